"""Asks one daemon again and again for its status and for new entries of its decision log, and keeps what it told.

Knows: the door, where the log was read to, that a daemon may be away for a while, how much of the past is kept.
Does not know: how the answers are shown.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from typing import Final

from zsched.commands.base.ask import Door
from zsched.commands.base.common import CliError, Json
from zsched.commands.look.history import moves_of, read_log, wall_text
from zsched.commands.look.status import ask_status
from zsched.core.values.errors import ConfigError
from zsched.core.values.exits import EXIT_CONFIG, EXIT_OK
from zsched.core.values.struct import Struct
from zsched.core.values.words import CREATION_STEP
from zsched.host.clock import wall_s


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


POINTS: Final = 900
"""Of a task's utilities: a quarter of an hour at one a second."""
SAME_S: Final = 0.1
"""Judgements that lie nearer together are one, told twice: the age and the moment of the question are read apart."""
MOST_MOVES: Final = 200
MOST_EVENTS: Final = 300


class Point(Struct, frozen=True, kw_only=True):
    """The joint utilities of a task's candidates in one round."""

    at: float
    """Seconds since 1970, by the clock of this machine."""
    owner: str | None
    totals: dict[str, float]
    """{candidate: joint utility}; a candidate that cannot have the task has none."""


class Past:
    """Takes news and keeps what they tell."""

    def __init__(self) -> None:
        self.status: Json | None = None
        """The newest one; while nobody answers the last one of before."""
        self.answered_at = 0.0
        self.why = ""
        """Why nobody answers; empty while somebody does."""
        self.code = EXIT_OK
        """The exit code for that."""
        self.points: dict[str, deque[Point]] = {}
        self.events: deque[Json] = deque(maxlen=MOST_EVENTS)
        """Lines of the decision log, the newest last."""
        self._of_moves: deque[Json] = deque(maxlen=2 * MOST_MOVES)
        self._now = 0.0

    def take(self, news: News) -> None:
        """Keep what is new."""
        self._now = news.at
        self.why, self.code = news.why, news.code
        for entry in news.entries:
            self.events.append(entry)
            if "move" in entry or "took_s" in entry:
                self._of_moves.append(entry)
        if news.status is None:
            return
        self.status, self.answered_at = news.status, news.at
        for task in news.status["tasks"]:
            decision = task["decision"]
            if decision is None:  # an edge decides nothing
                continue
            kept = self.points.setdefault(task["name"], deque(maxlen=POINTS))
            judged_at = news.at - decision["age_s"]
            if kept and kept[-1].at - judged_at > SAME_S:
                kept.clear()  # this machine's clock was set back: what is newer than now would hide what is told now
            if not kept or judged_at - kept[-1].at > SAME_S:
                kept.append(Point(at=judged_at, owner=task["owner"], totals=dict(decision["aggregates"])))

    def moves(self) -> list[Json]:
        """The newest changes of owner, and owners that were there already, as ``zsched.history/1`` has them.

        The newest is the last.

        Where the log cannot be read, they are what the status remembers: without votes and durations.
        """
        if self._of_moves or self.status is None:
            return list(moves_of(self._of_moves, self._now, None))[-MOST_MOVES:]
        told = [move for task in self.status["tasks"] for move in _remembered(task, self.answered_at)]
        return sorted(told, key=lambda move: str(move["at"]))[-MOST_MOVES:]


def _remembered(task: Json, at: float) -> Iterator[Json]:
    """The moves of a task that its status tells of.

    The first that it tells is one only where it is the first placement: what was before is not told.
    """
    left: str | None = None
    for number, past in enumerate(task["history"]):
        if past["owner"] == left:
            continue  # another weight, the same owner
        yield {
            "at": wall_text(at - past["age_s"]),
            "age_s": past["age_s"],
            "task": task["name"],
            "epoch": past["epoch"],
            "revision": past["revision"],
            "from": left,
            "to": past["owner"],
            "is_known": number == 0 and (past["epoch"] % CREATION_STEP > 1 or past.get("is_known", False)),
            "reason": past["reason"],
            "votes": {},
            "switched_s": None,
        }
        left = past["owner"]
