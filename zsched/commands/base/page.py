"""Lines of text for a terminal: tables, blocks that wrap, and styles that take no room (pure).

Knows: columns, cutting, ANSI styles, how figures and moments are written. Does not know: what is shown.
"""

from __future__ import annotations

import re
import shutil
import textwrap
import time
from collections.abc import Sequence
from typing import Any, Final, TypeAlias

from zsched.commands.base.common import CliError, Json
from zsched.core.values.exits import EXIT_USAGE
from zsched.core.values.gauges import BY_NAME
from zsched.core.values.words import PAPER_METRICS, missed

STYLES = {"bold": "1", "dim": "2", "red": "31", "green": "32", "yellow": "33", "stage": "1;36", "alarm": "1;31"}

DROPS_OVER_S = 60.0
"""Drops that have not risen for this long are over."""

NAME_ROOM: Final = 20
"""Columns that a name may take on a page of 100."""

Cell: TypeAlias = tuple[str, str]
"""A text and its style ("" for none)."""


def page_width() -> int:
    """Columns of the terminal, as far as a page uses them."""
    return max(60, min(shutil.get_terminal_size((100, 30)).columns, 160))


Row = tuple[str, str, str, str]
"""Of a table: (task, what, before, after) of a change."""


def lined(titles: Row, rows: Sequence[Row]) -> list[str]:
    """A table as lines; none where it has no row."""
    shown = [titles, *rows] if rows else []
    widths = [max(map(len, column)) for column in zip(*shown, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in shown]


class Page:
    """Lines that are never longer than ``width``; ``indent`` is where a block's text begins."""

    def __init__(self, width: int, color: bool, at: float | None = None) -> None:
        """``at``: now, by this machine's clock (seconds since 1970); ``None``: no wall times."""
        self.width, self.indent, self._color = width, 11, color
        self._at = at
        self.lines: list[str] = []

    def paint(self, text: str, style: str) -> str:
        """``text`` in a style, when there is colour."""
        return f"\x1b[{STYLES[style]}m{text}\x1b[0m" if style and text and self._color else text

    def moment(self, age_s: float) -> str:
        """Behind an age: when that was on this machine's clock."""
        return "" if self._at is None else f", {clock_time(self._at - age_s, self._at)}"

    def since(self, age_s: float) -> str:
        """Behind a duration: since when, on this machine's clock."""
        return "" if self._at is None else f", since {clock_time(self._at - age_s, self._at)}"

    def row(self, *cells: tuple[str, int, str], indent: int = 0) -> None:
        """One line of a table: (text, columns, style) each; negative columns align right, what is too long is cut."""
        line, used = " " * indent, indent
        for text, columns, style in cells:
            room = min(abs(columns), self.width - used)
            if room <= 0:
                break
            shown = cut(text, room)
            blanks = " " * (room - len(shown))
            line += blanks + self.paint(shown, style) if columns < 0 else self.paint(shown, style) + blanks
            line += " "
            used += room + 1
        self.lines.append(line.rstrip())

    def block(self, title: str, *parts: Cell) -> None:
        """A title and behind it the parts, joined by dots and broken between them (in them only when need be)."""
        used = max(self.indent, len(title) + 2)
        line = self.paint(title, "stage") + " " * (used - len(title))
        is_first = True
        for text, style in parts:
            for index, piece in enumerate(textwrap.wrap(text, self.width - self.indent) or [""]):
                joint = "" if is_first or index else " · "
                if index or (not is_first and used + len(joint) + len(piece) > self.width):
                    self.lines.append(line.rstrip())
                    line, used, joint = " " * self.indent, self.indent, ""
                line += joint + self.paint(piece, style)
                used += len(joint) + len(piece)
                is_first = False
        self.lines.append(line.rstrip())


def name_room(page: int, least: int, *lengths: int) -> int:
    """Columns for the longest of some names (characters each) on a page: 20 of 100 or fewer, more of a wider one."""
    return min(max(least, *lengths), max(NAME_ROOM, page - 80))


def short_name(name: str, width: int) -> str:
    """A name in at most ``width`` characters: of a long one the end is kept, for by that names of a fleet differ.

    >>> short_name("warehouse-north-robot-07", 12)
    '…th-robot-07'
    """
    return name if len(name) <= width else f"…{name[len(name) - width + 1 :]}"


def cut(text: str, width: int) -> str:
    """At most ``width`` characters; a dot at the end shows that there were more."""
    return text if len(text) <= width else text[: max(width - 1, 0)] + "…"[:width]


def span(seconds: float | None) -> str:
    """A duration in at most five characters or so: ``0.3s 42s 5m03s 3h05m 2d04h``; ``-`` when there is none."""
    if seconds is None:
        return "-"
    if seconds < 9.95:
        return f"{max(seconds, 0.0):.1f}s"
    whole = round(seconds)
    for unit, smaller, big, small in (("d", "h", 86400, 3600), ("h", "m", 3600, 60), ("m", "s", 60, 1)):
        if whole >= big:
            return f"{whole // big}{unit}{whole % big // small:02d}{smaller}"
    return f"{whole}s"


def short_span(seconds: float | None) -> str:
    """The same in at most four characters from ten minutes on: ``45m 12h 2d``.

    >>> [short_span(seconds) for seconds in (None, 303.0, 2712.0, 43_500.0, 864_000.0)]
    ['-', '5m03s', '45m', '12h', '10d']
    """
    told = span(seconds)
    return told if len(told) <= 5 else re.split(r"(?<=[dhm])", told)[0]


_DURATION = re.compile(r"([0-9]{1,12}(?:\.[0-9]{1,9})?)(s|m|h|d)")
_UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86400.0}


def duration_s(text: str) -> float:
    """Seconds of a duration like ``90s``, ``10m``, ``2h``, ``1d``.

    >>> duration_s("10m")
    600.0

    Raises:
        CliError: it is none.
    """
    seconds = age_s_of(text)
    if seconds is None:
        raise CliError(EXIT_USAGE, f"{text!r} is no duration; write it like 90s, 10m, 2h or 1d")
    return seconds


def age_s_of(text: str) -> float | None:
    """Seconds of a duration; ``None``: it is none."""
    found = _DURATION.fullmatch(text)
    return None if found is None else float(found[1]) * _UNITS[found[2]]


def clock_time(then: float, now: float) -> str:
    """A moment of today as ``14:03:22``, an older one as ``11-22 14:03`` (local time; seconds since 1970)."""
    told, today = time.localtime(then), time.localtime(now)
    return time.strftime("%H:%M:%S" if told[:3] == today[:3] else "%m-%d %H:%M", told)


SINCE_START: Final = " (none since the daemon's start)"
"""Behind a number of drops that are all older."""


def none_for(age_s: float | None) -> str:
    """Behind a number of drops: that they are over, once none has come for a minute."""
    return f" (none in the last minute, last {span(age_s)} ago)" if age_s is not None and age_s > DROPS_OVER_S else ""


def missed_of(stream: dict[str, Any]) -> int:
    """How many of a stream's samples somebody may miss."""
    return missed(stream["drops"].items(), stream.get("lost") or 0, stream.get("at_most_lost") or 0)


def since_drop(stream: dict[str, Any]) -> str:
    """Behind the number of a stream's drops, as `none_for`; the relay's books are older than its daemon."""
    age_s = stream.get("dropped_s", 0.0)  # a later field of the schema's major version
    return SINCE_START if age_s is None else none_for(age_s)


def memory(mib: float) -> str:
    """Memory given in MiB: ``98M``, ``23.5G``, ``126G``."""
    if mib < 1000:
        return f"{mib:.0f}M"
    gib = mib / 1024
    return f"{gib:.1f}G" if gib < 99.95 else f"{gib:.0f}G"


def size(count: int) -> str:
    """Bytes: ``512 B``, ``1.2 MiB``."""
    value, units = float(count), ("B", "KiB", "MiB", "GiB")
    for unit in units:
        if value < 1000 or unit == units[-1]:
            return f"{value:.0f} {unit}" if unit == "B" else f"{value:.1f} {unit}"
        value /= 1024
    raise AssertionError


NAMES = (*PAPER_METRICS, *BY_NAME)


def shares(weights: Json) -> dict[str, float]:
    """``{metric: weight}`` of a status' weights, or of some: the paper's three, and the gauges that have one.

    >>> shares({"cpu": 0.7, "memory": 0.0, "network": 0.0, "gauges": {"gpu": 0.3}})
    {'cpu': 0.7, 'memory': 0.0, 'network': 0.0, 'gpu': 0.3}
    """
    found = {**weights, **weights.get("gauges", {})}  # a later field of the schema's major version
    return {name: found.get(name, 0.0) for name in NAMES if name in PAPER_METRICS or found.get(name)}
