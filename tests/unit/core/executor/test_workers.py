"""The states of this node's workers, and why they are what they are."""

from __future__ import annotations

from dataclasses import replace

from support.fleets import fleet_of, task_of
from zsched.core.executor.workers import TROUBLE_S, Workers
from zsched.core.values import events as ev
from zsched.core.values.fleet import WorkerSpec
from zsched.core.values.model import MAX_REASON
from zsched.core.values.profile import WorkerState
from zsched.core.values.words import Trouble

CUT = "x" * (MAX_REASON - 1) + "…"


def said(workers: Workers, now: float) -> dict[str, str]:
    return {task: text for task, (_, text) in workers.told(now).items()}


def changed(state: WorkerState, reason: str = "", trouble: Trouble = Trouble.NONE) -> ev.WorkerChanged:
    return ev.WorkerChanged(task="merge", state=state, trouble=trouble, reason=reason)


def test_a_reason_stays_until_the_worker_is_ready_and_is_no_longer_than_can_be_carried() -> None:
    workers = Workers({"merge": WorkerState.STARTING})
    workers.on_changed(changed(WorkerState.STOPPED, "x" * 10_000))
    assert said(workers, 0.0) == {"merge": CUT}
    assert workers.on_changed(changed(WorkerState.STOPPED, "another")) is None, "no news for the journal"
    assert said(workers, 0.0) == {"merge": "another"}
    workers.on_changed(changed(WorkerState.READY, "its token"))
    assert said(workers, 0.0) == {}


def test_a_worker_s_trouble_goes_with_its_reason() -> None:
    workers = Workers({"merge": WorkerState.STARTING})
    story = workers.on_changed(changed(WorkerState.STOPPED, "it crashed", Trouble.AGAIN))
    assert story is not None
    assert story.text == "worker it crashed"
    assert workers.told(0.0) == {"merge": (Trouble.AGAIN, "it crashed")}
    workers.on_changed(changed(WorkerState.STARTING))
    assert workers.told(0.0) == {"merge": (Trouble.AGAIN, "it crashed")}, "nothing else is known"
    assert workers.told(0.0, {"merge": "no lease"}) == {"merge": (Trouble.AGAIN, "it crashed")}
    workers.on_changed(changed(WorkerState.READY))
    assert workers.told(0.0) == {}


def test_a_worker_that_rests_does_so_whatever_else_is_wrong_with_it() -> None:
    workers = Workers({"merge": WorkerState.READY})
    assert workers.told(0.0, {"merge": "no lease"}) == {"merge": (Trouble.RESTS, "no lease")}
    workers.on_troubled(ev.WorkerTroubled(task="merge", count=1, text="ValueError"), 0.0)
    raised = "callback raised once: ValueError"
    assert workers.told(0.0, {"merge": "no lease"}) == {"merge": (Trouble.RESTS, raised)}
    assert workers.told(0.0) == {"merge": (Trouble.NONE, raised)}


def test_a_complaint_of_a_worker_that_is_ready_is_shown_for_a_minute_and_ends_with_it() -> None:
    workers = Workers({"merge": WorkerState.READY})
    workers.on_troubled(ev.WorkerTroubled(task="merge", count=1, text="ValueError: x"), 10.0)
    assert said(workers, 10.0) == {"merge": "callback raised once: ValueError: x"}
    workers.on_troubled(ev.WorkerTroubled(task="merge", count=2088, text="ValueError: x"), 20.0)
    assert said(workers, 20.0 + TROUBLE_S) == {"merge": "callback raised 2088 times: ValueError: x"}
    assert said(workers, 20.1 + TROUBLE_S) == {}
    workers.on_troubled(ev.WorkerTroubled(task="merge", count=2089, text="ValueError: x"), 100.0)
    workers.on_changed(changed(WorkerState.STARTING, "pid 7"))
    workers.on_troubled(ev.WorkerTroubled(task="merge", count=2090, text="late"), 100.0)
    assert said(workers, 100.0) == {"merge": "pid 7"}


def test_a_mistake_of_a_worker_is_shown_as_long_as_it_lives() -> None:
    workers = Workers({"merge": WorkerState.READY})
    workers.on_troubled(ev.WorkerTroubled(task="merge", count=0, text="puts on a/b"), 10.0)
    assert said(workers, 10.0 + 100 * TROUBLE_S) == {"merge": "puts on a/b"}
    workers.on_troubled(ev.WorkerTroubled(task="merge", count=1, text="ValueError"), 20.0)
    assert said(workers, 20.0) == {"merge": "callback raised once: ValueError"}, "which is the worse"
    assert said(workers, 20.1 + TROUBLE_S) == {"merge": "puts on a/b"}
    workers.on_changed(changed(WorkerState.STARTING, "pid 7"))
    workers.on_changed(changed(WorkerState.READY))
    assert said(workers, 20.1 + TROUBLE_S) == {}


def test_a_state_that_is_lost_is_shown_for_a_minute_also_of_a_worker_that_starts() -> None:
    workers = Workers({"merge": WorkerState.STARTING})
    cold = ev.WorkerTroubled(task="merge", count=0, text="began epoch 2 without the state of edge1: late", is_cold=True)
    story = workers.on_troubled(cold, 10.0)
    assert story is not None
    assert (story.stage, story.task) == ("executor", "merge")
    assert story.text == "the worker began epoch 2 without the state of edge1: late"
    workers.on_changed(changed(WorkerState.READY))
    assert said(workers, 10.0 + TROUBLE_S) == {"merge": cold.text}
    assert said(workers, 10.1 + TROUBLE_S) == {}
    assert Workers({}).on_troubled(cold, 0.0) is None


def test_a_worker_that_should_be_started_again_is_told_of_while_it_is_ready() -> None:
    workers = Workers(states={"merge": WorkerState.READY})
    workers.on_outdated(ev.WorkerOutdated(task="merge", reason="x" * 500))
    workers.on_outdated(ev.WorkerOutdated(task="other", reason="not ours"))
    assert said(workers, 0.0) == {"merge": CUT}
    workers.on_troubled(ev.WorkerTroubled(task="merge", count=1, text="ValueError"), 0.0)
    assert said(workers, 0.0) == {"merge": "callback raised once: ValueError"}, "which is the worse"
    assert said(workers, TROUBLE_S + 0.1) == {"merge": CUT}
    workers.on_changed(ev.WorkerChanged(task="merge", state=WorkerState.STOPPED, reason="gone"))
    assert said(workers, 100.0) == {"merge": "gone"}
    workers.on_changed(ev.WorkerChanged(task="merge", state=WorkerState.READY))
    workers.on_outdated(ev.WorkerOutdated(task="merge", reason=""))
    assert said(workers, 100.0) == {}


def test_a_worker_that_should_be_started_again_and_starts_is_not_told_of() -> None:
    workers = Workers(states={"merge": WorkerState.READY})
    workers.on_outdated(ev.WorkerOutdated(task="merge", reason="its file has changed"))
    assert said(workers, 0.0) == {"merge": "its file has changed"}
    workers.on_changed(ev.WorkerChanged(task="merge", state=WorkerState.STARTING))
    assert said(workers, 0.0) == {}


def test_a_worker_that_is_kept_no_more_is_told_of_until_it_has_stopped() -> None:
    workers = Workers.of(fleet_of(task_of()), "edge1")
    workers.on_changed(changed(WorkerState.READY))
    workers.on_fleet(fleet_of(tasks=()), "edge1", {"merge"})
    workers.on_changed(changed(WorkerState.STARTING, "pid 7"))
    assert (workers.states, said(workers, 0.0)) == ({"merge": WorkerState.STARTING}, {"merge": "pid 7"})
    workers.on_changed(changed(WorkerState.STOPPED, "signal 15"))
    assert (workers.states, said(workers, 0.0)) == ({}, {})


def test_a_worker_that_is_kept_no_more_and_waits_for_its_next_start_is_told_of_until_nobody_starts_it() -> None:
    workers = Workers.of(fleet_of(task_of()), "edge1")
    workers.on_changed(changed(WorkerState.STOPPED, "restarting (failure 1 of 3): exited with status 1"))
    workers.on_fleet(fleet_of(tasks=()), "edge1", {"merge"})
    assert list(workers.states) == ["merge"]
    assert workers.on_changed(changed(WorkerState.STOPPED, "stopped before its next start")) is None
    assert (workers.states, said(workers, 0.0)) == ({}, {})


def test_somebody_else_s_worker_that_is_kept_no_more_is_told_of_until_it_has_ended_its_work() -> None:
    """It runs on, and nobody tells when it ends."""
    foreign = task_of(worker=WorkerSpec())
    workers = Workers.of(fleet_of(foreign), "edge1")
    workers.on_changed(changed(WorkerState.READY))
    workers.on_outdated(ev.WorkerOutdated(task="merge", reason="its file has changed"))
    workers.on_fleet(fleet_of(replace(foreign, candidates=("edge2",))), "edge1", {"merge"})
    workers.let_go({"merge"})
    assert workers.states == {"merge": WorkerState.READY}
    assert workers.has_unwatched
    workers.let_go(set())
    assert (workers.states, said(workers, 0.0), workers.has_unwatched) == ({}, {}, False)


def test_a_worker_of_ours_that_is_kept_no_more_is_told_of_until_its_process_has_ended() -> None:
    ours = task_of(worker=WorkerSpec(command=("merge",)))
    workers = Workers.of(fleet_of(ours), "edge1")
    workers.on_changed(changed(WorkerState.READY))
    workers.on_fleet(fleet_of(replace(ours, candidates=("edge2",))), "edge1", {"merge"})
    workers.let_go(set())
    assert workers.states == {"merge": WorkerState.READY}
