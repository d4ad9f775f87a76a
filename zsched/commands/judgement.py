"""A judgement in its written form, reckoned with again on this side: its sums, what a robot sees, without a node.

Knows: the written form (`zsched.core.values.decision.Decision`), which word of it an operator has got wrong. Does not
know: where it comes from, text. It loads the scheduler, so a verb imports it only when it reckons (`explain` alone is
told the sums).
"""

from __future__ import annotations

from zsched.commands.common import CliError, Json, nearest
from zsched.core.report import plain
from zsched.core.scheduler.explain import explained, judged_again, seen_by, without
from zsched.core.values.decision import Decision
from zsched.errors import WireError
from zsched.exits import EXIT_FAILED, EXIT_USAGE
from zsched.wire.codec import from_plain


def read(written: Json) -> Decision:
    """The judgement.

    Raises:
        CliError: another version has written it, or it is damaged.
    """
    try:
        return from_plain(written, Decision)
    except WireError as error:
        text = f"the judgement cannot be read ({error}); update the older of the two, zsched here or the daemon"
        raise CliError(EXIT_FAILED, text) from error


def sums(written: Json) -> Json:
    """Its sums, as ``zsched.explain/1`` has them."""
    told: Json = plain(explained(read(written)))
    return told


def sight(written: Json, robot: str, judge: str) -> Json:
    """What the robot sees, as ``zsched.explain/1`` has it.

    Raises:
        CliError: it is no robot of the fleet.
    """
    decision = read(written)
    robots = decision.figures.voters
    if robot not in robots:
        raise CliError(EXIT_USAGE, f"--robot: the fleet has no robot {robot!r}{nearest(robot, robots)}")
    told: Json = plain(seen_by(decision, robot, judge))
    return told


def planned(written: Json, gone: str) -> Json:
    """The judgement without a node, and whether the task would move.

    Raises:
        CliError: the node is no candidate, robot or elector.
    """
    decision = read(written)
    figures = decision.figures
    known = sorted({*figures.rules.candidates, *figures.voters, *figures.electors})
    if gone not in known:
        raise CliError(EXIT_USAGE, f"--plan: {gone!r} is no candidate, robot or elector{nearest(gone, known)}")
    again = judged_again(decision, without(figures, gone))
    told: Json = plain(explained(again))
    moves = again.verdict.outcome == "propose" and again.verdict.candidate != figures.allocation.owner
    return {"without": gone, "would_move": moves, **told}
