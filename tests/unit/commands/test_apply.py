"""The verbs that change the fleet's document, against a node whose answers are written down here."""

from __future__ import annotations

import json
import os
import resource
import signal
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from support.schemas import faults
from zsched.cli import app
from zsched.commands.base import change as verbs
from zsched.commands.base.ask import PASSES_ON
from zsched.commands.base.change import DOCUMENT, InForce, OrderView, in_force
from zsched.commands.base.common import CliError
from zsched.commands.members import fleet
from zsched.config.editing import add_entries
from zsched.config.load import check_bytes
from zsched.core.values.fleet import fleet_hash
from zsched.host.operator_socket import OperatorSocket

Json = dict[str, Any]
TEXT = """\
fleet: hall   # the large one
nodes:
  robot1: {kind: robot, host: 127.0.0.1, listen: {control: tcp/127.0.0.1:7457, data: tcp/127.0.0.1:7458}}
  robot2: {kind: robot}
  edge1: {kind: edge}
electorate: [robot1, robot2, edge1]
tasks:
  merge:
    candidates: {kind: robot}   # who has a map
    weights: {cpu: 0.5, memory: 0.5}
"""
FLAGS = [{"kind": "drain", "subject": "robot2"}]
TASK = "tasks:\n  count: {candidates: [edge1], weights: {cpu: 1}}  # pallets\n"


class Node:
    """A node that goes by a document, agrees on every change of it, and counts the questions."""

    def __init__(self, text: str = TEXT) -> None:
        self.text, self.revision, self.document = text, 7, "ab12" * 8
        self.states = {"robot1": "alive", "robot2": "alive", "edge1": "alive"}
        self.owner = "robot1"
        self.pin: Json | None = None
        self.electors = ["edge1", "robot1", "robot2"]
        self.files: dict[str, str] = {}
        self.changes: list[Json] = []
        self.outcome = "ok"
        self.is_fetching = False
        self.drained: list[str] = []
        self.rollouts: list[Json] = []
        self.silent = 0
        """Questions by which document it goes, after a change, that it does not answer."""
        self.refused = "nothing"
        """The kind of change that another operator has overtaken."""
        self.meanwhile: list[tuple[str, list[str]]] = []
        self.unlearnt = 0
        """Conflicts before the node has learnt what came first."""
        """(verbs, electors) of what comes first at each change."""

    def answer(self, request: Json) -> Json:
        verb, node = request["verb"], str(request.get("node") or "robot1")
        if self.states[node] != "alive":
            return {"error": f"{node} did not answer within 3 s"}
        if verb == "status":
            flags = {name: [{"kind": "drain"}] for name in self.drained}
            nodes = [{"name": one, "state": self.states[one], "flags": flags.get(one, [])} for one in self.states]
            digest = self.files.get(node, digest_of(self.text))
            tasks = [{"name": "merge", "owner": self.owner, "pin": self.pin}]
            return {"fleet": "hall", "nodes": nodes, "tasks": tasks, "fleet_file": digest, "schema": "zsched.status/1"}
        if verb == "fleet" and self.changes and self.silent:
            self.silent -= 1
            return {"error": f"{node} is on its way down"}
        if verb == "fleet":
            electors = [{"name": name, "disk": f"d{name}"} for name in self.electors]
            body = {"node": node, "fleet": "hall", "revision": self.revision, "number": 2, "settled": True}
            told = {
                "electors": electors,
                "document": self.document,
                "text": self.text if self.document and not self.is_fetching else "",
                "flags": FLAGS,
                "rollouts": self.rollouts,
            }
            return {**body, **told, "fleet_file": digest_of(self.text), "disk": f"d{node}"}
        assert verb == "change"
        self.changes.append(request)
        if self.refused in request:
            return {"outcome": "conflict", "detail": "it was overtaken", "revision": None}
        if self.unlearnt:
            self.unlearnt -= 1
            return {"outcome": "conflict", "detail": "it was overtaken", "revision": None}
        if self.meanwhile:
            self.revision += 1
            self.document, self.electors = self.meanwhile.pop()
            return {"outcome": "conflict", "detail": "it was overtaken", "revision": None}
        if self.outcome != "ok":
            return {"outcome": self.outcome, "detail": "it was so", "revision": None}
        self.revision += 1
        self.rollouts = request.get("rollouts", self.rollouts)
        self.text, self.document = request.get("text", self.text), self.document or "cd34" * 8
        if removed := request.get("remove_elector"):
            self.electors.remove(removed)
        if added := request.get("add_elector"):
            assert request["disk"] == f"d{added}"
            self.electors.append(added)
        return {"outcome": "ok", "detail": "agreed", "revision": self.revision}


def digest_of(text: str) -> str:
    fleet = check_bytes(text.encode()).fleet
    assert fleet is not None
    return fleet_hash(fleet)


@pytest.fixture
def node(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Node]:
    monkeypatch.setenv("ZSCHED_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("ZSCHED_NODE", "robot1")
    one = Node()
    door = OperatorSocket(tmp_path / "robot1.sock", one.answer)
    door.open()
    yield one
    door.close()


def run(*words: object, stdin: str = "") -> Result:
    return CliRunner().invoke(app, [str(word) for word in words], input=stdin)


def changed(tmp_path: Path, old: str, new: str) -> Path:
    assert old in TEXT
    file = tmp_path / "new.yaml"
    file.write_text(TEXT.replace(old, new))
    return file


# --- apply -----------------------------------------------------------------------------------------------------------


def test_a_text_with_faults_is_not_warned_of_electors_that_it_does_not_name(node: Node, tmp_path: Path) -> None:
    """Those that are agreed stay: "two electors" would send an operator after what is not so."""
    file = changed(tmp_path, "electorate: [robot1, robot2, edge1]\n", "")
    file.write_text(file.read_text().replace("cpu: 0.5", "cpu: much"))
    node.document = "ab12" * 8
    result = run("apply", file, "--yes")
    assert (result.exit_code, node.changes) == (78, [])
    assert "much" in result.stderr
    assert "electors" not in result.stderr
    node.document = ""
    assert "electors" in run("apply", file, "--yes").stderr, "a first document says who they are"


def test_files_that_the_document_names_are_looked_for_beside_the_fleet_file(
    node: Node, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither in the folder from which the verb is called, nor in that of the new text."""
    (tmp_path / "etc").mkdir()
    monkeypatch.setenv("ZSCHED_CONFIG", str(tmp_path / "etc" / "fleet.yaml"))
    node.text += "site:\n  yard: {gateways: [tcp/192.0.2.31:7457, tcp/192.0.2.32:7457], file: yard.yaml}\n"
    for name, text in (("fleet.yaml", node.text), ("yard.yaml", "fleet: yard")):
        (tmp_path / "etc" / name).write_text(text)
    file = tmp_path / "new.yaml"
    file.write_text(node.text.replace("cpu: 0.5, memory: 0.5", "cpu: 0.6, memory: 0.4"))
    for words in (("apply", file), ("invite", "robot3")):
        result = run(*words, "--plan")
        assert (result.exit_code, "is not on this machine" in result.stderr) == (10, False), result.stderr
    (tmp_path / "etc" / "yard.yaml").unlink()
    assert f"{tmp_path / 'etc' / 'yard.yaml'} is not on this machine" in run("apply", file, "--plan").stderr


def test_a_plan_says_whether_the_owner_that_is_no_candidate_any_more_is_left(node: Node, tmp_path: Path) -> None:
    file = changed(tmp_path, "candidates: {kind: robot}", "candidates: [robot2, edge1]")
    leaves, stays = "merge leaves robot1: its streams move", "merge stays on robot1, where it is pinned hard"
    for pin, text in (
        (None, leaves),
        ({"node": "robot1", "is_hard": False}, leaves),
        ({"node": "robot1", "is_hard": True}, stays),
    ):
        node.pin = pin
        assert text in " ".join(run("apply", file, "--plan").stdout.split())


def test_a_plan_shows_before_and_after_in_the_files_words_and_changes_nothing(node: Node, tmp_path: Path) -> None:
    file = changed(tmp_path, "cpu: 0.5, memory: 0.5", "cpu: 0.6, memory: 0.4")
    result = run("apply", file, "--plan")
    assert result.exit_code == 10
    assert result.stdout.splitlines() == [
        "hall, revision 7:",
        "  tasks.merge.weights.cpu     0.5 -> 0.6  takes effect at once",
        "  tasks.merge.weights.memory  0.5 -> 0.4  takes effect at once",
    ]
    assert node.changes == []
    body = json.loads(run("apply", file, "--plan", "--json").stdout)
    assert faults(body) == []
    assert (body["outcome"], body["revision"], body["is_first"]) == ("planned", 7, False)
    assert [one["path"] for one in body["changes"]] == ["tasks.merge.weights.cpu", "tasks.merge.weights.memory"]


def test_what_a_daemon_cannot_take_over_while_it_runs_is_told_with_its_nodes(node: Node, tmp_path: Path) -> None:
    file = changed(tmp_path, "fleet: hall", "shared_memory: auto\nfleet: hall")
    result = run("apply", file, "--plan")
    assert "shared_memory  off -> auto  every daemon must be restarted" in result.stdout
    assert result.stdout.splitlines()[-1].startswith(
        "until edge1, robot1, robot2 restart: `shared_memory`: its sessions"
    )
    body = json.loads(run("apply", file, "--plan", "--json").stdout)
    assert faults(body) == []
    assert [(one["nodes"], one["by_itself"]) for one in body["restarts"]] == [(["edge1", "robot1", "robot2"], False)]
    electors = changed(tmp_path, "electorate: [robot1, robot2, edge1]", "electorate: [robot1, edge1]")
    assert json.loads(run("apply", electors, "--plan", "--json").stdout)["restarts"] == [], "they are agreed"
    lease = changed(tmp_path, "fleet: hall", "timing: {lease_s: 1.1}\nfleet: hall")
    (told,) = json.loads(run("apply", lease, "--plan", "--json").stdout)["restarts"]
    assert told["why"].startswith("`lease_s` of 1.1 s needs 4 signs of life"), "it is agreed, and sessions send fewer"
    assert node.changes == []


def test_a_restart_that_comes_by_itself_is_nobody_s_work(node: Node, tmp_path: Path) -> None:
    node.text = TEXT.replace("tcp/", "tls/") + "security: {}\n"
    come = node.text.replace("  edge1: {", "  robot3: {kind: robot}\n  edge1: {")
    file = tmp_path / "fleet.yaml"
    file.write_text(come.replace("fleet: hall", "shared_memory: auto\nfleet: hall"))
    told = run("apply", str(file), "--plan").stdout
    assert "shared_memory off -> auto daemons begin again in turns" in " ".join(told.split())
    assert "must be restarted" not in told
    assert "until edge1, robot1, robot2 begin again, by themselves: `shared_memory`" in told
    body = json.loads(run("apply", str(file), "--plan", "--json").stdout)
    assert faults(body) == []
    assert [one["by_itself"] for one in body["restarts"]] == [True]


def test_the_document_in_force_changes_nothing_and_another_comment_is_told(node: Node, tmp_path: Path) -> None:
    file = changed(tmp_path, "the large one", "the large one")
    for words in (("--plan",), ("--yes",), ()):
        result = run("apply", file, *words)
        assert (result.exit_code, result.stdout) == (0, "hall, revision 7: nothing would change\n")
    file = changed(tmp_path, "the large one", "the north one")
    result = run("apply", file, "--plan")
    assert result.exit_code == 10
    assert "only comments, blanks or the order of keys differ: nothing notices" in result.stdout
    assert node.changes == []


def test_off_a_terminal_the_command_with_yes_is_printed_and_that_command_works(node: Node, tmp_path: Path) -> None:
    file = changed(tmp_path, "cpu: 0.5, memory: 0.5", "cpu: 0.6, memory: 0.4")
    refused = run("apply", file, "-m", "less swapping")
    assert refused.exit_code == 2
    command = f"zsched apply {file} -m 'less swapping' --yes"
    assert command in refused.stderr
    assert node.changes == []
    done = run("apply", file, "-m", "less swapping", "--yes")
    assert (done.exit_code, done.stdout.splitlines()[-1]) == (0, "hall: revision 8 is agreed")
    (change,) = node.changes
    assert (change["base_revision"], change["flags"]) == (7, FLAGS)
    assert (change["reason"], change["why"]) == (f"apply {file}", "less swapping")
    assert change["by"].endswith("@robot1")
    assert node.text == file.read_text()


def test_a_revision_that_was_overtaken_is_refused_with_the_one_there_is(node: Node, tmp_path: Path) -> None:
    file = changed(tmp_path, "cpu: 0.5, memory: 0.5", "cpu: 1")
    result = run("apply", file, "--yes", "--revision", 6)
    assert (result.exit_code, node.changes) == (1, [])
    assert "revision 6 is overtaken: hall has revision 7" in result.stderr
    assert run("apply", file, "--yes", "--revision", 7).exit_code == 0


def test_electors_that_the_fleet_changes_by_itself_are_no_conflict_with_another_document(
    node: Node, tmp_path: Path
) -> None:
    """However many come one after another; the first conflict comes before the node has learnt what made it one."""
    node.unlearnt = 1
    node.meanwhile = [(node.document, ["edge1", "robot1"]), (node.document, ["edge1", "robot1", "robot2"])] * 3
    file = changed(tmp_path, "cpu: 0.5, memory: 0.5", "cpu: 1")
    result = run("apply", file, "--yes")
    bases = [one["base_revision"] for one in node.changes]
    assert (result.exit_code, bases) == (0, [7, 7, 8, 9, 10, 11, 12, 13]), result.output
    assert node.text == file.read_text()


@pytest.mark.parametrize("words", [(), ("--revision", 7)])
def test_another_document_or_a_revision_that_was_named_is_not_overtaken(
    node: Node, tmp_path: Path, words: tuple[object, ...]
) -> None:
    node.meanwhile = [(node.document if words else "ef56" * 8, node.electors)]
    result = run("apply", changed(tmp_path, "cpu: 0.5, memory: 0.5", "cpu: 1"), "--yes", *words)
    assert (result.exit_code, len(node.changes)) == (1, 1)
    assert "conflict: it was overtaken" in result.stderr


def test_a_danger_is_accepted_by_its_name_only(node: Node, tmp_path: Path) -> None:
    file = tmp_path / "new.yaml"
    file.write_text(TEXT[: TEXT.index("tasks:")] + "tasks: {}\n")
    refused = run("apply", file, "--yes")
    assert refused.exit_code == 1
    assert "remove-task: merge: its worker stops, its streams end" in refused.stderr
    assert f"zsched apply {file} --yes --accept remove-task" in refused.stderr
    assert node.changes == []
    unknown = run("apply", file, "--yes", "--accept", "remove-tasks")
    assert unknown.exit_code == 2
    assert "did you mean remove-task?" in unknown.stderr
    assert run("apply", file, "--yes", "--accept", "remove-task").exit_code == 0


def test_faults_are_those_of_check_and_another_fleets_file_is_refused(node: Node, tmp_path: Path) -> None:
    bad = changed(tmp_path, "cpu: 0.5", "cpu: 5")
    result = run("apply", bad, "--yes")
    assert (result.exit_code, result.stderr) == (78, run("check", bad).stderr)
    other = changed(tmp_path, "fleet: hall", "fleet: yard")
    result = run("apply", other, "--yes")
    assert result.exit_code == 1
    assert "is the file of fleet yard, and this is fleet hall; ask a node of yard with --connect" in result.stderr
    assert run("apply", tmp_path / "absent.yaml").exit_code == 78
    assert node.changes == []


def test_a_change_that_stops_half_way_says_how_far_it_came(node: Node, tmp_path: Path) -> None:
    """Electors and document are several changes; another operator was faster at the second."""
    file = changed(tmp_path, "electorate: [robot1, robot2, edge1]", "electorate: [robot1, edge1]")
    node.refused = "remove_elector"
    result = run("apply", file, "--yes", "--accept", "change-electors")
    assert result.exit_code == 5
    assert "1 of 2 changes are agreed, up to revision 8, and the next is not: conflict" in result.stderr
    assert node.text == file.read_text()
    node.refused = "nothing"
    assert run("apply", file, "--yes", "--accept", "change-electors").exit_code == 0, "it begins where it stopped"
    assert node.electors == ["edge1", "robot1"]
    assert ["text" in one for one in node.changes] == [True, False, False]
    assert run("apply", file, "--plan").exit_code == 0


def test_an_elector_that_is_lost_keeps_nobody_from_changing_the_rest(node: Node, tmp_path: Path) -> None:
    """The fleet was recovered: none of those that are lost could be forgotten, because of the other one."""
    node.electors = ["robot1"]
    node.states["robot2"] = node.states["edge1"] = "gone"
    file = changed(tmp_path, "electorate: [robot1, robot2, edge1]", "electorate: [robot1, robot2]")
    done = run("apply", file, "--yes", "--accept", "change-electors")
    assert done.exit_code == 0, done.stderr
    assert [(one.get("add_elector"), one.get("text")) for one in node.changes] == [(None, file.read_text())]
    node.text = node.text.replace("electorate: [robot1, robot2]", "electorate: [robot1]")
    refused = run("apply", file, "--yes", "--accept", "change-electors")
    assert (refused.exit_code, len(node.changes)) == (1, 1)
    assert "nothing was changed: robot2 cannot become an elector now" in refused.stderr, "it is named anew"


def test_electors_change_one_after_another_and_only_when_accepted(node: Node, tmp_path: Path) -> None:
    """A removal counts before the document, for a node that leaves; an addition after it, for a node that comes."""
    node.electors = ["robot1", "robot2", "edge1"]
    file = changed(tmp_path, "electorate: [robot1, robot2, edge1]", "electorate: [robot1, edge1]")
    assert run("apply", file, "--yes").exit_code == 1
    assert run("apply", file, "--yes", "--accept", "change-electors").exit_code == 0
    assert node.electors == ["robot1", "edge1"]
    back = tmp_path / "back.yaml"
    back.write_text(TEXT)
    result = run("apply", back, "--yes", "--accept", "change-electors")
    assert result.exit_code == 0, result.stderr
    assert sorted(node.electors) == ["edge1", "robot1", "robot2"]
    assert [one["base_revision"] for one in node.changes] == [7, 8, 9, 10]


# --- the first document ----------------------------------------------------------------------------------------------


def test_the_first_document_is_the_file_that_all_nodes_run_by(node: Node, tmp_path: Path) -> None:
    file = changed(tmp_path, "the large one", "the large one")
    node.document, node.revision = "", 0
    plan = run("apply", file, "--plan")
    assert plan.exit_code == 10
    assert "hall goes by the file on each machine; from then on by this one document" in plan.stdout
    node.files["edge1"] = "0123456789abcdef"
    refused = run("apply", file, "--yes")
    assert refused.exit_code == 1
    assert "other-files: edge1 go by another file now" in refused.stderr
    node.states["edge1"] = "gone"
    plan = run("apply", file, "--plan")
    assert "not asked, for they do not answer: edge1" in plan.stdout
    assert run("apply", file, "--yes").exit_code == 0
    assert [one["text"] for one in node.changes] == [TEXT]


# --- one entry -------------------------------------------------------------------------------------------------------


def test_a_task_comes_and_goes_and_the_comments_stay(node: Node, tmp_path: Path) -> None:
    file = tmp_path / "count.yaml"
    file.write_text(TASK)
    added = run("task", "add", file, "--yes")
    assert added.exit_code == 0, added.stderr
    assert "task count begins, on one of edge1" in added.stdout
    assert node.text == TEXT + TASK.partition("\n")[2]
    assert run("task", "add", file, "--yes").exit_code == 78
    node.owner = "robot1"
    unknown = run("task", "remove", "merg", "--yes")
    assert unknown.exit_code == 2
    assert "fleet hall has no task 'merg'; did you mean merge?" in unknown.stderr
    assert run("task", "remove", "merge", "--yes", "--accept", "remove-task").exit_code == 0
    assert "merge" not in node.text
    assert "# the large one" in node.text


IN_FLOW = (
    TEXT.partition("tasks:")[0] + "tasks: {merge: {candidates: {kind: robot}, weights: {cpu: 0.5, memory: 0.5}}}\n"
)


@pytest.mark.parametrize("text", [TEXT, IN_FLOW])
def test_faults_of_a_new_task_name_the_operator_s_own_file_and_its_lines(node: Node, tmp_path: Path, text: str) -> None:
    """By the lines of the merged document, which nobody has seen, they could not be found."""
    node.text = text
    file = tmp_path / "count.yaml"
    file.write_text("# pallets\ntasks:\n\n    count:\n      candidates: [edge9]\n      weights: {cpu: 1, memory: -1}\n")
    told = run("task", "add", file, "--yes").stderr
    assert f"{file}:5:20: error: " in told, told
    assert f"{file}:6:33: error: " in told, told
    assert "\n          weights: {cpu: 1, memory: -1}\n" in told
    assert DOCUMENT not in told
    assert node.changes == []


def test_a_document_that_names_no_electors_is_not_warned_of_those_that_a_first_file_would_have(
    node: Node, tmp_path: Path
) -> None:
    node.text = TEXT.replace("electorate: [robot1, robot2, edge1]\n", "")
    file = tmp_path / "robots.yaml"
    file.write_text("nodes: {robot3: {kind: robot}, robot4: {kind: robot}}\n")
    result = run("node", "add", file, "--plan")
    assert (result.exit_code, result.stderr) == (10, "")
    assert "electors survive the loss" in run("check", file_of(tmp_path, node.text, file)).stderr


def file_of(tmp_path: Path, text: str, fragment: Path) -> Path:
    whole = tmp_path / "whole.yaml"
    whole.write_text(add_entries(text, "nodes", fragment.read_text()))
    return whole


def test_a_node_may_go_that_is_no_last_elector_and_owns_nothing_while_it_lives(node: Node) -> None:
    owner = run("node", "remove", "robot1", "--yes")
    assert owner.exit_code == 1
    assert "robot1 is alive and owns merge; `zsched drain robot1` first" in owner.stderr
    node.drained = ["robot1"]
    drained = run("node", "remove", "robot1", "--yes")
    assert "owns merge; it is drained: `zsched drain robot1` says what it waits for" in drained.stderr
    assert "robot2 is alive: zsched node remove robot2" in run("node", "forget", "robot2", "--yes").stderr
    accepted = ("--accept", "remove-node", "--accept", "change-electors")
    assert run("node", "remove", "robot2", "--yes", *accepted[:2]).exit_code == 1
    done = run("node", "remove", "robot2", "--yes", *accepted)
    assert done.exit_code == 0, done.stderr
    assert [sorted({"remove_elector", "text"} & set(one)) for one in node.changes] == [["remove_elector"], ["text"]]
    assert "electorate: [robot1, edge1]" in node.text
    assert node.changes[-1]["flags"] == [], "what operators said of it goes with it"
    node.electors = ["edge1"]
    last = run("node", "remove", "edge1", "--yes")
    assert "edge1 is the last elector: without it nothing can be agreed; add another elector first" in last.stderr


def test_a_node_that_is_gone_is_forgotten(node: Node) -> None:
    node.states["edge1"], node.electors = "gone", ["robot1"]
    text = node.text = TEXT.replace("electorate: [robot1, robot2, edge1]\n", "")
    result = run("node", "forget", "edge1", "--yes", "--accept", "remove-node")
    assert result.exit_code == 0, result.stderr
    assert node.text == text.replace("  edge1: {kind: edge}\n", "")


def test_a_node_that_is_silent_once_the_change_is_agreed_is_waited_for(
    node: Node, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It may begin anew for that very change."""
    file = tmp_path / "new.yaml"
    file.write_text(node.text.replace("timing: wifi", "timing: wired").replace("cpu: 0.5, memory: 0.5", "cpu: 1"))
    node.silent = 2
    done = run("apply", file, "--yes")
    assert (done.exit_code, node.silent) == (0, 0), done.stderr
    assert "revision 8 is agreed" in done.stdout
    monkeypatch.setattr(verbs, "IN_FORCE_S", 0.2)
    file.write_text(TEXT)
    node.changes, node.silent = [], 10**9
    late = run("apply", file, "--yes")
    assert late.exit_code == 5
    assert "revision 9 is agreed, but robot1 is on its way down; see `zsched fleet show`" in late.stderr


# --- export, edit, show ----------------------------------------------------------------------------------------------


def test_an_export_that_finds_no_room_leaves_the_fleet_file_as_it_was(node: Node, tmp_path: Path) -> None:
    """A status advises to export over this machine's own file, without which its daemon does not start again."""
    own, link = tmp_path / "fleet.yaml", tmp_path / "link.yaml"
    own.write_text(f"{node.text}# older\n")
    own.chmod(0o640)
    link.symlink_to(own)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))  # as a disk that is full in the middle of it
    try:
        full = run("fleet", "export", "-o", own)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)
    assert full.exit_code == 1
    assert "File too large" in full.stderr
    assert own.read_text() == f"{node.text}# older\n"
    assert run("fleet", "export", "-o", link).exit_code == 0
    assert (own.read_text(), own.stat().st_mode & 0o777, link.is_symlink()) == (node.text, 0o640, True)
    assert sorted(one.name for one in tmp_path.iterdir() if one.suffix == ".yaml" or "yaml." in one.name) == [
        "fleet.yaml",
        "link.yaml",
    ]


def test_export_gives_the_text_back_byte_for_byte(node: Node, tmp_path: Path) -> None:
    node.text = "\ufeff" + TEXT.replace("\n", "\r\n") + "# ä"
    assert run("fleet", "export").stdout_bytes == node.text.encode()
    file = tmp_path / "out.yaml"
    assert run("fleet", "export", "-o", file).exit_code == 0
    assert file.read_bytes() == node.text.encode()
    node.document = ""
    result = run("fleet", "export")
    assert (result.exit_code, result.stdout) == (1, "")
    assert "agree one: zsched apply" in result.stderr


@pytest.fixture
def editor(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An editor that gives all weight to the cpu; drafts lie in the test's folder."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", None)
    monkeypatch.setenv("EDITOR", "sed -i s/0.5,.memory:.0.5/1/")
    monkeypatch.delenv("VISUAL", raising=False)


@pytest.mark.usefixtures("editor")
def test_edit_applies_what_the_editor_leaves_and_keeps_what_is_refused(
    node: Node, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = run("edit", "--yes")
    assert done.exit_code == 0, done.stderr
    assert node.text == TEXT.replace("0.5, memory: 0.5", "1")
    monkeypatch.setenv("EDITOR", "sed -i s/robot2,/robot9,/")
    faulty = run("edit", "--yes")
    assert faulty.exit_code == 78
    (kept,) = (path for path in tmp_path.iterdir() if path.suffix == ".yaml")
    assert f"your text is in {kept}" in faulty.stderr
    assert "robot9" in kept.read_text()
    assert kept.stat().st_mode & 0o077 == 0
    kept.unlink()
    monkeypatch.setenv("EDITOR", "false")
    assert "ended with 1; nothing was changed" in run("edit", "--yes").stderr
    monkeypatch.setenv("EDITOR", os.fspath(tmp_path / "absent"))
    assert "cannot be started" in run("edit", "--yes").stderr
    assert list(tmp_path.glob("*.yaml")) == [], "nobody has typed anything"


@pytest.mark.usefixtures("editor")
def test_edit_keeps_what_was_typed_where_it_only_plans_or_is_broken_off(
    node: Node, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = run("edit", "--plan")
    (kept,) = tmp_path.glob("*.yaml")
    assert (plan.exit_code, node.changes, "{cpu: 1}" in kept.read_text()) == (10, [], True), plan.output
    assert plan.stderr.endswith(f"your text is in {kept}; to have it agreed: zsched apply {kept}\n")
    kept.unlink()

    def broken_off(view: OrderView, make: Callable[[InForce], str], _file: str) -> int:
        make(in_force(view.door))
        raise KeyboardInterrupt

    monkeypatch.setattr(fleet, "apply_change", broken_off)
    off = run("edit")
    (kept,) = tmp_path.glob("*.yaml")
    assert (off.exit_code != 0, "{cpu: 1}" in kept.read_text()) == (True, True)
    assert f"your text is in {kept}: zsched apply {kept}" in off.stderr
    kept.unlink()
    monkeypatch.setenv("EDITOR", "true")
    assert "your text" not in run("edit").stderr
    assert list(tmp_path.glob("*.yaml")) == []


def test_edit_without_room_for_the_text_names_the_folder_and_leaves_nothing(
    node: Node, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = tempfile.mkstemp

    def full(**words: Any) -> tuple[int, str]:
        number, name = made(dir=tmp_path, **words)
        os.close(number)
        return os.open("/dev/full", os.O_WRONLY), name

    monkeypatch.setattr(tempfile, "mkstemp", full)
    failed = run("edit", "--yes")
    assert (failed.exit_code, node.changes) == (1, [])
    told = f"{tmp_path}: the text for the editor cannot be written: No space left on device"
    assert told in " ".join(failed.stderr.split())
    assert list(tmp_path.glob("*.yaml")) == []


def test_show_names_the_electors_and_who_goes_by_something_else(node: Node) -> None:
    node.states["edge1"] = "gone"
    result = run("fleet", "show")
    assert result.stdout.splitlines() == [
        "hall: revision 7, number 2, settled",
        "document ab12ab12ab12",
        "electors: edge1 (disk dedge1), robot1 (disk drobot1), robot2 (disk drobot2)",
        "  robot1  revision 7, document ab12ab12ab12",
        "  robot2  revision 7, document ab12ab12ab12",
        "  edge1   no answer",
    ]
    assert faults(json.loads(run("fleet", "show", "--json").stdout)) == []


def test_an_elector_that_only_the_document_names_is_shown_and_gets_its_seat_by_what_is_said(
    node: Node, tmp_path: Path
) -> None:
    """It has left, and that was taken back; or the fleet was recovered. What is exported differs in nothing else."""
    node.electors = ["edge1", "robot1"]
    shown = " ".join(run("fleet", "show").stdout.split())
    assert "electors by the document only: robot2; once they run: `zsched fleet export -o FILE`" in shown
    file = tmp_path / "exported.yaml"
    assert run("fleet", "export", "-o", file).exit_code == 0
    done = run("apply", file, "--accept", "change-electors", "--yes")
    assert done.exit_code == 0, done.stderr
    assert [(one.get("add_elector"), one.get("text")) for one in node.changes] == [("robot2", None)]
    assert "by the document only" not in run("fleet", "show").stdout


def test_show_does_not_take_who_may_not_be_asked_for_who_is_away(node: Node, monkeypatch: pytest.MonkeyPatch) -> None:
    """An operator's laptop asks one node of a secured fleet, and no other one through it."""
    assert node.states["edge1"] == "alive"
    asked = verbs.ask_all

    def ask_some(*given: Any) -> dict[str, Any]:
        return {**asked(*given), "edge1": CliError(3, f"edge1 did not answer within 3 s; robot1 {PASSES_ON}")}

    monkeypatch.setattr(fleet, "ask_all", ask_some)
    assert "  edge1   unknown here: robot1 passes on no command from elsewhere" in run("fleet", "show").stdout


@pytest.mark.parametrize("reason", ["by night\n2026-11-24 INFO forged", "x" * 201])
def test_a_reason_that_is_not_one_short_line_is_refused(node: Node, tmp_path: Path, reason: str) -> None:
    file = tmp_path / "new.yaml"
    file.write_text(node.text.replace("timing: wifi", "timing: wired"))
    done = run("apply", file, "--yes", "-m", reason)
    assert done.exit_code == 2
    assert "--reason: " in done.stderr
    assert node.changes == []


# --- apply --pause-after, task promote ------------------------------------------------------------------------------

ROLLED = TEXT.replace(
    "    weights: {cpu: 0.5, memory: 0.5}\n",
    "    weights: {cpu: 0.5, memory: 0.5}\n    worker: {command: [/opt/merge, -a], env: {GAIN: '1'}}\n",
).replace("{kind: robot}   #", "[edge1, robot1, robot2]   #")


def rolled(tmp_path: Path, node: Node, old: str = "-a", new: str = "-b", more: tuple[str, str] = ("", "")) -> Path:
    """A file whose worker differs from the document in force."""
    if not node.rollouts:
        node.text = ROLLED
    file = tmp_path / "new.yaml"
    file.write_text(node.text.replace(old, new).replace(*more))
    return file


def test_with_a_pause_the_first_candidates_get_the_changed_worker_and_the_document_keeps_the_other(
    node: Node, tmp_path: Path
) -> None:
    node.owner, node.drained = "edge1", []
    file = rolled(tmp_path, node)
    result = run("apply", file, "--pause-after", 1, "-m", "new net", "--yes")
    assert result.exit_code == 0, result.stderr
    assert "robot1 first; the others wait for `zsched task promote merge`" in result.stdout
    (change,) = node.changes
    assert change["text"] == file.read_text()
    (held,) = change["rollouts"]
    assert held.pop("by").endswith("@robot1")
    assert held == {
        "task": "merge",
        "first": ["robot1"],
        "command": ["/opt/merge", "-a"],
        "env": [["GAIN", "1"]],
        "reason": "new net",
        "revision": 8,
    }


def test_with_a_pause_the_key_of_a_driver_is_told_to_wait_as_a_command_is(node: Node, tmp_path: Path) -> None:
    node.owner, node.drained = "edge1", []
    node.text = ROLLED.replace("command: [/opt/merge, -a], env: {GAIN: '1'}", "driver: container, image: merge:1")
    assert "merge:1" in node.text
    file = tmp_path / "new.yaml"
    file.write_text(node.text.replace("merge:1", "merge:2"))
    result = run("apply", file, "--pause-after", 1, "--yes")
    assert result.exit_code == 0, result.stderr
    assert "robot1 first; the others wait for `zsched task promote merge`" in result.stdout
    assert "restart one after another" not in result.stdout


def test_those_go_first_that_could_get_the_task_by_name_and_the_owner_last(node: Node, tmp_path: Path) -> None:
    node.owner, node.drained = "edge1", ["robot1"]
    run("apply", rolled(tmp_path, node), "--pause-after", 2, "--yes")
    assert node.changes[-1]["rollouts"][0]["first"] == ["edge1", "robot2"]
    node.rollouts, node.states["robot2"], node.drained = [], "gone", []
    run("apply", rolled(tmp_path, node), "--pause-after", 1, "--yes")
    assert node.changes[-1]["rollouts"][0]["first"] == ["robot1"]


@pytest.mark.parametrize(
    ("count", "change", "said"),
    [
        (1, ("cpu: 0.5, memory: 0.5", "cpu: 0.6, memory: 0.4"), "no command or environment of a worker changes here"),
        (3, ("-a", "-b"), "merge has 3 candidates: nobody would be left to wait"),
        (1, ("command: [/opt/merge, -a], ", ""), "starts the workers of merge before or after only"),
        (1, ("command: [/opt/merge, -a]", "link: client, command: [/opt/merge, -b]"), "tasks.merge.worker.link would"),
    ],
)
def test_what_cannot_wait_is_refused_and_nothing_is_changed(
    node: Node, tmp_path: Path, count: int, change: tuple[str, str], said: str
) -> None:
    result = run("apply", rolled(tmp_path, node, *change), "--pause-after", count, "--yes")
    assert result.exit_code != 0
    assert said in result.stderr
    assert node.changes == []


def test_what_waits_waits_on_through_other_changes_until_the_worker_of_before_is_back(
    node: Node, tmp_path: Path
) -> None:
    run("apply", rolled(tmp_path, node), "--pause-after", 1, "--yes")
    waits = list(node.rollouts)
    run("apply", rolled(tmp_path, node, "cpu: 0.5, memory: 0.5", "cpu: 0.6, memory: 0.4"), "--yes")
    assert node.changes[-1]["rollouts"] == waits
    run("apply", rolled(tmp_path, node, "-b", "-c"), "--yes")
    assert node.changes[-1]["rollouts"] == waits, "the first ones get the newest, the others wait on"
    run("apply", rolled(tmp_path, node, "-c", "-a"), "--yes")
    assert node.changes[-1]["rollouts"] == [], "all run the worker of before"


def test_promote_lets_the_changed_worker_go_on_and_without_a_task_shows_what_waits(node: Node, tmp_path: Path) -> None:
    node.owner = "edge1"
    run("apply", rolled(tmp_path, node), "--pause-after", 1, "--yes")
    shown = run("task", "promote")
    assert (shown.exit_code, len(node.changes)) == (0, 1)
    assert "tasks.merge.worker  on robot1 -> everywhere  workers of merge restart one after another" in shown.stdout
    assert run("task", "promote", "merge").exit_code == 2, "off a terminal it takes --yes"
    assert run("task", "promote", "mergo", "--yes").exit_code == 2
    node.electors = ["edge1", "robot1"]
    planned = json.loads(run("task", "promote", "merge", "--plan", "--json").stdout)
    assert (faults(planned), planned["outcome"]) == ([], "planned")
    done = run("task", "promote", "merge", "--yes", "--revision", node.revision)
    assert done.exit_code == 0, done.stderr
    assert (node.changes[-1]["rollouts"], node.changes[-1]["text"], node.changes[-1]["flags"]) == ([], node.text, FLAGS)
    assert not [one for one in node.changes if "add_elector" in one], "one that has no seat is not asked for here"
    again = run("task", "promote", "merge", "--yes")
    assert (again.exit_code, len(node.changes)) == (1, 2)
    assert "merge waits for nothing" in again.stderr
