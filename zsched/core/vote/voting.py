"""VOTE in motion: proposals at one robot. Is a task's vote open, what is its outcome, when to commit the winner?

Knows: which proposals are fresh, which robots answer a call, which of them commits and when; the outcome in words. Does
not know: the reason of a robot's proposal (`zsched.core.scheduler.rounds`), the count's rules (`tally`), how a winner
is committed (`register`).

The first proposal for a move *opens* a vote and so calls all other robots to it. A robot that has proposed within
`vote_time` has already answered. A proposal is fresh for the same time: twice a gather, since an answer may take a
whole gather when a peer is frozen. The winner's voters commit it, staggered by rank, so that usually one suffices.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from zsched.core.values.change import MoveOwner
from zsched.core.values.fleet import Timing
from zsched.core.values.in_force import InForce
from zsched.core.values.instructions import PublishProposal, RecordStory
from zsched.core.values.model import Allocation, NodeId, PeerState, Proposal, TaskId
from zsched.core.values.quorum import present_voters
from zsched.core.values.todo import ToDo
from zsched.core.vote.tally import Tally, VoteOutcome, tally

VOTE_MARGIN_S = 0.1
"""A vote ends this long after the time for two gathers."""


def vote_time(timing: Timing) -> float:
    """How long a vote stays open and a proposal fresh, in seconds."""
    return 2 * timing.gather_s + VOTE_MARGIN_S


class Voting:
    """One task's voting at one robot. Times are monotonic seconds."""

    def __init__(self, in_force: InForce, me: NodeId) -> None:
        self._me, self._in_force = me, in_force
        self.proposals: dict[NodeId, tuple[Proposal, float]] = {}
        """Each robot's newest proposal and when it came."""
        self.called_at = -math.inf
        """When this robot last proposed a planned move, first tries in vain left out."""
        self._first_call_at: float | None = None
        """When it proposed one on today's value for the first time; ``None``: not yet, or twice already."""
        self.opened_at: float | None = None
        """Since when a vote on a move is open."""
        self.tally: Tally | None = None
        self.tally_base = 0
        self.tally_at = -math.inf
        self.commit: MoveOwner | None = None
        """The change that this robot will or does propose to the register."""
        self._won_at = math.inf
        """When its vote was won; infinity once the change is handed out."""
        self._commit_rank = 0
        self.awaited_until = -math.inf
        """A vote on a move was won: until when its value should be learnt."""

    @property
    def _voters(self) -> tuple[NodeId, ...]:
        return self._in_force.voters

    @property
    def _vote_s(self) -> float:
        return vote_time(self._in_force.timing)

    @property
    def commit_at(self) -> float:
        """When this robot proposes its change: it waits for those of a better rank."""
        return self._won_at + self._in_force.timing.stagger_s * self._commit_rank

    def next_deadline(self) -> float:
        """When a commit is due or the open vote ends; infinity when neither."""
        return self.commit_at if self.opened_at is None else min(self.commit_at, self.opened_at + self._vote_s)

    def call(self, now: float) -> None:
        """This robot proposes a move that takes turns.

        The first try on a value keeps the task's turn: an owner that is asked to leave and slow to stop leaves by the
        next vote, if that comes before its lease is granted again.
        """
        if self._first_call_at is None:
            self._first_call_at = now
        else:
            self.called_at, self._first_call_at = now, None

    def going_to(self, now: float) -> NodeId | None:
        """Where the task is about to go: by a commit or a vote that was won, else by this robot's open proposal.

        A proposal that is too old to count says nothing.
        """
        if self.commit is not None:
            return self.commit.owner
        if now < self.awaited_until and self.tally is not None:
            return self.tally.winner
        mine = self.proposals.get(self._me)
        is_open = self.opened_at is not None and mine is not None and now - mine[1] <= self._vote_s
        return mine[0].candidate if mine is not None and is_open else None

    # --- proposals -----------------------------------------------------------------------------------------------

    def absorb(self, proposal: Proposal, allocation: Allocation, now: float) -> bool:
        """Take in a proposal, our own too; whether it calls this robot to propose as well.

        On another base than ``allocation``, the present value, it does not count.
        """
        if proposal.base_revision != allocation.revision:
            return False
        self.proposals[proposal.voter] = (proposal, now)
        if proposal.candidate == allocation.owner:
            return False
        if self.opened_at is None and self.commit is None:
            self.opened_at = now
        return proposal.voter != self._me and self._must_answer(now)

    def _must_answer(self, now: float) -> bool:
        mine = self.proposals.get(self._me)
        return self._me in self._voters and self.commit is None and (mine is None or now - mine[1] > self._vote_s)

    # --- the count -----------------------------------------------------------------------------------------------

    def count(self, allocation: Allocation, states: Mapping[NodeId, PeerState], now: float) -> Tally | None:
        """Count the open vote; its tally when the vote has ended, ``None`` while it goes on or none is open.

        Args:
            allocation: the present value: proposals must name its revision, and it names the owner.
            states: this node's view of every node.
            now: monotonic seconds.
        """
        if self.opened_at is None:
            return None
        fresh = {
            voter: proposal
            for voter, (proposal, at) in self.proposals.items()
            if now - at <= self._vote_s and proposal.base_revision == allocation.revision
        }
        is_over = now >= self.opened_at + self._vote_s
        counted = tally(
            fresh,
            voters=self._voters,
            present=present_voters(self._voters, states),
            owner=allocation.owner,
            is_over=is_over,
        )
        self.tally, self.tally_base, self.tally_at = counted, allocation.revision, now
        if counted.outcome is VoteOutcome.PENDING:
            return None
        self.opened_at = None
        if counted.outcome is VoteOutcome.WON:
            timing = self._in_force.timing
            self.awaited_until = now + timing.ballot_s + timing.stagger_s
            self._schedule_commit(counted, allocation, fresh, now)
        return counted

    def _schedule_commit(
        self, counted: Tally, allocation: Allocation, fresh: Mapping[NodeId, Proposal], now: float
    ) -> None:
        supporters = [voter for voter, candidate in counted.votes if candidate == counted.winner]
        if self._me not in supporters or counted.winner is None:
            return
        self.commit = MoveOwner(base_revision=allocation.revision, owner=counted.winner, reason=fresh[self._me].reason)
        self._commit_rank = supporters.index(self._me)
        self._won_at = now

    # --- the commit ----------------------------------------------------------------------------------------------

    def take_commit(self, now: float) -> MoveOwner | None:
        """The change that is due now; it is handed out once."""
        if self.commit is None or now < self.commit_at:
            return None
        self._won_at = math.inf
        return self.commit

    def end_commit(self) -> None:
        """Our change was committed, overtaken or given up: votes may be called again."""
        self.commit, self._won_at, self.awaited_until = None, math.inf, -math.inf

    def on_learnt(self) -> None:
        """A newer revision is known: drop proposals on older bases, and a commit that is not handed out yet."""
        self.proposals.clear()
        self.opened_at, self.awaited_until = None, -math.inf
        if self._first_call_at is not None:
            self.called_at, self._first_call_at = self._first_call_at, None
        if self.commit is not None and self.commit_at < math.inf:
            self.end_commit()


class Votes:
    """All tasks' votes at one robot (on edges none is ever open)."""

    def __init__(self, in_force: InForce, me: NodeId) -> None:
        self._me = me
        self.tasks = in_force.by_task(lambda _name: Voting(in_force, me))

    def next_deadline(self) -> float:
        """When a commit is due or an open vote ends; infinity when neither."""
        return min((voting.next_deadline() for voting in self.tasks.values()), default=math.inf)

    @property
    def is_idle(self) -> bool:
        """Whether no vote is open."""
        return all(voting.opened_at is None for voting in self.tasks.values())

    def propose(
        self,
        proposal: Proposal,
        allocation: Allocation,
        states: Mapping[NodeId, PeerState],
        todo: ToDo,
        now: float,
        *,
        takes_turns: bool,
    ) -> None:
        """This robot's own proposal: send it to everybody, and count it here. ``takes_turns``: it costs one."""
        if takes_turns:
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
