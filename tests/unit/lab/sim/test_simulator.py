"""The simulator's own promises: delivery, faults, disks, and invariants that do go off."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from support.allocations import allocation_of
from support.beats import beat_of
from support.fleets import fleet_of, task_of
from zsched.config.timing import WIRED
from zsched.core.executor.tenure import Tenure
from zsched.core.membership.pace import FULL_S
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.errors import InvariantError
from zsched.core.values.fleet import StreamRule, WorkerSpec
from zsched.core.values.messages import Accepted, CommandOutcome, MoveTask, Promise
from zsched.core.values.model import Acceptance, Allocation, Asked, Ballot, NodeId, PeerState
from zsched.core.values.plan import Direction, Role, StreamCount, WorkerRole
from zsched_lab.sim.simulator import RESTART_S, TOKEN_DELAY_S, Simulator

RULE = StreamRule(direction=Direction.INPUT, from_template="{robot}/map", to_template="{target}/merge/{robot}/map")
FLEET = fleet_of(
    task_of(worker=WorkerSpec(command=("true",)), rules=(RULE,)),
    of=("edge1", "edge2", "robot1", "robot2", "robot3"),
    electors=("robot1", "robot2", "robot3"),
)


def make(seed: int = 1, *, loss: float = 0.0, delay_s: tuple[float, float] = (0.0005, 0.003)) -> Simulator:
    return Simulator(fleet=FLEET, seed=seed, loss=loss, delay_s=delay_s)


def settled(seed: int = 1) -> Simulator:
    sim = make(seed)
    sim.start()
    assert sim.run_until(lambda: sim.agreed("merge") is not None, 10)
    sim.run(1)
    return sim


# --- time and delivery -----------------------------------------------------------------------------------------------


def test_time_passes_to_the_condition_or_to_the_end() -> None:
    sim = make()
    sim.start()
    assert not sim.run_until(lambda: False, 0.5)
    assert sim.now == pytest.approx(100.5)
    assert sim.run_until(lambda: sim.now >= 101.0, 5)
    assert 101.0 <= sim.now < 101.3, "it stops at the event that made it true"


def test_messages_take_their_delay() -> None:
    sim = make(delay_s=(0.4, 0.5))
    sim.start()
    sim.run(0.39)
    assert sim.sees("robot1", "edge1") is PeerState.UNKNOWN
    sim.run(0.2)
    assert sim.sees("robot1", "edge1") is PeerState.ALIVE


def test_everything_lost_is_nothing_heard() -> None:
    sim = make(loss=1.0)
    sim.start()
    sim.run(2)
    assert {sim.sees("robot1", name) for name in ("robot2", "edge1")} == {PeerState.UNKNOWN}


def test_cut_parts_the_groups_in_both_directions_and_keeps_what_is_inside() -> None:
    sim = settled()
    sim.cut(("robot1", "edge1"), ("robot2", "robot3", "edge2"))
    sim.run(5)
    assert sim.sees("robot1", "edge1") is PeerState.ALIVE
    assert sim.sees("robot2", "edge2") is PeerState.ALIVE
    assert sim.sees("robot1", "robot2") is not PeerState.ALIVE
    assert sim.sees("robot2", "robot1") is not PeerState.ALIVE
    sim.heal()
    sim.run(1)
    assert sim.sees("robot1", "robot2") is PeerState.ALIVE


# --- crashes and disks -----------------------------------------------------------------------------------------------


def test_crash_is_seen_by_the_token_and_restart_counts_from_the_disk() -> None:
    sim = settled()
    sim.crash("robot3")
    assert sim.running() == ("edge1", "edge2", "robot1", "robot2")
    with pytest.raises(KeyError):
        sim.node("robot3")
    sim.run(TOKEN_DELAY_S + 0.001)
    assert sim.sees("robot1", "robot3") is not PeerState.ALIVE
    disk = sim.disk("robot3")
    assert disk is not None
    assert disk.registers[0].learnt == sim.node("robot1").registers["merge"].value
    sim.start("robot3")
    assert sim.node("robot3").incarnation > disk.incarnation
    assert sim.node("robot3").registers["merge"].value == disk.registers[0].learnt


@pytest.mark.parametrize("keep", [0, 1])
def test_cut_batch_is_carried_out_so_far_and_the_node_comes_back(keep: int) -> None:
    """The hook sees every batch; what it cuts off has no effect, the disk holds what was written before."""
    sim = settled()
    cuts: list[tuple[do.Instruction, ...]] = []

    def cut(name: NodeId, batch: tuple[do.Instruction, ...]) -> int | None:
        if cuts or name != "robot1" or not batch or not isinstance(batch[0], do.PersistState):
            return None
        cuts.append(batch)
        return keep

    before = sim.disk("robot1")
    sim.cut_batch = cut
    sim.crash(sim.agreed("merge") or "")
    assert sim.run_until(lambda: bool(cuts), 3)
    assert "robot1" not in sim.running()
    written = cuts[0][0]
    assert isinstance(written, do.PersistState)
    assert sim.disk("robot1") == (before if keep == 0 else written.state)
    sim.run(RESTART_S + 0.01)
    assert "robot1" in sim.running()


def instructions_of(sim: Simulator, who: NodeId) -> list[do.Instruction]:
    """What a node asks for from now on."""
    seen: list[do.Instruction] = []

    def note(name: NodeId, batch: tuple[do.Instruction, ...]) -> None:
        seen.extend(batch if name == who else ())

    sim.cut_batch = note
    return seen


def test_a_loop_that_stood_still_accuses_nobody_whose_beat_waits() -> None:
    """It takes in what has queued up and judges then, as the daemon's does."""
    sim = Simulator(fleet=replace(FLEET, timing=WIRED), seed=1)
    sim.start()
    sim.run(10)
    told = instructions_of(sim, "robot1")
    sim.pause(sim.machines["robot1"], 1.6)
    sim.run(5)
    accused = [one.text for one in told if isinstance(one, do.RecordStory) and "edge" in one.text.split(" ")[0]]
    assert accused == []


def test_an_order_at_a_node_whose_disk_is_slower_than_a_ballot_is_carried_out() -> None:
    """Its own promise holds its loop up; the others' are there before the time is looked at."""
    sim = settled()
    told = instructions_of(sim, "robot1")
    sim.machines["robot1"].disk_s = (0.4, 0.4)
    to = "edge2" if sim.agreed("merge") == "edge1" else "edge1"
    command = MoveTask(task="merge", node=to, asked=Asked(by="op@robot1"))
    sim.deliver(sim.machines["robot1"], ev.MoveCommanded(request=1, command=command))
    sim.run(6)
    (answer,) = (one.result for one in told if isinstance(one, do.AnswerCommand))
    assert (answer.outcome, sim.agreed("merge")) == (CommandOutcome.OK, to)


def test_broken_disk_keeps_its_old_content_and_tells_the_node() -> None:
    sim = settled()
    sim.broken_disks.add("robot1")
    before = sim.disk("robot1")
    sim.crash(sim.agreed("merge") or "")
    assert sim.run_until(lambda: not sim.node("robot1").agreement.is_elector, 3)
    assert sim.disk("robot1") == before


# --- invariants that go off ------------------------------------------------------------------------------------------


def learn(sim: Simulator, name: NodeId, allocation: Allocation) -> None:
    """Put a learnt value into a node, past all rules."""
    register = sim.node(name).registers["merge"]
    register.state = replace(register.state, learnt=allocation)


def test_value_that_is_told_without_being_on_disk_is_found() -> None:
    """What nodes learn is judged by the checker of histories, which has tests of its own (`test_history`)."""
    sim = settled()
    known = sim.node("robot1").registers["merge"].value
    learn(sim, "robot2", replace(known, revision=9))
    with pytest.raises(InvariantError, match="robot2 told of merge revision 9, which is not on its disk"):
        sim.run(1)


def test_two_that_work_on_an_exclusive_task_are_found() -> None:
    sim = settled()
    for name, is_found in (("edge1", False), ("edge2", True)):
        role = Role(task="merge", role=WorkerRole.ACTIVE, epoch=1, lease_until_s=sim.now + 1.0)
        machine = sim.machines[name]
        if not is_found:
            sim._carry_out(machine, (do.SetRole(role=role),), 0)
            continue
        with pytest.raises(InvariantError, match=r"edge1 .* and edge2 .* both work"):
            sim._carry_out(machine, (do.SetRole(role=role),), 0)


def test_a_loop_that_spins_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """It wants to be woken again and again for what it then does not do."""
    sim = settled()
    monkeypatch.setattr(Tenure, "next_deadline", lambda _tenure, now: now)
    with pytest.raises(InvariantError, match="its loop spins"):
        sim.run(1)


def test_node_is_woken_at_its_own_deadlines() -> None:
    """Not polled: between two deadlines nothing is queued for it but messages and samples."""
    sim = settled()
    node = sim.node("edge1")
    for _ in range(50):
        due = node.next_deadline()
        assert due < math.inf
        sim.run_until(lambda due=due: node.next_deadline() > due, 2)  # type: ignore[misc]
        assert sim.now <= due + 0.01


def test_promise_that_tells_another_acceptance_than_the_disk_holds_is_found() -> None:
    """But for an acceptance in the promise's own ballot: that came later, and went to the disk in the same write."""
    sim = settled()
    machine = sim.machines["robot1"]
    state = machine.disk.registers["merge"]
    before = state.accepted
    assert before is not None
    ballot = replace(state.promised, counter=state.promised.counter + 1)
    later = replace(
        before, ballot=ballot, value=allocation_of(before.value.revision + 1, "edge2", before.value.epoch + 1)
    )
    promise = Promise(elector="robot1", task="merge", ballot=ballot, accepted=before)

    machine.disk.registers["merge"] = replace(state, promised=ballot, accepted=later)
    sim.invariants.on_leaving(machine, do.AnswerElection(request=7, answer=promise), sim.now)

    machine.disk.registers["merge"] = replace(state, promised=ballot, accepted=None)
    with pytest.raises(InvariantError, match="told another acceptance"):
        sim.invariants.on_leaving(machine, do.AnswerElection(request=7, answer=promise), sim.now)


def test_two_acceptances_in_one_write_are_two_and_an_older_one_after_that_is_found() -> None:
    """Found by seed 400320: one release let an elector accept two values that had waited for it."""
    sim = settled()
    machine = sim.machines["robot1"]
    state, durable = machine.disk.registers["merge"], machine.disk.state
    assert durable is not None
    assert state.accepted is not None
    first = replace(state.promised, counter=state.promised.counter + 1)
    second = replace(first, counter=first.counter + 1)
    accepted = Acceptance(ballot=first, value=allocation_of(state.accepted.value.revision + 1, "edge2", 2))
    sim.invariants.ballots[("merge", 0), first] = ("robot2 life 1", accepted.value)

    def answer(ballot: Ballot) -> None:
        said = Accepted(elector="robot1", task="merge", ballot=ballot)
        sim.invariants.on_leaving(machine, do.AnswerElection(request=7, answer=said), sim.now)

    later = replace(state, promised=second, accepted=replace(accepted, ballot=second))
    durable = replace(durable, registers=(later,))
    sim.invariants.on_synced(machine, durable, sim.now)
    machine.disk.write(durable)
    machine.disk.sync()
    answer(first)
    stored = sim.invariants.checker._stored["merge", accepted.value.revision]
    assert stored[str(accepted)] == {"robot1"}, "it counts for a majority"
    answer(second)
    with pytest.raises(InvariantError, match="below what it had promised"):
        answer(first)
    sim.invariants.on_handled(machine, sim.now, sim.now)
    with pytest.raises(InvariantError, match="below what it had promised"):
        answer(first)


# --- a fleet at rest --------------------------------------------------------------------------------------------------


def at_rest() -> Simulator:
    sim = settled()
    sim.run(FULL_S + 1.0)
    return sim


def beats_sent(sim: Simulator, seconds: float) -> dict[NodeId, int]:
    before = {name: sim.node(name).beat_sequence for name in sim.running()}
    sim.run(seconds)
    return {name: sim.node(name).beat_sequence - count for name, count in before.items()}


def test_a_fleet_at_rest_beats_slowly_and_at_full_pace_once_a_node_is_killed() -> None:
    sim = at_rest()
    assert set(beats_sent(sim, 4.0).values()) == {10}
    sim.crash("robot3")
    sim.run(0.5)
    assert all(19 <= count <= 22 for count in beats_sent(sim, 4.0).values())
    sim.run(FULL_S + 1.0)
    assert set(beats_sent(sim, 4.0).values()) == {10}, "who is gone keeps nobody awake"


def test_who_is_accused_at_rest_refutes_before_it_is_taken_for_gone() -> None:
    sim = at_rest()
    node, now = sim.node("robot1"), sim.now
    changes = node.membership.absorb_token_lost("edge1", node.membership.incarnation("edge1") or 0, now)
    assert [change.after for change in changes] == [PeerState.SUSPECT]
    sim.run(0.35)
    assert sim.sees("robot1", "edge1") is PeerState.ALIVE


@pytest.mark.parametrize("has_candidates", [True, False])
def test_an_exclusive_task_keeps_its_fleet_at_full_pace(*, has_candidates: bool) -> None:
    """Also while it has no owner, and beats say nothing new."""
    tasks = tuple(replace(task, exclusive=True) for task in FLEET.tasks)
    sim = Simulator(fleet=replace(FLEET, tasks=tasks), seed=1)
    sim.start(*(FLEET.task("merge").candidates if has_candidates else ()), *FLEET.voters)
    sim.run(FULL_S + 5.0)
    assert all(19 <= count <= 22 for count in beats_sent(sim, 4.0).values())


def test_what_begins_at_a_node_at_rest_brings_its_next_beat_forward() -> None:
    sim = at_rest()
    node = sim.node("robot1")
    assert sim.run_until(lambda: node.beat_at - sim.now > 0.39, 1.0)
    node.membership.note_lag(0.05)
    node.handle(ev.DeadlineReached(), sim.now)
    assert node.next_deadline() <= sim.now + 0.2


def test_a_restless_peer_brings_the_next_beat_of_all_others_forward() -> None:
    sim = at_rest()
    node = sim.node("robot1")
    assert sim.run_until(lambda: node.beat_at - sim.now > 0.39, 1.0)
    peer = sim.node("edge1")
    beat = beat_of("edge1", peer.beat_sequence + 1, incarnation=peer.incarnation)
    node.handle(ev.BeatReceived(beat=beat), sim.now)
    assert node.next_deadline() <= sim.now + 0.2


@pytest.mark.parametrize(
    ("count", "is_slow"),
    [
        (StreamCount(stream="merge/in/0", messages=9, last_seen_s=0.1), False),
        (StreamCount(stream="merge/in/0", messages=9, last_seen_s=30.0, in_flight=1), False),
        (StreamCount(stream="merge/in/0", messages=9, last_seen_s=30.0, in_flight=0), True),
        (StreamCount(stream="merge/in/0"), True),
    ],
)
def test_a_fleet_whose_streams_flow_keeps_the_full_pace(count: StreamCount, *, is_slow: bool) -> None:
    """A full radio delays beats: with slow ones a robot was taken for dead whose uplink was saturated."""
    sim = at_rest()
    sim.node("robot1").handle(ev.StreamsCounted(counts=(count,)), sim.now)
    sim.run(1.0)
    assert sim.node("robot1").pace.is_slow is is_slow
    assert sim.node("edge1").pace.is_slow is is_slow
