"""The verbs for orders: what is shown before they act, who is asked, what a daemon is told, exit codes and JSON."""

from __future__ import annotations

import copy
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from support.doors import STATUS, answering, living
from support.schemas import faults
from zsched.cli import app
from zsched.commands.base.change import user_name
from zsched.commands.base.report import render_brief, render_status
from zsched.core.values.words import CREATION_STEP
from zsched.host.operator_client import Json

TUNING: Json = {
    "weights": {"cpu": 0.5, "memory": 0.5, "network": 0.0},
    "bonus": 0.1,
    "score": "service",
    "deadline_ms": None,
}


def task(name: str, owner: str) -> Json:
    found = copy.deepcopy(STATUS["tasks"][0])
    more = {"name": name, "owner": owner, "owner_state": "alive", "revision": 7, "phase": "settled", "streams": []}
    return {**found, **more, "tuning": TUNING, "file_tuning": TUNING, "pause": None, "pin": None, "switched_s": 0.086}


class Daemon:
    """Answers as a daemon whose register takes every order."""

    def __init__(self) -> None:
        nodes = [living("edge1", "edge", "echo"), living("edge2", "edge", "echo"), living("robot1", "robot", "echo")]
        self.status: Json = {**STATUS, "fleet": "lab", "node": "robot1", "nodes": nodes}
        self.status["tasks"] = [task("echo", "edge1"), task("merge", "edge2")]
        self.orders: list[Json] = []
        self.outcome = "ok"
        self.answers: Callable[[Json], Json] = self.answer

    def answer_now(self, request: Json) -> Json:
        return self.answers(request)

    def answer(self, request: Json) -> Json:
        if request["verb"] == "status":
            return copy.deepcopy(self.status)
        one = next(one for one in self.status["tasks"] if one["name"] == request["task"])
        outcome = self.outcome
        if not request.get("plan"):
            self.orders.append(request)
            if outcome == "ok":
                self._take(one, request)
        elif request["target"] == one["owner"]:
            outcome = "unchanged"
        return {"outcome": outcome, "detail": f"{one['name']}: as told", "revision": one["revision"]}

    def _take(self, one: Json, request: Json) -> None:
        one["revision"] += 1
        if request["verb"] == "move":
            one["owner"] = request["target"]
            one["epoch"] += 1
        elif request["verb"] == "hold":
            kind = "pause" if request["hold"] in ("pause", "resume") else "pin"
            held = {"by": request["by"], "reason": request["reason"], "known_s": 3.0, "for_s": request["for_s"]}
            held |= {"node": request["target"] or one["owner"], "is_hard": request["hard"]}
            one[kind] = held if request["hold"] == kind else None


@pytest.fixture
def daemon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Daemon]:
    running = Daemon()
    with answering(running.answer_now, tmp_path, monkeypatch):
        yield running


def run(*words: str) -> Result:
    return CliRunner().invoke(app, list(words))


def test_a_pause_carries_who_why_and_how_long_and_is_listed(daemon: Daemon) -> None:
    result = run("pause", "echo", "-m", "new lens", "--for", "2h", "--yes")
    assert result.exit_code == 0, result.output
    (order,) = daemon.orders
    assert (order["hold"], order["reason"], order["for_s"], order["base_revision"]) == ("pause", "new lens", 7200.0, 7)
    assert re.fullmatch(r"[^@]+@robot1", order["by"])
    listed = run("pause")
    assert listed.stdout == f"echo: paused, for 2h00m, {order['by']}: new lens, known for 3.0s\n"
    assert run("pin").stdout == "no task is pinned\n"
    body = json.loads(run("pause", "--json").stdout)
    assert (faults(body), [one["task"] for one in body["tasks"]]) == ([], ["echo"])


@pytest.mark.parametrize("words", [("pause", "echo"), ("pin", "echo", "edge1")])
def test_an_order_that_is_given_again_changes_nothing_but_for_another_reason_or_a_time(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...]
) -> None:
    """As a drain: also where somebody else gives it; without a reason it keeps the one that it had."""
    for user, more, orders, reason in (
        ("ada", ("-m", "lens"), 1, "lens"),
        ("bob", ("-m", "lens"), 1, "lens"),
        ("bob", (), 1, "lens"),
        ("bob", ("--for", "2h"), 2, "lens"),
        ("bob", ("--for", "2h"), 3, "lens"),
        ("bob", (), 4, "lens"),
        ("bob", ("-m", "fan"), 5, "fan"),
    ):
        monkeypatch.setattr("zsched.commands.base.change.user_name", lambda user=user: user)
        before = len(daemon.orders)
        said = run(*words, *more, "--yes").stdout
        assert ("Nothing would change." in said) is (before == orders)
        assert (len(daemon.orders), daemon.status["tasks"][0][words[0]]["reason"]) == (orders, reason)
    run("pin", "echo", "edge2", "--yes")
    assert daemon.status["tasks"][0]["pin"]["reason"] == "", "a pin to another node is another order"


def test_a_pause_that_waits_ends_when_every_node_knows_it(daemon: Daemon) -> None:
    late = {"edge2": 3}

    def answer(request: Json) -> Json:
        told = Daemon.answer(daemon, request)
        name = request.get("node", "robot1")
        if request["verb"] != "status" or name == "robot1":
            return told
        late[name] = late.get(name, 0) - 1
        tasks = [{**one, "revision": 7} if late[name] >= 0 else one for one in told["tasks"]]
        return {**told, "node": name, "tasks": tasks}

    daemon.answers = answer
    result = run("pause", "echo", "--wait", "--yes", "--json")
    body = json.loads(result.stdout)
    assert (result.exit_code, faults(body), body["missing"]) == (0, [], [])
    assert late["edge2"] < 0, "it was asked until it knew"


def test_a_pause_that_some_node_never_learns_says_which(daemon: Daemon, monkeypatch: pytest.MonkeyPatch) -> None:
    def answer(request: Json) -> Json:
        told = Daemon.answer(daemon, request)
        is_late = request["verb"] == "status" and request.get("node") == "edge2"
        return {**told, "tasks": [{**one, "revision": 7} for one in told["tasks"]]} if is_late else told

    daemon.answers = answer
    monkeypatch.setattr("zsched.commands.act.hold.KNOWN_S", 0.1)
    for _ in range(2):  # given again it changes nothing, and edge2 still has not learnt it
        result = run("pause", "echo", "--wait", "--yes")
        assert result.exit_code == 5, result.output
        assert result.stdout.splitlines()[-1] == "  edge2 has not learnt revision 8 of echo"
    assert len(daemon.orders) == 1
    told = json.loads(run("pause", "echo", "--wait", "--yes", "--json").stdout)
    assert told["missing"] == ["edge2 has not learnt revision 8 of echo"]


@pytest.mark.parametrize("outcome", ["unknown", "invalid"])
def test_an_order_of_which_no_revision_is_told_is_no_fault_of_the_program(daemon: Daemon, outcome: str) -> None:
    """As a daemon answers whose loop is slow, or for another node that is silent."""

    def answer(request: Json) -> Json:
        told = {"outcome": outcome, "detail": "as told", "revision": None}
        return told if request["verb"] == "hold" else Daemon.answer(daemon, request)

    daemon.answers = answer
    code = {"unknown": 5, "invalid": 1}[outcome]
    one = run("pause", "echo", "--yes")
    assert (one.exit_code, f"echo: {outcome}: as told" in one.stderr) == (code, True), one.exception
    every = run("pause", "--all", "--yes")
    assert (every.exit_code, every.stdout.count(f"{outcome}: as told")) == (code, 2)
    assert "None" not in every.stdout
    body = json.loads(run("pause", "echo", "--yes", "--json").stdout)
    assert (faults(body), body["tasks"][0]["outcome"]) == ([], outcome)


def test_what_all_has_reached_is_told_where_the_daemon_ends_in_the_middle_of_it(daemon: Daemon) -> None:
    """One task is paused and the other may be: whoever is only told that nobody answers knows of neither."""

    def answer(request: Json) -> Json:
        is_second = request["verb"] == "hold" and request["task"] == "merge"
        told = {"error": "the decision loop of robot1 did not answer within 3 s"}
        return told if is_second else Daemon.answer(daemon, request)

    daemon.answers = answer
    result = run("pause", "--all", "--yes")
    assert result.exit_code == 5
    assert "echo: agreed (revision 8)" in result.stdout
    assert "merge: unknown: the decision loop of robot1 did not answer" in result.stdout


def test_what_was_agreed_is_told_though_the_daemon_is_silent_afterwards(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It may begin again just then; whoever is told "nobody answers" would give the order again, or stop."""

    def answer(request: Json) -> Json:
        told = Daemon.answer(daemon, request)
        is_silent = request["verb"] == "status" and daemon.orders
        return {"error": "the decision loop of robot1 did not answer within 3 s"} if is_silent else told

    daemon.answers = answer
    monkeypatch.setattr("zsched.commands.act.hold.KNOWN_S", 0.3)
    result = run("pause", "echo", "--yes")
    assert (result.exit_code, result.stdout.splitlines()[-1]) == (0, "echo: agreed (revision 8)"), result.output
    daemon.orders.clear()
    waited = run("pause", "merge", "--yes", "--wait", "--json")
    body = json.loads(waited.stdout)
    assert (waited.exit_code, faults(body), body["tasks"][0]["outcome"]) == (5, [], "ok")
    assert body["missing"] == ["the decision loop of robot1 did not answer within 3 s"]


def test_a_task_that_is_taken_out_right_after_its_pause_is_told_as_it_was(daemon: Daemon) -> None:
    def answer(request: Json) -> Json:
        told = Daemon.answer(daemon, request)
        return {**told, "tasks": told["tasks"][1:]} if request["verb"] == "status" and daemon.orders else told

    daemon.answers = answer
    result = run("pause", "echo", "--yes", "--json")
    body = json.loads(result.stdout)
    (told,) = body["tasks"]
    assert (result.exit_code, faults(body)) == (0, [])
    assert (told["task"], told["outcome"], told["revision"], told["owner"]) == ("echo", "ok", 8, "edge1")


def test_all_pauses_every_task_and_resume_ends_it(daemon: Daemon) -> None:
    assert run("pause", "--all", "--yes").exit_code == 0
    assert [order["task"] for order in daemon.orders] == ["echo", "merge"]
    body = json.loads(run("resume", "--all", "--yes", "--json").stdout)
    assert (faults(body), [one["pause"] for one in body["tasks"]]) == ([], [None, None])
    assert run("resume").stdout == "no task is paused\n"
    assert run("unpin").stdout == "no task is pinned\n"


def test_a_pin_names_its_node_and_says_when_it_is_hard(daemon: Daemon) -> None:
    assert run("pin", "echo", "edge2", "--hard", "--yes").exit_code == 0
    assert (daemon.orders[0]["target"], daemon.orders[0]["hard"]) == ("edge2", True)
    assert run("pin").stdout.startswith("echo: edge2 (hard), ")
    told_by = daemon.status["tasks"][0]["pin"]["by"]
    shown = [render(daemon.status, 100, color=False) for render in (render_brief, render_status)]
    assert "edge1 (pin edge2)" in shown[0]
    assert [f"pinned to edge2 (hard), {told_by}" in " ".join(text.split()) for text in shown] == [True, True]
    assert run("pin", "echo", "egde2").exit_code == 2


def test_a_move_waits_until_the_streams_have_settled_and_tells_what_was_measured(daemon: Daemon) -> None:
    result = run("move", "echo", "edge2", "--from", "edge1", "-m", "lens", "--yes")
    assert result.exit_code == 0, result.output
    lines = result.stdout.splitlines()
    assert lines[2] == "It is agreed. Ctrl-C ends the watching, not the move."
    assert lines[3] == "echo: settled on edge2, streams switched in 86 ms, lost 0"
    assert (daemon.orders[0]["origin"], daemon.orders[0]["target"]) == ("edge1", "edge2")
    body = json.loads(run("move", "echo", "edge1", "--yes", "--json").stdout)
    assert (faults(body), body["settled"], body["lost"], body["from"]) == ([], True, 0, "edge2")
    body = json.loads(run("move", "echo", "edge2", "--yes", "--json", "--detach").stdout)
    assert (faults(body), body["settled"], body["lost"]) == ([], False, None)


def test_a_move_waits_for_the_profile_of_a_node_that_lives(daemon: Daemon, monkeypatch: pytest.MonkeyPatch) -> None:
    looks = []

    def answer(request: Json) -> Json:
        told = Daemon.answer(daemon, request)
        if request["verb"] == "status":
            looks.append(request)
            told["nodes"][1]["cpu_cores"] = None if len(looks) < 3 else 2.0
        elif len(looks) < 3:
            told |= {"outcome": "invalid", "detail": "echo: edge2 cannot have it: no fresh profile"}
        return told

    daemon.answers = answer
    assert run("move", "echo", "edge2", "--plan").exit_code == 10
    looks.clear()
    monkeypatch.setattr("zsched.commands.act.move.KNOWN_S", 0.0)
    result = run("move", "echo", "edge2", "--yes")
    assert (result.exit_code, len(looks)) == (1, 1)
    assert "no fresh profile" in result.stderr


def test_a_move_waits_for_a_robot_that_does_not_know_the_task_yet(daemon: Daemon) -> None:
    """Nodes fetch a document that adds a task one after the other."""
    daemon.status["nodes"].append(living("robot2", "robot", "echo"))
    behind = 3

    def answer(request: Json) -> Json:
        nonlocal behind
        told = Daemon.answer(daemon, request)
        if request.get("node") == "robot2" and behind:
            behind -= 1
            told |= {"node": "robot2", "tasks": []}
        return told

    daemon.answers = answer
    done = run("move", "echo", "edge2", "--yes")
    assert (done.exit_code, behind) == (0, 0), done.output
    assert "echo: settled on edge2" in done.stdout
    behind = 10**9
    late = run("move", "echo", "edge1", "--yes", "--timeout", "0")
    assert (late.exit_code, "  echo: robot2 has not learnt of it yet" in late.stdout) == (5, True), late.output


def test_a_move_that_is_agreed_is_watched_on_while_a_node_is_silent(daemon: Daemon) -> None:
    daemon.status["nodes"].append(living("robot2", "robot", "echo"))
    for one in daemon.status["tasks"]:
        one["streams"] = [{**STATUS["tasks"][0]["streams"][0], "lost": 5, "doubled": 0, "gap_s": None}]
    silent = {"robot2": 0, "robot1": 0}

    def answer(request: Json) -> Json:
        name = request.get("node", "robot1")
        if request["verb"] == "status" and (daemon.orders or name == "robot2") and silent[name]:
            silent[name] -= 1
            return {"error": f"{name} did not answer within 3 s; is it up and reachable?"}
        return {**Daemon.answer(daemon, request), "node": name}

    daemon.answers = answer
    for name, count in (("robot2", 2), ("robot1", 1)):
        daemon.orders.clear()
        silent[name] = count
        done = run("move", "echo", "edge2", "--yes", "--json")
        body = json.loads(done.stdout)
        assert (done.exit_code, silent[name], faults(body)) == (0, 0, []), done.output
        assert (body["settled"], body["lost"], body["missing"]) == (True, 0, []), "what was lost before does not count"
        told = "robot2: no answer before the order, so what is lost there is not counted\n"
        assert done.stderr == (told if name == "robot2" else "")
        daemon.status["tasks"][0]["owner"] = "edge1"
    silent["robot2"] = 10**9
    late = run("move", "echo", "edge2", "--yes", "--timeout", "0")
    assert (late.exit_code, "  robot2 does not answer: " in late.stdout) == (5, True), late.output
    silent |= {"robot1": 10**9, "robot2": 0}
    daemon.orders.clear()
    daemon.status["tasks"][0]["owner"] = "edge1"
    gone = run("move", "echo", "edge2", "--yes", "--timeout", "0", "--json")
    body = json.loads(gone.stdout)
    assert (gone.exit_code, faults(body), body["settled"], body["lost"]) == (5, [], False, None)
    assert "robot1 did not answer within 3 s" in body["missing"][0]


def test_a_move_of_a_task_that_is_taken_out_meanwhile_says_so(daemon: Daemon) -> None:
    def answer(request: Json) -> Json:
        told = Daemon.answer(daemon, request)
        return {**told, "tasks": []} if request["verb"] == "status" and daemon.orders else told

    daemon.answers = answer
    late = run("move", "echo", "edge2", "--yes", "--timeout", "0")
    assert (late.exit_code, "  echo: robot1 does not know it" in late.stdout) == (5, True), late.output


def test_a_move_that_its_task_has_left_again_is_no_success(daemon: Daemon) -> None:
    """The new owner's worker died on its first load; the move was told as settled, with another owner's streams."""

    def answer(request: Json) -> Json:
        told = Daemon.answer(daemon, request)
        if request["verb"] != "status" or not daemon.orders:
            return told
        left = {**told["tasks"][0], "owner": "edge1", "epoch": 9, "revision": told["tasks"][0]["revision"] + 1}
        return {**told, "tasks": [left, *told["tasks"][1:]]}

    daemon.answers = answer
    result = run("move", "echo", "edge2", "--yes")
    assert result.exit_code == 1, result.output
    assert result.stdout.splitlines()[-2:] == [
        "echo: it was given to edge2, and has left it again",
        "  echo: edge1 owns it (epoch 9); `zsched history` tells why",
    ]
    daemon.orders.clear()
    body = json.loads(run("move", "echo", "edge2", "--yes", "--json").stdout)
    assert (faults(body), body["settled"], len(body["missing"])) == ([], False, 1)


def test_a_move_that_does_not_settle_in_time_exits_with_5(daemon: Daemon) -> None:
    daemon.status["tasks"][0]["phase"] = "preparing"
    result = run("move", "echo", "edge2", "--timeout", "0", "--yes")
    assert (result.exit_code, len(daemon.orders)) == (5, 1)
    assert "not settled after" in result.stdout
    assert "`zsched status` on such a node names what it waits for" in result.stdout


@pytest.mark.parametrize(("outcome", "code"), [("conflict", 1), ("no_quorum", 4), ("invalid", 1), ("unknown", 5)])
def test_an_order_that_is_not_agreed_says_so(daemon: Daemon, outcome: str, code: int) -> None:
    daemon.outcome = outcome
    for words in (("pause", "echo"), ("move", "echo", "edge2"), ("tune", "echo", "bonus=0.3")):
        result = run(*words, "--yes")
        assert (result.exit_code, "as told" in result.stderr) == (code, True), result.output
        assert (outcome in result.stderr, "no quorum" in result.stderr) == (outcome != "no_quorum", False)


def test_a_tuning_is_shown_changed_and_set_back_to_the_file(daemon: Daemon) -> None:
    assert run("tune", "echo", "bonus=0.3", "reach=all", "--yes").exit_code == 0
    told = daemon.orders[0]["tuning"]
    assert (told["bonus"], told["reach"], told["weights"]["cpu"]) == (0.3, "all", 0.5)
    daemon.status["tasks"][0]["tuning"] = {**TUNING, "bonus": 0.3}
    assert "bonus=0.3 (file: 0.1)" in run("tune", "echo").stdout
    body = json.loads(run("tune", "--json").stdout)
    assert (faults(body), len(body["tasks"])) == ([], 2)
    body = json.loads(run("tune", "echo", "bonus=null", "--yes", "--json").stdout)
    assert (faults(body), body["tasks"][0]["tuning"]["bonus"]) == ([], 0.1)


def test_epochs_and_revisions_are_counted_from_1_for_people_and_typed_back(daemon: Daemon) -> None:
    first = daemon.status["tasks"][0]
    first |= {"revision": CREATION_STEP + 7, "epoch": CREATION_STEP + 2}
    told = render_status(daemon.status, 100, color=False)
    assert ("epoch 2 " in told, "revision 7" in told, str(CREATION_STEP)[:6] in told) == (True, True, False)
    assert "(revision 7)" in run("tune", "echo").stdout
    for said in ("7", str(CREATION_STEP + 7), "6"):
        result = run("tune", "echo", f"bonus=0.{said[0]}", "--revision", said, "--yes")
        assert result.stdout.splitlines()[-1].startswith("echo: agreed (revision "), result.output
    assert [one["base_revision"] - CREATION_STEP for one in daemon.orders] == [7, 7, 6]
    assert json.loads(run("tune", "echo", "--json").stdout)["tasks"][0]["revision"] > CREATION_STEP


OWN: Json = {
    **TUNING,
    "price_s": 0.3,
    "reach": "majority",
    "nu_dbm": -80.0,
    "rho_dbm": -40.0,
}


def test_settings_of_the_file_are_tuned_and_left_to_the_file_again(daemon: Daemon) -> None:
    daemon.status["tasks"][0] |= {"tuning": OWN, "file_tuning": OWN}
    result = run("tune", "echo", "price_s=0.5", "reach=all", "nu_dbm=-70", "--yes")
    assert result.exit_code == 0, result.stderr
    assert ["echo", "price_s", "0.3", "0.5"] in [line.split() for line in result.stdout.splitlines()]
    told = daemon.orders[0]["tuning"]
    assert {key: told[key] for key in ("price_s", "reach", "nu_dbm")} == {
        "price_s": 0.5,
        "reach": "all",
        "nu_dbm": -70.0,
    }
    assert not {"rho_dbm"} & set(told), "they follow the file"
    daemon.status["tasks"][0]["tuning"] = {**OWN, "price_s": 0.5, "reach": "all"}
    assert "price_s=0.5 (file: 0.3)" in run("tune", "echo").stdout
    assert "reach=all (file: majority)" in run("tune", "echo").stdout
    plan = json.loads(run("tune", "echo", "price_s=null", "reach=majority", "--plan", "--json").stdout)
    assert (faults(plan), plan["tasks"][0]["tuning"]["price_s"]) == ([], 0.3)
    assert run("tune", "echo", "price_s=null", "reach=majority", "--yes", "--revision", "7").exit_code == 0
    assert not {"price_s", "reach"} & set(daemon.orders[-1]["tuning"])


@pytest.mark.parametrize(
    ("pair", "says"),
    [
        ("bonus", "is no setting"),
        ("bonnus=1", "did you mean bonus?"),
        ("bonus=much", "not a number"),
        ("bonus=2", "bonus: 2.0 is not in [0, 1]"),
        ("score=best", "one of paper, service"),
        ("cpu=70", "the weights' sum must be 1, and cpu=70 memory=0.5 network=0 make 70.5"),
        ("deadline_ms=0", "deadline_ms: 0.0"),
        ("price_s=-1", "price_s: -1.0 is not in [0, 1000]"),
        ("reach=some", "one of majority, all"),
        ("prise_s=1", "did you mean price_s?"),
    ],
)
def test_a_setting_that_cannot_be_is_refused_before_anybody_is_asked(daemon: Daemon, pair: str, says: str) -> None:
    result = run("tune", "echo", pair, "--yes")
    assert (result.exit_code, daemon.orders) == (2, [])
    assert says in result.stderr, result.stderr


def test_a_deadline_that_could_not_count_is_refused_as_the_fleet_file_refuses_it(daemon: Daemon) -> None:
    """Whichever of the settings comes last, and whichever command brings it."""
    for words in (("deadline_ms=100", "cpu=0", "memory=1"), ("deadline_ms=100", "score=paper")):
        result = run("tune", "echo", *words, "--yes")
        assert (result.exit_code, daemon.orders) == (2, [])
    assert "the paper's score knows no deadlines" in result.stderr
    daemon.status["tasks"][0]["tuning"] = {**TUNING, "deadline_ms": 100.0}
    result = run("tune", "echo", "cpu=0", "memory=1", "--yes")
    assert (result.exit_code, daemon.orders) == (2, [])
    assert "this task gives the CPU no weight" in result.stderr
    assert "or deadline_ms=null" in result.stderr
    assert run("tune", "echo", "cpu=0", "memory=1", "deadline_ms=null", "--yes").exit_code == 0
    daemon.status["tasks"][0]["file_tuning"] = {**TUNING, "deadline_ms": 100.0}
    for words in (("score=paper", "deadline_ms=null"), ("cpu=0", "memory=1")):
        result = run("tune", "echo", *words, "--yes")
        assert result.exit_code == 2
        assert "or a fleet file without objective: latency and deadline_ms" in result.stderr, "null is the file's"


def test_a_deadline_of_a_worker_that_tells_nothing_is_tuned_with_a_word(daemon: Daemon) -> None:
    said = "judged by service, whatever the deadline"
    assert said not in run("tune", "echo", "deadline_ms=100", "--plan").stderr, "an older program does not tell"
    for is_mute, words, is_said in (
        (False, ("deadline_ms=100",), False),
        (True, ("bonus=0.2",), False),
        (True, ("deadline_ms=100",), True),
    ):
        daemon.status["tasks"][0]["tells_no_jobs"] = is_mute
        result = run("tune", "echo", *words, "--yes")
        assert (result.exit_code, said in result.stderr) == (0, is_said), result.output
    daemon.status["tasks"][0]["tuning"] = {**TUNING, "deadline_ms": 100.0}
    assert said not in run("tune", "echo", "bonus=0.2", "--yes").stderr, "that is not what is changed"


def test_who_gives_an_order_under_sudo_is_the_one_who_called_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.getuid", lambda: 0)
    assert user_name({"SUDO_USER": "ada"}) == "ada"
    monkeypatch.setattr("os.getuid", lambda: 4_000_000)
    assert user_name({"SUDO_USER": "ada"}) == "4000000"
