"""Registers, and the messages between them, for one situation at a time. Knows: `zsched.core.vote.register`."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from random import Random

from support.fleets import tuning_of
from zsched.core.values.messages import Accept, Prepare
from zsched.core.values.model import Acceptance, Allocation, Ballot, RegisterState
from zsched.core.vote.register import MoveOwner, Register, Step

ELECTORS = ("r1", "r2", "r3")
TUNING = tuning_of()
INITIAL = Allocation(task="merge", revision=0, epoch=0, owner=None, tuning=TUNING)
BLANK = RegisterState(task="merge")
FIRST = MoveOwner(base_revision=0, owner="e1", reason="test")
BALLOT_S, STAGGER_S = 0.3, 0.03


def make(
    me: str = "r1",
    *,
    state: RegisterState = BLANK,
    incarnation: int = 1,
    electorate: str = "abc",
    is_elector: bool | None = None,
    electors: tuple[str, ...] = ELECTORS,
    kind: type[Register] = Register,
) -> Register:
    """A register of one node."""
    return kind(
        me=me,
        incarnation=incarnation,
        electors=electors,
        electorate=electorate,
        is_elector=me in electors if is_elector is None else is_elector,
        initial=INITIAL,
        state=state,
        ballot_s=BALLOT_S,
        stagger_s=STAGGER_S,
        rng=Random(1),
    )


def allocation(revision: int, owner: str = "e1") -> Allocation:
    """The value of a revision, its epoch the same number."""
    return replace(INITIAL, revision=revision, epoch=revision, owner=owner)


def ballot(counter: int, node: str = "r9") -> Ballot:
    """A stranger's ballot."""
    return Ballot(counter=counter, node=node, incarnation=1)


def prepare(counter: int, node: str = "r9", electorate: str = "abc") -> Prepare:
    """A stranger's prepare."""
    return Prepare(task="merge", ballot=ballot(counter, node), electorate=electorate)


def accept(counter: int, value: Allocation, node: str = "r9", electorate: str = "abc") -> Accept:
    """A stranger's accept."""
    return Accept(task="merge", acceptance=Acceptance(ballot=ballot(counter, node), value=value), electorate=electorate)


def promise_all(proposer: Register, asked: Step, acceptors: Iterable[Register], now: float = 0.0) -> Step:
    """Hand a prepare to acceptors and their answers back; the last step that wants something."""
    assert asked.prepare is not None
    return last(proposer.on_answer(acceptor.on_prepare(asked.prepare)[1], now) for acceptor in acceptors)


def accept_all(proposer: Register, asked: Step, acceptors: Iterable[Register], now: float = 0.0) -> Step:
    """Hand an accept to acceptors and their answers back; the last step that wants something."""
    assert asked.accept is not None
    return last(proposer.on_answer(acceptor.on_accept(asked.accept, now)[1], now) for acceptor in acceptors)


def last(steps: Iterable[Step]) -> Step:
    """The last step that is not empty (every one is taken, as the daemon would)."""
    wanted = [step for step in steps if step != Step()]
    return wanted[-1] if wanted else Step()


def commit(proposer: Register, asked: Step, acceptors: list[Register], now: float = 0.0) -> Step:
    """Both rounds; the last step."""
    return accept_all(proposer, promise_all(proposer, asked, acceptors, now), acceptors, now)
