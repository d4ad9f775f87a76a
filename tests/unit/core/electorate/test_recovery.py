"""Recovery: when it is refused, which dangers it has, which states it begins with; and changing sides."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import pytest

from support import states
from support.allocations import allocation_of
from support.fleets import fleet_of, task_of
from zsched.core.electorate.changes import AdoptDocument, RemoveElector, SetLease
from zsched.core.electorate.founding import founded, newest_fleet
from zsched.core.electorate.recovery import (
    MOVED,
    NEW_DISK,
    Danger,
    Found,
    Recovery,
    choose_side,
    consider,
    new_member,
    rejoined,
    sides_of,
)
from zsched.core.values.codec import decode_state, encode_state
from zsched.core.values.durable import DurableState
from zsched.core.values.electorate import Elector, FleetValue
from zsched.core.values.fleet import Fleet
from zsched.core.values.model import Acceptance, Allocation, Ballot, RegisterState
from zsched.core.values.snapshot import SCHEMA, QuorumStatus, Snapshot
from zsched.core.values.words import CREATION_STEP

NAMES = ("edge1", "robot1", "robot2", "robot3")
ROBOTS = NAMES[1:]
TASK = task_of(candidates=NAMES, exclusive=True)
FLEET = fleet_of(TASK, of=NAMES, electors=ROBOTS)
FIRST = founded(FLEET.name, 0, ROBOTS)
ADOPTED = replace(
    AdoptDocument(base_revision=1, document="0d", tasks=(("merge", True),), lease_s=1.0).apply(FIRST), settled=True
)
BALLOT = Ballot(counter=9, incarnation=1, node="robot2")


def allocation(revision: int, owner: str, creation: int = 0) -> Allocation:
    start = creation * CREATION_STEP + revision
    return allocation_of(start, owner, leased=True)


def state_of(
    node: str,
    value: FleetValue | None = ADOPTED,
    *,
    learnt: Allocation | None = None,
    accepted: Allocation | None = None,
    lease_s: float = 0.0,
) -> DurableState:
    held = None if accepted is None else Acceptance(ballot=BALLOT, value=accepted)
    return states.state_of(
        node,
        RegisterState(task="merge", learnt=learnt, accepted=held),
        incarnation=5,
        hardware="h",
        lease_s=lease_s,
        disk=f"d{node[-1]}",
        fleet_register=None if value is None else RegisterState(task=FLEET.name, learnt=value),
    )


def answer_of(node: str, value: FleetValue = ADOPTED, *, role: str = "elector") -> Snapshot:
    quorum = QuorumStatus(
        electors=len(value.electors),
        needed=1,
        alive=0,
        ok=False,
        this_node=role,
        names=value.electorate.names,
        number=value.number,
        generation_id=value.generation_id,
        recovered_by=value.recovered_by,
    )
    return Snapshot(
        schema=SCHEMA,
        version="1",
        fleet=FLEET.name,
        node=node,
        kind="robot",
        incarnation=1,
        up_s=1.0,
        loop_lag_s=0.0,
        quorum=quorum,
        nodes=(),
        tasks=(),
        fleet_revision=value.revision,
    )


def found(
    *others: DurableState,
    own: DurableState | None = None,
    answers: tuple[Snapshot, ...] = (),
    documents: Mapping[str, Fleet] | None = None,
) -> Found:
    stored = {"0d": FLEET} if documents is None else documents
    return Found(fleet=FLEET, me="robot1", own=own, others=others, answers=answers, documents=stored, file_hash="0f")


def planned(it: Found) -> Recovery:
    plan = consider(it)
    assert isinstance(plan, Recovery), plan
    return plan


def carried_out(it: Found) -> tuple[DurableState, FleetValue]:
    state = planned(it).carry_out(generation_id="77", disk="ff", incarnation=3, hardware="h2")
    assert decode_state(encode_state(state)) == state
    assert state.fleet_register is not None
    assert state.fleet_register.learnt is not None
    return state, state.fleet_register.learnt


# --- when it is refused ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("it", "why"),
    [
        (found(), "robot1 has no state here, and none is given"),
        (found(own=state_of("robot1"), answers=(answer_of("robot2"),)), "robot1, robot2 can agree"),
        (
            found(own=state_of("robot1"), answers=(answer_of("edge1", replace(ADOPTED, revision=9)),)),
            "edge1 knows revision 9 of the fleet, and the states given here only 2",
        ),
        (
            found(state_of("robot2", replace(ADOPTED, generation_id="ab12")), own=state_of("robot1")),
            "halves that were recovered apart never mix",
        ),
        (found(replace(state_of("robot2"), fleet="other"), own=state_of("robot1")), "is of the fleet other"),
        (found(own=replace(state_of("robot1", None), joins="77")), "robot1 was to join generation 77"),
        (found(own=replace(state_of("robot1"), disputed="two of them")), "`zsched fleet recover --settle` comes first"),
        (
            found(own=state_of("robot1"), documents={"0d": fleet_of(TASK, of=ROBOTS[1:])}),
            "the agreed document names no node 'robot1'",
        ),
    ],
)
def test_what_speaks_against_it_is_said(it: Found, why: str) -> None:
    plan = consider(it)
    assert isinstance(plan, str)
    assert why in plan


def test_a_change_of_electors_that_was_only_accepted_is_none_yet() -> None:
    """robot3 is lost for good, and its removal was accepted by both others of four, which are no majority.

    By the three that would be left nothing was lost: nobody could agree any more, and `recover` said "start zsched".
    """
    four = replace(ADOPTED, electors=(Elector(name="edge1", disk="d1", joining=2), *FIRST.electors))
    three = RemoveElector(base_revision=four.revision, name="robot3").apply(four)
    own = replace(
        state_of("robot1", four),
        fleet_register=RegisterState(task=FLEET.name, learnt=four, accepted=Acceptance(ballot=BALLOT, value=three)),
    )
    it = found(own=own, answers=(answer_of("robot2", four), answer_of("edge1", four, role="follower")))
    assert planned(it).before == three, "it may have been chosen all the same"
    assert "can agree" in str(consider(found(own=own, answers=(answer_of("robot2", four), answer_of("edge1", four)))))


def test_a_state_that_is_lost_is_no_elector() -> None:
    lost = replace(state_of("robot1"), lost="older than peers remember")
    assert Danger.LOST in dict(planned(found(own=lost, answers=(answer_of("robot2"),))).dangers)


# --- its dangers -----------------------------------------------------------------------------------------------------


def dangers(it: Found) -> dict[Danger, str]:
    return dict(planned(it).dangers)


def test_old_electors_must_be_off_and_states_that_are_not_given_may_be_newer() -> None:
    told = dangers(found(own=state_of("robot1")))
    assert set(told) == {Danger.OFF, Danger.LOST}
    assert "second fleet with second owners" in told[Danger.OFF]
    assert "no states of robot2, robot3 are given" in told[Danger.LOST]


def test_who_was_the_only_elector_needs_nobody_to_be_off() -> None:
    alone = replace(ADOPTED, electors=ADOPTED.electors[:1])
    lost = replace(state_of("robot1", alone), lost="older than peers remember")
    assert set(dangers(found(own=lost))) == {Danger.LOST}


def test_states_of_a_majority_hold_all_that_was_agreed() -> None:
    assert set(dangers(found(state_of("robot2"), own=state_of("robot1")))) == {Danger.OFF}


def test_a_document_that_is_nowhere_gives_way_to_the_file() -> None:
    told = dangers(found(own=state_of("robot1"), documents={}))
    assert "the agreed document 0d is on none of the disks given" in told[Danger.FILE]


def test_another_half_that_was_recovered_already_is_a_danger() -> None:
    half = replace(ADOPTED, generation_id="ab" * 16, recovered_by="robot3")
    told = dangers(found(own=state_of("robot1"), answers=(answer_of("robot3", half),)))
    assert "`zsched fleet recover --rejoin abababab`" in told[Danger.HALF]


# --- what it begins with ---------------------------------------------------------------------------------------------


def test_the_survivor_is_the_only_elector_and_every_task_is_created_anew() -> None:
    state, value = carried_out(found(own=state_of("robot1", learnt=allocation(3, "edge1"))))
    assert (value.generation_id, value.parent_id, value.recovered_by) == ("77", ADOPTED.generation_id, "robot1")
    assert (value.number, value.revision, value.settled) == (ADOPTED.number + 1, ADOPTED.revision + 1, False)
    assert [(one.name, one.disk, one.joining) for one in value.electors] == [("robot1", "d1", value.number)]
    (register,) = state.registers
    assert register.learnt is not None
    assert (register.learnt.owner, register.learnt.epoch) == ("edge1", CREATION_STEP + 1)
    assert (register.creation, state.incarnation, state.hardware) == (1, 5, "h2")


@pytest.mark.parametrize(
    ("own", "other", "owner"),
    [
        ({"learnt": allocation(3, "edge1")}, {"learnt": allocation(4, "robot2")}, "robot2"),
        ({"learnt": allocation(3, "edge1")}, {"accepted": allocation(4, "robot2")}, "robot2"),
        ({"learnt": allocation(4, "edge1")}, {"accepted": allocation(4, "robot2")}, "edge1"),
        ({"accepted": allocation(4, "edge1")}, {"learnt": allocation(3, "robot2")}, "edge1"),
    ],
)
def test_the_newest_value_of_all_states_is_kept(
    own: dict[str, Allocation], other: dict[str, Allocation], owner: str
) -> None:
    it = found(
        state_of("robot2", learnt=other.get("learnt"), accepted=other.get("accepted")),
        own=state_of("robot1", learnt=own.get("learnt"), accepted=own.get("accepted")),
    )
    (register,) = carried_out(it)[0].registers
    assert register.learnt is not None
    assert register.learnt.owner == owner


def test_a_newer_fleet_value_of_a_dead_machine_counts_even_if_it_was_only_accepted() -> None:
    newer = RemoveElector(base_revision=2, name="robot3").apply(ADOPTED)
    held = RegisterState(task=FLEET.name, learnt=ADOPTED, accepted=Acceptance(ballot=BALLOT, value=newer))
    assert newest_fleet([held]) == newer
    it = found(replace(state_of("robot2"), fleet_register=held), own=state_of("robot1"))
    assert carried_out(it)[1].number == newer.number + 1


def test_the_guard_is_as_long_as_any_lease_that_was_granted_before() -> None:
    longer = SetLease(base_revision=2, lease_s=3.0).apply(ADOPTED)
    shorter = replace(SetLease(base_revision=3, lease_s=0.5).apply(replace(longer, settled=True)), settled=False)
    state, value = carried_out(found(own=state_of("robot1", shorter)))
    assert (value.lease_s, value.guard_lease_s, state.lease_s) == (0.5, 3.0, 3.0)
    state, value = carried_out(found(state_of("robot2", lease_s=7.0), own=state_of("robot1")))
    assert (value.lease_s, value.guard_lease_s, state.lease_s) == (1.0, 7.0, 7.0)


def test_a_fleet_that_goes_by_its_files_gets_this_machines_file_as_its_document() -> None:
    own = state_of("robot1", None, learnt=allocation(3, "edge1"))
    plan = planned(found(own=own, documents={}))
    assert Danger.FILE not in dict(plan.dangers)
    state, value = carried_out(found(own=own, documents={}))
    assert (value.document, value.lease_s) == ("0f", FLEET.timing.lease_s)
    assert [(one.task, one.number, one.exclusive) for one in value.tasks] == [("merge", 1, True)]
    (register,) = state.registers
    assert register.learnt is not None
    assert register.learnt.owner == "edge1"


def test_a_node_without_a_state_recovers_with_one_that_was_brought() -> None:
    state, value = carried_out(found(state_of("robot2", learnt=allocation(3, "edge1"))))
    assert (value.electorate.names, state.disk, state.node) == (("robot1",), "ff", "robot1")


# --- changing sides --------------------------------------------------------------------------------------------------

LEFT = replace(ADOPTED, generation_id="aa" * 16, recovered_by="robot2")
RIGHT = replace(ADOPTED, generation_id="bb" * 16, recovered_by="robot3")


@pytest.mark.parametrize(
    ("values", "wanted", "expected"),
    [
        ([LEFT], "", LEFT.generation_id),
        ([LEFT, ADOPTED], "", LEFT.generation_id),
        ([LEFT, RIGHT], "bb", RIGHT.generation_id),
        ([LEFT, RIGHT], "", "name the generation to join; there are aaaaaaaa: robot2; bbbbbbbb: robot3"),
        ([], "", "no other node answers"),
        ([ADOPTED], "", "all nodes that answer are of this node's generation"),
        ([LEFT], "cc", "no node that answers is of a generation cc"),
        ([LEFT], ADOPTED.generation_id[:4], "already: start zsched, it follows by itself"),
    ],
)
def test_the_side_is_named_or_the_only_other_one(values: list[FleetValue], wanted: str, expected: str) -> None:
    answers = [answer_of(name, value) for name, value in zip(ROBOTS[1:], values, strict=False)]
    side = choose_side(FLEET, state_of("robot1"), sides_of(answers), wanted)
    assert expected in (side if isinstance(side, str) else side.generation_id)


def test_who_would_hear_nobody_of_the_other_side_does_not_change_to_it() -> None:
    """All who count by it came by invitation, after this fleet file was written."""
    sides = sides_of([answer_of("robot8", LEFT), answer_of("robot9", LEFT)])
    told = choose_side(FLEET, state_of("robot1"), sides, "")
    assert isinstance(told, str)
    assert told.startswith("the fleet file here names none of robot8, robot9")
    assert "`zsched fleet export` on robot8" in told
    known = sides_of([answer_of("robot2", LEFT), answer_of("robot9", LEFT)])
    assert choose_side(FLEET, state_of("robot1"), known, "") == known[0]


def test_who_changes_sides_starts_blank_as_another_member_and_is_no_elector() -> None:
    (side,) = sides_of([answer_of("robot2", LEFT)])
    own = state_of("robot1", learnt=allocation(3, "edge1"), lease_s=2.0)
    state = rejoined(FLEET, "robot1", own, side, disk="99", incarnation=2, hardware="h")
    assert (state.joins, state.disk, state.incarnation) == (LEFT.generation_id, "99", 5)
    assert (state.registers, state.fleet_register, state.votes, state.lease_s) == ((), None, 0, 2.0)
    assert state.lost == MOVED
    assert rejoined(FLEET, "edge1", None, side, disk="99", incarnation=2, hardware="h").lost == ""


# --- a blank disk ----------------------------------------------------------------------------------------------------


def voter_of(node: str, value: FleetValue = ADOPTED, **quorum: object) -> Snapshot:
    answer, said = answer_of(node, value), {"voted": ("robot3",), **quorum}
    return replace(answer, quorum=replace(answer.quorum, **said))  # type: ignore[arg-type]


def test_a_blank_disk_whose_name_has_a_seat_is_another_member_and_answers_nobody() -> None:
    side = new_member("robot3", 0, [voter_of("robot1"), answer_of("robot2")])
    assert side is not None
    state = rejoined(FLEET, "robot3", None, side, disk="99", incarnation=7, hardware="h", why=NEW_DISK)
    assert (state.joins, state.lost, state.disk) == (ADOPTED.generation_id, NEW_DISK, "99")
    assert (state.registers, state.fleet_register) == ((), None)


@pytest.mark.parametrize("voted", [(), ("edge1", "robot3")])
def test_a_blank_disk_whose_name_has_no_seat_founds_no_second_fleet(voted: tuple[str, ...]) -> None:
    """Its seat went with its disk. By the electors of its file it had a quorum of one, and owned an exclusive task."""
    side = new_member("edge1", 0, [voter_of("robot1", voted=voted), answer_of("robot2")])
    assert side is not None
    file = replace(FLEET, electors=("edge1",))
    state = rejoined(file, "edge1", None, side, disk="99", incarnation=7, hardware="h", why=NEW_DISK)
    assert (state.joins, state.lost, state.fleet_register) == (ADOPTED.generation_id, NEW_DISK, None)


@pytest.mark.parametrize(
    ("me", "generation", "answers"),
    [
        ("robot3", 0, []),
        ("robot3", 0, [voter_of("robot1", voted=())]),
        ("robot3", 1, [voter_of("robot1")]),
        ("robot3", 0, [voter_of("robot1"), voter_of("robot2", replace(ADOPTED, generation_id="ab"))]),
        ("robot3", 0, [voter_of("robot1", FIRST, number=0)]),
    ],
    ids=["nobody answers", "it never voted", "another generation", "two halves", "no document"],
)
def test_a_blank_disk_is_a_member_of_one_generation_that_knows_its_name(
    me: str, generation: int, answers: list[Snapshot]
) -> None:
    assert new_member(me, generation, answers) is None
