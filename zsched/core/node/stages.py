"""What one daemon consists of: the six stages, membership beside them, and what they share.

Knows: which parts there are, and what is asked of several of them together. Does not know: what an event means to them
(the handlers beside it), in which order they act (`zsched.core.node.node`).
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from collections.abc import Set as AbstractSet
from random import Random
from types import MappingProxyType
from typing import Any, Final

from zsched.core.electorate.numbers import known_at_start
from zsched.core.executor.handover import Executor
from zsched.core.executor.progress import HangWatch
from zsched.core.executor.renewing import Renewing
from zsched.core.executor.rollouts import Rollouts
from zsched.core.executor.sealing import Sealing
from zsched.core.executor.sparing import Lack, lacking
from zsched.core.executor.tenure import Tenure
from zsched.core.executor.workers import Workers
from zsched.core.gateway.gateway import Gateway
from zsched.core.gateway.round_trips import RoundTrips
from zsched.core.membership.beat_room import BeatRoom
from zsched.core.membership.identity import Identity
from zsched.core.membership.knocking import Knocking
from zsched.core.membership.namesakes import Namesakes
from zsched.core.membership.pace import Pace
from zsched.core.membership.peers import Membership
from zsched.core.membership.refused import RefusedKeys
from zsched.core.membership.relink import Introductions, MuteLinks
from zsched.core.membership.solitude import Solitude
from zsched.core.profile.profile import Profiler
from zsched.core.profile.relay_ends import RelayEnds
from zsched.core.route.gaps import StreamGaps
from zsched.core.route.rates import StreamRates
from zsched.core.scheduler.eligibility import NO_DOUBTS, Doubts
from zsched.core.scheduler.flags import NodeFlags
from zsched.core.scheduler.probation import Probation
from zsched.core.scheduler.rounds import Rounds
from zsched.core.scheduler.unseen import Unseen
from zsched.core.values import instructions as do
from zsched.core.values.document import Flag
from zsched.core.values.durable import DurableState
from zsched.core.values.events import SlotReady
from zsched.core.values.fleet import Fleet, TaskSpec, file_hash
from zsched.core.values.in_force import InForce
from zsched.core.values.model import Allocation, NodeId, NodeKind, PeerState, TaskId
from zsched.core.values.plan import StreamCount, WorkerRole
from zsched.core.values.problems import Problem, ProblemKey
from zsched.core.values.profile import Profile, WorkerState
from zsched.core.values.recent import RecentWorst
from zsched.core.values.startup import Startup
from zsched.core.values.struct import Struct
from zsched.core.values.todo import ToDo
from zsched.core.values.veto import Veto
from zsched.core.vote.agreement import Agreement
from zsched.core.vote.disks import Disks
from zsched.core.vote.expiry import Expiry
from zsched.core.vote.lease import IN_DOUBT
from zsched.core.vote.retuning import Retuning
from zsched.core.vote.voting import Votes

LAG_SHOWN_S: Final = 30.0
"""A delay of the loop is shown for so long: who looks at the status never comes in the moment of one."""
HISTORY = 32
"""Past values of a task that status can show."""


_NOTHING_FOUND: Final = Startup()


class PastValue(Struct, frozen=True, kw_only=True):
    """A learnt value, when this node learnt it and why it came about."""

    value: Allocation
    at: float
    reason: str
    is_known: bool
    """It was there before this node knew of it."""


UNREADY_SHOWN_S = 2.0
"""A slot that no worker takes for longer is a problem: a handover takes less."""


class Unready(Struct, frozen=True, kw_only=True):
    """A slot whose worker our relay does not see: what it misses there, and since when."""

    slot: SlotReady
    since: float


class Stages:
    """One daemon's whole decision state.

    Args:
        fleet: what the node goes by at its start: the validated fleet file, or the document that its state names.
        me: this node's name.
        durable: what the state file holds, with the incarnation of *this* start; ``None`` when there is no valid file
            (then this node is no elector).
        incarnation: this start's number (the durable one, or a guess above any seen when there is none).
        electorate: hash of the electorate in force.
        rng: seeded by the shell; the only source of chance.
        now: monotonic seconds.
        startup: what the daemon found on its machine.
        stored: {hash: what it says} of the documents on this node's disk that its state names.
        flags: {hash: its flags} of those of them that have any.
    """

    is_draining = False
    loop_lag_s = 0.0
    """The longest delay since the last beat, for the beat; `recent_lag` is what the status shows."""
    stream_counts: tuple[StreamCount, ...] = ()
    counted_at: float | None = None
    """When the relay last told them."""
    dropped_at: dict[str, float]
    """{counter: when it rose last}, of those that count invalid frames and links."""
    beat_sequence = 0
    # what the door (`zsched.core.node.node`) keeps from one event to the next
    _promised = math.inf
    """The deadline that the last batch was given out with."""
    behind_write: tuple[do.Instruction, ...] = ()
    """What the last batch had for this machine behind its write, if it had one: a refused write cuts it off."""

    def __init__(
        self,
        *,
        fleet: Fleet,
        me: NodeId,
        durable: DurableState | None,
        incarnation: int,
        electorate: str,
        rng: Random,
        now: float,
        startup: Startup = _NOTHING_FOUND,
        stored: Mapping[str, Fleet] = MappingProxyType({}),
        flags: Mapping[str, tuple[Flag, ...]] = MappingProxyType({}),
    ) -> None:
        self.in_force = InForce(known_at_start(fleet, durable, stored))
        fleet = self.fleet
        self.me, self.startup = me, startup
        self.kind = fleet.node(me).kind
        self.incarnation = incarnation
        self.started_at = now
        self.has_state = durable is not None
        self.told_fleet = fleet
        """The newest fleet file that was given to the runtime; what of it is in force is `fleet`."""
        self.by_file = self.text_hash
        """Hash of what that file says; once a document is agreed, the node does not go by the file."""
        self.counters: Counter[str] = Counter()
        self.problems: dict[ProblemKey, str] = {}
        self.history: dict[TaskId, deque[PastValue]] = self.in_force.by_task(lambda _name: deque(maxlen=HISTORY))

        # PROFILE, GATEWAY
        self.profiler = Profiler(me, incarnation, fleet.timing)
        self.relay_ends = RelayEnds()
        self.gateway = Gateway(self.in_force)
        self.round_trips = RoundTrips(me)
        # SCHEDULER, VOTE
        self.votes = Votes(self.in_force, me)
        self.probation, self.unseen = Probation(self.in_force), Unseen(self.in_force)
        self.flags = NodeFlags(rank=[node.name for node in fleet.nodes].index(me))
        self.rounds = Rounds(
            self.in_force, me, self.gateway, self.votes.tasks, rng, now, self._doubts, self.round_trips, self.flags
        )
        self.agreement = Agreement(
            in_force=self.in_force,
            me=me,
            durable=durable,
            incarnation=incarnation,
            electorate=electorate,
            rng=rng,
            now=now,
            stored=stored,
            flags=flags,
        )
        self.registers = self.agreement.registers
        self.unconfirmed: dict[TaskId, str] = {}
        """{task whose stored value is not carried out yet: how it is known}."""
        self.disks = Disks()
        self.retuning = Retuning(me, self.in_force)
        self.expiry = Expiry(rank=self.flags.rank)
        self.flags.take(self.agreement.flags, now)
        self._begin_work(fleet, now)
        self._begin_membership(now)
        self._todo = ToDo()

    def _begin_work(self, fleet: Fleet, now: float) -> None:
        """EXECUTOR and ROUTE: the tasks' slots, the workers, the streams."""
        me = self.me
        self.executors = {
            task.name: Executor(spec=task, me=me, has_streams=self.kind is NodeKind.ROBOT) for task in fleet.tasks
        }
        self.workers = Workers.of(fleet, me)
        self.worker_states = self.workers.states
        self.renewing = Renewing(me)
        self.rollouts = Rollouts()
        self.rollouts.take(fleet, now)
        self.hangs = HangWatch(self.in_force)
        self.recent_lag = RecentWorst(LAG_SHOWN_S)
        leases = self.agreement.leases
        self.tenure = Tenure(self.in_force, me, leases, self.executors)
        self.sealing = Sealing(self.in_force, me, self.executors, leases.over_at, lambda: leases.terms)
        self.missed: dict[str, tuple[int, float | None]] = {}
        """{stream: (how many of its samples somebody may miss, when that last rose; ``None``: before we started)}."""
        self.rates = StreamRates()
        self.gaps = StreamGaps()
        self.killed_at: dict[TaskId, float] = {}
        """{task: when our worker was last killed for a rehearsal}."""
        self.unready: dict[TaskId, Unready] = self.in_force.by_task()
        """The slots whose worker our relay does not see, or not any more."""

    def _begin_membership(self, now: float) -> None:
        """Who is there, who this node is to them, and when to beat."""
        me, here = self.me, self.in_force
        self.membership = Membership(me, here)
        self.identity = Identity(me, here, self.incarnation, now)
        self.namesakes = Namesakes(here)
        self.knocking = Knocking(here)
        self.refused_keys = RefusedKeys()
        self.introductions, self.mute_links = Introductions(), MuteLinks()
        self.solitude = Solitude(in_force=here, started_at=now)
        self.quorum_at = now
        """When this node last knew a majority of the electors to answer; its start, if never."""
        self.dropped_at = {}
        self.stateless: dict[NodeId, None] = here.by_node()
        """Electors whose newest beat says that they answer no proposer."""
        self.fileless: dict[NodeId, None] = here.by_node()
        """Those of them that have no state file at all."""
        self.beat_room = BeatRoom()
        self.beat_at = now
        """When the next beat is due that nothing brings forward."""
        self.pace = Pace(in_force=here)

    # --- the fleet in force ----------------------------------------------------------------------------------------

    @property
    def fleet(self) -> Fleet:
        """What this node goes by."""
        return self.in_force.fleet

    @property
    def fleet_file(self) -> str:
        """Its hash."""
        return self.in_force.file

    @property
    def text_hash(self) -> str:
        """Hash of it as its text says it, without rollouts."""
        return file_hash(self.fleet)

    # --- queries -----------------------------------------------------------------------------------------------------

    def values(self) -> Mapping[TaskId, Allocation]:
        """{task: the newest learnt register value}."""
        return self.agreement.values()

    @property
    def has_deadlines(self) -> bool:
        """Whether the way to other nodes counts in any score: by the agreed tunings, for operators change them."""
        return any(value.tuning.deadline_ms is not None for value in self.values().values())

    def owned(self) -> tuple[TaskId, ...]:
        """The tasks that this node owns, as far as it has learnt."""
        return tuple(name for name, value in self.values().items() if value.owner == self.me)

    def movable(self, now: float) -> tuple[TaskId, ...]:
        """What of it another candidate could take, as far as is known: one that lives and that nothing keeps out."""
        return tuple(
            name
            for name in self.owned()
            if any(self._can_take(candidate, now) for candidate in self.fleet.task(name).candidates)
        )

    def busy(self) -> AbstractSet[TaskId]:
        """The tasks whose worker here has a role: it is the owner's, or has not ended its work."""
        return {name for name, one in self.executors.items() if one.role.role is not WorkerRole.IDLE}

    def finishing(self) -> tuple[TaskId, ...]:
        """The tasks that have moved away while the worker here has not said that it has finished."""
        return tuple(name for name, executor in self.executors.items() if executor.is_finishing)

    def lacking(self, now: float) -> tuple[Lack, ...]:
        """The tasks that would have no owner if this node went now, though not if it waited."""
        others = {name: self._told_in_this_life(name, now) for name in self.membership.alive()}
        return lacking(self.fleet.tasks, self.values(), self.me, others, self.flags.closed)

    def _told_in_this_life(self, node: NodeId, now: float) -> Profile | None:
        profile = self.gateway.fresh(node, now)
        is_old = profile is not None and profile.incarnation != self.membership.incarnation(node)
        return None if is_old else profile

    def _can_take(self, node: NodeId, now: float) -> bool:
        is_there = node != self.me and self.membership.state(node) is PeerState.ALIVE
        return is_there and node not in self.flags.closed and not self.was_draining(node, now)

    def was_draining(self, node: NodeId | None, now: float) -> bool:
        """Whether an owner was told to stop, by the last that was heard of it."""
        data = None if node is None else self.gateway.newest(node, now)
        return data is not None and data.profile.draining

    def is_orphan(self, owner: NodeId | None) -> bool:
        """Whether a task's owner is gone: nobody could be found for it so far."""
        return owner is not None and self.membership.state(owner) is PeerState.GONE

    def renewals(self) -> tuple[TaskId, ...]:
        """The tasks whose worker here runs by an old recipe, as far as the fleet file names them."""
        return tuple(name for name in sorted(self.renewing.told) if name in self.executors)

    def heard_candidates(self, spec: TaskSpec, now: float) -> Mapping[NodeId, Profile]:
        """{candidate: its fresh profile} of the living ones, this node left out, and those that take nothing new."""
        return {name: profile for name, profile in self._heard(spec, now) if name not in self.flags.closed}

    def _is_enough(self, spec: TaskSpec) -> bool:
        """Whether this robot can do the task itself, and no other one shares it."""
        is_ready = self.worker_states.get(spec.name) is WorkerState.READY
        return is_ready and self.me in spec.candidates and self.in_force.voters == (self.me,)

    def _heard(self, spec: TaskSpec, now: float) -> Iterator[tuple[NodeId, Profile]]:
        """The other living candidates with a fresh profile."""
        for name in spec.candidates:
            if name != self.me and self.membership.state(name) is PeerState.ALIVE:
                profile = self.gateway.fresh(name, now)
                if profile is not None:
                    yield name, profile

    def unfit(self, task: TaskId, now: float) -> Mapping[NodeId, Veto]:
        """{node: why it can hold no lease} of an exclusive task; of any other one nobody needs any."""
        if not self.executors[task].is_leased:
            return {}
        owner, confirm_s, misses = self.registers[task].value.owner, self.fleet.timing.confirm_s, self.membership.misses

        def are_apart(node: NodeId, elector: NodeId) -> bool:
            # An owner may refute it; whoever loses the same electors a moment later would get the task for nothing
            for_s = confirm_s if node == owner else 0.0
            return misses(node, elector, now, for_s) or misses(elector, node, now, for_s)

        return self.agreement.leases.unfit(self.fleet.task(task).candidates, self.stateless.keys(), are_apart)

    def resting(self, now: float) -> Mapping[TaskId, str]:
        """{exclusive task that this node owns and may not work on: why}, once that lasts. For every turn."""
        leases, found = self.agreement.leases, dict[TaskId, str]()
        if not leases.is_holding:
            return found
        for task in self.owned():
            if self.tenure.misses_lease(self.registers[task].value, now):
                veto = IN_DOUBT if leases.is_in_doubt else self.unfit(task, now).get(self.me)
                why = "no majority of the electors grants one" if veto is None else veto.why
                found[task] = f"it rests, for it has no lease ({why})"
        return found

    def _doubts(self, spec: TaskSpec, now: float) -> Doubts:
        in_grace, unproven = self.membership.in_grace(), self.probation.doubts(spec, now)
        owner = self.registers[spec.name].value.owner
        unfit = self.unfit(spec.name, now)
        told = None if owner is None else self.gateway.fresh(owner, now)
        loads = ((name, profile.worker(spec.name)) for name, profile in self._heard(spec, now))
        ready = (name for name, load in loads if load is not None and load.state is WorkerState.READY)
        left = frozenset(self.flags.drained)
        stays = None if owner in left or (told is not None and told.draining) else owner
        unseen = self.unseen.look(
            spec,
            ready,
            self.probation,
            now,
            self.fleet.timing.decide_s,
            owner=stays,
            is_ours=stays == self.me,
            is_enough=self._is_enough(spec),
        )
        if owner is not None and self.unanswered_s(spec.name, now) is not None:
            unseen |= {owner}
        if owner is not None and self.rounds.tasks[spec.name].judge.is_overdue(now):
            left |= {owner}
        if not in_grace and not unproven and not unfit and not unseen and not left:
            return NO_DOUBTS
        return Doubts(in_grace=in_grace, unproven=unproven, unseen=unseen, left=left, unfit=unfit)

    def unanswered_s(self, task: TaskId, now: float) -> float | None:
        """For how long the owner has answered nothing here that it should have; ``None``: not too long.

        Not while our relay misses its worker for longer, for that is told by itself; nor while the library says that
        the worker is at work.
        """
        value, unready = self.registers[task].value, self.unready.get(task)
        told = None if value.owner is None else self.gateway.fresh(value.owner, now)
        load = None if told is None else told.worker(task)
        is_at_work = load is not None and (load.unended_s is not None or (load.jobs is not None and load.jobs.backlog))
        is_told = unready is not None and now - unready.since >= UNREADY_SHOWN_S
        return None if is_told or is_at_work else self.hangs.progress.overdue_s(task, value.epoch, now)

    def tend_disks(self) -> None:
        """Somebody has told how long a save takes: the clocks of votes leave room for it."""
        self.in_force.pace(self.disks.pace_s(self.me, self.agreement.electors))

    def counts_age_s(self, now: float) -> float:
        """For how long the relay has told no counts; 0 before the first."""
        return 0.0 if self.counted_at is None else max(now - self.counted_at, 0.0)

    def set_problem(self, kind: str, text: str | None, subject: str = "") -> None:
        """Show a problem in the status, or (``None``) that it is over."""
        self.problems.pop((kind, subject), None)
        if text is not None:
            self.problems[kind, subject] = text

    def clear_problems(self, *kinds: Problem) -> None:
        """Show none of these any more: what they come from says them again, where it is still so."""
        self.problems = {key: text for key, text in self.problems.items() if key[0] not in kinds}


Handler = Callable[[Stages, Any, ToDo, float], None]
"""What an event means: it changes the stages and writes down what is to be done. The time is monotonic seconds."""
