"""What is written for people: without what a terminal would obey, and broken at the width of theirs.

Knows: terminals and their width. Does not know: what is written. What is no terminal gets lines as they are: a file, a
journal, another program.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Sequence
from typing import Any, Final, TextIO

MIN_WIDTH: Final = 60
"""Of what is written for people; a terminal that is narrower breaks the lines itself."""
DEFAULT_WIDTH: Final = 80
"""Of a terminal that does not tell its own."""
COMMAND: Final = re.compile(r"`[^`]*`")
"""Within a sentence."""
COMMAND_LINE: Final = re.compile(r" *(?:sudo )?zsched (?![\w -]*: )")
"""A line of its own; an error's first line begins with the verb, too, and a colon."""
GLUE: Final = "\0"
"""In place of a blank within a command, which is not broken."""
CUT_LINES, WRAP_LINES = "\x1b[?7l", "\x1b[?7h"
"""The terminal cuts lines that are too wide, instead of moving all below them; and wraps them again, as usual."""
_HOME, _REST_OF_LINE, _REST_OF_SCREEN = "\x1b[H", "\x1b[K", "\x1b[J"
CARET: Final = "^"
"""Begins the line that points into the line above it."""


def fitted(text: str, stream: TextIO, indent: int = 2) -> str:
    """The text as it is written to ``stream``: harmless, and on a terminal no wider than that."""
    shown, width = harmless(text), screen_width(stream)
    return shown if width is None else wrapped(shown, width, indent)


def drawn(lines: Sequence[str], end: str = "\n") -> str:
    """The lines from the top of the screen; what was there is overwritten, so nothing flickers.

    Each is cleared before it is written: behind a whole line the cursor stands on its last character.
    """
    *others, last = lines or [""]
    return _HOME + "".join(f"{_REST_OF_LINE}{line}{end}" for line in others) + _REST_OF_SCREEN + last


def screen_width(stream: TextIO | None = None) -> int | None:
    """How many columns there are for people (of stdout, if no other is meant); ``None``: nobody looks."""
    stream = sys.stdout if stream is None else stream
    return max(_columns(stream), MIN_WIDTH) if is_screen(stream) else None


def is_screen(stream: TextIO) -> bool:
    """Whether people look at what is written there."""
    return stream.isatty()


def _columns(stream: TextIO) -> int:
    told = os.environ.get("COLUMNS", "")
    if told.isascii() and told.isdigit() and int(told) > 0:
        return int(told)
    try:
        return os.get_terminal_size(stream.fileno()).columns or DEFAULT_WIDTH
    except OSError:  # stdout of a test has no descriptor (io.UnsupportedOperation)
        return DEFAULT_WIDTH


def harmless(text: str) -> str:
    """The text with every character that a terminal would obey, but line ends and tabs, replaced by ``?``."""
    return text if text.isprintable() else "".join(c if c.isprintable() or c in "\n\t" else "?" for c in text)


def printable(value: Any) -> Any:
    """The JSON value with each of its texts as one such line."""
    if isinstance(value, str):
        return harmless(value).replace("\n", "?")
    if isinstance(value, list):
        return [printable(item) for item in value]
    if isinstance(value, dict):
        return {printable(key): printable(item) for key, item in value.items()}
    return value


def wrapped(text: str, width: int, indent: int = 2) -> str:
    """Lines of at most ``width`` columns: one that is longer is broken between its words, and goes on at ``indent``.

    What people copy stays whole, though it may be longer: a word, such as a path, and a command, on a line of its own
    or between backquotes. A line that the next one points into with a caret is cut, if it points into what remains.
    """
    import textwrap  # noqa: PLC0415 - off a terminal nothing is wrapped

    lines = text.split("\n")
    told: list[str] = []
    for line, following in zip(lines, [*lines[1:], ""], strict=True):
        if len(line) <= width or line.lstrip()[:1] == CARET or COMMAND_LINE.match(line):
            told.append(line)
            continue
        if following.lstrip()[:1] == CARET:
            told.append(line if len(following) >= width else f"{line[: width - 1]}…")
            continue
        deeper = max(indent, len(line) - len(line.lstrip()) + 2)
        glued = COMMAND.sub(lambda found: found[0].replace(" ", GLUE), line)
        pieces = textwrap.wrap(
            glued, width, subsequent_indent=" " * deeper, break_long_words=False, break_on_hyphens=False
        )
        told += [piece.replace(GLUE, " ") for piece in pieces] or [""]
    return "\n".join(told)
