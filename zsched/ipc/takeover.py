"""Where a relay that outlived its daemon is found again: a socket, and a lock with a note.

Knows: the files of a node's relay in the runtime folder, flock(2), the words before the pipe's first frame. Does
not know: how relays are started, zenoh, plans.

The lock is held by the relay process alone, by a file description it inherits, so the kernel gives it back however the
relay ends: as long as it is held there is exactly one relay, and the note in the file is about it. The relay accepts
connections on the socket only while it has no daemon.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import select
import socket
import struct
from collections.abc import Callable
from dataclasses import asdict
from hashlib import blake2s
from pathlib import Path
from typing import Any, Final

from zsched.clock import awake_s
from zsched.core.values.model import NodeId
from zsched.core.values.struct import Struct
from zsched.errors import AdapterError, WireError
from zsched.ipc.pipe import read_frame, write_frame
from zsched.ipc.protocol import RelayHello, RelayHere, RelayRefused
from zsched.wire import codec as wire

PROTOCOL: Final = 2
"""Another one of a relay and a daemon means: the relay is replaced. Raised whenever one of them would misunderstand the
other, or needs a word that the other does not know (the codec reads past what it does not know)."""
GREETING_S: Final = 1.0
"""A relay that does not answer for this long is no relay to go on with."""
_ANSWERS: Final[tuple[type[Any], ...]] = (RelayHere, RelayRefused)
_LOCK: Final = ".relay.lock"
_TIMEVAL: Final = struct.Struct("ll")
_CREDENTIALS: Final = struct.Struct("3i")


class Note(Struct, frozen=True, kw_only=True):
    """About the relay that holds the lock: its process, and the endpoint its data session listens on."""

    pid: int
    listen: str
    version: str = ""
    """Of the program that it runs; empty: not known."""


class Claim(Struct, kw_only=True):
    """What the next relay inherits: the lock, and the listening socket for its daemon's successors."""

    lock: int
    listener: socket.socket

    def close(self) -> None:
        """Give up our copies; the relay's own stay."""
        os.close(self.lock)
        self.listener.close()


class Door:
    """The files of one node's relay."""

    def __init__(self, folder: Path, node: NodeId) -> None:
        self._socket = folder / f"{node}.relay"
        self._next = folder / f"{node}.relay.next"
        self._lock = folder / f"{node}{_LOCK}"
        self.books = folder / f"{node}.relay.books"
        """What this node's relays have counted (`zsched.relay.books`)."""

    def note(self) -> Note | None:
        """The note about the relay that runs, ``None`` when none does."""
        try:
            descriptor = os.open(self._lock, os.O_RDONLY | os.O_CLOEXEC)
        except OSError:
            return None
        try:
            fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except OSError:
            return _read_note(os.pread(descriptor, 4096, 0))
        finally:
            os.close(descriptor)
        return None

    def prepare(self) -> Claim:
        """What a relay that is about to be started inherits; it has the place once it is taken (`take`).

        Raises:
            AdapterError: the folder cannot be used.
        """
        try:
            lock = os.open(self._lock, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise AdapterError(f"cannot open {self._lock}: {error.strerror}; check --runtime-dir") from error
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            self._next.unlink(missing_ok=True)
            listener.bind(str(self._next))
            self._next.chmod(0o600)
            listener.listen(4)
        except OSError as error:
            os.close(lock)
            listener.close()
            raise AdapterError(f"cannot listen on {self._next}: {error}; check --runtime-dir") from error
        return Claim(lock=lock, listener=listener)

    def take(self, claim: Claim) -> None:
        """Lock the place for the claim's relay, and be found there.

        Raises:
            AdapterError: another relay holds the lock, or the folder cannot be used.
        """
        try:
            fcntl.flock(claim.lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._next.rename(self._socket)
        except BlockingIOError as error:
            raise AdapterError(f"another relay holds {self._lock}; it ends by itself soon") from error
        except OSError as error:
            raise AdapterError(f"cannot listen on {self._socket}: {error}; check --runtime-dir") from error

    def sign(self, claim: Claim, note: Note) -> None:
        """Write down which relay has taken the claim."""
        os.ftruncate(claim.lock, 0)
        os.pwrite(claim.lock, json.dumps(asdict(note)).encode(), 0)

    def connect(
        self, hello: RelayHello, goes_on: Callable[[float, float], bool] = lambda _asked_s, _took_s: False
    ) -> tuple[socket.socket, RelayHere] | str:
        """Take over the relay behind the socket; answers the link to it, or why that cannot be.

        One that is silent for `GREETING_S` is waited for as long as ``goes_on`` (seconds asked for, seconds taken).
        """
        link = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            link.settimeout(GREETING_S)
            link.connect(str(self._socket))
            link.settimeout(None)
            set_timeout(link, GREETING_S)
            write_frame(link.fileno(), wire.encode(hello))
            if not _is_answered(link, goes_on):
                raise TimeoutError(f"nothing for {GREETING_S:g} s")
            frame = read_frame(link.fileno())
            answer: RelayHere | RelayRefused | None = None if frame is None else wire.decode(frame, *_ANSWERS)
        except (OSError, WireError) as error:
            link.close()
            return f"it does not answer ({error})"
        if isinstance(answer, RelayHere):
            set_timeout(link, 0.0)
            return link, answer
        link.close()
        return "it went away" if answer is None else answer.reason

    def remove(self) -> None:
        """Remove the files, once the relay is gone."""
        for path in (self._socket, self._next, self.books, fresh_file(self.books), self._lock):
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)


def fresh_file(path: Path) -> Path:
    """What takes the place of a file once it is whole."""
    return path.with_name(f"{path.name}.next")


def relays_in(folder: Path) -> tuple[int, ...]:
    """The process ids of the relays that can be found again in a runtime folder."""
    notes = (Door(folder, path.name.removesuffix(_LOCK)).note() for path in sorted(folder.glob(f"*{_LOCK}")))
    return tuple(note.pid for note in notes if note is not None and note.pid > 0)


def digest_of(*parts: str) -> str:
    """16 hex digits over all that a relay was started with; another one means: start a new relay."""
    state = blake2s(digest_size=8)
    for part in (str(PROTOCOL), *parts):
        state.update(len(part).to_bytes(4, "big") + part.encode())
    return state.hexdigest()


def _is_answered(link: socket.socket, goes_on: Callable[[float, float], bool]) -> bool:
    """Wait for an answer; false once ``goes_on`` says that waiting is of no use."""
    poller = select.poll()
    poller.register(link, select.POLLIN)
    while True:
        began = awake_s()
        if poller.poll(GREETING_S * 1000):
            return True
        if not goes_on(GREETING_S, awake_s() - began):
            return False


def set_timeout(link: socket.socket, seconds: float) -> None:
    """Bound every read and write on ``link`` (0: unbounded); over it they raise `BlockingIOError`."""
    value = _TIMEVAL.pack(int(seconds), int(seconds % 1 * 1e6))
    for option in (socket.SO_RCVTIMEO, socket.SO_SNDTIMEO):
        link.setsockopt(socket.SOL_SOCKET, option, value)


def user_of(link: socket.socket) -> int:
    """The user id of the process at the other end."""
    _, user, _ = _CREDENTIALS.unpack(link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))
    return int(user)


def _read_note(text: bytes) -> Note | None:
    try:
        found = json.loads(text)
        return Note(pid=int(found["pid"]), listen=str(found["listen"]), version=str(found.get("version", "")))
    except (ValueError, KeyError, TypeError):
        return Note(pid=0, listen="")  # it has only just been started
