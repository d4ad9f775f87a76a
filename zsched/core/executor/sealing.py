"""EXECUTOR, beside the handover: when a task becomes *leased*, which means exclusive for every node.

An operator brings a new fleet file to one machine after the other, so `exclusive: true` holds on some nodes first. A
candidate with the old file may work without a lease, and for any time while it is cut off. So the nodes agree through
the task's register whether the task is leased (`Allocation.leased`). Every node obeys that value, whatever its own file
says:

* A task without an owner so far is leased from its first owner on, if the proposer's file says exclusive.
* Otherwise an owner whose file says exclusive proposes the change once no node works without a lease. Its own worker
  must have said that it has stopped. It asks every candidate and every node that it hears. Each must have learnt this
  epoch and answer that no worker there works without a lease. Until then no elector grants a lease: the owner waits,
  and its status says for which nodes. A node that is gone and no candidate is waited for if it has owned the task, for
  it may work still.
* The task stops being leased when the owner's file does not say exclusive and all nodes that it hears have its file.

Knows: peers' answers and fleet files. Does not know: grants (`zsched.core.vote.lease`), how a value is agreed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from zsched.core.executor.handover import Executor
from zsched.core.values.beat import Beat
from zsched.core.values.change import SetLeased
from zsched.core.values.fleet import TaskSpec
from zsched.core.values.in_force import InForce
from zsched.core.values.messages import Learnt
from zsched.core.values.model import Allocation, NodeId, TaskId
from zsched.core.values.struct import Struct, field
from zsched.core.values.words import shown

ASK_EVERY_S = 0.2
"""An owner that waits for unleased workers asks their nodes at most this often."""


class Sealing(Struct):
    """Decides for one node which changes of *leased* to propose and which peers to ask first."""

    in_force: InForce
    me: NodeId
    executors: Mapping[TaskId, Executor]
    over_at: float
    """When a lease of an earlier life of this node is over."""
    terms: Callable[[], str]
    """The terms of this node's leases now: by its file, or by the agreed number (`Leases.terms`)."""
    _files: dict[NodeId, str] = field(default_factory=dict)
    """{peer that was heard: its fleet file}."""
    _gone: dict[NodeId, None] = field(default_factory=dict)
    """Those of them that are gone."""
    _owners: dict[TaskId, set[NodeId]] = field(default_factory=dict)
    """{task: who has owned it, as far as this node has learnt}."""
    _answers: dict[NodeId, Learnt] = field(default_factory=dict)
    _asked_at: float = -math.inf

    def __post_init__(self) -> None:
        self._files, self._answers, self._gone = (self.in_force.by_node() for _ in range(3))
        self._owners = self.in_force.by_task()

    def hear(self, beat: Beat) -> None:
        """Note the fleet file that a living peer's beat names."""
        self._files[beat.node] = beat.fleet_file
        self._gone.pop(beat.node, None)

    def on_gone(self, node: NodeId) -> None:
        """A peer is gone."""
        self._gone[node] = None

    def note(self, value: Allocation) -> None:
        """A newer value was learnt."""
        if value.owner is not None:
            self._owners.setdefault(value.task, set()).add(value.owner)

    def on_answer(self, learnt: Learnt) -> None:
        """A peer answered a question. Answers count from this part's own first question on."""
        if self._asked_at > -math.inf:
            self._answers[learnt.node] = learnt

    def unleased(self, now: float) -> tuple[TaskId, ...]:
        """The tasks whose worker here may be working without a lease, for our answers."""
        return tuple(name for name, executor in self.executors.items() if executor.may_work_unleased(now))

    def due(self, values: Mapping[TaskId, Allocation], now: float) -> list[tuple[TaskId, SetLeased]]:
        """The changes that this node proposes as an owner.

        It waits until every lease of its own earlier life is over before it lets its worker do without one.
        """
        is_young = now < self.over_at
        return [
            (spec.name, SetLeased(base_revision=values[spec.name].revision, leased=spec.exclusive))
            for spec in self._open(values)
            if not (
                self._waits_for(spec, values[spec.name], now) if spec.exclusive else is_young or self._are_files_mixed()
            )
        ]

    def to_ask(self, values: Mapping[TaskId, Allocation], now: float) -> tuple[NodeId, ...]:
        """The peers to ask now for their learnt values and unleased workers."""
        tasks = [spec for spec in self._open(values) if spec.exclusive]
        if not tasks or now - self._asked_at < ASK_EVERY_S:
            return ()
        self._asked_at = now
        waits_for = {name for spec in tasks for name in self._waits_for(spec, values[spec.name], now)}
        return tuple(sorted(waits_for - {self.me}))

    def _open(self, values: Mapping[TaskId, Allocation]) -> list[TaskSpec]:
        """The tasks owned here whose agreed value differs from this node's file."""
        return [
            spec
            for spec in self.in_force.fleet.tasks
            if (value := values[spec.name]).owner == self.me and value.leased is not spec.exclusive
        ]

    def _are_files_mixed(self) -> bool:
        return any(file != self.in_force.file for name, file in self._files.items() if name not in self._gone)

    def _waits_for(self, spec: TaskSpec, value: Allocation, now: float) -> dict[NodeId, str]:
        """{node that must be heard, or whose worker must stop, before the task is leased: reason}.

        Ours, too: electors do not wait for a worker that has never had a lease.
        """
        owners = self._owners.get(spec.name, set()) & self.in_force.nodes.keys()
        heard = {name for name in self._files if name not in self._gone or name in owners}
        others = sorted({*heard, *spec.candidates} - {self.me})
        reasons = {name: self._obstacle(spec, value, name) for name in others}
        if self.executors[spec.name].may_work_unleased(now):
            reasons[self.me] = "has not said that its worker has stopped"
        return {name: reason for name, reason in reasons.items() if reason}

    def _obstacle(self, spec: TaskSpec, value: Allocation, node: NodeId) -> str:
        answer = self._answers.get(node)
        if answer is None:
            return "has not answered yet"
        if answer.lease_terms != self.terms():
            return "goes by other leases"
        if spec.name in answer.unleased:
            return "works without a lease"
        epoch = next((known.epoch for known in answer.values if known.task == spec.name), 0)
        return "" if epoch >= value.epoch else f"has not learnt epoch {shown(value.epoch)}"

    def problem(self, spec: TaskSpec, value: Allocation, now: float) -> str:
        """How this node's file and the agreed value differ at ``now``; empty when they do not."""
        if value.owner is None or value.leased is spec.exclusive:
            return ""
        if not spec.exclusive:
            return "exclusive for the fleet, though not by this node's fleet file"
        text = "exclusive by this node's fleet file, not yet for the fleet"
        if value.owner != self.me:
            return f"{text}: {value.owner} waits, or works without a lease (see its status)"
        waits = ", ".join(f"{name} {reason}" for name, reason in self._waits_for(spec, value, now).items())
        return f"{text}: nobody works until all candidates go by it ({waits or 'agreeing'})"
