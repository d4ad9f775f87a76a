"""What relays and workers say to one another about a hop."""

from __future__ import annotations

from zsched.core.values.relay_protocol import mark_of


def test_each_key_has_a_number_of_its_own_that_every_process_finds_and_none_is_no_key_s() -> None:
    """An acknowledgement tells by it under which key a publisher was heard; 0 there says that it does not tell."""
    marks = [mark_of(f"edge1/merge/robot{number}/map") for number in range(100)]
    assert len(set(marks)) == len(marks)
    assert all(1 <= mark <= 1 << 56 for mark in marks)
    assert mark_of("robot1/map") == 71017246864263755, "programs of other releases reckon with the same number"
