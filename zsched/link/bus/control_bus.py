"""The control session: beats, profiles, utilities, proposals and ballots over zenoh.

Knows: zenoh, the control keys, the codec. Does not know: what any of it leads to.

zenoh's callbacks only decode and enqueue (work in them would stall the process), every question is answered later, from
the loop, by its number. A frame that is malformed, whose key names another node than its content, or whose seal is not
right (`zsched.link.bus.seals`), becomes a `FrameDropped` event and nothing else. What comes too fast is counted
before anybody looks at it, and wakes nobody up (`zsched.link.bus.limits`). One subscriber and one queryable
serve all kinds: three threads in all.
"""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import zenoh

from zsched.core.values import codec as wire
from zsched.core.values import events as ev
from zsched.core.values.beat import Beat
from zsched.core.values.certificates import Holder, Role, parse_common_name
from zsched.core.values.decision import Explanation
from zsched.core.values.errors import AdapterError, WireError
from zsched.core.values.events import commanded
from zsched.core.values.fleet import MOST_ORDER_S
from zsched.core.values.messages import (
    COMMANDS,
    Accept,
    Accepted,
    AskDocument,
    Asking,
    Ballots,
    Command,
    CommandOutcome,
    CommandResult,
    FleetAnswer,
    FleetQuestion,
    FleetTold,
    HistoryTold,
    Learnt,
    Ordered,
    Prepare,
    Promise,
    ReadFleet,
    ReadHistory,
    ReadLines,
    Refused,
    Utilities,
    Votes,
    WorkerLines,
    asked_at,
    asked_by,
)
from zsched.core.values.model import NodeId, Proposal
from zsched.core.values.profile import Profile
from zsched.core.values.rehearsal import ReadRehearsals, RehearsalsTold
from zsched.core.values.snapshot import Snapshot
from zsched.core.values.words import NAME
from zsched.host.clock import monotonic_s
from zsched.host.guard import ends_within, tolerant
from zsched.link.bus import seals as sealing
from zsched.link.bus.limits import Buckets, Drops, Limit, Names
from zsched.link.bus.open_questions import QUESTION_TTL_S, Questions
from zsched.link.bus.seals import Seals
from zsched.link.keyspace import Keyspace, ParsedKey, counter, parse
from zsched.link.seal import Act
from zsched.link.sessions.expulsion import Expulsion, Refusal
from zsched.link.sessions.link_retries import LinkRetries
from zsched.link.sessions.link_sockets import LinkSockets, opened
from zsched.link.sessions.problems import why_not_open
from zsched.link.sessions.relink import Introducer

CLOSE_S = 0.5
COMMAND_TTL_S = MOST_ORDER_S + QUESTION_TTL_S
"""An operator's command is kept for longer than anybody waits for its end."""
AT_ONCE_SHARE = 0.9
"""zenoh ends a question at once where nobody is there to take it. One that lasted for this share of its time was taken,
or may have been."""
RING = 1024
"""Periodic frames that wait for the loop; if it does not come, the oldest go, and zenoh need not wait."""

MAX_LIVES = 1024
"""At most this many nodes' incarnations and sessions are remembered: commands to them are sealed for the former."""

Answer = Snapshot | CommandResult | Explanation | WorkerLines | HistoryTold | FleetTold | RehearsalsTold
Post = Callable[[ev.Event], None]
log = logging.getLogger("zsched.bus")

_PUTS: dict[str, type[Beat | Profile | Proposal | Learnt]] = {
    "beat": Beat,
    "profile": Profile,
    "proposal": Proposal,
    "allocation": Learnt,
}
_LIMITED = ("put", "question", "status", "answer", "token")
"""A peer has a bucket for each of these. Nodes pass questions for the status on, so any node may ask in any name."""
_QUESTIONS = frozenset({"utility", "register", "allocation", "document", "status", "command"})


def _event_of(value: Beat | Profile | Proposal | Learnt) -> tuple[NodeId, ev.Event]:
    """(the node that the content names, the event)."""
    if isinstance(value, Beat):
        return value.node, ev.BeatReceived(beat=value)
    if isinstance(value, Profile):
        return value.node, ev.ProfileReceived(profile=value)
    if isinstance(value, Proposal):
        return value.voter, ev.ProposalReceived(proposal=value)
    return value.node, ev.LearntReceived(learnt=value)


def answer_classes(command: Command | None) -> tuple[type[Answer], ...]:
    """What a node may answer to an operator's command, or (``None``) to the question for its status."""
    if command is None:
        return (Snapshot,)
    if isinstance(command, ReadFleet):
        return (FleetTold,)
    if isinstance(command, ReadRehearsals):
        return (RehearsalsTold, CommandResult)
    if isinstance(command, ReadHistory):
        return (HistoryTold, CommandResult)
    return (WorkerLines,) if isinstance(command, ReadLines) else (CommandResult, Explanation)


def signed_by(holder: Holder, command: Command) -> Command:
    """A command that tells who has ordered it, with the name of the certificate instead of what the tool says.

    A node signs for the programs of its machine, and tells whose they are.
    """
    if holder.role is Role.NODE:
        return asked_at(holder.name, command)
    return asked_by(holder.label, command) if isinstance(command, Ordered) else command


def task_of(command: Command) -> str:
    """The task that a command is about; empty: the fleet."""
    return str(getattr(command, "task", ""))


def _attachment(message: zenoh.Sample | zenoh.Query) -> bytes:
    return b"" if message.attachment is None else message.attachment.to_bytes()


class ControlBus:
    """One node's control session. ``post`` must only enqueue; all other methods are called from the loop."""

    def __init__(
        self,
        *,
        fleet: str,
        node: NodeId,
        incarnation: int,
        zenoh_config: str,
        post: Post,
        members: frozenset[str] | None = None,
        is_voter: bool = True,
        hears_all_beats_at_once: bool = True,
        seals: Seals | None = None,
        limit: Limit | None = None,
        names: Iterable[str] = (),
    ) -> None:
        """``members``: the names of certificates that belong to the fleet, ``None`` where none are asked for.

        A link of another name says nothing that zenoh would let in; it is counted, logged, ended. ``is_voter``: peers
        gather utilities here. Periodic frames are posted at once, or wait for `waiting`. ``seals``: ``None`` where
        nothing is sealed. ``limit``: what each of ``names`` may send, and all others together; ``None``: no limit.
        """
        self._seals, self._drops, self._refused_keys = seals, Drops(), Names()
        self._buckets = None if limit is None else {what: Buckets(limit, names) for what in _LIMITED}
        self._orders_of: frozenset[Holder] | None = None
        """Whose orders count; ``None``: of all that are let in."""
        self._lives: dict[NodeId, int] = {}
        """{node: its newest incarnation}, by the tokens."""
        self._is_voter, self._hears_all_at_once = is_voter, hears_all_beats_at_once
        self._ring: zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]] | None = None
        self._keys, self._members, self._fleet = Keyspace(fleet), members, fleet
        self._expulsion: Expulsion | None = None
        """Where certificates are asked for: elsewhere anybody can speak in anybody's name."""
        self._node, self._incarnation = node, incarnation
        self._config = zenoh_config
        self._introducer = Introducer(zenoh_config)
        self._zids: dict[NodeId, str] = {}
        """{node: the session that answered in its name last}."""
        self._sockets: LinkSockets | None = None
        self._retries: LinkRetries | None = None
        self._post = post
        self._questions = Questions(self._sealed_answer)
        self._session: zenoh.Session | None = None
        self._kept: list[Any] = []
        self._publishers: dict[str, zenoh.Publisher] = {}

    # --- life --------------------------------------------------------------------------------------------------------

    def open(self) -> None:
        """Open the session and declare everything.

        Raises:
            AdapterError: zenoh refuses (port taken, bad operator configuration).
        """
        zenoh.init_log_from_env_or("error")
        try:
            session = opened(self._config)
        except zenoh.ZError as error:
            raise AdapterError(f"the control session {why_not_open(self._config, error)}") from error
        self._session, self._sockets, self._retries = session, LinkSockets(session), LinkRetries(session)
        if self._members is not None:
            self._expulsion = Expulsion(session, self._fleet, self._members, self._refused)
        keys, node = self._keys, self._node
        self._publishers = {
            "beat": self._publisher(session, keys.beat(node), zenoh.Priority.REAL_TIME),
            "beat_in_turn": self._publisher(session, keys.beat_in_turn(node), zenoh.Priority.REAL_TIME),
            "profile": self._publisher(session, keys.profile(node), zenoh.Priority.INTERACTIVE_LOW),
            "profile_in_turn": self._publisher(
                session, keys.profile_in_turn(node), zenoh.Priority.REAL_TIME, is_express=False
            ),
            "proposal": self._publisher(session, keys.proposal(node), zenoh.Priority.INTERACTIVE_HIGH),
            "allocation": self._publisher(session, keys.allocation(node), zenoh.Priority.INTERACTIVE_HIGH),
        }
        token = keys.alive(node, self._incarnation)
        # The token goes last: a node that sees it may ask, and must find the queryable.
        self._kept = [
            session.declare_subscriber(keys.all_puts(), tolerant(self._on_sample, "put")),
            *self._hear_in_turn(session),
            *(session.declare_queryable(key, tolerant(self._on_query, "question")) for key in self._questions_to_us()),
            session.liveliness().declare_subscriber(
                keys.alive("*", "*"), tolerant(self._on_token, "token"), history=True
            ),
            session.liveliness().declare_token(token),
        ]

    def _hear_in_turn(self, session: zenoh.Session) -> list[Any]:
        """Subscribe to periodic frames: thirty a second in a small fleet, too many to wake up for each."""
        key = self._keys.all_in_turn()
        if self._hears_all_at_once:
            return [session.declare_subscriber(key, tolerant(self._on_sample, "put"))]
        self._ring = session.declare_subscriber(key, zenoh.handlers.RingChannel(RING))
        return [self._ring]

    def hear_all_at_once(self) -> None:
        """Wake the loop up for every periodic frame from now on: a task has become exclusive."""
        if self._hears_all_at_once or self._session is None:
            return
        self._hears_all_at_once = True
        ring, self._ring = self._ring, None
        self._kept += self._hear_in_turn(self._session)  # before the other one ends: none is missed
        if ring is not None:
            self._kept.remove(ring)
            ring.undeclare()

    def _questions_to_us(self) -> list[str]:
        """An edge has no utilities, so it is not to be asked for them."""
        keys, node = self._keys, self._node
        if self._is_voter:
            return [keys.all_questions(node)]
        asked = (keys.register, keys.learnt, keys.document, keys.status, keys.command)
        return [key(node, "*") for key in asked]

    def waiting(self) -> Iterator[ev.Event]:
        """The periodic beats and profiles that have come since the last call, and what was dropped (the loop)."""
        if self._retries is not None:
            self._retries.look()
        ring = self._ring
        while ring is not None and (sample := ring.handler.try_recv()) is not None:
            if (event := self._event(sample)) is not None:
                yield event
        for kind, reason, count in self._drops.take():
            yield ev.FrameDropped(kind=kind, reason=reason, count=count)
        for key in self._refused_keys.take():
            yield ev.LinkRefused(key=key)

    def _publisher(
        self, session: zenoh.Session, key: str, priority: zenoh.Priority, *, is_express: bool = True
    ) -> zenoh.Publisher:
        """One that is not express waits up to 1 ms for others of its priority, and shares their packet.

        So does a profile in turn, which leaves just before a beat.
        """
        return session.declare_publisher(
            key,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=priority,
            express=is_express,  # small and rare: not worth a batch's delay
            allowed_destination=zenoh.Locality.REMOTE,
        )

    def close(self) -> None:
        """Withdraw the token, then close; safe to call twice, returns within `CLOSE_S`.

        zenoh waits ten seconds for a frozen peer whose buffers are full; the thread that does ends with the process.
        """
        session, self._session = self._session, None
        if session is None:
            return
        self._introducer.close()
        if self._expulsion is not None:
            self._expulsion.close()
        kept, self._kept, self._publishers, self._ring = self._kept, [], {}, None
        if not ends_within(CLOSE_S, self._close, session, kept, name="zsched-bus-close"):
            log.warning("close_abandoned why=a peer does not read")

    def _close(self, session: zenoh.Session, kept: list[Any]) -> None:
        for entity in reversed(kept):
            with contextlib.suppress(zenoh.ZError):
                entity.undeclare()
        self._questions.clear()
        with contextlib.suppress(zenoh.ZError):
            session.close()

    def introduce_peers(self) -> None:
        """Let everybody hear of everybody's address again; returns at once (nothing where addresses are configured)."""
        self._introducer.introduce()

    def end_links(self, nodes: Iterable[NodeId]) -> None:
        """End the links to these nodes, as far as there are any over TCP; zenoh makes new ones."""
        if self._sockets is None or self._session is None:
            return
        names = {self._zids[node]: node for node in nodes if node in self._zids}
        with contextlib.suppress(zenoh.ZError):  # it is being closed
            for link in self._sockets.links() if names else ():
                if link.zid in names and link.cut():
                    log.warning("%s is gone and its link is up: the link to %s is ended", names[link.zid], link.name)

    def know(self, names: Iterable[str], limit: Limit | None = None) -> None:
        """Give new names of the fleet a bucket of their own; ``limit``: what each name may send from now on."""
        for buckets in (self._buckets or {}).values():
            buckets.know(names, limit)

    def take_orders_of(self, holders: Iterable[Holder]) -> None:
        """Of those that are let in let only these give orders from now on.

        The session itself lets in the same until it is opened anew. Meanwhile a key that is revoked, or a name that is
        gone, must not undo that by an order. A node that may give none is let in for good.
        """
        self._orders_of = frozenset(holders)

    def peers(self) -> int:
        """How many zenoh peers the session has a link to."""
        return 0 if self._session is None else len(self._session.info.peers_zid())

    # --- what comes in (zenoh's threads) -----------------------------------------------------------------------------

    def _is_let_in(self, what: str, kind: str, name: str) -> bool:
        """Whether a frame of that name is looked at; if not, it is counted."""
        if self._buckets is None or self._buckets[what].take(name, monotonic_s()):
            return True
        self._drops.add(kind, "rate")
        return False

    def _on_sample(self, sample: zenoh.Sample) -> None:
        if (event := self._event(sample)) is not None:
            self._post(event)

    def _event(self, sample: zenoh.Sample) -> ev.Event | None:
        key = parse(str(sample.key_expr))
        is_known = key is not None and key.kind in _PUTS
        if not self._is_let_in("put", key.kind if key and is_known else "key", key.owner if key else ""):
            return None
        if key is None or key.kind not in _PUTS:
            return ev.FrameDropped(kind="key", reason="unknown")
        try:
            frame = sample.payload.to_bytes()
            if self._seals is not None and key.kind in sealing.PUTS:
                self._seals.put(key.kind, str(sample.key_expr), frame, _attachment(sample), key.owner)
            value = wire.decode(frame, _PUTS[key.kind])
        except WireError as error:
            return ev.FrameDropped(kind=key.kind, reason=error.reason)
        owner, event = _event_of(value)
        return event if owner == key.owner else ev.FrameDropped(kind=key.kind, reason="foreign")

    def _refused(self, why: Refusal, name: str) -> None:
        self._drops.add("link", why)
        holder = parse_common_name(name, self._fleet) if why is Refusal.STRANGER else None
        if holder is not None:
            self._refused_keys.add(holder.label)

    def _on_token(self, sample: zenoh.Sample) -> None:
        key = parse(str(sample.key_expr))
        incarnation = counter(key.rest[0]) if key is not None and len(key.rest) == 1 else None
        if key is not None and self._expulsion is not None:
            is_fit = self._expulsion.shows(key.owner, is_present=sample.kind == zenoh.SampleKind.PUT)
            if not is_fit:
                self._drops.add("alive", "too_many")
                return
        if not self._is_let_in("token", "alive", key.owner if key is not None else ""):
            return
        if key is None or key.kind != "alive" or incarnation is None:
            self._post(ev.FrameDropped(kind="alive", reason="key"))
            return
        if key.owner in self._lives or len(self._lives) < MAX_LIVES:
            self._lives[key.owner] = max(self._lives.get(key.owner, 0), incarnation)
        if sample.kind == zenoh.SampleKind.PUT:
            self._post(ev.TokenSeen(node=key.owner, incarnation=incarnation))
        else:
            self._post(ev.TokenLost(node=key.owner, incarnation=incarnation))

    def _on_query(self, query: zenoh.Query) -> None:
        chunks = str(query.key_expr).split("/")
        kind, asker = chunks[2] if len(chunks) > 2 else "", chunks[-1]
        told = kind if kind in _QUESTIONS else "key"
        if not self._is_let_in("status" if kind == "status" else "question", told, asker):
            query.drop()
            return
        try:
            event = self._question(kind, asker, query)
        except WireError as error:
            event = ev.FrameDropped(kind=told, reason=error.reason)
            self._say_why_not(kind, asker, query, error)
            query.drop()
        self._post(event)

    def _say_why_not(self, kind: str, asker: str, query: zenoh.Query, error: WireError) -> None:
        """An operator that waits for a command's answer hears that its seal was refused."""
        if kind != "command" or error.reason not in tuple(sealing.SealFault):
            return
        result = CommandResult(outcome=CommandOutcome.INVALID, detail=f"{self._node} refused it: {error.reason}")
        query.reply(self._keys.command(self._node, asker), wire.encode(result))

    def _holder_of(self, asker: str) -> Holder | None:
        """Whose question it is that nobody has signed; ``None``: there are no certificates.

        zenoh's rules let who commands ask in its own name only, and a name is one holder's.
        """
        found = (parse_common_name(name, self._fleet) for name in self._members or ())
        return max((one for one in found if one is not None and one.name == asker), default=None)

    def _question(self, kind: str, asker: str, query: zenoh.Query) -> ev.Event:
        """The event of one query; the answer names its number."""
        if not NAME.fullmatch(asker):
            raise WireError("key", "no asker")
        payload = b"" if query.payload is None else query.payload.to_bytes()
        holder = None
        if self._seals is not None and kind in sealing.QUESTIONS:
            holder = self._seals.question(kind, str(query.key_expr), payload, _attachment(query), asker)
        keys, node = self._keys, self._node
        if kind == "utility":
            number = self._questions.keep(query, keys.utility(node, asker))
            return ev.UtilityAsked(request=number, asker=asker)
        if kind == "register":
            value: Any = wire.decode(payload, Prepare, Accept, FleetQuestion, Ballots)
            number = self._questions.keep(query, keys.register(node, asker))
            if isinstance(value, FleetQuestion):
                return ev.FleetAsked(request=number, asker=asker, question=value)
            if isinstance(value, Prepare):
                return ev.PrepareAsked(request=number, asker=asker, prepare=value)
            if isinstance(value, Ballots):
                return ev.BallotsAsked(request=number, asker=asker, ballots=value)
            return ev.AcceptAsked(request=number, asker=asker, accept=value)
        if kind == "allocation":
            return ev.LearntAsked(request=self._questions.keep(query, keys.learnt(node, asker)))
        if kind == "document":
            wanted = wire.decode(payload, AskDocument).document
            return ev.DocumentAsked(request=self._questions.keep(query, keys.document(node, asker)), document=wanted)
        if kind == "status":
            return ev.StatusAsked(request=self._questions.keep(query, keys.status(node, asker)))
        if kind == "command":
            command: Any = wire.decode(payload, *COMMANDS)
            if not isinstance(command, Asking):
                asking = holder or self._holder_of(asker)
                if asking is not None and self._orders_of is not None and asking not in self._orders_of:
                    log.warning("refused command=%s from=%s why=it may give none", type(command).__name__, asking.label)
                    raise WireError(sealing.SealFault.SIGNER, f"{asking.label} may give no orders")
                log.info("command=%s from=%s", type(command).__name__, asker)
                if asking is not None:
                    command = signed_by(asking, command)
                if holder is not None:
                    self._post(ev.Commanded(by=holder.label, what=type(command).__name__, task=task_of(command)))
            return commanded(self._questions.keep(query, keys.command(node, asker), COMMAND_TTL_S), command)
        raise WireError("key", "unknown kind")

    # --- what goes out (the loop) ------------------------------------------------------------------------------------

    def publish(self, kind: str, value: object) -> None:
        """Put one value under our own key of that kind (``beat``, ``profile``, ``proposal``, ``allocation``).

        Raises:
            AdapterError: the session is closed or refuses.
        """
        publisher = self._publishers.get(kind)
        if publisher is None:
            return
        try:
            frame = wire.encode(value)
            if self._seals is None or kind not in sealing.PUTS:
                publisher.put(frame)
            else:
                publisher.put(frame, attachment=self._seals.seal(Act.PUT, str(publisher.key_expr), frame))
        except (zenoh.ZError, WireError) as error:
            raise AdapterError(f"cannot publish {kind}: {error}") from error

    def answer(self, request: int, value: object) -> None:
        """Answer a question of a peer or an operator."""
        try:
            self._questions.answer(request, value)
        except (zenoh.ZError, WireError) as error:
            raise AdapterError(f"cannot answer question {request}: {error}") from error

    def answer_nothing(self, request: int) -> None:
        """End a question of a peer without an answer."""
        self._questions.drop(request)

    def ask_utilities(self, gather: int, deadline_s: float) -> None:
        """One query to every robot; answers are posted as they come."""

        def on_answer(owner: NodeId, value: Utilities, _zid: str) -> None:
            if owner == value.voter:
                self._post(ev.UtilityReceived(gather=gather, utilities=value))
            else:
                self._post(ev.FrameDropped(kind="utility", reason="foreign"))

        self._ask(self._keys.utility("*", self._node), None, deadline_s, (Utilities,), on_answer, is_remote=True)

    def ask_electors(self, question: Prepare | Accept | Ballots, deadline_s: float) -> None:
        """One query to every elector, ourselves included; answers are posted as they come."""

        def on_answer(owner: NodeId, value: Promise | Accepted | Refused | Votes, _zid: str) -> None:
            if owner != value.elector:
                self._post(ev.FrameDropped(kind="register", reason="foreign"))
            elif isinstance(value, Votes):
                self._post(ev.VotesReceived(votes=value))
            else:
                self._post(ev.ElectorAnswered(answer=value))

        kinds = (Promise, Accepted, Refused) if isinstance(question, Prepare | Accept) else (Votes,)
        self._ask(self._keys.register("*", self._node), wire.encode(question), deadline_s, kinds, on_answer)

    def ask_fleet(self, question: FleetQuestion, deadline_s: float) -> None:
        """One query to every node, ourselves included: electors answer; answers are posted as they come."""

        def on_answer(owner: NodeId, value: FleetAnswer, _zid: str) -> None:
            if owner == value.content.elector:
                self._post(ev.FleetAnswered(answer=value))
            else:
                self._post(ev.FrameDropped(kind="register", reason="foreign"))

        self._ask(self._keys.register("*", self._node), wire.encode(question), deadline_s, (FleetAnswer,), on_answer)

    def ask_learnt(self, peer: NodeId, deadline_s: float) -> None:
        """Ask one peer for what it has learnt."""

        def on_answer(owner: NodeId, value: Learnt, zid: str) -> None:
            if owner == value.node == peer:
                self._post(ev.LearntReceived(learnt=value, is_answer=True, where=self._where(zid)))
            else:
                self._post(ev.FrameDropped(kind="allocation", reason="foreign"))

        self._ask(self._keys.learnt(peer, self._node), None, deadline_s, (Learnt,), on_answer, is_remote=True)

    def _where(self, zid: str) -> str:
        """The address at the other end of the link to a session; empty: there is none."""
        session = self._session
        if session is not None:
            with contextlib.suppress(zenoh.ZError):  # it is being closed
                ends = (str(link.dst) for link in session.info.links() if str(link.zid) == zid)
                return next((end.partition("?")[0] for end in ends), "")
        return ""

    def _ask(
        self,
        selector: str,
        payload: bytes | None,
        deadline_s: float,
        classes: tuple[type[Any], ...],
        on_answer: Callable[[NodeId, Any, str], None],
        *,
        is_remote: bool = False,
    ) -> None:
        question = self._attachment_of(selector, payload)

        def on_reply(reply: zenoh.Reply) -> None:
            sample = reply.ok
            if sample is None:
                return  # the deadline passed for somebody: the core counts answers, not silences
            key = parse(str(sample.key_expr))
            if not self._is_let_in("answer", "key" if key is None else key.kind, "" if key is None else key.owner):
                return
            replier = reply.replier_id
            zid = "" if replier is None else str(replier.zid)
            try:
                self._judge_link(key, zid)
                self._judge_answer(key, sample, question)
                value = wire.decode(sample.payload.to_bytes(), *classes)
            except WireError as error:
                self._post(ev.FrameDropped(kind=key.kind if key is not None else "key", reason=error.reason))
                return
            if key is not None:
                if zid and (key.owner in self._zids or len(self._zids) < MAX_LIVES):
                    self._zids[key.owner] = zid
                on_answer(key.owner, value, zid)

        if self._session is None:
            return
        try:
            self._session.get(
                selector,
                tolerant(on_reply, "answer"),
                payload=payload,
                attachment=question or None,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,  # the default withholds all answers for a frozen peer
                timeout=deadline_s,
                priority=zenoh.Priority.INTERACTIVE_HIGH,
                express=True,
                allowed_destination=zenoh.Locality.REMOTE if is_remote else zenoh.Locality.ANY,
            )
        except zenoh.ZError as error:
            raise AdapterError(f"cannot ask {selector}: {error}") from error

    def _attachment_of(self, selector: str, payload: bytes | None) -> bytes:
        """A question's seal, or a number of its own, with which its answers are signed; empty: neither."""
        kind = selector.split("/")[2]
        if self._seals is None or kind not in sealing.ANSWERS:
            return b""
        if kind not in sealing.QUESTIONS:
            return sealing.nonce()
        return self._seals.seal(Act.QUESTION, selector, payload or b"", life=0)

    def _judge_link(self, key: ParsedKey | None, zid: str) -> None:
        """An answer is in the name of the certificate at the other end of its link; of a put zenoh tells no link."""
        if key is not None and self._expulsion is not None and self._expulsion.contradicts(zid, key.owner):
            log.warning("an answer in the name of %s came from %s, whose certificate is another", key.owner, zid)
            raise WireError("link", "another certificate")

    def _judge_answer(self, key: ParsedKey | None, sample: zenoh.Sample, question: bytes) -> None:
        if self._seals is None or key is None or key.kind not in sealing.ANSWERS:
            return
        frame, attachment = sample.payload.to_bytes(), _attachment(sample)
        self._seals.answer(key.kind, str(sample.key_expr), frame, attachment, key.owner, question)

    def _sealed_answer(self, key: str, frame: bytes, question: bytes) -> bytes | None:
        """The seal of an answer under ``key``; ``None``: this kind has none."""
        if self._seals is None or key.split("/")[2] not in sealing.ANSWERS:
            return None
        return self._seals.seal(Act.ANSWER, key, frame, question=question)

    # --- for the library (a thread of its own) -----------------------------------------------------------------------

    def fetch_document(self, peer: NodeId, document: str, deadline_s: float) -> bytes | None:
        """The frame of a document that ``peer`` has stored, or ``None``; blocks up to ``deadline_s``.

        Nothing is checked: the caller compares the hash.
        """
        session = self._session
        if session is None:
            return None
        try:
            replies = session.get(
                self._keys.document(peer, self._node),
                payload=wire.encode(AskDocument(document=document)),
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=deadline_s,
                allowed_destination=zenoh.Locality.REMOTE,
            )
            return next((reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None), None)
        except zenoh.ZError:
            return None  # it is being closed

    # --- for operators (a thread of their own) -----------------------------------------------------------------------

    def ask_node(self, node: NodeId, command: Command | None, within_s: float) -> Answer:
        """Ask another node for its status or an answer, or give it a command; blocks up to ``within_s``.

        Never in the loop.

        Raises:
            AdapterError: it did not answer. With the cause `TimeoutError` it may have taken the command; without one,
                nobody was there to take it.
        """
        if self._session is None:
            raise AdapterError("the control session is closed")
        if command is None:
            selector, payload = self._keys.status(node, self._node), None
        else:
            selector, payload = self._keys.command(node, self._node), wire.encode(command)
        kinds = answer_classes(command)
        attachment = None
        if self._seals is not None and payload is not None:
            attachment = self._seals.seal(Act.QUESTION, selector, payload, life=self._lives.get(node, 0))
        asked = monotonic_s()
        for reply in self._session.get(
            selector,
            payload=payload,
            attachment=attachment,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=within_s,
        ):
            if reply.ok is None:
                continue
            try:
                answer: Answer = wire.decode(reply.ok.payload.to_bytes(), *kinds)
            except WireError as error:
                raise AdapterError(f"{node} answered something else ({error}); is it another version?") from error
            return answer
        silence = TimeoutError() if monotonic_s() - asked >= AT_ONCE_SHARE * within_s else None
        raise AdapterError(f"{node} did not answer within {within_s:g} s; is it up and reachable?") from silence
