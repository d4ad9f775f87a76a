"""Decides how a document says that a task is on its way to another cell: in a comment, which holds the task's entry.

Knows: the comment's lines. Does not know: entries and sections (`zsched.config.editing`), cells and their steps
(`zsched.commands.hand`).

A comment changes nothing for a node, so daemons of every version take it; and whoever reads the document sees it. It is
agreed like the rest of the text: either cell can be asked how far a task is, from any machine.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from typing import Final

from zsched.config.reader import Mapping, Node, Scalar, read_yaml
from zsched.core.values.model import TaskId
from zsched.core.values.struct import Struct

_BEGIN: Final = re.compile(r"# zsched: task (\S+) goes to cell (\S+?)(?: by ([0-9a-f]{8}))?;.*")
_SECTION: Final = "tasks:\n"
_WORD: Final = re.compile(r"[A-Za-z0-9_-]+")


class Mark(Struct, frozen=True, kw_only=True):
    """A task of this cell that is on its way to another one."""

    task: TaskId
    cell: str
    entry: str
    """Its entry here, a text with the one key ``tasks``."""
    by: str = ""
    """Which run of the command takes it there, as eight hexadecimal digits; empty: it is not told."""


def marks_of(text: str) -> Iterator[Mark]:
    """What a document says of every task that is on its way."""
    lines = text.split("\n")
    for first, last in _places(lines):
        found = _BEGIN.fullmatch(lines[first])
        assert found is not None
        entry = "".join(f"{line[2:]}\n" for line in lines[first + 1 : last])
        yield Mark(task=found[1], cell=found[2], entry=_SECTION + entry, by=found[3] or "")


def mark_of(text: str, task: TaskId) -> Mark | None:
    """What a document says of a task that is on its way; ``None``: nothing."""
    return next((mark for mark in marks_of(text) if mark.task == task), None)


def marked(text: str, mark: Mark) -> str:
    """The document that says so, at its end."""
    text = unmarked(text, mark.task)
    goes_on = f"`zsched task hand {mark.task} {mark.cell}` goes on"
    kept = mark.entry.removeprefix(_SECTION).removesuffix("\n").split("\n")
    body = [f"# {line}" if line else "#" for line in kept]
    by = f" by {mark.by}" if mark.by else ""
    lines = (f"# zsched: task {mark.task} goes to cell {mark.cell}{by}; {goes_on}", *body, _end(mark.task))
    ended = text if not text or text.endswith("\n") else f"{text}\n"
    return ended + "".join(f"{line}\n" for line in lines)


def unmarked(text: str, task: TaskId) -> str:
    """The document without it, however often it stands there; all else stays."""
    lines = text.split("\n")
    gone = {at for first, last in _places(lines) if lines[last] == _end(task) for at in range(first, last + 1)}
    return "\n".join(line for at, line in enumerate(lines) if at not in gone)


def names_in(entry: str, names: Collection[str]) -> tuple[str, ...]:
    """Those of ``names`` that stand as words in what an entry says: candidates, keys, the words of a command."""
    root, _ = read_yaml(entry.encode())
    words = set() if root is None else {word for text in _said(root) for word in _WORD.findall(text)}
    return tuple(sorted(words.intersection(names)))


def _end(task: TaskId) -> str:
    return f"# zsched: end of task {task}"


def _places(lines: list[str]) -> Iterator[tuple[int, int]]:
    """The first and the last line of every such comment."""
    for first, line in enumerate(lines):
        found = _BEGIN.fullmatch(line)
        if found is None:
            continue
        for last in range(first + 1, len(lines)):
            if lines[last] == _end(found[1]):
                yield first, last
                break
            if not lines[last].startswith("#"):
                break  # somebody has cut it


def _said(node: Node) -> Iterator[str]:
    if isinstance(node, Scalar):
        yield node.text
        return
    for held in (held for _, held in node.pairs) if isinstance(node, Mapping) else node.items:
        yield from _said(held)
