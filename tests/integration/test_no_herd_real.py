"""Several tasks on the same candidates, on real daemons: one move at a time, by figures read again, and no herd."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from support.waiting import TooSlowError
from zsched.core.scheduler.utility import SPARE
from zsched_lab.fleet.testbed import Testbed, echo_fleet

TASKS = ("task1", "task2", "task3")
SHARE = 0.1
"""Of the machine's memory that each task is said to need: what tells a node with a task from one without."""


def three_tasks() -> dict[str, Any]:
    """Three robots that are all candidates of three equal tasks; they share one machine, so their figures are equal."""
    weights = {"cpu": 0.0, "memory": 1.0, "network": 0.0}
    tree = echo_fleet(edges=0, weights=weights, scheduling={"score": "service"})
    echo = tree["tasks"].popitem()[1]
    body = {
        **echo,
        # else the machines whose workers are up first get all, and nine of them start at once
        "worker": {**echo["worker"], "standby": "cold"},
        "demand": {"memory_mb": round(SHARE * psutil.virtual_memory().total / 2**20)},
        "inputs": [{"from": "{robot}/{task}/in", "to": "{target}/{task}/{robot}/in"}],
        "outputs": [{"from": "{target}/{task}/{epoch}/{robot}/out", "to": "{robot}/{task}/out"}],
    }
    tree["tasks"] = dict.fromkeys(TASKS, body)
    return tree


@pytest.fixture
def bed(tmp_path: Path) -> Iterator[Testbed]:
    with Testbed(tmp_path, three_tasks()) as testbed:
        testbed.init()
        testbed.start()
        yield testbed


def owners(bed: Testbed) -> dict[str, str] | None:
    """{task: owner} once every daemon knows the same; else ``None``."""
    seen = [{task["name"]: task["owner"] for task in bed.status(node)["tasks"]} for node in bed.names]
    return seen[0] if None not in seen[0].values() and all(one == seen[0] for one in seen) else None


PROPOSED = re.compile(r"zsched\.scheduler task=(\w+) .*propose \w+: .*\[(.*)\]")
LEARNT = re.compile(r"zsched\.vote task=(\w+) .*learnt revision 1: owner (\w+),")


def looked_again(log: str) -> dict[str, bool]:
    """{task: whether this robot's vote for it counted every task that was placed before}, for those it voted on."""
    votes: dict[str, tuple[int, dict[str, float]]] = {}
    placed: list[tuple[int, str]] = []
    found = {}
    for number, line in enumerate(log.splitlines()):
        if seen := PROPOSED.search(line):
            scores = (pair.split("=") for pair in seen[2].split())
            votes[seen[1]] = (number, {name: float(value) for name, value in scores})
        elif (seen := LEARNT.search(line)) and seen[1] in votes:
            at, utilities = votes[seen[1]]
            best = max(utilities.values())
            found[seen[1]] = all(then < at and utilities[node] < best - SPARE * SHARE / 2 for then, node in placed)
        if seen := LEARNT.search(line):
            placed.append((number, seen[2]))
    return found


def test_three_tasks_that_are_first_placed_together_end_on_three_nodes(bed: Testbed) -> None:
    """Each commit is followed by a new look that counts what the placed task will need where it went.

    A herd flocks each time, for the figures are equal; a commit that a busy machine delays does so once.
    """
    placed = bed.wait(lambda: owners(bed), 60, "owners of all tasks at all nodes") or {}

    if Counter(placed.values()) != dict.fromkeys(bed.names, 1):
        # Behind a commit that takes longer than a ballot, the next vote goes by older figures (`turns.py`).
        raise TooSlowError(f"two tasks were placed by the same figures: {placed}")
    for node in bed.names:
        history = {task["name"]: task["history"] for task in bed.status(node)["tasks"]}
        assert [len({past["epoch"] for past in history[name]}) for name in TASKS] == [1, 1, 1], "nobody moved twice"
    views = [looked_again(bed.log(node)) for node in bed.names]
    for name in TASKS:
        assert sum(view.get(name, False) for view in views) >= 2, f"no majority looked again before {name}: {views}"
