"""`zsched drain`, `undrain`: what they show and ask, what a daemon is told, how a drain is watched."""

from __future__ import annotations

import copy
import itertools
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from support.doors import STATUS, answering, living
from support.schemas import faults
from zsched.cli import app
from zsched.commands.act import flags as verbs
from zsched.commands.base.ask import Door
from zsched.commands.base.change import OrderView
from zsched.commands.base.report import render_brief, render_status
from zsched.host.operator_client import Json

TEXT = "fleet: lab\n"
TWO_NODES = """\
fleet: lab
nodes:
  edge1: {kind: edge, host: 127.0.0.1, listen: {control: tcp/127.0.0.1:7457, data: tcp/127.0.0.1:7458}}
  robot1: {kind: robot}
tasks: {}
"""
NODES = ("edge1", "edge2", "robot1")
ROLLOUT: Json = {"task": "echo", "first": ["edge1"], "command": ["/opt/echo"]}
"""A changed worker that waits for a look: no flag ends that."""


def task(name: str, owner: str) -> Json:
    found = copy.deepcopy(STATUS["tasks"][0])
    more = {"name": name, "owner": owner, "owner_state": "alive", "phase": "settled", "candidates": ["edge1", "edge2"]}
    decision = {**found["decision"], "reason": "nobody better", "vetoed": {"edge2": "worker failed"}}
    return {**found, **more, "streams": [], "pause": None, "pin": None, "switched_s": 0.086, "decision": decision}


def node(name: str) -> Json:
    return {**living(name, "robot" if name == "robot1" else "edge", "echo", "merge"), "flags": []}


class Daemon:
    """Answers as three daemons of a fleet with a document; after each look at a status `step` happens."""

    def __init__(self) -> None:
        nodes = [node(name) for name in NODES]
        self.status: Json = {**STATUS, "fleet": "lab", "node": "robot1", "nodes": nodes, "fleet_revision": 4}
        self.status["tasks"] = [task("echo", "edge1"), task("merge", "edge1")]
        self.flags: list[Json] = []
        self.document, self.text, self.electors = "ab" * 16, TEXT, list[Json]()
        self.changes: list[Json] = []
        self.outcome = "ok"
        self.overtaken = 0
        """Changes that the fleet's own new electors come before."""
        self.behind: set[str] = set()
        """Nodes that do not know the tasks yet."""
        self.silent: dict[str, int] = {}
        """{node: questions for its status that it does not answer}."""
        self.step: Callable[[], None] = lambda: None

    def answer(self, request: Json) -> Json:
        if request["verb"] == "status":
            body, name = copy.deepcopy(self.status), request.get("node", "robot1")
            if self.silent.get(name, 0):
                self.silent[name] -= 1
                return {"error": f"{name} did not answer within 3 s; is it up and reachable?"}
            if name == "robot1":
                self.step()
            return {**body, "node": name, **({"tasks": []} if name in self.behind else {})}
        if request["verb"] == "fleet":
            body = {"node": "robot1", "fleet": "lab", "revision": self.status["fleet_revision"], "number": 2}
            told = {"settled": True, "electors": self.electors, "document": self.document, "text": self.text}
            # as a daemon tells them: what is as by default is left out
            told["flags"] = [{key: said for key, said in flag.items() if said not in (None, "")} for flag in self.flags]
            told["rollouts"] = [ROLLOUT]
            return {**body, **told}
        assert request["verb"] == "change"
        self.changes.append(request)
        if self.overtaken:
            self.overtaken -= 1
            self.status["fleet_revision"] += 1
            return {"outcome": "conflict", "detail": "another change came first", "revision": None}
        if self.outcome == "ok":
            self.status["fleet_revision"] += 1
            self.set_flags(request["flags"])
        return {"outcome": self.outcome, "detail": "as told", "revision": self.status["fleet_revision"]}

    def set_flags(self, flags: list[Json]) -> None:
        self.flags = flags = [{"reason": "", "for_s": None, **flag} for flag in flags]
        for one in self.status["nodes"]:
            kept = [flag for flag in flags if flag["subject"] == one["name"]]
            keys = ("kind", "by", "reason", "for_s")
            one["flags"] = [{**{key: flag[key] for key in keys}, "known_s": 3.0} for flag in kept]

    def own(self, name: str, owner: str) -> None:
        next(one for one in self.status["tasks"] if one["name"] == name)["owner"] = owner


@pytest.fixture
def daemon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Daemon]:
    monkeypatch.setattr("zsched.commands.base.change.PAUSE_S", 0.001)
    running = Daemon()
    with answering(running.answer, tmp_path, monkeypatch):
        yield running


def run(*words: str) -> Result:
    return CliRunner().invoke(app, list(words))


def events(*words: str) -> list[Json]:
    """The NDJSON of a command, each line by its schema."""
    result = run(*words, "--json")
    found = [json.loads(line) for line in result.stdout.splitlines()]
    assert [fault for one in found for fault in faults(one)] == []
    return found


def test_a_drain_that_ends_by_itself_says_when_the_node_gets_tasks_again(daemon: Daemon) -> None:
    """Whoever opens the machine must not think that it stays empty until somebody says so."""
    for name in ("echo", "merge"):
        daemon.own(name, "edge2")
    ends = "edge1: empty, and gets nothing new for 27s, or until `zsched undrain edge1`"
    assert ends in run("drain", "edge1", "--yes", "--for", "30s").stdout


def test_electors_that_the_fleet_changes_by_itself_are_no_conflict_with_a_drain(daemon: Daemon) -> None:
    for name in ("echo", "merge"):
        daemon.own(name, "edge2")
    daemon.overtaken = 5
    assert run("drain", "edge1", "--yes").exit_code == 0
    assert [one["base_revision"] for one in daemon.changes] == [4, 5, 6, 7, 8, 9]


def test_a_drain_without_a_time_ends_by_hand_only_also_where_one_had_a_time(daemon: Daemon) -> None:
    """Who drains a machine must not find it at work after the time that somebody else has given."""
    for name in ("echo", "merge"):
        daemon.own(name, "edge2")
    run("drain", "edge1", "--yes", "--for", "30s", "-m", "new fan")
    again = run("drain", "edge1", "--yes")
    assert "It is agreed, and ends by hand only (edge1, was for 30s). Ctrl-C ends the watching" in again.stdout
    assert "edge1: empty, and gets nothing new until `zsched undrain edge1`" in again.stdout
    (flag,) = daemon.flags
    assert (flag["for_s"], flag["reason"]) == (None, "new fan")
    assert "Nothing would change" in run("drain", "edge1", "--yes").stdout
    assert run("undrain", "edge1", "--yes").exit_code == 0
    run("drain", "edge2", "--only", "new", "--for", "30s", "--yes")
    assert "ends by hand only (edge2, was for 30s)." in run("drain", "edge2", "--only", "new", "--yes").stdout


def test_several_nodes_are_flagged_by_one_change_that_keeps_the_other_flags(daemon: Daemon) -> None:
    other = {"kind": "ineligible", "subject": "robot1", "by": "b", "reason": "", "for_s": None, "revision": 2}
    daemon.flags = [other]
    result = run("drain", "edge2", "edge1", "--yes", "--detach", "-m", "hall", "--accept", "no-other-candidate")
    assert (result.exit_code, len(daemon.changes)) == (0, 1), result.stderr
    (change,) = daemon.changes
    assert (change["base_revision"], change["text"], change["rollouts"]) == (4, TEXT, [ROLLOUT])
    assert [(flag["subject"], flag["kind"], flag["revision"]) for flag in change["flags"]] == [
        ("edge1", "drain", 5),
        ("edge2", "drain", 5),
        ("robot1", "ineligible", 2),
    ]
    assert (change["reason"], change["why"]) == ("drain edge2, edge1", "hall")
    assert change["by"].endswith("@robot1")


def test_a_task_without_a_candidate_is_a_danger_that_is_accepted_by_name(daemon: Daemon) -> None:
    result = run("drain", "edge1", "edge2", "--yes")
    assert (result.exit_code, daemon.changes) == (1, [])
    assert "no-other-candidate: echo, merge: no candidate may get it any more" in result.stderr
    assert run("drain", "edge1", "--accept", "all", "--yes").exit_code == 2
    (planned,) = events("drain", "edge1", "edge2", "--plan")
    assert planned["reason"].startswith("no-other-candidate: echo, merge: ")
    said = {"by": "ada@robot1", "reason": "", "for_s": None, "revision": 2, "kind": "drain"}
    daemon.set_flags([{"subject": name, **said} for name in ("edge1", "edge2")])
    assert run("drain", "robot1", "--only", "new", "--yes").exit_code == 0, "it was so before"


def test_it_is_watched_until_the_node_is_empty_and_every_move_is_told(daemon: Daemon) -> None:
    moves = iter(("", "echo", "merge"))

    def step() -> None:
        if daemon.changes and (name := next(moves, "")):
            daemon.own(name, "edge2")

    daemon.step = step
    found = events("drain", "edge1", "--yes")
    assert [one["event"] for one in found] == ["agreed", "moved", "moved", "empty"]
    assert [(one["task"], one["node"], one["to"], one["lost"], one["switched_s"]) for one in found[1:3]] == [
        ("echo", "edge1", "edge2", 0, 0.086),
        ("merge", "edge1", "edge2", 0, 0.086),
    ]
    daemon.own("echo", "edge1")
    again = run("drain", "edge1", "--yes", "--deadline", "0s")
    assert re.search(r"Nothing would change \(edge1: drained, \S+@robot1\)\. Ctrl-C ends the watching", again.stdout)
    assert len(daemon.changes) == 1, "who gives it again only watches"


def test_a_drain_that_is_given_again_changes_nothing_but_for_another_reason(daemon: Daemon) -> None:
    for more, event, reason in (
        (("-m", "fan"), "agreed", "fan"),
        (("-m", "fan"), "unchanged", "fan"),
        ((), "unchanged", "fan"),
        (("-m", "new lens"), "agreed", "new lens"),
    ):
        assert [one["event"] for one in events("drain", "edge1", "--yes", "--detach", *more)] == [event]
        assert daemon.flags[0]["reason"] == reason
    assert len(daemon.changes) == 2


def test_at_the_deadline_it_says_what_is_missing_and_the_drain_stays(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(verbs, "STAYS_S", 0.1)
    result = run("drain", "edge1", "--yes", "--deadline", "1s")
    assert result.exit_code == 5
    assert "echo stays on edge1: nobody better (edge2: worker failed)" in result.stdout
    assert "edge1: not empty after 1" in result.stdout
    assert "  merge is owned by edge1" in result.stdout
    assert daemon.flags[0]["subject"] == "edge1"


def test_a_node_that_does_not_know_a_new_task_yet_breaks_no_drain(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It uses no old owner of that task; a task settles elsewhere once it knows it."""
    monkeypatch.setattr(verbs, "STAYS_S", 0.0)
    daemon.behind = {"edge1"}
    daemon.status["tasks"][0]["decision"] = None
    late = run("drain", "edge1", "--yes", "--deadline", "0s")
    assert (late.exit_code, "  merge is owned by edge1" in late.stdout) == (5, True), late.output

    def step() -> None:
        for name in ("echo", "merge"):
            daemon.own(name, "edge2")

    daemon.step = step
    assert [one["event"] for one in events("drain", "edge1", "--yes")] == ["unchanged", "empty"]


def test_a_node_that_is_silent_for_a_moment_refuses_and_ends_no_drain(daemon: Daemon) -> None:
    """Nodes are drained just when some are not well; what such a one has lost cannot be counted."""
    daemon.status["tasks"][0]["streams"] = [{**STATUS["tasks"][0]["streams"][0], "lost": 7, "doubled": 0}]
    daemon.own("merge", "edge2")
    daemon.silent = {"edge1": 2}
    looks = iter(range(10))

    def step() -> None:
        if daemon.changes and next(looks, 10) == 1:
            daemon.status["tasks"][0]["streams"][0]["lost"] = 9
            daemon.own("echo", "edge2")

    daemon.step = step
    done = run("drain", "edge1", "--yes")
    assert (done.exit_code, daemon.silent) == (0, {"edge1": 0}), done.output
    assert done.stderr == "edge1: no answer before the order, so what is lost there is not counted\n"
    assert "echo: edge1 -> edge2, streams switched in 86 ms, lost 2" in done.stdout


def test_with_force_the_deadline_does_not_count(daemon: Daemon) -> None:
    looks = iter(range(40))

    def step() -> None:
        if daemon.changes and next(looks, 40) == 20:
            daemon.own("echo", "edge2")
            daemon.own("merge", "edge2")

    daemon.step = step
    assert run("drain", "edge1", "--yes", "--force", "--deadline", "0s").exit_code == 0


def test_a_fleet_without_an_agreed_document_says_what_to_do(daemon: Daemon, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ZSCHED_CONFIG", "/run/zsched-dev-1/fleet.yaml")
    daemon.document = ""
    result = run("drain", "edge1", "--yes")
    assert (result.exit_code, daemon.changes, "zsched-dev-1" in result.stderr) == (1, [], False)
    assert result.stderr.endswith("(`zsched dev` has none to keep)\n")


def test_undrain_takes_every_drain_back(daemon: Daemon) -> None:
    said = {"by": "ada@robot1", "reason": "", "for_s": None, "revision": 2, "subject": "edge1"}
    daemon.set_flags([{"kind": "drain", **said}, {"kind": "ineligible", **said}])
    result = run("undrain", "edge1", "--yes")
    assert result.exit_code == 0
    assert [line.split()[:2] for line in result.stdout.splitlines()[1:3]] == [
        ["edge1", "drain"],
        ["edge1", "ineligible"],
    ]
    assert daemon.flags == []
    assert run("undrain", "edge1", "--yes").stdout.endswith("Nothing would change.\n")
    assert [one["event"] for one in events("undrain", "edge1", "--yes")] == ["unchanged"]


@pytest.mark.parametrize(
    ("kind", "named", "agreed", "lacks"),
    [
        ("leave", "electorate: [edge1, robot1]\n", "robot1", ["edge1"]),
        ("leave", "electorate: [edge1, robot1]\n", "edge1", []),
        ("leave", "", "robot1", []),
        ("drain", "electorate: [edge1, robot1]\n", "robot1", []),
    ],
)
def test_a_leave_that_is_taken_back_too_late_says_how_its_node_gets_its_seat_again(
    daemon: Daemon, kind: str, named: str, agreed: str, lacks: list[str]
) -> None:
    """Electors that a document names do not come by themselves, and nothing else would tell that one is missing."""
    daemon.text = f"{TWO_NODES}{named}"
    daemon.electors = [{"name": agreed, "disk": "01"}]
    said = {"by": "ada@robot1", "reason": "", "for_s": None, "revision": 2, "subject": "edge1"}
    for is_json in (False, True):
        daemon.set_flags([{"kind": kind, **said}])
        if is_json:
            told = events("undrain", "edge1", "--yes")[-1]["missing"]
        else:
            told = [line for line in run("undrain", "edge1", "--yes").stdout.splitlines() if "no elector" in line]
        assert len(told) == len(lacks)
        for line, name in zip(told, lacks, strict=True):
            assert f"{name} is no elector any more, and the document names it as one: `zsched fleet export" in line
            assert "-o FILE`, then `zsched apply FILE --accept change-electors` mends that" in line


def test_the_verbs_list_and_every_page_shows_the_flags(daemon: Daemon) -> None:
    assert run("drain").stdout == "no node is drained, as robot1 knows\n"
    said = {"by": "ada@robot1", "reason": "new fan", "for_s": 60.0, "revision": 2}
    daemon.set_flags(
        [{"kind": "drain", "subject": "edge1", **said}, {"kind": "ineligible", "subject": "edge2", **said}]
    )
    told = "drained, for 1m00s, ada@robot1: new fan"
    first, second = run("drain").stdout.splitlines()
    assert first == f"edge1: {told}, known for 3.0s"
    assert second.startswith("edge2: gets nothing new, for 1m00s, ada@robot1")
    listed, _ = events("drain")
    assert (listed["node"], listed["by"], listed["for_s"]) == ("edge1", "ada@robot1", 60.0)
    for page in (render_brief(daemon.status, 100, color=False), render_status(daemon.status, 100, color=False)):
        assert f"edge1: {told}, known for 3.0s" in page
        assert " drained " in page
        assert " no new " in page


def test_nodes_that_get_nothing_new_keep_their_tasks_and_are_not_watched(daemon: Daemon) -> None:
    result = run("drain", "edge1", "--only", "new", "--yes")
    assert (result.exit_code, [line.split()[0] for line in result.stdout.splitlines()]) == (0, ["WHAT", "edge1", "It"])
    assert [flag["kind"] for flag in daemon.flags] == ["ineligible"]


def test_the_end_of_a_rehearsals_drain_leaves_one_that_was_given_without_a_reason(
    daemon: Daemon, tmp_path: Path
) -> None:
    """A rehearsal that could not end its own drain would leave the machine empty for a minute or more."""
    plain = {"kind": "drain", "subject": "edge2", "by": "ada@robot1", "revision": 2}
    daemon.set_flags([plain, {**plain, "subject": "edge1", "reason": "rehearsal 7"}])
    view = OrderView(door=Door(socket=tmp_path / "robot1.sock"), is_yes=True, reason="rehearsal 7")
    assert verbs.lift_quietly(view, since=1) == ("edge1",)
    assert [flag["subject"] for flag in daemon.flags] == ["edge2"]


def test_a_drain_that_is_over_before_its_node_is_empty_is_not_said_to_stay_in_force(daemon: Daemon) -> None:
    """Somebody has taken it back, or its time is over: nothing empties the node any more."""
    looks = itertools.count()

    def step() -> None:
        if daemon.flags and next(looks) == 3:
            daemon.set_flags([])

    daemon.step = step
    result = run("drain", "edge1", "--yes", "--deadline", "3s")
    assert result.exit_code == 1
    assert "edge1: the drain is not in force any more: it was taken back, or its time is over" in result.stderr
    assert "stays in force" not in result.stdout
