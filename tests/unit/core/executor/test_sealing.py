"""Since when a task is exclusive for everybody: whom its owner waits for, whom it asks and how often, what it says."""

from __future__ import annotations

from dataclasses import replace

import pytest

from support.allocations import allocation_of
from support.beats import beat_of
from support.fleets import fleet_of, task_of, tuning_of
from support.todos import done
from zsched.core.executor.handover import Executor
from zsched.core.executor.sealing import ASK_EVERY_S, Sealing
from zsched.core.values.beat import Beat
from zsched.core.values.change import SetLeased
from zsched.core.values.fleet import Fleet, TaskSpec, WorkerSpec, fleet_hash, lease_terms
from zsched.core.values.in_force import InForce
from zsched.core.values.messages import Learnt
from zsched.core.values.model import Allocation
from zsched.core.values.todo import ToDo

NAMES = ("e1", "e2", "e3")
TUNING = tuning_of(cpu=1.0, memory=0.0)
OPEN = task_of("guard", NAMES[:2], tuning=TUNING, worker=WorkerSpec(command=("true",)))
EXCLUSIVE = replace(OPEN, exclusive=True)
YOUNG_S = 5.0


def fleet(*tasks: TaskSpec) -> Fleet:
    return fleet_of(*tasks, of=NAMES, electors=NAMES)


NEW, OLD = fleet(EXCLUSIVE), fleet(OPEN)


def sealing(of: Fleet = NEW, me: str = "e1") -> Sealing:
    executors = {task.name: Executor(spec=task, me=me, has_streams=False) for task in of.tasks}
    return Sealing(in_force=InForce(of), me=me, executors=executors, over_at=YOUNG_S, terms=lambda: lease_terms(of))


def value(task: str = "guard", *, leased: bool = False, owner: str | None = "e1", epoch: int = 3) -> Allocation:
    return allocation_of(7, owner, task=task, epoch=epoch, tuning=TUNING, leased=leased)


def values(*known: Allocation) -> dict[str, Allocation]:
    return {one.task: one for one in known or (value(),)}


def beat(node: str, of: Fleet = NEW) -> Beat:
    return beat_of(node, fleet_file=fleet_hash(of))


def answer(
    node: str = "e2", *, epoch: int = 3, terms: str | None = None, unleased: tuple[str, ...] = (), other: int = 9
) -> Learnt:
    """An answer about the task, and about another one in another epoch."""
    said = lease_terms(NEW) if terms is None else terms
    known = (value("other", epoch=other, owner="e3"), value(epoch=epoch))
    return Learnt(node=node, values=known, lease_terms=said, unleased=unleased)


def asked(of: Fleet = NEW) -> Sealing:
    one = sealing(of)
    assert one.to_ask(values(), 10.0) == ("e2",)
    return one


CHANGE = [("guard", SetLeased(base_revision=7, leased=True))]


def test_an_owner_proposes_once_every_candidate_has_answered_that_nobody_works_without_a_lease() -> None:
    one = asked()
    assert one.due(values(), 10.0) == []
    one.on_answer(answer())
    assert one.due(values(), 10.0) == CHANGE


@pytest.mark.parametrize(
    ("said", "why"),
    [
        (answer(unleased=("guard",)), "e2 works without a lease"),
        (answer(terms="others"), "e2 goes by other leases"),
        (answer(epoch=2), "e2 has not learnt epoch 3"),
        (Learnt(node="e2", values=(), lease_terms=lease_terms(NEW)), "e2 has not learnt epoch 3"),
        (None, "e2 has not answered yet"),
    ],
)
def test_whoever_may_work_without_a_lease_is_waited_for_and_named(said: Learnt | None, why: str) -> None:
    one = asked()
    if said is not None:
        one.on_answer(said)
    assert one.due(values(), 10.0) == []
    text = "exclusive by this node's fleet file, not yet for the fleet: nobody works until all candidates go by it"
    assert one.problem(EXCLUSIVE, value(), 10.0) == f"{text} ({why})"
    assert one.to_ask(values(), 11.0) == ("e2",)


def test_an_owner_waits_for_its_own_worker_too_which_nobody_else_knows_to_work_without_a_lease() -> None:
    executor = Executor(spec=OPEN, me="e1", has_streams=False)
    done(executor.execute, value(), 0.0)
    one = Sealing(
        in_force=InForce(NEW), me="e1", executors={"guard": executor}, over_at=YOUNG_S, terms=lambda: lease_terms(NEW)
    )
    executor.on_spec(EXCLUSIVE, ToDo(), 10.0, is_agreed_leased=False)
    assert one.to_ask(values(), 10.0) == ("e2",), "nobody asks itself"
    one.on_answer(answer())
    assert one.due(values(), 10.0) == []
    assert one.problem(EXCLUSIVE, value(), 10.0).endswith("(e1 has not said that its worker has stopped)")
    done(executor.on_role_ended, 3)
    assert one.due(values(), 10.0) == CHANGE


def test_who_has_learnt_nothing_of_the_task_is_waited_for_from_its_first_epoch_on() -> None:
    one = asked()
    one.on_answer(Learnt(node="e2", values=(), lease_terms=lease_terms(NEW)))
    assert one.due(values(value(epoch=1)), 10.0) == []


def test_a_later_answer_replaces_the_one_before_and_a_later_epoch_is_as_good() -> None:
    one = asked()
    one.on_answer(answer(unleased=("other",), epoch=4))
    assert one.due(values(), 10.0) == CHANGE, "another task's worker is none of this one's"
    one.on_answer(answer(unleased=("guard",)))
    assert one.due(values(), 10.0) == []


def test_who_is_heard_is_waited_for_too_though_it_is_no_candidate() -> None:
    one = asked()
    one.on_answer(answer())
    one.hear(beat("e3"))
    one.hear(beat("e1"))  # our own
    assert one.due(values(), 10.0) == []
    assert one.problem(EXCLUSIVE, value(), 10.0).endswith("(e3 has not answered yet)")
    assert one.to_ask(values(), 11.0) == ("e3",)


def test_who_is_gone_is_waited_for_only_if_it_is_a_candidate_or_has_owned_the_task() -> None:
    """A machine that is switched off stopped the task until it was back, though it had never worked on it."""
    one = asked()
    one.on_answer(answer())
    one.hear(beat("e3"))
    one.on_gone("e3")
    assert one.due(values(), 10.0) == CHANGE
    one.note(value("other", owner="e3"))
    assert one.due(values(), 10.0) == CHANGE, "that is another task"
    one.note(value(owner="e3", epoch=2))
    assert one.due(values(), 10.0) == []
    assert one.problem(EXCLUSIVE, value(), 10.0).endswith("(e3 has not answered yet)")
    one.on_answer(answer("e3"))
    assert one.due(values(), 10.0) == CHANGE

    one = asked()
    one.on_gone("e2")
    assert one.due(values(), 10.0) == [], "a candidate, whether it was heard or not"


def test_who_is_heard_again_is_waited_for_again() -> None:
    one = asked()
    one.on_answer(answer())
    one.hear(beat("e3"))
    one.on_gone("e3")
    one.hear(beat("e3"))
    assert one.to_ask(values(), 11.0) == ("e3",)


def test_an_answer_to_another_question_of_this_node_is_not_remembered() -> None:
    one = sealing()
    one.on_answer(answer())
    assert one.due(values(), 10.0) == []


def test_questions_are_asked_five_times_a_second_and_only_while_something_is_open() -> None:
    one = sealing()
    assert one.to_ask(values(value(leased=True)), 0.0) == ()
    assert one.to_ask(values(), 0.0) == ("e2",)
    assert one.to_ask(values(), 0.19) == ()
    assert one.to_ask(values(), ASK_EVERY_S) == ("e2",)
    assert ASK_EVERY_S == 0.2
    one.on_answer(answer())
    assert one.to_ask(values(), 2.0) == ()


@pytest.mark.parametrize(
    ("of", "known"),
    [
        (NEW, value(owner="e2")),
        (NEW, value(owner=None)),
        (NEW, value(leased=True)),
        (OLD, value()),
        (OLD, value(owner="e2", leased=True)),
    ],
)
def test_nothing_is_proposed_or_asked_where_the_file_and_the_fleet_agree_or_another_one_owns_it(
    of: Fleet, known: Allocation
) -> None:
    one = sealing(of)
    one.on_answer(answer())
    assert one.due(values(known), 10.0) == []
    assert one.to_ask(values(known), 10.0) == ()


OPENED = [("guard", SetLeased(base_revision=7, leased=False))]


def test_a_task_is_everybody_s_again_when_all_files_are_the_same_and_the_life_before_has_no_lease() -> None:
    one = sealing(OLD)
    known = values(value(leased=True))
    assert one.due(known, YOUNG_S - 0.001) == []
    assert one.due(known, YOUNG_S) == OPENED
    assert one.to_ask(known, YOUNG_S) == (), "there is nobody to wait for"
    one.hear(beat("e2", OLD))
    one.hear(beat("e3", NEW))
    assert one.due(known, YOUNG_S) == []
    one.hear(beat("e3", OLD))
    assert one.due(known, YOUNG_S) == OPENED
    one.hear(beat("e3", NEW))
    assert one.due(known, YOUNG_S) == []
    one.on_gone("e3")
    assert one.due(known, YOUNG_S) == OPENED, "it is not heard any more"


def test_a_young_owner_may_make_its_task_exclusive() -> None:
    one = sealing()
    one.to_ask(values(), 0.0)
    one.on_answer(answer())
    assert one.due(values(), YOUNG_S - 1.0) == CHANGE


def test_the_tasks_whose_worker_may_work_without_a_lease_are_told() -> None:
    one = sealing(fleet(OPEN, replace(EXCLUSIVE, name="other")))
    assert one.unleased(0.0) == ()
    for executor in one.executors.values():
        done(executor.execute, value(executor.spec.name, leased=executor.spec.exclusive), 0.0)
    assert one.unleased(0.0) == ("guard",)


@pytest.mark.parametrize(
    ("of", "known", "text"),
    [
        (NEW, value(owner=None), ""),
        (NEW, value(leased=True), ""),
        (OLD, value(), ""),
        (OLD, value(leased=True), "exclusive for the fleet, though not by this node's fleet file"),
        (NEW, value(owner="e2"), "e2 waits, or works without a lease (see its status)"),
    ],
)
def test_status_says_how_the_file_and_the_fleet_differ(of: Fleet, known: Allocation, text: str) -> None:
    said = sealing(of).problem(of.tasks[0], known, 10.0)
    assert said == text or (text and said.endswith(text))


def test_status_of_an_owner_that_waits_for_nobody_says_that_it_is_being_agreed() -> None:
    one = asked()
    one.on_answer(answer())
    assert one.problem(EXCLUSIVE, value(), 10.0).endswith("(agreeing)")
