"""VOTE, what is believed: whether a peer's word is enough for a value to be learnt, or to be accepted.

Knows: nodes, electors, how far a counter can honestly be ahead. Does not know: who asked what, what follows when
it is not enough (`zsched.core.vote.agreement` asks a majority).

Nobody is authenticated here. Whoever can put a frame on the network can say anything once; so what is said unasked only
leads to a question, and an answer is believed only where it could be true.
"""

from __future__ import annotations

from zsched.core.values.fleet import Fleet
from zsched.core.values.messages import Learnt
from zsched.core.values.model import Allocation
from zsched.core.vote.register import MAX_REVISION, Register

GENERATION_STEP = 2**32
"""Revision and epoch of generation G start at G times this (`zsched init --generation G`)."""
MAX_GENERATION = MAX_REVISION // GENERATION_STEP - 1
"""The last one that leaves room to count: above `MAX_REVISION` nothing can follow (`Register`)."""
MAX_AHEAD = 2**20
"""No honest revision is so far ahead of what a node knows: at one move a second that is a cut of twelve days."""


def is_fit(fleet: Fleet, value: Allocation, register: Register, start: int = 0) -> bool:
    """Whether a value that is new here could be one: its owner is a node of the fleet, and it is not far ahead.

    The owner need not be a candidate: it may have been one by the file of before, and a node that could not learn that
    could not take part in moving the task away from it. ``start`` is the first revision of the value's generation.
    """
    state = register.state
    accepted = None if state.accepted is None else state.accepted.value
    known = [one for one in (accepted, state.learnt) if one is not None]
    if value in known:
        return True
    newest = max([register.value.revision, start, *(one.revision for one in known)])
    is_known = value.owner is None or any(node.name == value.owner for node in fleet.nodes)
    return is_known and value.epoch <= value.revision <= newest + MAX_AHEAD


def is_proven(fleet: Fleet, learnt: Learnt, value: Allocation, register: Register, *, has_generation: bool) -> bool:
    """Whether a peer's answer to our own question is enough for a value to be learnt.

    It is an elector's, or of what this elector has accepted itself (whoever committed it may be no elector). A node
    without a state has no generation: it goes by that of whom it asked.
    """
    accepted = register.state.accepted
    if accepted is not None and accepted.value == value:
        return True
    start = 0 if has_generation else learnt.generation * GENERATION_STEP
    return learnt.node in fleet.electors and is_fit(fleet, value, register, start)
