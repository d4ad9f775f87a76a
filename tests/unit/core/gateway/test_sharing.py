"""What a task would get of a machine that is full: fair shares, and what it was seen to get there."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from support.profiles import load_of, profile_of
from zsched.core.gateway.sharing import COUNTED_S, LEFT_S, Shares, fair_share
from zsched.core.values.profile import Jobs, Profile, WorkerLoad, WorkerState


def idle(node: str = "edge1", *, runnable: float = 8.0) -> Profile:
    """Of a node where the task's worker is ready and does nothing."""
    return profile(runnable=runnable, got=0.0, node=node)


def profile(
    *, runnable: float | None = 8.0, got: float | None = 1.0, wanted: float | None = None, node: str = "edge1"
) -> Profile:
    return profile_of(
        node, cpu_used_cores=4.0, workers=(load_of(cpu_cores=got, wanted_cores=wanted),), runnable=runnable
    )


def test_by_its_need_until_it_was_seen_to_lack_cpu_then_by_its_threads() -> None:
    shares = Shares()
    assert shares.at("merge", idle("edge2"), 2.0) == pytest.approx(4.0 * 2 / 10)
    assert shares.at("merge", idle("edge2"), 0.3) == pytest.approx(4.0 / 9), "one thread at least"
    assert not shares.learn("merge", profile(got=0.7), 0.0), "it has what it wants"
    assert shares.learn("merge", profile(got=2.0, wanted=4.0), 0.0)
    assert shares.at("merge", idle("edge2"), 0.3) == pytest.approx(4.0 * 4 / 12)


@pytest.mark.parametrize("state", [WorkerState.STARTING, WorkerState.STOPPED, WorkerState.FAILED])
def test_a_worker_that_starts_again_tells_nothing_of_the_task_s_threads(state: WorkerState) -> None:
    """It loads a model by one thread for some seconds; its four threads are as many afterwards."""
    shares = Shares()
    shares.learn("merge", profile(got=2.0, wanted=4.0), 0.0)
    before = shares.at("merge", idle("edge2"), 4.0)
    starting = profile(got=0.1, wanted=1.0)
    load = replace(starting.workers[0], state=state)
    assert not shares.learn("merge", replace(starting, workers=(load,)), 0.0)
    assert before == shares.at("merge", idle("edge2"), 4.0)


def test_what_comes_shares_as_well_and_nobody_counted_is_nothing() -> None:
    assert Shares().at("merge", idle("edge2"), 2.0, coming_cores=6.0) == pytest.approx(4.0 * 2 / 16)
    assert Shares().at("merge", profile(runnable=None), 2.0) == 0.0
    assert not Shares().learn("merge", profile(runnable=None, wanted=3.0), 0.0)


def test_where_it_got_less_than_its_share_that_is_believed_of_this_machine_only() -> None:
    """Groups with weights of their own: 4 threads of 8 got a quarter of what is fair."""
    shares = Shares()
    shares.learn("merge", profile(got=0.5, wanted=4.0), 0.0)
    fair = 4.0 * 4 / 12
    assert shares.at("merge", idle(), 4.0) == pytest.approx(fair / 4)
    assert shares.at("merge", idle("edge2"), 4.0) == pytest.approx(fair)
    shares.learn("merge", profile(got=9.0, wanted=4.0), 0.0)
    assert shares.at("merge", idle(), 4.0) == pytest.approx(fair), "the newest counts, and no more than is fair"


def test_what_it_got_counts_as_a_part_of_what_as_many_threads_would_get_by_fairness() -> None:
    shares = Shares()
    shares.learn("merge", profile(got=0.25, wanted=0.95), 0.0)
    assert shares.at("merge", idle("edge2"), 0.25) == pytest.approx(4.0 / 9), "one thread, never less"
    assert shares.at("merge", idle(), 0.25) == pytest.approx(4.0 / 9 / 2), "beside seven others half a core is fair"
    shares.learn("merge", profile(runnable=2.0, got=2.0, wanted=4.0), 0.0)
    assert shares.at("merge", idle(runnable=0.0), 0.25) == pytest.approx(2.0), "the machine is the task's alone"


@pytest.mark.parametrize("need_cores", [0.3, 2.0])
def test_where_the_task_runs_it_does_not_count_among_the_others(need_cores: float) -> None:
    """Else the same machine would give it less as soon as it has the task, and another one like it be better."""
    alone = Shares().at("merge", idle(runnable=3.0), need_cores)
    assert Shares().at("merge", profile(runnable=3.0 + 0.6, got=0.6), need_cores) == pytest.approx(alone)
    assert Shares().at("merge", profile(runnable=0.2, got=0.6), 2.0) == pytest.approx(2.0), "there are no others"


def of(load: WorkerLoad, runnable: float, *, used: float = 4.0) -> Profile:
    return profile_of("edge1", cpu_used_cores=used, workers=(load,), runnable=runnable)


TOLD = Jobs(time_s=0.2, cpu_s=0.1, wait_s=0.1, done_hz=4.0, wanted_hz=4.0)


@pytest.mark.parametrize(
    "load",
    [
        load_of(cpu_cores=0.4, runnable=0.8),
        load_of(cpu_cores=0.8, runnable=0.3),  # its children end too soon to be counted
        load_of(jobs=TOLD),  # somebody else has started it
    ],
)
def test_its_threads_that_wait_are_no_others_either(load: WorkerLoad) -> None:
    assert Shares().at("merge", of(load, 3.8), 0.4) == Shares().at("merge", idle(runnable=3.0), 0.4)


@given(st.floats(0.0, 100.0), st.floats(0.1, 20.0), st.floats(0.01, 4.0))
def test_of_an_owner_that_is_short_the_share_is_what_it_gets(others: float, wanted: float, got: float) -> None:
    shares, threads = Shares(), max(wanted, 1.0)
    owner = profile(runnable=threads + others, got=min(got, fair_share(4.0, threads, others)), wanted=threads)
    shares.learn("merge", owner, 0.0)
    assert shares.at("merge", owner, 0.3) == pytest.approx(owner.workers[0].cpu_cores)


@given(st.floats(0.1, 4096.0), st.floats(1.0, 1e4), st.floats(0.0, 1e6), st.floats(0.0, 1e3))
def test_a_share_is_no_more_than_there_is_or_than_the_threads_can_use_and_falls_with_the_others(
    capacity: float, threads: float, others: float, more: float
) -> None:
    share = fair_share(capacity, threads, others)
    assert 0.0 < share <= min(capacity, threads) * (1 + 1e-9)
    assert fair_share(capacity, threads, others + more) <= share
    assert fair_share(capacity, threads + more, others) >= share * (1 - 1e-9)


# --- a worker that nobody measures -----------------------------------------------------------------------------------


def unmeasured(runnable: float | None, *, node: str = "edge1", state: WorkerState | None = None) -> Profile:
    """Of a node whose worker somebody else has started; without a state nobody sees it."""
    workers = () if state is None else (load_of(state=state),)
    return profile_of(node, cpu_used_cores=4.0, workers=workers, runnable=runnable)


def come(shares: Shares, *, others: float | None, runnable: float, state: WorkerState | None = None) -> None:
    """It is elsewhere until 0 s, and from then on here."""
    if others is not None:
        shares.look_elsewhere("merge", unmeasured(others), -1.0)
    for at in range(round(COUNTED_S) + 5):
        shares.learn("merge", unmeasured(runnable, state=state), float(at))


@pytest.mark.parametrize("state", [None, WorkerState.READY])
def test_its_threads_are_those_that_came_with_it(state: WorkerState | None) -> None:
    """Its surplus threads were taken for others', so it fled from itself, without end."""
    shares = Shares()
    come(shares, others=1.0, runnable=6.0, state=state)
    assert shares.beside_unmeasured("merge", unmeasured(6.0), 2.0) == (5.0, 1.0)
    assert shares.beside_unmeasured("merge", unmeasured(9.0), 2.0) == (5.0, 4.0), "who comes later is somebody else"
    assert shares.beside_unmeasured("merge", unmeasured(9.0), 7.0) == (7.0, 2.0)
    assert shares.beside_unmeasured("merge", unmeasured(None), 2.0) is None
    assert shares.beside_unmeasured("merge", unmeasured(6.0, node="edge2"), 2.0) == (2.0, 4.0), "it is not there"


def test_its_threads_are_counted_for_some_seconds_on_the_mean() -> None:
    shares = Shares()
    shares.look_elsewhere("merge", unmeasured(1.0), -1.0)
    assert shares.learn("merge", unmeasured(6.0), 0.0)
    assert shares.learn("merge", unmeasured(4.0), 1.0)
    assert shares.beside_unmeasured("merge", unmeasured(6.0), 2.0) == (4.0, 2.0), "on the mean"
    assert not shares.learn("merge", unmeasured(1.0), COUNTED_S)


def test_of_a_machine_that_was_not_seen_before_all_but_the_need_is_others() -> None:
    shares = Shares()
    come(shares, others=None, runnable=6.0)
    assert shares.beside_unmeasured("merge", unmeasured(6.0), 2.0) == (2.0, 4.0)


def test_a_worker_that_starts_or_is_measured_has_not_come() -> None:
    shares = Shares()
    come(shares, others=1.0, runnable=6.0, state=WorkerState.STARTING)
    assert shares.beside_unmeasured("merge", unmeasured(6.0), 2.0) == (2.0, 4.0)
    shares.look_elsewhere("merge", unmeasured(1.0), 99.0)
    for at in range(20):
        shares.learn("merge", profile(runnable=6.0, got=2.0), 100.0 + at)
    assert shares.beside_unmeasured("merge", unmeasured(6.0), 2.0) == (2.0, 4.0)


def test_it_may_go_on_for_some_seconds_after_it_has_another_owner() -> None:
    shares = Shares()
    come(shares, others=1.0, runnable=6.0)
    for at in (100.0, 100.0 + LEFT_S):
        shares.look_elsewhere("merge", unmeasured(6.0), at)
        assert shares.beside_unmeasured("merge", unmeasured(6.0), 2.0) == (5.0, 1.0)
    shares.learn("merge", unmeasured(6.0), 101.0 + LEFT_S)
    for at in (200.0, 200.0 + LEFT_S):
        shares.look_elsewhere("merge", unmeasured(6.0), at)
        assert shares.beside_unmeasured("merge", unmeasured(6.0), 2.0) == (5.0, 1.0), "it was back for a moment"
    shares.look_elsewhere("merge", unmeasured(2.0), 200.1 + LEFT_S)
    assert shares.beside_unmeasured("merge", unmeasured(6.0), 2.0) == (2.0, 4.0)
    for at in range(300, 320):
        shares.learn("merge", unmeasured(6.0), float(at))
    assert shares.beside_unmeasured("merge", unmeasured(6.0), 2.0) == (4.0, 2.0), "it has come again"
