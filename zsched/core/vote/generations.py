"""VOTE, a node's blank state: objections to it, its values in a new generation, what is said of a lost one.

Knows: the content of the state before, the fleet's answers. Does not know: disks, how a node is asked.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from zsched.core.values.durable import DurableState
from zsched.core.values.electorate import SAID_DIGITS
from zsched.core.values.fleet import Fleet, electorate_hash
from zsched.core.values.model import NO_BALLOT, Acceptance, Allocation, NodeId, RegisterState
from zsched.core.values.snapshot import Snapshot
from zsched.core.vote.belief import GENERATION_STEP


def first_registers(fleet: Fleet, generation: int, before: Iterable[RegisterState]) -> tuple[RegisterState, ...]:
    """The registers of a blank state of ``generation``; none for generation 0.

    The values are accepted everywhere, too: a majority that had learnt a value without an acceptance would look like
    one that forgot. A task whose last owner, by the state ``before``, needed no lease does not start leased: that owner
    may still work.
    """
    if not generation:
        return ()
    unleased = {state.task for state in before if _is_unleased(state)}
    values = (task.first_value(generation * GENERATION_STEP, is_new=task.name not in unleased) for task in fleet.tasks)
    return tuple(
        RegisterState(
            task=value.task, creation=generation, accepted=Acceptance(ballot=NO_BALLOT, value=value), learnt=value
        )
        for value in values
    )


def _is_unleased(state: RegisterState) -> bool:
    values: list[Allocation] = [] if state.learnt is None else [state.learnt]
    values += [] if state.accepted is None else [state.accepted.value]
    newest = max(values, key=lambda value: value.revision, default=None)
    return newest is not None and not newest.leased and newest.revision > 0


def blank_state(
    fleet: Fleet,
    node: NodeId,
    generation: int,
    before: DurableState | None,
    *,
    incarnation: int,
    hardware: str,
    disk: str = "",
) -> DurableState:
    """The state that `zsched init` writes: this name has never voted, in ``generation``.

    The length of the leases that the state ``before`` granted is kept. Their holder may still work by one, under a file
    with another length.
    """
    return DurableState(
        fleet=fleet.name,
        node=node,
        incarnation=incarnation,
        generation=generation,
        hardware=hardware,
        disk=disk,
        electorate=electorate_hash(fleet),
        registers=first_registers(fleet, generation, () if before is None else before.registers),
        lease_s=0.0 if before is None else before.lease_s,
    )


def way_out(generation: int) -> str:
    """The operator's steps from any mix of states to a fleet of one generation that agrees."""
    return (
        f"stop every daemon, run `zsched fleet recover --generation {generation} --force` on every node, "
        "and start them when all have it"
    )


# --- what speaks against a blank state -------------------------------------------------------------------------------


def generation_of(answer: Snapshot) -> int:
    """The generation of a node, as its status says.

    While no document is agreed it follows from the revisions: generation G starts at G * 2^32.
    """
    if answer.quorum.number:
        return answer.quorum.generation
    return max((task.revision for task in answer.tasks), default=0) // GENERATION_STEP


def objection(
    node: NodeId,
    generation: int,
    good: DurableState | None,
    answers: Sequence[Snapshot],
    *,
    is_elector: bool,
    is_forced: bool,
) -> str | None:
    """Why ``node`` must not get a blank state of ``generation``, and the remedy; ``None``: no objection known.

    Args:
        node: whose state it would be.
        generation: 0, or a new one for a fleet that cannot agree any more.
        good: its valid state of an older generation, which would be lost.
        answers: the other nodes' answers.
        is_elector: whether ``node`` is one.
        is_forced: the operator insists that the fleet needs a new generation. No operator can overrule that a node has
            voted in this one, or that the fleet is ahead of it.
    """
    newest = max(map(generation_of, answers), default=0)
    current = [answer for answer in answers if generation_of(answer) == newest]
    knows = next((answer.node for answer in current if node in answer.quorum.voted), None)
    if any(answer.quorum.number and node not in answer.quorum.names for answer in current):
        knows = None  # its seat went with its disk, and a new disk is another member
    if newest >= generation and knows is not None:
        again = f"To make it an elector again, {way_out(newest + 1)}"
        if any(answer.quorum.number for answer in current):
            again = (
                "Where `zsched status` tells of several generations, `zsched fleet recover --rejoin GENERATION` makes "
                "it a new member of one. Where nothing can be agreed any more: zsched fleet recover, on another one"
            )
        return (
            f"{knows} knows {node} as an elector that has voted; a blank state would let it vote twice. Without a "
            f"state it works all the same and votes no more. {again}"
        )
    named = {one.quorum.generation_id: one for one in answers if one.quorum.number}
    if len(named) > 1 and not is_forced and not any(node in one.quorum.names for one in named.values()):
        told = "; ".join(f"{name[:SAID_DIGITS]}: {one.node}" for name, one in sorted(named.items()))
        return (
            f"the fleet lives in several generations ({told}), and {node} has a seat in none: "
            f"`zsched fleet recover --rejoin GENERATION` makes it a new member of one"
        )
    if newest > generation:
        return (
            f"{current[0].node} says that the fleet lives in generation {newest}; join it with "
            f"`zsched fleet recover --generation {newest}`"
        )
    if newest == generation:
        return None
    if is_forced:
        return None
    agreeing = next((answer for answer in current if answer.quorum.ok), None)
    if agreeing is not None:
        quorum = agreeing.quorum
        return (
            f"the fleet lives in generation {newest} and agrees ({agreeing.node}: {quorum.alive} of {quorum.electors} "
            f"electors can answer, {quorum.needed} needed); it needs no generation {generation}. "
            "To make one all the same, stop every daemon first, or add --force"
        )
    if good is None or not is_elector or any(_has_lost_too_many(answer) for answer in current):
        return None
    heard = "nobody who answered says" if answers else "no other node answered, so nobody says"
    return (
        f"{node} has a good state of generation {good.generation} here, and {heard} that the fleet needs a new "
        "generation. If `zsched status`, or `zsched init` on another node, has said so, stop every daemon and add "
        "--force"
    )


def _has_lost_too_many(answer: Snapshot) -> bool:
    quorum = answer.quorum
    return quorum.electors - len(quorum.stateless) < quorum.needed


def moved_text(why: str, joins: str) -> str:
    """Why a node that was told which generation to join is no elector."""
    return (
        f"{why} yet (generation {joins[:SAID_DIGITS]}): no elector until it is added as one, which "
        "`electorate: auto` does by itself"
    )


def lost_text(why: str, *, is_agreed: bool) -> str:
    """Why a node whose state is lost is no elector, and until when.

    ``is_agreed``: the fleet goes by an agreed document, in which another disk is another member.
    """
    until = "a new generation (`zsched fleet recover --help`); it works all the same, and the fleet agrees if it can"
    if is_agreed:
        until = "it is added as one anew, which `electorate: auto` does by itself once its old seat is given up"
    return (
        f"{why}: it was brought back from a backup, or its disk has lost what it said was written; no elector until "
        f"{until}"
    )
