from __future__ import annotations

import math
from dataclasses import replace

import pytest

from support.fleets import fleet_of, task_of
from support.profiles import load_of, profile_of
from zsched.core.gateway.demand import Amount
from zsched.core.gateway.gateway import EdgeData, Gateway
from zsched.core.values.fleet import Demand
from zsched.core.values.in_force import InForce
from zsched.core.values.profile import Jobs, Profile, WorkerState

TASK = task_of(demand=Demand(cpu_cores=0.4, memory_mb=250.0))
FLEET = fleet_of(TASK, of=("edge1", "edge2", "robot1"), electors=("robot1",))
TTL_S = FLEET.timing.profile_ttl_s


def profile(
    sequence: int = 0,
    *,
    node: str = "edge1",
    incarnation: int = 1,
    cpu: float | None = 1.0,
    state: WorkerState = WorkerState.READY,
    used: tuple[float | None, float | None] = (0.5, 300.0),
) -> Profile:
    return profile_of(
        node,
        incarnation=incarnation,
        sequence=sequence,
        cpu_used_cores=cpu,
        workers=(load_of(state=state, cpu_cores=used[0], memory_mb=used[1]),),
    )


def gateway_with(*profiles: Profile, now: float = 0.0) -> Gateway:
    gateway = Gateway(InForce(FLEET))
    for one in profiles:
        assert gateway.absorb(one, now) is None
    return gateway


def test_what_is_fresh_now_is_fresh_until_then_also_at_the_very_end() -> None:
    gateway = gateway_with(profile(0))
    for now in (0.0, TTL_S):
        assert gateway.fresh("edge1", now) is not None
        assert gateway.fresh_until(now) == TTL_S
    assert gateway.fresh_until(TTL_S + 0.001) == math.inf


def test_a_battery_is_remembered_for_its_node_s_life_and_for_as_long_as_the_node_is_in_the_fleet() -> None:
    full = replace(profile(0), gauges=(("battery", 0.6), ("gpu", 0.3), ("wind", 5.0)))
    gateway = gateway_with(full)
    assert gateway.readings(full) == {"battery": 0.6, "gpu": 0.3}
    for sequence, gauges, known in (
        (1, (), {"battery": 0.6}),
        (2, (("battery", 7.0),), {"battery": 0.6}),  # a driver's fault
        (3, (("battery", 0.5),), {"battery": 0.5}),
        (4, (("temperature_c", 50.0),), {"battery": 0.5, "temperature_c": 50.0}),
    ):
        one = replace(profile(sequence), gauges=gauges)
        assert gateway.absorb(one, float(sequence)) is None
        assert gateway.readings(one) == known
    gateway._in_force.take(fleet_of(TASK, of=("edge2", "robot1"), electors=("robot1",)))
    gateway._in_force.take(FLEET)
    assert gateway.readings(profile(5)) == {}
    assert gateway.absorb(profile(6), 20.0) is None
    assert gateway.readings(profile(6)) == {}


# --- newest, fresh -------------------------------------------------------------------------------------------------


def test_newest_profile_is_kept_with_its_age_since_we_received_it() -> None:
    gateway = gateway_with(profile(0), profile(1), now=10.0)

    assert gateway.newest("edge1", now=12.5) == EdgeData(profile=profile(1), age_s=2.5)
    assert gateway.newest("edge2", now=12.5) is None


@pytest.mark.parametrize(
    ("late", "is_stale"),
    [
        (profile(4, incarnation=2), True),
        (profile(5, incarnation=2), True),
        (profile(6, incarnation=2), False),
        (profile(0, incarnation=3), False),
    ],
)
def test_older_and_repeated_profiles_are_stale_a_restart_is_newer(late: Profile, *, is_stale: bool) -> None:
    """Order is (incarnation, sequence): a restarted node counts from 0 again."""
    current = profile(5, incarnation=2)
    gateway = gateway_with(current)

    assert gateway.absorb(late, 1.0, life=late.incarnation) == ("stale" if is_stale else None)
    newest = gateway.newest("edge1", 1.0)
    assert newest is not None
    assert newest.profile == (current if is_stale else late)


@pytest.mark.parametrize("forged", [profile(10**9), profile(0, incarnation=10**9), profile(15)])
def test_one_forged_profile_does_not_silence_its_node(forged: Profile) -> None:
    """A number far ahead, or of another life than the beats show, is not believed; one a little ahead is overtaken."""
    gateway = gateway_with(profile(5))
    said = gateway.absorb(forged, 0.5, life=1)
    assert said == (None if forged.sequence == 15 else "doubtful")
    for step in range(1, 4):
        gateway.absorb(profile(5 + step), float(step), life=1)
    newest = gateway.newest("edge1", 3.0)
    assert newest is not None
    assert newest.profile == profile(8)


def test_a_stale_repeat_does_not_make_the_profile_younger() -> None:
    gateway = gateway_with(profile(5))
    gateway.absorb(profile(5), TTL_S)

    assert gateway.fresh("edge1", TTL_S + 0.1) is None


# --- demand (more of it: test_demand.py) ---------------------------------------------------------------------------


def test_an_owner_without_a_fresh_profile_or_worker_is_not_learnt_from() -> None:
    gateway = gateway_with(profile(used=(1.5, 600.0)))
    gateway.learn_demand("merge", "edge1", TTL_S + 1.0)
    gateway.learn_demand("merge", "edge2", 0.0)
    gateway.learn_demand("other", "edge1", 0.0)

    assert gateway.demand(TASK, profile()) == TASK.demand

    gateway.learn_demand("merge", "edge1", TTL_S)
    assert gateway.demand(TASK, profile()) == Amount(cpu_cores=1.5, memory_mb=600.0)


@pytest.mark.parametrize("is_gone", [True, False])
def test_a_quicker_machine_that_is_gone_does_not_set_the_need(*, is_gone: bool) -> None:
    """Jobs that also wait for a disk, on a slow core: it needs what the quickest machine that is there would do."""
    task = task_of(candidates=("edge1", "edge2"))
    gateway = Gateway(InForce(fleet_of(task, of=("edge1", "edge2", "robot1"), electors=("robot1",))))
    quick = profile_of("edge2", speed=4.0)
    jobs = Jobs(time_s=0.2, cpu_s=0.15, wait_s=0.0, done_hz=5.0, wanted_hz=10.0)
    load = load_of(cpu_cores=0.75, runnable=0.75, jobs=jobs)
    slow = profile_of(speed=1.0, cpu_used_cores=0.75, runnable=0.75, workers=(load,))
    gateway.absorb(quick, 0.0)
    for sequence in range(30):
        now = 100.0 + sequence
        gateway.absorb(replace(slow, sequence=sequence), now)
        if not is_gone:
            gateway.absorb(replace(quick, sequence=sequence + 2), now)
        gateway.learn_demand("merge", "edge1", now)
    need = gateway.demand(task, slow).cpu_cores
    assert need == pytest.approx(0.75 if is_gone else 1.5, rel=0.05)


def test_profiles_are_fresh_together_until_the_first_of_them_is_not() -> None:
    gateway = gateway_with(profile(0))
    assert gateway.absorb(profile(0, node="edge2"), 1.0) is None
    assert gateway.fresh_until(1.0) == TTL_S
    assert gateway.fresh_until(TTL_S + 0.5) == TTL_S + 1.0


def test_a_changed_fleet_keeps_the_profiles_of_the_nodes_that_stay() -> None:
    gateway = gateway_with(profile(5), profile(5, node="edge2"))
    gateway._in_force.take(fleet_of(task_of(candidates=("edge1",)), of=("edge1", "robot1"), electors=("robot1",)))
    assert gateway.fresh("edge1", 1.0) == profile(5)
    assert gateway.absorb(profile(4), 1.0) == "stale"
    assert gateway.newest("edge2", 1.0) is None
    assert gateway.absorb(profile(6, node="edge2"), 1.0) == "foreign"
