"""A clock whose rate is in doubt: its node works on no exclusive task, grants nothing, and begins again afterwards."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from support.allocations import allocation_of
from support.beats import beat_of
from support.fleets import fleet_of, task_of, tuning_of
from zsched.core.values.beat import Beat, Grant
from zsched.core.values.events import ClockCompared, HoldCommanded, MoveCommanded
from zsched.core.values.fleet import Fleet, WorkerSpec
from zsched.core.values.in_force import InForce
from zsched.core.values.lease import RHO, hold_s
from zsched.core.values.messages import Hold, HoldTask, MoveTask
from zsched.core.values.model import Asked, ScoreForm
from zsched.core.values.plan import WorkerRole
from zsched.core.values.profile import WorkerState
from zsched.core.vote.clocks import DOUBT_S, JUMP_S, ClockDoubt
from zsched.core.vote.lease import Leases
from zsched_lab.sim.clocks import LOOK_S, slew
from zsched_lab.sim.simulator import Simulator

SLEW = ClockCompared(error_ratio=0.083, since_s=0.2)
WELL = ClockCompared(error_ratio=1e-5, since_s=0.2)
TASK = task_of(
    "guard",
    tuning=tuning_of(cpu=1.0, memory=0.0),
    price_s=0.1,
    worker=WorkerSpec(command=("true",)),
    exclusive=True,
)
ROBOTS = ("robot1", "robot2", "robot3")


def fleet(*candidates: str) -> Fleet:
    return fleet_of(replace(TASK, candidates=candidates), of=sorted({*candidates, *ROBOTS}), electors=ROBOTS)


def started(*candidates: str) -> tuple[Simulator, str]:
    """A fleet whose exclusive worker works, and its owner."""
    sim = Simulator(fleet=fleet(*candidates), seed=1)
    sim.start()
    assert sim.run_until(lambda: working(sim) != "", 20.0)
    return sim, working(sim)


def working(sim: Simulator) -> str:
    name, until = sim.working.get("guard", ("", -math.inf))
    return name if until > sim.now else ""


def slewed(sim: Simulator, name: str, seconds: float, size: float = 0.083) -> None:
    """From now on the watch of a machine reports a slew, for so long; time goes on by ``run``."""
    machine = sim.machines[name]
    slew(size, seconds, tell=lambda event: sim.deliver(machine, event), later=sim.later, is_over=lambda: False)


# --- the judgement ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("event", "is_in_doubt"),
    [
        (WELL, False),
        (replace(WELL, error_ratio=RHO), False),
        (replace(WELL, error_ratio=RHO * 1.01), True),
        (replace(WELL, error_ratio=-RHO * 1.01), True),
        (replace(WELL, jump_s=JUMP_S), False),
        (replace(WELL, jump_s=JUMP_S * 1.5), True),
        (replace(WELL, jump_s=-JUMP_S * 1.5), True),
        (replace(WELL, jump_s=0.002, since_s=3.0), False),
        (ClockCompared(error_ratio=0.0, jump_s=60.0), True),
        (ClockCompared(error_ratio=0.0, jump_s=JUMP_S), False),
        (ClockCompared(error_ratio=0.0, jump_s=-JUMP_S), False),
        (ClockCompared(error_ratio=-RHO), False),
    ],
)
def test_a_rate_beyond_the_lease_s_bound_and_a_jump_are_doubts(event: ClockCompared, is_in_doubt: bool) -> None:
    doubt = ClockDoubt()
    assert doubt.absorb(event, 10.0) is is_in_doubt
    assert (doubt.complaint is not None) is is_in_doubt


def test_a_doubt_ends_some_time_after_the_last_bad_comparison() -> None:
    doubt = ClockDoubt()
    doubt.absorb(SLEW, 10.0)
    assert doubt.absorb(WELL, 10.0 + DOUBT_S - 0.01)
    doubt.absorb(SLEW, 11.5)
    assert doubt.absorb(WELL, 10.1 + DOUBT_S)
    assert not doubt.absorb(WELL, 11.5 + DOUBT_S)
    assert doubt.complaint is None


def test_the_operator_reads_what_is_wrong() -> None:
    doubt = ClockDoubt()
    doubt.absorb(SLEW, 10.0)
    assert "slewed by +8.30%" in (doubt.complaint or "")
    doubt.absorb(ClockCompared(error_ratio=0.0, jump_s=60.0), 11.0)
    assert "jumped by +60.000 s" in (doubt.complaint or "")
    doubt.absorb(ClockCompared(error_ratio=RHO, jump_s=60.0), 12.0)
    assert "jumped by +60.000 s" in (doubt.complaint or ""), "so much slew is no fault"


# --- leases ----------------------------------------------------------------------------------------------------------


def beat(node: str, number: int, echoes: tuple[Grant, ...] = (), terms: str = "") -> Beat:
    return beat_of(node, number, learnt=(("guard", 7, 3),), echoes=echoes, lease_terms=terms)


OF_EDGE1 = allocation_of(7, task="guard", epoch=3, tuning=tuning_of(cpu=1.0, memory=0.0))


def test_an_elector_in_doubt_grants_nothing_and_afterwards_begins_as_after_a_start() -> None:
    leases = Leases(
        in_force=InForce(fleet("edge1", "edge2")), me="robot1", incarnation=1, standing={"guard": None}, now=0.0
    )
    accepted = {"guard": ("edge1", 3)}
    assert leases.on_beat(beat("edge1", 5), accepted, 10.0)
    assert leases.on_sent(1, 10.0).echoes
    leases.doubt({"guard": OF_EDGE1})
    leases.on_beat(beat("edge1", 6), accepted, 10.1)
    assert leases.on_sent(2, 10.1).echoes == ()
    assert leases.may_accept("guard", "edge1", 10.2)
    assert not leases.may_accept("guard", "edge2", 1e6)
    assert leases.next_deadline(10.2) == math.inf
    leases.trust({"guard": OF_EDGE1}, 2, 20.0)
    leases.on_beat(beat("edge1", 7), accepted, 20.1)
    assert leases.on_sent(3, 20.1).echoes == ()
    assert not leases.may_accept("guard", "edge2", 20.0 + hold_s(1.0) - 0.001)
    assert leases.may_accept("guard", "edge2", 20.0 + hold_s(1.0))
    assert leases.on_beat(beat("edge1", 8), accepted, 20.0 + hold_s(1.0))


def test_an_owner_in_doubt_holds_no_lease_and_afterwards_only_by_new_beats() -> None:
    leases = Leases(in_force=InForce(fleet("edge1", "edge2")), me="edge1", incarnation=1, standing={}, now=0.0)
    leases.begin("guard", 3, 5)

    def echoed(number: int, now: float) -> None:
        leases.on_sent(number, now)
        grant = Grant(task="guard", owner="edge1", incarnation=1, epoch=3, number=number)
        for elector in ROBOTS[:2]:
            leases.on_beat(beat(elector, number, (grant,), leases.terms), {}, now)

    echoed(5, 10.0)
    assert leases.until("guard") == 11.0
    leases.on_given("guard", 11.0)
    leases.doubt({})
    assert leases.until("guard") == -math.inf
    leases.trust({}, 6, 12.1)
    assert leases.until("guard") == -math.inf
    echoed(6, 12.1)
    assert leases.until("guard") == -math.inf, "sent before the clock was trusted again"
    assert leases.given_until("guard") == 11.0, "so long the worker may have been at it"
    echoed(7, 12.2)
    assert leases.until("guard") == pytest.approx(13.2)


def test_beats_say_so_and_the_others_take_it_for_other_terms() -> None:
    mine = Leases(in_force=InForce(fleet("edge1", "edge2")), me="edge1", incarnation=1, standing={}, now=0.0)
    other = Leases(in_force=InForce(fleet("edge1", "edge2")), me="robot1", incarnation=1, standing={}, now=0.0)
    mine.doubt({})
    other.on_beat(beat("edge1", 5, terms=mine.terms_told), {}, 10.0)
    assert "clock in doubt" in other.unfit()["edge1"].why
    mine.trust({}, 5, 12.0)
    other.on_beat(beat("edge1", 6, terms=mine.terms_told), {}, 12.0)
    assert other.unfit() == {}
    assert mine.terms_told == mine.terms


# --- a fleet ---------------------------------------------------------------------------------------------------------


def test_an_owner_s_worker_stops_at_once_and_the_task_goes_to_a_node_whose_clock_is_right() -> None:
    sim, owner = started("edge1", "edge2")
    slewed(sim, owner, 20.0)
    sim.run(0.1)
    assert working(sim) == ""
    assert sim.machines[owner].roles["guard"].role is WorkerRole.IDLE
    assert "slewed" in sim.node(owner).problems["clock", ""]
    assert sim.run_until(lambda: working(sim) not in ("", owner), 10.0)
    sim.run(25.0)
    assert ("clock", "") not in sim.node(owner).problems
    assert sim.unsettled() == ""


def test_nobody_is_sent_to_a_node_whose_clock_is_in_doubt() -> None:
    sim, owner = started("edge1", "edge2")
    (other,) = {"edge1", "edge2"} - {owner}
    sim.run(5.0)
    slewed(sim, other, 20.0)
    sim.run(3.0)
    order = MoveTask(task="guard", node=other, asked=Asked(by="ada@robot1"))
    sim.deliver(sim.machines["robot1"], MoveCommanded(request=1, command=order))
    sim.run(1.0)
    (answer,) = (one.result for one in sim.answers if one.request == 1)
    assert answer.detail == f"{other} cannot have it: clock in doubt"
    assert working(sim) == owner


@pytest.mark.parametrize("hold", ["pin", "low battery"])
def test_nothing_that_waits_for_something_better_keeps_a_task_on_an_owner_whose_clock_is_in_doubt(hold: str) -> None:
    """It stood still for as long as the doubt lasted: only a planned move left it, and its margins still counted."""
    of = fleet("edge1", "edge2")
    tuning = tuning_of(cpu=1.0, memory=0.0, score=ScoreForm.SERVICE)
    limits = (("battery", 0.2),) if hold == "low battery" else ()
    task = replace(of.tasks[0], tuning=tuning, gauge_limits=limits)
    charge = {"edge2": (("battery", 0.22),)} if limits else {}
    sim = Simulator(fleet=replace(of, tasks=(task,)), seed=1, gauges=lambda node, _now: charge.get(node, ()))
    sim.start("edge1", *ROBOTS)
    assert sim.run_until(lambda: working(sim) == "edge1", 20.0)
    sim.start("edge2")
    if hold == "pin":
        order = HoldTask(task="guard", hold=Hold.PIN, node="edge1", asked=Asked(by="ada@robot1"))
        sim.deliver(sim.machines["robot1"], HoldCommanded(request=1, command=order))
    sim.run(12.0)
    assert working(sim) == "edge1"
    slewed(sim, "edge1", 40.0)
    assert sim.run_until(lambda: working(sim) == "edge2", 5.0)


@pytest.mark.parametrize(("slept_s", "error_s"), [(0.5, 0.0), (3.0, 0.0), (3.0, 0.9), (3.0, -0.9), (60.0, 0.0)])
def test_an_owner_that_wakes_from_sleep_stops_and_begins_again_like_one_that_has_just_started(
    slept_s: float, error_s: float
) -> None:
    """Its clock may be wrong by what it misjudges its sleep: the watch sees that there was one."""
    sim, owner = started("edge1", "edge2")
    sim.suspend(sim.machines[owner], slept_s, error_s)
    sim.run(slept_s + 1.5 * LOOK_S)
    assert f"jumped by {slept_s + error_s:+.3f} s" in sim.node(owner).problems["clock", ""]
    assert sim.machines[owner].roles["guard"].role is WorkerRole.IDLE
    assert working(sim) != owner
    sim.run(DOUBT_S - LOOK_S)
    assert "jumped" in sim.node(owner).problems["clock", ""], "and it is no slew to anybody who looks a little later"
    sim.run(10.0)
    assert ("clock", "") not in sim.node(owner).problems
    assert working(sim) != "", "somebody works"


def test_an_elector_that_wakes_from_sleep_grants_nothing_for_a_while() -> None:
    sim, owner = started("edge1", "edge2")
    sim.suspend(sim.machines[ROBOTS[0]], 3.0, 0.5)
    sim.run(3.0 + 1.5 * LOOK_S)
    assert sim.node(ROBOTS[0]).problems["clock", ""]
    for _ in range(60):
        sim.run(0.1)
        assert working(sim) == owner, "the others' grants are enough"


@pytest.mark.parametrize("after_s", [0.3, 0.5, 0.7, 0.9])
def test_an_elector_that_wakes_judges_nothing_by_the_time_before_it_hears_of_its_sleep(after_s: float) -> None:
    """It counts 0.9 s too much, and the beat of its owner's next life waits: the former life's lease still runs."""
    sim = Simulator(fleet=replace(fleet("edge1", *ROBOTS), electors=("robot1",)), seed=1)
    sim.start()
    assert sim.run_until(lambda: working(sim) != "", 20.0)
    owner = working(sim)
    assert owner != "robot1", "the elector is another machine"
    sim.crash(owner)
    sim.start(owner)
    sim.run(after_s)
    sim.suspend(sim.machines["robot1"], 0.15, 0.9)
    sim.run(3.0)  # the simulator finds two lives that work at the same time
    assert sim.run_until(lambda: working(sim) != "", 20.0)


def test_the_only_candidate_works_again_once_its_clock_is_right() -> None:
    sim, owner = started("edge1")
    slewed(sim, owner, 3.0)
    sim.run(3.0)
    assert working(sim) == ""
    assert sim.run_until(lambda: working(sim) == owner, DOUBT_S + 2 * LOOK_S + 1.0)
    assert sim.agreed("guard") == owner


def test_a_majority_of_electors_in_doubt_keeps_nobody_at_work() -> None:
    sim, _ = started("edge1", "edge2")
    for name in ROBOTS[:2]:
        slewed(sim, name, 6.0)
    sim.run(1.5)
    assert working(sim) == ""
    assert sim.run_until(lambda: working(sim) != "", 15.0)


def test_one_elector_in_doubt_is_not_missed() -> None:
    sim, owner = started("edge1", "edge2")
    slewed(sim, ROBOTS[0], 6.0)
    for _ in range(60):
        sim.run(0.1)
        assert working(sim) == owner


def test_tasks_that_are_not_exclusive_do_not_mind() -> None:
    shared = replace(fleet("edge1", "edge2"), tasks=(replace(TASK, exclusive=False),))
    sim = Simulator(fleet=shared, seed=1)
    sim.start()
    sim.run(10.0)
    owner = sim.agreed("guard")
    assert owner is not None
    slewed(sim, owner, 5.0)
    sim.run(5.0)
    assert sim.agreed("guard") == owner
    assert sim.node(owner).worker_states["guard"] is WorkerState.READY
    assert ("clock", "") not in sim.node(owner).problems


def test_a_doubt_is_no_problem_any_more_where_nothing_is_exclusive_any_more() -> None:
    """The operator has done about it what can be done, and the clock stays as it is."""
    sim, _ = started("edge1", "edge2")
    robot = ROBOTS[0]
    slewed(sim, robot, 8.0)
    sim.run(1.0)
    assert "slewed" in sim.node(robot).problems["clock", ""]
    shared = replace(sim.fleet, tasks=(replace(*sim.fleet.tasks, exclusive=False),))
    for machine in sim.machines.values():
        machine.fleet = shared
        sim.reload(machine)
    assert sim.run_until(lambda: ("clock", "") not in sim.node(robot).problems, 5.0), "its clock is still slewed"
    leases = sim.node(robot).agreement.leases
    assert leases.is_in_doubt
    assert sim.run_until(lambda: not leases.is_in_doubt, 8.0 + DOUBT_S), "it told the others so for ever"


def test_an_owner_of_two_exclusive_tasks_stops_both_and_works_on_both_again() -> None:
    both = replace(fleet("edge1"), tasks=tuple(replace(TASK, name=name, candidates=("edge1",)) for name in ("a", "b")))
    sim = Simulator(fleet=both, seed=1)
    sim.start()

    def at_work() -> set[str]:
        return {task for task, (_, until) in sim.working.items() if until > sim.now}

    assert sim.run_until(lambda: at_work() == {"a", "b"}, 20.0)
    slewed(sim, "edge1", 3.0)
    sim.run(0.1)
    assert at_work() == set()
    assert {role.role for role in sim.machines["edge1"].roles.values()} == {WorkerRole.IDLE}
    assert sim.run_until(lambda: at_work() == {"a", "b"}, 10.0)
