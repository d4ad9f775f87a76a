"""Nothing durable happens on a frame whose seal is not right: no file of the state folder changes, a counter rises.

The control session, the core and the files on disk are those of a daemon. The same frame with the right seal changes
the state folder: what is looked at is what would change.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from random import Random
from typing import Any, Self, cast

import pytest
import zenoh

from support.authorities import install, make_authority
from support.ballots import ballot_of
from support.fleets import fleet_of, task_of, tuning_of
from support.proposals import proposal_of
from support.states import state_of
from support.waiting import free_endpoint, until
from zsched.core.electorate.changes import AdoptDocument
from zsched.core.electorate.founding import founded
from zsched.core.node.node import Node
from zsched.core.values import codec as wire
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.certificates import Role
from zsched.core.values.fleet import Fleet, Security, electorate_hash
from zsched.core.values.in_force import InForce
from zsched.core.values.messages import (
    Accept,
    Accepted,
    Ballots,
    ChangeFleet,
    FleetQuestion,
    Learnt,
    Prepare,
    Promise,
    TuneTask,
    fleet_answer,
    fleet_question,
)
from zsched.core.values.model import Acceptance, Allocation, Asked, RegisterState
from zsched.host.clock import monotonic_s
from zsched.host.decision_log import DecisionLog
from zsched.host.state_file import StateFile
from zsched.link.bus.control_bus import ControlBus
from zsched.link.bus.sealing import seals_of
from zsched.link.bus.seals import Seals
from zsched.link.keyspace import Keyspace
from zsched.link.seal import Act
from zsched.link.sessions.config import control_config
from zsched.runtime.desk import LOCAL_REQUESTS_FROM, Desk
from zsched.runtime.inbox import Inbox
from zsched.runtime.library import Library
from zsched.runtime.shell import Shell

pytestmark = pytest.mark.long
NODES = ("edge1", "edge2", "robot1", "robot2", "robot3")
ROBOTS = NODES[2:]
FLEET = fleet_of(task_of(candidates=("edge1", "edge2"), tuning=tuning_of()), of=NODES)
FLEET = replace(FLEET, timing=replace(FLEET.timing, gather_s=0.05))
KEYS = Keyspace(FLEET.name)
LIFE = 7
VALUE = Allocation(task="merge", revision=5, epoch=3, owner="edge1", tuning=tuning_of())
NEWER = replace(VALUE, revision=6, epoch=4, owner="edge2")
BALLOT = ballot_of(50, node="robot2")
FIRST = founded(FLEET.name, 0, ROBOTS)
ADOPTED = AdoptDocument(base_revision=1, document="0d", tasks=(("merge", False),), lease_s=1.0).apply(FIRST)
SETTLED = replace(ADOPTED, settled=True)
ELECTORATE = electorate_hash(FLEET)
UNDER: dict[str, Any] = {"electorate": ELECTORATE, "generation_id": FIRST.generation_id, "number": FIRST.number}
WEIGHTS = TuneTask(task="merge", tuning=tuning_of(1.0, 0.0), base_revision=VALUE.revision, asked=Asked(by="bob@robot1"))
REMOVAL = ChangeFleet(remove_elector="robot3", asked=Asked(by="ada@edge1"))

QUIET_S, QUIET_TURNS = 0.5, 8
"""What a frame does it does within some milliseconds, a proposal when its vote has ended, in 0.2 s."""
TRIES, TRY_S = 6, 10.0

PREPARE = Prepare(task="merge", ballot=BALLOT, **UNDER)
ACCEPT = Accept(task="merge", acceptance=Acceptance(ballot=BALLOT, value=NEWER), **UNDER)
FLEET_PREPARE = Prepare(task=FLEET.name, ballot=BALLOT, **UNDER)
FLEET_ACCEPT = Accept(task=FLEET.name, acceptance=Acceptance(ballot=BALLOT, value=ADOPTED), **UNDER)
PUTS: dict[str, tuple[str, object]] = {
    "proposal": (KEYS.proposal("robot2"), proposal_of("robot2", "edge2", base_revision=5)),
    "learnt value": (KEYS.allocation("robot2"), Learnt(node="robot2", values=(NEWER,))),
    "learnt fleet value": (KEYS.allocation("robot2"), Learnt(node="robot2", values=(), fleet=ADOPTED)),
}
QUESTIONS: dict[str, tuple[str, object]] = {
    "prepare": (KEYS.register("*", "robot2"), PREPARE),
    "accept": (KEYS.register("*", "robot2"), ACCEPT),
    "ballots": (KEYS.register("*", "robot2"), Ballots(prepares=(PREPARE,), accepts=(ACCEPT,))),
    "prepare of the fleet": (KEYS.register("*", "robot2"), fleet_question(FLEET_PREPARE)),
    "accept of the fleet": (KEYS.register("*", "robot2"), fleet_question(FLEET_ACCEPT)),
    "command": (KEYS.command("robot1", "ana"), WEIGHTS),
}


class Silent:
    """Stands for the relay's handle and the supervisor: no task of this node is worked on."""

    def __getattr__(self, name: str) -> Callable[..., None]:
        return lambda *_arguments, **_options: None


class Machine:
    """One node's session, core and state folder, as a daemon has them."""

    def __init__(self, folder: Path, pki: Path, me: str, *, is_agreed: bool = False) -> None:
        """With ``is_agreed`` it goes by a document."""
        self.folder, self.endpoint = folder, free_endpoint()
        fleet = secured(pki / me)
        inbox = self.inbox = Inbox()
        self._file = StateFile(folder, fleet=FLEET.name, node=me, hardware="")
        self._file.acquire()
        register = RegisterState(task="merge", learnt=VALUE)
        of_fleet = RegisterState(task=FLEET.name, learnt=SETTLED) if is_agreed else None
        durable = state_of(
            me, register, electorate=ELECTORATE, disk="d1", incarnation=LIFE, fleet_register=of_fleet, lease_s=1.0
        )
        self._file.save(durable)
        self.bus = ControlBus(
            fleet=FLEET.name,
            node=me,
            incarnation=LIFE,
            zenoh_config=control_config(listen=(self.endpoint,), connect=(), timing=FLEET.timing),
            post=inbox.post,
            seals=seals_of(fleet, LIFE),
        )
        self.shell = Shell(
            node=me, inbox=inbox, bus=self.bus, state_file=self._file, desk=Desk(me, inbox, self.bus, InForce(fleet))
        )
        self.shell.relay = self.shell.crew.supervisor = cast("Any", Silent())
        self._log = self.shell.log = DecisionLog(folder, me, LIFE, lambda _problem: None)
        library = self.shell.library = Library(
            fleet=FLEET.name, node=me, config=folder / "fleet.yaml", state_dir=folder, post=inbox.post
        )
        self._library = library
        self.node = Node(
            fleet=fleet,
            me=me,
            durable=durable,
            incarnation=LIFE,
            electorate=ELECTORATE,
            rng=Random(1),
            now=monotonic_s(),
            stored={"0d": fleet},
        )
        self._is_over = threading.Event()
        self._turns = 0
        self._thread = threading.Thread(target=self._loop, daemon=True)

    def __enter__(self) -> Self:
        self.bus.open()
        self._log.start()
        self._library.start()
        self._thread.start()
        for name in NODES:  # a starting elector asks all others what they remember of it
            if name != self.node.me:
                self.inbox.post(ev.LearntReceived(learnt=Learnt(node=name, values=()), is_answer=True))
        return self

    def __exit__(self, *_: object) -> None:
        self._is_over.set()
        self._thread.join(10.0)
        self.bus.close()
        self._library.close()
        self._log.close()
        self._file.release()

    def _loop(self) -> None:
        self.shell.carry_out(self.node.start(monotonic_s()))
        while not self._is_over.is_set():
            wait = min(self.node.next_deadline() - monotonic_s(), 0.05)
            event = self.inbox.take(max(wait, 0.0)) or ev.DeadlineReached()
            self._turns += 1
            for one in (*self.shell.waiting_frames(), event):
                self.shell.carry_out(self.node.handle(one, monotonic_s()))

    def files(self) -> dict[str, tuple[int, bytes]]:
        """{file: (when it was written, what is in it)} of the state folder.

        A file that is replaced under its final name while it is read is looked for once more.
        """
        found = sorted(path for path in self.folder.rglob("*") if path.is_file())
        try:
            return {str(path.relative_to(self.folder)): (path.stat().st_mtime_ns, path.read_bytes()) for path in found}
        except FileNotFoundError:
            return self.files()

    def at_rest(self) -> dict[str, tuple[int, bytes]]:
        """The files, once nothing has changed them for a while; no write is under way then, however slow the disk."""
        while True:
            before = self.files()
            self.is_quiet()
            if self.files() == before and not any(name.endswith(".new") for name in before):
                return before

    def is_quiet(self) -> None:
        """Wait for as long as the loop needs to do what there is; on a busy machine that is longer."""
        turns = self._turns
        time.sleep(QUIET_S)
        until(lambda: self._turns >= turns + QUIET_TURNS, "turns of the loop")

    def refusals(self) -> int:
        """How many frames were dropped."""
        return sum(count for name, count in self.node.counters.copy().items() if name.startswith("dropped_"))

    def await_refusals(self, count: int) -> None:
        until(lambda: self.refusals() >= count, f"{count} refusals: {self.node.counters}")

    def refuses(self, say: Callable[[], None]) -> None:
        """Somebody says what is dropped; once more where it went with a link that a busy machine has lost."""
        before = self.refusals()
        for _ in range(TRIES):
            say()
            with contextlib.suppress(AssertionError):
                until(lambda: self.refusals() > before, "a refusal", TRY_S)
                return
        raise AssertionError(f"nothing was refused: {self.node.counters}")


def secured(folder: Path) -> Fleet:
    """The fleet as the holder of the certificate in a folder has it."""
    return replace(FLEET, security=Security(folder=str(folder), operators=("ana",), guests=("screen",)))


@pytest.fixture(scope="module")
def pki(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("pki")
    authority = make_authority(place / "authority", FLEET.name)
    for name in NODES:
        install(authority, place / name, name)
    install(authority, place / "ana", "ana", Role.OPERATOR)
    install(authority, place / "screen", "screen", Role.GUEST)
    foreign = make_authority(place / "foreign", FLEET.name)
    install(foreign, place / "false robot1", "robot1")
    install(foreign, place / "false robot2", "robot2")
    install(foreign, place / "false ana", "ana", Role.OPERATOR)
    return place


@pytest.fixture
def machine(tmp_path: Path, pki: Path, request: pytest.FixtureRequest) -> Iterator[Machine]:
    me, is_agreed = getattr(request, "param", ("robot1", False))
    with Machine(tmp_path / "state", pki, me, is_agreed=is_agreed) as made:
        yield made


@pytest.fixture
def session(machine: Machine) -> Iterator[zenoh.Session]:
    """Somebody on the same network, who says what it likes."""
    config = control_config(listen=(free_endpoint(),), connect=(machine.endpoint,), timing=FLEET.timing)
    with zenoh.open(zenoh.Config.from_json5(config)) as opened:
        until(lambda: machine.bus.peers() == 1, "a link")
        yield opened


def of(pki: Path, holder: str) -> Seals:
    made = seals_of(secured(pki / holder), 1)
    assert made is not None
    return made


Seal = Callable[[Act, str, bytes, bytes], bytes]
"""(what is done, its key, the frame, the attachment of the question that is answered): the frame's attachment."""


def forgeries(pki: Path, name: str) -> dict[str, Seal]:
    """How a frame in the name of ``name`` is not to be sealed."""
    own, member, guest, foreign = (of(pki, holder) for holder in (name, "robot3", "screen", f"false {name}"))

    def by(seals: Seals) -> Seal:
        return lambda act, key, frame, question: seals.seal(act, key, frame, question=question, life=LIFE)

    return {
        "unsigned": lambda _act, _key, _frame, _question: b"",
        "signature": lambda act, key, frame, question: by(own)(act, key, frame + b"x", question),
        "another key": lambda act, key, frame, question: by(own)(act, f"{key}x", frame, question),
        "another act": lambda act, key, frame, question: by(own)(
            Act.ANSWER if act is Act.PUT else Act.PUT, key, frame, question
        ),
        "of another member": by(member),
        "of a guest": by(guest),
        "of another authority": by(foreign),
        "no seal at all": lambda _act, _key, _frame, _question: b"nonsense",
    }


def rightly(pki: Path, name: str) -> Seal:
    own = of(pki, name)
    return lambda act, key, frame, question: own.seal(act, key, frame, question=question, life=LIFE)


def send(session: zenoh.Session, act: Act, key: str, frame: bytes, seal: bytes) -> None:
    if act is Act.PUT:
        session.put(key, frame, attachment=seal or None)
    else:
        session.get(key, lambda _reply: None, payload=frame, attachment=seal or None, timeout=1.0)


def answering(session: zenoh.Session, pki: Path, told: Learnt) -> None:
    """Tell robot1 what robot2 has learnt, rightly sealed, once it asks."""
    key, frame, seal = KEYS.learnt("robot2", "robot1"), wire.encode(told), rightly(pki, "robot2")

    def answer(query: zenoh.Query) -> None:
        assert query.attachment is not None
        query.reply(key, frame, attachment=seal(Act.ANSWER, key, frame, query.attachment.to_bytes()))

    session.declare_queryable(key, answer)


@pytest.mark.parametrize("kind", [*PUTS, *QUESTIONS])
def test_what_comes_with_a_wrong_seal_leaves_nothing_on_disk_and_with_the_right_one_it_does(
    kind: str, machine: Machine, session: zenoh.Session, pki: Path
) -> None:
    act = Act.PUT if kind in PUTS else Act.QUESTION
    key, value = {**PUTS, **QUESTIONS}[kind]
    frame, name = wire.encode(value), "ana" if kind == "command" else "robot2"
    before = machine.at_rest()
    if isinstance(value, Learnt):  # it leads to a question only, whose answer is believed
        answering(session, pki, value)
    for seal in forgeries(pki, name).values():
        machine.refuses(partial(send, session, act, key, frame, seal(act, key, frame, b"")))
    machine.is_quiet()
    assert machine.files() == before
    send(session, act, key, frame, rightly(pki, name)(act, key, frame, b""))
    until(lambda: machine.files() != before, "the frame with its right seal on disk")


def test_a_command_for_another_life_or_said_once_more_leaves_nothing_on_disk(
    machine: Machine, session: zenoh.Session, pki: Path
) -> None:
    ana, key, frame = of(pki, "ana"), KEYS.command("robot1", "ana"), wire.encode(WEIGHTS)
    first = ana.seal(Act.QUESTION, key, frame, life=LIFE)
    send(session, Act.QUESTION, key, frame, first)
    said = b"TuneTask came, signed by ana.operator"
    until(lambda: said in machine.files().get("decisions.ndjson", (0, b""))[1], "the command")
    register = machine.node.registers["merge"]
    until(lambda: register.state.promised.counter > 0 and not register.is_busy, "its end: nobody answers its ballots")
    before = machine.at_rest()
    for seal in (first, ana.seal(Act.QUESTION, key, frame, life=LIFE - 1)):
        send(session, Act.QUESTION, key, frame, seal)
    until(lambda: {"dropped_command_replay", "dropped_command_stale"} <= set(machine.node.counters), "both refused")
    machine.is_quiet()
    assert machine.files() == before


# --- answers ---------------------------------------------------------------------------------------------------------


class Electors:
    """Two electors at one session: they have what was chosen, say yes to everything, and seal it as they are told."""

    def __init__(self, session: zenoh.Session, pki: Path) -> None:
        self.seals: dict[type, str] = {}
        """{kind of answer: how it is not sealed}."""
        self.asked: list[type] = []
        self._right = {name: rightly(pki, name) for name in ("robot1", "robot2")}
        self._wrong = {name: forgeries(pki, name) for name in ("robot1", "robot2")}
        self._queryables = [
            session.declare_queryable(KEYS.register(name, "*"), partial(self._answer, name)) for name in self._right
        ]

    def _answer(self, name: str, query: zenoh.Query) -> None:
        assert query.payload is not None
        assert query.attachment is not None, "a question is sealed"
        asked: Any = wire.decode(query.payload.to_bytes(), Prepare, Accept, FleetQuestion)
        question, chosen = (asked.content, SETTLED) if isinstance(asked, FleetQuestion) else (asked, VALUE)
        answer: Any
        if isinstance(question, Prepare):
            held: Acceptance[Any] = Acceptance(ballot=ballot_of(), value=chosen)
            answer = Promise(elector=name, task=question.task, ballot=question.ballot, accepted=held)
        else:
            answer = Accepted(elector=name, task=question.task, ballot=question.acceptance.ballot)
        key = KEYS.register(name, str(query.key_expr).rpartition("/")[2])
        frame = wire.encode(fleet_answer(answer) if isinstance(asked, FleetQuestion) else answer)
        how = self.seals.get(type(answer))
        seal = self._right[name] if how is None else self._wrong[name][how]
        query.reply(key, frame, attachment=seal(Act.ANSWER, key, frame, query.attachment.to_bytes()) or None)
        self.asked.append(type(answer))


@pytest.mark.parametrize(
    ("machine", "order"),
    [(("edge1", False), WEIGHTS), (("edge1", True), REMOVAL)],
    indirect=["machine"],
    ids=["a task's register", "the fleet's register"],
)
@pytest.mark.parametrize("kind", [Promise, Accepted])
def test_votes_with_wrong_seals_leave_nothing_on_disk_and_with_right_ones_they_do(
    kind: type, order: TuneTask | ChangeFleet, machine: Machine, session: zenoh.Session, pki: Path
) -> None:
    """The node asks for its own user, and is no elector: nothing of its own round is on its disk.

    That a change of the fleet has failed stands in its decision log, so that is left out.
    """

    def without_log(files: dict[str, tuple[int, bytes]]) -> dict[str, tuple[int, bytes]]:
        return {name: held for name, held in files.items() if not name.startswith("decisions")}

    electors = Electors(session, pki)
    before = without_log(machine.at_rest())
    ask = ev.commanded(LOCAL_REQUESTS_FROM, order)
    for how in forgeries(pki, "robot1"):
        electors.seals[kind] = how
        refused = machine.refusals()
        machine.inbox.post(ask)
        machine.await_refusals(refused + 2)
        machine.is_quiet()
        assert without_log(machine.files()) == before, how
    assert kind in electors.asked
    electors.seals.clear()
    machine.inbox.post(ask)
    until(lambda: without_log(machine.files()) != before, "what right votes have chosen on disk")


@pytest.mark.parametrize("kind", ["a value", "the fleet's value"])
def test_learnt_values_in_answers_with_wrong_seals_leave_nothing_on_disk(
    kind: str, machine: Machine, session: zenoh.Session, pki: Path
) -> None:
    told = Learnt(node="robot2", values=(NEWER,)) if kind == "a value" else PUTS["learnt fleet value"][1]
    key, frame = KEYS.learnt("robot2", "robot1"), wire.encode(told)
    how: list[Seal] = []

    def answer(query: zenoh.Query) -> None:
        assert query.attachment is not None, "a question has a number of its own"
        seal = how[-1](Act.ANSWER, key, frame, query.attachment.to_bytes())
        query.reply(key, frame, attachment=seal or None)

    queryable = session.declare_queryable(key, answer)
    before, refused = machine.at_rest(), machine.refusals()
    for number, seal in enumerate(forgeries(pki, "robot2").values(), start=1):
        how.append(seal)
        machine.shell.carry_out((do.AskLearnt(peer="robot2", deadline_s=2.0),))
        machine.await_refusals(refused + number)
    machine.is_quiet()
    assert machine.files() == before
    how.append(rightly(pki, "robot2"))
    machine.shell.carry_out((do.AskLearnt(peer="robot2", deadline_s=2.0),))
    until(lambda: machine.files() != before, "what was learnt on disk")
    queryable.undeclare()
