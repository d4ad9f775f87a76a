"""A worker's state on its way to the next owner: offered in chunks, fetched before the first input, checked as a whole.

Knows: chunks, their checksum, how long a new owner waits. Does not know: what is in a snapshot, when roles change.

One query, many replies. The first says that the state is `COMING`; each other one is a chunk of at most `CHUNK` bytes,
its attachment a `SnapshotChunk` that names its place, the size of the whole and its checksum. A new owner waits
``timeout_s`` for all of them: an owner that is left because its machine is busy is long about its first word, too.
Before that word the wait ends once the node takes the predecessor's machine for gone. Whatever goes wrong is a cold
start with a reason, never an error.

The question names the epoch that begins. A predecessor that still waits for its own predecessor's state answers behind
it, and one that was not the owner of the epoch before has none: else an empty state, or an old one, would pass for it.
"""

from __future__ import annotations

import hashlib
import logging
import math
import queue
import threading
from collections.abc import Callable
from typing import Final, Protocol

import zenoh

from zsched.core.values.model import NodeId
from zsched.core.values.plan import Role, WorkerRole
from zsched.core.values.relay_protocol import ERROR_ENCODING, SnapshotChunk
from zsched.core.values.struct import Struct
from zsched.host.clock import monotonic_s
from zsched.host.guard import call_plain, guarded, tolerant
from zsched.link.keyspace import counter
from zsched.link.pipe.frames import decode_chunk, encode_chunk
from zsched.link.sessions.config import on_top_of, relay_endpoint, setting
from zsched.worker.troubles import Troubles

CHUNK: Final = 256 * 1024
MAX_SNAPSHOT: Final = 32 << 20
"""Bytes; a larger one is refused by both sides."""
COMING: Final = b"coming"
"""Attachment of the reply that says, before a worker is asked for its state, that somebody is there who has one."""
SLICE_S: Final = 0.02
"""Silence is counted in pieces of this length: a time in which this process did not run is no silence of another."""
TIMEOUT_S: Final = 2.0
EPOCH: Final = "epoch"
"""Parameter of the question: the epoch that begins. Workers of older versions neither name nor read it."""
TOLD_S: Final = 0.5
"""A successor may learn of a move before the predecessor's worker has heard that it was the owner."""
SETTLE_S: Final = 5.0
"""A predecessor waits so long for its own state before it refuses: longer than a successor waits for it."""
MAX_WAITING: Final = 4
"""Questions that wait in threads of their own, so that others are answered meanwhile; further ones are refused."""
CONTEST_S: Final = 0.1
"""A whole state waits this long for another answer to the same question."""
MAX_OFFERS: Final = 2
NOBODY, GONE = "nobody offers one", "its machine is gone"
"""Why there is no state: its worker cannot be reached or offers none, or its machine has left the fleet."""
RELAY_S: Final = 5.0
"""A worker that starts waits this long for its node's relay, which may start later than it does (or again)."""

_log = logging.getLogger("zsched.worker")


class StateLink:
    """The session for snapshots: a client of this node's relay, opened when it is first needed.

    Workers are peers, and peers carry nothing between two others: two workers of different machines need not have a
    link of their own. Their nodes' relays have, and a relay does carry for its clients.
    """

    def __init__(self, main: zenoh.Session, zenoh_config: str) -> None:
        """``zenoh_config``: that of the worker's ``main`` session (JSON5), whose first ``connect`` is the relay."""
        self._main, self._zenoh_config = main, zenoh_config
        self._lock = threading.Lock()
        self._own: zenoh.Session | None = None
        self._has_told = False

    @property
    def session(self) -> zenoh.Session:
        """The session; the worker's own one where that is a client already, or no relay is known.

        Where the relay cannot be reached it is the worker's own one for now: a later call tries again.
        """
        with self._lock:
            if self._own is None:
                self._own = self._opened()
            return self._main if self._own is None else self._own

    def open(self) -> None:
        """Open it now, so that it need not be in a move."""
        _ = self.session

    def close(self) -> None:
        """Close it, if it was opened."""
        own = self._own
        if own is not None and own is not self._main:
            own.close()

    def _opened(self) -> zenoh.Session | None:
        try:
            relay = relay_endpoint(self._zenoh_config)
            if setting(self._zenoh_config, "mode") == "client" or not relay:
                return self._main
            # Its one link is to its own relay, which judges what comes; by a peer's rules that one speaks for its own
            # node only, and another node's state would not be let in.
            own = {
                "mode": "client",
                "listen/endpoints": [],
                "connect/endpoints": [relay],
                "access_control/enabled": False,
            }
            own["connect/timeout_ms"] = round(RELAY_S * 1000)
            config = zenoh.Config.from_json5(on_top_of(self._zenoh_config, own))
            return zenoh.open(config)
        except (zenoh.ZError, ValueError) as error:
            if not self._has_told:
                _log.warning("no session of its own for snapshots yet (%s): only direct neighbours are asked", error)
                self._has_told = True
            return None


class Offer:
    """The queryable under which a worker's successor finds its state."""

    def __init__(
        self,
        session: zenoh.Session,
        key: str,
        snapshot: Callable[[], bytes | bytearray],
        troubles: Troubles,
        book: StateBook,
    ) -> None:
        """Declare it; ``snapshot`` is called in a thread of its own, once per query, when ``book`` says that it may."""
        self._key = key
        self._snapshot = snapshot
        self._troubles = troubles
        self._book = book
        self._waiting = threading.Semaphore(MAX_WAITING)
        self._saving = threading.Lock()
        self._moving = threading.Lock()
        self._session, self._queryable = session, self._declared(session)

    def offer_by(self, session: zenoh.Session) -> None:
        """Offer it by this session from now on, if it was another one."""
        with self._moving:
            if session is self._session:
                return
            try:
                before, self._queryable, self._session = self._queryable, self._declared(session), session
                before.undeclare()
            except zenoh.ZError as error:  # one of them is closed: the worker ends
                _log.info("the snapshot is offered by the session of before (%s)", error)

    def undeclare(self) -> None:
        """Offer it no more."""
        with self._moving:
            self._queryable.undeclare()

    def _declared(self, session: zenoh.Session) -> zenoh.Queryable[None]:
        return session.declare_queryable(self._key, tolerant(self._hear, "snapshot"), complete=True)

    def _hear(self, query: zenoh.Query) -> None:
        epoch = _asked_for(query)
        if not self._book.must_wait(epoch):
            self._take(query, epoch)
        elif self._waiting.acquire(blocking=False):
            try:
                guarded(self._wait, query, epoch, name="zsched offer", is_lasting=False).start()
            except RuntimeError as error:  # no thread is to be had
                self._waiting.release()
                self._take(query, epoch, str(error))
        else:
            self._take(query, epoch, "too many questions wait")

    def _wait(self, query: zenoh.Query, epoch: int | None) -> None:
        try:
            self._take(query, epoch)
        finally:
            self._waiting.release()

    def _take(self, query: zenoh.Query, epoch: int | None, why_not: str = "") -> None:
        try:
            with query:
                if why_not:
                    self._refuse(query, epoch, why_not)
                else:
                    self._answer(query, epoch)
        except zenoh.ZError as error:
            _log.info("a snapshot could not be sent (%s)", error)

    def _answer(self, query: zenoh.Query, epoch: int | None) -> None:
        query.reply(self._key, b"", attachment=COMING)
        if why_not := self._book.settle(epoch):
            self._refuse(query, epoch, why_not)
            return
        try:
            with self._saving:
                content = _copied(self._snapshot())
        except BaseException as error:  # noqa: BLE001 - the worker's own bug is the successor's cold start
            self._troubles.note("offer_snapshot", error)
            query.reply_err(f"failed: {type(error).__name__}: {error}"[:400], encoding=ERROR_ENCODING)
            return
        if len(content) > MAX_SNAPSHOT:
            _log.warning("the snapshot has %d bytes, at most %d are carried", len(content), MAX_SNAPSHOT)
            query.reply_err(f"too large: {len(content)} bytes, at most {MAX_SNAPSHOT}", encoding=ERROR_ENCODING)
            return
        for chunk, part in chunks(content):
            query.reply(self._key, part, attachment=encode_chunk(chunk))

    @staticmethod
    def _refuse(query: zenoh.Query, epoch: int | None, why_not: str) -> None:
        _log.info("no state for epoch %s: %s", epoch, why_not)
        query.reply_err(why_not, encoding=ERROR_ENCODING)


def _asked_for(query: zenoh.Query) -> int | None:
    """The epoch that begins; ``None``: the question names none, or nonsense."""
    return counter(query.parameters.get(EPOCH) or "")


def _copied(state: bytes | bytearray) -> bytes:
    """What the worker has given, which nobody changes on its way."""
    if not isinstance(state, bytes | bytearray):
        raise TypeError(f"a snapshot is bytes, not {type(state).__name__}")
    return bytes(state)


def chunks(content: bytes) -> list[tuple[SnapshotChunk, bytes]]:
    """``content`` cut up; at least one chunk, each with what is needed to check the whole."""
    checksum = _checksum(content)
    starts = range(0, max(1, len(content)), CHUNK)
    return [
        (
            SnapshotChunk(index=index, count=len(starts), size=len(content), checksum=checksum),
            content[start : start + CHUNK],
        )
        for index, start in enumerate(starts)
    ]


def _checksum(content: bytes) -> str:
    return hashlib.blake2s(content, digest_size=16).hexdigest()


class Assembly:
    """Puts chunks together, in any order; chunks of two workers (one is restarting) never mix."""

    def __init__(self) -> None:
        self._parts: dict[tuple[str, int, int], dict[int, bytes]] = {}

    @property
    def is_contested(self) -> bool:
        """Whether two different states are offered: one of them is a stranger's."""
        return len(self._parts) > 1

    def add(self, chunk: SnapshotChunk, part: bytes) -> bytes | str | None:
        """The whole content once it is complete, why it cannot be (``str``), ``None`` while something is missing.

        What is kept is bounded: `MAX_OFFERS` states of `MAX_SNAPSHOT` bytes.
        """
        if chunk.size > MAX_SNAPSHOT or chunk.count != max(1, -(-chunk.size // CHUNK)) or chunk.index >= chunk.count:
            return f"a chunk that fits no snapshot ({chunk.index} of {chunk.count}, {chunk.size} bytes)"
        if len(part) != min(CHUNK, chunk.size - chunk.index * CHUNK):
            return f"corrupt: piece {chunk.index} of {chunk.count} has {len(part)} bytes"
        name = (chunk.checksum, chunk.count, chunk.size)
        if name not in self._parts and len(self._parts) >= MAX_OFFERS:
            return "too many different states"
        parts = self._parts.setdefault(name, {})
        parts[chunk.index] = part
        if len(parts) < chunk.count:
            return None
        content = b"".join(parts[index] for index in range(chunk.count))
        if _checksum(content) != chunk.checksum:
            return "corrupt: its checksum does not match"
        return content


def fetch(session: zenoh.Session, key: str, epoch: int, timeout_s: float, is_gone: Callable[[], bool]) -> bytes | str:
    """The snapshot under ``key`` for the ``epoch`` that begins, or why there is none.

    It takes ``timeout_s`` at most, and ends before the first word of a predecessor whose machine ``is_gone``.
    """
    replies: queue.SimpleQueue[zenoh.Reply | None] = queue.SimpleQueue()
    token = zenoh.CancellationToken()
    until = monotonic_s() + timeout_s
    try:
        session.get(
            f"{key}?{EPOCH}={epoch}",
            zenoh.handlers.Callback(tolerant(replies.put, "snapshot"), lambda: replies.put(None), indirect=False),
            target=zenoh.QueryTarget.ALL,  # a stranger's offer may call itself complete, and must not be the only one
            timeout=timeout_s + 1.0,
            consolidation=zenoh.ConsolidationMode.NONE,
            cancellation_token=token,
        )
        return _assembled(replies, timeout_s, until, is_gone)
    except zenoh.ZError as error:
        return f"it could not be asked for ({error})"
    finally:
        token.cancel()


def _assembled(
    replies: queue.SimpleQueue[zenoh.Reply | None], timeout_s: float, until: float, is_gone: Callable[[], bool]
) -> bytes | str:
    """The one state that is offered. Another answer is waited for, shortly: two states are one too many."""
    assembly = Assembly()
    has_come, whole, problem = False, b"", ""
    is_whole = False
    while True:
        try:
            reply = _next_reply(
                replies, CONTEST_S if is_whole else math.inf, until, (lambda: False) if has_come else is_gone
            )
        except queue.Empty:
            if is_whole:
                break
            if has_come:
                return problem or "late: it had not come in time"
            return GONE if is_gone() else f"no answer within {timeout_s:g} s"
        if reply is None:
            break
        has_come = True
        result = None if _is_coming(reply) else _added(assembly, reply)
        if isinstance(result, bytes):
            is_whole, whole = True, result
        problem = result if isinstance(result, str) else problem
        if monotonic_s() >= until:
            return "late: it had not come in time"
    if assembly.is_contested:
        return "contested: two different states are offered"
    if is_whole:
        return whole
    return problem or ("incomplete: its worker died meanwhile" if has_come else NOBODY)


def _next_reply(
    replies: queue.SimpleQueue[zenoh.Reply | None], silence_s: float, until: float, is_gone: Callable[[], bool]
) -> zenoh.Reply | None:
    """The next one, ``None``: there are no more.

    `queue.Empty`: a silence of ``silence_s``, it is ``until``, or who should answer ``is_gone``.
    """
    quiet_s = 0.0
    while True:
        piece_s = max(0.0, min(SLICE_S, silence_s - quiet_s, until - monotonic_s()))
        try:
            return replies.get(timeout=piece_s)
        except queue.Empty:
            quiet_s += SLICE_S
            if quiet_s >= silence_s or monotonic_s() >= until or is_gone():
                raise


def _is_coming(reply: zenoh.Reply) -> bool:
    sample = reply.ok
    return sample is not None and sample.attachment is not None and sample.attachment.to_bytes() == COMING


def _added(assembly: Assembly, reply: zenoh.Reply) -> bytes | str | None:
    sample = reply.ok
    if sample is None:
        error = reply.err
        said = "" if error is None else error.payload.to_bytes()[:200].decode(errors="replace")
        return f"refused: {said}" if error is not None else "an empty reply"
    chunk = decode_chunk(sample.attachment.to_bytes()) if sample.attachment is not None else None
    if chunk is None:
        return "corrupt: a piece without its place"
    return assembly.add(chunk, sample.payload.to_bytes())


class _Fetched(Struct, frozen=True):
    epoch: int
    predecessor: NodeId
    content: bytes | str
    took_s: float


class StateBook:
    """What a worker's state is: whether it ever had a task's, and whether a predecessor's is on its way to it.

    Calls come from several threads.
    """

    def __init__(self) -> None:
        self.longest_s = SETTLE_S
        """A question waits so long for the state that is on its way here."""
        self._changed = threading.Condition()
        self._is_ready = False
        self._worked = 0
        """The newest epoch in which this worker was told to work."""
        self._coming = 0
        """The epoch whose predecessor's state is on its way here; 0: none is."""
        self._overtaken = 0
        """The newest epoch whose state was on its way when the next epoch came; 0: one that began since has one."""
        self._begun, self._is_cold = 0, False
        """The newest epoch that has begun here, and whether it has done so without its predecessor's state."""

    def ready(self) -> None:
        """This worker has said what it takes and offers."""
        with self._changed:
            self._is_ready = True
            self._changed.notify_all()

    def work(self, epoch: int) -> None:
        """This worker is told to work in ``epoch``."""
        with self._changed:
            self._worked = max(self._worked, epoch)
            self._changed.notify_all()

    def expect(self, epoch: int) -> None:
        """The state that ``epoch`` begins with is on its way."""
        with self._changed:
            self._overtaken = self._coming or self._overtaken
            self._coming = epoch
            self._changed.notify_all()

    def begun(self, epoch: int, *, is_cold: bool) -> None:
        """``epoch`` has begun with its predecessor's state, or without (``is_cold``)."""
        with self._changed:
            self._begun, self._is_cold = epoch, is_cold
            self._coming = 0 if self._coming == epoch else self._coming
            self._overtaken = 0 if epoch > self._overtaken else self._overtaken
            self._changed.notify_all()

    def must_wait(self, epoch: int | None) -> bool:
        """Whether `settle` would not answer at once."""
        with self._changed:
            return self._comes_for(epoch) or self._is_early(epoch)

    def settle(self, epoch: int | None) -> str:
        """Wait until there is what ``epoch`` is to begin with; why there is nothing (empty: there is).

        ``None``: the asker's version does not name its epoch.
        """
        with self._changed:
            self._changed.wait_for(lambda: not self._is_early(epoch), TOLD_S)
            if self._is_early(epoch):
                lack = f"was not the owner of epoch {(epoch or 1) - 1}" if self._is_ready else "is not ready"
                return f"its worker {lack}"
            if not self._comes_for(epoch):
                return self._why_not(epoch)
            awaited, had_one = self._coming, self._begun > 0
            self._changed.wait_for(lambda: self._coming != awaited, self.longest_s)
            if self._begun >= awaited and (had_one or not self._is_cold):
                return ""
            return _lacking(awaited)

    def _why_not(self, epoch: int | None) -> str:
        """A state that never came is missing in what is here."""
        is_missing = self._overtaken > 0 and (epoch is None or epoch > self._overtaken)
        return _lacking(self._overtaken) if is_missing else ""

    def _comes_for(self, epoch: int | None) -> bool:
        """Whether a state is on its way that comes before ``epoch``.

        What comes for a later one changes nothing: A, the owner again, has what B, the owner in between, asks for.
        """
        return self._coming > 0 and (epoch is None or self._coming < epoch)

    def _is_early(self, epoch: int | None) -> bool:
        """Whether this worker has not worked in the epoch before, as far as it has heard."""
        return epoch is not None and not (self._is_ready and self._worked >= epoch - 1)


def _lacking(epoch: int) -> str:
    return f"its worker has not got the state of epoch {epoch} itself"


class Restorer:
    """A new owner's side: while it `is_pending`, no input is processed and nothing is put out.

    `note` says that a role has come, `begin` starts the fetch in a thread of its own, `deliver` lets ``inputs`` go on
    behind the worker's callback. Calls come from several threads.
    """

    def __init__(
        self,
        fetched: Callable[[NodeId, int, float, Callable[[], bool]], bytes | str],
        node: NodeId,
        inputs: Held,
        tell: Callable[[str], None],
        book: StateBook,
    ) -> None:
        """``fetched``: (predecessor, epoch, longest wait, whether its machine is gone) -> the state, or why not.

        ``book`` is told of it for this worker's own offer; ``tell`` lets the node know of a state that is lost here.
        """
        self._fetch, self._tell = fetched, tell
        self._node = node
        self._inputs = inputs
        self._book = book
        self._lock = threading.RLock()
        self._callback: Callable[[bytes], None] | None = None
        self._timeout_s = TIMEOUT_S
        self._noted: Role | None = None
        self._is_gone = threading.Event()
        """The node takes the machine of the noted role's predecessor for gone; one for each fetch."""
        self._has_begun = False
        self._result: _Fetched | None = None
        self.is_pending = False
        """A snapshot is on its way: this worker is not the owner yet."""
        self.restored = 0
        self.cold_starts = 0

    @property
    def has_callback(self) -> bool:
        """Whether the worker takes a state over."""
        return self._callback is not None

    def register(self, callback: Callable[[bytes], None], timeout_s: float) -> None:
        """Take the worker's callback."""
        self._callback, self._timeout_s = callback, timeout_s
        self._book.longest_s = max(SETTLE_S, timeout_s + SETTLE_S / 2)

    def note(self, role: Role) -> None:
        """A role has come: stop the inputs when it begins an epoch that has a predecessor to ask.

        One of the same epoch without a predecessor says that its machine is gone.
        """
        with self._lock:
            noted = self._noted
            is_new = noted is None or role.epoch > noted.epoch
            # an older daemon's role that drains never names a predecessor
            names = role.role is WorkerRole.ACTIVE or (noted is not None and noted.role is WorkerRole.DRAINING)
            if names and noted is not None and noted.epoch == role.epoch and role.predecessor is None:
                self._is_gone.set()
            if role.role is WorkerRole.IDLE:
                return
            # from here on also one that drains: it was told too late that it is the owner
            asks = role.predecessor not in (None, self._node)
            self._book.work(role.epoch)
            if is_new and not asks:
                self._book.begun(role.epoch, is_cold=False)  # what is here is the task's
            if self._callback is None or not is_new or not asks:
                return
            self._noted, self._is_gone, self._has_begun, self._result = role, threading.Event(), False, None
            self.is_pending = True
            self._book.expect(role.epoch)
            self._inputs.hold()

    def begin(self, role: Role, then: Callable[[], None]) -> bool:
        """Start the fetch of this role's epoch, once; ``then`` follows in its thread. ``False``: nothing to await."""
        with self._lock:
            noted = self._noted
            is_ours = noted is not None and noted.epoch == role.epoch
            if not self.is_pending or not is_ours or noted is None or noted.predecessor is None:
                return False
            if self._has_begun:
                return self._result is None  # under way: a second asker (a lease was renewed) waits like the first
            self._has_begun = True
            arguments = (role.epoch, noted.predecessor, self._is_gone, then)
        try:
            guarded(self._run, *arguments, name="zsched restore", is_lasting=False).start()
        except RuntimeError:  # no thread is to be had; who waits for nothing would never be the owner
            self._run(*arguments)
        return True

    def deliver(self, epoch: int) -> None:
        """Hand over what has come, in the dispatch thread, and let the inputs follow; nothing while it is awaited.

        What has come for another epoch waits for that one's own call, behind which its inputs are processed.
        """
        with self._lock:
            result = self._result
            if result is None or result.epoch != epoch:
                return
            self._result = None
            self._inputs.release(lambda: self._hand_over(result))  # under the lock: the next epoch's hold comes behind

    def _run(self, epoch: int, predecessor: NodeId, gone: threading.Event, then: Callable[[], None]) -> None:
        started = monotonic_s()
        try:
            content = self._fetch(predecessor, epoch, self._timeout_s, gone.is_set)
        except Exception as error:  # noqa: BLE001 - no room for the state, say: whatever it is, the inputs wait for us
            _log.exception("the state could not be asked for")
            content = f"failed: {type(error).__name__}: {error}"
        with self._lock:
            if self._noted is not None and self._noted.epoch == epoch:  # else the next epoch's fetch goes on
                self._result = _Fetched(epoch, predecessor, content, monotonic_s() - started)
        then()

    def _hand_over(self, result: _Fetched) -> bool:
        """Give the worker its predecessor's state; answers whether it has it."""
        content, callback = result.content, self._callback
        if isinstance(content, bytes) and callback is not None:
            try:
                call_plain(callback, content)
            except BaseException:  # noqa: BLE001 - the worker goes on cold
                _log.exception("the worker's on_snapshot failed")
                content = "its own on_snapshot failed"
        with self._lock:
            is_newest = self._noted is not None and self._noted.epoch == result.epoch
            self.is_pending = self.is_pending and not is_newest
            self.restored += isinstance(content, bytes)
            self.cold_starts += isinstance(content, str)
        self._book.begun(result.epoch, is_cold=isinstance(content, str))
        where = (result.epoch, result.predecessor)
        if isinstance(content, bytes):
            took_ms = result.took_s * 1000
            _log.info("restored epoch=%d from=%s bytes=%d took_ms=%.0f", *where, len(content), took_ms)
        else:
            _log.warning("cold_start epoch=%d from=%s why=%r", *where, content)
            self._tell(f"began epoch {result.epoch} without the state of {result.predecessor}: {content}")
        return isinstance(content, bytes)


class Held(Protocol):
    """What a `Restorer` stops and starts: `zsched.worker.inputs.Dispatcher` is one."""

    def hold(self) -> None:
        """Process no input until `release`."""

    def release(self, first: Callable[[], bool]) -> None:
        """Call ``first`` in the dispatch thread, then go on; it answers whether the worker's state is another now."""
