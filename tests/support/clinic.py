"""A machine that the doctor looks at: fleet file, folders, answers. All is well until a test plants a fault."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from zsched import __version__
from zsched.config.load import check_file
from zsched.core.values.fleet import Fleet, fleet_hash
from zsched.core.values.plan import StreamCount
from zsched.core.values.profile import WorkerLoad, WorkerState
from zsched.core.values.report import snapshot_json
from zsched.core.values.snapshot import NodeStatus, QuorumStatus, Snapshot, TaskStatus
from zsched.core.vote.generations import blank_state
from zsched.host.state_file import StateFile, hardware_id
from zsched.tools.doctor.model import Json, Result, Scene, Verdict
from zsched.tools.doctor.table import CHECKS

FLEET = """
fleet: hall
nodes:
  edge1: {kind: edge, host: 127.0.0.1, listen: {control: tcp/0.0.0.0:21257, data: tcp/0.0.0.0:21258}, wired: true}
  robot1: {kind: robot}
  robot2: {kind: robot}
  robot3: {kind: robot}
tasks:
  merge:
    candidates: {kind: edge}
    weights: {cpu: 0.5, memory: 0.5}
    worker: {command: [python, -m, zsched.tasks.echo]}
    inputs: [{from: "{robot}/map", to: "{target}/merge/{robot}/map"}]
"""
OWNER = "edge1"


def scene_of(folder: Path, text: str = FLEET, node: str = OWNER, **options: Any) -> Scene:
    """A machine of the fleet whose file is ``text``, with a blank state, and the daemon's answer."""
    file = folder / "fleet.yaml"
    file.write_text(text)
    reading = check_file(file)
    state = folder / "state"
    if reading.fleet is not None and node in [spec.name for spec in reading.fleet.nodes]:
        make_state(reading.fleet, node, state)
        options.setdefault("own", status_of(reading.fleet, node))
    return Scene(file=file, reading=reading, node=node, state_folder=state, **options)


def answer(scene: Scene, **changes: Any) -> Scene:
    """The same machine, whose daemon's answer is changed."""
    return replace(scene, own={**scene.status, **changes})


def make_state(fleet: Fleet, node: str, folder: Path, **changes: Any) -> None:
    """A state of generation 0, with these fields changed."""
    state = blank_state(fleet, node, 0, None, incarnation=7, hardware=hardware_id())
    with StateFile(folder, fleet=fleet.name, node=node) as file:
        file.save(replace(state, **changes))
    (folder / "lock").write_text("")  # as if no daemon had ever run


def fleet_scene(folder: Path, text: str = FLEET, **options: Any) -> Scene:
    """The same of the whole fleet: every node answers, and all is well."""
    scene = scene_of(folder, text, is_fleet=True, **options)
    statuses = {spec.name: status_of(scene.fleet, spec.name) for spec in scene.fleet.nodes}
    return replace(scene, statuses=statuses, own=statuses[scene.node])


def status_of(fleet: Fleet, node: str) -> Json:
    """What a node says of a fleet in which all is well."""
    nodes = tuple(
        NodeStatus(
            name=spec.name,
            kind=spec.kind.value,
            state="alive",
            age_s=0.4,
            cpu_cores=4.0,
            memory_mb=8000.0,
            speed=1.0,
            workers=(WorkerLoad(task="merge", state=WorkerState.READY),) if spec.name == OWNER else (),
        )
        for spec in fleet.nodes
    )
    stream = StreamCount(stream="merge/in/0", messages=10, last_seen_s=0.2, from_expr=f"{node}/map", to_expr="x")
    task = TaskStatus(
        name=fleet.tasks[0].name,
        owner=OWNER,
        epoch=3,
        revision=5,
        since_s=9.0,
        owner_state="alive",
        phase="settled",
        tuning=fleet.tasks[0].tuning,
        candidates=fleet.tasks[0].candidates,
        streams=(stream,) if node.startswith("robot") else (),
    )
    count = len(fleet.electors)
    role = "elector" if node in fleet.electors else "no_elector"
    quorum = QuorumStatus(
        electors=count, needed=count // 2 + 1, alive=count, ok=True, this_node=role, names=tuple(sorted(fleet.electors))
    )
    return snapshot_json(
        Snapshot(
            schema="zsched.status/1",
            version=__version__,
            fleet=fleet.name,
            node=node,
            kind=fleet.node(node).kind.value,
            incarnation=7,
            up_s=600.0,
            loop_lag_s=0.001,
            quorum=quorum,
            nodes=nodes,
            tasks=(task,),
            fleet_file=fleet_hash(fleet),
            joins_at=("tcp/127.0.0.1:7458",),
        )
    )


def run(name: str, scene: Scene) -> Result:
    """What one check of the table says."""
    return next(check for check in CHECKS if check.name == name).run(scene)


def assert_finds(result: Result, verdict: Verdict, *words: str) -> None:
    """The fault is found, its evidence says ``words``, and there is something to do."""
    told = "\n".join(result.evidence)
    assert result.verdict is verdict, result
    assert not [word for word in words if word not in told], result
    assert result.fix, result
