"""What crosses, and how often it is done: the parcel of one sample, the numbers that a taker has had, circles.

Knows: keys and parameters of a crossing. Does not know: zenoh, gateways, roles.
"""

from __future__ import annotations

from collections import OrderedDict
from typing import Any, Final

from zsched.core.values.struct import Struct
from zsched.wire.keyspace import GIVEN_CHUNK, counter

TAKEN: Final = "taken"
"""The answer to a sample that was put, or that had been before."""
NOT_OWNER: Final = "not owner: nothing was done"
LASTING: Final = "never taken: "
"""In an answer to a sample that this taker's worker will not take later either. Takers of before do not say it."""
ANY_TAKER: Final = "*/*"
MAX_LIVES: Final = 64
"""Givers' lives whose numbers a taker remembers, the newest."""
_LIFE, _NUMBER = "life", "number"


class Parcel(Struct, frozen=True, kw_only=True):
    """One sample on its way to another cell."""

    name: str
    """Its key in the cell that it comes from, without what belongs to the giver: ``robot1/map``."""
    life: str
    """Of the giver: its numbers count from 1 in each life."""
    number: int
    payload: Any = b""
    attachment: Any = None
    encoding: str = ""

    def selector(self, taker: str, cell: str) -> str:
        """What a taker (``<node>/<task>``, or `ANY_TAKER`) is asked by the giver's ``cell``."""
        return f"{given_key(taker, cell, self.name)}?{_LIFE}={self.life};{_NUMBER}={self.number}"


def given_key(taker: str, cell: str, name: str) -> str:
    """The key under which a taker is given a sample.

    >>> given_key("edge1/from_hall_a", "hall-a", "robot1/map")
    'edge1/from_hall_a/@zsched/given/hall-a/robot1/map'
    """
    return f"{taker}/{GIVEN_CHUNK}/{cell}/{name}"


def parts_of(key: str) -> tuple[str, str]:
    """(taker, ``<cell>/<name>``) of such a key.

    >>> parts_of("edge1/from_hall_a/@zsched/given/hall-a/robot1/map")
    ('edge1/from_hall_a', 'hall-a/robot1/map')
    """
    taker, _, rest = key.partition(f"/{GIVEN_CHUNK}/")
    return taker, rest


def has_been_in(name: str, cell: str) -> bool:
    """Whether a stream has come from that cell, or through it: then it must not cross to it again.

    >>> has_been_in("robot1/hall-b/robot7/map", "hall-b"), has_been_in("robot1/map", "hall-b")
    (True, False)
    """
    return cell in name.split("/")


def is_lasting(why: str) -> bool:
    """Whether it says that nothing is gained by asking again."""
    return LASTING in why


class Had:
    """The numbers that a taker has had, by the givers' lives: a sample whose answer was lost comes again."""

    def __init__(self) -> None:
        self._newest: OrderedDict[str, int] = OrderedDict()

    def has(self, parameters: str) -> bool:
        """Whether what comes with these parameters has been put before; without a number nothing has."""
        life, number = _read(parameters)
        return 0 < number <= self._newest.get(life, 0)

    def note(self, parameters: str) -> None:
        """It has been put."""
        life, number = _read(parameters)
        self._newest[life] = number
        self._newest.move_to_end(life)
        if len(self._newest) > MAX_LIVES:
            self._newest.popitem(last=False)


def _read(parameters: str) -> tuple[str, int]:
    """(life, number); 0: none that counts."""
    given = dict(word.partition("=")[::2] for word in parameters.split(";"))
    return given.get(_LIFE, ""), counter(given.get(_NUMBER, "")) or 0
