"""Carries a node's instructions out: one line per instruction, in order, and the failure of one is an event.

Only a failed `PersistState` cuts its batch off: nothing after it may happen unless the state is on disk. Any other
failure is shown in the status until the same instruction works again, at most `PROBLEM_TTL_S`.

Knows: which adapter an instruction is for. Does not know: why it was given.
"""

from __future__ import annotations

import itertools
import logging
import math
import queue
import threading
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, assert_never

from zsched.adapters.host.decision_log import DecisionLog
from zsched.adapters.host.rehearsals import RehearsalStore
from zsched.adapters.host.state_file import StateFile
from zsched.adapters.network.address_trial import AddressTrial
from zsched.adapters.network.control_bus import ControlBus
from zsched.adapters.relay.streams import RelayHandle
from zsched.adapters.workers.supervisor import WorkerSupervisor
from zsched.clock import monotonic_s
from zsched.core import events as ev
from zsched.core import instructions as do
from zsched.core.relay_protocol import (
    HandleReport,
    RelayStarted,
    SlotLost,
    WorkerMatched,
    WorkerSeen,
    WorkerTrouble,
)
from zsched.core.report import plain, snapshot_json
from zsched.core.values.decision import Decision, Explanation
from zsched.core.values.document import Document, Flag, Rollout, Text
from zsched.core.values.fleet import Fleet
from zsched.core.values.gauges import GAUGES
from zsched.core.values.messages import (
    ChangeFleet,
    Command,
    CommandOutcome,
    CommandResult,
    ExplainTask,
    FleetTold,
    Hold,
    HoldTask,
    MoveTask,
    ReadFleet,
    ReadLines,
    RestartTask,
    RetryTask,
    SetWeights,
    TakeCertificate,
    TuneTask,
    WorkerLines,
    fleet_question,
)
from zsched.core.values.model import MAX_REASON, Asked, NodeId, TaskId, Tuning
from zsched.core.values.rehearsal import KeepRehearsal, ReadRehearsals, RehearsalsTold, Step, Strike
from zsched.core.values.snapshot import Snapshot
from zsched.core.values.struct import replace
from zsched.core.values.words import MAX_ASKER, NAME
from zsched.errors import AdapterError, WireError
from zsched.runtime.crew import Crew
from zsched.runtime.library import Library
from zsched.runtime.strikes import Strikes
from zsched.wire import codec as wire

INBOX_LIMIT = 20_000
WAITING_LIMIT = 64
ANSWER_TIMEOUT_S = 3.0
PROBLEM_TTL_S = 60.0
"""An instruction that failed and was never tried again is no problem any more after this time."""
LOCAL_REQUESTS_FROM = 1 << 40
"""Numbers of questions that came over the operator socket; smaller ones came over the bus."""

_stages = {
    name: logging.getLogger(f"zsched.{name}")
    for name in ("membership", "profile", "gateway", "scheduler", "vote", "executor", "route")
}


class Inbox:
    """The one queue into the loop; bounded, and what does not fit is counted."""

    def __init__(self) -> None:
        self._queue: queue.SimpleQueue[ev.Event] = queue.SimpleQueue()
        self._first: ev.Event | None = None
        self._waiting: deque[ev.Event] = deque(maxlen=WAITING_LIMIT)
        self.overflowed = 0

    def post(self, event: ev.Event) -> None:
        """Enqueue; from any thread, never blocks."""
        if self._queue.qsize() >= INBOX_LIMIT and not isinstance(event, ev.StopRequested):
            self.overflowed += 1
            return
        self._queue.put(event)

    def post_quietly(self, event: ev.Event) -> None:
        """Enqueue without waking the loop: it is taken by `waiting` when the loop is awake anyway; the oldest go."""
        self._waiting.append(event)

    def waiting(self) -> Iterator[ev.Event]:
        """What has been posted quietly, in order."""
        while self._waiting:
            yield self._waiting.popleft()

    def put_first(self, event: ev.Event) -> None:
        """Let ``event`` be the next one taken; from the loop only."""
        self._first = event

    def take_first(self) -> ev.Event | None:
        """What must be taken before anything else, if there is something."""
        event, self._first = self._first, None
        return event

    def take(self, timeout_s: float) -> ev.Event | None:
        """The next event, waiting at most ``timeout_s`` (<= 0: not at all); ``None`` when there is none."""
        event = self.take_first()
        if event is not None:
            return event
        try:
            return self._queue.get(timeout=timeout_s) if timeout_s > 0 else self._queue.get_nowait()
        except queue.Empty:
            return None


class Desk:
    """Operators' questions from the local socket: posted into the loop, awaited in the socket's thread."""

    def __init__(
        self,
        node: NodeId,
        inbox: Inbox,
        bus: ControlBus,
        access: Callable[[NodeId], dict[str, Any]] | None = None,
        log: Callable[[dict[str, Any]], dict[str, Any]] | None = None,
        leave: Callable[[], None] | None = None,
    ) -> None:
        """``access`` says how a tool on this machine joins a node's data network, ``log`` tells of the decision log.

        ``leave`` ends this daemon for good.
        """
        self._node, self._inbox, self._bus = node, inbox, bus
        self._access, self._log, self._leave = access, log, leave
        self._numbers = itertools.count(LOCAL_REQUESTS_FROM)
        self._waiting: dict[int, queue.SimpleQueue[object]] = {}
        self._lock = threading.Lock()

    def answer(self, request: dict[str, Any]) -> dict[str, Any]:
        """Answer one request of the socket (``status``, ``explain``, ``log``, ``weights``, ...).

        With ``node``: what another node answers.
        """
        verb, node = request["verb"], request.get("node") or self._node
        if not isinstance(node, str) or not NAME.fullmatch(node):
            return {"error": f"node: {node!r:.80} is not a name"}
        if verb == "status":
            return self._ask(node, None)
        if verb in _COMMANDS:
            try:
                command = command_of(request)
            except KeyError as error:
                return {"error": f"{verb}: {error} is missing"}
            except (TypeError, ValueError, OverflowError) as error:
                return {"error": f"{verb}: {error}"}
            return self._ask(node, command)
        if verb == "access" and self._access is not None:
            return self._access(node)
        if verb == "log" and self._log is not None:
            return self._log(request) if node == self._node else {"error": f"the log of {node} is told on {node} only"}
        if verb == "leave" and self._leave is not None:
            if node != self._node:
                return {"error": f"{node} leaves by a command on its own machine: zsched leave"}
            self._leave()
            return {"outcome": "ok"}
        known = ", ".join(sorted(("access", "leave", "log", "status", *_COMMANDS)))
        return {"error": f"unknown verb {verb!r:.80}; known: {known}"}

    def _ask(self, node: NodeId, command: Command | None) -> dict[str, Any]:
        if node != self._node:
            try:
                return answer_json(self._bus.ask_node(node, command))
            except AdapterError as error:
                return {"error": str(error)}
        number = next(self._numbers)
        slot: queue.SimpleQueue[object] = queue.SimpleQueue()
        with self._lock:
            self._waiting[number] = slot
        self._inbox.post(
            ev.StatusAsked(request=number) if command is None else ev.commanded(number, command, is_near=True)
        )
        try:
            return answer_json(slot.get(timeout=ANSWER_TIMEOUT_S))
        except queue.Empty:
            return {"error": f"the decision loop of {self._node} did not answer within {ANSWER_TIMEOUT_S:g} s"}
        finally:
            with self._lock:
                self._waiting.pop(number, None)

    def deliver(self, number: int, value: object) -> None:
        """The loop's answer; nobody waiting any more is no error."""
        with self._lock:
            slot = self._waiting.get(number)
        if slot is not None:
            slot.put(value)


def _weights_of(request: dict[str, Any]) -> SetWeights:
    base = _whole(request, "base_revision")
    cpu, memory, network = (float(request[name]) for name in ("cpu", "memory", "network"))
    gauges = tuple((gauge.name, float(request[gauge.name])) for gauge in GAUGES if request.get(gauge.name))
    if not all(map(math.isfinite, (cpu, memory, network, *dict(gauges).values()))):
        raise ValueError("expected finite numbers")
    return SetWeights(
        task=str(request["task"]),
        cpu=cpu,
        memory=memory,
        network=network,
        base_revision=base,
        gauges=tuple(sorted(gauges)),
        asked=_asked_of(request) if "by" in request else None,
    )


def _asked_of(request: dict[str, Any]) -> Asked:
    return Asked(by=str(request["by"])[:MAX_ASKER], reason=str(request.get("reason") or ""))


def _whole(request: dict[str, Any], name: str) -> int | None:
    number = request.get(name)
    if number is not None and type(number) is not int:
        raise ValueError(f"{name}: expected a whole number, not {number!r:.80}")
    return number


def _move_of(request: dict[str, Any]) -> MoveTask:
    origin = request.get("origin")
    return MoveTask(
        task=str(request["task"]),
        node=str(request["target"]),
        asked=_asked_of(request),
        origin=None if origin is None else str(origin),
        base_revision=_whole(request, "base_revision"),
        is_plan=bool(request.get("plan")),
    )


def _hold_of(request: dict[str, Any]) -> HoldTask:
    for_s = request.get("for_s")
    return HoldTask(
        task=str(request["task"]),
        hold=Hold(str(request["hold"])),
        asked=_asked_of(request),
        node=str(request.get("target") or ""),
        is_hard=bool(request.get("hard")),
        for_s=None if for_s is None else float(for_s),
        base_revision=_whole(request, "base_revision"),
    )


def _tune_of(request: dict[str, Any]) -> TuneTask:
    try:
        tuning = wire.from_plain(request["tuning"], Tuning)
    except WireError as error:
        raise ValueError(f"tuning: {error}") from error
    base = _whole(request, "base_revision")
    if base is None:
        raise KeyError("base_revision")
    return TuneTask(task=str(request["task"]), tuning=tuning, base_revision=base, asked=_asked_of(request))


def _retry_of(request: dict[str, Any]) -> RetryTask:
    asked = _asked_of(request) if "by" in request else None
    return RetryTask(task=str(request["task"]), node=str(request.get("whose") or ""), asked=asked)


def _explain_of(request: dict[str, Any]) -> ExplainTask:
    return ExplainTask(task=str(request["task"]))


def _restart_of(request: dict[str, Any]) -> RestartTask:
    return RestartTask(task=str(request["task"]), asked=_asked_of(request) if "by" in request else None)


def _certificate_of(request: dict[str, Any]) -> TakeCertificate:
    return TakeCertificate(certificate=Text(str(request["certificate"])))


def _lines_of(request: dict[str, Any]) -> ReadLines:
    after = request.get("after", 0)
    if type(after) is not int:
        raise ValueError(f"after: expected a whole number, not {after!r:.80}")
    return ReadLines(task=str(request["task"]), after=after)


def _change_of(request: dict[str, Any]) -> ChangeFleet:
    """The whole document, or one elector: exactly one of them is named."""
    base, text = request.get("base_revision"), request.get("text")
    if base is not None and type(base) is not int:
        raise ValueError(f"base_revision: expected a whole number, not {base!r:.80}")
    if text is not None and not isinstance(text, str):
        raise ValueError(f"text: expected the text of a fleet file, not {text!r:.80}")
    try:
        flags = tuple(wire.from_plain(flag, Flag) for flag in request.get("flags", ()))
        rollouts = tuple(wire.from_plain(one, Rollout) for one in request.get("rollouts", ()))
    except WireError as error:
        raise ValueError(f"flags, or rollouts: {error}") from error
    return ChangeFleet(
        document=None if text is None else Document(text=Text(text), flags=flags, rollouts=rollouts),
        add_elector=str(request.get("add_elector") or ""),
        disk=str(request.get("disk") or ""),
        remove_elector=str(request.get("remove_elector") or ""),
        base_revision=base,
        reason=str(request.get("reason") or "")[:MAX_REASON],
    )


def _fleet_of(request: dict[str, Any]) -> ReadFleet:
    return ReadFleet(with_document=request.get("with_document") is not False)


def _strike_of(request: dict[str, Any]) -> Strike:
    return Strike(
        task=str(request["task"]),
        step=Step(str(request["step"])),
        asked=_asked_of(request),
        cut_s=float(request.get("cut_s") or 0.0),
        is_plan=bool(request.get("plan")),
    )


def _keep_of(request: dict[str, Any]) -> KeepRehearsal:
    return KeepRehearsal(
        task=str(request["task"]),
        name=str(request["name"]),
        body=Text(str(request["body"])),
        told=str(request["told"])[:MAX_REASON],
        asked=_asked_of(request),
    )


def _rehearsals_of(request: dict[str, Any]) -> ReadRehearsals:
    return ReadRehearsals(task=str(request.get("task") or ""), name=str(request.get("name") or ""))


_COMMANDS: dict[str, Callable[[dict[str, Any]], Command]] = {
    "weights": _weights_of,
    "move": _move_of,
    "hold": _hold_of,
    "tune": _tune_of,
    "retry": _retry_of,
    "explain": _explain_of,
    "restart": _restart_of,
    "lines": _lines_of,
    "certificate": _certificate_of,
    "change": _change_of,
    "fleet": _fleet_of,
    "strike": _strike_of,
    "keep": _keep_of,
    "rehearsals": _rehearsals_of,
}


def command_of(request: dict[str, Any]) -> Command:
    """The command of a request of the socket.

    Raises:
        KeyError, TypeError, ValueError, OverflowError: something is missing or wrong.
    """
    return _COMMANDS[request["verb"]](request)


def answer_json(value: object) -> dict[str, Any]:
    """A node's answer as the socket tells it."""
    if isinstance(value, Snapshot):
        return snapshot_json(value)
    if isinstance(value, Explanation):
        return {"explanation": wire.as_plain(value), "sums": _sums(value.decision)}
    if isinstance(value, WorkerLines):
        lines = [{"number": line.number, "age_s": line.age_s, "text": line.text} for line in value.lines]
        body = {"node": value.node, "task": value.task, "lines": lines}
        return {**body, "newest": value.newest, "is_here": value.is_here}
    if isinstance(value, FleetTold):
        return _fleet_json(value)
    if isinstance(value, RehearsalsTold):
        promised = {one.step.value: wire.as_plain(one) for one in value.promised}
        kept = {"names": list(value.names), "body": value.body}
        return {"node": value.node, "timing": value.timing, "promised": promised, **kept}
    assert isinstance(value, CommandResult)
    return {"outcome": value.outcome.value, "detail": value.detail, "revision": value.revision}


def _sums(decision: Decision | None) -> dict[str, Any] | None:
    """The sums of a judgement: so the tool that asks need not load the scheduler."""
    from zsched.core.scheduler.explain import explained  # noqa: PLC0415 - only a daemon that is asked pays for it

    return None if decision is None else plain(explained(decision))


def _fleet_json(told: FleetTold) -> dict[str, Any]:
    """By which fleet value a node goes; its revision is ``None`` while it knows none."""
    value, content = told.value, told.content
    body = {"node": told.node, "fleet_file": told.fleet_file, "disk": told.disk}
    if value is None:
        return {**body, "revision": None}
    electors = [{"name": one.name, "disk": one.disk, "joining": one.joining} for one in value.electors]
    flags = [] if content is None else [wire.as_plain(flag) for flag in content.flags]
    rollouts = [] if content is None else [wire.as_plain(one) for one in content.rollouts]
    return {
        **body,
        "fleet": value.fleet,
        "generation_id": value.generation_id,
        "revision": value.revision,
        "number": value.number,
        "settled": value.settled,
        "electors": electors,
        "document": value.document,
        "text": "" if content is None else content.text,
        "flags": flags,
        "rollouts": rollouts,
        "value": wire.as_plain(value),
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
        self.measure_soon: Callable[[], None] = lambda: None
        """Told that work begins, ends or goes on here (`zsched.runtime.sampler`)."""
        self.take_certificate: Callable[[str], CommandResult] = _no_certificate
        """Keeps a newer certificate (`zsched.runtime.renewal`)."""
        self.stand_down = ""
        """Why this daemon must end, for its name is taken; empty: it need not."""
        self._failed_at: dict[str, float] = {}

    # --- instructions ------------------------------------------------------------------------------------------------

    def carry_out(self, batch: tuple[do.Instruction, ...]) -> None:
        """Carry a batch out in order; a failed write drops the rest, any other failure is only reported."""
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
                self._state_file.save(state)
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
            case do.TakeCertificate(request=request, certificate=certificate):
                self._answer_operator(request, self.take_certificate(certificate))
            case do.ApplyRoutes(plan=plan):
                self._streams().apply(plan)
            case do.AdoptFleet(fleet=fleet, is_agreed=is_agreed):
                self.follow(fleet, is_agreed)
            case do.EndTask(task=task):
                self._streams().end(task)
            case do.SetRole(role=role):
                self._streams().set_role(role)
                self.measure_soon()
            case do.StartWorker(task=task):
                self._workers().start(task)
                self.measure_soon()
            case do.StopWorker(task=task):
                self._workers().stop(task)
            case do.ResetWorker(task=task):
                self._workers().reset(task)
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
        if isinstance(report, ev.StreamsCounted) and all(count.is_still for count in report.counts):
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
        where = f"task={story.task} epoch={story.epoch} " if story.task else ""
        _stages[story.stage].info("%s%s", where, story.text)
        if self.log is not None:
            self.log.put(story)
