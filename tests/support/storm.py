"""Well-formed events in any order, by seed: for tests of the door that take anything for an answer."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from random import Random

from support.allocations import allocation_of
from support.ballots import ballot_of
from support.beats import beat_of
from support.fleets import fleet_of, tuning_of
from support.profiles import load_of, profile_of
from support.proposals import proposal_of
from zsched.core.electorate.changes import AdoptDocument
from zsched.core.electorate.founding import founded
from zsched.core.values import codec as wire
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.beat import Grant
from zsched.core.values.document import Document, Flag, FlagKind, Text
from zsched.core.values.electorate import FleetValue
from zsched.core.values.fleet import Fleet, OnIsolation, Standby, StreamRule, TaskSpec, WorkerSpec, electorate_hash
from zsched.core.values.messages import (
    Accept,
    Accepted,
    ChangeFleet,
    ExplainTask,
    Learnt,
    Prepare,
    Promise,
    ReadFleet,
    ReadHistory,
    ReadLines,
    Refusal,
    Refused,
    RestartTask,
    TakeCertificate,
    TuneTask,
    Utilities,
    fleet_answer,
    fleet_question,
)
from zsched.core.values.model import Acceptance, Allocation, Asked, Ballot, Tuning, Utility, UtilityVector, Weights
from zsched.core.values.plan import Direction, ReadyWhen, StreamCount
from zsched.core.values.profile import DeviceSample, TaskProgress, WorkerState
from zsched.core.values.rehearsal import FAULTS, KeepRehearsal, ReadRehearsals, Strike

ROBOTS, EDGES = ("robot1", "robot2", "robot3"), ("edge1", "edge2")
NAMES = (*ROBOTS, *EDGES, "ghost")
TASKS = ("alone", "cold", "merge", "other")
TUNINGS = tuple(Tuning(weights=Weights(cpu=cpu, memory=1.0 - cpu, network=0.0)) for cpu in (0.25, 0.75))
RULE = StreamRule(direction=Direction.INPUT, from_template="{robot}/{task}", to_template="{target}/{task}/{robot}/map")
OTHER_RULE = StreamRule(
    direction=Direction.OUTPUT, from_template="{target}/{task}/{robot}/{epoch}", to_template="{robot}/{task}/answer"
)


def task(name: str, candidates: tuple[str, ...], *, standby: Standby, exclusive: bool = False) -> TaskSpec:
    return TaskSpec(
        name=name,
        candidates=candidates,
        tuning=TUNINGS[0],
        price_s=0.02,
        worker=WorkerSpec(command=("work",), standby=standby, start_deadline_s=1.0, output_deadline_s=0.1),
        rules=(RULE,),
        exclusive=exclusive,
    )


FLEET = fleet_of(
    task("alone", (*EDGES, "robot1"), standby=Standby.WARM, exclusive=True),
    task("cold", (*EDGES, "robot1"), standby=Standby.COLD),
    task("merge", EDGES, standby=Standby.WARM),
    of=sorted((*ROBOTS, *EDGES)),
    electors=ROBOTS,
)
ELECTORATE = electorate_hash(FLEET)


def some_fleet(rng: Random) -> Fleet:
    """A fleet file that may follow on `FLEET`: same electors, other tasks, candidates, edges and times."""
    edges = rng.sample(("edge1", "edge2", "edge3"), rng.randrange(1, 4))
    robots = (*ROBOTS, "robot4") if rng.random() < 0.3 else ROBOTS
    tasks = [_some_task(rng, name, (*edges, "robot1")) for name in rng.sample(TASKS, rng.randrange(1, len(TASKS) + 1))]
    fleet = fleet_of(
        *sorted(tasks, key=lambda one: one.name), of=sorted((*robots, "edge1", "edge2", *edges)), electors=ROBOTS
    )
    if rng.random() < 0.5:
        return fleet
    beat_s = rng.choice((0.1, 0.2, 0.4))
    timing = replace(fleet.timing, beat_s=beat_s, suspect_s=6 * beat_s, decide_s=rng.choice((0.3, 0.5)), sample_s=0.1)
    return replace(fleet, timing=timing)


def _some_task(rng: Random, name: str, nodes: tuple[str, ...]) -> TaskSpec:
    chosen = tuple(sorted(rng.sample(nodes, rng.randrange(1, len(nodes) + 1))))
    made = task(name, chosen, standby=rng.choice(list(Standby)), exclusive=rng.random() < 0.4)
    worker = replace(made.worker, ready_when=rng.choice(list(ReadyWhen)), command=rng.choice((("work",), ("play",))))
    isolation = OnIsolation.HOLD if made.exclusive else rng.choice(list(OnIsolation))
    tuning = rng.choice((*TUNINGS, replace(TUNINGS[0], deadline_ms=50.0)))
    rules = rng.choice(((RULE,), (RULE, OTHER_RULE), (OTHER_RULE,)))
    return replace(
        made, worker=worker, on_isolation=isolation, tuning=tuning, rules=rules, drain_s=rng.choice((1.0, 2.0))
    )


FLAGS = (
    Flag(kind=FlagKind.DRAIN, subject="edge1", for_s=1.0, revision=2),
    Flag(kind=FlagKind.INELIGIBLE, subject="edge2"),
)
FOUNDING = founded(FLEET.name, 0, FLEET.electors)


def adopted(document: str) -> FleetValue:
    """The fleet value by which the fleet goes by a first document."""
    tasks = tuple((name, name == "alone") for name in TASKS if name != "other")
    change = AdoptDocument(base_revision=1, document=document, tasks=tasks, lease_s=FLEET.timing.lease_s)
    return change.apply(FOUNDING)


class Storm:
    """Well-formed events by seed; about half of them fit the moment, so that rounds and handovers get somewhere."""

    def __init__(self, me: str, seed: int) -> None:
        self.rng, self.me = Random(seed), me
        self.sent = 0
        self.asked: list[do.Instruction] = []
        self.plans: list[do.ApplyRoutes] = []
        self.epochs = dict.fromkeys(TASKS, 1)
        self.makers: tuple[Callable[[], ev.Event], ...] = (
            ev.DeadlineReached, self.sampled, self.profile, self.utility, self.proposal, self.prepare, self.accept,
            self.answer, self.answer, self.answer, self.learnt, self.beat, self.beat, self.token, self.worker,
            self.slot, self.slot, self.counted, self.relay, self.status, self.command, self.problem, self.fleet,
        )  # fmt: skip
        self.electors: list[do.AskElectors] = []
        self.storing: list[do.StoreDocument] = []

    def hear(self, batch: tuple[do.Instruction, ...]) -> None:
        self.asked += [one for one in batch if isinstance(one, do.AskUtilities | do.SendPrepare | do.SendAccept)]
        self.plans += [one for one in batch if isinstance(one, do.ApplyRoutes)]
        self.epochs |= {one.role.task: one.role.epoch for one in batch if isinstance(one, do.SetRole)}
        self.electors += [one for one in batch if isinstance(one, do.AskElectors)]
        self.storing += [one for one in batch if isinstance(one, do.StoreDocument)]
        del self.asked[:-6], self.plans[:-4], self.electors[:-2], self.storing[:-2]

    def event(self) -> ev.Event:
        if self.rng.random() < 0.003:
            return ev.FleetChanged(fleet=self.rng.choice((FLEET, some_fleet(self.rng))))
        if self.rng.random() < 0.002:
            return self.rng.choice((ev.StopRequested(), ev.PersistFailed(reason="full")))
        is_gathering = bool(self.asked) and isinstance(self.asked[-1], do.AskUtilities)
        return self.utility() if is_gathering and self.rng.random() < 0.2 else self.rng.choice(self.makers)()

    def name(self) -> str:
        return self.rng.choice(NAMES)

    def task(self) -> str:
        return self.rng.choice(TASKS)

    def number(self) -> int:
        return self.rng.choice((0, 1, 2, 3, 7, self.rng.randrange(2**40)))

    def sequence(self) -> int:
        """Mostly what an honest sender would count by now."""
        self.sent += 1
        return self.sent if self.rng.random() < 0.9 else self.rng.randrange(10**6)

    def ballot(self, node: str) -> Ballot:
        return ballot_of(self.rng.randrange(60), node, self.rng.randrange(9))

    def value(self, task: str) -> Allocation:
        revision = self.rng.randrange(40)
        owner = self.rng.choice((None, *NAMES)) if revision else None
        return allocation_of(revision, owner, task=task, epoch=revision // 2, tuning=self.rng.choice(TUNINGS))

    def sampled(self) -> ev.Event:
        used = self.rng.choice((None, self.rng.uniform(0, 5)))
        return ev.ProfileSampled(
            device=DeviceSample(cpu_cores=4.0, cpu_used_cores=used, memory_mb=4000.0, memory_used_mb=900.0)
        )

    def profile(self) -> ev.Event:
        loads = [load_of(name, self.rng.choice(list(WorkerState))) for name in TASKS]
        said = [
            TaskProgress(task=name, epoch=self.epochs[name], is_served=self.rng.random() < 0.1)
            for name in self.rng.sample(TASKS, self.rng.randrange(len(TASKS)))
        ]
        return ev.ProfileReceived(
            profile=profile_of(
                self.name(),
                incarnation=3,
                sequence=self.sequence(),
                cpu_used_cores=self.rng.uniform(0, 4),
                memory_used_mb=self.rng.uniform(0, 4000),
                workers=tuple(loads),
                draining=self.rng.random() < 0.1,
                progress=tuple(said),
            )
        )

    def utility(self) -> ev.Event:
        voter = self.name()
        if self.rng.random() < 0.2:
            return ev.UtilityAsked(request=self.number(), asker=voter)
        gathers = [one.gather for one in self.asked if isinstance(one, do.AskUtilities)]
        column = tuple(Utility(candidate=name, value=self.rng.random()) for name in self.rng.sample(NAMES, 3))
        vectors = tuple(
            UtilityVector(voter=voter, task=name, revision=self.rng.choice((0, 0, 0, 1, 2)), utilities=column)
            for name in TASKS
        )
        gather = gathers[-1] if gathers else self.number()
        return ev.UtilityReceived(gather=gather, utilities=Utilities(voter=voter, vectors=vectors))

    def proposal(self) -> ev.Event:
        return ev.ProposalReceived(
            proposal=proposal_of(
                self.name(),
                self.name(),
                task=self.task(),
                base_revision=self.rng.randrange(4),
                aggregate=self.rng.random(),
                is_escape=self.rng.random() < 0.5,
            )
        )

    def prepare(self) -> ev.Event:
        asker = self.name()
        asked = Prepare(task=self.task(), ballot=self.ballot(asker), electorate=self.rng.choice((ELECTORATE, "no")))
        return ev.PrepareAsked(request=self.number(), asker=asker, prepare=asked)

    def accept(self) -> ev.Event:
        asker, name = self.name(), self.task()
        acceptance = Acceptance(ballot=self.ballot(asker), value=self.value(name))
        asked = Accept(task=name, acceptance=acceptance, electorate=ELECTORATE)
        return ev.AcceptAsked(request=self.number(), asker=asker, accept=asked)

    def answer(self) -> ev.Event:
        """Mostly to what the node asked last."""
        elector = self.rng.choice((*ROBOTS, *ROBOTS, *NAMES))
        asked = [one for one in self.asked if isinstance(one, do.SendPrepare | do.SendAccept)]
        if not asked or self.rng.random() < 0.2:
            name, at = self.task(), self.ballot(self.me)
            return ev.ElectorAnswered(
                answer=Refused(
                    elector=elector,
                    task=name,
                    ballot=at,
                    refusal=self.rng.choice(list(Refusal)),
                    promised=self.ballot("robot2"),
                )
            )
        last = asked[-1]
        if isinstance(last, do.SendAccept):
            at = last.accept.acceptance.ballot
            return ev.ElectorAnswered(answer=Accepted(elector=elector, task=last.accept.task, ballot=at))
        held = None
        if self.rng.random() < 0.05:
            held = Acceptance(ballot=self.ballot("robot3"), value=self.value(last.prepare.task))
        promise = Promise(elector=elector, task=last.prepare.task, ballot=last.prepare.ballot, accepted=held)
        return ev.ElectorAnswered(answer=promise)

    def learnt(self) -> ev.Event:
        if self.rng.random() < 0.9:
            return ev.LearntAsked(request=self.number())
        changed = adopted(self.rng.choice(("ab", "cd"))) if self.rng.random() < 0.3 else None
        learnt = Learnt(node=self.name(), values=(self.value(self.task()),), fleet=changed)
        return ev.LearntReceived(learnt=learnt, is_answer=self.rng.random() < 0.8)

    def beat(self) -> ev.Event:
        learnt = tuple((name, self.number(), self.number()) for name in TASKS)
        suspects = tuple(self.rng.sample(NAMES, self.rng.randrange(3)))
        grants = tuple(
            Grant(
                task=name,
                owner=self.rng.choice((self.me, self.name())),
                incarnation=self.rng.choice((3, 7)),
                epoch=self.rng.randrange(20),
                number=self.rng.randrange(200),
            )
            for name in ("alone", "alone", "other")
        )
        return ev.BeatReceived(
            beat=beat_of(
                self.name(),
                self.sequence(),
                incarnation=self.rng.choice((*[3] * 20, 7, 8)),
                loop_lag_s=self.rng.random(),
                learnt=learnt,
                suspects=suspects,
                echoes=grants,
                released=grants[: self.rng.randrange(2)],
                asked_to_leave=(("alone", self.me, self.rng.randrange(20)),),
            )
        )

    def token(self) -> ev.Event:
        kind = self.rng.choice((ev.TokenSeen, ev.TokenLost))
        return kind(node=self.name(), incarnation=self.rng.choice((3, 7, 8)))

    def worker(self) -> ev.Event:
        if self.rng.random() < 0.2:
            text, is_cold = "x" * self.rng.choice((0, 3, 400)), self.rng.random() < 0.3
            return ev.WorkerTroubled(task=self.task(), count=self.number(), text=text, is_cold=is_cold)
        if self.rng.random() < 0.2:
            return ev.RecipeCompared(task=self.task(), is_old=self.rng.random() < 0.7)
        if self.rng.random() < 0.1:
            return ev.WorkerOutdated(task=self.task(), reason=self.rng.choice(("", "it lacks x", "x" * 400)))
        if self.rng.random() < 0.3:
            at_s, time_s, cpu_s, wait_s = (self.rng.choice((0.0, 0.5, 3.0, 1e6)) for _ in range(4))
            return ev.WorkerJobs(
                task=self.task(),
                incarnation=self.rng.choice("12"),
                at_s=at_s,
                done=self.number(),
                skipped=self.number(),
                waiting=self.number(),
                time_s=time_s,
                cpu_s=cpu_s,
                wait_s=wait_s,
            )
        reason = self.rng.choice(("", "its token", "x" * 400))
        return ev.WorkerChanged(task=self.task(), state=self.rng.choice(tuple(WorkerState)), reason=reason)

    def slot(self) -> ev.Event:
        """Mostly what the relay would say to one of the last plans."""
        current = self.rng.choice(self.plans).plan if self.plans else None
        name = self.task() if current is None else current.task
        epoch = self.number() if current is None or current.current is None else current.current.epoch
        if current is not None and current.predecessors and self.rng.random() < 0.3:
            return ev.SlotDrained(task=name, epoch=self.rng.choice(current.predecessors).epoch)
        kind = self.rng.choice((ev.SlotReady, ev.SlotFlipped, ev.RoleEnded))
        return kind(task=name, epoch=epoch)

    def counted(self) -> ev.Event:
        return ev.StreamsCounted(counts=(StreamCount(stream="merge/in/0", messages=self.number()),))

    def relay(self) -> ev.Event:
        return ev.RelayChanged(is_running=self.rng.random() < 0.5, reason="x")

    def fleet(self) -> ev.Event:
        """The fleet register and its documents, which all say what the file says."""
        kind = self.rng.randrange(8)
        if kind == 0:
            change = ChangeFleet(document=Document(text=Text(self.rng.choice("ab"))))
            return ev.FleetCommanded(request=self.number(), command=change)
        if kind == 1:
            removal = ChangeFleet(remove_elector=self.rng.choice(ROBOTS), base_revision=self.rng.choice((None, 1)))
            return ev.FleetCommanded(request=self.number(), command=removal)
        if kind == 2:
            return ev.DocumentAsked(request=self.number(), document="ab")
        if kind == 3:
            return self.stored()
        return self.fleet_answer() if self.electors and self.rng.random() < 0.7 else self.fleet_asked()

    def stored(self) -> ev.Event:
        order = self.storing[-1] if self.storing and self.rng.random() < 0.5 else None
        name = "ab" if order is None else wire.document_hash(order.content)
        request = None if order is None else order.request
        if self.rng.random() < 0.1:
            return ev.DocumentRefused(document=name, reason="no", request=request)
        return ev.DocumentStored(document=name, fleet=FLEET, flags=FLAGS, request=request)

    def fleet_asked(self) -> ev.Event:
        asker = self.name()
        generation_id = FOUNDING.generation_id if self.rng.random() < 0.9 else "ff"
        ballot, number = self.ballot(asker), self.rng.choice((1, 1, 1, 2))
        question: Prepare | Accept[FleetValue] = Prepare(
            task=FLEET.name, ballot=ballot, electorate=ELECTORATE, generation_id=generation_id, number=number
        )
        if self.rng.random() < 0.5:
            question = Accept(
                task=FLEET.name,
                acceptance=Acceptance(ballot=ballot, value=adopted(self.rng.choice(("ab", "cd")))),
                electorate=ELECTORATE,
                generation_id=generation_id,
                number=number,
            )
        return ev.FleetAsked(request=self.number(), asker=asker, question=fleet_question(question))

    def fleet_answer(self) -> ev.Event:
        last = self.electors[-1].question
        elector = self.rng.choice(self.electors[-1].to)
        if isinstance(last, Prepare):
            return ev.FleetAnswered(answer=fleet_answer(Promise(elector=elector, task=last.task, ballot=last.ballot)))
        at = last.acceptance.ballot
        return ev.FleetAnswered(answer=fleet_answer(Accepted(elector=elector, task=last.task, ballot=at)))

    def status(self) -> ev.Event:
        return ev.StatusAsked(request=self.number())

    def rehearsal(self) -> ev.Event:
        asked = Asked(by="root@robot1", reason="a test")
        kind = self.rng.randrange(4)
        if kind == 0:
            kept = KeepRehearsal(task=self.task(), name="one", body=Text("{}"), told="kept", asked=asked)
            return ev.RehearsalKept(request=self.number(), command=kept)
        if kind == 1:
            asks = ReadRehearsals(task=self.rng.choice(("", self.task())), name=self.rng.choice(("", "one")))
            return ev.RehearsalsAsked(request=self.number(), command=asks)
        strike = Strike(task=self.task(), step=self.rng.choice(FAULTS), asked=asked, is_plan=self.rng.random() < 0.5)
        return ev.StrikeCommanded(request=self.number(), command=strike, is_near=self.rng.random() < 0.8)

    def command(self) -> ev.Event:
        if self.rng.random() < 0.2:
            return ev.ExplanationAsked(request=self.number(), command=ExplainTask(task=self.task()))
        if self.rng.random() < 0.2:
            return ev.RestartCommanded(request=self.number(), command=RestartTask(task=self.task()))
        if self.rng.random() < 0.1:
            return ev.LinesAsked(request=self.number(), command=ReadLines(task=self.task()))
        if self.rng.random() < 0.1:
            return ev.HistoryAsked(request=self.number(), command=ReadHistory())
        if self.rng.random() < 0.1:
            return ev.FleetReadAsked(request=self.number(), command=ReadFleet())
        if self.rng.random() < 0.1:
            return ev.CertificateSent(request=self.number(), command=TakeCertificate(certificate=Text("pem")))
        if self.rng.random() < 0.1:
            return self.rehearsal()
        tuning = tuning_of(*self.rng.choice(((0.25, 0.75), (0.75, 0.25))))
        asked = Asked(by="ada@robot1")
        command = TuneTask(task=self.task(), tuning=tuning, base_revision=self.rng.randrange(3), asked=asked)
        return ev.TuneCommanded(request=self.number(), command=command)

    def problem(self) -> ev.Event:
        if self.rng.random() < 0.5:
            return ev.FrameDropped(kind="beat", reason="size")
        return ev.ProblemReported(source="profile", problem=self.rng.choice((None, "broken")))
