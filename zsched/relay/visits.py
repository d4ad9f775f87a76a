"""Who comes to a relay's socket: its daemon, of which it has one at a time, and whoever asks what runs here.

Knows: the socket, the greeting, which daemon a relay can obey. Does not know: what daemons say next, zenoh.

A relay goes on with the next daemon of its fleet and node, of whatever version of the code, if both have the same
`PROTOCOL` and what a process keeps for its life suits: threads, the host's own side and, where there is none, the data
session. Any other daemon needs another relay: this one says so, and ends.
"""

from __future__ import annotations

import logging
import os
import select
import socket
from pathlib import Path
from typing import Final, NoReturn

from zsched import __version__
from zsched.core.values import codec as wire
from zsched.core.values.errors import WireError
from zsched.core.values.struct import Struct
from zsched.host.clock import awake_s
from zsched.link.pipe.frames import read_frame, set_timeout, write_frame
from zsched.link.pipe.protocol import RelayHello, RelayHere, RelayQuestion, RelayRefused
from zsched.link.pipe.relay_socket import PROTOCOL

HELLO_S: Final = 0.5
LOOK_S: Final = 1.0
"""A signal that comes just before a wait begins has its handler called when that ends."""
BACKLOG: Final = 64

_log = logging.getLogger("zsched.relay")


class Daemon(Struct, frozen=True, kw_only=True):
    """A daemon that is obeyed: the link to it, what it needs, and the texts of its sessions."""

    link: socket.socket
    hello: RelayHello
    session: str
    local: str = ""

    def reopens(self, other: Daemon) -> bool:
        """Whether ``other``, which comes next, has another data session."""
        mine, its = self.hello, other.hello
        return (other.session, its.certificate) != (self.session, mine.certificate)


class RefusedError(Exception):
    """A daemon needs another relay than this one."""


class Visits:
    """The relay's socket; for the main thread alone."""

    def __init__(self, path: Path) -> None:
        """Listen at ``path``, in place of a relay that has gone.

        Raises:
            OSError: the folder cannot be used.
        """
        self._path = path
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        path.unlink(missing_ok=True)
        self._listener.bind(str(path))
        path.chmod(0o600)
        self._listener.listen(BACKLOG)
        self._daemon: Daemon | None = None
        """The newest that was obeyed."""
        self._threads = 0
        """Of this process, by its first daemon."""

    def close(self) -> None:
        """Nobody finds us any more."""
        self._path.unlink(missing_ok=True)
        self._listener.close()

    def next_daemon(self, timeout_s: float) -> Daemon | None:
        """The next daemon; ``None`` when none came within ``timeout_s``, while the machine was awake.

        One that is there at the end is let in: this process may have stood still until then.

        Raises:
            RefusedError: it needs another relay.
        """
        until = awake_s() + timeout_s
        is_over = False
        while not is_over:
            left_s = max(0.0, until - awake_s())
            is_over = left_s == 0.0
            if not self._wait(None, min(left_s, LOOK_S)):
                continue
            link, _ = self._listener.accept()
            if (found := self._greet(link, is_free=True)) is not None:
                self._threads = self._threads or found.hello.threads + found.hello.spare_threads
                self._daemon = found
                return found
            link.close()
        return None

    def next_frame(self, link: socket.socket) -> bytes | None:
        """What the daemon says next; ``None``: it has gone. Questions of others are answered meanwhile.

        Raises:
            OSError, WireError: as `read_frame`.
        """
        while True:
            ready = self._wait(link, LOOK_S)
            if link.fileno() in ready:  # its end is heard before the next daemon
                return read_frame(link.fileno())
            if ready:
                other, _ = self._listener.accept()
                self._greet(other, is_free=False)
                other.close()

    def _wait(self, link: socket.socket | None, timeout_s: float) -> set[int]:
        poller = select.poll()
        for one in (self._listener, link):
            if one is not None:
                poller.register(one, select.POLLIN)
        return {found for found, _ in poller.poll(timeout_s * 1000)}

    def _greet(self, link: socket.socket, *, is_free: bool) -> Daemon | None:
        """The daemon behind ``link``, if it is one and is let in; it is told so, or why not."""
        set_timeout(link, HELLO_S)
        try:
            if (frame := read_frame(link.fileno())) is None:
                return None  # it has only looked whether we are there
            word: RelayHello | RelayQuestion = wire.decode(frame, RelayHello, RelayQuestion)  # type: ignore[assignment] # one of both
            if isinstance(word, RelayQuestion):
                self._answer(link, self._here())
                return None
            if not is_free:
                self._answer(link, RelayRefused(reason="it has a daemon"))
                return None
            texts = [read_frame(link.fileno()) for _ in range(1 + word.has_local_side)]
        except (OSError, WireError) as error:
            if isinstance(error, WireError) and is_free:
                self._refuse(link, f"its greeting is none of ours ({error})")
            _log.warning("a daemon was not let in: no greeting (%s)", error)
            return None
        session, local = (_text(frame, word.credentials) for frame in (texts[0], texts[1] if texts[1:] else b""))
        found = Daemon(link=link, hello=word, session=session, local=local)
        if reason := objection(self._daemon, found, self._threads):
            self._refuse(link, reason)
        self._answer(link, self._here())
        set_timeout(link, 0.0)
        return found

    def _refuse(self, link: socket.socket, reason: str) -> NoReturn:
        self._answer(link, RelayRefused(reason=reason))
        link.close()
        raise RefusedError(reason)

    def _here(self) -> RelayHere:
        return RelayHere(version=__version__, listen="" if self._daemon is None else self._daemon.hello.listen)

    def _answer(self, link: socket.socket, answer: RelayHere | RelayRefused) -> None:
        try:
            write_frame(link.fileno(), wire.encode(answer))
        except (OSError, WireError) as error:
            _log.warning("somebody who came was not answered (%s)", error)


def objection(mine: Daemon | None, its: Daemon, threads: int) -> str:
    """Why a relay of so many threads, made by ``mine`` (``None``: nobody), is not the one for ``its``; or nothing."""
    hello = its.hello
    if hello.protocol != PROTOCOL:
        return f"its protocol is {hello.protocol}, this relay's is {PROTOCOL}"
    if mine is None:
        return ""
    was = mine.hello
    if (hello.fleet, hello.node) != (was.fleet, was.node):
        return f"it is {hello.fleet}/{hello.node}, this is the relay of {was.fleet}/{was.node}"
    if hello.threads > threads:
        return f"the fleet has grown: {hello.threads} threads are needed, this relay has {threads}"
    if (its.local, hello.addresses) != (mine.local, was.addresses):
        return "the host's own side, or its addresses, are not those that this relay was started with"
    if mine.reopens(its) and not its.local:
        return "its data session is another one, and the host's applications are on that of this relay"
    return ""


def _text(frame: bytes | None, credentials: str) -> str:
    """Of a session; what systemd has handed to the daemon, it has handed to us in a folder of our own."""
    text, ours = (frame or b"").decode(errors="replace"), os.environ.get("CREDENTIALS_DIRECTORY", "")
    return text.replace(credentials, ours) if credentials and ours else text
