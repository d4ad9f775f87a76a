"""Builds the status out of a node's state.

Knows: which figure stands where. Does not know: how it is shown.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator

from zsched.core.executor.handover import Executor, Phase
from zsched.core.executor.rhythm import HUNG_TIMES
from zsched.core.executor.rollouts import waiting
from zsched.core.gateway.shortfall import is_full, is_short
from zsched.core.node.stages import UNREADY_SHOWN_S, Stages, Unready
from zsched.core.route.rates import STALE_S
from zsched.core.scheduler.eligibility import OF_MACHINE, may_get
from zsched.core.scheduler.judge import by
from zsched.core.scheduler.rounds import TaskRound
from zsched.core.scheduler.scoring import score
from zsched.core.values.deadline import tells_jobs
from zsched.core.values.decision import Explanation
from zsched.core.values.document import Flag
from zsched.core.values.fleet import NodeSpec, TaskSpec
from zsched.core.values.gauges import possible
from zsched.core.values.model import Allocation, NodeId, Pause, PeerState, Pin, Reach, TaskId
from zsched.core.values.plan import Direction, ReadyWhen, Route, StreamCount
from zsched.core.values.problems import Problem, Told, parted, told_of
from zsched.core.values.profile import Profile, WorkerLoad, WorkerState
from zsched.core.values.quorum import majority
from zsched.core.values.snapshot import (
    SCHEMA,
    DecisionStatus,
    FlagStatus,
    HoldStatus,
    NodeStatus,
    PastAllocation,
    QuorumStatus,
    RolloutStatus,
    Snapshot,
    TaskStatus,
    VoteStatus,
)
from zsched.core.values.startup import NoState
from zsched.core.values.struct import replace
from zsched.core.values.veto import Filter
from zsched.core.values.words import Trouble, shown, told_of_worker
from zsched.core.vote.generations import way_out
from zsched.core.vote.voting import Voting

STARTED_BEFORE = (
    "who starts it (the task has no `command`) must start it again if it ran before this robot was in the fleet file "
    "there: the session {owner}-{task}.zenoh.json5 has this robot's address since"
)
INIT_THERE = "stop zsched there, run `zsched init` (it asks the fleet, and refuses where that is unsafe), and start it"
DRASTIC_AFTER_S = 60.0
"""What gives up a fleet's state is named only once its cause has stood for so long: daemons that begin anew come back.

A recovery beside electors that come back makes two fleets of one.
"""
RECOVER = "stop zsched on one that has its state, run `zsched fleet recover` there, and start it"
NO_SPARE = "no other candidate can take it"
HUNG_LEAST_S = 8.0
"""A job that takes `HUNG_TIMES` as long as jobs have taken may hang; one that takes less than this does not..."""
HUNG_FIRST_S = 30.0
"""...and, of a worker that has ended none of late, one that takes so long: a first job may load a model."""
LATE_RATIO = 0.5
"""A deadline that so many of a task's jobs miss is a problem, wherever the task is."""


def build_snapshot(node: Stages, now: float) -> Snapshot:
    """The whole status of ``node`` at ``now`` (monotonic seconds)."""
    quorum = _quorum(node)
    problems, kinds = parted(
        *node.namesakes.problems(now),
        *_problems(node, quorum, now),
        *_overloads(node, now),
        *_disk_problems(node),
        *_relay_problems(node, now),
        *told_of(node.knocking.problems(now, node.startup.fleet_path, is_agreed=bool(node.agreement.document_hash))),
    )
    return Snapshot(
        schema=SCHEMA,
        version=node.startup.version,
        fleet=node.fleet.name,
        node=node.me,
        kind=node.kind.value,
        incarnation=node.incarnation,
        up_s=now - node.started_at,
        loop_lag_s=node.recent_lag.worst(now),
        quorum=quorum,
        nodes=tuple(_node_status(node, spec, now) for spec in node.fleet.nodes),
        tasks=tuple(_task_status(node, spec, now) for spec in node.fleet.tasks),
        fleet_file=node.text_hash,
        fleet_revision=node.agreement.fleet_revision,
        document=node.agreement.document_hash,
        joins_at=node.startup.joins_at,
        counters=tuple(sorted((node.counters + node.agreement.counters).items())),
        frames_dropped_s=now - max(node.dropped_at.values()) if node.dropped_at else None,
        dropped_ages=tuple(sorted((name, now - at) for name, at in node.dropped_at.items())),
        refused=node.refused_keys.told(node.fleet, now),
        security=node.startup.security,
        order_s=node.fleet.timing.order_s,
        problems=problems,
        problem_kinds=kinds,
    )


def build_explanation(node: Stages, task: TaskId, now: float) -> Explanation:
    """What this node knows of the last judgement of ``task``; on an edge, which robots to ask."""
    states = node.membership.states()
    return Explanation(
        node=node.me,
        kind=node.kind.value,
        task=task,
        allocation=node.registers[task].value,
        robots=tuple(name for name in node.fleet.voters if states[name] is PeerState.ALIVE),
        decision=node.rounds.decision(task, now),
        age_s=max(now - node.rounds.tasks[task].judged_at, 0.0) if node.rounds.tasks[task].judgement else 0.0,
        vote=_vote(node.votes.tasks[task], now),
        knows_jobs=node.gateway.demands.job(task) is not None,
    )


def _problems(node: Stages, quorum: QuorumStatus, now: float) -> list[Told]:
    if _is_never_initialised(node, quorum):
        others = {key: text for key, text in node.problems.items() if key != (Problem.STATE, "")}
        names = ", ".join(quorum.stateless)
        first = (
            f"never initialised: no elector heard has a state ({names}), and nobody knows of one. "
            "If this node has lost its state and the fleet lives on elsewhere, first bring here, as the fleet file, "
            "what `zsched fleet export` writes on a living node, then `zsched init` here alone. If the fleet is new: "
            "Stop every daemon, run `zsched init` on every node, and start them again"
        )
        return [(Problem.NEVER_INITIALISED, first), *told_of(others)]
    said = {**node.problems, **node.agreement.problems}
    is_out = (Problem.TAKEN_OUT, "") in said
    states = node.membership.states()
    if is_out:  # the others go by another document, as they should
        said = {key: text for key, text in said.items() if key[1] not in states}
    problems = told_of(said)
    is_apart = any(kind == Problem.GENERATION for kind, _ in said)
    is_alone = node.solitude.is_alone(now, has_heard=node.membership.has_heard)
    if is_alone and not is_apart and not node.knocking.problems(now):
        may_be_refused = node.fleet.security is not None and (Problem.CERTIFICATE, "") not in said  # that line says why
        problems.insert(0, node.solitude.problem(node.me if may_be_refused else ""))
    if quorum.stateless:
        named = f"{len(quorum.stateless)} of {quorum.electors}: {', '.join(quorum.stateless)}"
        problems.append((Problem.STATELESS, f"electors without their state, {named}"))
    fresh = _never_had_one(node, quorum)
    has_enough = quorum.electors - len(quorum.stateless) >= quorum.needed
    if fresh and has_enough:
        problems.append(f"no state file on {', '.join(fresh)}: {INIT_THERE}")
    if quorum.apart:
        problems.append(
            "electors of another generation, or with other electors in their fleet file, "
            f"{len(quorum.apart)} of {quorum.electors}: {', '.join(quorum.apart)}; they and this node refuse each other"
        )
    if not quorum.ok:
        # A fleet that lives on elsewhere must not become two.
        is_left_behind = is_out or is_apart or (is_alone and not node.agreement.is_elector)
        problems.append((Problem.NO_QUORUM, _no_quorum(node, quorum, now, is_left_behind=is_left_behind)))
        if not is_alone and not is_out:  # who was taken out is let in nowhere: the electors are well
            problems += [f"elector {told}" for name in node.fleet.electors if (told := _why_silent(node, name, now))]
    elif quorum.alive == quorum.needed < quorum.electors:
        missing = [name for name in node.fleet.electors if not _can_answer(node, name)]
        problems.append(
            f"no elector to spare: {quorum.alive} of {quorum.electors} can answer, {quorum.needed} needed. "
            "With one more away nothing is decided. "
            + "; ".join(_why_silent(node, name, now) or _why_refused(node, name) for name in missing)
        )
    voters = node.agreement.voters
    silent = [name for name in voters if node.membership.state(name) is not PeerState.ALIVE]
    needed = majority(len(voters))
    # Who has just started knows nothing of an owner that it never heard: only a vote replaces that one.
    never_heard = f"; one that was never heard, once they are away for {node.fleet.away_s:g} s"
    never_heard = never_heard if node.agreement.document_hash else ""
    told = ", ".join(_as_heard(node, silent))
    if quorum.ok and not voters:
        problems.append("nobody votes: the fleet has no robot, so no task gets an owner; `zsched invite` brings one")
    elif quorum.ok and len(voters) - len(silent) < needed:
        still = f"An owner that is gone, stops or fails is still replaced{never_heard}"
        replaced = still if len(silent) < len(voters) else "No owner is replaced"
        problems.append(
            f"no planned moves: {len(voters) - len(silent)} of {len(voters)} robots can vote, {needed} needed; "
            f"not {told}. {replaced}"
        )
    if not has_enough and node.startup.no_state is not NoState.ANOTHER_NODE:
        problems.append((Problem.NOTHING_AGREED, _nothing_agreed(node, quorum, fresh, now)))
    problems += _behind(node, now)
    if not node.has_state and node.startup.no_state in (None, NoState.MISSING):
        problems.append("no valid state file: this node is no elector (see `zsched init --help`)")
    return problems


def _overloads(node: Stages, now: float) -> Iterator[str]:
    """Each machine without free CPU where tasks visibly want more than they get."""
    for profile in _heard(node, now):
        short = [load.task for load in profile.workers if is_short(load)]
        if short and is_full(profile):
            used = f"{profile.cpu_used_cores:.3g} of {profile.cpu_cores:g} cores are in use"
            yield f"{profile.node} is overloaded: {used}, too little is left for {', '.join(short)}"


def _as_heard(node: Stages, names: Iterable[NodeId]) -> Iterator[str]:
    """Names of nodes that are away, and of those that have never been heard that they were not."""
    for name in names:
        yield f"{name} (not heard yet)" if node.membership.state(name) is PeerState.UNKNOWN else name


def _no_quorum(node: Stages, quorum: QuorumStatus, now: float, *, is_left_behind: bool) -> str:
    """How many electors lack, for whom this node waits, and after a while what to do if those never come."""
    told = f"no quorum: {quorum.alive} of {quorum.electors} electors can answer, {quorum.needed} needed"
    silent = [name for name in node.fleet.electors if node.membership.state(name) is not PeerState.ALIVE]
    if is_left_behind:
        return told
    if silent:
        told += f"; waiting for {', '.join(silent)}"
    if not node.agreement.document_hash:
        return told
    return told + _drastic(node, f". Only for nodes that will never come back: {RECOVER}", node.quorum_at, now)


def _drastic(node: Stages, advice: str, since: float, now: float) -> str:
    """Advice that gives up what a fleet remembers: none while its cause is young, or a disk only has to be freed."""
    has_stood = now >= since + DRASTIC_AFTER_S
    return advice if has_stood and not node.disks.refusal and not _refusing(node) else ""


def _behind(node: Stages, now: float) -> Iterator[str]:
    """What brings nodes of several generations together again."""
    for name, (generation, since, _) in sorted(node.agreement.behind.items()):
        ours = node.agreement.generation or 0
        command = f"`zsched fleet recover --generation {max(generation, ours)}`"
        where = f"on {name}, with its daemon stopped: {command}"
        if generation > ours:
            where = f"stop this daemon, {command} here, start it; so on every node that is behind {name}"
        if told := _drastic(node, where, since, now):
            yield told


def has_quorum(node: Stages) -> bool:
    """Whether a majority of the electors can answer, as far as this node hears."""
    return len(_answering(node)) >= majority(len(node.fleet.electors))


def _answering(node: Stages) -> list[NodeId]:
    return [name for name in node.fleet.electors if _can_answer(node, name)]


def _never_had_one(node: Stages, quorum: QuorumStatus) -> list[NodeId]:
    """The electors on which `init` was only forgotten, as far as is known: no file, no vote that anybody remembers."""
    if node.agreement.newest_generation:
        return []
    fileless = node.fileless.keys() | ({node.me} if node.startup.no_state is NoState.MISSING else set())
    return [name for name in quorum.stateless if name in fileless and name not in node.agreement.voted]


def _nothing_agreed(node: Stages, quorum: QuorumStatus, fresh: list[NodeId], now: float) -> str:
    """The way out of too many missing states: `init` where it was forgotten, else a new generation.

    The electors without a state say so themselves; the others must be there, too, before these are given up.
    """
    what = "nothing can be agreed: too many electors without their states"
    heard = [name for name in node.fleet.electors if node.membership.state(name) is PeerState.ALIVE]
    lost = RECOVER if node.agreement.document_hash else way_out(node.agreement.newest_generation + 1)
    is_forgotten = quorum.electors - len(quorum.stateless) + len(fresh) >= quorum.needed
    if is_forgotten and not node.agreement.document_hash:
        what, lost = f"{what}. No state file on {', '.join(fresh)}: {INIT_THERE}", f". Only where it refuses, {lost}"
    else:
        what, lost = f"{what} (each says why)", f"; if these are lost, {lost}"
    return what + (_drastic(node, lost, node.quorum_at, now) if len(heard) >= quorum.needed else "")


def _why_silent(node: Stages, name: NodeId, now: float) -> str:
    """Why an elector is not heard, and what to do about it; empty for one that is heard, or may still connect."""
    state = node.membership.state(name)
    if state is PeerState.GONE:
        return f"{name} is gone: start zsched on it, or look at its network"
    if state is PeerState.SUSPECT:
        return f"{name} is silent: it is gone soon, or is heard again"
    if state is PeerState.UNKNOWN and node.solitude.is_alone(now, has_heard=False):
        return f"{name} was never heard: start zsched on it, and check its host, port and firewall"
    return ""


def _why_refused(node: Stages, name: NodeId) -> str:
    if _has_lost_state(node, name):
        return f"{name} has no state"
    return f"{name} and this node refuse each other" if name in node.agreement.apart else f"{name} is not heard yet"


def _is_never_initialised(node: Stages, quorum: QuorumStatus) -> bool:
    """Whether too many electors lack a state, none is known to have one, and no node remembers that one ever had."""
    agreement, electors = node.agreement, node.fleet.electors
    if node.me in electors and node.startup.no_state is not NoState.MISSING:
        return False
    is_remembered = agreement.newest_generation or agreement.voted or agreement.problems or quorum.apart
    if is_remembered or any(register.value.revision for register in node.registers.values()):
        return False
    return quorum.alive == 0 and quorum.electors - len(quorum.stateless) < quorum.needed


def _disk_problems(node: Stages) -> Iterator[str]:
    """Disks on which others wait, and those that refuse: an own refusal is told by the state's line."""
    for name, save_s in node.disks.slow(node.me, node.fleet.timing.ballot_s / 2).items():
        if name != node.me and node.membership.state(name) is not PeerState.ALIVE:
            continue
        yield (
            f"the disk of {name} is slow: a save takes {save_s:.2g} s, and a vote waits for two of them; "
            f"put its state folder on another disk, or look what else writes there: iotop on {name}"
        )
    for name, why in _refusing(node).items():
        yield f"the disk of {name} refuses what must be saved: {why}; then start zsched there anew"


def _refusing(node: Stages) -> dict[NodeId, str]:
    """Of the nodes that are there: whose disks refuse a save, and why."""
    told = node.disks.refusals().items()
    return {name: why for name, why in told if node.membership.state(name) is PeerState.ALIVE}


def _relay_problems(node: Stages, now: float) -> Iterator[str]:
    """Relays that do not stay: their robots' streams pause each time, although the tasks look well from here."""
    for name in node.membership.states():
        told = _relay_told(node, name, now)
        if told and not (name == node.me and (Problem.RELAY, "") in node.problems):
            yield f"the relay of {name} {told}; its streams rest meanwhile: look at the log of zsched on {name}"


def _relay_told(node: Stages, name: NodeId, now: float) -> str:
    if name == node.me:
        return node.relay_ends.told(now)
    data = node.gateway.newest(name, now)
    return "" if data is None or node.membership.state(name) is not PeerState.ALIVE else data.profile.relay


def _has_lost_state(node: Stages, name: NodeId) -> bool:
    return not node.agreement.is_elector if name == node.me else name in node.stateless


def _can_answer(node: Stages, name: NodeId) -> bool:
    is_there = node.membership.state(name) is PeerState.ALIVE and name not in node.agreement.apart
    return is_there and not _has_lost_state(node, name)


def _quorum(node: Stages) -> QuorumStatus:
    electors, value = node.fleet.electors, node.agreement.fleet_value
    stateless = [name for name in electors if _has_lost_state(node, name)]
    alive = _answering(node)
    needed = majority(len(electors))
    lost = "other_electorate" if node.startup.no_state is NoState.ANOTHER_ELECTORATE else "lost_state"
    role = "elector" if node.agreement.is_elector else (lost if node.me in electors else "no_elector")
    return QuorumStatus(
        electors=len(electors),
        needed=needed,
        alive=len(alive),
        ok=len(alive) >= needed,
        this_node=role,
        stateless=tuple(sorted(stateless)),
        voted=tuple(sorted(node.agreement.voted)),
        apart=tuple(sorted(node.agreement.apart)),
        names=electors,
        number=node.agreement.number,
        generation=node.agreement.generation or 0,
        pilot=node.agreement.helm.reason,
        away=() if value is None else value.away,
        generation_id="" if value is None else value.generation_id,
        recovered_by="" if value is None else value.recovered_by,
    )


def _node_status(node: Stages, spec: NodeSpec, now: float) -> NodeStatus:
    state = node.membership.state(spec.name)
    incarnation = node.incarnation if spec.name == node.me else node.membership.incarnation(spec.name)
    flags = tuple(_flag_status(node, flag, now) for flag in node.flags.flags if flag.subject == spec.name)
    data = node.gateway.newest(spec.name, now)
    if data is None:
        return NodeStatus(
            name=spec.name, kind=spec.kind.value, state=state.value, age_s=None, incarnation=incarnation, flags=flags
        )
    profile = data.profile
    cpu, memory = profile.cpu_used_cores, profile.memory_used_mb
    return NodeStatus(
        name=spec.name,
        kind=spec.kind.value,
        state=state.value,
        age_s=data.age_s,
        incarnation=incarnation,
        cpu_cores=profile.cpu_cores,
        cpu_used_cores=cpu,
        cpu_ratio=None if cpu is None else min(cpu / profile.cpu_cores, 1.0),
        memory_mb=profile.memory_mb,
        memory_used_mb=memory,
        memory_ratio=None if memory is None else min(memory / profile.memory_mb, 1.0),
        links=profile.links,
        workers=profile.workers,
        draining=profile.draining,
        speed=profile.speed,
        cpu_pressure=profile.cpu_pressure,
        flags=flags,
        gauges=possible(profile.gauges),
    )


def _flag_status(node: Stages, flag: Flag, now: float) -> FlagStatus:
    since = node.flags.since(flag)
    return FlagStatus(
        kind=flag.kind.value,
        by=flag.by,
        reason=flag.reason,
        known_s=now - (node.started_at if since is None else since),
        for_s=flag.for_s,
    )


def _task_status(node: Stages, spec: TaskSpec, now: float) -> TaskStatus:
    value = node.registers[spec.name].value
    executor, standing = node.executors[spec.name], node.rounds.tasks[spec.name]
    problems, kinds = parted(*_task_problems(node, spec, value, now))
    owner_state = "none" if value.owner is None else node.membership.state(value.owner).value
    prefix = f"{spec.name}/"
    routes = {route.stream: route for route in executor.routes}
    return TaskStatus(
        name=spec.name,
        owner=value.owner,
        epoch=value.epoch,
        revision=value.revision,
        since_s=None if value.owner is None else now - standing.settled_at,
        owner_state=owner_state,
        phase=executor.phase.value,
        tuning=spec.in_force(value.tuning),
        candidates=spec.candidates,
        round_trips=_round_trips(node, spec) if value.tuning.deadline_ms is not None else (),
        decision=_decision(standing, now),
        vote=_vote(node.votes.tasks[spec.name], now),
        problems=problems,
        problem_kinds=kinds,
        pause=_hold(node, value, "pause", now),
        pin=_hold(node, value, "pin", now),
        rollout=_rollout(node, spec, now),
        file_tuning=spec.in_force(spec.tuning),
        switched_s=executor.switched_s,
        gap_s=_move_gap(node, executor),
        tells_no_jobs=not tells_jobs(spec.worker),
        streams=tuple(
            _with_flow(_with_keys(_with_ages(count, node, now), routes.get(count.stream)), node, now)
            for count in node.stream_counts
            if count.stream.startswith(prefix)
        ),
        history=tuple(
            PastAllocation(
                epoch=past.value.epoch,
                revision=past.value.revision,
                owner=past.value.owner,
                age_s=now - past.at,
                reason=past.reason,
                by="" if past.value.asked is None else past.value.asked.by,
                is_known=past.is_known,
            )
            for past in node.history[spec.name]
        ),
    )


def _hold(node: Stages, value: Allocation, kind: str, now: float) -> HoldStatus | None:
    """The task's pause or pin; one of an older program has no author."""
    order: Pause | Pin | None = value.pause if kind == "pause" else value.pin
    is_held = value.paused if kind == "pause" else value.pinned
    if not is_held:
        return None
    since = node.expiry.since(value.task, kind)
    return HoldStatus(
        by="" if order is None else order.asked.by,
        reason="" if order is None else order.asked.reason,
        known_s=now - (node.started_at if since is None else since),
        for_s=None if order is None else order.for_s,
        node=value.home if kind == "pin" else None,
        is_hard=value.is_bound and kind == "pin",
    )


def _rollout(node: Stages, spec: TaskSpec, now: float) -> RolloutStatus | None:
    rollout = spec.rollout
    if rollout is None:
        return None
    since = node.rollouts.since(spec.name)
    return RolloutStatus(
        by=rollout.by,
        reason=rollout.reason,
        known_s=now - (node.started_at if since is None else since),
        first=rollout.first,
        waiting=waiting(node.fleet, spec),
    )


def _round_trips(node: Stages, spec: TaskSpec) -> tuple[tuple[NodeId, float], ...]:
    return tuple(
        (name, round_trip_s) for name, round_trip_s in node.round_trips.seconds().items() if name in spec.candidates
    )


def _task_problems(node: Stages, task: TaskSpec, value: Allocation, now: float) -> Iterator[Told]:
    executor, owner = node.executors[task.name], value.owner
    if differs := node.sealing.problem(task, value, now):
        yield differs
    if value.paused:
        yield (
            f"paused by {by(value.pause)}: nothing moves it by itself, and a dead owner is not replaced; "
            f"`zsched resume {task.name}`"
        )
    if value.pin is not None and value.pin.node not in task.candidates:
        yield (
            f"pinned to {value.pin.node}, which is no candidate{' any more' if owner == value.pin.node else ''}: "
            f"`zsched unpin {task.name}`, or name it in `candidates`"
        )
    if task.rollout is not None:
        held, first = waiting(node.fleet, task), ", ".join(task.rollout.first)
        wait = "wait" if len(held) > 1 else "waits"
        yield (
            f"the changed worker runs on {first or 'no node'} first, {', '.join(held) or 'no node'} {wait} with that "
            f"of before: `zsched task promote {task.name}` goes on"
        )
    if executor.is_local:
        yield f"cut off from {owner}: this robot works alone, degraded"
    server, is_server_ready = node.me if executor.is_local else owner, True
    for profile in _heard(node, now):
        name, load = profile.node, profile.worker(task.name)
        if load is None:
            continue
        is_server_ready &= name != server or load.state is WorkerState.READY
        why = f": {load.reason}" if load.reason else ""
        if load.state is WorkerState.FAILED:
            told = f"the worker on {name} failed{why}; mend it, then `zsched restart {task.name} {name}`"
            yield Problem.WORKER_FAILED, told
        elif (name == server and load.state is not WorkerState.READY) or (
            _is_in_the_way(task, load) and (owner is None or _may_follow(node, task, profile, server))
        ):
            yield f"the worker on {name} {told_of_worker(load.state, load.trouble, load.reason)}"
        elif load.state is WorkerState.READY and load.reason:
            yield f"the worker on {name}{why}"
        late_ratio = None if load.jobs is None else load.jobs.late_ratio
        if load.state is WorkerState.READY and name == owner and late_ratio is not None and late_ratio >= LATE_RATIO:
            yield (
                f"the worker on {name} ends {late_ratio * 100:.0f} % of its jobs later than the deadline; "
                f"`zsched explain {task.name}` tells what each machine is worth"
            )
        if load.state is WorkerState.READY and name == owner and load.unended_s is not None and _hangs(load):
            more = f", and {load.jobs.backlog} wait" if load.jobs is not None and load.jobs.backlog else ""
            anew = f"see `zsched logs {task.name}`, `zsched restart {task.name}` starts it anew"
            yield (
                f"the worker on {name} has had work for {load.unended_s:.0f} s and finished no job{more}: it "
                f"may hang in a callback; {anew if task.worker.command else 'start it again there'}"
            )
    state = PeerState.UNKNOWN if owner is None else node.membership.state(owner)
    is_served = owner == server and is_server_ready and state is PeerState.ALIVE
    if owner is not None and (is_served or state in (PeerState.SUSPECT, PeerState.GONE)):
        yield from ((Problem.NO_SPARE, text) for text in _no_spare(node, task, value, owner, now))
    for name in sorted(node.unseen.found.get(task.name, ())):
        if name != owner:  # of the owner the wait is told, below
            is_seen = node.probation.sees(name, task.name)
            what = "its token comes and goes here" if is_seen else "our relay does not see its token"
            yield (
                f"the worker on {name} is ready, and {what}: {name} gets nothing for this robot; "
                f"`zsched ping {name}` tells whether its data session answers here"
            )
    if (waited_s := node.unanswered_s(task.name, now)) is not None:
        yield (
            f"{owner} has had inputs of this robot and answered none of them for {waited_s:.0f} s: its worker hangs, "
            f"or what is large does not reach it (`zsched ping {owner}` tries that); `zsched logs {task.name}`, "
            f"`zsched restart {task.name}`{_outvoted(node, task)}"
        )
    since = _unready_since(node, executor)
    if is_server_ready and now - since >= UNREADY_SHOWN_S:
        waited = f"this robot's streams have waited for {executor.served_by} for {now - since:.0f} s"
        told = _outvoted(node, task) if owner in node.unseen.found.get(task.name, ()) else ""
        yield f"{waited}: {_untaken(task, executor, node.unready.get(task.name))}{told}"


def _outvoted(node: Stages, task: TaskSpec) -> str:
    """What helps a robot whose streams do not reach the owner, where a majority of the others' may keep it there."""
    is_alone = node.rounds.tasks[task.name].spec.reach is Reach.ALL or len(node.fleet.voters) < 2
    return (
        ""
        if is_alone
        else f"; if the others' streams reach it, `zsched tune {task.name} reach=all` lets this one count"
    )


def _hangs(load: WorkerLoad) -> bool:
    """Whether there is work, and no job has ended for many times as long as one took before."""
    bound_s = HUNG_FIRST_S if load.jobs is None else max(HUNG_LEAST_S, HUNG_TIMES * load.jobs.time_s)
    return load.unended_s is not None and load.unended_s >= bound_s


def _is_in_the_way(task: TaskSpec, load: WorkerLoad) -> bool:
    """Whether this worker keeps its node from the task until somebody looks: it is missed, has failed before, or hangs.

    Missed is one that somebody else has to start.
    """
    is_missed = not task.worker.command and load.state is WorkerState.STOPPED and bool(load.reason)
    return is_missed or load.trouble in (Trouble.LOST, Trouble.AGAIN)


def _heard(node: Stages, now: float) -> Iterator[Profile]:
    """The newest profiles of the nodes that are alive, in the fleet file's order."""
    for spec in node.fleet.nodes:
        data = node.gateway.newest(spec.name, now)
        if data is not None and node.membership.state(spec.name) is PeerState.ALIVE:
            yield data.profile


def _may_follow(node: Stages, task: TaskSpec, profile: Profile, server: NodeId | None) -> bool:
    """Whether that is another candidate, and nobody keeps tasks from it on purpose."""
    name = profile.node
    return name != server and name in task.candidates and name not in node.flags.closed and not profile.draining


def _no_spare(node: Stages, task: TaskSpec, value: Allocation, owner: NodeId, now: float) -> Iterator[str]:
    """That nobody could take a task over now; nodes that are away, or closed by an operator, are no trouble.

    A machine lacks what it would lack if the owner were gone: the file's figure of memory counts, and no margin.
    """
    is_missed, untold = False, list[str]()
    states = {**node.membership.states(), owner: PeerState.GONE}
    vetoes = score(task.under(value.tuning), value, node.me, node.gateway, states, now).vetoes
    for profile in _heard(node, now):
        if not _may_follow(node, task, profile, owner):
            continue
        load = profile.worker(task.name)
        is_told = load is not None and (load.state is WorkerState.FAILED or _is_in_the_way(task, load))
        is_ready = not is_told and may_get(task, None if load is None else load.state)
        lack = vetoes.get(profile.node)
        if is_ready and (lack is None or lack.filter not in OF_MACHINE):
            return
        is_missed = True
        if is_ready:
            is_memory = lack is not None and lack.filter is Filter.MEMORY
            untold.append(f"{'' if is_memory else 'on '}{profile.node} {lack}")
        elif load is None:
            untold.append(f"{profile.node} runs no worker for it")
        elif not is_told:  # why the others cannot stands in lines of their own
            untold.append(f"the worker on {profile.node} {told_of_worker(load.state, load.trouble, load.reason)}")
    if is_missed:
        yield f"{NO_SPARE}: {'; '.join(untold)}" if untold else NO_SPARE


def _unready_since(node: Stages, executor: Executor) -> float:
    """Since when our relay has missed a worker for the newest slot; infinity when it has one."""
    if executor.phase is Phase.PREPARING:
        return executor.started_at
    known = node.unready.get(executor.spec.name)
    return known.since if known is not None and known.slot.epoch == executor.epoch else math.inf


def _untaken(task: TaskSpec, executor: Executor, known: Unready | None) -> str:
    """What our relay misses, as far as it has reported."""
    newer = "" if task.worker.command else f"; {STARTED_BEFORE.format(owner=executor.served_by, task=task.name)}"
    told = known.slot if known is not None and known.slot.epoch == executor.epoch else None
    untaken = () if told is None else told.untaken
    # The control sessions meet, and its daemon calls it ready: what is between us is the way of the data.
    look = f": `zsched ping {executor.served_by}` tells whether its data session answers here"
    if task.worker.ready_when is ReadyWhen.TOKEN:
        if told is None or told.has_token is None:
            return f"our relay does not see its worker's token, or its subscriptions{look}{newer}"
        if not told.has_token:
            return f"our relay does not see its worker's token{look}{newer}"
        if not untaken:
            return f"our relay has just seen its worker's subscriptions{newer}"
        return (
            f"its worker is there, and nobody subscribes to {', '.join(untaken)}: it has to take each such key with "
            f"`Worker.subscribe` before `ready` (`zsched stream list` shows the keys){newer}"
        )
    keys = untaken or [route.to_expr for route in executor.routes if route.direction is not Direction.OUTPUT][:1]
    return f"our relay sees nobody take {', '.join(keys) or 'them'}{newer}"


def _with_ages(count: StreamCount, node: Stages, now: float) -> StreamCount:
    """What the relay told a while ago is older by now; what it has not told for long is not known any more."""
    told_s = node.counts_age_s(now)
    rose_at = node.missed.get(count.stream, (0, None))[1] if count.missed else None
    return replace(
        count,
        dropped_s=None if rose_at is None else now - rose_at,
        last_seen_s=None if count.last_seen_s is None else count.last_seen_s + told_s,
        answer_s=count.answer_s if told_s <= STALE_S else None,
        paired_hz=count.paired_hz if told_s <= STALE_S else None,
    )


def _with_keys(count: StreamCount, route: Route | None) -> StreamCount:
    return count if route is None else replace(count, from_expr=route.from_expr, to_expr=route.to_expr)


def _with_flow(count: StreamCount, node: Stages, now: float) -> StreamCount:
    """How fast it flows, and its longest gap."""
    rate, gap_s = node.rates.of(count.stream, now), node.gaps.of(count.stream, now)
    count = replace(count, gap_s=gap_s) if gap_s != count.gap_s else count
    return count if rate is None else replace(count, hz=rate[0], bytes_per_s=rate[1])


def _move_gap(node: Stages, executor: Executor) -> float | None:
    """How long this robot's applications had no answer at the newest move."""
    prefix = f"{executor.spec.name}/"
    counts = [count for count in node.stream_counts if count.stream.startswith(prefix)]
    gaps = [count.move_gap_s for count in counts if count.move_gap_s is not None and count.move_epoch == executor.epoch]
    return max(gaps, default=None)


def _decision(standing: TaskRound, now: float) -> DecisionStatus | None:
    judgement, joint = standing.judgement, standing.standing
    if judgement is None or joint is None:
        return None
    return DecisionStatus(
        outcome=judgement.outcome.value,
        winner=judgement.candidate,
        reason=judgement.reason,
        age_s=now - standing.judged_at,
        aggregates=tuple(sorted(judgement.aggregates.items())),
        utilities=tuple((vector.voter, vector.utilities) for vector in joint.vectors),
        vetoed=tuple((name, veto.why) for name, veto in sorted(joint.vetoed.items())),
        unkept=tuple(sorted(judgement.unkept.items())),
        owed=tuple(sorted(judgement.owed.items())),
        silent=standing.silent,
    )


def _vote(voting: Voting, now: float) -> VoteStatus | None:
    counted = voting.tally
    if counted is None:
        return None
    return VoteStatus(
        base_revision=voting.tally_base,
        votes=counted.votes,
        outcome=counted.outcome.value,
        winner=counted.winner,
        age_s=now - voting.tally_at,
    )


def status_line(node: Stages) -> str:
    """One line for a service manager: role, peers, tasks with their owners and epochs."""
    states = node.membership.states()
    alive = sum(state is PeerState.ALIVE for state in states.values())
    values = [register.value for register in node.registers.values()]
    tasks = " · ".join(f"{value.task}@{value.owner or 'nobody'} epoch {shown(value.epoch)}" for value in values)
    quorum = "" if _quorum(node).ok else " · NO QUORUM"
    return f"{node.kind} {node.me} · {alive}/{len(states)} nodes · {tasks}{quorum}"
