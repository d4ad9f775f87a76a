"""Carries a node's instructions out: one line per instruction, in order, and the failure of one is an event.

Only a failed `PersistState` cuts its batch off: nothing after it may happen unless the state is on disk. Any other
failure is shown in the status until the same instruction works again, at most `PROBLEM_TTL_S`. `AdoptFleet` is tried
until it works.

Knows: which adapter an instruction is for. Does not know: why it was given.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterator
from typing import assert_never

from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.document import Text
from zsched.core.values.errors import AdapterError, WireError
from zsched.core.values.fleet import Fleet
from zsched.core.values.messages import (
    CommandOutcome,
    CommandResult,
    FleetTold,
    HistoryTold,
    WorkerLines,
    fleet_question,
)
from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.rehearsal import KeepRehearsal, RehearsalsTold
from zsched.core.values.relay_protocol import (
    HandleReport,
    RelayStarted,
    SlotLost,
    WorkerMatched,
    WorkerSeen,
    WorkerTrouble,
)
from zsched.core.values.struct import replace
from zsched.core.values.words import shown
from zsched.host.clock import monotonic_s
from zsched.host.decision_log import DecisionLog
from zsched.host.rehearsals import RehearsalStore
from zsched.host.state_file import StateFile
from zsched.host.workers.supervisor import WorkerSupervisor
from zsched.link.bus.address_trial import AddressTrial
from zsched.link.bus.control_bus import ControlBus
from zsched.runtime.crew import Crew
from zsched.runtime.desk import LOCAL_REQUESTS_FROM, Desk
from zsched.runtime.inbox import Inbox
from zsched.runtime.library import Library
from zsched.runtime.relay.streams import RelayHandle
from zsched.runtime.strikes import Strikes

FOLLOW_AGAIN_S = 10.0
"""So often the adapters are told again to follow a fleet that they could not follow; what else would tell them?"""
PROBLEM_TTL_S = 60.0
"""An instruction that failed and was never tried again is no problem any more after this time."""

_stages = {
    name: logging.getLogger(f"zsched.{name}")
    for name in ("membership", "profile", "gateway", "scheduler", "vote", "executor", "route")
}


def _no_certificate(_pem: str) -> CommandResult:
    return CommandResult(outcome=CommandOutcome.INVALID, detail="this node's fleet has no certificates")


class Shell:
    """The adapters of one daemon, and what each instruction means for them."""

    def __init__(
        self,
        *,
        node: NodeId,
        inbox: Inbox,
        bus: ControlBus,
        state_file: StateFile,
        desk: Desk,
        fleet: Fleet | None = None,
    ) -> None:
        """``fleet`` says how workers show themselves; see `Crew`."""
        self._node, self._inbox = node, inbox
        self._bus, self._state_file, self._desk = bus, state_file, desk
        self.crew = Crew(inbox.post, fleet, node)
        self._trial = AddressTrial(inbox.post)
        self.relay: RelayHandle | None = None
        """It reports to this shell, so it is made after it."""
        self.library: Library | None = None
        """The fleet's documents."""
        self.strikes: Strikes | None = None
        self.rehearsals: RehearsalStore | None = None
        self.log: DecisionLog | None = None
        self.follow: Callable[[Fleet, bool], None] = lambda _fleet, _is_agreed: None
        """Lets the adapters follow another fleet (`zsched.runtime.adoption`), once they are all made."""
        self.end: Callable[[TaskId], None] = lambda task: self._streams().end(task)
        """Ends the streams of a task (`zsched.runtime.adoption`)."""
        self.measure_soon: Callable[[], None] = lambda: None
        """Told that work begins, ends or goes on here (`zsched.runtime.sampler`)."""
        self.take_certificate: Callable[[str], CommandResult] = _no_certificate
        """Keeps a newer certificate (`zsched.runtime.renewal`)."""
        self.stand_down = ""
        """Why this daemon must end, for its name is taken; empty: it need not."""
        self._failed_at: dict[str, float] = {}
        self._unfollowed: do.AdoptFleet | None = None
        """The fleet that the adapters could not follow; nothing but another change would bring this order again."""
        self._follow_at = 0.0

    # --- instructions ------------------------------------------------------------------------------------------------

    def carry_out(self, batch: tuple[do.Instruction, ...]) -> None:
        """Carry a batch out in order; a failed write drops the rest, any other failure is only reported.

        Call it at least once a second: a fleet that could not be followed is tried again, in front of the batch.
        """
        if self._unfollowed is not None and monotonic_s() >= self._follow_at:
            batch = (self._unfollowed, *batch)
        for instruction in batch:
            kind = type(instruction).__name__
            try:
                self._carry_out(instruction)
            except (AdapterError, WireError) as error:
                if isinstance(instruction, do.PersistState):
                    # Before anything else: what the node believes to be on disk must not lead to a beat or an answer.
                    self._inbox.put_first(ev.PersistFailed(reason=str(error)))
                    return
                self._failed_at[kind] = monotonic_s()
                self._inbox.post(ev.ProblemReported(source=kind, problem=str(error)))
            else:
                if self._failed_at:
                    self._forget(kind)

    def waiting_frames(self) -> Iterator[ev.Event]:
        """The beats and profiles that have come and woken nobody up."""
        return self._bus.waiting()

    def _forget(self, works: str) -> None:
        """End the problem of an instruction that works again, and those that are too old to mean anything."""
        now = monotonic_s()
        for kind, at in tuple(self._failed_at.items()):
            if kind == works or now - at > PROBLEM_TTL_S:
                del self._failed_at[kind]
                self._inbox.post(ev.ProblemReported(source=kind, problem=None))

    def _carry_out(self, instruction: do.Instruction) -> None:
        bus = self._bus
        match instruction:
            case do.PersistState(state=state):
                began = monotonic_s()
                self._state_file.save(state)
                # Before any deadline is judged: whoever waits for other disks must know how slow this one was.
                self._inbox.put_first(ev.StateSaved(took_s=monotonic_s() - began))
            case do.PublishBeat(beat=beat, is_news=is_news):
                bus.publish("beat" if is_news else "beat_in_turn", beat)
            case do.PublishProfile(profile=profile, is_news=is_news):
                bus.publish("profile" if is_news else "profile_in_turn", profile)
            case do.PublishProposal(proposal=proposal):
                bus.publish("proposal", proposal)
            case do.PublishLearnt(learnt=learnt):
                bus.publish("allocation", learnt)
            case do.AskUtilities(gather=gather, deadline_s=deadline_s):
                bus.ask_utilities(gather, deadline_s)
            case do.SendPrepare(prepare=prepare, deadline_s=deadline_s):
                bus.ask_electors(prepare, deadline_s)
            case do.SendAccept(accept=accept, deadline_s=deadline_s):
                bus.ask_electors(accept, deadline_s)
            case do.SendBallots(ballots=ballots, deadline_s=deadline_s):
                bus.ask_electors(ballots, deadline_s)
            case do.AskElectors(question=question, deadline_s=deadline_s):
                bus.ask_fleet(fleet_question(question), deadline_s)
            case do.AnswerFleet(request=request, answer=fleet_answer):
                bus.answer(request, fleet_answer)
            case do.StoreDocument() | do.AmendDocument() | do.FetchDocument() | do.KeepDocuments():
                self._documents().order(instruction)
            case do.AnswerFleetRead(request=request, told=told, with_document=with_document):
                self._answer_operator(request, self._with_document(told) if with_document else told)
            case do.AnswerDocument(request=request, document=document):
                self._answer_document(request, document)
            case do.AskLearnt(peer=peer, deadline_s=deadline_s):
                bus.ask_learnt(peer, deadline_s)
            case do.IntroducePeers():
                bus.introduce_peers()
            case do.EndLinks(nodes=nodes):
                bus.end_links(nodes)
            case do.TryAddresses(addresses=addresses):
                self._trial.begin(addresses)
            case do.AnswerUtilities(request=request, utilities=value):
                bus.answer(request, value)
            case do.AnswerElection(request=request, answer=vote):
                bus.answer(request, vote)
            case do.AnswerBallots(request=request, votes=votes):
                bus.answer(request, votes)
            case do.AnswerLearnt(request=request, learnt=learnt):
                bus.answer(request, learnt)
            case do.AnswerStatus(request=request, snapshot=snapshot):
                self._answer_operator(request, snapshot)
            case do.AnswerCommand(request=request, result=result):
                self._answer_operator(request, result)
            case do.AnswerExplanation(request=request, explanation=explanation):
                self._answer_operator(request, explanation)
            case do.AnswerLines(request=request, task=task, after=after):
                self._answer_operator(request, self._lines(task, after))
            case do.AnswerHistory(request=request, cursor=cursor):
                self._tell_history(request, cursor)
            case do.TakeCertificate(request=request, certificate=certificate):
                self._answer_operator(request, self.take_certificate(certificate))
            case do.ApplyRoutes(plan=plan):
                self._streams().apply(plan)
            case do.AdoptFleet(fleet=fleet, is_agreed=is_agreed):
                self._unfollowed, self._follow_at = instruction, monotonic_s() + FOLLOW_AGAIN_S
                self.follow(fleet, is_agreed)
                self._unfollowed = None
            case do.EndTask(task=task):
                self.end(task)
            case do.SetRole(role=role):
                self._streams().set_role(role)
                self.measure_soon()
            case do.StartWorker(task=task):
                self._workers().start(task)
                self.measure_soon()
            case do.StopWorker(task=task):
                self._workers().stop(task)
            case do.RenewWorker(task=task):
                self._workers().renew(task)
            case do.RestartWorker(task=task, reason=reason):
                self._workers().report_hung(task, self.crew.life_of(task), reason)
            case do.StrikeDaemon(request=request, strike=strike, fleet=fleet):
                assert self.strikes is not None
                self.strikes.order(request, strike, fleet)
            case do.StoreRehearsal(request=request, rehearsal=rehearsal):
                self._keep(request, rehearsal)
            case do.AnswerRehearsals(request=request, told=told, name=name):
                self._answer_operator(request, self._with_kept(told, name))
            case do.StandDown(reason=reason):
                self.stand_down = reason
            case do.RecordStory():
                self._tell(instruction)
            case _:
                assert_never(instruction)

    def _workers(self) -> WorkerSupervisor:
        assert self.crew.supervisor is not None
        return self.crew.supervisor

    def _lines(self, task: TaskId, after: int) -> WorkerLines:
        kept = self._workers().output(task)
        if kept is None:
            return WorkerLines(node=self._node, task=task, is_here=False)
        lines, newest = kept.behind(after)
        return WorkerLines(node=self._node, task=task, lines=lines, newest=newest)

    def _tell_history(self, request: int, cursor: str) -> None:
        """Let the log's thread answer: it reads files."""

        def answer(told: HistoryTold | None) -> None:
            refused = CommandResult(outcome=CommandOutcome.INVALID, detail="its decision log cannot be read")
            with contextlib.suppress(AdapterError):  # the session has closed: nobody hears it
                self._answer_operator(request, told or refused)

        if self.log is None or not self.log.ask(cursor, answer):
            busy = "others read its decision log just now: ask again in a moment"
            self._answer_operator(request, CommandResult(outcome=CommandOutcome.INVALID, detail=busy))

    def _keep(self, request: int, rehearsal: KeepRehearsal) -> None:
        assert self.rehearsals is not None
        outcome, detail = CommandOutcome.OK, "kept"
        try:
            self.rehearsals.save(rehearsal.name, rehearsal.body)
        except AdapterError as error:
            outcome, detail = CommandOutcome.INVALID, str(error)
        self._answer_operator(request, CommandResult(outcome=outcome, detail=detail))

    def _with_kept(self, told: RehearsalsTold, name: str) -> RehearsalsTold:
        assert self.rehearsals is not None
        body = self.rehearsals.load(name) if name else ""
        return replace(told, names=self.rehearsals.names(), body=Text(body))

    def answer_operator(self, request: int, result: CommandResult) -> None:
        """Answer an operator's command; from any thread."""
        self._answer_operator(request, result)

    def _documents(self) -> Library:
        assert self.library is not None
        return self.library

    def _with_document(self, told: FleetTold) -> FleetTold:
        value = told.value
        if value is None or not value.document:
            return told
        return replace(told, content=self._documents().store.load(value.document))

    def _answer_document(self, request: int, document: str) -> None:
        content = self._documents().store.load(document)
        if content is None:
            self._bus.answer_nothing(request)
        else:
            self._bus.answer(request, content)

    def _streams(self) -> RelayHandle:
        assert self.relay is not None
        return self.relay

    def _answer_operator(self, request: int, value: object) -> None:
        if request >= LOCAL_REQUESTS_FROM:
            self._desk.deliver(request, value)
        else:
            self._bus.answer(request, value)

    # --- what adapters report (their threads) ------------------------------------------------------------------------

    def on_report(self, report: HandleReport) -> None:
        """The relay's handle: most reports are events; what is seen of our own workers goes by the crew."""
        if isinstance(report, RelayStarted):
            self.crew.on_relay_started()
            return
        if isinstance(report, ev.RelayChanged) and not report.is_running:
            self.crew.on_relay_ended()
        if isinstance(report, SlotLost):
            text = f"{report.owner} left {report.samples} samples unacknowledged: at most so many had no result"
            self._tell(do.RecordStory(stage="route", text=text, task=report.task, epoch=report.epoch))
            return
        if isinstance(report, WorkerMatched):
            self.crew.on_matched(report)
            return
        if isinstance(report, WorkerTrouble):
            self.crew.on_trouble(report)
            return
        if isinstance(report, ev.WorkerJobs):
            if self.crew.is_ours(report):
                self._inbox.post_quietly(report)
                self.measure_soon()
            return
        if isinstance(report, ev.StreamsCounted) and all(count.is_still() for count in report.counts):
            # they can wait until the loop is awake
            self._inbox.post_quietly(report)
            return
        if not isinstance(report, WorkerSeen):
            self._inbox.post(report)
            return
        if report.node == self._node:
            self.crew.on_token(report)
            return
        shown = ev.WorkerShown(
            node=report.node, task=report.task, incarnation=report.incarnation, is_present=report.is_present
        )
        self._inbox.post(shown)

    def _tell(self, story: do.RecordStory) -> None:
        where = f"task={story.task} epoch={shown(story.epoch)} " if story.task else ""
        _stages[story.stage].info("%s%s", where, story.text)
        if self.log is not None:
            self.log.put(story)
