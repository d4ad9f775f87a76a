"""The door's order: what one event leads to, sorted so that every prefix of it is safe.

Knows: which instructions other nodes see and which only this machine does. Does not know: why they are given.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from zsched.core import instructions as do

_LOCAL = frozenset(
    {
        do.ApplyRoutes,
        do.SetRole,
        do.StartWorker,
        do.StopWorker,
        do.ResetWorker,
        do.RestartWorker,
        do.RecordStory,
        do.StandDown,
    }
)


@dataclass(slots=True)
class Batch:
    """One call's instructions: *persist (when dirty), then send, then apply*."""

    is_dirty: bool = False
    send: list[do.Instruction] = field(default_factory=list)
    apply: list[do.Instruction] = field(default_factory=list)

    def add(self, *instructions: do.Instruction) -> None:
        """Sort instructions into sending (other nodes see it) and applying (this machine does it)."""
        for instruction in instructions:
            (self.apply if type(instruction) in _LOCAL else self.send).append(instruction)
