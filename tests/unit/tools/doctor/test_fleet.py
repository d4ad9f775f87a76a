"""Faults planted in what the nodes of a fleet say of one another."""

from __future__ import annotations

import re
import socket
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import pytest

from support.clinic import FLEET, assert_finds, fleet_scene, run
from zsched.tools.doctor import table
from zsched.tools.doctor.fleet import differs
from zsched.tools.doctor.model import Check, Needs, Result, Scene, Verdict, warned
from zsched.tools.doctor.table import CHECKS, GROUP, brought, run_all

FAIL, WARN, PASS, SKIP = Verdict.FAIL, Verdict.WARN, Verdict.PASS, Verdict.SKIP


def planted(scene: Scene, node: str, **changes: Any) -> Scene:
    """The same fleet, in which one node says something else."""
    return replace(scene, statuses={**scene.statuses, node: {**scene.statuses[node], **changes}})


def seen(scene: Scene, listener: str, speaker: str, state: str) -> Scene:
    """The same fleet, in which one node finds another one in ``state``."""
    nodes = [
        {**node, "state": state} if node["name"] == speaker else node for node in scene.statuses[listener]["nodes"]
    ]
    return planted(scene, listener, nodes=nodes)


def test_a_fleet_in_order_has_no_fault(tmp_path: Path) -> None:
    results = [(check, result) for check, result in run_all(fleet_scene(tmp_path)) if check.needs is Needs.FLEET]
    bad = [check.name for check, result in results if result.fix and check.name != "fleet.addresses"]
    assert (bad, len(results)) == ([], 13)


def test_nodes_that_do_not_answer_are_named(tmp_path: Path) -> None:
    scene = fleet_scene(tmp_path)
    without = replace(scene, statuses={name: one for name, one in scene.statuses.items() if name != "robot2"})
    assert_finds(run("fleet.answers", without), WARN, "1 of 4", "robot2")
    assert_finds(run("fleet.electors", without), WARN, "1 of 3 electors")
    lonely = replace(scene, statuses={"edge1": scene.statuses["edge1"]})
    assert_finds(run("fleet.electors", lonely), FAIL, "3 of 3 electors")


def test_a_fleet_of_which_nobody_answers_is_no_healthy_one(tmp_path: Path) -> None:
    """Else the doctor would end with 0 where a port is closed, and all else is left out."""
    scene = replace(fleet_scene(tmp_path), statuses={})
    assert_finds(run("fleet.answers", scene), FAIL, "4 of 4", "robot2")
    of_fleet = [result for check, result in run_all(scene) if check.needs is Needs.FLEET]
    assert [result.verdict for result in of_fleet] == [FAIL] + [SKIP] * (len(of_fleet) - 1)


def test_an_address_that_nobody_can_reach_is_found(tmp_path: Path) -> None:
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        scene = fleet_scene(tmp_path, FLEET.replace("21257", str(port)).replace("21258", "1"))
        result = run("fleet.addresses", replace(scene, node="robot1"))
    assert_finds(result, FAIL, "edge1's data session at tcp/127.0.0.1:1", "refused")
    assert len(result.evidence) == 1
    assert run("fleet.addresses", scene).verdict is SKIP, "from inside, an address translation may lead nowhere"


def test_a_node_with_another_file_or_version_is_found(tmp_path: Path) -> None:
    scene = fleet_scene(tmp_path)
    files = run("fleet.files", planted(scene, "robot2", fleet_file="0" * 16))
    assert_finds(files, FAIL, "robot2 goes by hash 000")
    assert "systemctl reload zsched" in files.fix
    assert_finds(run("fleet.versions", planted(scene, "robot2", version="0.0.9")), WARN, "zsched 0.0.9: robot2")


def test_a_node_with_other_electors_is_not_to_be_restarted(tmp_path: Path) -> None:
    scene = fleet_scene(tmp_path)
    quorum = {**scene.statuses["robot2"]["quorum"], "names": ["edge1", "robot1", "robot2"]}
    files = run("fleet.files", planted(scene, "robot2", fleet_file="0" * 16, quorum=quorum))
    assert_finds(files, FAIL, "robot2 goes by hash 000")
    assert "restart no daemon" in files.fix


def test_a_pair_that_hears_one_way_only_is_found(tmp_path: Path) -> None:
    result = run("fleet.pairs", seen(fleet_scene(tmp_path), "robot1", "robot3", "gone"))
    assert_finds(result, FAIL, "robot1 does not hear robot3 (gone); robot3 finds robot1 alive")
    assert len(result.evidence) == 1


def register(**changes: Any) -> Callable[[Scene, str], Scene]:
    def plant(scene: Scene, node: str) -> Scene:
        (task,) = scene.statuses[node]["tasks"]
        return planted(scene, node, tasks=[{**task, **changes}])

    return plant


PIN = {"by": "eve@robot2", "reason": "", "known_s": 3.0, "for_s": None, "node": "edge1", "is_hard": False}


def test_what_each_file_says_of_a_task_is_no_register(tmp_path: Path) -> None:
    """The status tells a tuning as it is in force: with what it leaves to that node's file."""
    scene = register(tuning={"bonus": 9, "price_s": 0.3, "rho_dbm": -40.0})(fleet_scene(tmp_path), "robot1")
    for node in sorted(scene.statuses.keys() - {"robot1"}):
        scene = register(tuning={"bonus": 9, "price_s": 1.0, "rho_dbm": -50.0})(scene, node)
    assert not differs(scene.statuses)
    assert run("fleet.registers", scene).verdict is PASS


@pytest.mark.parametrize(
    "changes",
    [{"revision": 4}, {"owner": "robot1"}, {"epoch": 2, "revision": 4}, {"pin": PIN}, {"tuning": {"bonus": 9}}],
)
def test_registers_that_differ_are_found(tmp_path: Path, changes: dict[str, Any]) -> None:
    scene = fleet_scene(tmp_path)
    assert not differs(scene.statuses)
    apart = register(**changes)(scene, "robot2")
    assert differs(apart.statuses)
    assert_finds(run("fleet.registers", apart), FAIL, "revision 5, epoch 3, owner edge1, hash ")
    assert_finds(run("fleet.registers", apart), FAIL, " on edge1, robot1, robot3")
    assert ("two values of one revision" in run("fleet.registers", apart).fix) is ("revision" not in changes)


def test_an_order_that_nodes_have_known_for_different_times_is_one(tmp_path: Path) -> None:
    scene = fleet_scene(tmp_path)
    for name, known_s in zip(scene.statuses, (1.0, 2.0, 3.0, 4.0), strict=True):
        scene = register(pin={**PIN, "known_s": known_s})(scene, name)
    assert not differs(scene.statuses)


def test_electors_without_their_state_or_apart_are_found(tmp_path: Path) -> None:
    scene = fleet_scene(tmp_path)
    quorum = scene.statuses["robot2"]["quorum"]
    lost = planted(scene, "robot2", quorum={**quorum, "this_node": "lost_state"})
    assert_finds(run("fleet.electors", lost), FAIL, "robot2 is an elector without a valid state (lost_state)")
    apart = planted(scene, "robot2", quorum={**quorum, "apart": ["robot1"]})
    assert_finds(run("fleet.electors", apart), FAIL, "robot2 and robot1 refuse each other")


def test_a_slow_loop_and_a_slow_answer_are_found(tmp_path: Path) -> None:
    scene = fleet_scene(tmp_path)
    assert_finds(
        run("fleet.lag", planted(scene, "robot2", loop_lag_s=2.0)),
        FAIL,
        "robot2: its decision loop was up to 2000.0 ms late",
    )
    assert run("fleet.timing", replace(scene, answered_s={"robot2": 0.02})).verdict is PASS
    slow = replace(scene, answered_s={"robot2": 0.02, "robot3": 0.2})
    assert_finds(run("fleet.timing", slow), WARN, "robot3, took 200 ms")


def test_a_task_without_an_owner_is_found_from_a_machine_that_is_no_node(tmp_path: Path) -> None:
    """It passed: no daemon names an owner that is not there among its problems."""
    scene = replace(fleet_scene(tmp_path), node="laptop", own=None, state_folder=tmp_path / "none")
    assert run("fleet.owners", scene).verdict is PASS
    (task,) = scene.statuses["robot2"]["tasks"]
    for name in ("robot1", "robot2"):
        scene = planted(scene, name, tasks=[{**task, "owner": None, "owner_state": None}])
    found = {check.name: result for check, result in run_all(scene)}
    assert_finds(found["fleet.owners"], FAIL, "robot1, robot2: merge has no owner")
    quorum = {**scene.statuses["robot3"]["quorum"], "ok": False}
    assert_finds(run("fleet.owners", planted(scene, "robot3", quorum=quorum)), FAIL, "robot3: no quorum", "no owner")


def test_what_a_robot_s_streams_wait_for_is_found_from_every_node(tmp_path: Path) -> None:
    """Only that robot's status has it, and there it stands with the task."""
    scene = fleet_scene(tmp_path)
    (task,) = scene.statuses["robot2"]["tasks"]
    waits = "this robot's streams have waited for edge1 for 600 s"
    assert_finds(
        run("fleet.problems", planted(scene, "robot2", tasks=[{**task, "problems": [waits]}])),
        WARN,
        f"robot2: merge: {waits}",
    )


def test_a_clock_in_doubt_and_a_problem_elsewhere_are_told(tmp_path: Path) -> None:
    problem = "clock: this machine's clock is slewed by +8.30%, leases allow for 0.10%"
    scene = planted(fleet_scene(tmp_path), "robot2", problems=[problem], problem_kinds=["clock"])
    assert_finds(run("fleet.clocks", scene), WARN, "robot2: clock: this machine's clock is slewed")
    assert_finds(run("fleet.problems", scene), WARN, "robot2: clock")


def test_a_task_that_fits_nowhere_is_found(tmp_path: Path) -> None:
    text = FLEET.replace("    weights", "    demand: {cpu_cores: 6}\n    weights")
    assert_finds(run("fleet.demand", fleet_scene(tmp_path, text)), WARN, "merge needs 6 cores", "edge1 4.0 cores")


# --- the table -------------------------------------------------------------------------------------------------------


def test_a_visitor_looks_at_the_fleet_only(tmp_path: Path) -> None:
    scene = replace(fleet_scene(tmp_path), node="laptop", own=None, state_folder=tmp_path / "none")
    needs = {check.needs for check, _ in run_all(scene)}
    assert needs == {Needs.NOTHING, Needs.FILE, Needs.FLEET}
    assert not [check.name for check, result in run_all(scene) if check.name == "file.node" and result.fix]


def test_without_fleet_the_fleet_s_checks_are_left_out(tmp_path: Path) -> None:
    scene = replace(fleet_scene(tmp_path), is_fleet=False)
    assert Needs.FLEET not in {check.needs for check, _ in run_all(scene)}


def planted_check(_scene: Scene) -> Result:
    return warned("the arm is not calibrated", fix="arm calibrate")


OWN = Check(name="arm.calibrated", asks="Is the arm calibrated?", run=planted_check, needs=Needs.NOTHING)
SEVERAL = (OWN, OWN)


def test_another_distribution_brings_checks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Point(EntryPoint):
        def load(self) -> Any:
            return {"one": OWN, "more": SEVERAL, "none": 7}[self.name]

    points: list[EntryPoint] = [Point(name=name, value="arm:checks", group=GROUP) for name in ("one", "more", "none")]
    points.append(EntryPoint(name="gone", value="zsched_nosuch:checks", group=GROUP))
    found = brought(points)
    assert [check.name for check in found] == ["arm.calibrated"] * 3 + ["none", "gone"]
    monkeypatch.setattr(table, "brought", lambda: found)
    results = run_all(fleet_scene(tmp_path))[-5:]
    assert [result.verdict for _, result in results] == [WARN, WARN, WARN, FAIL, FAIL]
    assert "neither" in results[3][1].evidence[0]
    assert "ModuleNotFoundError" in results[4][1].evidence[0]


def test_a_check_that_fails_itself_takes_no_other_along(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(_scene: Scene) -> Result:
        raise KeyError("tasks")

    bad = Check(name="arm.broken", asks="Does it work?", run=broken, needs=Needs.NOTHING)
    monkeypatch.setattr(table, "CHECKS", (bad, OWN))
    results = run_all(fleet_scene(tmp_path))
    assert_finds(results[0][1], FAIL, "the check itself failed: KeyError")
    assert results[1][1].verdict is WARN


def test_the_page_has_a_row_for_each_check() -> None:
    page = (Path(__file__).parents[4] / "docs" / "guide" / "doctor.md").read_text()
    rows = re.findall(r"^\| `(\w+\.\w+)` \| ([^|]+) \|", page, re.MULTILINE)
    assert rows == [(check.name, check.asks) for check in CHECKS]
