"""The checker of the chaos tests against a fleet that moves on while it is being read."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from zsched.core.values.model import NodeId
from zsched_lab.fleet.chaos import GUARD, ChaosBed
from zsched_lab.fleet.netbed import Received
from zsched_lab.fleet.testbed import TASK
from zsched_lab.sim.history import History, Learnt


def sample(node: NodeId, at: float, epoch: int | None = None) -> Received:
    return Received(key="robot1/out", number=int(at), sent_at=at, at=at, node=node, epoch=epoch)


class Moving(ChaosBed):
    """Nothing runs; whenever its logs are read, the task moves to edge3 a moment later."""

    def __init__(self, folder: Path, owners: list[NodeId], received: list[Received]) -> None:
        self.folder = folder
        self._processes = {}
        self._ticks = folder / "ticks"
        self._ticks.mkdir()
        self._owners, self._given = owners, received
        self.probes = {"robot1": SimpleNamespace(received=received)}  # type: ignore[dict-item] # all that is asked of it

    def history(self, **arguments: object) -> History:
        history = History(**arguments)  # type: ignore[arg-type]
        for task in (TASK, GUARD):
            for epoch, owner in enumerate(self._owners, 1):
                at = float(epoch)
                history.record(Learnt(at=at, node="robot1", task=task, revision=epoch, epoch=epoch, owner=owner))
        self._given += [sample("edge3", 90.0), sample("edge3", 91.0, epoch=9)]
        (self._ticks / "edge3-1.ticks").write_text("9 92.0\n")
        return history


def test_what_happens_while_the_logs_are_read_is_not_held_against_the_fleet(tmp_path: Path) -> None:
    received = [sample("edge1", 1.5), sample("edge2", 2.5, epoch=2)]
    bed = Moving(tmp_path, ["edge1", "edge2"], received)
    assert bed.violations() == []
    assert len(received) == 4


@pytest.mark.parametrize(
    ("given", "found"),
    [
        ([sample("edge2", 1.5), sample("edge1", 2.5)], "robot1 admitted ['edge2', 'edge1']"),
        ([sample("edge1", 1.5, epoch=2)], "robot1 admits edge1 in epoch 2 of edge2"),
    ],
)
def test_messages_of_another_than_the_owner_are_found(tmp_path: Path, given: list[Received], found: str) -> None:
    assert any(text.startswith(found) for text in Moving(tmp_path, ["edge1", "edge2"], given).violations())
