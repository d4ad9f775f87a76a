"""The one answer of every stage: the result of one event and of the time that has passed.

Knows: what there is to do, and its order: *persist, then send, then apply*, so that every prefix of it is safe. Does
not know: the reasons.

A stage writes into the `ToDo` that it gets and returns nothing of the kind. `Node` passes the same one from stage to
stage and makes a batch of instructions of it at the end.
"""

from __future__ import annotations

from zsched.core.values import instructions as do
from zsched.core.values.change import Change, Ended, Rewrite, RoundOutcome
from zsched.core.values.electorate import FleetValue
from zsched.core.values.fleet import Fleet
from zsched.core.values.instructions import FleetInstruction
from zsched.core.values.model import Allocation, TaskId
from zsched.core.values.struct import Struct, field

_LOCAL = frozenset(
    {
        do.AdoptFleet,
        do.EndTask,
        do.ApplyRoutes,
        do.SetRole,
        do.StartWorker,
        do.StopWorker,
        do.RenewWorker,
        do.RestartWorker,
        do.StrikeDaemon,
        do.StoreRehearsal,
        do.RecordStory,
        do.StandDown,
    }
)


class ToDo(Struct):
    """What there is to do, by receiver."""

    must_persist: bool = False
    """The durable state has changed: it is on disk before anything is sent."""
    must_beat: bool = False
    """The other nodes must hear the next beat at once."""
    must_decide: bool = False
    """Something happened that may need a decision: a round now."""
    called: list[tuple[TaskId, bool]] = field(default_factory=list)
    """(task, whether its owner is to be left at once) of the votes to which another robot has called this one."""
    stayed: list[TaskId] = field(default_factory=list)
    """Tasks whose vote has ended with: stay."""
    ended: list[Ended] = field(default_factory=list)
    """Changes of this node's that were committed, overtaken or given up."""
    learnt: list[tuple[Allocation, str | None]] = field(default_factory=list)
    """(a newer value, why it came about; ``None``: another node committed it)."""
    send: list[do.Instruction] = field(default_factory=list)
    """Instructions whose effect other nodes, or an asking operator, will see."""
    apply: list[do.Instruction] = field(default_factory=list)
    """Instructions whose effect stays on this machine."""
    fleet: list[FleetInstruction] = field(default_factory=list)
    """What the fleet register asks of other nodes, and tells them."""
    fleet_ended: list[tuple[Rewrite[FleetValue], RoundOutcome]] = field(default_factory=list)
    """Changes of the fleet that were committed, overtaken or given up."""
    must_tell: bool = False
    """A change of the fleet was committed here: the other nodes must hear at once what this one has learnt."""
    in_force: Fleet | None = None
    """Another fleet is in force from now on: its document is stored, and the value with it is learnt."""

    stand_down: do.StandDown | None = None
    """This daemon ends: the last instruction, behind all others of the same event."""

    def add(self, *instructions: do.Instruction) -> None:
        """Sort instructions into sending and applying."""
        for instruction in instructions:
            (self.apply if type(instruction) in _LOCAL else self.send).append(instruction)

    def end(self, task: TaskId, change: Change, outcome: RoundOutcome) -> None:
        """A change has ended."""
        self.ended.append(Ended(task=task, change=change, outcome=outcome))

    @property
    def is_settled(self) -> bool:
        """Whether no stage has left anything for another stage."""
        is_of_fleet = self.fleet_ended or self.must_tell or self.in_force is not None
        return not (self.called or self.stayed or self.ended or self.learnt or is_of_fleet)

    @property
    def is_only_sent(self) -> bool:
        """Whether it holds only messages that can leave at once, mostly answers."""
        is_called_on = self.must_persist or self.must_beat or self.must_decide or self.stand_down is not None
        return not (is_called_on or self.apply) and self.is_settled
