"""Takes what zenoh prints on standard output into the daemon's own log: one line per cause and minute, not a flood.

zenoh writes its log to standard output and offers no other way. Its errors are often the only word on why a link does
not come about (a certificate, a refused handshake), and the same one comes with every attempt to dial. So standard
output becomes a pipe that a thread of this process reads. With ``RUST_LOG`` set, zenoh's own log stays untouched.

Knows: file descriptors, the look of zenoh's lines. Does not know: sessions, nodes.
"""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Mapping

from zsched.host.clock import monotonic_s
from zsched.host.guard import guarded

PERIOD_S = 60.0
"""One line per cause in this time; the others are counted."""
MAX_TEXT = 300
MAX_LINE = 65_536
"""An unfinished line longer than this is cut; it is not ours."""

log = logging.getLogger("zsched.zenoh")

_COLOURS = re.compile(r"\x1b\[[0-9;]*m")
_LINE = re.compile(r"\S+Z\s+(?P<level>[A-Z]+)\s+(?:\S+\s+)?(?:ThreadId\(\d+\)\s+)?(?P<cause>[\w:]+): (?P<text>.*)")
_SOURCE = re.compile(r" at \S+\.rs:\d+\.?$")
_LEVELS = {"ERROR": logging.WARNING, "WARN": logging.WARNING}
"""An error of zenoh's is none of ours: it dials again."""


class Digest:
    """Decides which of zenoh's lines are said; the others are counted and told with the next one of their cause."""

    def __init__(self) -> None:
        self._said_at: dict[str, float] = {}
        self._left_out: dict[str, int] = {}

    def line(self, raw: str, now: float) -> tuple[int, str] | None:
        """(level, text) to log for a line of zenoh's, or ``None``."""
        plain = _COLOURS.sub("", raw).strip()
        found = _LINE.fullmatch(plain)
        if found is None:
            return (logging.INFO, plain[:MAX_TEXT]) if plain else None
        cause = found["cause"]
        if now - self._said_at.get(cause, now - PERIOD_S) < PERIOD_S:
            self._left_out[cause] = self._left_out.get(cause, 0) + 1
            return None
        self._said_at[cause] = now
        left_out = self._left_out.pop(cause, 0)
        more = f" (and {left_out} more of this kind before)" if left_out else ""
        text = _SOURCE.sub("", found["text"])[:MAX_TEXT]
        return _LEVELS.get(found["level"], logging.INFO), f"{cause}: {text}{more}"


def capture(environ: Mapping[str, str]) -> bool:
    """Send standard output of this process into the log from now on; ``False`` when the operator wants zenoh's own."""
    if environ.get("RUST_LOG"):
        return False
    read_end, write_end = os.pipe()
    os.dup2(write_end, 1)
    os.close(write_end)
    guarded(_read, read_end, name="zsched-zenoh-log").start()
    return True


def _read(descriptor: int) -> None:
    digest, partial = Digest(), b""
    while chunk := os.read(descriptor, 65_536):
        *lines, partial = (partial + chunk).split(b"\n")
        partial = partial[-MAX_LINE:]
        for line in lines:
            said = digest.line(line.decode(errors="replace"), monotonic_s())
            if said is not None:
                log.log(*said)
