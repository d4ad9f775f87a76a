"""EXECUTOR and ROUTE at the door: learnt values are carried out; reports of workers and the relay are taken in.

Knows: which stages a learnt value, a worker's state and a slot's progress concern. Does not know: the handover's table
(`zsched.core.executor.handover`), how a value is agreed.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from zsched.core.node.stages import UNREADY_SHOWN_S, Handler, PastValue, Stages, Unready
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.decision import Move
from zsched.core.values.fleet import OnIsolation
from zsched.core.values.model import Allocation, NodeId, PeerState, Proposal, Weights, as_reason, told_by
from zsched.core.values.plan import StreamCount
from zsched.core.values.problems import Problem
from zsched.core.values.profile import WorkerState
from zsched.core.values.quorum import majority
from zsched.core.values.todo import ToDo
from zsched.core.values.words import CREATION_STEP, shown

Why = str | None
"""Why a value came about; ``None``: another node committed it."""
FROM_A_PEER: Final = "learnt from a peer"
"""That one in words."""
FIRST_NEWS: Final = "known from a peer, the first news here"
"""Why a task has its owner, at a node that knew nothing of the task."""

# --- learnt values ---------------------------------------------------------------------------------------------------


def carry_out(node: Stages, value: Allocation, why: Why, todo: ToDo, now: float, *, is_known: bool = False) -> None:
    """Carry out a newly learnt value; this batch writes it to disk before anything else.

    ``is_known``: the value was there before this node's executor was, so it is no change of owner.
    """
    task, executor = value.task, node.executors[value.task]
    is_new_epoch, is_ours = value.epoch > executor.epoch, why is not None
    if not is_ours and _is_first_news(executor.epoch, value):
        is_known, why = True, FIRST_NEWS
    is_by_order = value.asked is not None and (is_ours or _has_only_moved(node, value))
    move = _move_of(node, value, why, is_known=is_known) if is_new_epoch and value.owner is not None else None
    reason = _reason_of(node, value, why, is_new_epoch=is_new_epoch) if move is None else move.reason
    node.history[task].append(PastValue(value=value, at=now, reason=reason, is_known=is_known))
    if is_new_epoch:
        left = executor.owner
        failed, drained = _has_failed(node, value, left, now, is_ours=is_ours), node.was_draining(left, now)
        node.rounds.on_moved(
            task,
            left,
            has_failed=failed,
            was_draining=drained,
            is_escape=any(one.is_escape for one in _votes(node, value)),
            is_ordered=is_by_order or left in node.flags.drained,
            now=now,
        )
    node.expiry.note(value, now)
    node.votes.on_learnt(task)
    node.rounds.on_learnt(task, is_new_epoch=is_new_epoch, now=now, tuning=value.tuning)
    text = f"learnt revision {shown(value.revision)}: owner {value.owner}, weights {_told(value.tuning.weights)}"
    text += "" if value.asked is None and not is_known else f", {reason}"
    by = "" if value.asked is None or is_known else value.asked.by
    todo.add(do.RecordStory(stage="vote", text=text, task=task, epoch=value.epoch, move=move, by=by))
    executor.execute(value, todo, now)
    node.tenure.hold(value, node.beat_sequence + 1)
    node.sealing.note(value)
    for old in executor.predecessors:
        if node.membership.state(old) is PeerState.GONE:
            executor.on_gone(old, todo)
    todo.must_beat = True


def take_known(node: Stages, value: Allocation, reason: str, todo: ToDo, now: float) -> None:
    """Carry out a value that this node's disk tells of, or keep it until it may be."""
    if is_confirmed(node, value):
        carry_out(node, value, reason, todo, now, is_known=True)
    else:
        node.unconfirmed[value.task] = reason


def take_up(node: Stages, todo: ToDo, now: float) -> None:
    """Carry out what had to wait and is confirmed by now."""
    waiting, node.unconfirmed = node.unconfirmed, {}
    for task, reason in waiting.items():
        take_known(node, node.registers[task].value, reason, todo, now)


def is_confirmed(node: Stages, value: Allocation) -> bool:
    """Whether a stored value may be carried out; what is learnt in this life may be at once.

    What is stored may be older than the last move. So nobody is an owner by it before a majority of the electors is
    heard, of which none knows a newer value. A robot that may work alone does so once it has listened in vain.
    """
    if value.owner != node.me:
        return True
    heard = [name for name in node.fleet.electors if name == node.me or _remembers(node, name)]
    if any(node.membership.learnt(name, value.task) > value.revision for name in heard):
        return False
    may_be_alone = node.fleet.task(value.task).on_isolation is OnIsolation.LOCAL and node.membership.has_watched
    return may_be_alone or len(heard) >= majority(len(node.fleet.electors))


def _remembers(node: Stages, name: NodeId) -> bool:
    """Whether an elector is heard that knows what it has learnt, though its disk may take nothing more."""
    is_there = node.membership.state(name) is PeerState.ALIVE and name not in node.agreement.apart
    return is_there and (name not in node.stateless or name in node.disks.refusals())


def _is_first_news(epoch: int, value: Allocation) -> bool:
    """Whether a peer tells of an owner to a node that knew nothing of the task, and that owner is not the first one.

    The first placement is a move for everybody: nobody had the task before.
    """
    return epoch == 0 and value.owner is not None and value.epoch % CREATION_STEP > 1


def _move_of(node: Stages, value: Allocation, why: Why, *, is_known: bool) -> Move:
    """A change of owner, with the votes for it as far as this node has heard them.

    A robot that did not commit it itself tells the reason of one that wanted it.
    """
    votes = _votes(node, value)
    wanted = [proposal.reason for proposal in votes if proposal.candidate == value.owner and proposal.reason]
    return Move(
        epoch=value.epoch,
        revision=value.revision,
        left=node.executors[value.task].owner,
        owner=value.owner,
        reason=wanted[0] if wanted and why is None else _reason_of(node, value, why, is_new_epoch=True),
        votes=tuple((proposal.voter, proposal.candidate) for proposal in votes),
        is_known=is_known,
    )


def _votes(node: Stages, value: Allocation) -> list[Proposal]:
    """What this node has heard and proposed in the vote that led to a value, sorted by voter."""
    heard = [proposal for _, (proposal, _) in sorted(node.votes.tasks[value.task].proposals.items())]
    return [proposal for proposal in heard if proposal.base_revision == value.revision - 1]


def _has_only_moved(node: Stages, value: Allocation) -> bool:
    """Whether each revision since the last one that is known here was a move, so that the newest one is."""
    known, start = node.history[value.task], value.epoch // CREATION_STEP * CREATION_STEP
    revision, epoch = (known[-1].value.revision, known[-1].value.epoch) if known else (start, start)
    return value.revision - revision == value.epoch - epoch > 0


def _reason_of(node: Stages, value: Allocation, why: Why, *, is_new_epoch: bool) -> str:
    """Why the value is what it is; a node that did not commit an operator's order tells it from the value.

    Who has missed a revision does not know whether the order is the one that has moved the task.
    """
    if value.asked is None or why is not None:
        return FROM_A_PEER if why is None else why
    who = told_by(value.asked)
    if is_new_epoch:
        return f"moved by {who}" if _has_only_moved(node, value) else FROM_A_PEER
    if value.pause is not None and value.pause.revision == value.revision:
        return f"paused by {who}"
    if value.pin is not None and value.pin.revision == value.revision:
        return f"pinned to {value.pin.node} by {who}"
    return f"changed by {who}"


def _has_failed(node: Stages, value: Allocation, left: NodeId | None, now: float, *, is_ours: bool) -> bool:
    """Whether the task fled from the owner that it left: that one is not there, or its worker has failed.

    A node that is cut off misses everybody, so what it sees counts with a vote that it has taken part in. Of a move
    behind its back it knows nothing; those who made it remember. Who is silent for a moment
    while the task leaves it for a better one has not failed: a full machine's beats come late. ``is_ours``: this node
    has committed the value.
    """
    if left is None or left == node.me:
        return False
    votes, lacks_lease = _votes(node, value), node.rounds.tasks[value.task].lacks_lease(left)
    is_escape, has_met = any(one.is_escape for one in votes), any(one.voter != node.me for one in votes)
    if not is_ours and not ((is_escape or lacks_lease) and has_met):
        return False
    state = node.membership.state(left)
    if state is PeerState.GONE or (state is PeerState.SUSPECT and is_escape):
        return True
    if is_escape and node.hangs.progress.overdue_s(value.task, node.executors[value.task].epoch, now) is not None:
        return True
    profile = node.gateway.fresh(left, now)
    # without a lease, it would come back with each of its links' good moments
    return lacks_lease or (profile is not None and profile.has_failed(value.task))


def _told(weights: Weights) -> str:
    return " ".join(f"{name}={weight:g}" for name, weight in weights.shares)


# --- workers ---------------------------------------------------------------------------------------------------------


def _on_worker(node: Stages, event: ev.WorkerChanged, todo: ToDo, now: float) -> None:
    was_ready = node.worker_states.get(event.task) is WorkerState.READY
    if event.state is not WorkerState.READY:
        node.profiler.note_end(event.task)
    story = node.workers.on_changed(event)
    if story is None:
        if was_ready and event.state is WorkerState.READY:
            node.executors[event.task].on_worker_seen(now)
        return
    if event.state is WorkerState.READY:
        node.executors[event.task].on_worker_ready(now)
    elif event.state is not WorkerState.STARTING:
        node.executors[event.task].on_worker_ended(todo, now, was_ready=was_ready)
    if was_ready:
        node.agreement.leases.on_worker_lost(event.task)
    node.hangs.note_worker(event.task, event.state, now)
    if event.task in node.owned():
        node.hangs.excuse(event.task)
    todo.add(story)
    todo.must_decide |= event.task in node.owned()


def _on_worker_troubled(node: Stages, event: ev.WorkerTroubled, todo: ToDo, now: float) -> None:
    story = node.workers.on_troubled(event, now)
    if story is not None:
        todo.add(story)


def _on_worker_outdated(node: Stages, event: ev.WorkerOutdated, _todo: ToDo, _now: float) -> None:
    node.workers.on_outdated(event)


def _on_worker_shown(node: Stages, event: ev.WorkerShown, todo: ToDo, now: float) -> None:
    node.probation.on_token(event.node, event.task, event.incarnation, is_present=event.is_present, now=now)
    if event.task not in node.executors or not node.membership.is_known(event.node):
        return
    if event.is_present and node.is_orphan(node.registers[event.task].value.owner):
        todo.must_decide = True  # this may be the candidate that the task waits for


def _on_jobs(node: Stages, event: ev.WorkerJobs, _todo: ToDo, now: float) -> None:
    if event.task not in node.worker_states or not node.profiler.note_jobs(event, now):
        node.counters["jobs_refused"] += 1


# --- the relay -------------------------------------------------------------------------------------------------------


def _on_slot_ready(node: Stages, event: ev.SlotReady, todo: ToDo, now: float) -> None:
    if event.task not in node.executors:
        return
    if not event.is_ready:
        known = node.unready.get(event.task)
        since = known.since if known is not None and known.slot.epoch == event.epoch else now
        node.unready[event.task] = Unready(slot=event, since=since)
        return
    known = node.unready.pop(event.task, None)
    if known is not None and known.slot.epoch == event.epoch:
        node.hangs.on_ready_again(event.task)
        if now - known.since >= UNREADY_SHOWN_S:
            node.hangs.excuse(event.task)
    node.executors[event.task].on_ready(event.epoch, todo)


def _on_slot_flipped(node: Stages, event: ev.SlotFlipped, todo: ToDo, now: float) -> None:
    if event.task in node.executors:
        node.executors[event.task].on_flipped(event.epoch, event.replayed, todo, now, event.draining)


def _on_slot_drained(node: Stages, event: ev.SlotDrained, todo: ToDo, _now: float) -> None:
    if event.task in node.executors:
        node.executors[event.task].on_drained(event.epoch, todo)


def _on_role_ended(node: Stages, event: ev.RoleEnded, todo: ToDo, _now: float) -> None:
    if event.task in node.executors:
        node.executors[event.task].on_role_ended(event.epoch, todo)
    todo.must_beat |= node.agreement.leases.on_stopped(event.task, event.epoch, node.beat_sequence)


def _on_counted(node: Stages, event: ev.StreamsCounted, todo: ToDo, now: float) -> None:
    rose_at = None if node.counted_at is None else now  # the relay's books are older than this daemon
    node.stream_counts, node.counted_at = event.counts, now
    for count in event.counts:
        if count.missed and node.missed.get(count.stream, (0, None))[0] != count.missed:
            node.missed[count.stream] = (count.missed, rose_at)
    node.rates.absorb(event.counts, now)
    for count in node.gaps.absorb(event.counts, now):
        _tell_gap(node, count, todo)
    node.hangs.absorb(event.counts, node.executors, now)


def _tell_gap(node: Stages, count: StreamCount, todo: ToDo) -> None:
    """A new owner's first answer has passed: how long this robot's applications had none."""
    task = count.stream.partition("/")[0]
    if task not in node.executors or count.move_gap_s is None:
        return
    text = f"{count.stream}: {count.move_gap_s * 1000:.0f} ms between the last answer of one owner and the next one's"
    epoch, gap_s = count.move_epoch, count.move_gap_s
    todo.add(do.RecordStory(stage="route", text=text, task=task, epoch=epoch, gap_s=gap_s))


def _on_relay(node: Stages, event: ev.RelayChanged, _todo: ToDo, now: float) -> None:
    node.relay_ends.on_changed(event, now)
    if not event.is_running:
        node.probation.forget_tokens()
        node.unseen.forget()
        for name, executor in node.executors.items():
            if executor.routes:
                untold = ev.SlotReady(task=name, epoch=executor.epoch, is_ready=False)
                node.unready[name] = Unready(slot=untold, since=now)
        node.clear_problems(Problem.RELAY)
        node.counters["relay_exits"] += 1
    node.set_problem(Problem.RELAY, None if event.is_running else f"the relay is down: {event.reason}")


def _on_saved(node: Stages, event: ev.StateSaved, _todo: ToDo, _now: float) -> None:
    node.disks.on_saved(event.took_s)
    node.tend_disks()


def _on_persist_failed(node: Stages, event: ev.PersistFailed, todo: ToDo, _now: float) -> None:
    """The disk refused. What happens on this machine goes on: these of the cut-off instructions are given again."""
    node.disks.refusal = as_reason(event.reason)
    node.agreement.on_persist_failed(event.reason)
    todo.add(*node.behind_write)


HANDLERS: Final[Mapping[type[Any], Handler]] = {
    ev.WorkerChanged: _on_worker,
    ev.WorkerTroubled: _on_worker_troubled,
    ev.WorkerOutdated: _on_worker_outdated,
    ev.WorkerShown: _on_worker_shown,
    ev.WorkerJobs: _on_jobs,
    ev.SlotReady: _on_slot_ready,
    ev.SlotFlipped: _on_slot_flipped,
    ev.SlotDrained: _on_slot_drained,
    ev.RoleEnded: _on_role_ended,
    ev.StreamsCounted: _on_counted,
    ev.RelayChanged: _on_relay,
    ev.StateSaved: _on_saved,
    ev.PersistFailed: _on_persist_failed,
}
