"""`zsched rehearse` before it acts: what is refused and why, what is planned, what is kept."""

from __future__ import annotations

import copy
import itertools
import json
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from support.doors import STATUS, answering, living
from support.schemas import faults
from zsched.cli import app
from zsched.commands.base.ask import Door
from zsched.commands.base.change import OrderView
from zsched.commands.base.common import CliError
from zsched.core.values.errors import WireError
from zsched.core.values.exits import EXIT_DEGRADED, EXIT_FAILED, EXIT_OK, EXIT_TIMED_OUT
from zsched.core.values.rehearsal import Step
from zsched.core.values.struct import replace
from zsched.host.operator_client import Json
from zsched.tools.rehearsal import verb as rehearse
from zsched.tools.rehearsal.programme import MIN_CALM_S, Do, Over, Programme
from zsched.tools.rehearsal.verb import RehearseOrder, Stage

PROMISED = {
    "move": {"step": "move", "gap_s": 0.3, "decide_s": 1.0, "whole": ["echo/in/0"]},
    "drain": {"step": "drain", "gap_s": 0.3, "decide_s": None, "whole": []},
    "worker": {"step": "worker", "gap_s": 3.0, "decide_s": None, "whole": []},
    "daemon": {"step": "daemon", "gap_s": 3.0, "decide_s": 2.0, "whole": []},
    "link": {"step": "link", "gap_s": 4.0, "decide_s": 3.0, "whole": []},
}


class Daemon:
    """Answers as a robot's daemon in a fleet of two edges; notes what it is told to do."""

    def __init__(self) -> None:
        nodes = [living("edge1", "edge", "echo"), living("edge2", "edge", "echo"), living("robot1", "robot", "echo")]
        task = copy.deepcopy(STATUS["tasks"][0])
        more = {"name": "echo", "owner": "edge1", "owner_state": "alive", "revision": 7, "phase": "settled"}
        task |= {**more, "streams": [], "candidates": ["edge1", "edge2"], "pause": None, "pin": None, "switched_s": 0.1}
        self.task: Json = task
        self.status: Json = {**STATUS, "fleet": "lab", "node": "robot1", "nodes": nodes, "tasks": [task]}
        self.done: list[Json] = []
        self.refusal = ""
        self.kept: dict[str, str] = {}
        self.document, self.revision = "", 4
        self.flags: list[Json] = []
        self.on_change: Callable[[], None] = lambda: None

    def answer(self, request: Json) -> Json:
        if request["verb"] == "status":
            return copy.deepcopy(self.status)
        if request["verb"] == "rehearsals":
            body = self.kept.get(request.get("name", ""), "")
            return {"node": "robot1", "timing": "wifi", "promised": PROMISED, "names": list(self.kept), "body": body}
        if request["verb"] == "fleet":
            held = {"node": "robot1", "fleet": "lab", "revision": self.revision, "number": 1, "settled": True}
            text = "fleet: lab" if self.document else ""
            return {**held, "electors": [], "document": self.document, "text": text, "flags": self.flags}
        if not request.get("plan"):
            self.done.append(request)
        if request["verb"] == "change":
            if request["base_revision"] != self.revision:
                return {"outcome": "conflict", "detail": "overtaken", "revision": self.revision}
            self.on_change()
            self.flags, self.revision = request["flags"], self.revision + 1
            return {"outcome": "ok", "detail": "", "revision": self.revision}
        if request["verb"] == "move" and self.refusal:
            return {"outcome": "invalid", "detail": self.refusal, "revision": 7}
        return {"outcome": "ok", "detail": "it can be done", "revision": 7}


@pytest.fixture
def daemon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Daemon]:
    running = Daemon()
    with answering(running.answer, tmp_path, monkeypatch):
        yield running


def run(*words: str) -> Result:
    return CliRunner().invoke(app, ["rehearse", *words])


# --- words -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ((), "name a task, or --list"),
        (("echo", "--list"), "--list and --show go without a task"),
        (("ecko",), "has no task 'ecko'; did you mean echo?"),
        (("echo", "--pause", "5"), "--pause: at least 11 s"),
        (("echo", "--cut", "2"), "--cut: more than 3.0 s"),
        (("echo", "--cut", "61"), "at most 60 s"),
        (("echo", "-m", "x" * 400), "--reason: 400 characters, at most 200"),
        (("--show", "none"), "robot1 has kept no rehearsal 'none'"),
    ],
)
def test_wrong_words_end_as_usage_and_nothing_is_done(daemon: Daemon, words: tuple[str, ...], says: str) -> None:
    result = run(*words)
    assert result.exit_code == 2, result.output
    assert says in result.stderr
    assert daemon.done == []


# --- guard rails -----------------------------------------------------------------------------------------------------


def test_a_task_that_nobody_else_could_have_is_not_touched(daemon: Daemon) -> None:
    daemon.refusal = "edge2 has no room"
    result = run("echo", "--yes")
    assert result.exit_code == 1
    assert "echo: no candidate but edge1 is fit" in result.stderr
    assert daemon.done == []


@pytest.mark.parametrize(("key", "says"), [("pause", "zsched resume echo"), ("pin", "zsched unpin echo")])
def test_a_task_that_is_held_is_not_touched(daemon: Daemon, key: str, says: str) -> None:
    daemon.task[key] = {"by": "ann", "reason": "", "known_s": 1.0, "for_s": None, "node": "edge1", "is_hard": False}
    result = run("echo", "--yes")
    assert result.exit_code == 1
    assert says in result.stderr
    assert daemon.done == []


def test_off_a_terminal_nothing_is_done_without_consent(daemon: Daemon) -> None:
    result = run("echo", "--steps", "move,worker")
    assert result.exit_code == 2
    assert "nothing was done, for nobody can be asked here" in result.stderr
    assert daemon.done == []


def test_a_plan_says_what_is_left_out_and_does_nothing(daemon: Daemon) -> None:
    """The one daemon that this rehearsal could look through is its owner's: it must not be ended."""
    daemon.task["owner"], daemon.task["candidates"] = "robot1", ["robot1", "edge1"]
    result = run("echo", "--plan", "--json", "--steps", "move,daemon")
    assert result.exit_code == 10, result.output
    body = json.loads(result.stdout)
    assert faults(body) == []
    move, killed = body["plan"]
    assert (move["step"], move["left_out"]) == ("move", None)
    assert "give it another node by --connect" in killed["left_out"]
    assert daemon.done == []


@pytest.fixture
def refusing(daemon: Daemon) -> Daemon:
    """The one daemon that this rehearsal could look through is its owner's."""
    daemon.task["owner"], daemon.task["candidates"] = "robot1", ["robot1", "edge1"]
    return daemon


@pytest.mark.parametrize("more", [(), ("--json",)])
def test_where_every_step_is_refused_nothing_is_done_without_consent_either(
    refusing: Daemon, more: tuple[str, ...]
) -> None:
    """With --json there was no question, and what had become possible meanwhile was done."""
    result = run("echo", "--steps", "daemon", *more)
    assert result.exit_code == 1, result.output
    assert "echo: no step can be done: daemon: this rehearsal looks at the fleet through robot1" in result.stderr
    assert refusing.done == []


@pytest.mark.parametrize("more", [(), ("--json",)])
def test_where_every_step_is_refused_no_promise_was_kept(refusing: Daemon, more: tuple[str, ...]) -> None:
    result = run("echo", "--steps", "daemon", "--yes", *more)
    assert result.exit_code == 1, result.output
    assert "no step can be done" in result.stderr
    assert "every promise was kept" not in result.output
    assert refusing.done == []
    planned = run("echo", "--steps", "daemon", "--plan")
    assert (planned.exit_code, refusing.done) == (0, []), "nothing would be done"


@pytest.mark.parametrize("node", [None, "robot1"])
@pytest.mark.parametrize(("through", "is_seen"), [("edge1", False), ("edge2", True), (None, False)])
def test_the_node_at_the_endpoint_is_the_eye_whoever_answers(
    monkeypatch: pytest.MonkeyPatch, through: str | None, node: str | None, *, is_seen: bool
) -> None:
    """Without --node, or with another one, the owner passed every look on, and was ended."""

    def answer(door: Door, _request: Json) -> Json:
        if through is None:
            raise CliError(3, "nobody answers")
        return {"node": door.node or through}

    monkeypatch.setattr(rehearse, "ask_door", answer)
    stage = object.__new__(Stage)
    stage._view = OrderView(door=Door(socket=Path(), endpoint="tcp/127.0.0.1:1", node=node))
    assert stage._has_other_eye("edge1") is is_seen
    assert node is None or not stage._has_other_eye(node)


def test_only_steps_that_were_shown_as_possible_are_played(refusing: Daemon, monkeypatch: pytest.MonkeyPatch) -> None:
    """The kill was left out at the question, and is possible when its turn comes."""

    def play(_programme: Programme, stage: Stage) -> Over:
        monkeypatch.setattr(Stage, "_has_other_eye", lambda _self, _owner: True)
        for step in (Step.DAEMON, Step.WORKER):
            _, why = stage.act(Do(round=1, step=step, node="robot1", target="edge1"))
            played.append((step, why.partition(":")[0]))
        return Over(is_kept=True, why="every step is done")

    played: list[tuple[Step, str]] = []
    monkeypatch.setattr(rehearse, "_run", play)
    monkeypatch.setattr(Stage, "go_back", lambda _self: "")
    result = run("echo", "--steps", "daemon,worker", "--yes")
    assert result.exit_code == EXIT_OK, result.output
    assert played == [(Step.DAEMON, "this rehearsal looks at the fleet through robot1"), (Step.WORKER, "")]
    assert [one["step"] for one in refusing.done if one["verb"] == "strike"] == ["worker"]


def test_a_rehearsal_of_which_every_step_was_left_out_does_not_end_as_a_kept_one(
    stage: Stage, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The owner's daemon refuses what it has let be planned."""

    def play(programme: Programme, at: Stage) -> Over:
        look = at.look()
        *_, action = [programme.advance(replace(look, now=now)) for now in (0.0, 1.0, MIN_CALM_S + 1.0)]
        assert action == DRAIN
        programme.leave_out("edge1 has an order already")
        over = programme.advance(replace(look, now=MIN_CALM_S + 2.0))
        assert isinstance(over, Over)
        return over

    monkeypatch.setattr(rehearse, "_run", play)
    order = RehearseOrder(task="echo", steps=(Step.DRAIN,), pause_s=MIN_CALM_S)
    assert rehearse._play(stage._view, order, stage) == EXIT_FAILED


@pytest.mark.parametrize("left", ["a drain", "the task", "nothing"])
def test_a_rehearsal_that_leaves_something_behind_does_not_end_as_a_kept_one(
    left: str, stage: Stage, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Every promise was kept, and the fleet is not what it was before: a script must hear of it."""
    over = Over(is_kept=True, why="every step is done")
    monkeypatch.setattr(rehearse, "_run", lambda _programme, _stage: over)
    monkeypatch.setattr(stage, "lift", lambda: "a node may still be drained" if left == "a drain" else "")
    stage._base.moved = True
    monkeypatch.setattr(stage, "_moved_back", lambda _owner: (left != "the task", "edge1 is gone"))
    monkeypatch.setattr(rehearse, "BACK_S", 0.01)
    order = RehearseOrder(task="echo", steps=(Step.DRAIN,), pause_s=MIN_CALM_S)
    assert rehearse._play(stage._view, order, stage) == (EXIT_OK if left == "nothing" else EXIT_FAILED)
    told = {
        "a drain": "may still be drained",
        "the task": "echo is not back on edge1: edge1 is gone",
        "nothing": "again",
    }
    assert told[left] in capsys.readouterr().out


# --- the drain -------------------------------------------------------------------------------------------------------


DRAIN = Do(round=1, step=Step.DRAIN, node="edge1", target="edge2")


@pytest.fixture
def stage(daemon: Daemon, tmp_path: Path) -> Stage:
    """A rehearsal that may drain."""
    daemon.document = "0123456789abcdef"
    view = OrderView(door=Door(socket=tmp_path / "robot1.sock"), is_yes=True, reason="new fan")
    return Stage(view, RehearseOrder(task="echo", steps=(Step.DRAIN,)), tmp_path)


def seen(daemon: Daemon) -> None:
    """The nodes' statuses show the document's flags."""
    for one in daemon.status["nodes"]:
        one["flags"] = [flag for flag in daemon.flags if flag["subject"] == one["name"]]


def test_a_fleet_without_a_document_leaves_the_drain_out(daemon: Daemon) -> None:
    result = run("echo", "--plan", "--json", "--steps", "drain,move")
    drain, move = json.loads(result.stdout)["plan"]
    assert "has no document yet; agree one" in drain["left_out"]
    assert (move["left_out"], result.exit_code) == (None, 10)
    assert daemon.done == []


def test_a_drain_is_ours_ends_by_itself_and_is_lifted_without_touching_others(daemon: Daemon, stage: Stage) -> None:
    theirs = {"kind": "ineligible", "subject": "edge2", "by": "eve@robot2", "reason": "", "for_s": None, "revision": 2}
    daemon.flags = [theirs]
    _, why = stage.act(DRAIN)
    assert why == ""
    ours = next(flag for flag in daemon.flags if flag != theirs)
    assert (ours["kind"], ours["subject"], ours["for_s"]) == ("drain", "edge1", 120.0)
    assert ours["reason"].startswith("rehearsal ")
    seen(daemon)
    assert stage.look().drained == ("edge1",), "that of somebody else is not ours"
    assert stage.lift() == ""
    assert daemon.flags == [theirs]
    assert stage.lift() == "", "once more changes nothing"
    assert [one["verb"] for one in daemon.done] == ["change", "change"]


def test_a_robot_that_does_not_know_the_task_or_a_node_is_something_that_it_lacks(daemon: Daemon, stage: Stage) -> None:
    """A document that was changed meanwhile reaches one node after the other."""
    assert stage.look().lacks == ()
    gone = daemon.status["nodes"].pop(1)
    assert "edge2 is not known to robot1" in stage.look().lacks
    daemon.status["nodes"].insert(1, gone)
    daemon.status["tasks"] = []
    look = stage.look()
    assert (look.owner, look.lacks) == (None, ("echo: robot1 does not know it",))


def test_what_a_newer_daemon_promises_more_is_passed_over(daemon: Daemon, monkeypatch: pytest.MonkeyPatch) -> None:
    more = {**PROMISED, "move": {**PROMISED["move"], "jitter_s": 0.1}, "quake": {"step": "quake", "gap_s": 9.0}}
    monkeypatch.setitem(globals(), "PROMISED", more)
    result = run("echo", "--plan", "--json", "--steps", "move")
    assert (result.exit_code, json.loads(result.stdout)["plan"]) == (10, [{"step": "move", "left_out": None}])
    assert daemon.done == []


def test_an_owner_with_an_order_is_not_drained(daemon: Daemon, stage: Stage) -> None:
    daemon.flags = [{"kind": "drain", "subject": "edge1", "by": "eve", "reason": "", "for_s": None, "revision": 2}]
    assert stage.act(DRAIN)[1] == "edge1 has an order already; see `zsched status`"
    assert stage.lift() == ""
    assert len(daemon.flags) == 1
    assert daemon.done == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interrupted_drain_is_lifted(
    daemon: Daemon, stage: Stage, monkeypatch: pytest.MonkeyPatch, number: signal.Signals
) -> None:
    """The signal comes while the drain is being agreed, and its answer never arrives here."""

    def play(_programme: Programme, at: Stage) -> Over:
        at.act(DRAIN)
        raise AssertionError("the signal came too late")

    has_come, lift = threading.Event(), stage.lift

    def lifting() -> str:
        has_come.set()
        return lift()

    def interrupt() -> None:
        daemon.on_change = lambda: None
        signal.pthread_kill(threading.main_thread().ident or 0, number)
        assert has_come.wait(60.0), "beside others' work a thread may hear late of its signal"
        time.sleep(0.5)  # it is agreed later than the first look for it

    monkeypatch.setattr(stage, "lift", lifting)
    daemon.on_change = interrupt
    monkeypatch.setattr(rehearse, "_run", play)
    before = signal.getsignal(number)
    order = RehearseOrder(task="echo", steps=(Step.DRAIN,))
    assert rehearse._play(stage._view, order, stage) == EXIT_TIMED_OUT
    assert [one["verb"] for one in daemon.done][:2] == ["change", "change"], "drained, and undrained"
    assert daemon.flags == []
    assert signal.getsignal(number) is before


def test_a_second_ctrl_c_while_nobody_answers_tells_what_is_left(
    stage: Stage, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """It comes where the way back waits, which is nearly always: who is left with a drained node must hear of it."""
    seconds = iter([0.0])

    def pause(_s: float) -> None:
        if next(seconds, None) is not None:
            raise KeyboardInterrupt

    def refuse() -> None:
        raise CliError(EXIT_DEGRADED, "no majority of the electors answers")

    assert stage.act(DRAIN)[1] == ""
    now = itertools.count(0.0, 5.0)
    monkeypatch.setattr(stage, "lift_once", refuse)
    monkeypatch.setattr("zsched.tools.rehearsal.verb.time.sleep", pause)
    monkeypatch.setattr(rehearse, "monotonic_s", lambda: next(now))
    told = stage.lift()
    assert told.startswith("a node may still be drained: no majority of the electors answers; `zsched status` tells")
    assert "the drain is ended first" in capsys.readouterr().err
    monkeypatch.setattr(stage, "look", refuse)
    seconds = iter([0.0])
    assert "echo is not back on edge1: interrupted; `zsched move` brings it there" in stage.go_back()


def test_a_daemon_of_another_version_is_one_message_and_no_traceback(
    refusing: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    def read(_told: Json, _kind: object) -> object:
        raise WireError("unknown", "a field that a later version has")

    assert refusing.done == []
    monkeypatch.setattr(rehearse, "from_plain", read)
    result = run("echo", "--steps", "worker", "--yes")
    assert (result.exit_code, type(result.exception)) == (EXIT_FAILED, SystemExit)
    assert "a daemon's answer cannot be read (unknown: a field that a later version has); update" in result.stderr
