"""Several tasks on the same candidates, on real daemons: one move at a time, by figures read again, and no herd."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import psutil
import pytest

from support.waiting import TooSlowError
from zsched.core.scheduler.judge import Outcome
from zsched.core.scheduler.utility import SPARE
from zsched.core.values.codec import from_plain
from zsched.core.values.quorum import majority
from zsched.host.decision_log import NAME, Entry
from zsched_lab.fleet.testbed import Testbed, echo_fleet

TASKS = ("task1", "task2", "task3")
SHARE = 0.1
"""Of the machine's memory that each task is said to need: what tells a node with a task from one without."""


def three_tasks() -> dict[str, Any]:
    """Three robots that are all candidates of three equal tasks; they share one machine, so their figures are equal."""
    weights = {"cpu": 0.0, "memory": 1.0, "network": 0.0}
    # else a machine that is up a second after the others owes for that second, and gets nothing
    tree = echo_fleet(edges=0, weights=weights, scheduling={"score": "service", "price_s": 0.0})
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


@dataclass(frozen=True, slots=True)
class Vote:
    """One robot's vote on a task's first place: what it knew by then, and its own look at the nodes."""

    placed: Mapping[str, str]
    """{task that it knew to be placed: owner}."""
    worth: Mapping[str, float]
    """{node: what the task is worth there}, of the nodes that can have it."""
    rest: AbstractSet[str] = frozenset()
    """Tasks that it learnt to be placed after its vote, and before this one was."""

    def counted(self, *, so: bool = True) -> set[str]:
        """The placed tasks that make their owner worth less than a node without any; not ``so``: that do not."""
        free = max((value for node, value in self.worth.items() if node not in self.placed.values()), default=None)
        known = {task: self.worth[owner] for task, owner in self.placed.items() if owner in self.worth}
        return {task for task, worth in known.items() if free and (worth < free - SPARE * SHARE / 2) is so}

    @property
    def looked_again(self) -> bool:
        """Whether it counted every task that was placed before this one."""
        return not self.rest and self.counted() == set(self.placed)


def votes(bed: Testbed) -> dict[str, dict[str, Vote]] | None:
    """{robot: {task: its last vote on the first place}}; ``None`` until the logs of all tell of all places."""
    seen = {}
    for node in bed.names:
        found: dict[str, Vote] = {}
        placed: dict[str, str] = {}
        lines, _, _ = (bed.folder / node / NAME).read_bytes().rpartition(b"\n")
        for line in lines.splitlines():
            entry = from_plain(json.loads(line), Entry)
            task, move, told = entry.task, entry.move, entry.decision
            if move is not None and move.revision == 1 and move.owner is not None:
                if task in found:
                    found[task] = replace(found[task], rest=placed.keys() - found[task].placed.keys())
                placed[task] = move.owner
            elif told is not None and told.verdict.outcome == Outcome.PROPOSE and task not in placed:
                (own,) = (one for one in told.figures.vectors if one.voter == node)
                found[task] = Vote(dict(placed), {one.candidate: one.value for one in own.utilities})
        if placed.keys() != set(TASKS):
            return None
        seen[node] = found
    return seen


def test_three_tasks_that_are_first_placed_together_end_on_three_nodes(bed: Testbed) -> None:
    """Each commit is followed by a new look that counts what the placed task will need where it went.

    A robot's own look counts it at once, however busy the machine is. What others answer may be older, where they
    learn of the commit later; so a busy machine can place two tasks together once. A herd flocks each time, for the
    figures are equal.
    """
    placed = bed.wait(lambda: owners(bed), 60, "owners of all tasks at all nodes") or {}
    seen = bed.wait(lambda: votes(bed), 60, "all places in the logs of all nodes") or {}

    wrong = {node: {task: vote.counted(so=False) for task, vote in of.items()} for node, of in seen.items()}
    assert not any(missed for of in wrong.values() for missed in of.values()), f"a look left out {wrong}: {seen}"
    if Counter(placed.values()) != dict.fromkeys(bed.names, 1):
        # Behind a commit that takes longer than a ballot, the next vote goes by older figures (`turns.py`).
        raise TooSlowError(f"two tasks were placed by the same figures: {placed}, by {seen}")
    for node in bed.names:
        history = {task["name"]: task["history"] for task in bed.status(node)["tasks"]}
        assert [len({past["epoch"] for past in history[name]}) for name in TASKS] == [1, 1, 1], "nobody moved twice"
    for name in TASKS:
        again = sum(name in of and of[name].looked_again for of in seen.values())
        if again < majority(len(bed.names)):
            raise TooSlowError(f"no majority looked again before it voted on {name}: {seen}")
