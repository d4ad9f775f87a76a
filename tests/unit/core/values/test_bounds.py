"""Every bound of every value that comes from outside: its ends pass, what is beyond is refused by the field's name."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from support.allocations import allocation_of
from support.ballots import ballot_of
from support.beats import beat_of
from support.fleet_values import fleet_value_of
from support.fleets import tuning_of
from support.profiles import load_of, profile_of
from support.proposals import proposal_of
from support.states import state_of
from zsched.core.values import model
from zsched.core.values.beat import Grant
from zsched.core.values.change import SetHold, SetLeased
from zsched.core.values.document import MAX_DOCUMENT_BYTES, MAX_FLAGS, Document, Flag, FlagKind, Text
from zsched.core.values.electorate import Creation, Elector
from zsched.core.values.events import (
    CertificateSent,
    ExplanationAsked,
    FleetCommanded,
    FleetReadAsked,
    HistoryAsked,
    HoldCommanded,
    LinesAsked,
    MoveCommanded,
    RehearsalKept,
    RehearsalsAsked,
    RestartCommanded,
    StrikeCommanded,
    TuneCommanded,
    WorkerJobs,
    commanded,
)
from zsched.core.values.fleet import Demand
from zsched.core.values.messages import (
    Accept,
    Accepted,
    ChangeFleet,
    ExplainTask,
    FleetAnswer,
    FleetQuestion,
    FleetTold,
    HistoryTold,
    Hold,
    HoldTask,
    Learnt,
    MoveTask,
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
    WorkerLines,
    asked_at,
)
from zsched.core.values.model import (
    MAX_COUNTER,
    Acceptance,
    Asked,
    Pause,
    ScoreForm,
    Utility,
    UtilityVector,
)
from zsched.core.values.plan import ServiceSettings, StreamSettings
from zsched.core.values.profile import (
    MAX_BITRATE_MBPS,
    MAX_CPU_CORES,
    MAX_HELD_S,
    MAX_JOB_S,
    MAX_JOBS_HZ,
    MAX_MEMORY_MB,
    Echo,
    Jobs,
    Link,
    LinkSource,
    TaskProgress,
)
from zsched.core.values.rehearsal import (
    MAX_CUT_S,
    MAX_KEPT_BYTES,
    KeepRehearsal,
    ReadRehearsals,
    RehearsalsTold,
    Step,
    Strike,
)
from zsched.core.values.relay_protocol import EndMarker, SnapshotChunk, StreamAck, WorkerTrouble
from zsched.core.values.words import MAX_ASKED, MAX_ASKER

TUNING = tuning_of(score=ScoreForm.SERVICE)
BALLOT = ballot_of(node="r1")
VALUE = allocation_of(owner="e1", tuning=TUNING)
LINK = Link(source=LinkSource.FIXED)
LOAD = load_of()
PROFILE = profile_of("e1", memory_mb=100.0, memory_used_mb=1.0)
UTILITY = Utility(candidate="e1", value=0.5)
VECTOR = UtilityVector(voter="r1", task="merge", revision=1, utilities=())
PROPOSAL = proposal_of("r1", "e1", base_revision=1)
GRANT = Grant(task="merge", owner="e1", incarnation=1, epoch=1, number=1)
BEAT = beat_of("e1")
PROGRESS = TaskProgress(task="merge", epoch=1, is_served=True)
PROMISE = Promise(elector="r1", task="merge", ballot=BALLOT)
ACCEPTED = Accepted(elector="r1", task="merge", ballot=BALLOT)
REFUSED = Refused(elector="r1", task="merge", ballot=BALLOT, refusal=Refusal.BALLOT, promised=BALLOT)
TROUBLE = WorkerTrouble(task="merge", incarnation="1", count=1, text="")
WORD = WorkerJobs(task="merge", incarnation="1", at_s=1.0, done=1)
JOBS = Jobs(time_s=0.1, cpu_s=0.1)
ADA = Asked(by="ada@robot1")
SEAT = Elector(name="r1", disk="01", joining=1)
ECHO = Echo(node="r1", incarnation=1, sequence=1, held_s=0.1)
END = EndMarker(epoch=1, count=1)
PIECE = SnapshotChunk(index=0, count=1, size=1, checksum="")

COUNTERS = [
    (PROGRESS, "epoch", "progress"),
    (PROFILE, "incarnation", "profile"),
    (PROFILE, "sequence", "profile"),
    (VECTOR, "revision", "vector"),
    (PROPOSAL, "base_revision", "proposal"),
    (VALUE, "revision", "allocation"),
    (VALUE, "epoch", "allocation"),
    (BALLOT, "counter", "ballot"),
    (BALLOT, "incarnation", "ballot"),
    (GRANT, "incarnation", "grant"),
    (GRANT, "epoch", "grant"),
    (GRANT, "number", "grant"),
    (BEAT, "votes", "beat"),
    (BEAT, "incarnation", "beat"),
    (BEAT, "sequence", "beat"),
    (BEAT, "generation", "beat"),
    (Learnt(node="e1", values=()), "generation", "learnt"),
    (TROUBLE, "count", "trouble"),
    *((WORD, name, "jobs") for name in ("done", "skipped", "waiting", "late")),
    (JOBS, "backlog", "jobs"),
    (ECHO, "incarnation", "echo"),
    (ECHO, "sequence", "echo"),
    (END, "epoch", "end"),
    (END, "count", "end"),
    (END, "replayed", "end"),
    *((PIECE, name, "snapshot") for name in ("index", "count", "size")),
    *(
        (StreamAck(eid=1, first=0, arrived=0, processed=0), name, "ack")
        for name in ("eid", "first", "arrived", "processed", "lost", "doubled", "reordered", "until")
    ),
]
NAMES = [
    (LINK, "peer", "link"),
    (LOAD, "task", "worker"),
    (PROGRESS, "task", "progress"),
    (PROFILE, "node", "profile"),
    (UTILITY, "candidate", "utility"),
    (VECTOR, "voter", "vector"),
    (VECTOR, "task", "vector"),
    (PROPOSAL, "voter", "proposal"),
    (PROPOSAL, "task", "proposal"),
    (PROPOSAL, "candidate", "proposal"),
    (VALUE, "task", "allocation"),
    (VALUE, "owner", "allocation"),
    (BALLOT, "node", "ballot"),
    (GRANT, "task", "grant"),
    (GRANT, "owner", "grant"),
    (BEAT, "node", "beat"),
    (Prepare(task="merge", ballot=BALLOT, electorate="x"), "task", "prepare"),
    (PROMISE, "elector", "promise"),
    (PROMISE, "task", "promise"),
    (ACCEPTED, "elector", "accepted"),
    (ACCEPTED, "task", "accepted"),
    (REFUSED, "elector", "refused"),
    (REFUSED, "task", "refused"),
    (Learnt(node="e1", values=()), "node", "learnt"),
    (TROUBLE, "task", "trouble"),
    (WORD, "task", "jobs"),
    (ECHO, "node", "echo"),
    (RestartTask(task="merge"), "task", "restart"),
    (ReadLines(task="merge"), "task", "lines"),
    (Strike(task="merge", step=Step.DAEMON, asked=Asked(by="ada@robot1")), "task", "strike"),
    (ReadRehearsals(task="merge"), "task", "rehearsals"),
    (ReadRehearsals(name="1"), "name", "rehearsals"),
    (RehearsalsTold(node="edge1"), "node", "rehearsals_told"),
    (WorkerLines(node="edge1", task="merge"), "node", "worker_lines"),
    (WorkerLines(node="edge1", task="merge"), "task", "worker_lines"),
    (FleetTold(node="edge1", value=None, fleet_file=""), "node", "fleet_told"),
    (HistoryTold(node="edge1", now=1.0), "node", "history_told"),
]
RATIO = (0.0, 1.0)
RANGES = [
    (TUNING, "bonus", "bonus", RATIO),
    (tuning_of(), "price_s", "price_s", (0.0, 1000.0)),
    (LINK, "rssi_dbm", "link.rssi_dbm", (-120.0, 0.0)),
    (LINK, "bitrate_mbps", "link.bitrate_mbps", (0.0, MAX_BITRATE_MBPS)),
    (LINK, "retry_ratio", "link.retry_ratio", RATIO),
    (LOAD, "cpu_cores", "worker.cpu_cores", (0.0, MAX_CPU_CORES)),
    (LOAD, "memory_mb", "worker.memory_mb", (0.0, MAX_MEMORY_MB)),
    (PROFILE, "cpu_cores", "profile.cpu_cores", (0.001, MAX_CPU_CORES)),
    (PROFILE, "cpu_used_cores", "profile.cpu_used_cores", (0.0, MAX_CPU_CORES)),
    (PROFILE, "memory_mb", "profile.memory_mb", (1.0, MAX_MEMORY_MB)),
    (PROFILE, "memory_used_mb", "profile.memory_used_mb", (0.0, MAX_MEMORY_MB)),
    (PROFILE, "cpu_pressure", "profile.cpu_pressure", RATIO),
    (LOAD, "wanted_cores", "worker.wanted_cores", (0.0, MAX_CPU_CORES)),
    (TUNING, "deadline_ms", "deadline_ms", (model.MIN_DEADLINE_MS, model.MAX_DEADLINE_MS)),
    *((JOBS, name, f"jobs.{name}", (0.0, MAX_JOB_S)) for name in ("time_s", "cpu_s", "wait_s", "age_s")),
    (LOAD, "unended_s", "worker.unended_s", (0.0, MAX_JOB_S)),
    *((JOBS, name, f"jobs.{name}", (0.0, MAX_JOBS_HZ)) for name in ("done_hz", "wanted_hz")),
    (JOBS, "late_ratio", "jobs.late_ratio", RATIO),
    *((WORD, name, f"jobs.{name}", (0.0, MAX_COUNTER)) for name in ("at_s", "time_s", "cpu_s", "wait_s", "age_s")),
    (ECHO, "held_s", "echo.held_s", (0.0, MAX_HELD_S)),
    (UTILITY, "value", "utility.value", RATIO),
    (UTILITY, "cpu", "utility.cpu", RATIO),
    (UTILITY, "memory", "utility.memory", RATIO),
    (UTILITY, "network", "utility.network", RATIO),
    (PROPOSAL, "aggregate", "proposal.aggregate", (0.0, 2.0)),
    (Demand(), "cpu_cores", "demand.cpu_cores", (0.0, 4096.0)),
    (Demand(), "memory_mb", "demand.memory_mb", (0.0, 1e8)),
    (ServiceSettings(), "timeout_s", "timeout_s", (0.05, 3600.0)),
    (ServiceSettings(), "hold_s", "hold_s", (0.0, 3600.0)),
    (ServiceSettings(), "max_pending", "max_pending", (1, 256)),
    (StreamSettings(), "keep_last", "keep_last", (0, 1000)),
    (StreamSettings(), "depth", "depth", (1, 100_000)),
    (StreamSettings(), "max_hz", "max_hz", (0.01, 10_000)),
    (BEAT, "loop_lag_s", "beat.loop_lag_s", (0.0, 86400.0)),
]


@pytest.mark.parametrize(("value", "field", "kind"), COUNTERS)
def test_counters_go_from_zero_to_the_largest(value: Any, field: str, kind: str) -> None:
    for good in (0, MAX_COUNTER):
        assert getattr(replace(value, **{field: good}), field) == good
    for bad in (-1, MAX_COUNTER + 1):
        with pytest.raises(ValueError, match=f"{kind}.{field}"):
            replace(value, **{field: bad})


@pytest.mark.parametrize(("value", "field", "kind"), NAMES)
def test_names_are_of_the_alphabet(value: Any, field: str, kind: str) -> None:
    assert getattr(replace(value, **{field: "other-1"}), field) == "other-1"
    for bad in ("*", "Robot", "a" * 64):
        with pytest.raises(ValueError, match=f"{kind}.{field}"):
            replace(value, **{field: bad})


@pytest.mark.parametrize(("value", "field", "told", "ends"), RANGES)
def test_figures_keep_within_both_ends(value: Any, field: str, told: str, ends: tuple[float, float]) -> None:
    low, high = ends
    for good in ends:
        assert getattr(replace(value, **{field: good}), field) == good
    for bad in (low - 0.0001, high * 1.01 + 0.01, float("nan"), float("inf")):
        with pytest.raises(ValueError, match=told):
            replace(value, **{field: bad})


def test_what_a_worker_says_of_itself_has_a_length() -> None:
    assert len(replace(LOAD, reason="x" * 400).reason) == len(replace(TROUBLE, text="x" * 400).text) == 400
    with pytest.raises(ValueError, match=r"worker\.reason: 401 characters, at most 400"):
        replace(LOAD, reason="x" * 401)
    with pytest.raises(ValueError, match=r"trouble\.text: 401 characters, at most 400"):
        replace(TROUBLE, text="x" * 401)


def test_each_command_is_its_own_event() -> None:
    assert commanded(9, RestartTask(task="merge")) == RestartCommanded(request=9, command=RestartTask(task="merge"))
    assert commanded(9, ReadLines(task="merge")) == LinesAsked(request=9, command=ReadLines(task="merge"))
    assert commanded(9, ReadHistory()) == HistoryAsked(request=9, command=ReadHistory())
    strike = Strike(task="merge", step=Step.DAEMON, asked=Asked(by="ada@robot1"))
    assert commanded(9, strike) == StrikeCommanded(request=9, command=strike)
    assert commanded(9, strike, is_near=True) == StrikeCommanded(request=9, command=strike, is_near=True)
    keep = KeepRehearsal(task="merge", name="1", body=Text("{}"), told="", asked=Asked(by="ada@robot1"))
    assert commanded(9, keep) == RehearsalKept(request=9, command=keep)
    assert commanded(9, ReadRehearsals()) == RehearsalsAsked(request=9, command=ReadRehearsals())
    assert commanded(9, ReadFleet()) == FleetReadAsked(request=9, command=ReadFleet())
    sent = TakeCertificate(certificate=Text("-----BEGIN CERTIFICATE-----"))
    assert commanded(9, sent) == CertificateSent(request=9, command=sent)
    explain = ExplainTask(task="merge")
    assert commanded(9, explain) == ExplanationAsked(request=9, command=explain)
    move = MoveTask(task="merge", node="e1", asked=ADA)
    assert commanded(9, move) == MoveCommanded(request=9, command=move)
    hold = HoldTask(task="merge", hold=Hold.PAUSE, asked=ADA)
    assert commanded(9, hold) == HoldCommanded(request=9, command=hold)
    tune = TuneTask(task="merge", tuning=TUNING, base_revision=1, asked=ADA)
    assert commanded(9, tune) == TuneCommanded(request=9, command=tune)
    change = ChangeFleet(remove_elector="r1", asked=ADA)
    assert commanded(9, change) == FleetCommanded(request=9, command=change)


def test_a_program_names_its_user_and_neither_an_operator_nor_another_node() -> None:
    """The name of an order as this node passes it on."""
    pause = HoldTask(task="merge", hold=Hold.PAUSE, asked=ADA)

    def by(who: str) -> str:
        passed = asked_at("r1", replace(pause, asked=Asked(by=who, reason="new fan")))
        assert isinstance(passed, HoldTask)
        assert passed.asked.reason == "new fan"
        return passed.asked.by

    assert by("ada@r1") == "ada@r1"
    assert by("ada@hall-b/r1") == "ada@hall-b/r1", "a user of another cell"
    assert by("ada@r2") == by("ada") == "ada@r1"
    assert by("ada@r11") == "ada@r1", "that ends with this node's name, and is another node"
    assert by("a" * MAX_ASKER) == f"{'a' * (MAX_ASKER - 3)}@r1", "as long as a name may be"
    nobody = asked_at("r1", RestartTask(task="merge"))
    assert isinstance(nobody, RestartTask)
    assert nobody.asked == Asked(by="r1")
    assert asked_at("r1", ReadFleet()) == ReadFleet(), "a question is nobody's order"


def test_an_operator_s_words_have_a_length() -> None:
    assert len(Asked(by="a" * MAX_ASKER, reason="x" * MAX_ASKED).by) == MAX_ASKER
    with pytest.raises(ValueError, match=r"asked\.by: 97 characters, at most 96"):
        Asked(by="a" * (MAX_ASKER + 1))
    with pytest.raises(ValueError, match=r"asked\.reason: 201 characters, at most 200"):
        Asked(by="a", reason="x" * (MAX_ASKED + 1))
    with pytest.raises(ValueError, match=r"profile\.relay: 401 characters, at most 400"):
        replace(PROFILE, relay="x" * (model.MAX_REASON + 1))
    flag = Flag(kind=FlagKind.DRAIN, subject="e1", reason="x" * model.MAX_REASON, by="a" * model.MAX_REASON)
    with pytest.raises(ValueError, match=r"flag\.reason: 401 characters, at most 400"):
        replace(flag, reason="x" * (model.MAX_REASON + 1))
    with pytest.raises(ValueError, match=r"flag\.by: 401 characters, at most 400"):
        replace(flag, by="x" * (model.MAX_REASON + 1))


def test_a_document_keeps_within_its_bounds() -> None:
    flag = Flag(kind=FlagKind.DRAIN, subject="e1")
    assert len(Document(text=Text("x" * MAX_DOCUMENT_BYTES), flags=(flag,) * MAX_FLAGS).flags) == MAX_FLAGS
    with pytest.raises(ValueError, match=r"document\.text: larger than"):
        Document(text=Text("x" * (MAX_DOCUMENT_BYTES + 1)))
    with pytest.raises(ValueError, match=r"document\.text: larger than"):
        Document(text=Text("\u00e9" * (MAX_DOCUMENT_BYTES // 2 + 1)))
    with pytest.raises(ValueError, match=r"document\.flags: more than"):
        Document(text=Text(""), flags=(flag,) * (MAX_FLAGS + 1))


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ({"electors": ()}, r"fleet\.electors: a fleet has at least one elector"),
        ({"electors": (SEAT, SEAT)}, r"fleet\.electors: not sorted by name, or a name stands twice"),
        ({"electors": (SEAT, replace(SEAT, name="e1"))}, r"fleet\.electors: not sorted"),
        ({"electors": (replace(SEAT, joining=2),)}, r"fleet\.electors: an elector joined under a later number"),
        ({"creations": 0}, r"fleet\.tasks: a task has a number that no creation has had"),
        ({"away": ("r2", "r1")}, r"fleet\.away: not sorted"),
    ],
)
def test_a_fleet_value_does_not_contradict_itself(changed: dict[str, Any], why: str) -> None:
    task = Creation(task="merge", number=1, exclusive=False)
    value = fleet_value_of(1, SEAT, number=1, creations=1, tasks=(task,), away=("r1", "r2"))
    with pytest.raises(ValueError, match=why):
        replace(value, **changed)


def test_a_message_of_the_fleet_s_register_says_one_thing() -> None:
    prepare = Prepare(task="hall", ballot=BALLOT, electorate="x")
    accept = Accept(task="hall", acceptance=Acceptance(ballot=BALLOT, value=fleet_value_of(1)), electorate="x")
    assert FleetQuestion(prepare=prepare).content == prepare
    assert FleetQuestion(accept=accept).content == accept
    for both in ((None, None), (prepare, accept)):
        with pytest.raises(ValueError, match="fleet_question: expected a prepare or an accept"):
            FleetQuestion(prepare=both[0], accept=both[1])
    for accepted, refused in ((None, None), (ACCEPTED, REFUSED)):
        with pytest.raises(ValueError, match="fleet_answer: expected a promise, an acceptance or a refusal"):
            FleetAnswer(accepted=accepted, refused=refused)
    for come, gone in (("", ""), ("r1", "r2")):
        with pytest.raises(ValueError, match="fleet: expected one of document, add_elector and remove_elector"):
            ChangeFleet(add_elector=come, disk="01", remove_elector=gone)
    with pytest.raises(ValueError, match=r"fleet\.disk: r1 needs the id of its disk"):
        ChangeFleet(add_elector="r1")


def test_a_change_to_what_is_there_already_changes_nothing() -> None:
    """Such a round ends without a new revision."""
    pause = Pause(asked=ADA, revision=1)
    paused = replace(VALUE, paused=True, pause=pause)
    assert SetHold(base_revision=1, pause=pause, pin=None, reason="").apply(paused) == paused
    ended = SetHold(base_revision=1, pause=None, pin=None, reason="").apply(paused)
    assert (ended.revision, ended.paused, ended.pause) == (VALUE.revision + 1, False, None)
    for leased in (False, True):
        value = replace(VALUE, leased=leased)
        assert SetLeased(base_revision=1, leased=leased).apply(value) == value
        assert SetLeased(base_revision=1, leased=not leased).apply(value).leased is not leased


def test_a_rehearsal_keeps_within_its_bounds() -> None:
    asked = Asked(by="ada@robot1")
    assert Strike(task="merge", step=Step.LINK, asked=asked, cut_s=MAX_CUT_S).cut_s == MAX_CUT_S
    with pytest.raises(ValueError, match=r"strike\.cut_s"):
        Strike(task="merge", step=Step.LINK, asked=asked, cut_s=MAX_CUT_S + 1)
    with pytest.raises(ValueError, match=r"strike\.step: move is not done by a node to itself"):
        Strike(task="merge", step=Step.MOVE, asked=asked)
    keep = KeepRehearsal(task="merge", name="1", body=Text("x" * MAX_KEPT_BYTES), told="x" * 400, asked=asked)
    with pytest.raises(ValueError, match=r"rehearsal\.body: larger than"):
        replace(keep, body=Text("x" * (MAX_KEPT_BYTES + 1)))
    with pytest.raises(ValueError, match=r"rehearsal\.told: 401 characters"):
        replace(keep, told="x" * 401)
    with pytest.raises(ValueError, match="surrogates not allowed"):  # JSON may hold one; it cannot be written down
        replace(keep, body=Text("\ud800"))


@pytest.mark.parametrize("field", ["by", "reason"])
def test_half_a_character_is_no_word_of_an_order(field: str) -> None:
    """JSON may hold one: its proposer kept it, and all others had another sign for the same revision."""
    with pytest.raises(ValueError, match="surrogates not allowed"):
        Asked(**{"by": "ada@robot1", field: "\ud800"})


def test_a_state_follows_a_generation_by_its_id_only() -> None:
    assert state_of("robot1", joins="ab12").joins == "ab12"
    with pytest.raises(ValueError, match=r"state\.joins: 'generation 2' is not an id"):
        state_of("robot1", joins="generation 2")
