"""Decides whether one YAML node is the value that its place wants: the building blocks of a schema.

Knows: numbers with ranges, choices, names, endpoints, lists, records; each says in words what it takes. Does not know:
which of them the fleet file is made of (`zsched.config.schema`).
"""

from __future__ import annotations

import re
from collections.abc import Callable
from collections.abc import Mapping as Lookup
from dataclasses import fields
from enum import StrEnum
from typing import Any, Final, Generic, Protocol, TypeVar

from zsched.config.reader import Collector, Mapping, Node, Place, Scalar, Sequence, kind_of, nearest
from zsched.core.values.struct import Struct, field
from zsched.core.values.words import NAME

T = TypeVar("T")
T_co = TypeVar("T_co", covariant=True)

_INTEGER: Final = re.compile(r"[-+]?[0-9]{1,18}|0o[0-7]{1,20}|0x[0-9a-fA-F]{1,15}")
_REAL: Final = re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?")
_NOT_YAML_12: Final = ("yes", "no", "on", "off", "y", "n")


class Block(Protocol[T_co]):
    """One building block."""

    def read(self, node: Node, out: Collector) -> T_co | None:
        """The value of ``node``; `None` when it is none, after reporting why."""
        ...

    def says(self) -> str:
        """What it takes, in the words of the reference and of its faults."""
        ...


class Located(Struct, Generic[T], frozen=True):
    """A value and where it stands."""

    value: T
    place: Place


# --- scalars ---------------------------------------------------------------------------------------------------------


def _refuse(node: Node, out: Collector, wanted: str, hint: str = "") -> None:
    out.error(node.place, f"expected {wanted}, not {kind_of(node)}", hint)


class Number(Struct, frozen=True):
    """A finite number in [low, high]; ``unit`` is for the reader only."""

    low: float
    high: float
    unit: str = ""

    def read(self, node: Node, out: Collector) -> float | None:
        """The number."""
        if not isinstance(node, Scalar) or not node.is_plain or _REAL.fullmatch(node.text) is None:
            quoted = isinstance(node, Scalar) and not node.is_plain and _REAL.fullmatch(node.text) is not None
            _refuse(node, out, self.says(), "it is text: remove the quotes" if quoted else "")
            return None
        value = float(node.text)
        if not self.low <= value <= self.high:
            is_percent = (self.low, self.high, self.unit) == (0.0, 1.0, "") and 2.0 <= value <= 100.0
            hint = f"a share: {node.text} % is {plain_number(value / 100.0)}" if is_percent else ""
            out.error(node.place, f"{node.text} is not in the allowed range {self._range()}", hint)
            return None
        return value

    def says(self) -> str:
        """Range and unit."""
        return f"a number {self._range()}"

    def _range(self) -> str:
        return f"{plain_number(self.low)}..{plain_number(self.high)}{f' {self.unit}' if self.unit else ''}"


class Whole(Struct, frozen=True):
    """A whole number in [low, high]."""

    low: int
    high: int

    def read(self, node: Node, out: Collector) -> int | None:
        """The number."""
        if not isinstance(node, Scalar) or not node.is_plain or _INTEGER.fullmatch(node.text) is None:
            _refuse(node, out, self.says())
            return None
        value = int(node.text, 0 if node.text[:2] in ("0x", "0o") else 10)
        if not self.low <= value <= self.high:
            out.error(node.place, f"{node.text} is not in the allowed range {self.low}..{self.high}")
            return None
        return value

    def says(self) -> str:
        """Range."""
        return f"a whole number {self.low}..{self.high}"


class Flag(Struct, frozen=True):
    """``true`` or ``false``; ``only`` when just one of them makes sense."""

    only: bool | None = None

    def read(self, node: Node, out: Collector) -> bool | None:
        """The truth value."""
        text = node.text.lower() if isinstance(node, Scalar) and node.is_plain else ""
        if text not in ("true", "false") or (self.only is not None and text != str(self.only).lower()):
            hint = "YAML 1.2 has only true and false" if text in _NOT_YAML_12 else ""
            _refuse(node, out, self.says(), hint)
            return None
        return text == "true"

    def says(self) -> str:
        """The words it takes."""
        return "`true` or `false`" if self.only is None else f"`{str(self.only).lower()}`"


class Choice(Struct, Generic[T], frozen=True):
    """One of some words, each standing for a value."""

    values: Lookup[str, T]

    @classmethod
    def of(cls, kind: type[T]) -> Choice[T]:
        """The words of an enumeration of strings."""
        assert issubclass(kind, StrEnum)
        return cls({str(member): member for member in kind})

    def read(self, node: Node, out: Collector) -> T | None:
        """The value that the word stands for."""
        if not isinstance(node, Scalar) or node.is_null:
            _refuse(node, out, self.says())
            return None
        if node.text not in self.values:
            out.error(node.place, f"{node.text!r} is not {self.says()}", nearest(node.text, self.values))
            return None
        return self.values[node.text]

    def says(self) -> str:
        """The words."""
        return " or ".join(f"`{word}`" for word in self.values)


class Text(Struct, frozen=True):
    """Text as written (a plain ``1.10`` stays ``1.10``), checked by ``fault``: why not, or `None`."""

    what: str
    fault: Callable[[str], str | None] = lambda _: None
    hint: str = ""

    def read(self, node: Node, out: Collector) -> str | None:
        """The text."""
        if not isinstance(node, Scalar) or node.is_null:
            _refuse(node, out, self.what, self.hint)
            return None
        problem = self.fault(node.text)
        if problem is not None:
            out.error(node.place, f"{node.text!r} is not {self.what}: {problem}", self.hint)
            return None
        return node.text

    def says(self) -> str:
        """What the text is."""
        return self.what


_NO_NAME_S: Final = re.compile(r"[^a-z0-9_-]+")


def _name_fault(text: str) -> str | None:
    if NAME.fullmatch(text) is not None:
        return None
    if len(text) > 63:
        return f"it has {len(text)} characters, more than 63"
    likely = _NO_NAME_S.sub("-", text.lower()).strip("-_")
    example = f"; for example {likely}" if NAME.fullmatch(likely) is not None else ""
    return f"small letters, digits, '_' and '-', and a letter or digit first{example}"


NAME_BLOCK: Final = Text("a name", _name_fault)


class Here(Struct, Generic[T], frozen=True):
    """What ``inner`` reads, with its place, for checks that come later."""

    inner: Block[T]

    def read(self, node: Node, out: Collector) -> Located[T] | None:
        """Value and place."""
        value = self.inner.read(node, out)
        return None if value is None else Located(value, node.place)

    def says(self) -> str:
        """As ``inner``."""
        return self.inner.says()


# --- collections -----------------------------------------------------------------------------------------------------


class ListOf(Struct, Generic[T], frozen=True):
    """A list of at least ``least`` items."""

    item: Block[T]
    least: int = 0

    def read(self, node: Node, out: Collector) -> tuple[T, ...] | None:
        """The items that could be read."""
        if not isinstance(node, Sequence):
            words = ", ".join(node.text.split()) if isinstance(node, Scalar) and not node.is_null else ""
            hint = f"write a list: [{words}]" if words else ""
            _refuse(node, out, self.says(), hint)
            return None
        if len(node.items) < self.least:
            found = len(node.items) or "none"
            out.error(node.place, f"expected {self.says()}, at least {self.least} of them, found {found}")
            return None
        values = (self.item.read(item, out) for item in node.items)
        return tuple(value for value in values if value is not None)

    def says(self) -> str:
        """What the items are."""
        return f"a list, each {self.item.says()}"


class MapOf(Struct, Generic[T], frozen=True):
    """A mapping from free keys (checked by ``key``) to values of one kind."""

    key: Text
    item: Block[T]

    def read(self, node: Node, out: Collector) -> dict[str, Located[T | None]] | None:
        """Value and place of each key; a value that could not be read is `None`, its key is still there.

        One of whose keys none can be read is `None`, and not empty.
        """
        if not isinstance(node, Mapping):
            _refuse(node, out, self.says())
            return None
        before = out.count
        held: dict[str, Located[T | None]] = {}
        for key, value in _distinct(node, out):
            name = self.key.read(key, out)
            item = self.item.read(value, out)
            if name is not None:
                held[name] = Located(item, key.place)
        return held if held or out.count == before else None

    def says(self) -> str:
        """What keys and values are."""
        return f"a mapping, each key {self.key.says()}, each value {self.item.says()}"


class Field(Struct, frozen=True):
    """One key of a record. ``default`` is only for the reference."""

    block: Block[Any]
    doc: str
    required: bool = False
    default: str = ""


class Section(Struct):
    """A record that was read: values by key, with places. Keys that were absent or faulty are not there."""

    place: Place
    values: dict[str, Any] = field(default_factory=dict)
    places: dict[str, Place] = field(default_factory=dict)
    is_whole: bool = True
    """No fault in it: only then do checks between its fields make sense."""

    def get(self, key: str, default: Any = None) -> Any:
        """The value of ``key``, or ``default``."""
        return self.values.get(key, default)

    def where(self, key: str) -> Place:
        """Where the value of ``key`` stands; the section's own place when it is absent."""
        return self.places.get(key, self.place)

    def build(self, kind: type[T], out: Collector, **more: Any) -> T | None:
        """``kind`` from the values of the same names and ``more``; a `ValueError` of its own checks is a fault."""
        names = {item.name for item in fields(kind)}  # type: ignore[arg-type] # every caller passes a dataclass
        given = {name: value for name, value in self.values.items() if name in names}
        try:
            return kind(**{**given, **more})
        except ValueError as error:
            if self.is_whole:
                out.error(self.place, str(error))
                self.is_whole = False
            return None


class Record(Struct, frozen=True):
    """A mapping with known keys."""

    what: str
    items: Lookup[str, Field]
    removed: Lookup[str, str] = field(default_factory=dict)
    """{key that files had once: what to write instead}; files and agreed documents with it stay in force."""

    def read(self, node: Node, out: Collector) -> Section | None:
        """Every key that could be read; unknown, double and missing ones are faults."""
        if not isinstance(node, Mapping):
            _refuse(node, out, self.says())
            return None
        before = out.count
        section = Section(node.place)
        for key, value in _distinct(node, out):
            item = self.items.get(key.text)
            if item is None:
                self._refuse_key(key, out)
                continue
            section.places[key.text] = value.place
            read = item.block.read(value, out)
            if read is not None:
                section.values[key.text] = read
        for name, item in self.items.items():
            if item.required and name not in section.places:
                out.error(node.place, f"{self.what} lacks the key {name!r}", f"{name}: {item.block.says()}")
        section.is_whole = out.count == before
        return section

    def _refuse_key(self, key: Scalar, out: Collector) -> None:
        gone = self.removed.get(key.text)
        if gone is None:
            out.error(key.place, f"{self.what} has no key {key.text!r}", nearest(key.text, self.items))
        else:
            out.warn(key.place, f"{self.what} has no key {key.text!r} any more; nothing is done with it", gone)

    def says(self) -> str:
        """Its keys."""
        return f"a mapping {{{', '.join(self.items)}}}"


class Forms(Struct, frozen=True):
    """A place that takes more than one shape: each node goes to the block of its shape."""

    word: Block[Any] | None = None
    listing: Block[Any] | None = None
    mapping: Block[Any] | None = None

    def read(self, node: Node, out: Collector) -> Any:
        """What the block of the node's shape reads."""
        block = self.word
        if isinstance(node, Mapping):
            block = self.mapping
        elif isinstance(node, Sequence):
            block = self.listing
        if block is None:
            _refuse(node, out, self.says())
            return None
        return block.read(node, out)

    def says(self) -> str:
        """All shapes."""
        return ", or ".join(block.says() for block in (self.word, self.listing, self.mapping) if block is not None)


def _distinct(node: Mapping, out: Collector) -> list[tuple[Scalar, Node]]:
    """The pairs of a mapping, second ones of a key reported and left out."""
    first: dict[str, tuple[Scalar, Node]] = {}
    for key, value in node.pairs:
        known = first.setdefault(key.text, (key, value))
        if known[0] is not key:
            out.error(key.place, f"the key {key.text!r} is there twice", f"first at {known[0].place.told()}")
    return list(first.values())


def plain_number(value: float) -> str:
    """As one writes it."""
    return f"{value:g}" if abs(value) < 1e5 else f"{value:.0f}"
