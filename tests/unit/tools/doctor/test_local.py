"""Faults planted on one machine (files, sockets, processes, answers): each is found by its check, with what to do."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from support.clinic import FLEET, answer, assert_finds, make_state, run, scene_of, status_of
from support.fleet_values import fleet_value_of
from support.planted_faults import found_in
from zsched import __version__
from zsched.commands.base.places import Machine
from zsched.config.load import load_fleet
from zsched.core.values.codec import as_plain, document_hash
from zsched.core.values.document import Document, Text
from zsched.core.values.electorate import Elector, FleetValue
from zsched.core.values.model import RegisterState
from zsched.host.clock import ClockWatch, Drift
from zsched.host.document_store import DocumentStore
from zsched.host.machine.device_profiler import DeviceProfiler
from zsched.host.operator_socket import OperatorSocket
from zsched.host.radio.nl80211 import GenericNetlink, Interface
from zsched.tools.doctor import look as looking
from zsched.tools.doctor import machine, state
from zsched.tools.doctor.look import look
from zsched.tools.doctor.model import Check, Scene, Verdict
from zsched.tools.doctor.table import CHECKS, run_all

FAIL, WARN, PASS, SKIP = Verdict.FAIL, Verdict.WARN, Verdict.PASS, Verdict.SKIP
HERE = Path(__file__).parent
BESIDE = HERE.parents[2] / "parts" / "tools" / "doctor"
FOUND = found_in(path for folder in (HERE, BESIDE) for path in folder.glob("test_*.py"))
ROBOTS_OWN = FLEET.replace("  robot1: {kind: robot}", "  robot1: {kind: robot, wifi: wlan7}")


def test_a_machine_in_order_has_no_fault(tmp_path: Path) -> None:
    """What these checks say of the machine itself (its unit, its memory) is another matter."""
    elsewhere = (
        "unit.",
        "machine.",
        "tls.open",
        "net.ports",
        "clock.",
        "state.fsync",
        "state.space",
    )
    scene = scene_of(tmp_path, node="robot1")
    bad = [(check.name, result) for check, result in run_all(scene) if result.fix]
    assert [one for one in bad if not one[0].startswith(elsewhere)] == []
    assert len(run_all(scene)) >= 20


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.name)
def test_a_planted_fault_is_found_by_every_check(check: Check) -> None:
    """By its name or its function: a new check comes with a test that fails unless it finds what was planted."""
    function = f"{check.run.__module__.rpartition('.')[2]}.{check.run.__name__}"
    assert {check.name, function} & FOUND


# --- the fleet file --------------------------------------------------------------------------------------------------


def test_a_wrong_fleet_file_is_found_and_what_needs_it_is_skipped(tmp_path: Path) -> None:
    scene = scene_of(tmp_path, FLEET.replace("kind: edge, host", "kind: ege, host"))
    results = {check.name: result for check, result in run_all(scene)}
    assert_finds(results["file.valid"], FAIL, "fleet.yaml:4:", "ege")
    assert results["state.valid"].verdict is results["worker.imports"].verdict is SKIP


def test_a_fleet_file_that_may_be_better_is_a_warning(tmp_path: Path) -> None:
    assert_finds(run("file.warnings", scene_of(tmp_path, FLEET.replace("  robot3: {kind: robot}\n", ""))), WARN, "two")


def test_a_machine_that_the_file_does_not_name_is_found(tmp_path: Path) -> None:
    assert_finds(run("file.node", scene_of(tmp_path, node="robot9")), FAIL, "robot9", "robot1")


def test_a_daemon_with_yesterday_s_file_is_found(tmp_path: Path) -> None:
    scene = scene_of(tmp_path)
    scene.file.write_text(FLEET.replace("cpu: 0.5, memory: 0.5", "cpu: 0.6, memory: 0.4"))
    newer = scene_of(tmp_path, scene.file.read_text(), own=scene.own)
    assert run("file.in_force", scene).verdict is PASS
    result = run("file.in_force", newer)
    assert_finds(result, WARN, "goes by a file of hash")
    assert result.fix.startswith("sudo systemctl reload zsched")


def test_a_file_with_other_electors_is_no_reason_to_restart(tmp_path: Path) -> None:
    """A daemon that started by it would be no elector any more."""
    scene = scene_of(tmp_path)
    scene.file.write_text(FLEET.replace("tasks:", "electorate: [robot1]\ntasks:"))
    result = run("file.in_force", scene_of(tmp_path, scene.file.read_text(), own=scene.own))
    assert_finds(result, WARN, "goes by a file of hash")
    assert "restart no daemon" in result.fix


def test_a_file_that_is_not_the_agreed_document_is_no_fault(tmp_path: Path) -> None:
    scene = scene_of(tmp_path)
    scene.file.write_text(FLEET.replace("cpu: 0.5, memory: 0.5", "cpu: 0.6, memory: 0.4"))
    agreed = scene_of(tmp_path, scene.file.read_text(), own={**(scene.own or {}), "document": "0d" * 8})
    result = run("file.in_force", agreed)
    assert result.verdict is PASS
    assert "goes by the agreed document" in "\n".join(result.evidence)


AGREED = FLEET.replace("  robot3: {kind: robot}\n", "  robot3: {kind: robot}\n  robot4: {kind: robot}\n")


def agreed_on(folder: Path, text: str = AGREED) -> FleetValue:
    """The state and the document of edge1, as agreed: robot4 has come, and only edge1 elects."""
    file = folder / "agreed.yaml"
    file.write_text(text)
    content = Document(text=Text(text))
    DocumentStore(folder / "state").save(content)
    value = fleet_value_of(9, Elector(name="edge1", disk="01", joining=1), document=document_hash(content))
    make_state(load_fleet(file), "edge1", folder / "state", fleet_register=RegisterState(task="hall", learnt=value))
    return value


def machine_of(scene: Scene, folder: Path) -> Machine:
    return Machine(file=scene.file, state_folder=folder / "state", runtime_folder=folder, node="edge1")


def test_where_a_document_is_agreed_it_counts_and_not_the_file(tmp_path: Path) -> None:
    by_file = scene_of(tmp_path)
    value = agreed_on(tmp_path)
    answer = {"text": AGREED, "value": as_plain(value), "document": value.document}
    door = OperatorSocket(
        tmp_path / "edge1.sock", lambda asked: answer if asked["verb"] == "fleet" else {"error": "not asked for"}
    )
    from_disk = look(machine_of(by_file, tmp_path), is_fleet=False)
    door.open()
    try:
        from_daemon = _seen(look(machine_of(by_file, tmp_path), is_fleet=False), by_file)
    finally:
        door.close()
    for scene in (_seen(from_disk, by_file), from_daemon):
        assert (scene.text, scene.revision, scene.fleet.electors) == (AGREED, 9, ("edge1",))
        assert [node.name for node in scene.fleet.nodes][-1] == "robot4"
        assert "nothing goes by it, for a document is agreed" in run("file.valid", scene).evidence[0]
        told = "the agreed document (revision 9): no warnings"
        assert run("file.warnings", scene).evidence == (told,), "electors are agreed: the file's default is moot"
        assert run("file.in_force", scene).evidence[1] == "revision 9: 5 nodes, 1 task"
        assert run("state.elector", scene).evidence == ("edge1 is one of 1 electors, and its state is theirs",)
    other = replace(from_daemon, is_fleet=True, statuses={"robot1": {"fleet_file": "00"}})
    found = run("fleet.files", other)
    assert_finds(found, FAIL, "the agreed document (revision 9) here has")
    assert "zsched fleet show" in found.fix


def test_an_elector_that_only_the_document_names_is_found(tmp_path: Path) -> None:
    """It gave its seat up, and its leave was taken back: nothing else tells that one machine less may be away."""
    by_file = scene_of(tmp_path)
    agreed_on(tmp_path, f"{AGREED}electorate: [edge1, robot1, robot2]\n")
    seen = look(machine_of(by_file, tmp_path), is_fleet=False)
    assert run("state.elector", seen).verdict is PASS
    assert seen.unseated == ("robot1", "robot2")
    there = replace(seen, node="robot2")
    told = "robot2 is no elector, and the agreed document (revision 9) names it as one"
    assert_finds(run("state.elector", there), WARN, told)
    found = run("fleet.electors", replace(seen, is_fleet=True, statuses={"edge1": status_of(seen.fleet, "edge1")}))
    assert_finds(found, WARN, "names electors that are none: robot1, robot2")
    assert "while robot1, robot2 run: zsched fleet export" in found.fix
    assert "zsched apply FILE --accept change-electors" in found.fix


def _seen(scene: Scene, by_file: Scene) -> Scene:
    """The same, with the answer of a daemon that goes by the document."""
    return replace(scene, own={**(by_file.own or {}), "document": "0d" * 8})


def test_a_document_that_cannot_be_read_here_leaves_the_file(tmp_path: Path) -> None:
    scene = scene_of(tmp_path)
    value = agreed_on(tmp_path)
    (tmp_path / "state" / "documents" / value.document).write_text("broken")
    seen = look(machine_of(scene, tmp_path), is_fleet=False)
    assert (seen.document, seen.text, len(seen.fleet.nodes)) == (None, "", 4)


# --- the state -------------------------------------------------------------------------------------------------------


def test_an_elector_without_a_state_is_found(tmp_path: Path) -> None:
    scene = scene_of(tmp_path, node="robot1")
    assert run("state.valid", scene).verdict is PASS
    (scene.state_folder / "state").unlink()
    assert_finds(run("state.valid", scene), FAIL, "does not exist", "cannot vote")
    assert "what `zsched fleet export` writes on a living node" in run("state.valid", scene).fix
    edge = replace(scene, node="edge1")
    assert_finds(run("state.valid", edge), WARN, "works without")


def test_a_damaged_state_and_another_node_s_are_found(tmp_path: Path) -> None:
    scene = scene_of(tmp_path, node="robot1")
    assert_finds(run("state.valid", replace(scene, node="robot2")), FAIL, "belongs to the node 'robot1'")
    file = scene.state_folder / "state"
    file.write_bytes(file.read_bytes()[:-3])
    assert_finds(run("state.valid", scene), FAIL, "damaged")


@pytest.mark.parametrize("field", ["electorate", "disputed", "lost"])
def test_a_state_by_which_nobody_may_vote_is_found(tmp_path: Path, field: str) -> None:
    scene = scene_of(tmp_path, node="robot1")
    assert run("state.elector", scene).verdict is PASS
    make_state(scene.fleet, "robot1", scene.state_folder, **{field: "something else"})
    assert_finds(run("state.elector", scene), FAIL)


def test_a_slow_disk_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    took_s = state._sync_s(tmp_path)
    assert 0.0 < took_s < 5.0
    assert list(tmp_path.iterdir()) == []
    assert state.judged_sync(0.004, 0.3, tmp_path).verdict is PASS
    assert_finds(state.judged_sync(0.06, 0.3, tmp_path), WARN, "60.0 ms")
    assert_finds(state.judged_sync(0.2, 0.3, tmp_path), FAIL, "ballot_s = 0.3 s")
    scene = scene_of(tmp_path)
    monkeypatch.setattr(state, "_sync_s", lambda _folder: scene.fleet.timing.ballot_s)
    assert_finds(run("state.fsync", scene), FAIL, str(scene.state_folder), "ballot_s")


def test_the_state_folder_s_own_disk_is_looked_at(tmp_path: Path) -> None:
    scene = scene_of(tmp_path)
    for name, word in (("state.fsync", "median of 5"), ("state.space", "MiB left")):
        (told, *_) = run(name, scene).evidence
        assert str(scene.state_folder) in told
        assert word in told
    assert run("state.fsync", replace(scene, state_folder=tmp_path / "none")).verdict is SKIP


def test_a_full_and_a_read_only_disk_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def judged(**facts: Any) -> Any:
        return state.judged_space(tmp_path, **{"free": 1 << 30, "files": 1000, "is_read_only": False, **facts})

    assert judged().verdict is PASS
    assert_finds(judged(free=5000), FAIL, "0 MiB left")
    assert_finds(judged(free=9 << 20), WARN, "9 MiB left")
    assert_finds(judged(files=3), FAIL, "3 files")
    assert_finds(judged(is_read_only=True), FAIL, "read-only")
    scene = scene_of(tmp_path)
    facts = os.statvfs(scene.state_folder)
    full = os.statvfs_result((*facts[:4], 0, *facts[5:]))  # no block is left for this user
    monkeypatch.setattr(os, "statvfs", lambda _folder: full)
    assert_finds(run("state.space", scene), FAIL, "0 MiB left")


# --- the daemon ------------------------------------------------------------------------------------------------------


def test_a_daemon_that_is_not_there_is_found(tmp_path: Path) -> None:
    scene = replace(scene_of(tmp_path), own=None, refusal="cannot reach edge1.sock: no such file")
    found = run("daemon.answers", scene)
    assert_finds(found, FAIL, "cannot reach")
    assert found.fix.startswith("sudo systemctl start zsched")


def test_a_wedged_daemon_is_to_be_restarted(tmp_path: Path) -> None:
    """`systemctl start` finds it started, and does nothing."""
    refusal = "the daemon at edge1.sock did not answer within 5 s; is it wedged?"
    found = run("daemon.answers", replace(scene_of(tmp_path), own=None, refusal=refusal))
    assert_finds(found, FAIL, "is it wedged")
    assert found.fix.startswith("sudo systemctl restart zsched")


def test_a_daemon_that_goes_away_while_a_slow_answer_is_asked_for_again_ends_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = scene_of(tmp_path)
    own, asked = scene.status, list[str]()

    def through(_door: Path, node: str) -> tuple[dict[str, Any] | None, float]:
        asked.append(node)
        return ({**own, "node": node}, 9.0) if asked.count(node) == 1 else (None, 0.0)

    fleet = scene.reading.fleet
    assert fleet is not None
    monkeypatch.setattr(looking, "_through", through)
    found = looking._all(fleet, "robot1", tmp_path / "robot1.sock")
    assert found.answered_s == {node.name: 9.0 for node in fleet.nodes if node.name != "robot1"}
    assert len(asked) > len(fleet.nodes)


def test_a_daemon_of_another_version_is_found(tmp_path: Path) -> None:
    scene = scene_of(tmp_path)
    assert run("daemon.version", scene).verdict is PASS
    assert_finds(run("daemon.version", answer(scene, version="0.0.9")), WARN, "0.0.9")


def test_a_relay_of_another_versions_code_is_found(tmp_path: Path) -> None:
    scene = scene_of(tmp_path)
    assert run("daemon.version", replace(scene, relay_version=__version__)).verdict is PASS
    assert_finds(run("daemon.version", replace(scene, relay_version="0.1")), WARN, "by the code of 0.1")


def test_a_decision_loop_that_lags_is_found(tmp_path: Path) -> None:
    scene = scene_of(tmp_path)
    assert run("daemon.lag", scene).verdict is PASS
    assert_finds(run("daemon.lag", answer(scene, loop_lag_s=0.3)), WARN, "300.0 ms")
    assert_finds(run("daemon.lag", answer(scene, loop_lag_s=0.9)), FAIL, "suspect")


def test_what_the_daemon_names_is_told(tmp_path: Path) -> None:
    scene = answer(scene_of(tmp_path), problems=["relay: the relay is down"])
    assert_finds(run("daemon.problems", scene), WARN, "the relay is down")


def test_who_was_refused_is_told_with_the_counter(tmp_path: Path) -> None:
    scene = scene_of(tmp_path)
    assert run("tls.refused", scene).verdict is PASS
    counters = {"dropped_data_link_stranger": 3, "dropped_allocation_link": 2, "dropped_beat_rate": 9}
    refused = answer(scene, counters={**scene.status["counters"], **counters})
    found = run("tls.refused", refused)
    assert_finds(
        found, WARN, "not let in: 3 (`dropped_data_link_stranger`)", "another name", "2 (`dropped_allocation_link`)"
    )
    assert "beat_rate" not in str(found)


def test_who_was_refused_before_and_is_not_any_more_is_no_warning(tmp_path: Path) -> None:
    """Every machine that joins dials before the others let it in."""
    scene = scene_of(tmp_path)
    counters = {"dropped_link_stranger": 30, "dropped_data_link_stranger": 3, "dropped_beat_rate": 9}
    ages = {"dropped_link_stranger": 61.0, "dropped_data_link_stranger": 300.0, "dropped_beat_rate": 1.0}
    over = answer(scene, counters=counters, dropped_ages=ages)
    assert run("tls.refused", over).verdict is PASS
    assert "before, since it started: 30 `dropped_link_stranger`, 3 `dropped_data" in str(run("tls.refused", over))
    again = answer(scene, counters=counters, dropped_ages={**ages, "dropped_link_stranger": 2.0})
    assert_finds(run("tls.refused", again), WARN, "not let in: 30 (`dropped_link_stranger`)")
    assert "dropped_data_link" not in str(run("tls.refused", again))
    named = answer(scene, counters=counters, dropped_ages=ages, refused=["robot9 dials with a key that is revoked"])
    assert_finds(run("tls.refused", named), WARN, "robot9 dials with a key that is revoked")


def test_a_task_without_an_owner_and_a_lost_quorum_are_found(tmp_path: Path) -> None:
    scene = scene_of(tmp_path)
    assert run("task.owners", scene).verdict is PASS
    (task,) = scene.status["tasks"]
    lost = answer(scene, tasks=[{**task, "owner": None}], quorum={**scene.status["quorum"], "ok": False, "alive": 1})
    assert_finds(run("task.owners", lost), FAIL, "no quorum: 1 of 3", "merge has no owner")
    nobody = run("task.owners", answer(scene, tasks=[{**task, "owner": None}]))
    assert nobody.fix.startswith("zsched explain merge"), "which says why each candidate cannot have it"
    assert_finds(run("task.owners", answer(scene, tasks=[{**task, "owner_state": "gone"}])), FAIL, "edge1 is gone")


def test_a_node_that_gets_nothing_new_is_told_and_a_task_without_a_candidate_is_a_fault(tmp_path: Path) -> None:
    scene = scene_of(tmp_path)
    assert run("node.flags", scene).verdict is PASS
    flag = {"kind": "drain", "by": "ada@robot1", "reason": "new fan", "known_s": 90.0, "for_s": None}

    def flagged(name: str) -> Scene:
        nodes = [{**one, "flags": [flag] if one["name"] == name else []} for one in scene.status["nodes"]]
        return answer(scene, nodes=nodes)

    told = "robot1 is drained by ada@robot1 (new fan), known here for 90 s"
    assert_finds(run("node.flags", flagged("robot1")), WARN, told)
    assert_finds(run("node.flags", flagged("edge1")), FAIL, "merge: no candidate may get it", "edge1 is drained by ada")


def test_a_worker_that_failed_is_found(tmp_path: Path) -> None:
    scene = scene_of(tmp_path)
    assert run("worker.state", scene).verdict is PASS
    load = {"task": "merge", "state": "failed", "reason": "no such camera"}
    broken = answer(scene, nodes=[{"name": "edge1", "workers": [load]}])
    assert_finds(run("worker.state", broken), FAIL, "no such camera")
    assert "zsched restart merge edge1" in run("worker.state", broken).fix


@pytest.mark.parametrize(
    ("load", "verdict", "fix"),
    [
        (
            {"state": "starting", "trouble": "lost", "reason": "was ready until 12:00:00 UTC, its token went"},
            FAIL,
            "zsched logs merge edge1; zsched restart merge edge1 starts it anew",
        ),
        (
            {"state": "stopped", "trouble": "lost", "reason": "was ready until 12:00:00 UTC: start it again on edge1"},
            FAIL,
            "somebody else starts it: do so as the line says",
        ),
        (
            {"state": "starting", "trouble": "again", "reason": "restarting (failure 1 of 3): killed"},
            WARN,
            "zsched logs merge edge1 shows what it printed",
        ),
        ({"state": "ready", "reason": "raises: no model file"}, WARN, "zsched logs merge edge1 shows what it printed"),
    ],
)
def test_advice_for_a_worker_names_its_node_for_the_owner_s_may_be_well(
    tmp_path: Path, load: dict[str, str], verdict: Verdict, fix: str
) -> None:
    scene = scene_of(tmp_path)
    (task,) = scene.status["tasks"]
    nodes = [{"name": "edge1", "workers": [{"task": "merge", **load}]}]
    result = run("worker.state", answer(scene, nodes=nodes, tasks=[{**task, "owner": "robot1"}]))
    assert (result.verdict, result.fix) == (verdict, fix)


def test_an_owner_whose_worker_hangs_is_found_by_its_node_and_by_the_others(tmp_path: Path) -> None:
    scene = scene_of(tmp_path)
    why = "was ready until 12:00:00 UTC, its token went: it may hang"
    load = {"task": "merge", "state": "starting", "trouble": "lost", "reason": why}
    hung = answer(scene, nodes=[{"name": "edge1", "workers": [load]}])
    assert_finds(run("worker.state", hung), FAIL, f"the worker of merge {why}")
    assert_finds(run("task.owners", hung), FAIL, f"merge: the worker of its owner edge1 {why}")
    first = answer(scene, nodes=[{"name": "edge1", "workers": [{**load, "trouble": "", "reason": ""}]}])
    assert run("worker.state", first).verdict is PASS, "it starts"
    assert run("task.owners", first).verdict is PASS


def test_a_task_that_no_other_candidate_could_take_is_found(tmp_path: Path) -> None:
    scene = scene_of(tmp_path)
    (task,) = scene.status["tasks"]
    told = "no other candidate can take it: the worker on edge2 is starting"
    said = {"problems": [told], "problem_kinds": ["no_spare"]}
    assert_finds(run("task.owners", answer(scene, tasks=[{**task, **said}])), WARN, f"merge: {told}")
    assert run("task.owners", answer(scene, tasks=[{**task, **said, "problem_kinds": ["other"]}])).verdict is PASS


def test_an_input_that_nobody_publishes_is_found(tmp_path: Path) -> None:
    scene = scene_of(tmp_path, node="robot1")
    assert run("stream.silent", scene).verdict is PASS
    (task,) = scene.status["tasks"]
    quiet = {**task["streams"][0], "last_seen_s": None}
    silent = answer(scene, tasks=[{**task, "streams": [{**quiet, "messages": 0}]}])
    before = run("stream.silent", answer(scene, tasks=[{**task, "streams": [quiet]}]))
    assert_finds(before, WARN, "robot1/map on robot1 since the relay's start or the stream's last change")
    result = run("stream.silent", silent)
    assert_finds(result, WARN, "nobody has published robot1/map")
    assert "tcp/127.0.0.1:7458" in result.fix
    assert run("stream.silent", answer(silent, up_s=3.0)).verdict is SKIP


# --- the machine -----------------------------------------------------------------------------------------------------


class PlantedWatch(ClockWatch):
    """A clock that is slewed so fast."""

    def __init__(self, ratio: float) -> None:
        super().__init__()
        self.ratio = ratio

    def look(self) -> Drift | None:
        return Drift(self.ratio, self.ratio * 0.5, 0.5)


def test_a_clock_that_is_slewed_is_found(tmp_path: Path) -> None:
    scene = scene_of(tmp_path)
    exclusive = FLEET.replace("    weights", "    exclusive: true\n    weights")
    assert machine.clock_runs_true(scene, PlantedWatch(0.0)).verdict is PASS
    assert_finds(machine.clock_runs_true(scene, PlantedWatch(0.083)), WARN, "+8.300%")
    leased = scene_of(tmp_path, exclusive)
    assert_finds(machine.clock_runs_true(leased, PlantedWatch(-0.05)), FAIL, "exclusive tasks meanwhile: merge")


@pytest.fixture
def starved() -> Iterator[int]:
    """A process that may open 64 files."""
    code = "import resource, time; resource.setrlimit(resource.RLIMIT_NOFILE, (64, 64)); print(1); time.sleep(60)"
    with subprocess.Popen([sys.executable, "-uc", code], stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        yield process.pid
        process.kill()


def test_a_daemon_that_may_open_few_files_is_found(tmp_path: Path, starved: int) -> None:
    scene = scene_of(tmp_path)
    (scene.state_folder / "lock").write_text(f"{starved}\n")
    assert_finds(run("machine.descriptors", scene), WARN, f"process {starved} may open 64 files")


def test_shared_memory_that_cannot_be_used_is_found(tmp_path: Path) -> None:
    text = FLEET.replace("fleet: hall", "fleet: hall\nshared_memory: auto").replace(
        'merge/{robot}/map"}', 'merge/{robot}/map", class: reliable}'
    )
    assert run("machine.shared_memory", scene_of(tmp_path)).verdict is SKIP
    assert_finds(run("machine.shared_memory", scene_of(tmp_path, text)), WARN, "class reliable")


def test_a_machine_that_is_too_small_for_a_task_is_found(tmp_path: Path) -> None:
    def with_demand(demand: str) -> Scene:
        return scene_of(tmp_path, FLEET.replace("    weights", f"    demand: {demand}\n    weights"))

    assert run("machine.demand", with_demand("{cpu_cores: 0.01, memory_mb: 1}")).verdict is PASS
    assert_finds(run("machine.demand", with_demand("{cpu_cores: 900}")), WARN, "merge needs 900 cores")
    assert_finds(run("machine.demand", with_demand("{memory_mb: 60000000}")), FAIL, "MiB")
    assert_finds(run("machine.memory", with_demand("{memory_mb: 60000000}")), WARN, "1 worker")


@pytest.mark.parametrize(("standby", "verdict"), [("warm", WARN), ("cold", PASS)])
def test_cold_standbys_are_not_all_kept_at_once(tmp_path: Path, standby: str, verdict: Verdict) -> None:
    """The advice was to make some of them cold, which was not looked at."""
    half = DeviceProfiler().sample({}).memory_mb * 0.6
    worker = f"    demand: {{memory_mb: {half:.0f}}}\n    weights"
    text = FLEET.replace("    weights", worker).replace("worker: {", f"worker: {{standby: {standby}, ")
    assert f"standby: {standby}" in text
    task = text[text.index("  merge:") :]
    assert task.count("  merge:") == 1
    scene = scene_of(tmp_path, text + task.replace("merge:", "other:").replace("/merge/", "/other/"))
    assert run("machine.memory", scene).verdict is verdict


class PlantedRadio(GenericNetlink):
    """A kernel with one Wi-Fi interface."""

    def __init__(self, name: str, is_on: bool | None) -> None:
        self._name, self._is_on = name, is_on

    def interfaces(self) -> tuple[Interface, ...]:
        return (Interface(index=3, name=self._name),)

    def power_save(self, index: int) -> bool | None:
        assert index == 3
        return self._is_on

    def close(self) -> None:
        """Nothing is open."""


def test_wifi_power_save_and_a_missing_interface_are_found(tmp_path: Path) -> None:
    scene = scene_of(tmp_path, ROBOTS_OWN, node="robot1")
    check = machine.radio_stays_awake
    assert check(scene, PlantedRadio("wlan7", is_on=False)).verdict is PASS
    assert check(scene, PlantedRadio("wlan7", is_on=None)).verdict is SKIP
    result = check(scene, PlantedRadio("wlan7", is_on=True))
    assert_finds(result, WARN, "power save is on")
    assert "iw dev wlan7 set power_save off" in result.fix
    assert_finds(check(scene, PlantedRadio("wlan0", is_on=False)), FAIL, "no Wi-Fi interface wlan7")


# --- addresses -------------------------------------------------------------------------------------------------------


def test_a_name_that_does_not_resolve_is_found(tmp_path: Path) -> None:
    assert run("net.names", scene_of(tmp_path)).verdict is PASS
    wrong = scene_of(tmp_path, FLEET.replace("host: 127.0.0.1", "host: edge1.zsched.invalid"))
    assert_finds(run("net.names", wrong), FAIL, "edge1.zsched.invalid (edge1)")


def test_an_address_that_only_this_machine_reaches_is_found(tmp_path: Path) -> None:
    far = "  robot1: {kind: robot, host: 192.0.2.9, listen: {control: tcp/0.0.0.0:7457, data: tcp/0.0.0.0:7458}}"
    scene = scene_of(tmp_path, FLEET.replace("  robot1: {kind: robot}", far))
    assert_finds(run("net.loopback", scene), FAIL, "edge1's control session", "only this machine")
    assert run("net.loopback", replace(scene, node="robot1")).verdict is SKIP


@pytest.fixture
def listener() -> Iterator[tuple[socket.socket, int]]:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        yield other, other.getsockname()[1]


def test_another_program_on_our_port_is_found(tmp_path: Path, listener: tuple[socket.socket, int]) -> None:
    text = FLEET.replace("21257", str(listener[1]))
    scene = replace(scene_of(tmp_path, text), own=None)
    found = run("net.ports", scene)
    assert_finds(found, WARN, f"a program listens at tcp/127.0.0.1:{listener[1]} (control)")
    assert f"sport = :{listener[1]}" in found.fix
    listener[0].close()
    assert run("net.ports", scene).verdict is PASS


def test_a_relay_without_its_daemon_is_no_other_program(tmp_path: Path, listener: tuple[socket.socket, int]) -> None:
    scene = replace(scene_of(tmp_path, FLEET.replace("21258", str(listener[1]))), own=None)
    assert run("net.ports", scene).verdict is WARN
    assert run("net.ports", replace(scene, relay_version="0.1")).verdict is PASS


def test_a_daemon_that_does_not_listen_where_it_should_is_found(
    tmp_path: Path, listener: tuple[socket.socket, int]
) -> None:
    text = FLEET.replace("21257", str(listener[1])).replace("21258", str(listener[1] - 1 or 1))
    scene = scene_of(tmp_path, text)
    assert_finds(run("net.ports", scene), FAIL, "nobody listens at")


# --- workers ---------------------------------------------------------------------------------------------------------


def with_command(folder: Path, command: str) -> Scene:
    return scene_of(folder, FLEET.replace("[python, -m, zsched.tasks.echo]", command))


@pytest.mark.parametrize(
    ("command", "verdict", "word"),
    [
        ("[nosuchprogram, --x]", FAIL, "nosuchprogram"),
        ("[/opt/nowhere/worker]", FAIL, "/opt/nowhere/worker"),
        ("[python, /opt/nowhere/worker.py]", FAIL, "no file /opt/nowhere/worker.py"),
        ("[python, -u, -W, ignore, /opt/nowhere/worker.py]", FAIL, "no file /opt/nowhere/worker.py"),
        (f"[{sys.executable}, -u, /opt/nowhere/worker.py]", FAIL, "no file /opt/nowhere/worker.py"),
    ],
)
def test_a_worker_whose_program_is_missing_is_found(tmp_path: Path, command: str, verdict: Verdict, word: str) -> None:
    assert_finds(run("worker.command", with_command(tmp_path, command)), verdict, word)


def test_a_program_is_looked_for_where_the_service_looks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What lies in the caller's own folder the daemon does not find."""
    own, root = tmp_path / "bin", tmp_path / "root"
    own.mkdir()
    (own / "mymerger").write_text("#!/bin/sh\n")
    (own / "mymerger").chmod(0o755)
    monkeypatch.setenv("PATH", f"{own}:{os.environ['PATH']}")
    scene = replace(with_command(tmp_path, "[mymerger]"), root=root)
    assert run("worker.command", scene).verdict is PASS, "there is no unit"
    unit = root / "etc/systemd/system/zsched.service"
    unit.parent.mkdir(parents=True)
    unit.write_text("[Service]\nExecStart=/opt/zsched/bin/zsched up\n")
    assert_finds(run("worker.command", scene), FAIL, "no program mymerger")
    drop_in = unit.with_name("zsched.service.d") / "path.conf"
    drop_in.parent.mkdir()
    drop_in.write_text(f'[Service]\nEnvironment=A=1 "PATH={own}:/usr/bin"\nEnvironment=NOTE=it\'s\n')
    assert run("worker.command", scene).verdict is PASS
    drop_in.write_text(f"[Service]\nEnvironment=PATH={own}\nEnvironment=\n")
    assert run("worker.command", scene).verdict is FAIL, "an empty line takes back what stood before"
    for elsewhere in ("EnvironmentFile=-/etc/default/zsched", "Environment=PATH=%h/bin"):
        drop_in.write_text(f"[Service]\n{elsewhere}\n")
        assert run("worker.command", scene).verdict is PASS, "nobody can tell from here"


def test_a_worker_s_program_that_is_there_passes(tmp_path: Path) -> None:
    assert run("worker.command", scene_of(tmp_path)).verdict is PASS
    assert run("worker.command", with_command(tmp_path, "[sleep, '1']")).verdict is PASS
    assert run("worker.command", scene_of(tmp_path, node="robot1")).verdict is SKIP


def test_a_worker_that_lacks_a_package_is_found_and_never_carried_out(tmp_path: Path) -> None:
    script, trace = tmp_path / "worker.py", tmp_path / "ran"
    script.write_text(f"import json\nimport nosuchpackage\nopen({str(trace)!r}, 'w')\n")
    assert_finds(run("worker.imports", with_command(tmp_path, f"[python, {script}]")), FAIL, "nosuchpackage")
    script.write_text(f"import json\nfrom zsched.worker import Worker\nopen({str(trace)!r}, 'w')\n")
    assert run("worker.imports", with_command(tmp_path, f"[python, {script}]")).verdict is PASS
    assert not trace.exists()


def test_a_worker_s_module_is_followed_through_its_own_package(tmp_path: Path) -> None:
    package, trace = tmp_path / "mine", tmp_path / "ran"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "__main__.py").write_text(f"from mine import parts\nopen({str(trace)!r}, 'w')\n")
    (package / "parts.py").write_text("from . import deeper\n")
    (package / "deeper.py").write_text(
        "import nosuchpackage\ntry:\n    import optional\nexcept ImportError:\n    pass\n"
    )
    text = FLEET.replace("[python, -m, zsched.tasks.echo]", "[python, -m, mine]").replace(
        "worker: {", f"worker: {{env: {{PYTHONPATH: {tmp_path}}}, "
    )
    assert_finds(run("worker.imports", scene_of(tmp_path, text)), FAIL, "nosuchpackage")
    (package / "deeper.py").write_text("import json\n")
    assert run("worker.imports", scene_of(tmp_path, text)).verdict is PASS
    assert not trace.exists()


def test_a_worker_s_module_that_is_not_there_is_found(tmp_path: Path) -> None:
    assert_finds(run("worker.imports", with_command(tmp_path, "[python, -m, nosuch.worker]")), FAIL, "nosuch")


def test_a_unit_that_this_machine_has_not_is_found(tmp_path: Path) -> None:
    """Also where there is no systemd at all."""
    kept = FLEET.replace("{command: [python, -m, zsched.tasks.echo]}", "{driver: systemd, unit: nosuch@.service}")
    found = run("worker.engine", scene_of(tmp_path, kept))
    assert_finds(found, FAIL if found.verdict is FAIL else WARN)
    assert run("worker.engine", scene_of(tmp_path)).verdict is SKIP
