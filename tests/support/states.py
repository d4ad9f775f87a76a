"""What a node has on its disk, with what a test does not care about filled in."""

from __future__ import annotations

from typing import Any

from zsched.core.values.durable import DurableState
from zsched.core.values.model import NodeId, RegisterState


def state_of(node: NodeId, *registers: RegisterState, **options: Any) -> DurableState:
    """The state of a node's seventh life, of generation 0, in the fleet "test"."""
    usual = {"fleet": "test", "incarnation": 7, "generation": 0, "hardware": "", "electorate": "e"}
    return DurableState(node=node, registers=registers, **{**usual, **options})
