"""PROFILE, GATEWAY, SCHEDULER and VOTE at the door: figures, utilities, proposals, ballots and learnt values.

Knows: which stage takes each of them, and when a decision may be needed. Does not know: how a stage judges.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from zsched.core.executor.workers import failed_workers, given_away
from zsched.core.node.beats import on_twins
from zsched.core.node.stages import Handler, Stages
from zsched.core.profile.profile import BLIND_S
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.model import Proposal
from zsched.core.values.profile import WorkerState, with_troubles
from zsched.core.values.struct import replace
from zsched.core.values.todo import ToDo

BLIND = f"nothing of this machine has been measured for {BLIND_S:g} s: a driver or a disk hangs; see the journal"
"""The sampler tells of a reader that raises, and can tell of none that hangs."""

# --- PROFILE, GATEWAY ------------------------------------------------------------------------------------------------


def publish_profile(node: Stages, todo: ToDo, now: float) -> None:
    """Send this machine's profile when it is due or has news; it enters our own gateway like a peer's."""
    profile = node.profiler.publishable(
        node.worker_states,
        is_draining=node.is_draining,
        now=now,
        progress=node.hangs.reports(now),
        reasons=node.workers.told(now, node.resting(now)),
        echoes=node.round_trips.echoes(now),
        relay=node.relay_ends.told(now),
        renewals=node.renewing.told,
        beats_now=todo.must_beat or now >= node.beat_at,
    )
    if profile is None:
        return
    has_deadlines = node.has_deadlines
    if has_deadlines:
        node.round_trips.note_sent(profile, now)
    node.gateway.absorb(profile, now)
    # A profile that waits for the hearer's next deadline would seem to have been under way for so long.
    todo.add(do.PublishProfile(profile=profile, is_news=node.profiler.has_news or has_deadlines))
    node.set_problem("measuring", BLIND if node.profiler.is_blind(now) else None)
    _look_for_hangs(node, todo, now)


def _look_for_hangs(node: Stages, todo: ToDo, now: float) -> None:
    node.hangs.look(node.owned(), node.executors, node.gateway, todo, now)


def _on_sampled(node: Stages, event: ev.ProfileSampled, _todo: ToDo, now: float) -> None:
    node.profiler.absorb(event.device, event.links, now)


def _on_profile(node: Stages, event: ev.ProfileReceived, todo: ToDo, now: float) -> None:
    profile = with_troubles(event.profile)
    if profile.node == node.me:
        return
    if node.agreement.strangers.is_one(profile.node, now):
        node.counters["profile_stranger"] += 1
        return
    before = node.gateway.fresh(profile.node, now)
    reason = node.gateway.absorb(profile, now, node.membership.incarnation(profile.node))
    if reason is not None:
        node.counters[f"profile_{reason}"] += 1
        return
    if node.has_deadlines:
        node.round_trips.note_heard(profile, node.incarnation, now)
    if profile.progress:
        _look_for_hangs(node, todo, now)
    failed = failed_workers(profile)
    if before is not None and before.incarnation == profile.incarnation:
        for task in (failed_workers(before) - failed) & node.executors.keys():
            node.rounds.forgive(task, profile.node, now)  # somebody has mended it: nothing else starts it again
    values = node.values()
    owned = {name for name, value in values.items() if value.owner == profile.node}
    for task in owned:
        load = profile.worker(task)
        if load is not None and load.state is not WorkerState.READY:
            node.hangs.excuse(task)
    is_to_leave = bool(owned) and (profile.draining or bool(owned & failed) or bool(owned & given_away(profile)))
    # With an orphan about, this may be the candidate that the task waits for.
    todo.must_decide |= is_to_leave or any(node.is_orphan(value.owner) for value in values.values())


# --- SCHEDULER, VOTE -------------------------------------------------------------------------------------------------


def _on_utility_asked(node: Stages, event: ev.UtilityAsked, todo: ToDo, now: float) -> None:
    utilities = node.rounds.vectors(node.values(), node.membership.states(), now)
    todo.add(do.AnswerUtilities(request=event.request, utilities=utilities))


def _on_utility(node: Stages, event: ev.UtilityReceived, _todo: ToDo, now: float) -> None:
    voter = event.utilities.voter
    if not node.membership.is_known(voter):
        node.counters["utility_foreign"] += 1
        return
    if node.agreement.strangers.is_one(voter, now):
        node.counters["utility_stranger"] += 1
        return
    if voter not in node.fleet.voters:
        return  # edges hear the question too and have nothing to say
    if not node.rounds.absorb_utilities(event.gather, event.utilities):
        node.counters["utility_late"] += 1


def _on_proposal(node: Stages, event: ev.ProposalReceived, todo: ToDo, now: float) -> None:
    proposal = event.proposal
    if proposal.voter == node.me or not _is_ours(node, proposal):
        node.counters["proposal_foreign"] += 1
        return
    if node.agreement.strangers.is_one(proposal.voter, now):
        node.counters["proposal_stranger"] += 1
        return
    value = node.registers[proposal.task].value
    if proposal.base_revision != value.revision:
        node.counters["proposal_stale" if proposal.base_revision < value.revision else "proposal_ahead"] += 1
    if node.rounds.is_voter:
        node.votes.absorb(proposal, value, node.membership.states(), todo, now)


def _is_ours(node: Stages, proposal: Proposal) -> bool:
    if proposal.task not in node.registers or proposal.voter not in node.fleet.voters:
        return False
    return proposal.candidate in node.fleet.task(proposal.task).candidates


# --- VOTE, the agreement under it ------------------------------------------------------------------------------------


def _on_prepare(node: Stages, event: ev.PrepareAsked, todo: ToDo, now: float) -> None:
    node.agreement.acceptor.on_prepare(event, todo, now)


def _on_accept(node: Stages, event: ev.AcceptAsked, todo: ToDo, now: float) -> None:
    node.agreement.acceptor.on_accept(event, todo, now)


def _on_answer(node: Stages, event: ev.ElectorAnswered, todo: ToDo, now: float) -> None:
    node.agreement.on_answer(event, todo, now)


def _on_ballots(node: Stages, event: ev.BallotsAsked, todo: ToDo, now: float) -> None:
    node.agreement.on_ballots(event, todo, now)


def _on_votes(node: Stages, event: ev.VotesReceived, todo: ToDo, now: float) -> None:
    if event.votes.ahead is not None:  # first: with the others the round that it belongs to may go on
        node.agreement.on_fleet_answer(ev.FleetAnswered(answer=event.votes.ahead), todo, now)
    for answer in event.votes.answers:
        node.agreement.on_answer(ev.ElectorAnswered(answer=answer), todo, now)


def _on_learnt(node: Stages, event: ev.LearntReceived, todo: ToDo, now: float) -> None:
    node.agreement.on_learnt(event, todo, now)
    if node.agreement.strangers.is_one(event.learnt.node, now):
        return
    if event.is_answer and node.membership.is_known(event.learnt.node):
        node.sealing.on_answer(event.learnt)
        on_twins(node, event, todo, now)


def _on_learnt_asked(node: Stages, event: ev.LearntAsked, todo: ToDo, now: float) -> None:
    learnt = replace(
        node.agreement.answer(),
        unleased=node.sealing.unleased(now),
        daemon=node.incarnation,
        twins=node.namesakes.lives(now),
    )
    todo.add(do.AnswerLearnt(request=event.request, learnt=learnt))


HANDLERS: Final[Mapping[type[Any], Handler]] = {
    ev.ProfileSampled: _on_sampled,
    ev.ProfileReceived: _on_profile,
    ev.UtilityAsked: _on_utility_asked,
    ev.UtilityReceived: _on_utility,
    ev.ProposalReceived: _on_proposal,
    ev.PrepareAsked: _on_prepare,
    ev.AcceptAsked: _on_accept,
    ev.ElectorAnswered: _on_answer,
    ev.BallotsAsked: _on_ballots,
    ev.VotesReceived: _on_votes,
    ev.LearntReceived: _on_learnt,
    ev.LearntAsked: _on_learnt_asked,
}
