"""Reading a YAML text: what is kept of a text that is read again."""

import sys

import pytest

from zsched.config import reader
from zsched.config.reader import NOWHERE, read_yaml


def test_a_text_that_is_read_again_is_not_parsed_again(monkeypatch: pytest.MonkeyPatch) -> None:
    text = b"a: {b: [1, 2]}  # read twice"
    root, first = read_yaml(text)
    monkeypatch.setattr(reader, "_compose", lambda *_: pytest.fail("it was parsed again"))
    again, second = read_yaml(text)
    assert again is root
    first.error(NOWHERE, "what one reader finds wrong")
    assert not second.faults  # is no fault for the other


@pytest.mark.parametrize("text", [b"a: [1", b"", b"{{a: 1}: 2}"])
def test_a_faulty_text_tells_its_faults_each_time(text: bytes) -> None:
    told = [read_yaml(text)[1].faults for _ in range(2)]
    assert told[0]
    assert told[0] == told[1]


def test_a_long_text_is_not_kept() -> None:
    text = b"".join(b"key%d: value\n" % number for number in range(2000))
    assert read_yaml(text)[0] is not read_yaml(text)[0]


def test_a_stack_that_was_too_deep_for_a_text_says_nothing_of_the_text_later() -> None:
    text = b"a: {b: {c: [1, {d: [2]}]}}  # read from far down"

    def read_at(depth: int) -> int:
        """How many faults it has there."""
        return read_at(depth - 1) if depth else len(read_yaml(text)[1].faults)

    def tried(depth: int) -> int:
        try:
            return read_at(depth)
        except RecursionError:
            return 0

    assert any(tried(depth) for depth in range(sys.getrecursionlimit(), 0, -1))
    assert not read_at(0)
