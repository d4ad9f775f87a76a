"""A table of attacks on real sessions, opened as a secured fleet's daemons and relays open theirs.

The victims are robot1's control session and edge1's data session; both listen to everything. Whoever attacks goes by no
rules of its own. A frame of a member under its own key comes last: what was sent before it has been refused by then.
"""

from __future__ import annotations

import contextlib
import json
import socket
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import zenoh
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from support.authorities import install, make_authority
from support.waiting import free_endpoint, until
from zsched.config.load import check_file
from zsched.core.values import codec as wire
from zsched.core.values import events as ev
from zsched.core.values.certificates import Role
from zsched.core.values.events import RoleEnded
from zsched.core.values.fleet import Fleet, WorkerLink
from zsched.core.values.messages import Learnt, MoveTask
from zsched.core.values.model import Asked
from zsched.link.bus.control_bus import ControlBus
from zsched.link.bus.limits import Limit, limit_for
from zsched.link.keyspace import Keyspace
from zsched.link.sessions import config as zenoh_config
from zsched.link.sessions import expulsion
from zsched.link.sessions.access_rules import Side, common_names_of, names_of
from zsched.link.sessions.expulsion import HOLD_S, MAX_SHOWN, Expulsion, Refusal, members_of
from zsched.link.sessions.tls import session_text
from zsched.pki.authority import Authority
from zsched.relay import tokens

FLEET = """\
fleet: yard
nodes:
  robot1: {kind: robot}
  robot2: {kind: robot}
  robot3: {kind: robot}
  edge1: {kind: edge, host: 192.0.2.1, listen: {control: tls/0.0.0.0:7457, data: tls/0.0.0.0:7458}}
tasks:
  merge:
    candidates: [edge1]
    weights: {cpu: 0.5, memory: 0.5}
    worker: {command: [python]}
    inputs: [{from: "{robot}/in", to: "{target}/merge/{robot}/in"}]
    outputs: [{from: "{target}/merge/{robot}/out", to: "{robot}/out"}]
security: {folder: FOLDER, operators: [ana], guests: [screen], revoked: [robot3]}
"""
KEYS = Keyspace("yard")
REFUSED_S = 0.4
"""Who is let in is so within some milliseconds; zenoh tries again until this time is over."""
ANSWER_S = 0.5
TOKENS = 5000
FLOOD = 60
"""Questions."""
VOTES = {"utility/rate", "register/rate"}
THIN_BYTES_S, LARGE_BYTES = 50_000.0, 16_000
MOST_HELD_UP_S = 1.5
"""Of a put: 0.3 s, and what a busy machine adds."""
SHORT_S = 3
"""So long a certificate lives that shall end: long enough for a handshake on a busy machine."""


@dataclass
class Victim:
    """One session of a member, with all that it hears."""

    session: zenoh.Session
    endpoint: str
    heard: list[str] = field(default_factory=list)
    """Keys of samples."""
    asked: list[str] = field(default_factory=list)
    tokens: list[str] = field(default_factory=list)

    def listen(self) -> None:
        def answer(query: zenoh.Query) -> None:
            self.asked.append(str(query.key_expr))
            with query:
                query.reply(str(query.key_expr), b"secret")

        for key in ("@zsched/yard/**", "**", "*/**/@zsched/**"):
            self.session.declare_subscriber(key, lambda sample: self.heard.append(str(sample.key_expr)))
        for key in ("@zsched/yard/*/robot1/*", "@zsched/yard/snapshot/edge1/*"):
            self.session.declare_queryable(key, answer)
        self.session.liveliness().declare_subscriber(
            "@zsched/yard/**", lambda sample: self.tokens.append(str(sample.key_expr)), history=True
        )

    def links(self) -> set[str]:
        """Certificates at the other ends."""
        return {str(link.auth_identifier) for link in self.session.info.links()}


@dataclass
class Yard:
    """The fleet: its authority, certificates, and the two victims."""

    folder: Path
    authority: Authority
    control: Victim
    data: Victim

    def fleet(self, node: str) -> Fleet:
        """The fleet as a node has it: with its own certificate."""
        (self.folder / "fleet.yaml").write_text(FLEET.replace("FOLDER", node))
        fleet = check_file(self.folder / "fleet.yaml").fleet
        assert fleet is not None
        return fleet

    def text(self, node: str, *, listen: tuple[str, ...] = (), connect: tuple[str, ...] = ()) -> str:
        """The configuration of a node's control session."""
        rules = session_text(self.fleet(node), Side.CONTROL)
        return zenoh_config.control_config(listen=listen, connect=connect, operator_json5=rules)

    def tls(self, holder: str, **more: Any) -> dict[str, Any]:
        """TLS settings of who holds a certificate in a folder, and goes by no rules."""
        folder = self.folder / holder
        files = {"connect_certificate": "certificate.pem", "connect_private_key": "key.pem"}
        own = {name: str(folder / file) for name, file in files.items()}
        trusted = str(self.folder / "robot1" / "ca.pem")
        return {"root_ca_certificate": trusted, "enable_mtls": True, "verify_name_on_connect": False, **own, **more}

    @contextlib.contextmanager
    def session(
        self, victim: Victim, tls: dict[str, Any] | None, *, is_plain: bool = False, connect_s: float = 5.0
    ) -> Iterator[zenoh.Session]:
        """A client's session to a victim.

        Raises:
            zenoh.ZError: it is not let in.
        """
        endpoint = victim.endpoint.replace("tls/", "tcp/") if is_plain else victim.endpoint
        config = json.loads(zenoh_config.client_config(connect=(endpoint,), connect_s=connect_s))
        if tls is not None:
            config["transport"]["link"]["tls"] = tls
        with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as session:
            yield session

    @contextlib.contextmanager
    def member(self, holder: str, victim: Victim) -> Iterator[zenoh.Session]:
        """A peer's session, as a daemon has it, of who goes by no rules."""
        config = json.loads(zenoh_config.control_config(listen=(), connect=(victim.endpoint,)))
        config["transport"]["link"]["tls"] = self.tls(holder)
        with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as session:
            until(session.info.links, f"a link of {holder}")
            yield session


def reissue(authority: Authority, folder: Path, name: str) -> None:
    """The next key of a name whose first one is revoked."""
    authority.revoke(name, datetime.now(UTC))
    install(authority, folder, name)


@pytest.fixture(scope="module")
def yard(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Yard]:
    folder = tmp_path_factory.mktemp("yard")
    authority = make_authority(folder / "authority", "yard")
    for name in ("robot1", "robot2", "edge1", "robot3", "mallory"):
        install(authority, folder / name, name)
    reissue(authority, folder / "robot3.k2", "robot3")
    install(authority, folder / "ana", "ana", Role.OPERATOR)
    install(authority, folder / "screen", "screen", Role.GUEST)
    install(make_authority(folder / "other authority", "yard"), folder / "other", "robot2")
    (folder / "late").mkdir()
    expired = authority.renew("robot2", None, b"", b"", datetime.now(UTC) - timedelta(days=31))
    (folder / "late" / "certificate.pem").write_bytes(expired.certificate)
    (folder / "late" / "key.pem").write_bytes((folder / "robot2" / "key.pem").read_bytes())
    with contextlib.ExitStack() as stack:
        victims = []
        for name, side in (("robot1", Side.CONTROL), ("edge1", Side.DATA)):
            (folder / "fleet.yaml").write_text(FLEET.replace("FOLDER", name))
            fleet = check_file(folder / "fleet.yaml").fleet
            assert fleet is not None
            endpoint = free_endpoint().replace("tcp/", "tls/")
            make = zenoh_config.control_config if side is Side.CONTROL else zenoh_config.data_config
            text = make(listen=(endpoint,), connect=(), operator_json5=session_text(fleet, side))
            session = stack.enter_context(zenoh.open(zenoh.Config.from_json5(text)))
            victims.append(Victim(session, endpoint.partition("#")[0]))
            victims[-1].listen()
        yield Yard(folder, authority, *victims)


def until_alone(victim: Victim) -> None:
    """All that came by a link has been judged when the link has ended."""
    until(lambda: not victim.session.info.links(), "the links to end")


def note_keys(session: zenoh.Session, keys: list[str]) -> None:
    """Note what others say on the control network."""
    session.declare_subscriber(
        "@zsched/yard/**", lambda sample: keys.append(str(sample.key_expr)), allowed_origin=zenoh.Locality.REMOTE
    )


@pytest.fixture
def fresh(yard: Yard) -> Yard:
    """The victims without what they have heard, and without the links of earlier attacks."""
    for victim in (yard.control, yard.data):
        until_alone(victim)
        victim.heard.clear()
        victim.asked.clear()
        victim.tokens.clear()
    return yard


# --- strangers -------------------------------------------------------------------------------------------------------

OUTSIDE: dict[str, Callable[[Yard], dict[str, Any] | None]] = {
    "no certificate": lambda yard: {"root_ca_certificate": str(yard.folder / "robot1" / "ca.pem")},
    "another authority": lambda yard: yard.tls("other"),
    "expired": lambda yard: yard.tls("late"),
}


@pytest.mark.parametrize("attack", OUTSIDE)
@pytest.mark.parametrize("which", ["control", "data"])
def test_who_has_no_valid_certificate_gets_no_link(fresh: Yard, attack: str, which: str) -> None:
    victim: Victim = getattr(fresh, which)
    with pytest.raises(zenoh.ZError), fresh.session(victim, OUTSIDE[attack](fresh), connect_s=REFUSED_S):
        pass
    assert not victim.links()


def test_plain_text_gets_no_link(fresh: Yard) -> None:
    for victim in (fresh.control, fresh.data):
        with pytest.raises(zenoh.ZError), fresh.session(victim, None, is_plain=True, connect_s=REFUSED_S):
            pass


@pytest.mark.parametrize("stranger", ["mallory", "robot3"])
@pytest.mark.parametrize("which", ["control", "data"])
def test_a_certificate_that_the_file_does_not_let_in_speaks_and_hears_nothing(
    fresh: Yard, stranger: str, which: str
) -> None:
    """``mallory`` is certified and no node; the key ``robot3`` is revoked, and ``robot3.k2`` is let in."""
    victim: Victim = getattr(fresh, which)
    got: dict[str, list[str]] = {stranger: [], "robot3.k2": []}
    said = {}
    for who, keys in got.items():
        with fresh.member(who, victim) as session:
            name = who.partition(".")[0]
            note_keys(session, keys)
            session.liveliness().declare_token(KEYS.alive(name, 1))
            session.put(KEYS.beat(name), b"")
            session.put(f"edge1/merge/{name}/in", b"")
            said[who] = [reply.ok for reply in session.get(KEYS.status("robot1", name), timeout=ANSWER_S)]
            victim.session.put(KEYS.beat("robot1"), b"", allowed_destination=zenoh.Locality.REMOTE)
            if who == "robot3.k2":
                until(lambda: KEYS.beat("robot3") in victim.heard, "the member's own beat")
                until(lambda: got["robot3.k2"], "the victim's beat at the member")
                until(lambda: victim.tokens, "the member's token")
        until_alone(victim)
    until(lambda: len(victim.tokens) > 1, "the member's token to go")
    assert not got[stranger]
    assert not said[stranger]
    assert {key.split("/")[3] if key.startswith("@") else key.split("/")[2] for key in victim.heard} == {"robot3"}
    assert victim.heard.count(KEYS.beat("robot3")) == 1, "the revoked key has sent one, too"
    assert len(victim.tokens) == 2, "the token of the member came and went"


def test_who_is_certified_by_another_trusted_authority_under_a_public_name_says_and_hears_nothing(
    fresh: Yard, tmp_path: Path
) -> None:
    """As any authority of the public web, which zenoh trusts when it dials; addresses are not checked."""
    public = make_authority(tmp_path / "public", "example")
    install(public, fresh.folder / "public", "robot2")
    bundle = fresh.folder / "public" / "ca.pem"
    bundle.write_bytes(bundle.read_bytes() + (fresh.folder / "robot1" / "ca.pem").read_bytes())
    files = {"listen_certificate": "certificate.pem", "listen_private_key": "key.pem"}
    tls = {name: str(fresh.folder / "public" / file) for name, file in files.items()}
    listening = free_endpoint().replace("tcp/", "tls/")
    config = json.loads(zenoh_config.control_config(listen=(listening,), connect=()))
    config["transport"]["link"]["tls"] = fresh.tls("public", root_ca_certificate=str(bundle), **tls)
    heard: list[str] = []
    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as impostor:
        note_keys(impostor, heard)
        dialler = json.loads(fresh.text("robot1", connect=(listening,)))
        dialler["transport"]["link"]["tls"]["root_ca_certificate"] = str(bundle)
        with zenoh.open(zenoh.Config.from_json5(json.dumps(dialler))) as session:
            victim = Victim(session, listening)
            victim.listen()
            until(lambda: victim.links() == {"robot2.example.zsched.internal"}, "it is dialled")
            impostor.put(KEYS.beat("robot2"), b"forged", congestion_control=zenoh.CongestionControl.BLOCK)
            assert not list(impostor.get(KEYS.status("robot1", "robot2"), timeout=ANSWER_S))
            session.put(KEYS.beat("robot1"), b"", allowed_destination=zenoh.Locality.REMOTE)
        until(lambda: not impostor.info.links(), "the link to end")
    assert (victim.heard, victim.asked, victim.tokens, heard) == ([], [], [], [])


LESSER, GREATER = {"robot2": "1", "mallory": "2"}, "f" * 32
"""Ids of sessions: of two peers that could dial each other only the one with the greater id does."""


def test_who_is_dialled_because_a_member_named_its_address_says_and_hears_nothing(fresh: Yard) -> None:
    """Gossip passes no rule: a member tells of a peer that is none, and the victim dials it."""
    meeting = free_endpoint().replace("tcp/", "tls/")
    heard: list[str] = []
    with contextlib.ExitStack() as stack:

        def peer(holder: str, listen: str, *connect: str) -> zenoh.Session:
            config = json.loads(zenoh_config.control_config(listen=(listen,), connect=connect))
            config["id"] = LESSER[holder]
            files = {"listen_certificate": "certificate.pem", "listen_private_key": "key.pem"}
            own = {name: str(fresh.folder / holder / file) for name, file in files.items()}
            config["transport"]["link"]["tls"] = fresh.tls(holder, **own)
            return stack.enter_context(zenoh.open(zenoh.Config.from_json5(json.dumps(config))))

        liar = peer("robot2", meeting)
        foreign = peer("mallory", free_endpoint().replace("tcp/", "tls/"), meeting)
        note_keys(foreign, heard)
        until(liar.info.links, "the peer that is none is at the member")
        text = json.dumps({**json.loads(fresh.text("robot1", connect=(meeting,))), "id": GREATER})
        victim = Victim(stack.enter_context(zenoh.open(zenoh.Config.from_json5(text))), meeting)
        victim.listen()
        strangers = {"mallory.yard.zsched.internal"}
        until(lambda: strangers < victim.links(), "both are linked: the member, and whom it told of")
        foreign.put(KEYS.beat("edge1"), b"forged", congestion_control=zenoh.CongestionControl.BLOCK)
        assert not list(foreign.get(KEYS.status("robot1", "edge1"), timeout=ANSWER_S))

        def is_heard() -> bool:
            liar.put(KEYS.beat("robot2"), b"own")  # more than one: a busy machine drops what does not block
            return bool(victim.heard)

        until(is_heard, "the member's own frame")
        victim.session.put(KEYS.beat("robot1"), b"", allowed_destination=zenoh.Locality.REMOTE)
    assert set(victim.heard) == {KEYS.beat("robot2")}
    assert KEYS.beat("robot1") not in heard


@contextlib.contextmanager
def _bus(
    yard: Yard, *, has_rules: bool = True, limit: Limit | None = None
) -> Iterator[tuple[ControlBus, Victim, list[ev.Event]]]:
    """A daemon's control session, as robot1; where it listens; what it tells."""
    endpoint = free_endpoint().replace("tcp/", "tls/")
    config = json.loads(yard.text("robot1", listen=(endpoint,)))
    if not has_rules:
        del config["access_control"]
    fleet, events = yard.fleet("robot1"), list[ev.Event]()
    assert fleet.security is not None
    bus = ControlBus(
        fleet="yard",
        node="robot1",
        incarnation=1,
        zenoh_config=json.dumps(config),
        post=events.append,
        members=common_names_of(fleet, fleet.security),
        limit=limit or limit_for(fleet.timing, 1),
        names=names_of(fleet),
    )
    bus.open()
    try:
        yield bus, Victim(yard.control.session, endpoint.partition("#")[0]), events
    finally:
        bus.close()


def _dropped(bus: ControlBus, events: list[ev.Event]) -> set[str]:
    """What has been dropped, ``kind/reason``."""
    events.extend(bus.waiting())
    return {f"{event.kind}/{event.reason}" for event in events if isinstance(event, ev.FrameDropped)}


@pytest.mark.long
@pytest.mark.parametrize(("holder", "counted"), [("robot2", "alive/too_many"), ("mallory", "link/stranger")])
def test_who_shows_thousands_of_tokens_loses_its_link(
    fresh: Yard, holder: str, counted: str, caplog: pytest.LogCaptureFixture
) -> None:
    """A member, and somebody with a certificate who is none; tokens that were seen are taken back with the link."""
    with _bus(fresh) as (bus, victim, events):
        with fresh.member(holder, victim) as session:
            held = [session.liveliness().declare_token(KEYS.alive(holder, number)) for number in range(TOKENS)]
            until(lambda: counted in _dropped(bus, events), f"{counted} to be counted")
            assert len(held) == TOKENS
            until(lambda: "is ended" in caplog.text, "the link is ended")
            if holder == "robot2":
                until(lambda: "link/shut_out" in _dropped(bus, events), "its next link is refused before its tokens")
        until(lambda: not bus.peers(), "the link to end")
    here = Counter(event.node for event in events if isinstance(event, ev.TokenSeen))
    here.subtract(event.node for event in events if isinstance(event, ev.TokenLost))
    assert max(here.values(), default=0) <= MAX_SHOWN


def test_tokens_of_one_member_take_no_other_workers_place(fresh: Yard, monkeypatch: pytest.MonkeyPatch) -> None:
    """A relay remembers so many: were they all one node's, no next owner's worker would be seen to be ready."""
    monkeypatch.setattr(tokens, "MAX_TOKENS", FLOOD)
    monkeypatch.setattr(tokens, "MAX_OF_NODE", FLOOD // 2, raising=False)
    ended = list[RoleEnded]()
    seen = tokens.Tokens(
        fresh.data.session, KEYS, lambda _: None, lambda _, role: ended.append(role), wake=lambda: None
    )
    with fresh.member("robot2", fresh.data) as flood, fresh.member("edge1", fresh.data) as session:
        held = [flood.liveliness().declare_token(KEYS.worker("robot2", "merge", number)) for number in range(2 * FLOOD)]
        until(lambda: len(fresh.data.tokens) == len(held), "the flood")
        ready = session.liveliness().declare_token(KEYS.worker("edge1", "merge", 1))
        until(lambda: seen.has_worker("edge1", "merge", "1"), "the worker's token")
        ready.undeclare()
        until(lambda: not seen.has_worker("edge1", "merge", "1"), "the worker's token to go")
        for token in held:
            token.undeclare()
        until(lambda: not seen.seen(), "all tokens to go")
        last = flood.liveliness().declare_token(KEYS.worker("robot2", "merge", 1))
        until(lambda: seen.has_worker("robot2", "merge", "1"), "its own worker, once there is room")
        last.undeclare()
    seen.leave()


def test_a_member_has_so_many_sessions_and_no_more(
    fresh: Yard, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """zenoh takes 1000 sessions in all: one member must not have them. Another member is let in beside it."""
    monkeypatch.setattr(expulsion, "MAX_SESSIONS", 3)
    with _bus(fresh) as (bus, victim, events), contextlib.ExitStack() as stack:
        for _ in range(3):
            stack.enter_context(fresh.member("robot2", victim))
        until(lambda: bus.peers() == 3, "three sessions of robot2")
        stack.enter_context(fresh.member("robot2", victim))
        until(lambda: "link/too_many" in _dropped(bus, events), "the fourth one to be counted")
        until(lambda: "is ended" in caplog.text, "its link is ended")
        stack.enter_context(fresh.member("edge1", victim))
        until(lambda: bus.peers() >= 4, "another member is let in")


LOOK_S = 4 * HOLD_S


@pytest.mark.parametrize("side", [Side.CONTROL, Side.DATA])
def test_who_is_not_let_in_and_dials_again_is_held(fresh: Yard, side: Side) -> None:
    """zenoh dials at once what it had a link to: 40 times a second, each with a handshake, to daemon and relay."""
    endpoint, told = free_endpoint().replace("tcp/", "tls/"), list[str]()
    make = zenoh_config.control_config if side is Side.CONTROL else zenoh_config.data_config
    text = make(listen=(endpoint,), connect=(), operator_json5=session_text(fresh.fleet("robot1"), side))
    members = members_of(text)
    assert members is not None
    with zenoh.open(zenoh.Config.from_json5(text)) as session:
        expulsion = Expulsion(session, "yard", members, lambda why, name: told.append(f"{why} {name}"))
        victim = Victim(session, endpoint.partition("#")[0])
        with fresh.member("mallory", victim) as stranger:
            held = [stranger.liveliness().declare_token(KEYS.alive("mallory", number)) for number in range(100)]
            time.sleep(LOOK_S)  # a rate is looked at, not an event
            with fresh.member("robot2", victim):
                until(lambda: "robot2.yard.zsched.internal" in victim.links(), "a member is let in beside it")
        assert len(held) == 100
        assert 2 <= len(told) <= 2 + 2 * LOOK_S / HOLD_S
        assert set(told) == {"stranger mallory.yard.zsched.internal"}
        until_alone(victim)
        expulsion.close()


# --- members that speak for others -----------------------------------------------------------------------------------

FORGED_PUTS = {
    "control": {
        "beat": KEYS.beat("edge1"),
        "periodic beat": KEYS.beat_in_turn("edge1"),
        "profile": KEYS.profile("edge1"),
        "proposal": KEYS.proposal("robot1"),
        "learnt values": KEYS.allocation("edge1"),
    },
    "data": {
        "input": "edge1/merge/robot1/in",
        "end marker": "edge1/merge/robot1/in/@zsched/end",
        "output": "edge1/merge/robot1/out",
        "answer sent again": "edge1/merge/robot1/out/@zsched/again/abc",
        "role": KEYS.role("edge1", "merge"),
        "acknowledgement": KEYS.ack("edge1", "merge", 1, "abc"),
        "receipt": KEYS.received("robot1", "abc", "def"),
        "trouble": KEYS.trouble("edge1", "merge", 1),
    },
}
OWN = {"control": KEYS.beat("robot2"), "data": "edge1/merge/robot2/in"}


@pytest.mark.parametrize("which", FORGED_PUTS)
def test_a_member_that_speaks_for_another_is_not_heard(fresh: Yard, which: str) -> None:
    victim: Victim = getattr(fresh, which)
    with fresh.member("robot2", victim) as session:
        for key in FORGED_PUTS[which].values():
            session.put(key, b"forged", congestion_control=zenoh.CongestionControl.BLOCK)
            session.delete(key, congestion_control=zenoh.CongestionControl.BLOCK)
        for key in (KEYS.alive("edge1", 9), KEYS.worker("edge1", "merge", 9), f"{KEYS.role('edge1', 'merge')}/9"):
            session.liveliness().declare_token(key)
        own = session.liveliness().declare_token(KEYS.alive("robot2", 1))
        until(lambda: KEYS.alive("robot2", 1) in victim.tokens, "its own token")
        session.put(OWN[which], b"own")
        until(lambda: OWN[which] in victim.heard, "its own frame")
        own.undeclare()
    assert victim.heard == [OWN[which]]
    assert set(victim.tokens) == {KEYS.alive("robot2", 1)}


@pytest.mark.parametrize("question", [KEYS.register, KEYS.learnt, KEYS.command, KEYS.utility])
def test_a_member_that_asks_in_anothers_name_is_not_answered(fresh: Yard, question: Callable[[str, str], str]) -> None:
    with fresh.member("robot2", fresh.control) as session:
        assert not list(session.get(question("robot1", "edge1"), timeout=ANSWER_S))
        until(lambda: list(session.get(question("robot1", "robot2"), timeout=ANSWER_S)), "its own question's answer")
    assert set(fresh.control.asked) == {question("robot1", "robot2")}


def test_questions_for_the_status_in_anothers_name_leave_its_votes_their_room(fresh: Yard) -> None:
    """A node passes such questions on, so they may bear any name: a flood must not silence that name's votes."""
    limit = Limit(hz=0.01, burst=FLOOD / 2)
    with _bus(fresh, limit=limit) as (bus, victim, events), fresh.member("robot2", victim) as flood:
        for _ in range(FLOOD):
            flood.get(KEYS.status("robot1", "edge1"), lambda _: None, timeout=ANSWER_S)
        until(lambda: "status/rate" in _dropped(bus, events), "the flood to be counted")
        with fresh.member("edge1", victim) as session:
            session.get(KEYS.utility("robot1", "edge1"), lambda _: None, timeout=ANSWER_S)
            until(
                lambda: any(isinstance(event, ev.UtilityAsked) for event in events) or _dropped(bus, events) & VOTES,
                "the other member's own question",
            )
            assert not _dropped(bus, events) & VOTES


def test_a_member_that_answers_for_another_is_not_believed(fresh: Yard) -> None:
    """A promise in an elector's name, and a worker's state in the owner's."""
    for victim, own, forged, asked in (
        (
            fresh.control,
            KEYS.register("robot2", "robot1"),
            KEYS.register("edge1", "robot1"),
            KEYS.register("*", "robot1"),
        ),
        (fresh.data, KEYS.snapshot("robot2", "merge"), KEYS.snapshot("edge1", "more"), KEYS.snapshot("*", "*")),
    ):
        with fresh.member("robot2", victim) as session:

            def answer(query: zenoh.Query, own: str = own, forged: str = forged) -> None:
                with query:
                    query.reply(forged, b"forged")
                    query.reply(own, b"own")

            session.declare_queryable(asked, answer)
            session.declare_queryable(own, answer)
            victims = victim

            def answers(victims: Victim = victims, asked: str = asked) -> set[str]:
                replies = victims.session.get(
                    asked,
                    consolidation=zenoh.ConsolidationMode.NONE,
                    timeout=ANSWER_S,
                    target=zenoh.QueryTarget.ALL,
                    allowed_destination=zenoh.Locality.REMOTE,
                )
                return {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}

            assert until(answers, "the member's own answer") == {own}


def test_an_answer_in_a_name_that_is_not_the_links_is_counted_where_no_rule_stops_it(fresh: Yard) -> None:
    """zenoh's rules drop it and tell nobody; the daemon looks itself, at what zenoh tells the link of."""
    with _bus(fresh, has_rules=False) as (bus, victim, events), fresh.member("robot2", victim) as session:

        def answer(query: zenoh.Query) -> None:
            owner = str(query.key_expr).split("/")[3]
            with query:
                query.reply(str(query.key_expr), wire.encode(Learnt(node=owner, values=())))

        for owner in ("edge1", "robot2"):
            session.declare_queryable(KEYS.learnt(owner, "robot1"), answer)

        def told(owner: str) -> set[str]:
            bus.ask_learnt(owner, ANSWER_S)
            learnt = {f"learnt/{one.learnt.node}" for one in events if isinstance(one, ev.LearntReceived)}
            return learnt | _dropped(bus, events)

        watched = bus._expulsion
        assert watched is not None
        until(lambda: watched._names, "the link's event")
        watched._names.clear()  # as while that event is on its way
        until(lambda: "allocation/link" in told("edge1"), "the answer for another is counted")
        until(lambda: "learnt/robot2" in told("robot2"), "its own answer is taken")
        assert "learnt/edge1" not in told("edge1")


# --- guests and operators --------------------------------------------------------------------------------------------


def test_a_guest_reads_status_and_streams_and_commands_nothing(fresh: Yard) -> None:
    with fresh.session(fresh.control, fresh.tls("screen")) as session:
        until(lambda: list(session.get(KEYS.status("robot1", "screen"), timeout=ANSWER_S)), "the status")
        for key in (KEYS.command("robot1", "screen"), KEYS.command("robot1", "ana"), KEYS.register("robot1", "screen")):
            assert not list(session.get(key, timeout=ANSWER_S))
        session.put(KEYS.beat("screen"), b"")
    assert set(fresh.control.asked) == {KEYS.status("robot1", "screen")}
    got = threading.Event()
    with fresh.session(fresh.data, fresh.tls("screen")) as session:
        session.declare_subscriber("robot1/out", lambda _: got.set())
        session.put("edge1/merge/robot1/in", b"forged")
        assert not list(session.get(KEYS.snapshot("edge1", "merge"), timeout=ANSWER_S))

        def reads() -> bool:
            fresh.data.session.put("robot1/out", b"")
            return got.wait(0.02)

        until(reads, "the stream at the guest")
    assert "edge1/merge/robot1/in" not in fresh.data.heard
    assert not fresh.control.heard


@pytest.mark.parametrize("which", ["control", "data"])
@pytest.mark.parametrize("who", ["screen", "ana"])
def test_who_is_no_node_says_and_answers_nothing_under_any_key(fresh: Yard, who: str, which: str) -> None:
    """As a peer, by every way to speak, under keys of its own, of others, and under wildcards that meet them."""
    victim: Victim = getattr(fresh, which)
    kinds = ("beat", "profile", "proposal", "allocation", "register", "command", "status", "role", "snapshot", "alive")
    keys = [f"@zsched/yard/{kind}/{node}" for kind in kinds for node in (who, "robot1", "edge1")]
    keys += [f"{key}/{who}" for key in keys] + [*FORGED_PUTS["control"].values(), *FORGED_PUTS["data"].values()]
    keys += ["robot1/in", "robot1/out", "edge1/merge/robot1/in/@adv/pub/1", "@ros2_lv/1/x", "@adv/x"]
    wide = ["@zsched/yard/*/*", "@zsched/yard/**", "@zsched/**", "**", "*/merge/robot1/in", "robot1/*"]
    asked = [KEYS.register("*", "robot1"), KEYS.snapshot("edge1", "merge"), KEYS.role("edge1", "merge"), "robot1/plan"]

    def answer(query: zenoh.Query) -> None:
        with query:
            query.reply(str(query.key_expr), b"forged")

    with fresh.member(who, victim) as session:
        for key in (*keys, *wide):
            session.put(key, b"forged", congestion_control=zenoh.CongestionControl.BLOCK)
            session.delete(key, congestion_control=zenoh.CongestionControl.BLOCK)
        for key in keys:
            session.liveliness().declare_token(key)
        for key in (*wide, *asked):
            session.declare_queryable(key, answer)
        for key in asked:
            replies = victim.session.get(
                key, target=zenoh.QueryTarget.ALL, timeout=ANSWER_S, allowed_destination=zenoh.Locality.REMOTE
            )
            assert not [reply.ok for reply in replies if reply.ok is not None], key
        for key in (*wide[:3], KEYS.register("*", who), KEYS.learnt("robot1", who), KEYS.status("*", "*")):
            asks = session.get(key, timeout=ANSWER_S, allowed_destination=zenoh.Locality.REMOTE)
            assert not [one for one in asks if one.ok is not None], key
    until_alone(victim)
    with fresh.member("robot2", victim) as session:
        session.put(OWN[which], b"own")
        until(lambda: OWN[which] in victim.heard, "a member's own frame")
    assert (victim.heard, victim.tokens, victim.asked) == ([OWN[which]], [], [])


@contextlib.contextmanager
def _thin(endpoint: str, is_thin: threading.Event) -> Iterator[str]:
    """A way to an endpoint that carries `THIN_BYTES_S` of what comes back, once it is thin."""
    host, _, port = endpoint.partition("/")[2].rpartition(":")
    with socket.create_server(("127.0.0.1", 0)) as listener, contextlib.ExitStack() as stack:
        is_over = threading.Event()

        def there(near: socket.socket, far: socket.socket) -> None:
            with contextlib.suppress(OSError):
                while data := near.recv(65536):
                    far.sendall(data)

        def back(near: socket.socket, far: socket.socket) -> None:
            with contextlib.suppress(OSError):
                while data := far.recv(1024 if is_thin.is_set() else 65536):
                    near.sendall(data)
                    if is_thin.is_set():
                        is_over.wait(len(data) / THIN_BYTES_S)
            for end in (near, far):
                with contextlib.suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)

        def serve() -> None:
            with contextlib.suppress(OSError):
                while True:
                    near = stack.enter_context(listener.accept()[0])
                    far = stack.enter_context(socket.create_connection((host, int(port))))
                    for way in (there, back):
                        threading.Thread(target=way, args=(near, far), daemon=True).start()

        threading.Thread(target=serve, daemon=True).start()
        yield f"tls/127.0.0.1:{listener.getsockname()[1]}"
        is_over.set()
        listener.shutdown(socket.SHUT_RDWR)


@pytest.mark.long
@pytest.mark.parametrize("who", ["screen", "ana"])
def test_who_only_looks_and_reads_too_slowly_holds_no_stream_up(fresh: Yard, who: str) -> None:
    """A `reliable` input waits for each receiver; the guest shows that it lives, and takes little."""
    endpoint, told, got = free_endpoint().replace("tcp/", "tls/"), list[str](), list[float]()
    make = zenoh_config.data_config
    text = make(listen=(endpoint,), connect=(), operator_json5=session_text(fresh.fleet("robot1"), Side.DATA))
    members, is_thin = members_of(text), threading.Event()
    assert members is not None
    with contextlib.ExitStack() as stack:
        session = stack.enter_context(zenoh.open(zenoh.Config.from_json5(text)))
        expulsion = Expulsion(session, "yard", members, lambda why, _name: told.append(why), has_streams=True)
        stack.callback(expulsion.close)
        victim = Victim(session, endpoint.partition("#")[0])
        owner = stack.enter_context(fresh.member("edge1", victim))
        owner.declare_subscriber("edge1/merge/robot1/in", lambda _: got.append(time.monotonic()))
        thin = Victim(session, stack.enter_context(_thin(victim.endpoint, is_thin)))
        slow = stack.enter_context(fresh.session(thin, fresh.tls(who)))
        seen = threading.Event()
        slow.declare_subscriber("**", lambda _: seen.set())
        way = session.declare_publisher(
            "edge1/merge/robot1/in",
            congestion_control=zenoh.CongestionControl.BLOCK,
            reliability=zenoh.Reliability.RELIABLE,
        )

        def put_until(is_done: Callable[[], object], deadline_s: float = 20.0) -> float:
            """The longest put, in seconds."""
            longest, end = 0.0, time.monotonic() + deadline_s
            while not is_done():
                assert time.monotonic() < end
                began = time.monotonic()
                way.put(bytes(LARGE_BYTES))
                longest = max(longest, time.monotonic() - began)
                time.sleep(0.005)  # the rate of a stream
            return longest

        put_until(lambda: seen.is_set() and got)
        assert not told, "who reads quickly stays"
        is_thin.set()
        longest = put_until(lambda: "slow" in told)
        assert longest < MOST_HELD_UP_S
        before, until_s = len(got), time.monotonic() + 6.0
        longest = put_until(lambda: len(got) > before + 500 and time.monotonic() > until_s)
        assert longest < MOST_HELD_UP_S, "it is shut out for a while"
        assert told.count("slow") <= 4, "for 1 s, then for 2, 4, 8 s"


def test_an_operator_commands_in_its_own_name(fresh: Yard) -> None:
    with fresh.session(fresh.control, fresh.tls("ana")) as session:
        until(lambda: list(session.get(KEYS.command("robot1", "ana"), timeout=ANSWER_S)), "the command's answer")
        assert not list(session.get(KEYS.command("robot1", "robot2"), timeout=ANSWER_S))
        session.put(KEYS.beat("ana"), b"")
    assert set(fresh.control.asked) == {KEYS.command("robot1", "ana")}
    assert not fresh.control.heard


# --- certificates that end -------------------------------------------------------------------------------------------


def test_a_link_ends_with_its_certificate(fresh: Yard) -> None:
    life = timedelta(days=30)
    issued = fresh.authority.renew("robot2", None, b"", b"", datetime.now(UTC) - life + timedelta(seconds=SHORT_S))
    folder = fresh.folder / "short"
    folder.mkdir()
    (folder / "certificate.pem").write_bytes(issued.certificate)
    (folder / "key.pem").write_bytes((fresh.folder / "robot2" / "key.pem").read_bytes())
    with fresh.session(fresh.control, fresh.tls("short")):
        assert fresh.control.links() == {"robot2.yard.zsched.internal"}
        until_alone(fresh.control)
    with pytest.raises(zenoh.ZError), fresh.session(fresh.control, fresh.tls("short"), connect_s=REFUSED_S):
        pass


# --- what is let in --------------------------------------------------------------------------------------------------


def test_between_two_authorities_certificates_of_both_are_let_in(fresh: Yard, tmp_path: Path) -> None:
    """A machine whose ``ca.pem`` is the one of a rotation; its own certificate is still of the former authority."""
    authority = make_authority(tmp_path / "authority", "yard")
    for name in ("robot1", "robot2"):
        install(authority, fresh.folder / f"turning {name}", name)
    authority.rotate(b"", datetime.now(UTC))
    install(authority, fresh.folder / "turned edge1", "edge1")
    (fresh.folder / "turning robot1" / "ca.pem").write_bytes(authority.trusted)
    (fresh.folder / "fleet.yaml").write_text(FLEET.replace("FOLDER", "turning robot1"))
    fleet = check_file(fresh.folder / "fleet.yaml").fleet
    assert fleet is not None
    endpoint = free_endpoint().replace("tcp/", "tls/")
    text = zenoh_config.control_config(listen=(endpoint,), connect=(), operator_json5=session_text(fleet, Side.CONTROL))
    with zenoh.open(zenoh.Config.from_json5(text)) as session:
        victim = Victim(session, endpoint)
        for holder in ("turning robot2", "turned edge1"):
            bundle = str(fresh.folder / "turning robot1" / "ca.pem")
            with fresh.session(victim, fresh.tls(holder, root_ca_certificate=bundle)):
                assert victim.links() == {f"{holder.split()[1]}.yard.zsched.internal"}
            until_alone(victim)
        with pytest.raises(zenoh.ZError), fresh.session(victim, fresh.tls("robot2"), connect_s=REFUSED_S):
            pass


def test_a_p256_key_is_let_in_like_any_other(fresh: Yard) -> None:
    key = ec.generate_private_key(ec.SECP256R1())
    request = (
        x509.CertificateSigningRequestBuilder().subject_name(x509.Name([])).sign(key, hashes.SHA256())
    ).public_bytes(serialization.Encoding.PEM)
    folder = fresh.folder / "p256"
    folder.mkdir()
    issued = fresh.authority.renew("robot2", None, request, b"", datetime.now(UTC))
    (folder / "certificate.pem").write_bytes(issued.certificate)
    (folder / "key.pem").write_bytes(
        key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())
    )
    with fresh.member("p256", fresh.control):
        assert fresh.control.links() == {"robot2.yard.zsched.internal"}


@pytest.mark.parametrize(("who", "said"), [("ana", "ana.operator"), ("robot2", "eve@robot2")])
def test_an_order_that_is_not_signed_bears_the_name_of_its_link(fresh: Yard, who: str, said: str) -> None:
    """With ``signatures: off``, or from an older version: the rules bind the asker's name to the certificate."""
    order = wire.encode(MoveTask(task="merge", node="edge1", asked=Asked(by="eve@robot1", reason="mine")))
    with _bus(fresh) as (_, victim, events), fresh.session(victim, fresh.tls(who)) as session:

        def orders() -> list[Asked]:
            session.get(KEYS.command("robot1", who), lambda _: None, payload=order, timeout=ANSWER_S)
            return [event.command.asked for event in events if isinstance(event, ev.MoveCommanded)]

        assert until(orders, "the order")[0] == Asked(by=said, reason="mine")


def heard_of(victim: Victim, key: str) -> bool:
    """Whether a sample of that key and a token have come."""
    return bool(victim.tokens) and key in victim.heard


def test_a_worker_without_the_key_speaks_as_a_worker_of_its_node_only(fresh: Yard) -> None:
    """It joins its own relay by a socket; what the rules let through goes on to the members, with the node's name."""
    endpoint, path = free_endpoint().replace("tcp/", "tls/"), fresh.folder / "edge1.sock"
    by_socket = f"{zenoh_config.WORKERS_BY}/{path}"
    rules = session_text(fresh.fleet("edge1"), Side.DATA, home="edge1")
    text = zenoh_config.data_config(listen=(endpoint, by_socket), connect=(), operator_json5=rules)
    worker_text = zenoh_config.worker_config(connect=(by_socket,), link=WorkerLink.CLIENT)
    theirs, refused = session_text(fresh.fleet("robot1"), Side.DATA), list[Refusal]()
    with contextlib.ExitStack() as stack:
        relay = Victim(stack.enter_context(zenoh.open(zenoh.Config.from_json5(text))), endpoint.partition("#")[0])
        relay.listen()
        members = members_of(text)
        assert members is not None
        watch = Expulsion(relay.session, "yard", members, lambda why, _: refused.append(why), has_streams=True)
        stack.callback(watch.close)
        far_text = zenoh_config.data_config(listen=(), connect=(relay.endpoint,), operator_json5=theirs)
        far = Victim(stack.enter_context(zenoh.open(zenoh.Config.from_json5(far_text))), "")
        far.listen()
        until(lambda: relay.links() and far.links(), "the relays are linked")
        worker = stack.enter_context(zenoh.open(zenoh.Config.from_json5(worker_text)))
        inputs = list[str]()
        worker.declare_subscriber("edge1/merge/*/in", lambda sample: inputs.append(str(sample.key_expr)))
        time.sleep(2 * HOLD_S)  # a stranger's link would be ended by now
        node, others = KEYS.all_puts().removesuffix("*/*"), ("robot1", "robot2")
        for key in (
            *(f"{node}{kind}/{name}" for kind in ("beat", "proposal", "allocation") for name in ("edge1", "robot1")),
            *(KEYS.role(name, "merge") for name in ("edge1", *others)),
            *(KEYS.ack(name, "merge", "1", "ab") for name in others),
            *(KEYS.received(name, "ab", "cd") for name in ("edge1", "robot1")),
            *("robot1/in", "robot1/out", "edge1/merge/robot1/in", "other/merge/robot1/out"),
        ):
            worker.put(key, b"forged")
        for key in (KEYS.relay("edge1", "ab"), KEYS.alive("edge1", "9"), KEYS.worker("robot2", "merge", "9")):
            stack.callback(worker.liveliness().declare_token(key).undeclare)
        said = [KEYS.trouble("edge1", "merge", "9"), KEYS.ack("edge1", "merge", "9", "ab"), "edge1/merge/robot1/out"]
        for key in said:
            worker.put(key, b"true")
        stack.callback(worker.liveliness().declare_token(KEYS.worker("edge1", "merge", "9")).undeclare)
        for victim in (relay, far):
            until(partial(heard_of, victim, said[-1]), "what a worker may say")
            assert (sorted(victim.heard), victim.tokens) == (sorted(said), [KEYS.worker("edge1", "merge", "9")])
        until(lambda: far.session.put("edge1/merge/robot1/in", b"1") or inputs, "an input of another machine")
        assert refused == []
