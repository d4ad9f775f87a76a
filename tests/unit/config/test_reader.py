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
