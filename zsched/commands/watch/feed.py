"""Asks one daemon again and again for its status and for new entries of its decision log.

Knows: the door, where the log was read to, that a daemon may be away for a while.
Does not know: how the answers are shown.
"""

from __future__ import annotations

from collections.abc import Callable

from zsched.clock import wall_s
from zsched.commands.ask import Door
from zsched.commands.common import CliError, Json
from zsched.commands.history import read_log
from zsched.commands.status import ask_status
from zsched.core.values.struct import Struct
from zsched.errors import ConfigError
from zsched.exits import EXIT_CONFIG, EXIT_OK


class News(Struct, frozen=True, kw_only=True):
    """What one question brought."""

    at: float
    """When it was asked: seconds since 1970, by the clock of this machine."""
    status: Json | None
    """``None``: nobody answered."""
    why: str = ""
    """Why nobody answered."""
    code: int = EXIT_OK
    """The exit code that tells so."""
    log_why: str = ""
    """Why there are no entries, although somebody answered."""
    entries: tuple[Json, ...] = ()
    """Lines of the decision log since the question before, the newest last; ``at`` is the node's clock."""


class Feed:
    """One daemon, asked by one thread."""

    def __init__(self, find: Callable[[], Door]) -> None:
        """``find`` names the daemon; it is called again until it does."""
        self._find = find
        self._door: Door | None = None
        self._cursor = ""

    def door(self) -> Door:
        """The daemon that is asked.

        Raises:
            CliError: there is none.
        """
        if self._door is None:
            self._door = self._find()
        return self._door

    def ask(self) -> News:
        """The next news; blocks for as long as a daemon may take to answer (5 s)."""
        at = wall_s()
        try:
            door = self.door()
            status = ask_status(door)
            try:
                return News(at=at, status=status, entries=self._entries(door))
            except CliError as error:  # a log that cannot be read hides no status
                problems = [*status.get("problems", ()), f"no events are shown: {error}"]
                return News(at=at, status={**status, "problems": problems}, log_why=str(error))
        except CliError as error:
            return News(at=at, status=None, why=str(error), code=error.code)
        except ConfigError as error:  # this machine's certificate is gone, or wrong; it may come back
            return News(at=at, status=None, why=str(error), code=EXIT_CONFIG)

    def _entries(self, door: Door) -> tuple[Json, ...]:
        """Of another machine there is no log: it lies on that machine."""
        if door.endpoint or door.node is not None:
            return ()
        _, _, entries, self._cursor = read_log(door, is_moves=False, cursor=self._cursor)
        return tuple(entries)
