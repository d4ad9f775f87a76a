"""Membership: makes every beat fit into a frame. Parts without room in one beat are in the next, one after another.

A beat that is too large would not be sent, and a healthy node would look dead. `zsched check` refuses fleet files whose
beats could be too large in the long run (`most_bytes`). A moment in which many tasks move may still exceed it.

Knows: how many bytes a beat's parts take at most. Does not know: the bytes themselves, what a part means.
"""

from __future__ import annotations

from zsched.core.values.beat import MAX_BEAT_BYTES, Beat, Grant
from zsched.core.values.fleet import Fleet
from zsched.core.values.struct import Struct, replace

FRAME_BYTES = 704
"""Room for the frame, the names of the fields and the fields with one value."""
_NUMBER = 9
_GRANT = 1 + sum(1 + len(name) for name in ("task", "owner", "incarnation", "epoch", "number")) + 3 * _NUMBER
_PARTS = ("learnt", "released", "asked_to_leave", "echoes")


def _text(text: str) -> int:
    return 2 + len(text)


def _part_bytes(part: object) -> int:
    if isinstance(part, Grant):
        return _GRANT + _text(part.task) + _text(part.owner)
    assert isinstance(part, tuple)
    return 1 + sum(_text(one) if isinstance(one, str) else _NUMBER for one in part)


def beat_bytes(beat: Beat) -> int:
    """How many bytes a beat's frame takes at most."""
    parts = sum(_part_bytes(part) for kind in _PARTS for part in getattr(beat, kind))
    return FRAME_BYTES + parts + _names_bytes(beat)


def _names_bytes(beat: Beat) -> int:
    return sum(_text(name) for names in (beat.suspects, beat.twins, beat.gone, beat.away) for name in names)


def most_bytes(fleet: Fleet) -> int:
    """How many bytes a beat of this fleet takes at most in the long run.

    The worst case: all tasks are learnt, an elector echoes every exclusive one and has released all itself, and every
    peer is suspect (or some names live twice), gone as an elector and away as a robot.
    """
    longest = max((len(node.name) for node in fleet.nodes), default=0)
    learnt = sum(1 + _text(task.name) + 2 * _NUMBER for task in fleet.tasks)
    grants = sum(2 * (_GRANT + _text(task.name) + 2 + longest) for task in fleet.tasks if task.exclusive)
    return FRAME_BYTES + learnt + grants + 3 * sum(_text(node.name) for node in fleet.nodes)


class BeatRoom(Struct):
    """Makes one node's beats fit, and remembers which parts come next."""

    _next: int = 0

    def fit(self, beat: Beat) -> tuple[Beat, int]:
        """The beat as it is sent, and how many of its parts wait for the next ones.

        Names of nodes are always in it: a node that is missing among the suspects counts as heard.
        """
        if beat_bytes(beat) <= MAX_BEAT_BYTES:
            return beat, 0
        parts = [(kind, part) for kind in _PARTS for part in getattr(beat, kind)]
        room = MAX_BEAT_BYTES - FRAME_BYTES - _names_bytes(beat)
        first = self._next % len(parts)
        chosen: list[tuple[str, object]] = []
        for kind, part in (*parts[first:], *parts[:first]):
            room -= _part_bytes(part)
            if room >= 0:  # it only shrinks: nothing is chosen behind the first part that has no room
                chosen.append((kind, part))
        self._next = first + len(chosen)
        held = {kind: tuple(part for of, part in chosen if of == kind) for kind in _PARTS}
        return replace(beat, **held), len(parts) - len(chosen)  # type: ignore[arg-type]
