"""VOTE, on its way: the questions of several registers to the same electors go in one frame.

Ten tasks that are read anew under a new number of the fleet (`zsched.core.electorate.settling`) would be ten questions
to each elector, ten writes there and ten answers, twice.

Knows: which instructions may travel together. Does not know: why a register asks (`zsched.core.vote.register`), what an
elector answers (`zsched.core.vote.agreement`).
"""

from __future__ import annotations

from collections.abc import Sequence

from zsched.core.instructions import Instruction, SendAccept, SendBallots, SendPrepare
from zsched.core.values.messages import MOST_BALLOTS, Ballots


def joined(send: list[Instruction]) -> list[Instruction]:
    """What is sent, the questions that may join in one frame; they stand where the first of them stood."""
    may = [one for one in send if isinstance(one, SendPrepare | SendAccept) and one.may_join]
    if len(may) < 2:
        return send
    first, taken = send.index(may[0]), {id(one) for one in may}
    rest = [one for one in send if id(one) not in taken]
    parts = [may[start : start + MOST_BALLOTS] for start in range(0, len(may), MOST_BALLOTS)]
    together = [_one_frame(part) for part in parts]
    return [*rest[:first], *together, *rest[first:]]


def _one_frame(asked: Sequence[SendPrepare | SendAccept]) -> SendPrepare | SendAccept | SendBallots:
    if len(asked) == 1:
        return asked[0]
    return SendBallots(
        ballots=Ballots(
            prepares=tuple(one.prepare for one in asked if isinstance(one, SendPrepare)),
            accepts=tuple(one.accept for one in asked if isinstance(one, SendAccept)),
        ),
        deadline_s=min(one.deadline_s for one in asked),
    )
