"""Decides where each thing in a YAML file stands, and collects everything that is wrong with it.

Knows: YAML 1.2 nodes with line and column, faults and how they look, the building blocks of a schema (`Number`,
`Choice`, `Record`...). Does not know: what a fleet file holds (`zsched.config.schema`, `zsched.config.load`).

A building block reads one node: it returns the value, or reports a fault and returns `None`, and goes on, so that one
pass finds every fault. Scalars are taken by YAML 1.2's core schema and by what the place wants: ``no`` and ``12:30``
are text, ``0x10`` is 16, and where text is wanted ``1.10`` stays ``1.10``.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from functools import lru_cache
from typing import Final, TypeAlias

from zsched.core.values.struct import Struct, field, replace
from zsched.host.screen import printable

MAX_FILE_BYTES: Final = 256 << 10
"""Three thousand rules and more; each is checked, and an operator waits seconds."""
_MAX_DEPTH: Final = 32
_MAX_SHOWN: Final = 200
_MAX_COMPARED: Final = 300
"""More names than these are not searched for the nearest one: a long wrong list must not take minutes."""
_MAX_KEPT: Final = 4
"""Texts that are parsed once only: a verb that changes a document reads it, and what it becomes, dozens of times."""
_MAX_KEPT_CHARS: Final = 16 << 10
"""Longer texts are parsed each time: nodes take twelve times a text's room."""
_LINE_BREAK: Final = re.compile("\r\n|[\n\r\x85\u2028\u2029]")
"""YAML's own line breaks, so that our lines are its lines."""


class Place(Struct, frozen=True, kw_only=True):
    """A place in the file: line and column from 1, and how many characters the caret underlines."""

    line: int
    col: int
    width: int = 1
    file: str = ""
    """The file's name, where there are several (`zsched.config.parts`)."""

    def told(self) -> str:
        """As an operator is told of a place beside the fault's own."""
        return f"{self.file}:{self.line}:{self.col}" if self.file else f"{self.line}:{self.col}"


NOWHERE: Final = Place(line=0, col=0)
"""The file as a whole."""


class Fault(Struct, frozen=True, kw_only=True):
    """One thing wrong in a file: where (line and column from 1; 0: the whole file), what, and what to do."""

    line: int
    col: int
    message: str
    hint: str = ""
    source_line: str = ""
    width: int = 1
    file: str = ""
    """As `Place.file`."""
    is_of_electors: bool = False
    """A warning of how many electors the file has, or would have by default."""

    def render(self, file: str, severity: str = "error") -> str:
        """The fault as a compiler shows it: place, message, the line, a caret, the hint."""
        file = self.file or file
        if self.line == 0:
            lines = [f"{file}: {severity}: {self.message}"]
        else:
            lines = [f"{file}:{self.line}:{self.col}: {severity}: {self.message}"]
            # tabs stay tabs, so that the caret stands under its character whatever a terminal makes of them
            margin = "".join("\t" if char == "\t" else " " for char in self.source_line[: self.col - 1])
            lines += [f"    {self.source_line}", f"    {margin}^{'~' * (self.width - 1)}"]
        if self.hint:
            lines.append(f"    hint: {self.hint}")
        return "\n".join(lines)


class Collector:
    """The faults and warnings of one file, in the order of their places."""

    def __init__(self, lines: tuple[str, ...], faults: Iterable[Fault] = ()) -> None:
        """``faults``: what is known already."""
        self._lines = {"": lines}
        self._faults = list(faults)
        self._warnings: list[Fault] = []

    def add_file(self, file: str, text: str) -> None:
        """Some places are in this file, too."""
        self._lines[file] = _lines(text)

    def error(self, place: Place, message: str, hint: str = "") -> None:
        """The file cannot be used."""
        self._faults.append(self._fault(place, message, hint))

    def warn(self, place: Place, message: str, hint: str = "", *, is_of_electors: bool = False) -> None:
        """The file can be used, but an operator should know."""
        self._warnings.append(replace(self._fault(place, message, hint), is_of_electors=is_of_electors))

    @property
    def count(self) -> int:
        """Number of errors so far: a section compares it before and after to know whether it is whole."""
        return len(self._faults)

    @property
    def faults(self) -> tuple[Fault, ...]:
        """Errors in the order of the file, no two alike (an anchor may be read twice)."""
        return _in_order(self._faults)

    @property
    def warnings(self) -> tuple[Fault, ...]:
        """Warnings in the order of the file, no two alike."""
        return _in_order(self._warnings)

    def _fault(self, place: Place, message: str, hint: str) -> Fault:
        lines = self._lines[place.file]
        source = printable(lines[place.line - 1] if 0 < place.line <= len(lines) else "")
        width = max(1, min(place.width, len(source) - place.col + 1))
        line, col, file = place.line, place.col, place.file
        return Fault(line=line, col=col, message=message, hint=hint, source_line=source, width=width, file=file)


def _in_order(faults: Iterable[Fault]) -> tuple[Fault, ...]:
    return tuple(sorted(dict.fromkeys(faults), key=lambda fault: (fault.file, fault.line, fault.col)))


def render_all(file: str, faults: tuple[Fault, ...], severity: str = "error") -> str:
    """All faults of ``file``, one below the other, with a closing count when there are very many."""
    shown = [fault.render(file, severity) for fault in faults[:_MAX_SHOWN]]
    if len(faults) > _MAX_SHOWN:
        shown.append(f"{file}: {severity}: and {len(faults) - _MAX_SHOWN} more")
    return "\n".join(shown)


_MEANT: Final = {
    "wlan": "wifi",
    "wi-fi": "wifi",
    "wireless": "wifi",
    "lan": "wired",
    "ethernet": "wired",
    "cpu": "cpu_cores",
    "memory": "memory_mb",
    "docker": "container",
    "podman": "container",
}
"""Other words for what a fleet file says, which are spelled like something else."""


def nearest(name: str, names: Iterable[str]) -> str:
    """A hint naming what of ``names`` was probably meant, or all of them when they are few."""
    known = sorted(names)
    if _MEANT.get(name.lower()) in known:
        return f"did you mean {_MEANT[name.lower()]!r}?"
    if len(known) > _MAX_COMPARED:
        return ""
    close = difflib.get_close_matches(name, known, n=1, cutoff=0.6)
    if close:
        return f"did you mean {close[0]!r}?"
    if 0 < len(known) <= 20:
        return f"one of: {', '.join(known)}"
    return ""


# --- nodes -----------------------------------------------------------------------------------------------------------


class Scalar(Struct, frozen=True, kw_only=True):
    """One scalar as written; ``is_plain`` when without quotes (only then it may be a number, a boolean or null)."""

    text: str
    is_plain: bool
    place: Place

    @property
    def is_null(self) -> bool:
        """Nothing, ``~`` or ``null``."""
        return self.is_plain and self.text in ("", "~", "null", "Null", "NULL")


class Sequence(Struct, frozen=True, kw_only=True):
    """A list."""

    items: tuple[Node, ...]
    place: Place


class Mapping(Struct, frozen=True, kw_only=True):
    """Keys and values in the order of the file; keys are scalars, doubles are still there."""

    pairs: tuple[tuple[Scalar, Node], ...]
    place: Place


Node: TypeAlias = Scalar | Sequence | Mapping


def kind_of(node: Node) -> str:
    """What an operator calls this node."""
    if isinstance(node, Mapping):
        return "a mapping"
    if isinstance(node, Sequence):
        return "a list"
    return "nothing" if node.is_null else repr(node.text)


class _Conversion(Struct):
    """From ruamel's nodes to ours: aliases shared, circles and other oddities refused."""

    out: Collector
    done: dict[int, Node] = field(default_factory=dict)
    open_ids: set[int] = field(default_factory=set)

    def node(self, raw: object, depth: int) -> Node | None:
        known = self.done.get(id(raw))
        if known is not None:
            return known
        place = _place(raw)
        if id(raw) in self.open_ids:
            self.out.error(place, "an alias holds itself")
            return None
        if depth > _MAX_DEPTH:
            self.out.error(place, f"nested deeper than {_MAX_DEPTH} levels")
            return None
        self.open_ids.add(id(raw))
        node = self._convert(raw, place, depth)
        self.open_ids.discard(id(raw))
        if node is not None:
            self.done[id(raw)] = node
        return node

    def _convert(self, raw: object, place: Place, depth: int) -> Node | None:
        kind, value = getattr(raw, "id", ""), getattr(raw, "value", None)
        if kind == "scalar":
            return self._scalar(str(value), getattr(raw, "style", None) is None, place)
        if kind == "sequence" and isinstance(value, list):
            items = (self.node(item, depth + 1) for item in value)
            return Sequence(items=tuple(item for item in items if item is not None), place=place)
        if kind == "mapping" and isinstance(value, list):
            pairs = (self._pair(key, held, depth) for key, held in value)
            return Mapping(pairs=tuple(pair for pair in pairs if pair is not None), place=place)
        self.out.error(place, "cannot be read")
        return None

    def _scalar(self, text: str, is_plain: bool, place: Place) -> Scalar | None:
        if any("\ud800" <= char <= "\udfff" for char in text):
            self.out.error(place, "half of a UTF-16 pair is no character", "write the character itself")
            return None
        return Scalar(text=text, is_plain=is_plain, place=place)

    def _pair(self, key: object, value: object, depth: int) -> tuple[Scalar, Node] | None:
        name, held = self.node(key, depth + 1), self.node(value, depth + 1)
        if name is not None and not isinstance(name, Scalar):
            self.out.error(name.place, "a key must be one word, not " + kind_of(name))
            return None
        return (name, held) if name is not None and held is not None else None


def _place(raw: object) -> Place:
    start, end = getattr(raw, "start_mark", None), getattr(raw, "end_mark", None)
    if start is None:
        return NOWHERE
    width = 1
    if getattr(raw, "id", "") == "scalar" and end is not None and end.line == start.line:
        width = max(1, end.column - start.column)
    return Place(line=start.line + 1, col=start.column + 1, width=width)


# --- the file --------------------------------------------------------------------------------------------------------


def read_yaml(data: bytes) -> tuple[Node | None, Collector]:
    """The root node of a YAML 1.2 file, `None` when there is none to read, and the collector for all that follows."""
    if len(data) > MAX_FILE_BYTES:
        out = Collector(())
        out.error(NOWHERE, f"the file has {len(data)} bytes, more than the {MAX_FILE_BYTES} that are read")
        return None, out
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        good = data[: error.start].decode("utf-8", "replace")
        out = Collector(_lines(data.decode("utf-8", "replace")))
        out.error(_end_of(good), f"byte 0x{data[error.start]:02x} is not UTF-8", "save the file as UTF-8")
        return None, out
    try:
        root, faults = (_parsed if len(text) > _MAX_KEPT_CHARS else _kept)(text)
    except RecursionError:  # of this caller's stack, which is not kept with the text
        out = Collector(_lines(text))
        out.error(NOWHERE, "not valid YAML: nested too deeply")
        return None, out
    return root, Collector(_lines(text), faults)


def _parsed(text: str) -> tuple[Node | None, tuple[Fault, ...]]:
    """The root node and its faults; both are immutable, so that all who read the text may share them."""
    out = Collector(_lines(text))
    return _compose(text, out), out.faults


_kept: Final = lru_cache(maxsize=_MAX_KEPT)(_parsed)


def _lines(text: str) -> tuple[str, ...]:
    return tuple(_LINE_BREAK.split(text))


def _end_of(text: str) -> Place:
    lines = _lines(text)
    return Place(line=len(lines), col=len(lines[-1]) + 1)


def _compose(text: str, out: Collector) -> Node | None:
    from ruamel.yaml import YAML  # noqa: PLC0415 - 3 MB that only a process reading a fleet file should pay
    from ruamel.yaml.error import MarkedYAMLError, YAMLError  # noqa: PLC0415 - as above
    from ruamel.yaml.reader import ReaderError  # noqa: PLC0415 - as above

    try:
        yaml = YAML(typ="safe", pure=True)
        yaml.composer.warn_double_anchors = False  # YAML allows it, and a warning on stderr helps nobody
        raw = yaml.compose(text)
    except MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        place = Place(line=mark.line + 1, col=mark.column + 1) if mark is not None else NOWHERE
        message = str(error.problem or error.context).split("\n", 1)[0]
        out.error(place, f"not valid YAML: {message}", _syntax_hint(text, place))
    except ReaderError as error:
        before = text[: error.position] if isinstance(error.position, int) else ""
        out.error(_end_of(before), "not valid YAML: a control character", "delete it")
    except (YAMLError, ValueError, ArithmeticError, AttributeError, TypeError, LookupError, AssertionError) as error:
        # the library's own slips on hostile input; an operator still gets a sentence, not a traceback
        out.error(NOWHERE, f"not valid YAML: {str(error).split(chr(10), 1)[0] or type(error).__name__}")
    else:
        if raw is not None:
            return _Conversion(out).node(raw, 0)
        out.error(NOWHERE, "the file is empty", "`zsched new python` writes one that works")
    return None


def _syntax_hint(text: str, place: Place) -> str:
    lines = _lines(text)
    near = lines[place.line - 1] if 0 < place.line <= len(lines) else ""
    if "\t" in near[: place.col]:
        return "indent with spaces; YAML allows no tabs"
    if "{robot}" in near or "{target}" in near:
        return 'a template must be quoted: from: "{robot}/map"'
    return ""
