"""Tells where what was added to a fleet file stands in the operator's own file, from which it came.

Knows: the trees of both texts. Does not know: how a part gets into a fleet file (`zsched.config.editing`), faults.

A fault in the new entry of a merged text is the operator's to find, in a file that they have.
"""

from __future__ import annotations

from zsched.config.reader import Mapping, Node, Place, Scalar, Sequence, read_yaml
from zsched.core.values.struct import Struct, replace

Pair = tuple[Scalar, Node]


class Part(Struct, frozen=True, kw_only=True):
    """A text with one section of a fleet file, whose entries were added to another text."""

    section: str
    text: str
    file: str
    """The name of the file that it stands in."""


def placed(root: Node, file: str, part: Part) -> Node:
    """The tree of the merged text, called ``file``: every place names its file, also of what came from ``part``."""
    own, _ = read_yaml(part.text.encode())
    added = {key.text: (key, held) for key, held in _entries(own, part.section)}
    whole = _in_file(root, file)
    if not isinstance(whole, Mapping):
        return whole
    pairs = [(key, _with(held, added, part.file) if key.text == part.section else held) for key, held in whole.pairs]
    return replace(whole, pairs=tuple(pairs))


def _entries(root: Node | None, section: str) -> tuple[Pair, ...]:
    held = next((held for key, held in root.pairs if key.text == section), None) if isinstance(root, Mapping) else None
    return held.pairs if isinstance(held, Mapping) else ()


def _with(section: Node, added: dict[str, Pair], file: str) -> Node:
    """The section with the added entries as they stand in their own file: they say the same there."""
    if not isinstance(section, Mapping):
        return section
    pairs = [_pair_in_file(added[key.text], file) if key.text in added else (key, held) for key, held in section.pairs]
    return replace(section, pairs=tuple(pairs))


def _pair_in_file(pair: Pair, file: str) -> Pair:
    key, held = pair
    return replace(key, place=_named(key.place, file)), _in_file(held, file)


def _in_file(node: Node, file: str) -> Node:
    place = _named(node.place, file)
    if isinstance(node, Mapping):
        return replace(node, pairs=tuple(_pair_in_file(pair, file) for pair in node.pairs), place=place)
    if isinstance(node, Sequence):
        return replace(node, items=tuple(_in_file(item, file) for item in node.items), place=place)
    return replace(node, place=place)


def _named(place: Place, file: str) -> Place:
    made: Place = replace(place, file=file)
    return made
