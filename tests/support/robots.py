"""One robot's scheduler and votes together, as the node runs them. Knows: `Rounds`, `Votes`, what goes between them."""

from __future__ import annotations

from collections.abc import Mapping
from random import Random

from zsched.core.gateway.gateway import Gateway
from zsched.core.scheduler.rounds import Rounds
from zsched.core.values.fleet import Fleet
from zsched.core.values.in_force import InForce
from zsched.core.values.instructions import Instruction
from zsched.core.values.model import Allocation, NodeId, PeerState, Proposal, TaskId
from zsched.core.values.todo import ToDo
from zsched.core.vote.voting import Votes


class Decider:
    """Gathers, judges, proposes and votes for one robot; no register, no executor."""

    def __init__(self, fleet: Fleet, me: NodeId, gateway: Gateway, seed: int = 1, now: float = 0.0) -> None:
        self.votes = Votes(InForce(fleet), me)
        self.rounds = Rounds(InForce(fleet), me, gateway, self.votes.tasks, Random(seed), now)
        self.tasks = self.rounds.tasks

    def next_deadline(self) -> float:
        """When `tick` may have something to do."""
        return min(self.rounds.next_deadline(), self.votes.next_deadline())

    def tick(
        self, values: Mapping[TaskId, Allocation], states: Mapping[NodeId, PeerState], now: float
    ) -> list[Instruction]:
        """Time has passed."""
        todo = ToDo()
        for proposal in self.rounds.tick(values, states, todo, now):
            takes_turns = self.rounds.tasks[proposal.task].takes_turns
            self.votes.propose(proposal, values[proposal.task], states, todo, now, takes_turns=takes_turns)
        self.votes.count(values, states, todo, now)
        return self._settled(todo, now)

    def absorb_proposal(
        self, proposal: Proposal, value: Allocation, states: Mapping[NodeId, PeerState], now: float
    ) -> list[Instruction]:
        """A proposal was heard."""
        todo = ToDo()
        self.votes.absorb(proposal, value, states, todo, now)
        return self._settled(todo, now)

    def on_learnt(self, task: TaskId, *, is_new_epoch: bool, now: float) -> None:
        """A newer revision is known."""
        self.votes.on_learnt(task)
        self.rounds.on_learnt(task, is_new_epoch=is_new_epoch, now=now)

    def _settled(self, todo: ToDo, now: float) -> list[Instruction]:
        for task, is_escape in todo.called:
            self.rounds.on_called(task, is_escape=is_escape, now=now)
        for task in todo.stayed:
            self.rounds.on_stayed(task)
        return [*todo.send, *todo.apply]
