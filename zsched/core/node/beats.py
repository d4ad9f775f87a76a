"""Membership at the door: beats that are sent and heard, tokens, and peers that come, go or use our name.

Knows: which stage each part of a beat comes from and goes to. Does not know: the rules of each (membership, witness,
leases, sealing), the scheduler's and the executor's own events.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Final

from zsched.core.membership.identity import Verdict
from zsched.core.membership.peers import LOSS_FACTOR, Transition
from zsched.core.node.stages import Handler, Stages
from zsched.core.node.status import has_quorum
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.beat import Beat
from zsched.core.values.model import NodeId, PeerState
from zsched.core.values.problems import Problem
from zsched.core.values.startup import NoState
from zsched.core.values.todo import ToDo

# --- sent ------------------------------------------------------------------------------------------------------------


def send_beat(node: Stages, todo: ToDo, now: float) -> None:
    """Send the beat that is due or urgent."""
    is_news, todo.must_beat = todo.must_beat, False
    node.beat_sequence += 1
    if has_quorum(node):
        node.quorum_at = now
    if (Problem.MEMBERSHIP, "") in node.problems:
        _complain(node, now)
    node.membership.fade_lag_factor()
    node.agreement.forget(now)
    parts = node.agreement.leases.on_sent(node.beat_sequence, now)
    gone, away = node.agreement.helm.opinion(node.agreement.disk, now)
    beat = Beat(
        node=node.me,
        incarnation=node.incarnation,
        sequence=node.beat_sequence,
        loop_lag_s=min(node.loop_lag_s, 86400.0),
        learnt=tuple((name, value.revision, value.epoch) for name, value in node.values().items()),
        suspects=node.membership.suspects(),
        echoes=parts.echoes,
        released=parts.released,
        asked_to_leave=parts.asked_to_leave,
        fleet_file=node.fleet_file,
        has_voted=node.agreement.has_voted,
        generation=node.agreement.generation or 0,
        lease_terms=node.agreement.leases.terms_told,
        votes=node.agreement.votes_kept,
        number=node.agreement.number,
        fleet_revision=node.agreement.fleet_revision,
        has_lost_state=node.me in node.agreement.electors and not node.agreement.is_elector,
        electorate=node.agreement.electorate if node.agreement.is_elector else "",
        twins=node.namesakes.names(now),
        lacks_state_file=node.me in node.agreement.electors and node.startup.no_state is NoState.MISSING,
        disk=node.agreement.disk,
        gone=gone,
        away=away,
        may_return=node.agreement.may_return,
        save_s=min(node.disks.save_s, 86400.0),
        disk_refusal=node.disks.refusal,
    )
    node.loop_lag_s = 0.0
    beat = node.pace.marked(beat, now, is_restless=is_news or is_restless(node, now))
    node.beat_at = node.pace.next_at(beat, are_all_calm=node.membership.are_calm)
    todo.add(do.PublishBeat(beat=_fitting(node, beat), is_news=is_news))
    node.agreement.helm.tick(todo, now)
    _seal(node, todo, now)
    _hear_leases(node, beat, todo, now, is_newest=True)
    if node.introductions.is_due(now, is_missing=node.membership.misses_anybody):
        todo.add(do.IntroducePeers())
    if mute := node.mute_links.due(now, node.membership.gone if node.membership.misses_anybody else ()):
        todo.add(do.EndLinks(nodes=mute))
    if node.solitude.must_try(now, has_heard=node.membership.has_heard):
        todo.add(do.TryAddresses(addresses=node.solitude.dialled))


def is_restless(node: Stages, now: float) -> bool:
    """Whether anything goes on here for which beats must come at full pace, besides what they say themselves."""
    if node.tenure.exclusive or not node.votes.is_idle or node.membership.is_uneasy(now):
        return True
    is_agreeing = node.agreement.acceptor.has_parked or node.agreement.next_deadline() < math.inf
    told_s = node.counts_age_s(now)
    is_moving = any(executor.next_deadline() < math.inf for executor in node.executors.values())
    return (
        is_agreeing
        or is_moving
        # a full radio delays beats, and slow ones are too late
        or not all(count.is_still(told_s) for count in node.stream_counts)
        or any(kind == Problem.FLEET and subject for kind, subject in node.problems)
    )


def tend_pace(node: Stages, now: float) -> None:
    """Bring the next beat forward where something goes on since the last one."""
    if node.pace.is_slow and is_restless(node, now):
        node.beat_at = node.pace.hasten(node.beat_at, now)


def _fitting(node: Stages, beat: Beat) -> Beat:
    """The beat as it is sent: never too large to be sent."""
    sent, left_out = node.beat_room.fit(beat)
    if left_out:
        node.counters["beat_parts_left_out"] += left_out
    if left_out or (Problem.BEAT, "") in node.problems:
        text = f"{left_out} parts have no room in a beat and come in turn: fewer exclusive tasks, or shorter names"
        node.set_problem(Problem.BEAT, text if left_out else None)
    return sent


def _seal(node: Stages, todo: ToDo, now: float) -> None:
    """As an owner, propose what our file says of exclusive tasks, for all nodes."""
    for task, change in node.sealing.due(node.values(), now):
        if not node.registers[task].is_busy:
            node.agreement.propose(task, change, todo, now)
    for peer in node.sealing.to_ask(node.values(), now):
        _ask(node, peer, todo)


# --- heard -----------------------------------------------------------------------------------------------------------


def _on_beat(node: Stages, event: ev.BeatReceived, todo: ToDo, now: float) -> None:
    beat = event.beat
    if beat.node == node.me:
        node.agreement.witness.on_twin()
        _heed(node, node.identity.on_own_name(beat, node.beat_sequence, now), todo, now)
        return
    if not node.membership.is_known(beat.node):
        node.counters["beat_foreign"] += 1
        node.knocking.on_beat(beat, now, generation=node.agreement.foreign_generation(beat))
        return
    if node.agreement.is_stranger(beat, todo, now):
        node.counters["beat_stranger"] += 1
        return
    if node.namesakes.on_beat(beat, now):
        todo.must_beat = True  # the two of them may not hear each other
        text = f"two daemons call themselves {beat.node}"
        todo.add(do.RecordStory(stage="membership", text=text))
    if node.namesakes.must_ask(beat.node, now):
        _ask(node, beat.node, todo)
    for change in node.membership.absorb_beat(beat, now):
        on_transition(node, change, todo, now)
    if (is_lossy := node.membership.way_changes(now)) is not None:
        _tell_of_way(node, todo, is_lossy=is_lossy)
    if node.membership.is_doubtful(beat.node):
        node.counters["beat_doubtful"] += 1
        return
    if not beat.calm:
        node.beat_at = node.pace.hasten(node.beat_at, now)
    if node.me in beat.twins:
        node.agreement.witness.on_twin()
        if node.identity.must_ask(beat.node, now):
            _ask(node, beat.node, todo)
    if node.disks.hear(beat):
        node.tend_disks()
    node.agreement.compare(beat, todo, now)
    if node.membership.is_newest(beat.node):
        node.agreement.hear_pilot(beat, now)
    if beat.has_lost_state:
        node.stateless[beat.node] = None
    elif node.stateless:
        node.stateless.pop(beat.node, None)
    if beat.lacks_state_file:
        node.fileless[beat.node] = None
    elif node.fileless:
        node.fileless.pop(beat.node, None)
    if node.membership.state(beat.node) is not PeerState.GONE:  # or the beat is a late one
        node.sealing.hear(beat)
        node.retuning.hear(beat.node, beat.fleet_revision, node.agreement.fleet_revision)
    if node.renewing.told:
        node.renewing.hear(beat.node, beat.fleet_file, now)
    if beat.fleet_file != node.fleet_file or node.problems:
        told = node.identity.file_complaint(beat, node.startup.fleet_path, is_agreed=bool(node.agreement.document_hash))
        node.set_problem(Problem.FLEET, told, beat.node)
    _hear_leases(node, beat, todo, now, is_newest=node.membership.is_newest(beat.node))


def _tell_of_way(node: Stages, todo: ToDo, *, is_lossy: bool) -> None:
    limit_s = node.fleet.timing.suspect_s * (LOSS_FACTOR if is_lossy else 1.0)
    text = "links lose packets and hold beats up" if is_lossy else "links hold no beats up any more"
    todo.add(do.RecordStory(stage="membership", text=f"{text}: a peer is suspect after {limit_s:g} s of silence"))
    node.counters["links_lossy"] += is_lossy


def _ask(node: Stages, peer: NodeId, todo: ToDo) -> None:
    todo.add(do.AskLearnt(peer=peer, deadline_s=node.fleet.timing.ballot_s))


def _hear_leases(node: Stages, beat: Beat, todo: ToDo, now: float, *, is_newest: bool) -> None:
    if not node.tenure.exclusive:
        return  # thirty beats a second come by here
    node.tenure.hear(beat, node.agreement.accepted(), todo, now, is_newest=is_newest)
    node.agreement.note_asked(beat, now)
    if beat.released:
        node.agreement.acceptor.retry_parked(todo, now)


def on_twins(node: Stages, event: ev.LearntReceived, todo: ToDo, now: float) -> None:
    """A peer's answer holds its address, and whether it hears our name twice."""
    learnt = event.learnt
    node.namesakes.on_answer(learnt.node, learnt.daemon, event.where)
    lives = {incarnation: sequence for name, incarnation, sequence in learnt.twins if name == node.me}
    if lives and learnt.node != node.me:
        _heed(node, node.identity.on_told(learnt.node, lives, node.beat_sequence, now), todo, now)


def _heed(node: Stages, verdict: Verdict, todo: ToDo, now: float) -> None:
    """Act on another daemon of our name: complain, and stand down or stop electing."""
    if verdict is Verdict.OURS:
        return
    complaint = _complain(node, now)
    if verdict is Verdict.LEAVE:
        todo.stand_down = do.StandDown(reason=complaint)
    elif verdict is Verdict.DISPUTE:
        node.agreement.dispute(complaint, todo)


def _complain(node: Stages, now: float) -> str:
    """Show or end the complaint that another daemon uses our name."""
    complaint = node.identity.complaint(now)
    node.set_problem(Problem.MEMBERSHIP, complaint)
    return complaint or ""


def _on_token_seen(node: Stages, event: ev.TokenSeen, _todo: ToDo, now: float) -> None:
    node.counters["tokens_seen"] += 1
    _note_token(node, event.node, event.incarnation, now, is_present=True)


def _on_token_lost(node: Stages, event: ev.TokenLost, todo: ToDo, now: float) -> None:
    _note_token(node, event.node, event.incarnation, now, is_present=False)
    for change in node.membership.absorb_token_lost(event.node, event.incarnation, now):
        on_transition(node, change, todo, now)


def _note_token(node: Stages, of: NodeId, incarnation: int, now: float, *, is_present: bool) -> None:
    if of == node.me:
        node.identity.on_token(incarnation, is_present=is_present)
        _complain(node, now)
    elif node.membership.is_known(of):
        node.namesakes.on_token(of, incarnation, is_present=is_present)


# --- what follows ----------------------------------------------------------------------------------------------------


def on_transition(node: Stages, change: Transition, todo: ToDo, now: float) -> None:
    """A peer has come, is suspected or has gone: tell every stage that depends on it."""
    text = f"{change.node} {change.before} -> {change.after}: {change.reason}"
    todo.add(do.RecordStory(stage="membership", text=text))
    todo.must_beat = True  # tell the others at once: they wait for a second observer
    if change.after is PeerState.ALIVE:
        node.probation.on_back(change.node, now)
        node.profiler.owe(now)
        for executor in node.executors.values():
            executor.on_back(change.node)
        if change.before in (PeerState.SUSPECT, PeerState.GONE):
            node.hangs.on_back(change.node, now)
            for task in [name for name, value in node.values().items() if value.owner == change.node]:
                node.hangs.excuse(task)
    if change.after is PeerState.GONE:
        node.probation.on_gone(change.node, now)
        node.sealing.on_gone(change.node)
        node.retuning.on_gone(change.node)
        node.set_problem(Problem.FLEET, None, change.node)  # its first beat says it again, if it is still so
        for executor in node.executors.values():
            executor.on_gone(change.node, todo)
    todo.must_decide |= any(value.owner == change.node for value in node.values().values())


def _on_addresses(node: Stages, event: ev.AddressesTried, _todo: ToDo, _now: float) -> None:
    node.solitude.on_tried(event.found)


def _on_clock(node: Stages, event: ev.ClockCompared, todo: ToDo, now: float) -> None:
    if node.tenure.on_clock(event, node.agreement.standing(), node.beat_sequence, now):
        todo.must_beat = True  # the others must hear whether our echoes count
    if node.tenure.exclusive or (Problem.CLOCK, "") in node.problems:
        node.set_problem(Problem.CLOCK, node.tenure.clock.complaint if node.tenure.exclusive else None)


HANDLERS: Final[Mapping[type[Any], Handler]] = {
    ev.BeatReceived: _on_beat,
    ev.TokenSeen: _on_token_seen,
    ev.TokenLost: _on_token_lost,
    ev.AddressesTried: _on_addresses,
    ev.ClockCompared: _on_clock,
}
