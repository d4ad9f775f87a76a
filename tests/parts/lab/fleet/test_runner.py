from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from zsched.config.load import load_fleet
from zsched.host.operator_client import ask
from zsched.tasks.map_merge.geometry import Pose2
from zsched_lab.demo.run import fleet_template, worker_options
from zsched_lab.fleet.children import ChildError, Children
from zsched_lab.fleet.injector import Injector
from zsched_lab.fleet.limits import LimitKind, NodeLimits
from zsched_lab.fleet.observer import Observer
from zsched_lab.fleet.runner import FleetRunner, LabFleet, write_fleet
from zsched_lab.fleet.schedule import Injection

STUB = (sys.executable, str(Path(__file__).parent / "stub_daemon.py"))
NO_LIMITS = NodeLimits(LimitKind.NONE, "none")
FRAMES = {"robot1": Pose2(x=1.5, y=-2.0, yaw=0.25)}
SMALL = """
fleet: small
nodes:
  edge1: {kind: edge, wired: true}
  edge2: {kind: edge, wired: true}
  robot1: {kind: robot, wired: true}
tasks:
  map_merge:
    candidates: {kind: edge}
    weights: {cpu: 1}
    worker: {command: [python, -m, zsched.tasks.map_merge, --mode, known, --pose, "robot1=0,0,0", --rate, "2"]}
"""


def wait_for(condition: Callable[[], bool], deadline_s: float = 10.0) -> None:
    end = time.monotonic() + deadline_s
    while not condition():
        assert time.monotonic() < end, "it did not come about in time"
        time.sleep(0.02)


@pytest.fixture
def template(tmp_path: Path) -> Path:
    path = tmp_path / "template.yaml"
    path.write_text(SMALL)
    return path


@pytest.fixture
def fleet(template: Path, tmp_path: Path) -> LabFleet:
    return write_fleet(template, tmp_path / "fleet.yaml", worker_options("known", FRAMES))


@pytest.fixture
def children(tmp_path: Path) -> Iterator[Children]:
    with Children(tmp_path / "logs") as children:
        yield children
    assert children.left_behind == []


@pytest.mark.parametrize("mode", ["known", "track", "estimate"])
def test_the_demos_effective_file_is_a_valid_fleet_of_its_own_ports(tmp_path: Path, mode: str) -> None:
    lab = write_fleet(fleet_template(), tmp_path / "fleet.yaml", worker_options(mode, FRAMES))

    fleet = load_fleet(tmp_path / "fleet.yaml")

    assert lab.robots == fleet.voters == ("robot1", "robot2", "robot3")
    assert lab.edges == fleet.task(lab.task).candidates == ("edge1", "edge2", "edge3")
    endpoints = [end for node in fleet.nodes for end in (node.listen_control, node.listen_data)]
    assert len(set(endpoints)) == 12
    assert {node.name: node.listen_data for node in fleet.nodes} == dict(lab.data_endpoints)
    command = fleet.task(lab.task).worker.command
    assert command[command.index("--mode") + 1] == mode
    poses = [word for word in command if word.startswith("robot")]
    assert poses == ([] if mode == "estimate" else ["robot1=1.500000,-2.000000,0.250000000"])


def test_a_fleet_comes_up_is_watched_loaded_and_ends(fleet: LabFleet, children: Children, tmp_path: Path) -> None:
    runner = FleetRunner(fleet, children, tmp_path / "rt", NO_LIMITS, STUB)
    told: list[str] = []
    injector = Injector(
        (Injection(start_s=1.0, end_s=3.0, target=None), Injection(start_s=5.0, end_s=6.0, target="edge2")),
        runner,
        children,
        tmp_path,
        lambda _, text: told.append(text),
    )

    runner.init()
    runner.up()
    with Observer(runner.sockets(), fleet.task, ask) as observer:
        runner.wait_up(observer.statuses, lambda: time.sleep(0.02))
        injector.tick(0.5, "edge1")
        assert injector.loaded == frozenset()
        injector.tick(1.0, None)
        assert injector.loaded == frozenset()
        injector.tick(1.2, "edge1")
        assert injector.loaded == {"edge1"}
        wait_for(lambda: len(observer.moves()) == 2)
        first, second = observer.moves()
        injector.tick(3.0, "edge2")

    assert (first.node, second.node, second.reason) == ("edge1", "edge2", "edge1 is busy")
    assert second.t_s - first.t_s == pytest.approx(1.0, abs=0.2)
    assert injector.loaded == frozenset()
    ((load,)) = injector.loads
    assert (load.node, load.start_s, load.end_s) == ("edge1", 1.2, 3.0)
    injector.tick(7.0, "edge1")  # the second window has passed meanwhile
    assert len(injector.loads) == 1
    assert told[0].startswith("neural load on edge1")


@pytest.mark.parametrize("verb", ["init", "up"])
def test_a_daemon_that_fails_is_named_with_its_words(
    fleet: LabFleet, children: Children, tmp_path: Path, verb: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("STUB_FAILS", verb)
    runner = FleetRunner(fleet, children, tmp_path / "rt", NO_LIMITS, STUB)

    def start() -> None:
        runner.init()
        runner.up()
        runner.wait_up(tuple, lambda: time.sleep(0.02))

    with pytest.raises(ChildError, match=r"(?s)(edge|robot)\d.*the disk is full"):
        start()
