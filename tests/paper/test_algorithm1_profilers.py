"""Algorithm 1, "Resource Profilers and Gateways", with the paper's sentences on profiling."""

from __future__ import annotations

import itertools
import math

import pytest

from support.fleets import fleet_of, task_of, tuning_of
from support.profiles import SAMPLE
from zsched.core.gateway.gateway import Gateway
from zsched.core.profile.profile import Profiler
from zsched.core.values.fleet import Timing
from zsched.core.values.in_force import InForce
from zsched.core.values.profile import DeviceSample, LinkSample, LinkSource, Profile

TIMING = Timing()
FLEET = fleet_of(
    task_of(tuning=tuning_of(cpu=0.5, memory=0.25, network=0.25)), of=("edge1", "edge2", "robot1", "robot2")
)


def sampled(profiler: Profiler, now: float, *, cpu: float = 1.0, memory: float = 1000.0, rssi: float = -60.0) -> None:
    device = DeviceSample(cpu_cores=4.0, cpu_used_cores=cpu, memory_mb=4000.0, memory_used_mb=memory)
    profiler.absorb(device, (LinkSample(source=LinkSource.WIRELESS, rssi_dbm=rssi),), now)


def published(profiler: Profiler, now: float) -> Profile:
    profile = profiler.publishable({}, is_draining=False, now=now)
    assert profile is not None
    return profile


def test_a_profiler_on_every_edge_measures_beta_mu_and_lambda() -> None:
    """Alg. 1: get beta (CPU), mu (memory) and lambda (RSSI) for each edge."""
    profiler = Profiler("edge1", 1, TIMING)
    sampled(profiler, 0.0, cpu=1.5, memory=1200.0, rssi=-55.0)
    profile = published(profiler, 0.0)

    assert (profile.cpu_cores, profile.cpu_used_cores) == (4.0, 1.5)
    assert (profile.memory_mb, profile.memory_used_mb) == (4000.0, 1200.0)
    assert profile.links[0].rssi_dbm == -55.0


def test_the_network_profiler_measures_each_link_for_itself() -> None:
    """Sec. III-D: the RSSI from each edge device or nearby router respective to each individual robot."""
    profiler = Profiler("robot1", 1, TIMING)
    links = tuple(
        LinkSample(source=LinkSource.NL80211, peer=peer, rssi_dbm=rssi)
        for peer, rssi in ((None, -60.0), ("edge1", -50.0), ("edge2", -70.0))
    )
    profiler.absorb(SAMPLE, links, 0.0)

    seen = {link.peer: link.rssi_dbm for link in published(profiler, 0.0).links}
    assert seen == {None: -60.0, "edge1": -50.0, "edge2": -70.0}


def test_profilers_are_continually_active() -> None:
    """Sec. III-D: three profilers are continually active; each step presents a snapshot of what changes."""
    profiler = Profiler("edge1", 1, TIMING)
    seen = []
    for tick in range(51):
        now = tick * TIMING.sample_s
        sampled(profiler, now, cpu=1.0 if tick < 25 else 3.0)
        profile = profiler.publishable({}, is_draining=False, now=now)
        if profile is not None:
            seen.append((now, profile.sequence, profile.cpu_used_cores or 0.0))

    gaps = [later[0] - earlier[0] for earlier, later in itertools.pairwise(seen)]
    assert max(gaps) <= TIMING.publish_s + TIMING.sample_s
    assert [sequence for _, sequence, _ in seen] == list(range(len(seen)))
    assert seen[-1][2] > 1.0 + 2.0 * (1 - math.exp(-1.0)), "the load of five seconds shows"


def test_profiles_are_smoothed_by_elapsed_time_where_they_are_measured() -> None:
    """Reading: a momentary peak of a shared processor is no reason to move (EWMA, time constant 1 s)."""
    profiler = Profiler("edge1", 1, TIMING)
    sampled(profiler, 0.0, cpu=1.0)
    sampled(profiler, 0.2, cpu=4.0)

    assert published(profiler, 0.2).cpu_used_cores == pytest.approx(
        1.0 + 3.0 * (1 - math.exp(-0.2 / TIMING.smoothing_s))
    )


def test_every_robot_s_gateway_holds_edge_data_of_every_edge() -> None:
    """Alg. 1: for each robot a gateway, for each edge its data, republished with respect to the edge."""
    profilers = {name: Profiler(name, 1, TIMING) for name in ("edge1", "edge2")}
    gateways = [Gateway(InForce(FLEET)) for _ in FLEET.voters]
    for at, (name, profiler) in enumerate(profilers.items()):
        sampled(profiler, 0.0, cpu=1.0 + at)
        profile = published(profiler, 0.0)
        for gateway in gateways:
            assert gateway.absorb(profile, 0.1) is None
        assert profile.node == name

    for gateway in gateways:
        used = [gateway.fresh(name, 0.5) for name in profilers]
        assert [profile.cpu_used_cores for profile in used if profile is not None] == [1.0, 2.0]


def test_gateways_keep_the_most_updated_data() -> None:
    """Sec. V, Gateways: they keep the most updated data about the current state; late ones do not overwrite it."""
    profiler = Profiler("edge1", 1, TIMING)
    sampled(profiler, 0.0, cpu=1.0)
    first = published(profiler, 0.0)
    sampled(profiler, 60.0, cpu=3.0)
    second = published(profiler, 60.0)
    gateway = Gateway(InForce(FLEET))

    assert gateway.absorb(second, 60.0) is None
    assert gateway.absorb(first, 60.1) == "stale"
    data = gateway.newest("edge1", 61.0)
    assert data is not None
    assert data.profile is second
    assert data.age_s == pytest.approx(1.0)


def test_data_that_is_too_old_describes_nothing_any_more() -> None:
    """Reading of "most updated": edge data has an age, and beyond its time to live it is not used."""
    profiler = Profiler("edge1", 1, TIMING)
    sampled(profiler, 0.0)
    gateway = Gateway(InForce(FLEET))
    gateway.absorb(published(profiler, 0.0), 0.0)

    assert gateway.fresh("edge1", TIMING.profile_ttl_s) is not None
    assert gateway.fresh("edge1", TIMING.profile_ttl_s + 0.1) is None
