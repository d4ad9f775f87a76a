"""The crew: processes, tokens and matches of this node's workers become one state each, with its reason."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from support.fleets import fleet_of, task_of, tuning_of
from support.waiting import until
from zsched.core.values import events as ev
from zsched.core.values.fleet import WorkerSpec
from zsched.core.values.model import MAX_REASON
from zsched.core.values.plan import ReadyWhen
from zsched.core.values.profile import WorkerState
from zsched.core.values.relay_protocol import WorkerMatched, WorkerSeen, WorkerTrouble
from zsched.core.values.words import Trouble, told_of_worker
from zsched.host.workers.supervisor import WorkerContext, WorkerSupervisor
from zsched.link.sessions.config import worker_config
from zsched.runtime import crew as crew_module
from zsched.runtime.crew import OTHERS, Crew
from zsched.runtime.sessions import SessionsRead

SLEEPER = ("python", "-c", "import time; time.sleep(600)")
TUNING = tuning_of(cpu=1.0, memory=0.0)
SPECS = {
    "node": WorkerSpec(command=SLEEPER, ready_when=ReadyWhen.MATCHING, start_deadline_s=4.0, stop_grace_s=0.1),
    "others": WorkerSpec(ready_when=ReadyWhen.MATCHING),
    "alone": WorkerSpec(),
    "token": WorkerSpec(command=SLEEPER, start_deadline_s=4.0, stop_grace_s=0.1),
}
FLEET = fleet_of(
    *((task_of(name, ("edge1",), tuning=TUNING, worker=one) for name, one in SPECS.items())),
    of=("edge1",),
    electors=("edge1",),
)
Told = list[tuple[str, WorkerState, str]]


class House:
    """A crew with a real supervisor."""

    def __init__(self) -> None:
        self.events: list[ev.Event] = []
        self.crew = Crew(self.events.append, FLEET, "edge1")
        self.crew.supervisor = self.supervisor = WorkerSupervisor(
            specs=SPECS,
            context=WorkerContext(fleet="test", node="edge1", incarnation=1),
            events=self.crew,
            why_not_ready=self.crew.why_not_ready,
        )

    def states(self, task: str) -> list[WorkerState]:
        return [one.state for one in tuple(self.events) if isinstance(one, ev.WorkerChanged) and one.task == task]

    def reasons(self, task: str) -> list[str]:
        return [one.reason for one in tuple(self.events) if isinstance(one, ev.WorkerChanged) and one.task == task]

    def troubles(self, task: str) -> list[Trouble]:
        return [one.trouble for one in tuple(self.events) if isinstance(one, ev.WorkerChanged) and one.task == task]

    def told(self, task: str) -> list[str]:
        """In words, as the status has it."""
        said = zip(self.states(task), self.troubles(task), self.reasons(task), strict=True)
        return [told_of_worker(*one) for one in said]

    def problems(self) -> list[tuple[str, str | None]]:
        return [(one.source, one.problem) for one in tuple(self.events) if isinstance(one, ev.ProblemReported)]

    def match(self, task: str, *, is_matched: bool = True, is_certain: bool = True) -> None:
        missing = "" if is_matched else "nobody subscribes to a/key"
        self.crew.on_matched(WorkerMatched(task=task, is_matched=is_matched, is_certain=is_certain, missing=missing))


@pytest.fixture
def house() -> Iterator[House]:
    made = House()
    yield made
    made.supervisor.close(1.0)


def test_a_process_that_matches_is_ready_and_is_not_ended_at_its_deadline(house: House) -> None:
    house.supervisor.start("node")
    until(lambda: house.states("node"), "it runs")
    house.match("node")
    until(lambda: house.supervisor.states()["node"] is WorkerState.READY, "the supervisor knows")
    assert house.states("node") == [WorkerState.STARTING, WorkerState.READY]
    house.match("node", is_matched=False)
    assert house.states("node")[-1] is WorkerState.STARTING, "its process lives"
    until(lambda: "not ready again within 4 s: was ready until" in str(house.reasons("node")), "the deadline")


def test_what_a_relay_has_seen_that_ended_says_nothing_of_the_next_process(house: House) -> None:
    """It was called ready, and got the task, before anybody had seen that it subscribes."""
    house.supervisor.start("node")
    life = until(lambda: house.crew.life_of("node"), "it runs")
    house.match("node")
    until(lambda: house.supervisor.states()["node"] is WorkerState.READY, "the supervisor knows")
    house.crew.on_relay_ended()
    os.kill(house.supervisor.pids()["node"], signal.SIGKILL)
    until(lambda: house.crew.life_of("node") not in (0, life), "the next process runs")
    time.sleep(0.2)
    assert house.states("node")[-1] is WorkerState.STARTING
    house.match("node")
    until(lambda: house.states("node")[-1] is WorkerState.READY, "the next relay sees it")


@pytest.mark.long
def test_no_worker_is_ended_while_no_relay_could_see_it(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its token went, as its link broke; then the relay was away for longer than a worker may take to start."""
    monkeypatch.setattr(crew_module, "MISSED_S", 2.0)
    house.supervisor.start("token")
    life = until(lambda: house.crew.life_of("token"), "it runs")
    seen = WorkerSeen(node="edge1", task="token", incarnation=str(life), is_present=True)
    house.crew.on_token(seen)
    until(lambda: house.supervisor.states()["token"] is WorkerState.READY, "the supervisor knows")
    house.crew.on_token(replace(seen, is_present=False))
    house.crew.on_relay_ended()
    time.sleep(SPECS["token"].start_deadline_s + 1.0)
    assert house.crew.life_of("token") == life
    house.crew.on_relay_started()
    time.sleep(1.0)
    assert house.crew.life_of("token") == life, "the relay may be about to see it"
    house.crew.on_token(seen)
    until(lambda: house.supervisor.states()["token"] is WorkerState.READY, "it is seen")
    house.crew.on_relay_ended()
    house.crew.on_relay_started()
    until(lambda: house.supervisor.states()["token"] is not WorkerState.READY, "nobody sees it any more")
    until(lambda: house.crew.life_of("token") != life, "it is ended in the end")


def test_a_process_that_never_matches_is_told_what_it_lacks(house: House) -> None:
    house.supervisor.start("node")
    until(lambda: house.states("node"), "it runs")
    house.match("node", is_matched=False)
    until(lambda: "not ready within 4 s: nobody subscribes to a/key" in str(house.reasons("node")), "the deadline")
    assert "did it open $ZSCHED_ZENOH_CONFIG, or does it subscribe to another key?" in str(house.reasons("node"))


def test_a_token_that_comes_before_the_word_of_its_process_s_start_counts(house: House) -> None:
    """On a busy machine a program that starts in some milliseconds was never ready, and killed at its deadline."""
    house.crew.on_token(WorkerSeen(node="edge1", task="token", incarnation="100001", is_present=True))
    house.supervisor.start("token")
    until(lambda: house.crew.life_of("token") == 100001, "it runs")
    until(lambda: house.supervisor.states()["token"] is WorkerState.READY, "the supervisor knows")
    assert house.states("token")[-2:] == [WorkerState.STARTING, WorkerState.READY]


def test_a_worker_that_was_ready_is_not_told_what_it_has_done_already(house: House) -> None:
    """It was stopped or hangs: how to get ready is no news to it, and it is not starting."""
    house.supervisor.start("token")
    life = until(lambda: house.crew.life_of("token"), "it runs")
    pid = house.supervisor.pids()["token"]
    seen = WorkerSeen(node="edge1", task="token", incarnation=str(life), is_present=True)
    house.crew.on_token(seen)
    until(lambda: house.supervisor.states()["token"] is WorkerState.READY, "the supervisor knows")
    house.crew.on_token(replace(seen, is_present=False))
    lost = house.reasons("token")[-1]
    assert house.troubles("token")[-1] is Trouble.LOST
    assert lost.startswith("was ready until ")
    assert lost.endswith(f"its token went: it may hang, be frozen or cut off; see its log and process {pid}")
    assert house.told("token")[-1] == lost, "and not that it is starting"
    until(lambda: f"not ready again within 4 s: {lost}" in str(house.reasons("token")), "the deadline")
    until(lambda: house.crew.life_of("token") not in (0, life), "the next process runs")
    assert "no token" in house.crew.why_not_ready("token"), "which has not been ready"


def test_a_worker_that_was_killed_is_restarting_and_not_just_starting(house: House) -> None:
    house.supervisor.start("token")
    life = until(lambda: house.crew.life_of("token"), "it runs")
    first = house.supervisor.pids()["token"]
    assert house.reasons("token") == [f"pid {first}"]
    os.kill(first, signal.SIGKILL)
    again = until(lambda: (now := house.crew.life_of("token")) not in (0, life) and now, "the next process runs")
    second = house.supervisor.pids()["token"]
    said = "restarting (failure 1 of 3): killed by signal 9 (Killed)"
    assert house.reasons("token")[1:] == [said, f"{said}; now it is pid {second}"]
    assert house.troubles("token") == [Trouble.NONE, Trouble.AGAIN, Trouble.AGAIN]
    told = [f"is starting: pid {first}", f"is {said}", f"is {said}; now it is pid {second}"]
    assert house.told("token") == told
    house.crew.on_token(WorkerSeen(node="edge1", task="token", incarnation=str(again), is_present=True))
    until(lambda: house.supervisor.states()["token"] is WorkerState.READY, "the supervisor knows")
    house.supervisor.stop("token")
    until(lambda: house.crew.life_of("token") == 0, "it is stopped")
    house.supervisor.start("token")
    until(lambda: house.crew.life_of("token"), "it runs again")
    assert house.reasons("token")[-1].startswith("pid "), "an operator's stop is no failure"
    assert house.troubles("token")[-3:] == [Trouble.NONE] * 3


def test_a_worker_that_is_not_started_again_is_not_restarting(house: House) -> None:
    house.crew.on_stopped("token")
    assert house.told("token") == ["is stopped: stopped before its next start"]


def test_a_process_that_is_started_again_and_matches_nobody_is_restarting(house: House) -> None:
    """What it lacks is said of every one that does not get ready; that there was one before must not be lost by it."""
    house.supervisor.start("node")
    until(lambda: house.states("node"), "it runs")
    house.match("node", is_matched=False)
    until(lambda: len(house.states("node")) > 3, "the next process runs")
    house.match("node", is_matched=False)
    said = house.reasons("node")[-1]
    assert said.startswith("restarting (failure 1 of 3): not ready within 4 s")
    assert said.count("nobody subscribes to a/key") == 1
    assert house.troubles("node")[-1] is Trouble.AGAIN


def test_what_matches_without_a_process_is_not_the_worker(house: House) -> None:
    house.match("node")
    assert house.states("node") == []
    house.supervisor.start("node")
    until(lambda: WorkerState.READY in house.states("node"), "from its start on it may be")
    house.supervisor.stop("node")
    until(lambda: house.states("node")[-1] is WorkerState.STOPPED, "its process has ended")
    house.match("node")
    assert house.states("node")[-1] is WorkerState.STOPPED


def test_somebody_else_s_worker_comes_and_goes_by_matching(house: House) -> None:
    house.match("others", is_matched=False)
    house.match("others")
    house.match("others", is_matched=False)
    assert house.states("others") == [WorkerState.STOPPED, WorkerState.READY, WorkerState.STOPPED]
    never, _, lost = house.reasons("others")
    start_it = "on edge1 (the task has no `command`) with the session edge1-others.zenoh.json5"
    assert never == f"nobody subscribes to a/key: start it {start_it}"
    assert house.troubles("others") == [Trouble.NONE, Trouble.NONE, Trouble.LOST]
    assert lost.startswith("was ready until ")
    assert lost.endswith(f"nobody subscribes to a/key: it has ended, hangs or is frozen; start it again {start_it}")
    assert len(lost) <= MAX_REASON


def test_a_token_says_nothing_of_a_worker_that_is_known_by_matching(house: House) -> None:
    house.crew.on_token(WorkerSeen(node="edge1", task="others", incarnation="1", is_present=True))
    assert house.states("others") == []


def test_who_listens_to_everything_is_told_where_no_process_would_show_the_end(house: House) -> None:
    house.match("others", is_certain=False)
    house.match("others", is_certain=False)
    house.match("others")
    house.match("node", is_certain=False)
    assert house.problems() == [("worker/others", OTHERS), ("worker/others", None)]


def test_nobody_is_told_of_a_worker_that_this_node_keeps_no_more(house: House) -> None:
    house.match("others", is_certain=False)
    adopt(house)
    assert house.problems() == [("worker/others", OTHERS), ("worker/others", None)]


def test_nor_of_one_that_this_node_starts_from_now_on(house: House) -> None:
    house.match("others", is_certain=False)
    worker = WorkerSpec(command=("work",), ready_when=ReadyWhen.MATCHING)
    house.crew.on_fleet(fleet_of(task_of("others", ("edge1",), worker=worker), of=["edge1"], electors=["edge1"]), {})
    assert house.problems() == [("worker/others", OTHERS), ("worker/others", None)]


def outdated(house: House) -> list[str]:
    return [one.reason for one in house.events if isinstance(one, ev.WorkerOutdated)]


def reads(house: House, folder: Path, *tasks: str) -> None:
    """The daemon of before has written another session."""
    for connect in (("tcp/10.0.0.1:7458",), ("tcp/10.0.0.1:7458", "tcp/10.0.0.2:7458")):
        read = SessionsRead(folder)
        for task in tasks:
            read.begin(task, worker_config(connect=connect))
        read.save()
    house.crew.sessions_read = read


def test_a_stranger_that_is_there_with_the_relay_runs_since_before(
    house: House, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reads(house, tmp_path, "others")
    house.crew.on_relay_started()
    house.match("others", is_matched=False)  # it dials the new relay only now
    house.match("others")
    (told,) = outdated(house)
    assert told.startswith("seems to run since before its session changed: start it again on edge1 (the task has no")
    assert told.endswith("it lacks tcp/10.0.0.2:7458")
    house.match("others", is_matched=False)
    house.match("others")
    assert set(outdated(house)) == {told}, "the relay is as young"
    monkeypatch.setattr(crew_module, "REJOIN_S", 0.0)
    house.match("others", is_matched=False)
    house.match("others")
    assert outdated(house)[-1] == ""


def test_a_stranger_that_comes_long_after_the_relay_has_read_the_newest(
    house: House, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(crew_module, "REJOIN_S", 0.0)
    reads(house, tmp_path, "others")
    house.crew.on_relay_started()
    house.match("others")
    assert outdated(house) == []


def test_the_number_of_its_life_tells_more_than_the_time(
    house: House, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reads(house, tmp_path, "alone")
    assert house.crew.sessions_read is not None
    house.crew.sessions_read.seen("alone", 5, is_new=False)
    monkeypatch.setattr(crew_module, "REJOIN_S", 0.0)
    house.crew.on_relay_started()
    seen = WorkerSeen(node="edge1", task="alone", incarnation="5", is_present=True)
    house.crew.on_token(seen)
    (told,) = outdated(house)
    assert "it lacks tcp/10.0.0.2:7458" in told
    monkeypatch.setattr(crew_module, "REJOIN_S", 1e9)
    house.crew.on_token(replace(seen, incarnation="6"))
    assert outdated(house) == [told, ""]


def test_only_the_running_process_complains(house: House) -> None:
    house.supervisor.start("token")
    life = until(lambda: house.crew.life_of("token"), "it runs")
    for incarnation in (str(life - 1), str(life)):
        house.crew.on_trouble(WorkerTrouble(task="token", incarnation=incarnation, count=2, text="ValueError"))
    told = [one for one in tuple(house.events) if isinstance(one, ev.WorkerTroubled)]
    assert told == [ev.WorkerTroubled(task="token", count=2, text="ValueError")]


def test_a_failed_worker_that_nobody_wants_now_may_be_chosen_again_after_a_reset(house: House) -> None:
    """A cold standby that failed as the owner: its node stays out until an operator says otherwise."""
    house.crew.on_started("token", 7, 100001)
    house.crew.on_exited("token", 100001, 1, "no map")
    house.crew.on_failed("token", "no map")
    house.crew.on_reset("token")
    assert house.states("token")[-2:] == [WorkerState.FAILED, WorkerState.STOPPED]


def test_a_worker_without_its_token_is_told_what_it_lacks(house: House) -> None:
    house.supervisor.start("token")
    life = until(lambda: house.crew.life_of("token"), "it runs")
    until(lambda: "not ready within" in str(house.reasons("token")), "the deadline")
    reason = next(reason for reason in house.reasons("token") if "not ready" in reason)
    assert "without zsched.worker say `ready: matching`" in reason
    assert reason.endswith(f"@zsched/test/worker/edge1/token/{life}")
    assert len(reason) <= MAX_REASON


def test_a_worker_whose_token_is_at_another_key_is_told_both(house: House) -> None:
    house.supervisor.start("token")
    life = until(lambda: house.crew.life_of("token"), "it runs")
    house.crew.on_token(WorkerSeen(node="edge1", task="token", incarnation="1", is_present=True))
    until(lambda: "not ready within" in str(house.reasons("token")), "the deadline")
    assert f"its token ends in /1, and should be @zsched/test/worker/edge1/token/{life}" in str(house.reasons("token"))
    house.crew.on_token(WorkerSeen(node="edge1", task="token", incarnation="1", is_present=False))
    assert "no token" in house.crew.why_not_ready("token")


def test_who_has_to_start_a_worker_with_a_token_is_told_its_key(house: House) -> None:
    house.crew.sessions = {"alone": Path("edge1-alone.zenoh.json5")}
    house.crew.begin()
    assert "`ready: matching`" in house.reasons("alone")[0]
    assert "worker/edge1/alone/NUMBER" in house.reasons("alone")[0]
    assert "start it on edge1 (the task has no `command`) with the session edge1-alone" in house.reasons("alone")[0]
    assert house.reasons("others") == house.reasons("node") == house.reasons("token") == []


# --- a changed fleet file --------------------------------------------------------------------------------------------


def adopt(house: House, *tasks: str) -> None:
    """Go by a file that has these tasks only, as `zsched.runtime.adoption` does."""
    specs = {name: SPECS[name] for name in tasks}
    house.crew.on_fleet(replace(FLEET, tasks=tuple(one for one in FLEET.tasks if one.name in tasks)), {})
    house.supervisor.keep(specs)
    house.crew.keep(specs)


def test_a_token_that_stayed_while_its_task_was_away_is_told_when_it_is_back(house: House) -> None:
    seen = WorkerSeen(node="edge1", task="alone", incarnation="7", is_present=True)
    house.crew.on_token(seen)
    until(lambda: house.supervisor.states()["alone"] is WorkerState.READY, "the supervisor knows")
    adopt(house, "others")
    until(lambda: "alone" not in house.supervisor.states(), "the task is away")
    adopt(house, "others", "alone")
    assert house.states("alone")[-1] is WorkerState.READY
    until(lambda: house.supervisor.states().get("alone") is WorkerState.READY, "the supervisor knows again")


def test_a_token_that_came_before_its_task_is_told_with_it(house: House) -> None:
    adopt(house, "others")
    until(lambda: "alone" not in house.supervisor.states(), "the task is away")
    house.crew.on_token(WorkerSeen(node="edge1", task="alone", incarnation="7", is_present=True))
    assert house.states("alone") == [], "nobody asks for it yet"
    adopt(house, "others", "alone")
    assert house.states("alone")[-1] is WorkerState.READY


def test_a_token_that_went_while_its_task_was_away_is_not_told(house: House) -> None:
    seen = WorkerSeen(node="edge1", task="alone", incarnation="7", is_present=True)
    house.crew.on_token(seen)
    adopt(house, "others")
    until(lambda: "alone" not in house.supervisor.states(), "the task is away")
    house.crew.on_token(replace(seen, is_present=False))
    told = len(house.states("alone"))
    adopt(house, "others", "alone")
    assert WorkerState.READY not in house.states("alone")[told:]


def test_a_new_relay_tells_anew_which_tokens_are_there(house: House) -> None:
    seen = WorkerSeen(node="edge1", task="alone", incarnation="7", is_present=True)
    house.crew.on_token(seen)
    adopt(house, "others")
    until(lambda: "alone" not in house.supervisor.states(), "the task is away")
    house.crew.on_relay_ended()
    told = len(house.states("alone"))
    adopt(house, "others", "alone")
    assert WorkerState.READY not in house.states("alone")[told:]
    adopt(house, "others")
    house.crew.on_token(seen)
    house.crew.on_relay_started()
    adopt(house, "others", "alone")
    assert house.states("alone")[-1] is WorkerState.READY, "it may tell so before it says that it runs"


@pytest.mark.parametrize("task", ["alone", "token"])
def test_a_worker_that_a_new_relay_never_sees_is_not_ready_any_more(
    house: House, monkeypatch: pytest.MonkeyPatch, task: str
) -> None:
    """It froze, or ended, while no relay was there to see its token go; one that comes back is ready again."""
    monkeypatch.setattr(crew_module, "MISSED_S", 0.1)
    life = 7
    if task == "token":
        house.supervisor.start(task)
        life = until(lambda: house.crew.life_of(task), "it runs")
    seen = WorkerSeen(node="edge1", task=task, incarnation=str(life), is_present=True)
    house.crew.on_token(seen)
    house.crew.on_relay_ended()
    house.crew.on_token(seen)
    house.crew.on_relay_started()
    time.sleep(0.3)
    assert house.states(task)[-1] is WorkerState.READY, "this relay sees it"
    house.crew.on_relay_started()
    house.crew.on_relay_ended()
    time.sleep(0.3)
    assert house.states(task)[-1] is WorkerState.READY, "no relay is there that could"
    house.crew.on_relay_started()
    until(lambda: house.states(task)[-1] is not WorkerState.READY, "the next one does not")
    assert crew_module.UNSEEN in house.reasons(task)[-1]
    if task == "token":
        until(lambda: "not ready again within 4 s" in str(house.reasons(task)), "it is started again")
    else:
        house.crew.on_token(seen)
        assert house.states(task)[-1] is WorkerState.READY


def test_a_match_that_comes_before_the_supervisor_has_heard_of_the_task_counts(house: House) -> None:
    """The relay tells it once, and may be quicker than the supervisor's thread."""
    adopt(house, "alone")
    until(lambda: "others" not in house.supervisor.states(), "the task is away")
    house.crew.on_fleet(FLEET, {})
    house.crew.keep(SPECS)
    house.match("others")
    house.supervisor.keep(SPECS)
    assert house.states("others") == [WorkerState.READY]


def test_a_late_start_of_ours_hides_no_worker_that_somebody_else_starts_now(house: House) -> None:
    """The supervisor's thread hears later than the crew that the task has no `command` any more."""
    tasks = tuple(replace(one, worker=WorkerSpec()) if one.name == "token" else one for one in FLEET.tasks)
    house.crew.on_fleet(replace(FLEET, tasks=tasks), {})
    house.crew.on_started("token", 7, 100001)
    house.crew.on_exited("token", 100001, -2, "stopped by SIGINT")
    assert house.states("token") == []
    house.crew.on_token(WorkerSeen(node="edge1", task="token", incarnation="7", is_present=True))
    assert house.states("token") == [WorkerState.READY]
