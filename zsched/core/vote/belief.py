"""VOTE, belief: is a peer's word enough to learn a value, or to accept it?

Knows: nodes, electors, how far ahead a counter can honestly be. Does not know: who asked, what follows when the word is
not enough (`zsched.core.vote.agreement` asks a majority).

No message is authenticated here, and anybody on the network can say anything once. So an unasked word only leads to a
question, and an answer is believed only if it could be true.
"""

from __future__ import annotations

from zsched.core.register.register import MAX_REVISION
from zsched.core.register.task_register import TaskRegister
from zsched.core.values.electorate import FleetValue
from zsched.core.values.fleet import Fleet
from zsched.core.values.messages import Learnt
from zsched.core.values.model import Allocation, NodeId

GENERATION_STEP = 2**32
"""Revision and epoch of generation G start at G times this (`zsched fleet recover --generation G`)."""
MAX_GENERATION = MAX_REVISION // GENERATION_STEP - 1
"""The last one that leaves room to count: above `MAX_REVISION` nothing can follow (`Register`)."""
MAX_AHEAD = 2**20
"""No honest revision is further ahead: at one move a second that would be a cut of twelve days."""


def is_fit(fleet: Fleet, value: Allocation, register: TaskRegister, start: int = 0) -> bool:
    """Whether a value that is new here could be true: its owner is a node of the fleet, and it is not far ahead.

    The owner need not be a candidate. It may have been one by an earlier file, and a node that could not learn that
    value could not help to move the task away from it. Nor need it be a node any more where it has the task already, as
    far as is known here: no order that leaves the owner as it is could be agreed, nor what ends the pin that holds the
    task there. ``start`` is the first revision of the value's generation.
    """
    state = register.state
    accepted = None if state.accepted is None else state.accepted.value
    known = [one for one in (accepted, state.learnt) if one is not None]
    if value in known:
        return True
    newest = max([register.value.revision, start, *(one.revision for one in known)])
    names = {register.value.owner, *(one.owner for one in known), *(node.name for node in fleet.nodes)}
    is_known = value.owner is None or value.owner in names
    return is_known and value.epoch <= value.revision <= newest + MAX_AHEAD


def is_fleet_fit(known: FleetValue | None, value: FleetValue) -> bool:
    """Whether a fleet value could be true: neither of its counters is far ahead of the ``known`` one's, if one is.

    Behind one that is, every true value would be too old to be learnt, and nothing could be agreed any more.
    """
    if known is None:
        return True
    return value.revision <= known.revision + MAX_AHEAD and value.number <= known.number + MAX_AHEAD


def is_proven(
    fleet: Fleet,
    electors: tuple[NodeId, ...],
    learnt: Learnt,
    value: Allocation,
    register: TaskRegister,
    *,
    has_generation: bool,
) -> bool:
    """Whether a peer's answer to our own question is enough to learn a value.

    It is when the peer is an elector, or when this elector has accepted the same value (whoever committed it need not
    be an elector). A node without a state has no generation and takes that of the node that it asked.
    """
    accepted = register.state.accepted
    if accepted is not None and accepted.value == value:
        return True
    start = 0 if has_generation else learnt.generation * GENERATION_STEP
    return learnt.node in electors and is_fit(fleet, value, register, start)
