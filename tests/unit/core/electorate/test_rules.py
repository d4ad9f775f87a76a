"""One situation for each rule of electors that change: red when the rule is left out (`zsched_lab.bugs.elector_bugs`).

The machines are rolls and registers of the core with their disks (`zsched_lab.sim.electors`); whatever is chosen twice,
forgotten, or learnt without having been chosen ends a test by itself (`zsched_lab.sim.chosen`).
"""

from __future__ import annotations

from dataclasses import replace

import pytest

from support.fleet_values import fleet_value_of
from zsched.core.electorate.changes import AddElector, FleetChange, RemoveElector, SetDocument, SetLease, Settle
from zsched.core.electorate.founding import founded, recovered
from zsched.core.values.change import RoundOutcome
from zsched.core.values.electorate import Creation, Elector, FleetValue
from zsched.core.values.lease import hold_s
from zsched.core.values.messages import Prepare, Promise, Refusal, Refused
from zsched.core.values.model import Allocation
from zsched.core.values.todo import ToDo
from zsched_lab.sim.chosen import ChosenError
from zsched_lab.sim.electors import Ask, AskRoll, Machine, Machines, Message, Say, SayRoll

AT_ONCE_S = 0.01
"""Long enough for messages, too short for another elector to begin to settle; who proposes the change stays still."""


def value_of(machine: Machine) -> FleetValue:
    assert machine.roll is not None
    return machine.roll.value


def add(world: Machines, by: str, name: str, *, for_s: float = 3.0, among: str = "") -> None:
    """Add an elector and let it be settled."""
    machine, disk = world.machine(by), world.machine(name).disk.id
    assert world.change(machine, AddElector(base_revision=value_of(machine).revision, name=name, disk=disk)) == ""
    world.run(*among, for_s=for_s, still=(by,) if for_s == AT_ONCE_S else ())


def remove(world: Machines, by: str, name: str, *, for_s: float = 3.0, among: str = "") -> None:
    """Remove an elector and let that be settled."""
    machine = world.machine(by)
    assert world.change(machine, RemoveElector(base_revision=value_of(machine).revision, name=name)) == ""
    world.run(*among, for_s=for_s, still=(by,) if for_s == AT_ONCE_S else ())


def moved(world: Machines, by: str, among: str, task: str = "t1") -> bool:
    """Whether a move that this machine proposes is committed with these machines."""
    machine = world.machine(by)
    owner = world.move(machine, task)
    world.run(*among)
    register = machine.registers.get(task)
    return register is not None and register.value.owner == owner


def pick(world: Machines, to: str, kind: type, sender: str = "") -> list[Message]:
    """Messages under way to a machine, of a kind of body."""
    return [one for one in world.pool if one.to == to and isinstance(one.body, kind) and sender in ("", one.sender)]


def give(world: Machines, messages: list[Message]) -> None:
    """Deliver these, and no others."""
    for message in messages:
        world.pool.remove(message)
        world.give(message)


# --- one at a time, on a settled value -------------------------------------------------------------------------------

VALUE = fleet_value_of(
    7,
    *(Elector(name=name, disk="0", joining=1) for name in "abc"),
    number=3,
    fleet="f",
    generation_id="ab",
    lease_s=2.0,
    guard_lease_s=2.0,
    creations=2,
    tasks=(Creation(task="t1", number=1), Creation(task="t2", number=2, exclusive=True)),
    document="d",
)
CHANGES: tuple[FleetChange, ...] = (
    AddElector(base_revision=7, name="d", disk="4"),
    RemoveElector(base_revision=7, name="b"),
    SetLease(base_revision=7, lease_s=0.5),
    SetDocument(base_revision=7, document="e", tasks=(("t1", False), ("t3", False))),
)


@pytest.mark.parametrize("change", CHANGES)
def test_two_sides_swap_at_once_is_no_change_there_is(change: FleetChange) -> None:
    after = change.apply(VALUE)
    assert after.revision == VALUE.revision + 1
    assert len(set(after.electors) ^ set(VALUE.electors)) == (1 if change in CHANGES[:2] else 0)
    assert (after.number, after.settled) == ((4, False) if change in CHANGES[:3] else (3, True))


RELET = SetDocument(base_revision=7, document="e", tasks=(("t1", False),), lease_s=0.5)


def test_a_document_with_another_length_of_leases_raises_the_number() -> None:
    after = RELET.apply(VALUE)
    assert (after.revision, after.number, after.settled, after.document) == (8, 4, False, "e")
    assert (after.lease_s, after.guard_lease_s) == (0.5, 2.0), "longer ones may run"


@pytest.mark.parametrize("change", [*CHANGES[:3], RELET])
def test_a_change_that_raises_the_number_waits_until_the_one_before_is_settled(change: FleetChange) -> None:
    unsettled = replace(VALUE, settled=False)
    assert change.fault(unsettled) == "number 3 is not settled: a majority of its electors must answer first"
    assert change.apply(unsettled) == unsettled


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (AddElector(base_revision=7, name="a", disk="9"), "a is an elector"),
        (RemoveElector(base_revision=7, name="d"), "d is no elector"),
        (Settle(base_revision=7, number=3), "another number, or settled already"),
    ],
)
def test_a_change_of_what_is_so_already_changes_nothing(change: FleetChange, fault: str) -> None:
    assert change.fault(VALUE) == fault
    assert change.apply(VALUE) == VALUE


def test_the_last_elector_stays() -> None:
    alone = replace(VALUE, electors=VALUE.electors[:1])
    change = RemoveElector(base_revision=7, name="a")
    assert change.fault(alone) == "a is the last elector"
    assert change.apply(alone) == alone


def test_a_document_changes_an_unsettled_value_and_leaves_it_unsettled() -> None:
    unsettled = replace(VALUE, settled=False)
    after = CHANGES[3].apply(unsettled)
    assert (after.number, after.settled, after.document) == (3, False, "e")


def chosen_by_a_and_b() -> Machines:
    """Of a, b and c only the first two have the task's value; c has not heard of it."""
    world = Machines("abcd", electors=3)
    assert moved(world, "a", "ab")
    world.drop()
    return world


def test_chosen_value_survives_two_changes_that_come_at_once() -> None:
    world = chosen_by_a_and_b()
    remove(world, "b", "a", among="bc", for_s=AT_ONCE_S)
    assert not value_of(world.machine("b")).settled
    machine = world.machine("b")
    change = AddElector(base_revision=value_of(machine).revision, name="d", disk=world.machine("d").disk.id)
    assert world.change(machine, change) == "number 2 is not settled: a majority of its electors must answer first"
    world.tell(world.machine("b"), "c")
    world.run("b", "c", "d", for_s=AT_ONCE_S, still=("b",))
    world.tell(world.machine("c"), "d")
    world.run("c", "d")
    assert moved(world, "c", "bcd")


@pytest.mark.parametrize("settler", ["b", "c"])
def test_chosen_value_survives_two_changes_one_after_another(settler: str) -> None:
    world = chosen_by_a_and_b()
    other = {"b": "c", "c": "b"}[settler]
    machine = world.machine(settler)
    world.change(machine, RemoveElector(base_revision=1, name="a"))
    world.run("b", "c", still=(other,))
    assert value_of(machine).settled
    add(world, settler, "d", among="bcd")
    world.drop()
    assert moved(world, "c", "cd"), "a majority without b"
    assert world.machine("c").registers["t1"].value.epoch == world.first.tasks[0].start + 2


# --- whose answer counts ---------------------------------------------------------------------------------------------


def test_disk_lost_during_its_own_addition() -> None:
    world = Machines("abc", electors=2)
    add(world, "a", "c")
    assert moved(world, "a", "ac")
    world.drop()
    world.lose_disk(world.machine("c"))
    world.share("b", "c")
    assert value_of(world.machine("c")).number == 2
    assert not moved(world, "b", "bc"), "c has lost what it had accepted"
    world.run()
    remove(world, "b", "c")
    add(world, "b", "c")
    world.drop()
    assert moved(world, "c", "bc"), "under its new disk it is an elector"


def test_duplicate_member_names() -> None:
    world = Machines("abc", electors=3)
    copy = world.clone(world.machine("c"))
    assert copy.disk.id != world.machine("c").disk.id
    world.stop(copy)
    assert moved(world, "a", "ac")
    world.drop()
    world.stop(world.machine("c"))
    world.start(copy)
    assert not moved(world, "b", "bc"), "the copy has not accepted it"


def test_cloned_disk_with_the_same_id_would_be_found() -> None:
    """The harness can see it: so the id of a copied disk must be another one."""
    world = Machines("abc", electors=3)
    world.copied_id = lambda copied: copied  # type: ignore[method-assign]
    copy = world.clone(world.machine("c"))
    world.stop(copy)
    assert moved(world, "a", "ac")
    world.drop()
    world.stop(world.machine("c"))
    world.start(copy)
    with pytest.raises(ChosenError):
        moved(world, "b", "bc")


def test_lost_disk_repeats_a_ballot() -> None:
    world = Machines("abcd", electors=3)
    machine = world.machine("d")
    world.move(machine, "t1")
    for name in "abc":
        give(world, pick(world, name, Ask))
    late = pick(world, "d", Say)
    for message in late:
        world.give(message)
    world.drop()
    world.pool += late
    give(world, pick(world, "d", Say, "c"))  # a majority is there already: nothing comes of it
    world.lose_disk(machine)
    world.tell(world.machine("a"), "d")
    give(world, [one for one in world.pool if one.to == "d" and not isinstance(one.body, Say)])
    world.move(machine, "t1")
    late = pick(world, "d", Say)
    world.pool = [one for one in world.pool if one in late]
    give(world, late)
    assert world.pool == [], "promises that were given to the first life count nothing"
    world.run()
    assert machine.registers["t1"].value.owner == "w2"


def test_old_majority_goes_on_under_the_old_number() -> None:
    world = Machines("abcd", electors=3)
    add(world, "b", "d", among="bcd")
    remove(world, "b", "a", among="bcd")
    world.drop()
    assert moved(world, "c", "cd")
    world.drop()
    assert value_of(world.machine("a")).number == 1
    assert not moved(world, "a", "ab"), "b has left the number under which a asks"
    assert value_of(world.machine("a")).number == 3, "and has handed the newer one over"


def test_an_elector_that_is_behind_refuses_and_is_told() -> None:
    world = Machines("abc", electors=3)
    remove(world, "a", "c", among="ab")
    world.drop()
    add(world, "a", "c", among="ab")
    world.drop()
    assert value_of(world.machine("c")).number == 1
    assert moved(world, "a", "ac"), "c follows as soon as it is asked"
    assert value_of(world.machine("c")).number == 3


@pytest.mark.parametrize(
    ("change", "counts"),
    [({}, True), ({"disk": "other"}, False), ({"joining": 2}, False), ({"elector": "d"}, False)],
)
def test_a_yes_counts_for_the_seat_of_its_round_only(change: dict[str, object], counts: bool) -> None:
    world = Machines("abc", electors=3)
    machine = world.machine("a")
    register = machine.registers["t1"]
    world.move(machine, "t1")
    (asked,) = [one.body.questions[0] for one in pick(world, "b", Ask) if isinstance(one.body, Ask)]
    assert isinstance(asked, Prepare)
    for name in "ab":
        said = Promise(elector=name, task="t1", ballot=asked.ballot, disk=world.machine(name).disk.id, joining=1)
        todo = ToDo()
        register.on_answer(replace(said, **change) if name == "b" else said, todo, 0.1)  # type: ignore[arg-type]
    assert bool(todo.send) is counts


def test_another_generation_gets_no_answer() -> None:
    world = Machines("abc", electors=3)
    world.recover(world.machine("c"))
    world.move(world.machine("a"), "t1")
    give(world, pick(world, "c", Ask))
    assert pick(world, "a", Say, "c") == []


def test_round_ends_when_its_node_learns_another_number() -> None:
    world = Machines("abcd", electors=3)
    machine = world.machine("a")
    world.move(machine, "t1")
    for name in "abc":
        give(world, pick(world, name, Ask))
    late = pick(world, "a", Say)
    world.pool = [one for one in world.pool if one not in late]
    remove(world, "b", "c", among="bc", for_s=AT_ONCE_S)
    world.tell(world.machine("b"), "a")
    give(world, [one for one in world.pool if one.to == "a" and one.sender == "b" and not isinstance(one.body, Say)])
    world.pool = list(late)
    give(world, late)
    assert not any(isinstance(one.body, Ask) for one in world.pool), "promises of number 1 lead to no accept"
    world.run("a", "b", still=("b",))
    assert machine.registers["t1"].value.owner is not None, "it is tried again under number 2"


# --- what is on disk, what is handed on ------------------------------------------------------------------------------


def test_elector_forgets_the_new_number() -> None:
    world = Machines("abc", electors=3)
    remove(world, "a", "c", among="ab", for_s=AT_ONCE_S)
    for name in "ab":
        world.restart(world.machine(name))
        assert value_of(world.machine(name)).number == 2


def test_fleet_value_is_persisted_in_the_step_that_learns_it() -> None:
    world = Machines("ab", electors=1)
    roll = world.machine("b").roll
    assert roll is not None
    todo = ToDo()
    roll.learn(replace(world.first, revision=2, document="d1"), todo, 0.0)
    assert todo.must_persist
    assert roll.state.learnt == roll.value


def test_accepted_is_not_learnt() -> None:
    world = Machines("abcde", electors=3)
    add(world, "a", "d", among="abcd")
    world.drop()
    machine = world.machine("c")
    change = AddElector(base_revision=value_of(machine).revision, name="e", disk=world.machine("e").disk.id)
    assert world.change(machine, change) == ""
    for name in "abcd":
        give(world, pick(world, name, AskRoll))
    give(world, pick(world, "c", SayRoll))
    give(world, pick(world, "a", AskRoll))
    world.drop()
    world.stop(machine)
    roll = world.machine("a").roll
    assert roll is not None
    assert roll.state.accepted is not None
    assert roll.state.accepted.value.number == 3
    world.move(world.machine("e"), "t1")  # under number 1
    give(world, pick(world, "a", Ask))
    give(world, pick(world, "e", Say))
    assert value_of(world.machine("e")).number == 2


def test_change_on_top_of_an_unlearnt_change() -> None:
    world = Machines("abcd", electors=3)
    machine = world.machine("c")
    assert world.change(machine, AddElector(base_revision=1, name="d", disk=world.machine("d").disk.id)) == ""
    for name in "abc":
        give(world, pick(world, name, AskRoll))
    give(world, pick(world, "c", SayRoll))
    give(world, pick(world, "a", AskRoll))
    world.drop()
    world.stop(machine)
    assert world.change(world.machine("b"), RemoveElector(base_revision=1, name="c")) == ""
    world.run("a", "b", for_s=AT_ONCE_S)
    assert value_of(world.machine("b")).electorate.names == ("a", "b", "c", "d"), "first what was accepted before"
    assert [outcome for _, outcome in world.ended] == [RoundOutcome.CONFLICT]


# --- settling --------------------------------------------------------------------------------------------------------


def test_settled_is_said_a_guard_time_after_the_identity_rounds_when_a_task_is_exclusive() -> None:
    world = Machines("abc", electors=2, tasks=(("t1", True),), lease_s=2.0)
    add(world, "a", "c", for_s=1.9)
    assert not value_of(world.machine("a")).settled
    world.run(for_s=0.4)
    assert value_of(world.machine("a")).settled


def test_settled_is_said_at_once_when_no_task_is_exclusive() -> None:
    world = Machines("abc", electors=2, lease_s=2.0)
    add(world, "a", "c", for_s=0.2)
    assert value_of(world.machine("a")).settled


@pytest.mark.parametrize(("before_s", "after_s"), [(2.0, 0.5), (0.5, 2.0)])
def test_lease_shortened_is_another_number_and_the_guard_goes_by_the_longer(before_s: float, after_s: float) -> None:
    world = Machines("ab", electors=2, tasks=(("t1", True),), lease_s=before_s)
    assert world.change(world.machine("a"), SetLease(base_revision=1, lease_s=after_s)) == ""
    world.run(for_s=1.9)
    value = value_of(world.machine("a"))
    assert (value.number, value.settled, value.lease_s, value.guard_lease_s) == (2, False, after_s, 2.0)
    world.run(for_s=0.4)
    value = value_of(world.machine("a"))
    assert (value.settled, value.guard_lease_s) == (True, after_s)
    assert hold_s(2.0) < 2.3


class Leased(Machines):
    """Their tasks have been exclusive, and are leased until their owner's file says otherwise."""

    def first_value(self, creation: Creation) -> Allocation:
        return replace(super().first_value(creation), leased=True)


def test_a_task_that_is_leased_is_waited_for_though_the_document_calls_it_exclusive_no_more() -> None:
    world = Leased("abc", electors=2, lease_s=2.0)
    add(world, "a", "c", for_s=1.9)
    assert not value_of(world.machine("a")).settled
    world.run(for_s=0.4)
    assert value_of(world.machine("a")).settled


def test_without_an_exclusive_task_nobody_waits_and_the_longer_lease_stays_known() -> None:
    """The task that had it may come back, before its owner's lease has ended."""
    world = Machines("abc", electors=2, lease_s=2.0)
    assert world.change(world.machine("a"), SetLease(base_revision=1, lease_s=0.5)) == ""
    world.run(for_s=0.4)
    value = value_of(world.machine("a"))
    assert (value.settled, value.lease_s, value.guard_lease_s) == (True, 0.5, 2.0)
    add(world, "a", "c", for_s=0.4)
    assert value_of(world.machine("a")).guard_lease_s == 2.0, "nor does the next change"


def test_a_task_that_becomes_exclusive_as_all_is_settled_does_not_forget_longer_leases() -> None:
    """Who settles has not waited, for it knew of no such task; its word is put on top of the newer document."""
    unsettled = replace(VALUE, number=4, settled=False, lease_s=0.5)
    assert unsettled.is_exclusive
    assert Settle(base_revision=7, number=4).apply(unsettled).guard_lease_s == 2.0
    assert Settle(base_revision=7, number=4, has_waited=True).apply(unsettled).guard_lease_s == 0.5


def test_a_document_that_changes_meanwhile_does_not_keep_electors_unsettled() -> None:
    world = Machines("abc", electors=2, tasks=(("t1", True),), lease_s=1.0)
    add(world, "a", "c", for_s=0.1)
    for step in range(4):
        machine = world.machine("b")
        change = SetDocument(
            base_revision=value_of(machine).revision, document=f"e{step}", tasks=(("t1", True), (f"t{step + 2}", False))
        )
        assert world.change(machine, change) == ""
        world.run(for_s=0.35)
    value = value_of(world.machine("a"))
    assert (value.settled, value.document) == (True, "e3")


def test_a_settler_s_word_is_of_its_number_only() -> None:
    after = replace(VALUE, number=4, settled=False)
    assert Settle(base_revision=7, number=3).apply(after) == after
    assert Settle(base_revision=7, number=4).apply(after).settled


def test_proposer_dies_between_change_and_settling() -> None:
    world = Machines("abcd", electors=3)
    add(world, "a", "d", for_s=AT_ONCE_S)
    assert not value_of(world.machine("a")).settled
    world.stop(world.machine("a"))
    world.run()
    assert value_of(world.machine("b")).settled


def test_settling_asks_for_all_tasks_in_one_frame() -> None:
    tasks = tuple((f"t{index}", False) for index in range(1, 11))
    world = Machines("abc", electors=3, tasks=tasks)
    for task, _ in tasks:
        assert moved(world, "a", "abc", task)
    remove(world, "a", "c", for_s=AT_ONCE_S)
    frames: list[Ask] = []
    give_before = world.give

    def counted(message: Message) -> None:
        frames.extend([message.body] if isinstance(message.body, Ask) and message.sender == "a" else [])
        give_before(message)

    world.give = counted  # type: ignore[method-assign]
    world.run("a", "b", still=("b",))
    assert value_of(world.machine("a")).settled
    assert [len(frame.questions) for frame in frames] == [10] * 4, "a prepare and an accept to each of two electors"


# --- seats, creations ------------------------------------------------------------------------------------------------


def test_unchosen_value_comes_back_not() -> None:
    world = Machines("abcd", electors=3)
    machine = world.machine("d")
    world.move(machine, "t1")
    for name in "abc":
        give(world, pick(world, name, Ask))
    give(world, pick(world, "d", Say))
    give(world, pick(world, "c", Ask))
    assert world.machine("c").registers["t1"].state.accepted is not None, "by a minority"
    world.drop()
    world.stop(machine)
    remove(world, "a", "c", among="ab")
    add(world, "a", "c", among="ab")
    world.drop()
    world.share("a", "c")
    assert value_of(world.machine("c")).number == 3
    assert world.machine("c").registers["t1"].state.accepted is None, "of another seat"


def test_removed_elector_with_a_stale_high_ballot_returns() -> None:
    world = chosen_by_a_and_b()
    remove(world, "a", "c", among="ab")
    add(world, "a", "c", among="ab")
    world.run()
    assert moved(world, "c", "bc")


def test_what_the_fleet_register_accepted_under_a_number_before_is_dropped() -> None:
    world = Machines("abcd", electors=3)
    add(world, "a", "d", for_s=AT_ONCE_S)
    for name in "abc":
        roll = world.machine(name).roll
        assert roll is not None
        assert roll.state.accepted is None or roll.state.accepted.value.number == 2
    world.run()
    world.restart(world.machine("b"))
    remove(world, "b", "a")
    assert value_of(world.machine("b")).settled


def test_task_removed_and_added_again() -> None:
    world = Machines("abc", electors=3)
    assert moved(world, "a", "ab")
    for tasks in ((), (("t1", False),)):
        machine = world.machine("a")
        change = SetDocument(base_revision=value_of(machine).revision, document=f"e{len(tasks)}", tasks=tasks)
        assert world.change(machine, change) == ""
        world.run("a", "b")
        world.drop()
    assert moved(world, "a", "ab")
    register = world.machine("a").registers["t1"]
    assert register.state.creation == 2
    assert register.value.epoch == 2 * 2**32 + 1
    world.share()
    assert world.machine("c").registers["t1"].value == register.value


def test_stale_proposer_of_a_removed_task() -> None:
    world = Machines("abcd", electors=3)
    assert moved(world, "a", "abc")
    world.drop()
    machine = world.machine("a")
    assert world.change(machine, SetDocument(base_revision=1, document="e", tasks=())) == ""
    world.run("a", "b", "c")
    world.drop()
    assert not world.machine("a").registers
    world.move(world.machine("d"), "t1")
    for name in "abc":
        give(world, pick(world, name, Ask))
    answers = [one.body.answers[0] for one in pick(world, "d", Say) if isinstance(one.body, Say)]
    assert [isinstance(one, Refused) and one.refusal is Refusal.NUMBER for one in answers] == [True] * 3
    assert not moved(world, "d", "abcd")


def test_changes_under_way_of_a_task_that_is_removed_end() -> None:
    world = Machines("abc", electors=3)
    machine = world.machine("c")
    world.move(machine, "t1")
    world.move(machine, "t1")
    world.drop()
    assert world.change(world.machine("a"), SetDocument(base_revision=1, document="e", tasks=())) == ""
    world.run(for_s=AT_ONCE_S)
    outcomes = [outcome for change, outcome in world.ended if not isinstance(change, SetDocument)]
    assert outcomes == [RoundOutcome.NO_QUORUM] * 2


# --- absence ---------------------------------------------------------------------------------------------------------


def test_two_changes_from_two_sides_of_a_partition() -> None:
    world = Machines("abcde", electors=3)
    world.change(world.machine("a"), RemoveElector(base_revision=1, name="c"))
    world.change(world.machine("c"), RemoveElector(base_revision=1, name="a"))
    world.run("a", "b")
    world.run("c", "d")
    assert value_of(world.machine("a")).electorate.names == ("a", "b")
    assert value_of(world.machine("c")).number == 1, "the smaller side commits nothing"
    world.run()
    world.share()
    assert value_of(world.machine("c")) == value_of(world.machine("a"))


def test_seven_to_two_each_dead_one_removed() -> None:
    world = Machines("abcdefg", electors=5)
    add(world, "a", "f")
    add(world, "a", "g")
    for index, name in enumerate("gfedc"):
        world.stop(world.machine(name))
        left = "abcdefg"[: 6 - index]
        remove(world, "a", name, among=left)
        assert value_of(world.machine("a")).settled
        assert moved(world, "b", left)
    assert value_of(world.machine("a")).electorate.names == ("a", "b")
    remove(world, "a", "b")
    assert moved(world, "a", "a"), "and to one, when the last but one leaves"


def test_all_replaced_while_one_sleeps() -> None:
    world = Machines("abcdefgh", electors=3)
    awake = "abcdefg"
    for new, old in (("d", "a"), ("e", "b"), ("f", "c")):
        add(world, "a" if old == "a" else "d", new, among=awake)
        remove(world, "d", old, among=awake)
    assert value_of(world.machine("d")).electorate.names == ("d", "e", "f")
    assert moved(world, "g", awake)
    world.drop()
    assert value_of(world.machine("h")).number == 1
    moved(world, "h", "abch")
    assert value_of(world.machine("h")).number == 7, "the old ones hand the newest over"
    assert moved(world, "h", "abcdefgh") or moved(world, "h", "abcdefgh")


# --- recovery --------------------------------------------------------------------------------------------------------


def test_recover_two_halves() -> None:
    world = Machines("abcd", electors=4)
    assert moved(world, "a", "abcd")
    world.share()
    left, right = world.recover(world.machine("a")), world.recover(world.machine("d"))
    assert left.generation_id != right.generation_id
    assert left.parent_id == right.parent_id == world.first.generation_id
    assert moved(world, "a", "a")
    assert moved(world, "d", "d")
    world.share()
    assert value_of(world.machine("a")).generation_id == left.generation_id
    assert value_of(world.machine("d")).generation_id == right.generation_id, "each stays on its side"


def test_recovered_tasks_go_on_with_higher_epochs() -> None:
    world = Machines("abc", electors=3)
    assert moved(world, "a", "abc")
    owner, before = world.machine("a").registers["t1"].value.owner, world.first.tasks[0]
    value = world.recover(world.machine("a"))
    register = world.machine("a").registers["t1"]
    assert (value.number, value.settled, value.electorate.names) == (2, False, ("a",))
    assert value.tasks[0].number == before.number + 1
    assert (register.value.owner, register.value.epoch) == (owner, value.tasks[0].start + 1)
    world.run("a")
    assert value_of(world.machine("a")).settled
    world.lose_disk(world.machine("b"))
    world.machine("b").generation_id = value.generation_id
    world.share("a", "b")
    add(world, "a", "b", among="ab")
    assert moved(world, "b", "ab")


def test_recover_takes_the_newest_of_all_states_it_is_given() -> None:
    world = Machines("abc", electors=3)
    old = world.machine("a").registers["t1"].state
    assert moved(world, "a", "abc")
    new = world.machine("a").registers["t1"].state
    other = replace(new, creation=9)
    for states in ((old, new, other), (new, other, old)):
        value, registers = recovered(world.first, "c", disk="5", generation_id="77", states=states)
        (state,) = registers
        assert state.learnt is not None
        assert new.learnt is not None
        assert state.learnt.owner == new.learnt.owner
        assert state.creation == value.tasks[0].number == 2
    assert recovered(world.first, "c", disk="5", generation_id="77", states=())[1] == ()


def test_chosen_but_learnt_by_no_survivor_waits_for_recover() -> None:
    """The dead end that clause 25 would open: it loses nothing, and an operator's `recover` ends it."""
    world = Machines("abc", electors=2)
    assert world.change(world.machine("b"), RemoveElector(base_revision=1, name="b")) == ""
    for name in "ab":
        give(world, pick(world, name, AskRoll))
    give(world, pick(world, "b", SayRoll))
    for name in "ab":
        give(world, pick(world, name, AskRoll))
    world.drop()
    world.lose_disk(world.machine("b"))
    assert not moved(world, "a", "abc")
    assert value_of(world.machine("a")).number == 1
    world.recover(world.machine("a"))
    assert moved(world, "a", "a")


# --- of today's files ------------------------------------------------------------------------------------------------


def test_nodes_found_the_same_value_of_today_s_file_and_generation() -> None:
    value = founded("f", 2, ("b", "a"))
    assert value == founded("f", 2, ("a", "b"))
    assert value.generation_id != founded("f", 3, ("a", "b")).generation_id != founded("g", 3, ("a", "b")).generation_id
    assert (value.revision, value.number, value.settled, value.creations) == (1, 1, True, 2)
    assert all(one.is_held_by(one.name, "any disk") for one in value.electors)
