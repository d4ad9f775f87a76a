"""Beats, with what a test does not care about filled in."""

from __future__ import annotations

from typing import Any

from zsched.core.node.node import Node
from zsched.core.values.beat import Beat
from zsched.core.values.events import BeatReceived
from zsched.core.values.instructions import Instruction
from zsched.core.values.model import NodeId


def beat_of(node: NodeId, sequence: int = 1, **options: Any) -> Beat:
    """A beat of a node's first life whose loop does not lag; it tells nothing else."""
    return Beat(node=node, sequence=sequence, **{"incarnation": 1, "loop_lag_s": 0.0, **options})


def hear(node: Node, *others: NodeId, now: float, **options: Any) -> tuple[Instruction, ...]:
    """Let a node hear the first beats of ``others``; the last batch. Who hears too few electors carries little out."""
    batch: tuple[Instruction, ...] = ()
    for other in others:
        batch = node.handle(BeatReceived(beat=beat_of(other, **options)), now)
    return batch
