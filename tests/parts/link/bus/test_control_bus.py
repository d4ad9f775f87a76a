"""The control session over real zenoh on loopback: every put and question arrives as its event, nothing hangs."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar, get_args

import pytest
import zenoh

from support.allocations import allocation_of
from support.authorities import install, make_authority
from support.ballots import ballot_of
from support.beats import beat_of
from support.fleets import fleet_of, tuning_of
from support.profiles import profile_of
from support.proposals import proposal_of
from support.snapshots import SNAPSHOT
from support.waiting import free_endpoint, until
from zsched.core.values import codec as wire
from zsched.core.values import events as ev
from zsched.core.values.certificates import Holder, Role
from zsched.core.values.document import Document, Text
from zsched.core.values.errors import AdapterError
from zsched.core.values.fleet import MOST_ORDER_S, Fleet, Security, Timing
from zsched.core.values.messages import (
    COMMANDS,
    Accept,
    Accepted,
    Ballots,
    ChangeFleet,
    CommandOutcome,
    CommandResult,
    ExplainTask,
    FleetTold,
    Hold,
    HoldTask,
    Learnt,
    MoveTask,
    Ordered,
    Prepare,
    Promise,
    ReadFleet,
    Refusal,
    Refused,
    RestartTask,
    TuneTask,
    Utilities,
    Votes,
)
from zsched.core.values.model import Acceptance, Asked
from zsched.core.values.rehearsal import KeepRehearsal, Step, Strike
from zsched.core.values.words import MAX_ASKER
from zsched.host.clock import monotonic_s
from zsched.link.bus import control_bus, open_questions
from zsched.link.bus.control_bus import RING, ControlBus, signed_by
from zsched.link.bus.open_questions import Questions
from zsched.link.bus.sealing import orderers_of, seals_of
from zsched.link.sessions.config import control_config

T = TypeVar("T")
TIMING = Timing()
VALUE = allocation_of()
BALLOT = ballot_of(node="a")
PREPARE = Prepare(task="merge", ballot=BALLOT, electorate="e")
ACCEPT = Accept(task="merge", acceptance=Acceptance(ballot=BALLOT, value=VALUE), electorate="e")
BEAT = beat_of("a")
PROFILE = profile_of("a", cpu_cores=1, cpu_used_cores=None, memory_mb=10, memory_used_mb=None)
PROPOSAL = proposal_of("a")
LEARNT = Learnt(node="a", values=(VALUE,))
RESULT = CommandResult(outcome=CommandOutcome.OK, detail="done", revision=4)
COMMAND = TuneTask(task="merge", tuning=tuning_of(), base_revision=3, asked=Asked(by="ada@robot1"))


class Peer:
    """One bus and the events it posted."""

    def __init__(self, name: str, listen: str, hub: str | None, incarnation: int = 1, **options: Any) -> None:
        self.events: list[ev.Event] = []
        connect = () if hub is None else (hub,)
        config = control_config(listen=(listen,), connect=connect, timing=TIMING)
        self.listen, self.name = listen, name
        self.bus = ControlBus(
            fleet="f", node=name, incarnation=incarnation, zenoh_config=config, post=self.events.append, **options
        )

    def of(self, kind: type[T]) -> list[T]:
        return [event for event in tuple(self.events) if isinstance(event, kind)]

    def next(self, kind: type[T]) -> T:
        """The next event of a kind, taken out."""
        event: T = until(lambda: next(iter(self.of(kind)), None), f"{kind.__name__} at {self.name}: {self.events}")
        self.events.remove(event)  # type: ignore[arg-type]
        return event

    def sees(self, *names: str) -> bool:
        return set(names) <= {event.node for event in self.of(ev.TokenSeen)}


@pytest.fixture(scope="module")
def trio() -> Iterator[tuple[Peer, Peer, Peer]]:
    """Three buses, meshed by gossip over the first."""
    hub = free_endpoint()
    peers = (Peer("a", hub, None), Peer("b", free_endpoint(), hub), Peer("c", free_endpoint(), hub))
    try:
        for peer in peers:
            peer.bus.open()
        until(lambda: all(peer.sees("a", "b", "c") for peer in peers), "everybody's token everywhere")
        until(lambda: all(peer.bus.peers() == 2 for peer in peers), "a full mesh")
        yield peers
    finally:
        for peer in peers:
            peer.bus.close()


@pytest.fixture
def mesh(trio: tuple[Peer, Peer, Peer]) -> tuple[Peer, Peer, Peer]:
    for peer in trio:
        peer.events.clear()
    return trio


@pytest.fixture(scope="module")
def stranger(trio: tuple[Peer, Peer, Peer]) -> Iterator[zenoh.Session]:
    """A plain session on the same network that says what it likes."""
    hub = trio[0].listen
    listen = free_endpoint()  # of two that meet by gossip either may have to dial
    session = zenoh.open(zenoh.Config.from_json5(control_config(listen=(listen,), connect=(hub,), timing=TIMING)))
    try:
        until(lambda: all(peer.bus.peers() == 3 for peer in trio), "the stranger is in the mesh")
        # what a link's other end subscribes to is known before its tokens are; a put goes nowhere before that
        until(lambda: len(list(session.liveliness().get("@zsched/f/**"))) >= len(trio), "it knows who subscribes")
        yield session
    finally:
        session.close()


BOB = Asked(by="bob@robot1", reason="why")
ORDERS: tuple[Ordered, ...] = (
    MoveTask(task="merge", node="edge1", asked=BOB),
    HoldTask(task="merge", hold=Hold.PAUSE, asked=BOB),
    TuneTask(task="merge", tuning=tuning_of(), base_revision=3, asked=BOB),
    RestartTask(task="merge", asked=BOB),
    Strike(step=Step.WORKER, task="merge", asked=BOB),
    KeepRehearsal(task="merge", name="one", body=Text("{}"), told="", asked=BOB),
    ChangeFleet(remove_elector="a", asked=BOB),
)


@pytest.mark.parametrize("order", ORDERS, ids=lambda order: type(order).__name__)
def test_an_operator_s_order_has_the_name_of_its_certificate_whatever_the_tool_says(order: Ordered) -> None:
    ana = Holder(name="ana", role=Role.OPERATOR)
    signed = signed_by(ana, order)
    assert isinstance(signed, type(order))
    assert signed.asked == Asked(by="ana.operator", reason="why")


@pytest.mark.parametrize("order", ORDERS, ids=lambda order: type(order).__name__)
def test_a_node_names_users_of_its_own_machine_and_neither_operators_nor_other_nodes(order: Ordered) -> None:
    robot1, robot2 = Holder(name="robot1"), Holder(name="robot2")
    assert signed_by(robot1, order) == order, "the user of a node's machine, as that node tells it"
    for said, told in (
        ("bob@robot1", "bob@robot2"),
        ("ana.operator", "ana.operator@robot2"),
        ("ana.operator/robot2", "ana.operator/robot2@robot2"),
        ("bob@robot22", "bob@robot2"),
        ("bob@yard/robot2", "bob@yard/robot2"),
        ("", "@robot2"),
        ("x" * MAX_ASKER, f"{'x' * (MAX_ASKER - 7)}@robot2"),
    ):
        signed = signed_by(robot2, replace(order, asked=Asked(by=said, reason="why")))
        assert isinstance(signed, type(order))
        assert signed.asked == Asked(by=told, reason="why")


def test_an_operator_whose_tool_says_nothing_is_named_too_and_questions_have_no_name() -> None:
    ana = Holder(name="ana", role=Role.OPERATOR)
    assert set(get_args(Ordered)) == {type(order) for order in ORDERS}
    assert set(get_args(Ordered)) == {one for one in COMMANDS if "asked" in one.__annotations__}
    signed = signed_by(ana, RestartTask(task="merge"))
    assert isinstance(signed, RestartTask)
    assert signed.asked == Asked(by="ana.operator")
    signed = signed_by(Holder(name="robot1"), ChangeFleet(document=Document(text=Text("x"))))
    assert isinstance(signed, ChangeFleet)
    assert signed.asked == Asked(by="robot1"), "else a document's flags would go on under any name"
    question = ExplainTask(task="merge")
    assert signed_by(ana, question) == question


# --- puts ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "value", "event"),
    [
        ("beat", BEAT, ev.BeatReceived(beat=BEAT)),
        ("beat_in_turn", BEAT, ev.BeatReceived(beat=BEAT)),
        ("profile", PROFILE, ev.ProfileReceived(profile=PROFILE)),
        ("profile_in_turn", PROFILE, ev.ProfileReceived(profile=PROFILE)),
        ("proposal", PROPOSAL, ev.ProposalReceived(proposal=PROPOSAL)),
        ("allocation", LEARNT, ev.LearntReceived(learnt=LEARNT)),
    ],
)
def test_every_put_arrives_everywhere_but_at_its_sender(
    mesh: tuple[Peer, Peer, Peer], kind: str, value: object, event: ev.Event
) -> None:
    a, b, c = mesh
    a.bus.publish(kind, value)
    assert b.next(type(event)) == event
    assert c.next(type(event)) == event
    assert a.events == []


def test_what_comes_in_turn_waits_until_the_loop_asks_and_news_do_not() -> None:
    hub = free_endpoint()
    a, b = Peer("a", hub, None), Peer("b", free_endpoint(), hub, hears_all_beats_at_once=False)
    try:
        a.bus.open()
        b.bus.open()
        until(lambda: a.sees("b") and b.sees("a"), "each other's tokens")
        found: list[ev.Event] = []

        def comes() -> bool:
            a.bus.publish("beat_in_turn", BEAT)
            found.extend(b.bus.waiting())
            return bool(found)

        until(comes, "a beat in turn")
        a.bus.publish("profile_in_turn", PROFILE)
        a.bus.publish("beat", replace(BEAT, sequence=99))
        assert b.next(ev.BeatReceived).beat.sequence == 99
        assert b.of(ev.ProfileReceived) == []
        found.clear()

        def has_profile() -> bool:
            found.extend(b.bus.waiting())
            return ev.ProfileReceived(profile=PROFILE) in found

        until(has_profile, "the profile")
        assert all(isinstance(event, ev.BeatReceived | ev.ProfileReceived) for event in found)
    finally:
        a.bus.close()
        b.bus.close()
    assert list(b.bus.waiting()) == []


def test_a_loop_that_does_not_come_costs_the_oldest_in_turn_and_holds_no_news_up() -> None:
    """More than the ring holds come; zenoh's thread waits for nobody."""
    hub = free_endpoint()
    a, b = Peer("a", hub, None), Peer("b", free_endpoint(), hub, hears_all_beats_at_once=False)
    try:
        a.bus.open()
        b.bus.open()
        until(lambda: a.sees("b") and b.sees("a"), "each other's tokens")
        newest = RING + 300
        for number in range(newest + 1):
            a.bus.publish("beat_in_turn", replace(BEAT, sequence=number))
            if number % 50 == 0:
                time.sleep(0.02)  # the sender drops what has no room at its link

        def has_news() -> bool:
            a.bus.publish("beat", replace(BEAT, sequence=10_000))  # again, for this may be dropped as well
            return any(event.beat.sequence == 10_000 for event in b.of(ev.BeatReceived))

        until(has_news, "a beat that is not in turn")
        kept: list[int] = []

        def has_newest() -> bool:
            a.bus.publish("beat_in_turn", replace(BEAT, sequence=newest))
            kept.extend(event.beat.sequence for event in b.bus.waiting() if isinstance(event, ev.BeatReceived))
            return newest in kept

        until(has_newest, "the newest beat in turn")
        assert kept == sorted(kept)
    finally:
        a.bus.close()
        b.bus.close()


def test_edges_are_not_asked_for_utilities_and_answer_everything_else() -> None:
    hub = free_endpoint()
    robot, edge = Peer("a", hub, None), Peer("b", free_endpoint(), hub, is_voter=False)
    try:
        robot.bus.open()
        edge.bus.open()
        until(lambda: robot.sees("b") and edge.sees("a"), "each other's tokens")

        def answers() -> bool:
            robot.bus.ask_learnt("b", 1.0)
            return bool(edge.of(ev.LearntAsked))

        until(answers, "a question that it answers")
        robot.bus.ask_utilities(1, 0.2)
        robot.bus.ask_electors(PREPARE, 1.0)
        edge.next(ev.PrepareAsked)  # asked after the utilities
        assert edge.of(ev.UtilityAsked) == []
        edge.bus.ask_utilities(2, 1.0)
        robot.next(ev.UtilityAsked)
    finally:
        robot.bus.close()
        edge.bus.close()


def test_frame_that_is_too_large_to_send_is_an_error_of_the_adapter(mesh: tuple[Peer, Peer, Peer]) -> None:
    large = replace(BEAT, suspects=tuple("x" * 63 for _ in range(300)))
    with pytest.raises(AdapterError, match="cannot publish beat: size"):
        mesh[0].bus.publish("beat", large)


@pytest.mark.parametrize(
    ("key", "payload", "dropped"),
    [
        ("beat/b", wire.encode(BEAT), ("beat", "foreign")),
        ("profile/b", wire.encode(PROFILE), ("profile", "foreign")),
        ("proposal/b", wire.encode(PROPOSAL), ("proposal", "foreign")),
        ("allocation/b", wire.encode(LEARNT), ("allocation", "foreign")),
        ("beat/a", wire.encode(PROFILE), ("beat", "kind")),
        ("beat/a", b"\xff\x00garbage", ("beat", "garbage")),
        ("beat/a", b"", ("beat", "garbage")),
        ("beat/a", b"\x00" * (wire.KINDS["beat"][1] + 1), ("beat", "size")),
        ("nonsense/a", wire.encode(BEAT), ("key", "unknown")),
        ("beat/No.Name", wire.encode(BEAT), ("key", "unknown")),
    ],
)
def test_bad_put_is_dropped_with_its_reason_and_nothing_else(
    mesh: tuple[Peer, Peer, Peer], stranger: zenoh.Session, key: str, payload: bytes, dropped: tuple[str, str]
) -> None:
    _, b, _ = mesh
    stranger.put(f"@zsched/f/{key}", payload)
    frame = b.next(ev.FrameDropped)
    assert (frame.kind, frame.reason) == dropped
    assert b.events == []


# --- questions -------------------------------------------------------------------------------------------------------


def test_gather_asks_every_other_node_and_brings_their_answers(mesh: tuple[Peer, Peer, Peer]) -> None:
    a, b, c = mesh
    a.bus.ask_utilities(7, 2.0)
    for peer in (b, c):
        asked = peer.next(ev.UtilityAsked)
        assert asked.asker == "a"
        peer.bus.answer(asked.request, Utilities(voter=peer.name, vectors=()))
    answers = [a.next(ev.UtilityReceived) for _ in range(2)]
    assert {answer.utilities.voter for answer in answers} == {"b", "c"}
    assert {answer.gather for answer in answers} == {7}
    assert a.of(ev.UtilityAsked) == [], "not ourselves"


@pytest.mark.parametrize("question", [PREPARE, ACCEPT])
def test_electors_are_asked_ourselves_included(mesh: tuple[Peer, Peer, Peer], question: Prepare | Accept) -> None:
    a = mesh[0]
    a.bus.ask_electors(question, 2.0)
    answers: dict[str, Any] = {
        "a": Promise(elector="a", task="merge", ballot=BALLOT),
        "b": Accepted(elector="b", task="merge", ballot=BALLOT),
        "c": Refused(elector="c", task="merge", ballot=BALLOT, refusal=Refusal.BALLOT, promised=BALLOT),
    }
    for peer in mesh:
        asked: Any = peer.next(ev.PrepareAsked if isinstance(question, Prepare) else ev.AcceptAsked)
        assert asked.asker == "a"
        assert (asked.prepare if isinstance(question, Prepare) else asked.accept) == question
        peer.bus.answer(asked.request, answers[peer.name])
    heard = [a.next(ev.ElectorAnswered).answer for _ in mesh]
    assert sorted(heard, key=lambda answer: answer.elector) == list(answers.values())


def test_questions_of_several_tasks_go_in_one_frame_and_so_do_the_answers(mesh: tuple[Peer, Peer, Peer]) -> None:
    a, b, c = mesh
    ballots = Ballots(prepares=(PREPARE,), accepts=(ACCEPT,))
    a.bus.ask_electors(ballots, 2.0)
    for peer in mesh:
        asked = peer.next(ev.BallotsAsked)
        assert (asked.asker, asked.ballots) == ("a", ballots)
        name = "a" if peer is c else peer.name
        peer.bus.answer(asked.request, Votes(promises=(Promise(elector=name, task="merge", ballot=BALLOT),)))
    assert {a.next(ev.VotesReceived).votes.elector for _ in (a, b)} == {"a", "b"}
    assert a.next(ev.FrameDropped).reason == "foreign", "c answers for a"


def test_one_peer_is_asked_for_what_it_has_learnt(mesh: tuple[Peer, Peer, Peer]) -> None:
    a, b, c = mesh
    b.bus.ask_learnt("a", 2.0)
    a.bus.answer(a.next(ev.LearntAsked).request, LEARNT)
    heard = b.next(ev.LearntReceived)
    assert (heard.learnt, heard.is_answer) == (LEARNT, True)
    assert heard.where == a.listen, "the other end of the link, for people"
    assert c.events == []


def test_a_gone_nodes_link_is_ended_and_made_anew(mesh: tuple[Peer, Peer, Peer]) -> None:
    a, b, c = mesh
    b.bus.ask_learnt("a", 2.0)
    a.bus.answer(a.next(ev.LearntAsked).request, LEARNT)
    b.next(ev.LearntReceived)
    b.bus.end_links(("nobody", "a"))
    until(lambda: b.of(ev.TokenLost), "the end of the link")
    until(lambda: b.sees("a"), "a's token by a new link")
    a.bus.publish("beat", BEAT)
    until(lambda: b.of(ev.BeatReceived), "a beat by the new link")
    assert {event.node for event in b.of(ev.TokenLost)} == {"a"}
    assert c.of(ev.TokenLost) == []


def test_operator_asks_and_commands_another_node(mesh: tuple[Peer, Peer, Peer]) -> None:
    a, b, _ = mesh
    answers: list[object] = []
    for command, kind, answer in ((None, ev.StatusAsked, SNAPSHOT), (COMMAND, ev.TuneCommanded, RESULT)):
        asking = threading.Thread(target=lambda c=command: answers.append(a.bus.ask_node("b", c, 60.0)))
        asking.start()
        asked: Any = b.next(kind)
        b.bus.answer(asked.request, answer)
        asking.join(60)
    assert answers == [SNAPSHOT, RESULT]


def test_a_command_is_answered_however_many_questions_come_meanwhile(
    mesh: tuple[Peer, Peer, Peer], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each question drops those that are too old."""
    a, b, c = mesh
    answers: list[object] = []
    asking = threading.Thread(target=lambda: answers.append(a.bus.ask_node("b", COMMAND, 60.0)))
    asking.start()
    command = b.next(ev.TuneCommanded)
    monkeypatch.setattr(open_questions, "monotonic_s", lambda: monotonic_s() + MOST_ORDER_S)
    c.bus.ask_learnt("b", 2.0)
    b.next(ev.LearntAsked)
    b.bus.answer(command.request, RESULT)
    asking.join(60)
    assert answers == [RESULT]


@pytest.fixture
def sealed(tmp_path: Path) -> Iterator[tuple[Peer, Peer, Fleet]]:
    """Two buses of a fleet whose nodes sign, and the fleet."""
    authority = make_authority(tmp_path / "authority", "f")
    hub = free_endpoint()
    peers: list[Peer] = []
    fleets: list[Fleet] = []
    for name in ("robot1", "robot2"):
        install(authority, tmp_path / name, name)
        fleets.append(
            fleet_of(name="f", of=("robot1", "robot2"), tasks=(), security=Security(folder=str(tmp_path / name)))
        )
        listen, dialled = (free_endpoint(), hub) if peers else (hub, None)
        peers.append(Peer(name, listen, dialled, seals=seals_of(fleets[-1], 1)))
    one, other = peers
    try:
        for peer in peers:
            peer.bus.open()
        until(lambda: one.sees("robot2") and other.sees("robot1"), "both tokens")
        yield one, other, fleets[0]
    finally:
        for peer in peers:
            peer.bus.close()


def test_who_is_gone_may_still_ask_whether_the_others_know(sealed: tuple[Peer, Peer, Fleet]) -> None:
    """So does `zsched leave`, after the change that takes its node out."""
    one, other, _ = sealed
    one.bus.take_orders_of(())
    answers: list[object] = []
    asking = threading.Thread(target=lambda: answers.append(other.bus.ask_node("robot1", ReadFleet(), 60.0)))
    asking.start()
    told = FleetTold(node="robot1", value=None, fleet_file="")
    one.bus.answer(one.next(ev.FleetReadAsked).request, told)
    asking.join(60)
    assert answers == [told]


@pytest.mark.parametrize("by", [{"revoked": ("robot2",)}, {"orders": ("robot1",)}], ids=["revoked", "orders of others"])
def test_a_key_whose_orders_count_no_more_does_not_take_that_back(
    sealed: tuple[Peer, Peer, Fleet], by: dict[str, Any]
) -> None:
    """A revoked one before sessions are opened anew; a node that is not named ever."""
    one, other, fleet = sealed
    assert fleet.security is not None
    back = ChangeFleet(document=Document(text=Text("fleet: f\n")))

    def order() -> object:
        answers: list[object] = []
        asking = threading.Thread(target=lambda: answers.append(other.bus.ask_node("robot1", back, 60.0)))
        asking.start()
        until(lambda: answers or one.of(ev.FleetCommanded), "the order, or that it is refused")
        for event in one.of(ev.FleetCommanded):
            one.bus.answer(event.request, RESULT)
        asking.join(60)
        return answers[0]

    assert order() == RESULT
    one.events.clear()
    security = replace(fleet.security, **by)
    one.bus.take_orders_of(orderers_of(fleet, security))
    assert order() == CommandResult(outcome=CommandOutcome.INVALID, detail="robot1 refused it: signer")
    until(lambda: one.of(ev.FrameDropped), "that the frame is counted, behind the answer")
    assert one.of(ev.FrameDropped) == [ev.FrameDropped(kind="command", reason="signer")]
    assert not one.of(ev.FleetCommanded)
    assert not one.of(ev.Commanded)
    one.bus.take_orders_of(orderers_of(fleet, fleet.security))
    assert order() == RESULT, "somebody else has taken it back"


@pytest.mark.parametrize(("node", "is_there"), [("ghost", False), ("b", True)])
def test_operator_hears_that_a_node_does_not_answer_and_whether_it_may_have_taken_the_order(
    mesh: tuple[Peer, Peer, Peer], node: str, *, is_there: bool
) -> None:
    within_s = 0.5 if is_there else 30.0  # where nobody is, zenoh ends the question at once
    with pytest.raises(AdapterError, match=f"{node} did not answer within {within_s:g} s") as silent:
        mesh[0].bus.ask_node(node, COMMAND, within_s)
    assert isinstance(silent.value.__cause__, TimeoutError) == is_there
    assert bool(mesh[1].of(ev.TuneCommanded)) == is_there


def test_answer_in_another_s_name_is_foreign(mesh: tuple[Peer, Peer, Peer]) -> None:
    a, b, _ = mesh

    def dropped() -> tuple[str, str]:
        frame = a.next(ev.FrameDropped)
        return frame.kind, frame.reason

    a.bus.ask_utilities(1, 1.0)
    b.bus.answer(b.next(ev.UtilityAsked).request, Utilities(voter="c", vectors=()))
    assert dropped() == ("utility", "foreign")
    a.bus.ask_learnt("b", 1.0)
    b.bus.answer(b.next(ev.LearntAsked).request, LEARNT)
    assert dropped() == ("allocation", "foreign")
    a.bus.ask_electors(PREPARE, 1.0)
    b.bus.answer(b.next(ev.PrepareAsked).request, Promise(elector="c", task="merge", ballot=BALLOT))
    assert dropped() == ("register", "foreign")


def test_answer_of_another_kind_is_dropped(mesh: tuple[Peer, Peer, Peer]) -> None:
    a, b, _ = mesh
    a.bus.ask_learnt("b", 1.0)
    b.bus.answer(b.next(ev.LearntAsked).request, RESULT)
    frame = a.next(ev.FrameDropped)
    assert (frame.kind, frame.reason) == ("allocation", "kind")


@pytest.mark.parametrize(
    ("key", "payload", "dropped"),
    [
        ("register/b/x", b"garbage", ("register", "garbage")),
        ("register/b/x", None, ("register", "garbage")),
        ("register/b/x", wire.encode(BEAT), ("register", "kind")),
        ("command/b/x", wire.encode(RESULT), ("command", "kind")),
        ("command/b/x", b"\x00" * 300_000, ("command", "size")),
        ("made-up/b/x", None, ("key", "key")),
        ("utility/b/No.Name", None, ("utility", "key")),
    ],
)
def test_bad_question_is_dropped_at_once_with_its_reason(
    mesh: tuple[Peer, Peer, Peer],
    stranger: zenoh.Session,
    key: str,
    payload: bytes | None,
    dropped: tuple[str, str],
) -> None:
    """The asker is not left to its timeout, and no name of its choice becomes a counter."""
    _, b, _ = mesh
    start = time.monotonic()
    assert list(stranger.get(f"@zsched/f/{key}", payload=payload, timeout=90.0)) == []
    assert time.monotonic() - start < 60.0
    frame = b.next(ev.FrameDropped)
    assert (frame.kind, frame.reason) == dropped
    assert b.events == []


def test_question_is_answered_once_and_late_answers_are_harmless(
    mesh: tuple[Peer, Peer, Peer], stranger: zenoh.Session
) -> None:
    _, b, _ = mesh
    replies = stranger.get("@zsched/f/allocation/b/x", timeout=60.0)
    number = b.next(ev.LearntAsked).request
    b.bus.answer(number, LEARNT)
    b.bus.answer(number, LEARNT)
    b.bus.answer(number + 1000, LEARNT)
    assert len(list(replies)) == 1
    late = stranger.get("@zsched/f/allocation/b/x", timeout=0.1)
    number = b.next(ev.LearntAsked).request
    assert all(reply.ok is None for reply in late)
    b.bus.answer(number, LEARNT)


class Query:
    """Stands for a zenoh query: whether it was let go."""

    def __init__(self) -> None:
        self.is_dropped = False

    def drop(self) -> None:
        self.is_dropped = True


def test_open_questions_are_bounded_in_number_and_age(monkeypatch: pytest.MonkeyPatch) -> None:
    now = 100.0
    monkeypatch.setattr(open_questions, "monotonic_s", lambda: now)
    questions: Any = Questions()
    queries = [Query() for _ in range(open_questions.MAX_QUESTIONS + 10)]
    for query in queries:
        questions.keep(query, "key")
    assert [query.is_dropped for query in queries] == [True] * 10 + [False] * open_questions.MAX_QUESTIONS
    order = Query()
    questions.keep(order, "key", control_bus.COMMAND_TTL_S)
    now += open_questions.QUESTION_TTL_S + 0.1
    questions.keep(Query(), "key")
    assert all(query.is_dropped for query in queries)
    assert len(questions._open) == 2
    now += MOST_ORDER_S - open_questions.QUESTION_TTL_S
    questions.keep(Query(), "key")
    assert not order.is_dropped, "somebody may still wait for its end"
    now += 2 * open_questions.QUESTION_TTL_S
    questions.keep(Query(), "key")
    assert order.is_dropped
