"""VOTE, on its way: the questions of several registers to the same electors go in one frame.

Ten tasks that are read anew under a new number of the fleet (`zsched.core.electorate.settling`) would be ten questions
to each elector, ten writes there and ten answers, twice. With them goes what an elector needs to answer them at once:
the fleet value that brought the number, and the first question of the change that will say that all is settled.

Knows: which instructions may travel together. Does not know: why a register asks (`zsched.core.register.register`),
what an elector answers (`zsched.core.vote.acceptor`).
"""

from __future__ import annotations

from collections.abc import Sequence

from zsched.core.values.electorate import FleetValue
from zsched.core.values.instructions import AskElectors, Instruction, SendAccept, SendBallots, SendPrepare
from zsched.core.values.messages import MOST_BALLOTS, Ballots, Prepare


def joined(send: list[Instruction], unsettled: FleetValue | None = None) -> list[Instruction]:
    """What is sent, the questions that may join in one frame; they stand where the first of them stood.

    ``unsettled``: the learnt fleet value, while its electors are not settled. It goes along with first questions, and
    before any other word of it: an elector then writes once what it learns and what it promises.
    """
    may = [one for one in send if isinstance(one, SendPrepare | SendAccept) and one.may_join]
    ahead = [one for one in send if isinstance(one, AskElectors) and one.may_join]
    told = unsettled if ahead or any(isinstance(one, SendPrepare) for one in may) else None
    if len(may) + len(ahead) < 2 and told is None:
        return send
    taken = {id(one) for one in (*may, *ahead)}
    first = 0 if told else next(index for index, one in enumerate(send) if id(one) in taken)
    rest = [one for one in send if id(one) not in taken]
    parts = [may[start : start + MOST_BALLOTS] for start in range(0, len(may), MOST_BALLOTS)] or [[]]
    frames: list[Instruction] = [_one_frame(parts[0], ahead, told), *(_one_frame(part, []) for part in parts[1:])]
    return [*rest[:first], *frames, *rest[first:]]


def _one_frame(
    asked: Sequence[SendPrepare | SendAccept], ahead: Sequence[AskElectors], told: FleetValue | None = None
) -> SendPrepare | SendAccept | SendBallots:
    if len(asked) == 1 and not ahead and told is None:
        return asked[0]
    first = next((one.question for one in ahead if isinstance(one.question, Prepare)), None)
    return SendBallots(
        ballots=Ballots(
            prepares=tuple(one.prepare for one in asked if isinstance(one, SendPrepare)),
            accepts=tuple(one.accept for one in asked if isinstance(one, SendAccept)),
            ahead=first,
            fleet=told,
        ),
        deadline_s=min(one.deadline_s for one in (*asked, *ahead)),
    )
