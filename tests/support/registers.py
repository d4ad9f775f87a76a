"""Registers, and the messages between them, for one situation at a time. Knows: `zsched.core.register.register`."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from random import Random
from typing import Any

from support.allocations import allocation_of
from support.ballots import ballot_of
from support.fleets import tuning_of
from zsched.core.register.task_register import TaskRegister
from zsched.core.values.change import Change, MoveOwner, RoundOutcome
from zsched.core.values.fleet import Timing
from zsched.core.values.instructions import SendAccept, SendPrepare
from zsched.core.values.messages import Accept, Accepted, Prepare, Promise, Refused
from zsched.core.values.model import Acceptance, Allocation, Ballot, RegisterState
from zsched.core.values.todo import ToDo

ELECTORS = ("r1", "r2", "r3")
TUNING = tuning_of()
INITIAL = allocation_of(0, None)
BLANK = RegisterState(task="merge")
FIRST = MoveOwner(base_revision=0, owner="e1", reason="test")
BALLOT_S, STAGGER_S = 0.3, 0.03
CLOCKS = Timing(ballot_s=BALLOT_S, stagger_s=STAGGER_S)


def make(
    me: str = "r1",
    *,
    state: RegisterState = BLANK,
    incarnation: int = 1,
    electorate: str = "abc",
    is_elector: bool | None = None,
    electors: tuple[str, ...] = ELECTORS,
    kind: type[TaskRegister] = TaskRegister,
    clocks: Timing = CLOCKS,
) -> TaskRegister:
    """A register of one node."""
    return kind(
        me=me,
        incarnation=incarnation,
        electors=electors,
        electorate=electorate,
        is_elector=me in electors if is_elector is None else is_elector,
        initial=INITIAL,
        state=state,
        clocks=lambda: clocks,
        rng=Random(1),
    )


def allocation(revision: int, owner: str = "e1") -> Allocation:
    """The value of a revision, its epoch the same number."""
    return allocation_of(revision, owner)


def ballot(counter: int, node: str = "r9") -> Ballot:
    """A stranger's ballot."""
    return ballot_of(counter, node)


def prepare(counter: int, node: str = "r9", electorate: str = "abc") -> Prepare:
    """A stranger's prepare."""
    return Prepare(task="merge", ballot=ballot(counter, node), electorate=electorate)


def accept(counter: int, value: Allocation, node: str = "r9", electorate: str = "abc") -> Accept:
    """A stranger's accept."""
    return Accept(task="merge", acceptance=Acceptance(ballot=ballot(counter, node), value=value), electorate=electorate)


@dataclass(frozen=True, slots=True, kw_only=True)
class Step:
    """What one call into a register has left to do."""

    is_dirty: bool = False
    prepare: Prepare | None = None
    accept: Accept | None = None
    learnt: Allocation | None = None
    reason: str | None = ""
    """Why what was learnt is what it is."""
    ends: tuple[tuple[Change, RoundOutcome], ...] = ()
    problem: str = ""

    @property
    def finished(self) -> tuple[Change, RoundOutcome] | None:
        """The first change that has ended."""
        return self.ends[0] if self.ends else None


def _step(register: TaskRegister, problem: str, todo: ToDo) -> Step:
    prepares = [one.prepare for one in todo.send if isinstance(one, SendPrepare)]
    accepts = [one.accept for one in todo.send if isinstance(one, SendAccept)]
    assert len(todo.send) == len(prepares) + len(accepts) <= 1, "a register has one round at a time"
    assert len(todo.learnt) <= 1
    learnt, reason = todo.learnt[0] if todo.learnt else (None, "")
    return Step(
        is_dirty=todo.must_persist,
        prepare=prepares[0] if prepares else None,
        accept=accepts[0] if accepts else None,
        learnt=learnt,
        reason=reason,
        ends=tuple((one.change, one.outcome) for one in todo.ended),
        problem=register.problem if register.problem != problem else "",
    )


def did(call: Callable[..., None], *args: Any) -> Step:
    """One call of a register's method whose last argument is the time."""
    register: TaskRegister = call.__self__  # type: ignore[attr-defined] # a bound method
    todo, problem = ToDo(), register.problem
    call(*args[:-1], todo, args[-1])
    return _step(register, problem, todo)


def promised(register: TaskRegister, prepare: Prepare) -> tuple[Step, Promise | Refused]:
    """What an elector makes of a prepare, and its answer."""
    todo = ToDo()
    answer = register.on_prepare(prepare, todo)
    return _step(register, register.problem, todo), answer


def accepted(register: TaskRegister, accept: Accept, now: float) -> tuple[Step, Accepted | Refused]:
    """What an elector makes of an accept, and its answer."""
    todo = ToDo()
    answer = register.on_accept(accept, todo, now)
    return _step(register, register.problem, todo), answer


def promise_all(proposer: TaskRegister, asked: Step, acceptors: Iterable[TaskRegister], now: float = 0.0) -> Step:
    """Hand a prepare to acceptors and their answers back; the last step that wants something."""
    assert asked.prepare is not None
    return last(did(proposer.on_answer, promised(acceptor, asked.prepare)[1], now) for acceptor in acceptors)


def accept_all(proposer: TaskRegister, asked: Step, acceptors: Iterable[TaskRegister], now: float = 0.0) -> Step:
    """Hand an accept to acceptors and their answers back; the last step that wants something."""
    assert asked.accept is not None
    return last(did(proposer.on_answer, accepted(acceptor, asked.accept, now)[1], now) for acceptor in acceptors)


def last(steps: Iterable[Step]) -> Step:
    """The last step that is not empty (every one is taken, as the daemon would)."""
    wanted = [one for one in steps if one != Step()]
    return wanted[-1] if wanted else Step()


def commit(proposer: TaskRegister, asked: Step, acceptors: list[TaskRegister], now: float = 0.0) -> Step:
    """Both rounds; the last step."""
    return accept_all(proposer, promise_all(proposer, asked, acceptors, now), acceptors, now)
