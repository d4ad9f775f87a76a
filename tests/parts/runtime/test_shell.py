"""The shell: each instruction reaches its adapter in order, failures become events, operators get answers."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast, get_type_hints

import pytest

from support.allocations import allocation_of
from support.ballots import ballot_of
from support.beats import beat_of
from support.fleets import fleet_of
from support.profiles import profile_of
from support.proposals import proposal_of
from support.states import state_of
from support.waiting import until
from zsched.commands.base import ask
from zsched.commands.look.history import moves_of
from zsched.config.timing import WAN
from zsched.core.electorate.founding import founded
from zsched.core.values import events as ev
from zsched.core.values import fleet as fleet_values
from zsched.core.values import instructions as do
from zsched.core.values.codec import document_hash
from zsched.core.values.decision import Explanation, Move
from zsched.core.values.document import Document, Flag, FlagKind, Text
from zsched.core.values.durable import DurableState
from zsched.core.values.errors import AdapterError, WireError
from zsched.core.values.fleet import MOST_ORDER_S, Fleet, Timing, WorkerSpec
from zsched.core.values.in_force import InForce
from zsched.core.values.messages import (
    Accept,
    Accepted,
    Agreed,
    Asking,
    Ballots,
    ChangeFleet,
    CommandOutcome,
    CommandResult,
    FleetTold,
    Hold,
    HoldTask,
    Learnt,
    MoveTask,
    Prepare,
    ReadLines,
    TuneTask,
    Utilities,
    Votes,
)
from zsched.core.values.model import Acceptance, Asked, Tuning, Weights
from zsched.core.values.plan import STILL_S, Role, RoutePhase, RoutePlan, StreamCount, WorkerRole
from zsched.core.values.profile import WorkerState
from zsched.core.values.relay_protocol import RelayStarted, WorkerSeen
from zsched.host.decision_log import DecisionLog
from zsched.host.state_file import StateFile
from zsched.host.workers.kept_lines import KeptLines
from zsched.host.workers.supervisor import WorkerContext, WorkerSupervisor
from zsched.link.requests import COMMANDS, command_of
from zsched.runtime import shell as shell_module
from zsched.runtime.desk import LOCAL_REQUESTS_FROM, Desk
from zsched.runtime.inbox import INBOX_LIMIT, WAITING_LIMIT, Inbox
from zsched.runtime.library import Library
from zsched.runtime.shell import FOLLOW_AGAIN_S, PROBLEM_TTL_S, Shell

BALLOT = ballot_of()
VALUE = allocation_of()
BEAT = beat_of("robot1")
PROFILE = profile_of("robot1", cpu_cores=1, cpu_used_cores=None, memory_mb=10, memory_used_mb=None)
PROPOSAL = proposal_of("robot1")
PREPARE = Prepare(task="merge", ballot=BALLOT, electorate="e")
ACCEPT = Accept(task="merge", acceptance=Acceptance(ballot=BALLOT, value=VALUE), electorate="e")
LEARNT = Learnt(node="robot1", values=(VALUE,))
UTILITIES = Utilities(voter="robot1", vectors=())
ANSWER = Accepted(elector="robot1", task="merge", ballot=BALLOT)
BALLOTS, VOTES = Ballots(prepares=(PREPARE,), accepts=(ACCEPT,)), Votes(accepted=(ANSWER,))
RESULT = CommandResult(outcome=CommandOutcome.OK, detail="done", revision=4)
EXPLANATION = Explanation(node="edge1", kind="edge", task="merge", allocation=VALUE, robots=("robot1",))
PLAN = RoutePlan(task="merge", phase=RoutePhase.CLOSE, current=None)
ROLE = Role(task="merge", role=WorkerRole.IDLE)
STATE = state_of("robot1", fleet="f", incarnation=3)


class Adapter:
    """Stands for the bus, the relay's handle and the supervisor, none of which can be made to fail: notes every call,
    and raises what ``broken`` holds for its name."""

    def __init__(self, calls: list[tuple[Any, ...]]) -> None:
        self.calls = calls
        self.broken: dict[str, Exception] = {}

    def __getattr__(self, name: str) -> Callable[..., None]:
        def call(*arguments: object) -> None:
            self.calls.append((name, *arguments))
            if name in self.broken:
                raise self.broken[name]

        return call


class House:
    """A shell with stand-in adapters, a real state file and a real inbox."""

    def __init__(self, folder: Path) -> None:
        self.calls: list[tuple[Any, ...]] = []
        self.adapter = cast("Any", Adapter(self.calls))
        self.inbox = Inbox()
        self.state_file = StateFile(folder, fleet="f", node="robot1", hardware="")
        self.here = InForce(fleet_of())
        self.desk = Desk("robot1", self.inbox, self.adapter, self.here)
        self.shell = Shell(
            node="robot1", inbox=self.inbox, bus=self.adapter, state_file=self.state_file, desk=self.desk
        )
        self.shell.relay = self.shell.crew.supervisor = self.adapter

    def events(self) -> list[ev.Event]:
        found = []
        while (event := self.inbox.take(0)) is not None:
            found.append(event)
        return found


@pytest.fixture
def house(tmp_path: Path) -> Iterator[House]:
    made = House(tmp_path)
    with made.state_file:
        yield made


# --- instructions ----------------------------------------------------------------------------------------------------

EVERY: dict[do.Instruction, tuple[Any, ...]] = {
    do.PublishBeat(beat=BEAT): ("publish", "beat", BEAT),
    do.PublishBeat(beat=BEAT, is_news=False): ("publish", "beat_in_turn", BEAT),
    do.PublishProfile(profile=PROFILE): ("publish", "profile", PROFILE),
    do.PublishProfile(profile=PROFILE, is_news=False): ("publish", "profile_in_turn", PROFILE),
    do.PublishProposal(proposal=PROPOSAL): ("publish", "proposal", PROPOSAL),
    do.PublishLearnt(learnt=LEARNT): ("publish", "allocation", LEARNT),
    do.AskUtilities(gather=3, deadline_s=0.1): ("ask_utilities", 3, 0.1),
    do.SendPrepare(prepare=PREPARE, deadline_s=0.2): ("ask_electors", PREPARE, 0.2),
    do.SendAccept(accept=ACCEPT, deadline_s=0.2): ("ask_electors", ACCEPT, 0.2),
    do.SendBallots(ballots=BALLOTS, deadline_s=0.2): ("ask_electors", BALLOTS, 0.2),
    do.AskLearnt(peer="edge1", deadline_s=0.2): ("ask_learnt", "edge1", 0.2),
    do.AnswerUtilities(request=1, utilities=UTILITIES): ("answer", 1, UTILITIES),
    do.AnswerElection(request=2, answer=ANSWER): ("answer", 2, ANSWER),
    do.AnswerBallots(request=2, votes=VOTES): ("answer", 2, VOTES),
    do.AnswerLearnt(request=3, learnt=LEARNT): ("answer", 3, LEARNT),
    do.AnswerCommand(request=4, result=RESULT): ("answer", 4, RESULT),
    do.AnswerExplanation(request=5, explanation=EXPLANATION): ("answer", 5, EXPLANATION),
    do.StartWorker(task="merge"): ("start", "merge"),
    do.StopWorker(task="merge"): ("stop", "merge"),
    do.RestartWorker(task="merge", reason="no output"): ("report_hung", "merge", 0, "no output"),
    do.RenewWorker(task="merge"): ("renew", "merge"),
    do.SetRole(role=ROLE): ("set_role", ROLE),
    do.ApplyRoutes(plan=PLAN): ("apply", PLAN),
}


def test_every_instruction_reaches_its_adapter_in_order(house: House) -> None:
    house.shell.carry_out((do.PersistState(state=STATE), *EVERY))
    assert house.calls == list(EVERY.values())
    assert house.state_file.load().state == STATE
    (saved,) = house.events()
    assert isinstance(saved, ev.StateSaved)
    assert 0.0 < saved.took_s < 5.0


def test_stories_go_to_the_logger_of_their_stage(house: House, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    house.shell.carry_out(
        (
            do.RecordStory(stage="vote", text="won", task="merge", epoch=3),
            do.RecordStory(stage="membership", text="edge1 alive -> gone"),
        )
    )
    assert [(line.name, line.getMessage()) for line in caplog.records] == [
        ("zsched.vote", "task=merge epoch=3 won"),
        ("zsched.membership", "edge1 alive -> gone"),
    ]


# --- failures --------------------------------------------------------------------------------------------------------


def test_refused_write_drops_the_rest_and_is_the_very_next_event(house: House) -> None:
    house.inbox.post(ev.StatusAsked(request=1))
    house.state_file.release()  # a save without the lock is refused
    house.shell.carry_out((do.PersistState(state=STATE), *EVERY))
    assert house.calls == []
    first, second = house.events()
    assert isinstance(first, ev.PersistFailed)
    assert "lock" in first.reason
    assert second == ev.StatusAsked(request=1)


def test_state_too_large_to_write_is_a_refused_write(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    def too_large(_state: DurableState) -> None:
        raise WireError("size", "state: too many bytes")

    monkeypatch.setattr(house.state_file, "save", too_large)
    house.shell.carry_out((do.PersistState(state=STATE), *EVERY))
    assert house.calls == []
    assert house.events() == [ev.PersistFailed(reason="size: state: too many bytes")]


@pytest.mark.parametrize("error", [AdapterError("session is closed"), WireError("size", "beat")])
def test_other_failures_are_reported_and_the_rest_goes_on(house: House, error: Exception) -> None:
    house.adapter.broken["publish"] = error
    house.shell.carry_out((do.PublishBeat(beat=BEAT), do.StartWorker(task="merge")))
    assert house.calls[-1] == ("start", "merge")
    assert house.events() == [ev.ProblemReported(source="PublishBeat", problem=str(error))]


def test_problem_ends_when_the_same_instruction_works_again(house: House) -> None:
    house.adapter.broken["publish"] = AdapterError("closed")
    house.shell.carry_out((do.PublishBeat(beat=BEAT),))
    house.events()
    house.shell.carry_out((do.StartWorker(task="merge"),))
    assert house.events() == [], "another one's success says nothing"
    house.adapter.broken.clear()
    house.shell.carry_out((do.PublishBeat(beat=BEAT), do.PublishBeat(beat=BEAT)))
    assert house.events() == [ev.ProblemReported(source="PublishBeat", problem=None)]


def test_problem_of_an_instruction_that_never_comes_again_ends_by_its_age(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 100.0
    monkeypatch.setattr(shell_module, "monotonic_s", lambda: now)
    house.adapter.broken["answer"] = AdapterError("gone")
    house.shell.carry_out((do.AnswerCommand(request=4, result=RESULT),))
    now += PROBLEM_TTL_S - 1
    house.shell.carry_out((do.PublishBeat(beat=BEAT),))
    assert len(house.events()) == 1
    now += 2
    house.shell.carry_out((do.PublishBeat(beat=BEAT),))
    assert house.events() == [ev.ProblemReported(source="AnswerCommand", problem=None)]


def test_a_fleet_that_could_not_be_followed_is_tried_and_told_until_it_works(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing else brings the order again: the problem vanished, and the adapters went by the fleet before."""
    now, full = 100.0, AdapterError("cannot write a session: no space left on device")
    monkeypatch.setattr(shell_module, "monotonic_s", lambda: now)
    tried: list[tuple[Fleet, bool]] = []

    def follow(fleet: Fleet, is_agreed: bool) -> None:
        tried.append((fleet, is_agreed))
        if is_full:
            raise full

    house.shell.follow, is_full = follow, True
    first, second = (do.AdoptFleet(fleet=fleet_of(name=name), is_agreed=True) for name in ("first", "second"))
    house.shell.carry_out((first, do.StartWorker(task="merge")))
    assert house.calls == [("start", "merge")]
    until_s = now + PROBLEM_TTL_S + 2 * FOLLOW_AGAIN_S
    while now < until_s:
        now += 1.0
        house.shell.carry_out((do.PublishBeat(beat=BEAT),))
    assert tried == [(first.fleet, True)] * (1 + int((PROBLEM_TTL_S + 2 * FOLLOW_AGAIN_S) / FOLLOW_AGAIN_S))
    assert set(house.events()) == {ev.ProblemReported(source="AdoptFleet", problem=str(full))}
    now, is_full = now + FOLLOW_AGAIN_S, False
    del tried[:]
    for batch in ((second,), (), ()):
        house.shell.carry_out(batch)
        now += FOLLOW_AGAIN_S
    assert [fleet for fleet, _ in tried] == [first.fleet, second.fleet], "the newer one is the last"
    assert house.events() == [ev.ProblemReported(source="AdoptFleet", problem=None)]


def test_inbox_is_bounded_and_always_takes_a_stop() -> None:
    inbox = Inbox()
    for number in range(INBOX_LIMIT + 5):
        inbox.post(ev.StatusAsked(request=number))
    inbox.post(ev.StopRequested())
    assert inbox.overflowed == 5
    taken = [inbox.take(0) for _ in range(INBOX_LIMIT + 1)]
    assert taken[0] == ev.StatusAsked(request=0)
    assert taken[-1] == ev.StopRequested()
    assert inbox.take(0) is None
    assert inbox.take(-1.0) is None


# --- workers ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def supervised(house: House) -> Iterator[House]:
    """With a real supervisor: ``merge`` is a process that ends when it is told, ``foreign`` somebody else's."""
    command = (sys.executable, "-c", "import sys; sys.stdin.close(); import time; time.sleep(600)")
    supervisor = WorkerSupervisor(
        specs={"merge": WorkerSpec(command=command), "foreign": WorkerSpec()},
        context=WorkerContext(fleet="f", node="robot1", incarnation=1),
        events=house.shell.crew,
    )
    house.shell.crew.supervisor = supervisor
    try:
        yield house
    finally:
        supervisor.close(1.0)


def seen(task: str, life: int | str, *, is_present: bool = True, node: str = "robot1") -> WorkerSeen:
    return WorkerSeen(node=node, task=task, incarnation=str(life), is_present=is_present)


def states(house: House) -> list[WorkerState]:
    return [event.state for event in house.events() if isinstance(event, ev.WorkerChanged)]


def test_token_of_the_running_worker_makes_it_ready_and_its_end_starting(supervised: House) -> None:
    shell = supervised.shell
    shell.carry_out((do.StartWorker(task="merge"),))
    life = until(lambda: shell.crew._lives.get("merge"), "the worker runs")
    shell.on_report(seen("merge", life))
    shell.on_report(seen("merge", life, is_present=False))
    assert states(supervised) == [WorkerState.STARTING, WorkerState.READY, WorkerState.STARTING]


def test_real_end_of_a_worker_is_stopped_and_its_late_token_says_nothing(supervised: House) -> None:
    shell = supervised.shell
    shell.carry_out((do.StartWorker(task="merge"),))
    life = until(lambda: shell.crew._lives.get("merge"), "the worker runs")
    shell.carry_out((do.StopWorker(task="merge"),))
    until(lambda: shell.crew._lives.get("merge") == 0, "the worker has ended")
    shell.on_report(seen("merge", life))
    shell.on_report(seen("merge", life, is_present=False))
    assert states(supervised) == [WorkerState.STARTING, WorkerState.STOPPED]


def test_token_that_goes_after_the_worker_failed_leaves_it_failed(supervised: House) -> None:
    """Else a broken worker would look startable, and its node would be eligible again."""
    shell = supervised.shell
    shell.crew.on_started("merge", 1, 100001)
    shell.crew.on_exited("merge", 100001, 1, "")
    shell.crew.on_failed("merge", "exit code 1")
    shell.on_report(seen("merge", 100001, is_present=False))
    assert states(supervised) == [WorkerState.STARTING, WorkerState.STOPPED, WorkerState.FAILED]


def test_lives_of_an_earlier_process_are_ignored(supervised: House) -> None:
    shell = supervised.shell
    shell.crew.on_started("merge", 1, 100002)
    shell.on_report(seen("merge", 100001))
    shell.on_report(seen("merge", 100001, is_present=False))
    shell.crew.on_exited("merge", 100001, 0, "late")
    assert states(supervised) == [WorkerState.STARTING]


@pytest.mark.parametrize("report", [seen("merge", 5, node="robot2"), seen("merge", "x"), seen("unknown", 5)])
def test_tokens_that_are_not_ours_are_ignored_and_do_no_harm(supervised: House, report: WorkerSeen) -> None:
    """A token of an unknown task must not end the supervisor's thread."""
    shell = supervised.shell
    shell.on_report(report)
    shell.carry_out((do.StartWorker(task="merge"),))
    until(lambda: shell.crew._lives.get("merge"), "the supervisor still starts workers")
    assert states(supervised) == [WorkerState.STARTING]


@pytest.mark.parametrize("is_present", [True, False])
def test_another_node_s_token_is_told_to_the_node(house: House, is_present: bool) -> None:
    house.shell.on_report(seen("merge", "3-1", node="edge1", is_present=is_present))
    shown = ev.WorkerShown(node="edge1", task="merge", incarnation="3-1", is_present=is_present)
    assert house.events() == [shown]


def test_foreign_worker_comes_and_goes_by_its_token(supervised: House) -> None:
    supervised.shell.on_report(seen("foreign", 1))
    supervised.shell.on_report(seen("foreign", 1, is_present=False))
    assert states(supervised) == [WorkerState.READY, WorkerState.STOPPED]


def test_relays_other_reports_are_events_as_they_are(house: House) -> None:
    house.shell.on_report(RelayStarted(pid=1, zid="z"))
    house.shell.on_report(ev.SlotReady(task="merge", epoch=1))
    assert house.events() == [ev.SlotReady(task="merge", epoch=1)]


@pytest.mark.parametrize(
    ("count", "wakes"),
    [
        (StreamCount(stream="s"), False),
        (StreamCount(stream="s", messages=7, last_seen_s=STILL_S, in_flight=0), False),
        (StreamCount(stream="s", messages=7, last_seen_s=STILL_S - 0.1, in_flight=0), True),
        (StreamCount(stream="s", messages=7, last_seen_s=9.0, in_flight=1), True),
    ],
)
def test_counters_wake_the_loop_only_while_something_flows_or_is_under_way(
    house: House, count: StreamCount, *, wakes: bool
) -> None:
    report = ev.StreamsCounted(counts=(StreamCount(stream="still"), count))
    house.shell.on_report(report)
    assert house.events() == [report] * wakes
    assert list(house.inbox.waiting()) == [report] * (not wakes)


def test_work_is_told_to_the_sampler(house: House) -> None:
    told: list[str] = []
    house.shell.measure_soon = lambda: told.append("soon")
    house.shell.carry_out((do.SetRole(role=ROLE),))
    house.shell.carry_out((do.StartWorker(task="merge"),))
    assert len(told) == 2
    house.shell.on_report(ev.WorkerJobs(task="merge", incarnation="1", at_s=1.0, done=1))
    assert len(told) == 3


# --- the desk --------------------------------------------------------------------------------------------------------


TUNING = {"weights": {"cpu": 1.0, "memory": 0.0, "network": 0.0}, "bonus": 0.3}


def test_an_order_becomes_the_event_that_says_all_of_it() -> None:
    asked = Asked(by="ada@robot1", reason="lens")
    order = {"task": "merge", "by": "ada@robot1", "reason": "lens", "base_revision": 3}
    move = command_of({**order, "verb": "move", "target": "edge1", "origin": "edge2", "plan": True})
    assert move == MoveTask(task="merge", node="edge1", asked=asked, origin="edge2", base_revision=3, is_plan=True)
    pin = command_of({**order, "verb": "hold", "hold": "pin", "target": "edge1", "hard": True, "for_s": 60})
    assert pin == HoldTask(
        task="merge", hold=Hold.PIN, asked=asked, node="edge1", is_hard=True, for_s=60.0, base_revision=3
    )
    tuned = command_of({**order, "verb": "tune", "tuning": TUNING})
    wanted = Tuning(weights=Weights(cpu=1.0, memory=0.0, network=0.0), bonus=0.3)
    assert tuned == TuneTask(task="merge", tuning=wanted, base_revision=3, asked=asked)
    drained = command_of({"verb": "change", "text": "x", "reason": "drain", "by": "ada@robot1", "why": "lens"})
    assert drained == ChangeFleet(document=Document(text=Text("x")), reason="drain", asked=asked)
    assert command_of({"verb": "change", "text": "x"}) == ChangeFleet(document=Document(text=Text("x")))
    kinds = [type(ev.commanded(1, command)) for command in (move, pin, tuned)]
    assert kinds == [ev.MoveCommanded, ev.HoldCommanded, ev.TuneCommanded]


def test_the_command_line_waits_as_long_as_the_desk_and_for_the_same_orders() -> None:
    """It names them by their verbs: the values' classes, and zenoh, are not loaded for a question."""
    made = {verb: get_type_hints(make)["return"] for verb, make in COMMANDS.items()}
    assert {verb for verb, kind in made.items() if issubclass(kind, Agreed)} == ask.AGREED
    assert {verb for verb, kind in made.items() if issubclass(kind, Asking)} <= ask.READS
    assert ask.ORDER_TIMEOUT_S > MOST_ORDER_S


def test_a_program_on_this_machine_orders_in_no_operator_s_and_no_other_node_s_name(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fleet_values, "LEAST_ORDER_S", 0.001)
    house.here.take(replace(fleet_of(), timing=Timing(ballot_s=0.01)))
    for said, told in (
        ({"by": "ada@robot1"}, "ada@robot1"),
        ({"by": "ana.operator"}, "ana.operator@robot1"),
        ({"by": "eve@robot2"}, "eve@robot1"),
        ({}, "robot1"),
    ):
        house.desk.answer({"verb": "change", "text": "x", **said})
        (event,) = house.events()
        assert isinstance(event, ev.FleetCommanded)
        assert event.command.asked == Asked(by=told)


def test_a_node_that_may_give_no_orders_says_so_and_still_asks(house: House) -> None:
    """A worker that reached the socket of its node could order what it liked."""
    house.here.take(fleet_of(security=fleet_values.Security(folder="pki", orders=("robot2", "robot3"))))
    for request in ({"verb": "change", "text": "x"}, {"verb": "change", "text": "x", "node": "robot2"}):
        said = house.desk.answer({"by": "eve@robot1", **request})["error"]
        assert said.startswith("robot1 gives no orders in this fleet, robot2 and robot3 may (`security: {orders: [")
    assert house.events() == []
    house.here.take(fleet_of(security=fleet_values.Security(folder="pki", orders=("robot1",))))
    house.desk.answer({"verb": "restart", "task": "merge"})
    assert [type(event) for event in house.events()] == [ev.RestartCommanded]


def test_a_daemon_is_ended_for_good_on_its_own_machine_only(house: House) -> None:
    ended: list[str] = []
    desk = Desk("robot1", house.inbox, house.adapter, house.here, leave=lambda: ended.append("robot1"))
    told = desk.answer({"verb": "leave", "node": "edge1"})
    assert (told, ended) == ({"error": "edge1 leaves by a command on its own machine: zsched leave"}, [])
    assert (desk.answer({"verb": "leave"}), ended) == ({"outcome": "ok"}, ["robot1"])


def test_desk_refuses_what_is_no_request(house: House) -> None:
    order = {"task": "merge", "by": "ada@robot1"}
    tune = {**order, "verb": "tune", "tuning": TUNING, "base_revision": 3}
    for request, says in (
        (
            {"verb": "fly"},
            "unknown verb 'fly'; known: access, certificate, change, explain, fleet, history, hold, keep, leave, ",
        ),
        ({"verb": "move", "task": "merge", "target": "edge1"}, "move: 'by' is missing"),
        ({**order, "verb": "move"}, "move: 'target' is missing"),
        ({**order, "verb": "hold", "hold": "stop"}, "hold: 'stop' is not a valid Hold"),
        ({**order, "verb": "hold", "hold": "pause", "for_s": 0.5}, "hold: hold.for_s: 0.5 is not in [1, "),
        ({**order, "verb": "hold", "hold": "pause", "reason": "x" * 201}, "hold: asked.reason: 201 characters"),
        ({**order, "verb": "tune", "tuning": {"weights": 1}, "base_revision": 3}, "tune: tuning: "),
        ({**order, "verb": "tune", "tuning": TUNING}, "tune: 'base_revision' is missing"),
        ({**order, "verb": "strike", "step": "move"}, "strike: strike.step: move is not done by a node to itself"),
        ({**order, "verb": "strike", "step": "nap"}, "strike: 'nap' is not a valid Step"),
        ({**order, "verb": "strike", "step": "link", "cut_s": 61}, "strike: strike.cut_s: "),
        ({**order, "verb": "keep", "name": "one", "told": ""}, "keep: 'body' is missing"),
        ({"verb": "rehearsals", "name": "../x"}, "rehearsals: rehearsals.name: '../x' is not a name"),
        ({"verb": "restart"}, "restart: 'task' is missing"),
        ({"verb": "lines", "task": "merge", "after": "1"}, "lines: after: expected a whole number, not '1'"),
        ({"verb": "lines", "task": "merge", "after": -1}, "lines: lines.after"),
        ({"verb": "change"}, "change: fleet: expected one of document, add_elector and remove_elector"),
        ({"verb": "change", "text": 7}, "change: text: expected the text of a fleet file, not 7"),
        ({"verb": "change", "text": "x" * 200_000}, "change: document.text: larger than 196608 bytes"),
        ({"verb": "change", "text": "x", "flags": [{"kind": "sleep"}]}, "change: flags, or rollouts: "),
        ({"verb": "change", "text": "x", "base_revision": "7"}, "change: base_revision: expected a whole number"),
        ({"verb": "change", "add_elector": "edge1"}, "change: fleet.disk: edge1 needs the id of its disk"),
        ({"verb": "status", "node": 5}, "node: 5 is not a name"),
        ({"verb": "status", "node": "*"}, "node: '*' is not a name"),
        ({"verb": "status", "node": "a/b"}, "node: 'a/b' is not a name"),
        ({**tune, "task": "No Name"}, "tune: tune.task: 'No Name' is not a name"),
        ({**tune, "base_revision": "3"}, "tune: base_revision: expected a whole number, not '3'"),
        ({**tune, "base_revision": True}, "tune: base_revision: expected a whole number, not True"),
    ):
        answer = house.desk.answer(request)
        assert answer["error"].startswith(says), answer
    assert house.events() == []
    assert house.calls == []


def test_lines_are_asked_of_the_supervisor_and_answered_as_json(house: House) -> None:
    kept = KeptLines()
    kept.add("one")
    kept.add("two")
    house.adapter.output = lambda task: kept if task == "merge" else None
    answers: list[dict[str, Any]] = []
    for task in ("merge", "other"):
        request = {"verb": "lines", "task": task, "after": 1}
        asking = threading.Thread(target=lambda asked: answers.append(house.desk.answer(asked)), args=(request,))
        asking.start()
        event = house.inbox.take(60.0)
        assert isinstance(event, ev.LinesAsked)
        assert event.command == ReadLines(task=task, after=1)
        house.shell.carry_out((do.AnswerLines(request=event.request, task=task, after=event.command.after),))
        asking.join(60.0)
    found, none = answers
    assert [(line["number"], line["text"]) for line in found["lines"]] == [(2, "two")]
    assert found["lines"][0]["age_s"] >= 0.0
    assert (found["node"], found["task"], found["newest"], found["is_here"]) == ("robot1", "merge", 2, True)
    assert (none["lines"], none["newest"], none["is_here"]) == ([], 0, False)


def test_a_history_is_asked_of_the_log_and_answered_as_json(house: House, tmp_path: Path) -> None:
    answers: list[dict[str, Any]] = []

    def ask(request: dict[str, Any]) -> None:
        asking = threading.Thread(target=lambda: answers.append(house.desk.answer(request)))
        asking.start()
        event = house.inbox.take(60.0)
        assert isinstance(event, ev.HistoryAsked)
        house.shell.carry_out((do.AnswerHistory(request=event.request, cursor=event.command.cursor),))
        asking.join(60.0)

    ask({"verb": "history"})
    assert answers.pop()["outcome"] == "invalid", "there is no log"
    house.shell.log = log = DecisionLog(tmp_path, "robot1", 7, lambda _problem: None)
    move = Move(epoch=2, revision=3, left="edge1", owner="edge2", reason="edge1 is gone", votes=(("r1", "edge2"),))
    log.put(do.RecordStory(stage="vote", text="learnt", task="merge", epoch=2, move=move))
    log.put(do.RecordStory(stage="vote", text="no move"))
    log.start()
    ask({"verb": "history", "moves": True, "cursor": ""})
    log.close()
    told = answers.pop()
    (entry,) = told["entries"]
    assert (told["node"], told["more"], entry["task"], entry["text"]) == ("robot1", False, "merge", "learnt")
    (shown,) = moves_of(told["entries"], told["now"], "merge")
    assert (shown["from"], shown["to"], shown["votes"]) == ("edge1", "edge2", {"r1": "edge2"})
    assert house.desk.answer({"verb": "history", "cursor": "1:2:3"})["error"].startswith("history: history.cursor")


def test_a_question_for_the_fleet_is_answered_with_the_text_of_its_document(house: House, tmp_path: Path) -> None:
    content = Document(text=Text("fleet: lab  # ours"), flags=(Flag(kind=FlagKind.DRAIN, subject="edge1"),))
    library = Library(fleet="lab", node="robot1", config=tmp_path / "f.yaml", state_dir=tmp_path, post=lambda _: None)
    library.store.save(content)
    house.shell.library = library
    value = replace(founded("lab", 0, ("robot1",)), document=document_hash(content))
    answers: list[dict[str, Any]] = []
    for with_document, known in ((True, value), (False, value), (True, None)):
        request = {"verb": "fleet", "with_document": with_document}
        asking = threading.Thread(target=lambda asked: answers.append(house.desk.answer(asked)), args=(request,))
        asking.start()
        event = house.inbox.take(60.0)
        assert isinstance(event, ev.FleetReadAsked)
        told = FleetTold(node="robot1", value=known, fleet_file="ab", disk="d1")
        is_wanted = event.command.with_document
        order = do.AnswerFleetRead(request=event.request, told=told, with_document=is_wanted)
        house.shell.carry_out((order,))
        asking.join(60.0)
    whole, short, blank = answers
    assert (whole["text"], whole["flags"]) == (content.text, [{"kind": "drain", "subject": "edge1"}])
    assert (whole["electors"], whole["document"]) == ([{"name": "robot1", "disk": "", "joining": 0}], value.document)
    assert (short["text"], short["revision"], short["disk"]) == ("", value.revision, "d1")
    assert (blank["revision"], blank["node"], blank["fleet_file"]) == (None, "robot1", "ab")


def test_desk_answers_several_at_once_each_with_its_own(house: House) -> None:
    answers: dict[int, dict[str, Any]] = {}

    def ask(number: int) -> None:
        tune = {"verb": "tune", "task": "merge", "tuning": TUNING, "base_revision": number, "by": "ada@robot1"}
        answers[number] = house.desk.answer(tune)

    threads = [threading.Thread(target=ask, args=(number,)) for number in range(8)]
    for thread in threads:
        thread.start()
    asked = [until(lambda: house.inbox.take(0.1), "a question") for _ in threads]
    for event in reversed(asked):
        assert event.request >= LOCAL_REQUESTS_FROM
        result = CommandResult(outcome=CommandOutcome.OK, detail="done", revision=event.command.base_revision)
        house.shell.carry_out((do.AnswerCommand(request=event.request, result=result),))
    for thread in threads:
        thread.join(60)
    assert answers == {number: {"outcome": "ok", "detail": "done", "revision": number} for number in range(8)}
    assert house.calls == [], "nothing went over the bus"


def test_desk_gives_up_on_a_loop_that_does_not_answer(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("zsched.runtime.desk.ANSWER_TIMEOUT_S", 0.05)
    assert house.desk.answer({"verb": "status"}) == {
        "error": "the decision loop of robot1 did not answer within 0.05 s"
    }
    (asked,) = house.events()
    assert isinstance(asked, ev.StatusAsked)
    house.shell.carry_out((do.AnswerCommand(request=asked.request, result=RESULT),))  # too late: no error
    assert house.events() == []


def test_an_order_that_the_loop_tells_no_end_of_may_have_been_carried_out(
    house: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fleet_values, "LEAST_ORDER_S", 0.001)
    monkeypatch.setattr("zsched.runtime.desk.ANSWER_TIMEOUT_S", 0.05)
    house.here.take(replace(fleet_of(), timing=Timing(ballot_s=0.01)))
    why = "the decision loop of robot1 did not answer within"
    for order, within_s in (
        ({"verb": "hold", "task": "merge", "hold": "pause", "by": "ada@robot1"}, 0.14),
        ({"verb": "restart", "task": "merge"}, 0.05),
    ):
        told = house.desk.answer(order)
        assert told == {"outcome": "unknown", "detail": f"{why} {within_s:g} s", "revision": None}


def test_desk_asks_other_nodes_over_the_bus_and_hands_its_errors_on(house: House) -> None:
    waited: list[float] = []

    def ask_node(node: str, command: TuneTask | None, within_s: float) -> CommandResult:
        waited.append(within_s)
        if node == "edge1":
            assert command is not None
            return RESULT
        silence = TimeoutError() if node == "edge3" else None
        raise AdapterError(f"{node} did not answer within {within_s:g} s; is it up and reachable?") from silence

    house.desk._bus = SimpleNamespace(ask_node=ask_node)  # type: ignore[assignment]
    house.here.take(replace(fleet_of(), timing=WAN))
    tune = {"verb": "tune", "task": "merge", "tuning": TUNING, "base_revision": 3, "by": "ada@robot1"}
    assert house.desk.answer({**tune, "node": "edge1"})["outcome"] == "ok"
    for node in ("edge2", "edge3"):
        assert f"{node} did not answer" in house.desk.answer({"verb": "status", "node": node})["error"]
    assert "edge2 did not answer" in house.desk.answer({**tune, "node": "edge2"})["error"], "nobody has taken it"
    unsure = {"outcome": "unknown", "detail": "edge3 did not answer within 14 s", "revision": None}
    assert house.desk.answer({**tune, "node": "edge3"}) == unsure
    assert waited == [14.0, 3.0, 3.0, 14.0, 14.0], "a question has 3 s, and an order what the fleet's timing gives it"
    assert house.events() == [], "the loop is not asked for another node"


def test_what_is_posted_quietly_wakes_nobody_and_keeps_its_order() -> None:
    inbox = Inbox()
    first, second = ev.StreamsCounted(counts=()), ev.DeadlineReached()
    inbox.post_quietly(first)
    inbox.post_quietly(second)
    assert inbox.take(0.01) is None
    assert list(inbox.waiting()) == [first, second]
    assert list(inbox.waiting()) == []
    for _ in range(WAITING_LIMIT + 5):
        inbox.post_quietly(second)
    assert len(list(inbox.waiting())) == WAITING_LIMIT
