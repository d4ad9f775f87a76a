"""Single keys from a terminal, which is left as it was found.

Knows: termios. Does not know: what a key means.
"""

from __future__ import annotations

import contextlib
import os
import sys
import termios
from typing import Any, Self


class Keys:
    """A context in which keys come one by one; Ctrl-C stays a signal. Off a terminal there are none."""

    def __init__(self) -> None:
        self._before: list[Any] | None = None
        self.descriptor = -1

    def __enter__(self) -> Self:
        """Take the terminal, where stdin and stdout are one."""
        if sys.stdin is not None and sys.stdin.isatty() and sys.stdout.isatty():
            self.descriptor = sys.stdin.fileno()
            self._before = termios.tcgetattr(self.descriptor)
            new = termios.tcgetattr(self.descriptor)
            new[3] &= ~(termios.ICANON | termios.ECHO)
            termios.tcsetattr(self.descriptor, termios.TCSADRAIN, new)
        return self

    def __exit__(self, *_: object) -> None:
        """Give it back."""
        if self._before is not None:
            with contextlib.suppress(termios.error):  # it may have been closed
                termios.tcsetattr(self.descriptor, termios.TCSADRAIN, self._before)

    @property
    def is_there(self) -> bool:
        """Whether keys can come."""
        return self.descriptor >= 0

    def read(self) -> str:
        """What has been pressed; empty: the terminal is gone, and no key will come any more."""
        try:
            pressed = os.read(self.descriptor, 64).decode(errors="replace")
        except OSError:
            pressed = ""
        if not pressed:
            self.descriptor = -1
        return pressed
