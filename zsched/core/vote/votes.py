"""VOTE in motion at one robot, all tasks: takes proposals in, counts votes, hands winners on to be committed.

Knows: every task's voting, the outcome of a vote in words. Does not know: the reason of a robot's proposal
(`zsched.core.scheduler.rounds`), when a vote is open and how it ends (`zsched.core.vote.voting`), the register.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from zsched.core.instructions import PublishProposal, RecordStory
from zsched.core.todo import ToDo
from zsched.core.values.change import MoveOwner
from zsched.core.values.fleet import Fleet
from zsched.core.values.model import Allocation, NodeId, PeerState, Proposal, TaskId
from zsched.core.vote.tally import VoteOutcome
from zsched.core.vote.voting import Voting


class Votes:
    """All tasks' votes at one robot (on edges none is ever open)."""

    def __init__(self, fleet: Fleet, me: NodeId) -> None:
        self._me = me
        self.tasks = {spec.name: Voting(fleet, me) for spec in fleet.tasks}

    def adopt(self, fleet: Fleet) -> None:
        """Take tasks and robots from ``fleet``: votes on tasks that stay go on."""
        kept = dict(self.tasks)
        self.tasks.clear()  # the rounds look into the same table
        for spec in fleet.tasks:
            voting = self.tasks[spec.name] = kept.get(spec.name) or Voting(fleet, self._me)
            voting.adopt(fleet)

    def next_deadline(self) -> float:
        """When a commit is due or an open vote ends; infinity when neither."""
        return min((voting.next_deadline() for voting in self.tasks.values()), default=math.inf)

    def count_with(self, voters: tuple[NodeId, ...]) -> None:
        """These robots vote from now on."""
        for voting in self.tasks.values():
            voting.count_with(voters)

    @property
    def is_idle(self) -> bool:
        """Whether no vote is open."""
        return all(voting.opened_at is None for voting in self.tasks.values())

    def propose(
        self, proposal: Proposal, allocation: Allocation, states: Mapping[NodeId, PeerState], todo: ToDo, now: float
    ) -> None:
        """This robot's own proposal: send it to everybody, and count it here."""
        if not proposal.is_escape:
            self.tasks[proposal.task].call(now)
        todo.add(PublishProposal(proposal=proposal))
        self.absorb(proposal, allocation, states, todo, now)

    def absorb(
        self, proposal: Proposal, allocation: Allocation, states: Mapping[NodeId, PeerState], todo: ToDo, now: float
    ) -> None:
        """Any robot's proposal. It does not count on another base than ``allocation``, the present value."""
        voting = self.tasks[proposal.task]
        if voting.absorb(proposal, allocation, now):
            todo.called.append((proposal.task, proposal.is_escape))
        self._count(voting, allocation, states, todo, now)

    def count(
        self,
        values: Mapping[TaskId, Allocation],
        states: Mapping[NodeId, PeerState],
        todo: ToDo,
        now: float,
    ) -> None:
        """Time has passed, or robots have come or gone: count what is open."""
        for name, voting in self.tasks.items():
            if voting.opened_at is not None:
                self._count(voting, values[name], states, todo, now)

    @staticmethod
    def _count(
        voting: Voting, allocation: Allocation, states: Mapping[NodeId, PeerState], todo: ToDo, now: float
    ) -> None:
        ended = voting.count(allocation, states, now)
        if ended is None:
            return
        if ended.outcome is VoteOutcome.STAY:
            todo.stayed.append(allocation.task)
        text = f"{ended.outcome}: {ended.reason} ({', '.join(f'{v}->{c}' for v, c in ended.votes)})"
        todo.add(RecordStory(stage="vote", text=text, task=allocation.task, epoch=allocation.epoch))

    def due_commits(self, now: float) -> list[tuple[TaskId, MoveOwner]]:
        """Changes that are due now; each is handed out once."""
        due = ((name, voting.take_commit(now)) for name, voting in self.tasks.items())
        return [(name, change) for name, change in due if change is not None]

    def on_commit_ended(self, task: TaskId) -> None:
        """Our change was committed, overtaken or given up: votes may be called again."""
        if task in self.tasks:  # it may have left the fleet file
            self.tasks[task].end_commit()

    def on_learnt(self, task: TaskId) -> None:
        """A newer revision is known: drop proposals on older bases."""
        self.tasks[task].on_learnt()
