"""Decides in which places two YAML trees differ: a path, and what stands there before and after.

Knows: mappings, lists, scalars as they are written. Does not know: what a key means (`zsched.config.difference`).

A thing that is there in one tree only is one row, however much it holds. Of two mappings every key is compared by
itself, and so is every item of two lists of equal length; other lists are compared by what their items say.
"""

from __future__ import annotations

import difflib
import json
from collections.abc import Iterator
from typing import Final

from zsched.config.reader import Mapping, Node, Scalar, Sequence
from zsched.core.values.struct import Struct

_BREAKS: Final = {ord(char): f"\\u{ord(char):04x}" for char in "\x85\u2028\u2029"}
"""To YAML they end a line, of a comment, too; JSON leaves them as they are."""


class Row(Struct, frozen=True, kw_only=True):
    """One place that differs; ``None``: nothing stands there."""

    path: str
    """As ``tasks.echo.inputs[0].class``."""
    before: str | None
    after: str | None


def rows(old: Node | None, new: Node | None, path: str = "") -> Iterator[Row]:
    """Every place in which ``new`` differs from ``old``, in the order of ``new``, what is gone behind it."""
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        yield from _keys(old, new, path)
    elif isinstance(old, Sequence) and isinstance(new, Sequence):
        yield from _items(old, new, path)
    elif _said(old) != _said(new):
        yield Row(path=path, before=_said(old), after=_said(new))


def _keys(old: Mapping, new: Mapping, path: str) -> Iterator[Row]:
    before = {key.text: held for key, held in old.pairs}
    after = {key.text: held for key, held in new.pairs}
    for name in (*after, *(name for name in before if name not in after)):
        yield from rows(before.get(name), after.get(name), f"{path}.{name}" if path else name)


def _items(old: Sequence, new: Sequence, path: str) -> Iterator[Row]:
    is_plain = all(isinstance(item, Scalar) for item in (*old.items, *new.items))
    if is_plain and [flow(item) for item in old.items] != [flow(item) for item in new.items]:
        yield Row(path=path, before=flow(old), after=flow(new))
        return
    if len(old.items) == len(new.items):
        for number, (before, after) in enumerate(zip(old.items, new.items, strict=True)):
            yield from rows(before, after, f"{path}[{number}]")
        return
    ours, theirs = [flow(item) for item in old.items], [flow(item) for item in new.items]
    for what, start, end, first, last in difflib.SequenceMatcher(None, ours, theirs, autojunk=False).get_opcodes():
        if what != "equal":
            yield from (Row(path=f"{path}[{at}]", before=ours[at], after=None) for at in range(start, end))
            yield from (Row(path=f"{path}[{at}]", before=None, after=theirs[at]) for at in range(first, last))


def _said(node: Node | None) -> str | None:
    return None if node is None else flow(node)


def flow(node: Node) -> str:
    """The node on one line, as YAML's flow style writes it; comments are not in it."""
    if isinstance(node, Mapping):
        return "{" + ", ".join(f"{flow(key)}: {flow(held)}" for key, held in node.pairs) + "}"
    if isinstance(node, Sequence):
        return "[" + ", ".join(flow(item) for item in node.items) + "]"
    is_open = node.is_plain and not any(char in node.text for char in ",[]{}") and ": " not in node.text
    return node.text if is_open else json.dumps(node.text, ensure_ascii=False).translate(_BREAKS)
