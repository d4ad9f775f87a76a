"""What is decided of a worker hangs on its state and its trouble; its reason is for people, whatever it says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from random import Random
from typing import Any

import pytest

from support.allocations import allocation_of
from support.beats import beat_of
from support.clinic import FLEET as CLINIC
from support.clinic import answer, run, scene_of
from support.fleets import fleet_of, task_of
from support.profiles import load_of, profile_of
from support.states import state_of
from zsched.commands.base.report import degradations, render_status
from zsched.core.node.node import Node
from zsched.core.node.status import build_snapshot
from zsched.core.values import events as ev
from zsched.core.values.fleet import WorkerSpec, electorate_hash
from zsched.core.values.messages import Learnt
from zsched.core.values.profile import WorkerLoad, WorkerState, with_troubles
from zsched.core.values.report import snapshot_json
from zsched.core.values.words import Trouble
from zsched.tools.doctor.model import Scene

ROBOTS, EDGES = ("robot1", "robot2", "robot3"), ("edge1", "edge2")
FLEET = fleet_of(
    task_of("merge", EDGES, worker=WorkerSpec(command=("work",))), of=sorted((*ROBOTS, *EDGES)), electors=ROBOTS
)
TROUBLES = (
    (WorkerState.READY, Trouble.NONE),
    (WorkerState.READY, Trouble.RESTS),
    (WorkerState.STARTING, Trouble.NONE),
    (WorkerState.STARTING, Trouble.LOST),
    (WorkerState.STARTING, Trouble.AGAIN),
    (WorkerState.STOPPED, Trouble.NONE),
    (WorkerState.STOPPED, Trouble.LOST),
    (WorkerState.STOPPED, Trouble.AGAIN),
)
TODAYS_WORDS = (
    "was ready until 12:00:00 UTC, its token went: it may hang",
    "restarting (failure 1 of 3): killed by signal 9",
    "it rests, for it has no lease (clock in doubt)",
)


def status_of(of_owner: WorkerLoad, of_other: WorkerLoad) -> dict[str, Any]:
    """What robot1 says of a task that edge1 owns, and that edge2 could take."""
    hashed = electorate_hash(FLEET)
    node = Node(
        fleet=FLEET,
        me="robot1",
        durable=state_of("robot1", electorate=hashed),
        incarnation=7,
        electorate=hashed,
        rng=Random(1),
        now=100.0,
    )
    for name in (*ROBOTS[1:], *EDGES):
        node.handle(ev.BeatReceived(beat=beat_of(name, incarnation=3)), 100.0)
    learnt = Learnt(node="robot2", values=(allocation_of(1, "edge1"),))
    node.handle(ev.LearntReceived(learnt=learnt, is_answer=True), 100.0)
    for name, load in zip(EDGES, (of_owner, of_other), strict=True):
        profile = profile_of(name, incarnation=3, memory_used_mb=100.0, workers=(load,))
        node.handle(ev.ProfileReceived(profile=profile), 100.0)
    return snapshot_json(build_snapshot(node, 100.0))


def decisions(scene: Scene, load: WorkerLoad) -> tuple[object, ...]:
    """All that is made of a worker but its sentences, first of an owner's, then of a standby's."""
    found: list[object] = []
    for loads in ((load, load_of()), (load_of(), load)):
        status = status_of(*loads)
        rows = [line for line in render_status(status, 140, color=True).splitlines() if line.startswith(EDGES)]
        found += [len(status["tasks"][0]["problems"]), len(degradations(status)), *rows]
        seen = answer(scene, nodes=status["nodes"])
        for check in ("worker.state", "task.owners"):
            result = run(check, seen)
            found += [result.verdict, result.fix]
    return tuple(found)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    folder: Path = tmp_path_factory.mktemp("clinic")
    return scene_of(folder, CLINIC)


def test_the_trouble_decides_what_the_state_leaves_open(scene: Scene) -> None:
    def of(state: WorkerState, trouble: Trouble) -> tuple[object, ...]:
        return decisions(scene, load_of(state=state, trouble=trouble, reason="it did not tell"))

    for state in (WorkerState.STARTING, WorkerState.STOPPED):
        assert len({of(state, trouble) for trouble in (Trouble.NONE, Trouble.LOST, Trouble.AGAIN)}) == 3


# --- the release before this one: its words alone --------------------------------------------------------------------

WAS, AGAIN, RESTS = TODAYS_WORDS


@pytest.mark.parametrize(
    ("state", "reason", "trouble"),
    [
        (WorkerState.STARTING, WAS, Trouble.LOST),
        (WorkerState.STOPPED, WAS, Trouble.LOST),
        (WorkerState.STARTING, AGAIN, Trouble.AGAIN),
        (WorkerState.STOPPED, AGAIN, Trouble.AGAIN),
        (WorkerState.READY, RESTS, Trouble.RESTS),
        (WorkerState.STARTING, RESTS, Trouble.NONE),
        (WorkerState.STARTING, "pid 7", Trouble.NONE),
        (WorkerState.READY, "restarting the camera takes long", Trouble.NONE),
        (WorkerState.READY, "", Trouble.NONE),
    ],
)
def test_an_older_daemon_s_words_become_its_worker_s_trouble(
    scene: Scene, state: WorkerState, reason: str, trouble: Trouble
) -> None:
    old = load_of(state=state, reason=reason)
    assert old.trouble is Trouble.NONE
    new = replace(old, trouble=trouble)
    well = load_of("other")
    assert with_troubles(profile_of(workers=(old, well))).workers == (new, well)
    assert decisions(scene, old) == decisions(scene, new)


@pytest.mark.parametrize("reason", ["", *TODAYS_WORDS])
def test_a_daemon_that_names_the_trouble_is_taken_at_its_word(reason: str) -> None:
    for state, trouble in TROUBLES:
        if trouble is not Trouble.NONE:
            told = profile_of(workers=(load_of(state=state, trouble=trouble, reason=reason),))
            assert with_troubles(told) is told
