"""Whoever sits on a member's link says again, word for word, what that member has said: nothing changes.

A router or a gateway in between is let in with the member's link and has everything that went by, seals and source
numbers included. It goes by no access rules of its own here. What one member says again under another's key does not
pass zenoh's rules (`tests/integration/test_attacks.py`). The task has moved to the other edge and back before, so that
what is said again is of former epochs, too.
"""

from __future__ import annotations

import contextlib
import threading
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import pytest
import zenoh

from support.authorities import secured
from support.operators import Operator, Stream
from zsched.core.values import codec as wire
from zsched.core.values.messages import (
    COMMANDS,
    Accept,
    Accepted,
    Ballots,
    CommandOutcome,
    CommandResult,
    FleetAnswer,
    FleetQuestion,
    Prepare,
    Promise,
    Refused,
)
from zsched.host.operator_client import ask
from zsched.link.keyspace import Keyspace
from zsched.link.sessions.access_rules import Side
from zsched_lab.fleet.loopback import free_endpoint
from zsched_lab.fleet.secured import without_rules
from zsched_lab.fleet.testbed import TASK, Json, Testbed, echo_fleet

pytestmark = pytest.mark.long

KEYS = Keyspace("testbed")
TIMES = 20
"""So often each frame is said again."""
ANSWER_S = 2.0
REMOTE = zenoh.Locality.REMOTE


@dataclass(frozen=True)
class Question:
    """A question as it went by."""

    key: str
    frame: bytes
    seal: bytes | None

    def ask(self, session: zenoh.Session) -> list[zenoh.Sample]:
        """The answers to the same words."""
        replies = session.get(
            self.key,
            payload=self.frame,
            attachment=self.seal,
            timeout=ANSWER_S,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            allowed_destination=REMOTE,
        )
        return [reply.ok for reply in replies if reply.ok is not None]


def content_of(frame: bytes) -> Any:
    """What a frame of a register says, also of the fleet's."""
    value: Any = wire.decode(
        frame, Prepare, Accept, Promise, Accepted, Refused, FleetQuestion, FleetAnswer, Ballots, *COMMANDS
    )
    return value.content if isinstance(value, FleetQuestion | FleetAnswer) else value


@dataclass
class Middle:
    """Sessions with members' certificates on members' links, and all that went by there."""

    bed: Testbed
    stack: contextlib.ExitStack
    said: defaultdict[str, list[zenoh.Sample]] = field(default_factory=lambda: defaultdict(list))
    """{key: what was put}."""
    asked: list[Question] = field(default_factory=list)
    old_answers: dict[str, tuple[bytes, bytes]] = field(default_factory=dict)
    """{kind of a question: an answer of robot2 to a former one, with its seal}: told whenever robot1 asks."""
    links: dict[str, zenoh.Session] = field(default_factory=dict)

    def open(self) -> None:
        """As robot2 at robot1, as robot1 at robot2, and as robot1 and edge1 among relays and workers."""
        self.links["robot2"] = as_robot2 = self._link("robot2", Side.CONTROL, "robot1")
        self.links["robot1"] = as_robot1 = self._link("robot1", Side.CONTROL, "robot2")
        self._keep(as_robot1, "@zsched/testbed/*/robot2", "@zsched/testbed/*/robot2/in/turn")
        for node, session in self.links.items():
            for kind in ("register", "allocation"):
                session.declare_queryable(f"@zsched/testbed/{kind}/{node}/*", self._hear)
        # a complete one is asked instead of robot2
        as_robot2.declare_queryable("@zsched/testbed/command/robot2/*", self._pass_on, complete=True)
        relays = [node for node in self.bed.names if self.bed.fleet.node(node).listen_data]
        for holder in ("robot1", "edge1"):
            self.links[f"data of {holder}"] = session = self._link(holder, Side.DATA, *relays)
        self._keep(session, "**", "@zsched/testbed/**", "**/@zsched/**")

    def _link(self, holder: str, side: Side, *to: str) -> zenoh.Session:
        """A session with the certificate of ``holder``; workers dial one of the data network."""
        listen = () if side is Side.CONTROL else (free_endpoint().partition("#")[0].replace("tcp/", "tls/"),)
        text = without_rules(self.bed, holder, side, to=to, listen=listen)
        return self.stack.enter_context(zenoh.open(zenoh.Config.from_json5(text)))

    def _keep(self, session: zenoh.Session, *keys: str) -> None:
        for key in keys:
            session.declare_subscriber(key, lambda one: self.said[str(one.key_expr)].append(one), allowed_origin=REMOTE)

    def _note(self, query: zenoh.Query) -> Question:
        frame = b"" if query.payload is None else query.payload.to_bytes()
        seal = None if query.attachment is None else query.attachment.to_bytes()
        self.asked.append(Question(str(query.key_expr), frame, seal))
        return self.asked[-1]

    def _hear(self, query: zenoh.Query) -> None:
        kind, _, asker = self._note(query).key.split("/")[2:]
        with query:
            if kind in self.old_answers and asker == "robot1":
                answer, seal = self.old_answers[kind]
                query.reply(f"@zsched/testbed/{kind}/robot2/robot1", answer, attachment=seal)

    def _pass_on(self, query: zenoh.Query) -> None:
        question = self._note(query)

        def run() -> None:  # not in zenoh's thread
            with query:
                for answer in question.ask(self.links["robot1"]):
                    query.reply(answer.key_expr, answer.payload)

        threading.Thread(target=run, daemon=True).start()

    def question(self, kind: str, asker: str, *classes: type[Any]) -> Question | None:
        """The oldest question of a kind that has gone by."""
        for one in tuple(self.asked):
            chunks = one.key.split("/")
            if chunks[2] == kind and chunks[4] == asker and (not classes or isinstance(content_of(one.frame), classes)):
                return one
        return None

    def first(self, start: str, end: str) -> zenoh.Sample | None:
        """The oldest put under a key that begins and ends so."""
        return next(
            (samples[0] for key, samples in sorted(self.said.items()) if key.startswith(start) and key.endswith(end)),
            None,
        )


def say_again(session: zenoh.Session, sample: zenoh.Sample | None) -> None:
    """As it was: key, frame, seal, and source with its number."""
    assert sample is not None
    for _ in range(TIMES):
        session.put(
            str(sample.key_expr),
            sample.payload.to_bytes(),
            attachment=sample.attachment,
            encoding=sample.encoding,
            timestamp=sample.timestamp,
            source_info=sample.source_info,
            congestion_control=zenoh.CongestionControl.BLOCK,
        )


def counters(bed: Testbed, node: str) -> dict[str, int]:
    found: dict[str, int] = bed.status(node)["counters"]
    return found


def state(bed: Testbed) -> Json:
    """All that must not change, as both robots see it."""
    return {
        node: {
            "task": {key: status["tasks"][0][key] for key in ("owner", "epoch", "revision", "tuning")},
            "is paused": status["tasks"][0]["pause"] is not None,
            "nodes": [(one["name"], one["state"], one["incarnation"]) for one in status["nodes"]],
            "fleet": status["fleet_revision"],
        }
        for node in ("robot1", "robot2")
        for status in [bed.status(node)]
    }


@dataclass
class Scene:
    """The fleet, who sits in between, and an application's stream."""

    bed: Testbed
    middle: Middle
    operator: Operator
    stream: Stream

    def goes_on(self) -> None:
        """What is sent from now on comes back, and what came back came once and in order."""
        sent = self.stream.sent
        self.bed.wait(lambda: bool(self.stream.back) and self.stream.back[-1] > sent + 50, 60, "the stream to go on")
        back = list(self.stream.back)
        came = Counter(back)
        wrong = {number: came[number] for number in range(max(back)) if came[number] != 1}
        assert wrong == {}, f"answers that came not once: {wrong} of {self.stream.sent}"

    def turns(self, task_weights: float, robot: str) -> None:
        """Change a weight at a robot: it asks the electors, and tells everybody."""
        wanted = (f"cpu={task_weights}", f"memory={1 - task_weights}")
        self.operator.done("tune", TASK, *wanted, "--yes", "--node", robot)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    folder = tmp_path_factory.mktemp("replays")
    tree = echo_fleet(robots=2, edges=2, stream_class="reliable")
    tree["tasks"][TASK]["outputs"][0]["handover"] = "all"
    del tree["nodes"]["robot2"]["listen"]["data"]  # so workers dial by gossip: also who sits in between
    with Testbed(folder, secured(tree, folder)) as bed, contextlib.ExitStack() as stack:
        bed.init()
        bed.start()
        middle = Middle(bed, stack)
        middle.open()
        bed.wait_settled(90)
        (folder / "alone").mkdir()
        (folder / "alone" / "robot1.sock").symlink_to(folder / "robot1.sock")
        operator = Operator(bed, folder / "alone")  # so what robot2 shall do, robot1 tells it
        operator.done("pause", TASK, "--yes")
        access = ask(folder / "robot1.sock", {"verb": "access", "node": "robot1"}, 5.0)
        session = stack.enter_context(zenoh.open(zenoh.Config.from_json5(access["sides"]["fleet"])))
        made = Scene(bed, middle, operator, Stream(session))
        stack.callback(made.stream.end)
        made.stream.start()
        bed.wait(lambda: made.stream.back, 60, "the first answer")
        for edge in ("edge2", "edge1", "edge2", "edge1"):
            operator.done("move", TASK, edge, "--yes")
        for number, robot in enumerate(("robot1", "robot2") * 2):
            made.turns(0.25 + number / 8, robot)
        operator.done("apply", bed.file, "--yes")  # the fleet's register is asked, too
        operator.done("drain", "edge2", "--yes", "--node", "robot2")
        operator.done("undrain", "edge2", "--yes", "--node", "robot2")
        yield made


# --- puts of the control network -------------------------------------------------------------------------------------

PUTS = {
    "beat": None,
    "profile": None,
    "proposal": "dropped_proposal_replay",
    "allocation": "dropped_allocation_replay",
}
"""{kind: the counter of what is refused by its seal}. The others are unsigned, and judged by their numbers."""


@pytest.mark.parametrize("kind", PUTS)
def test_what_a_robot_has_put_is_put_again(scene: Scene, kind: str) -> None:
    bed, link = scene.bed, scene.middle.links["robot2"]
    old = bed.wait(lambda: scene.middle.first(f"@zsched/testbed/{kind}/robot2", ""), 60, f"a {kind} of robot2")
    before, counted = state(bed), counters(bed, "robot1")
    say_again(link, old)
    link.put(KEYS.proposal("robot2"), b"", congestion_control=zenoh.CongestionControl.BLOCK)  # behind them
    behind = "dropped_proposal_unsigned"
    bed.wait(lambda: counters(bed, "robot1").get(behind, 0) > counted.get(behind, 0), 60, "the frame behind them")
    if (counter := PUTS[kind]) is not None:
        assert counters(bed, "robot1")[counter] >= counted.get(counter, 0) + TIMES
    scene.goes_on()
    assert state(bed) == before


# --- questions and answers of votes ----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [Prepare, Accept])
def test_what_a_robot_has_asked_an_elector_is_asked_again(scene: Scene, kind: type[Any]) -> None:
    """A former round's question, with its seal: the ballot is too low."""
    link, before = scene.middle.links["robot2"], state(scene.bed)
    question = scene.middle.question("register", "robot2", kind)
    assert question is not None, f"no {kind.__name__} of robot2 has gone by"
    for _ in range(TIMES):
        answers = question.ask(link)
        assert {type(content_of(answer.payload.to_bytes())) for answer in answers} == {Refused}
    scene.goes_on()
    assert state(scene.bed) == before


ANSWERS = {
    "promise or acceptance": ("register", (Prepare, Accept), "dropped_register_signature"),
    "learnt values": ("allocation", (), "dropped_allocation_signature"),
}


@pytest.mark.parametrize("what", ANSWERS)
def test_what_an_elector_has_answered_is_answered_again(scene: Scene, what: str) -> None:
    """A former answer to today's question: it is sealed together with another question."""
    kind, classes, counter = ANSWERS[what]
    bed, middle = scene.bed, scene.middle
    question = middle.question(kind, "robot1", *classes)
    assert question is not None, f"no question for {what} has gone by"
    own = f"@zsched/testbed/{kind}/robot2/robot1"
    answer = next(one for one in question.ask(middle.links["robot1"]) if str(one.key_expr) == own)
    assert answer.attachment is not None
    middle.old_answers[kind] = answer.payload.to_bytes(), answer.attachment.to_bytes()
    before, counted = state(bed), counters(bed, "robot1").get(counter, 0)
    weights: Iterator[float] = iter(0.25 + number / 64 for number in range(48))

    def refused() -> bool:
        scene.turns(next(weights), "robot1" if kind == "register" else "robot2")
        return counters(bed, "robot1").get(counter, 0) > counted

    try:
        bed.wait(refused, 60, counter)
    finally:
        del middle.old_answers[kind]
    scene.goes_on()
    after = state(bed)
    for node in after.values():
        del node["task"]["revision"], node["task"]["tuning"]
    for node in before.values():
        del node["task"]["revision"], node["task"]["tuning"]
    assert after == before


# --- the data network ------------------------------------------------------------------------------------------------

STREAMS = {
    "role": ("edge1", "@zsched/testbed/role/edge1/", TASK),
    "acknowledgement": ("edge1", "@zsched/testbed/ack/edge1/", ""),
    "trouble and jobs": ("edge1", "@zsched/testbed/trouble/edge1/", ""),
    "answer of a former epoch": ("edge1", "edge1/echo/", "/robot1/out"),
    "end marker of answers": ("edge1", "edge1/echo/", "/robot1/out/@zsched/end"),
    "input": ("robot1", "edge1/echo/robot1/in", "in"),
    "end marker of inputs": ("robot1", "edge1/echo/robot1/in", "/@zsched/end"),
    "acknowledgement of answers": ("robot1", "@zsched/testbed/received/robot1/", ""),
}
"""{what: (whose, how its key begins, and ends)}."""


@pytest.mark.parametrize("what", STREAMS)
def test_what_relays_and_workers_have_said_is_said_again(scene: Scene, what: str) -> None:
    holder, start, end = STREAMS[what]
    bed, link = scene.bed, scene.middle.links[f"data of {holder}"]
    old = bed.wait(lambda: scene.middle.first(start, end), 60, f"{what} of {holder}")
    assert old is not None
    publisher = link.declare_publisher(str(old.key_expr))
    bed.wait(lambda: getattr(publisher.matching_status, "matching", False), 60, f"somebody hears {old.key_expr}")
    publisher.undeclare()
    before = state(bed)
    for _ in range(3):
        say_again(link, old)
        scene.goes_on()
    assert state(bed) == before
    assert bed.unaccounted() == []


# --- commands, and a daemon that has forgotten -----------------------------------------------------------------------


def test_a_command_that_was_given_is_given_again(scene: Scene) -> None:
    """Also to the node's next life, which does not know what the former one has heard."""
    bed, middle = scene.bed, scene.middle
    question = middle.question("command", "robot1")
    assert question is not None, "no command of robot1 to robot2 has gone by"
    before = state(bed)

    def refused_as(word: str) -> bool:
        found = [wire.decode(one.payload.to_bytes(), CommandResult) for one in question.ask(middle.links["robot1"])]
        assert all(one.outcome is CommandOutcome.INVALID for one in found), found
        return any(one.detail.endswith(word) for one in found)

    assert refused_as("replay")
    assert state(bed) == before
    life = before["robot1"]["nodes"][-1]
    assert life[0] == "robot2"
    bed.kill("robot2")
    bed.start("robot2")
    bed.wait_whole()
    bed.wait(lambda: refused_as("stale"), 60, "the next life to refuse it")
    after = state(bed)
    assert after["robot2"]["task"] == before["robot2"]["task"]


def test_a_token_of_a_former_life_is_shown_again(scene: Scene) -> None:
    bed, link = scene.bed, scene.middle.links["robot2"]
    before = state(bed)
    life = next(incarnation for name, _, incarnation in before["robot1"]["nodes"] if name == "robot2")
    for _ in range(3):
        token = link.liveliness().declare_token(KEYS.alive("robot2", life - 1))
        scene.goes_on()
        assert state(bed) == before
        token.undeclare()
        scene.goes_on()
        assert state(bed) == before


def test_a_daemon_that_has_begun_anew_hears_what_was_said_before(scene: Scene) -> None:
    """It has forgotten what it has heard; what is on its disk, and its peers, know better."""
    bed, middle = scene.bed, scene.middle
    old = [middle.first(f"@zsched/testbed/{kind}/robot2", "") for kind in PUTS]
    before = state(bed)
    bed.kill("robot1", with_relay=False)
    bed.start("robot1")
    bed.wait_whole()
    link = middle.links["robot2"]
    bed.wait(link.info.links, 60, "a link to the daemon")
    for sample in old:
        say_again(link, sample)
    scene.goes_on()
    after = state(bed)
    assert {node: seen["task"] for node, seen in after.items()} == {node: seen["task"] for node, seen in before.items()}
    assert {name: word for name, word, _ in after["robot1"]["nodes"]} == dict.fromkeys(bed.names, "alive")
