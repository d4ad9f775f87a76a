from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import is_dataclass
from inspect import Parameter, signature

import pytest

from zsched.core.values import beat as beat_values
from zsched.core.values import model
from zsched.core.values import profile as profile_values
from zsched.core.values.beat import Beat
from zsched.core.values.model import (
    MAX_COUNTER,
    MAX_REASON,
    Allocation,
    Ballot,
    Proposal,
    Tuning,
    Utility,
    UtilityVector,
    Weights,
    as_reason,
    check_name,
)
from zsched.core.values.profile import Link, LinkSource, Profile, WorkerLoad, WorkerState

EVEN = Weights(cpu=0.5, memory=0.25, network=0.25)


def make_profile(
    *, node: str = "edge1", cpu_cores: float = 4.0, cpu_used: float | None = 1.0, memory_mb: float = 4000.0
) -> Profile:
    return Profile(
        node=node,
        incarnation=1,
        sequence=0,
        cpu_cores=cpu_cores,
        cpu_used_cores=cpu_used,
        memory_mb=memory_mb,
        memory_used_mb=None,
        workers=(WorkerLoad(task="merge", state=WorkerState.READY),),
    )


def make_allocation(*, revision: int = 0, epoch: int = 0, owner: str | None = None) -> Allocation:
    return Allocation(task="merge", revision=revision, epoch=epoch, owner=owner, tuning=Tuning(weights=EVEN))


def make_proposal(*, voter: str = "robot1", aggregate: float = 0.5) -> Proposal:
    return Proposal(voter=voter, task="merge", base_revision=0, candidate="edge1", aggregate=aggregate)


def make_beat(*, node: str = "edge1", sequence: int = 0, lag: float = 0.0) -> Beat:
    return Beat(node=node, incarnation=0, sequence=sequence, loop_lag_s=lag)


def make_load(cpu: float | None, memory: float | None) -> WorkerLoad:
    return WorkerLoad(task="merge", state=WorkerState.READY, cpu_cores=cpu, memory_mb=memory)


@pytest.mark.parametrize("name", ["", "-a", "_a", "Edge", "a/b", "a*", "a" * 64, "edge 1", "edge1\n", "é"])
def test_other_names_are_refused_with_the_field_named(name: str) -> None:
    with pytest.raises(ValueError, match=r"^node: "):
        check_name("node", name)


@pytest.mark.parametrize(
    ("build", "field"),
    [
        (lambda: Weights(cpu=1.1, memory=0.0, network=-0.1), "weights.cpu"),
        (lambda: Weights(cpu=0.5, memory=-0.5, network=1.0), "weights.memory"),
        (lambda: Weights(cpu=0.5, memory=0.5, network=math.nan), "weights.network"),
        (lambda: Weights(cpu=0.5, memory=0.5, network=0.5), "weights: the sum is 1.5"),
        (lambda: Weights(cpu=0.0, memory=0.0, network=0.0), "weights: the sum is 0"),
        (lambda: Weights(cpu=0.5, memory=0.5, network=2e-6), "weights: the sum"),
        (lambda: Tuning(weights=EVEN, bonus=-0.01), "bonus"),
        (lambda: Tuning(weights=EVEN, bonus=1.01), "bonus"),
        (lambda: Link(source=LinkSource.FIXED, rssi_dbm=1.0), "link.rssi_dbm"),
        (lambda: Link(source=LinkSource.FIXED, rssi_dbm=-121.0), "link.rssi_dbm"),
        (lambda: Link(source=LinkSource.FIXED, bitrate_mbps=-1.0), "link.bitrate_mbps"),
        (lambda: Link(source=LinkSource.FIXED, retry_ratio=1.1), "link.retry_ratio"),
        (lambda: Link(source=LinkSource.FIXED, peer="Not A Name"), "link.peer"),
        (lambda: make_load(-1.0, None), "worker.cpu_cores"),
        (lambda: make_load(None, -1.0), "worker.memory_mb"),
        (lambda: make_profile(node="Edge"), "profile.node"),
        (lambda: make_profile(cpu_cores=0.0), "profile.cpu_cores"),
        (lambda: make_profile(cpu_used=-0.1), "profile.cpu_used_cores"),
        (lambda: make_profile(cpu_used=math.nan), "profile.cpu_used_cores"),
        (lambda: make_profile(memory_mb=0.5), "profile.memory_mb"),
        (lambda: Utility(candidate="edge1", value=1.01), "utility.value"),
        (lambda: Utility(candidate="edge1", value=-0.01), "utility.value"),
        (lambda: Utility(candidate="Edge", value=0.5), "utility.candidate"),
        (lambda: Utility(candidate="edge1", value=0.5, cpu=1.01), "utility.cpu"),
        (lambda: Utility(candidate="edge1", value=0.5, cpu=-0.01), "utility.cpu"),
        (lambda: Utility(candidate="edge1", value=0.5, memory=1.01), "utility.memory"),
        (lambda: Utility(candidate="edge1", value=0.5, memory=-0.01), "utility.memory"),
        (lambda: Utility(candidate="edge1", value=0.5, network=1.01), "utility.network"),
        (lambda: Utility(candidate="edge1", value=0.5, network=-0.1), "utility.network"),
        (lambda: UtilityVector(voter="", task="merge", revision=0, utilities=()), "vector.voter"),
        (lambda: UtilityVector(voter="robot1", task="merge", revision=-1, utilities=()), "vector.revision"),
        (lambda: make_proposal(aggregate=2.1), "proposal.aggregate"),
        (lambda: make_proposal(voter="*"), "proposal.voter"),
        (lambda: make_allocation(revision=-1), "allocation.revision"),
        (lambda: make_allocation(epoch=MAX_COUNTER + 1), "allocation.epoch"),
        (lambda: make_allocation(owner=""), "allocation.owner"),
        (lambda: Ballot(counter=-1, node="a", incarnation=0), "ballot.counter"),
        (lambda: Ballot(counter=0, node="A", incarnation=0), "ballot.node"),
        (lambda: make_beat(node="a b"), "beat.node"),
        (lambda: make_beat(sequence=-1), "beat.sequence"),
        (lambda: make_beat(lag=math.nan), "beat.loop_lag_s"),
    ],
)
def test_out_of_range_is_refused_with_the_field_named(build: Callable[[], object], field: str) -> None:
    with pytest.raises(ValueError, match=f"^{field}"):
        build()


def test_weights_sum_to_one_within_float_error() -> None:
    assert Weights(cpu=0.1, memory=0.2, network=0.7).network == 0.7
    third = 1 / 3
    assert Weights(cpu=third, memory=third, network=third).cpu == third


def test_values_are_frozen_slotted_and_keyword_only() -> None:
    """No object is ever shared with an adapter that could change it."""
    modules = (model, profile_values, beat_values)
    found = [cls for module in modules for cls in vars(module).values() if isinstance(cls, type) and is_dataclass(cls)]
    values = [cls for cls in found if cls.__module__ in {module.__name__ for module in modules}]
    assert len(values) > 15
    for cls in values:
        assert not cls.__dictoffset__, cls
        assert {one.kind for one in signature(cls).parameters.values()} <= {Parameter.KEYWORD_ONLY}, cls
    profile = make_profile()
    with pytest.raises(AttributeError):
        profile.sequence = 2  # type: ignore[misc]  # that is the point


@pytest.mark.parametrize(("length", "is_cut"), [(MAX_REASON, False), (MAX_REASON + 1, True)])
def test_a_reason_is_cut_where_it_is_too_long(length: int, *, is_cut: bool) -> None:
    reason = as_reason("x" * length)
    assert len(reason) == MAX_REASON
    assert reason.endswith("…") is is_cut
