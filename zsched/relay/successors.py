"""Waits, once the daemon is gone, for the one that comes after it, and lets no other in.

Knows: the listening socket in the runtime folder, who may take this relay over. Does not know: why the daemon went,
what is carried meanwhile.

A successor is the same user's, of the same fleet and node, was started later (its incarnation is higher), and has the
same protocol, Python and session on the host's own side: anything else makes a new relay necessary. Its code may be
another version's, and its data session another one where the host has a side of its own (docs/decisions/0103).
"""

from __future__ import annotations

import logging
import os
import select
import socket
from typing import Final

from zsched.clock import awake_s
from zsched.core.values.model import TaskId
from zsched.core.values.struct import Struct, replace
from zsched.errors import WireError
from zsched.ipc.pipe import read_frame, write_frame
from zsched.ipc.protocol import RelayHello, RelayHere, RelayRefused
from zsched.ipc.takeover import set_timeout, user_of
from zsched.wire import codec as wire

HELLO_S: Final = 0.5

_log = logging.getLogger("zsched.relay")


class Successor(Struct, frozen=True, kw_only=True):
    """The next daemon: the link to it, the tasks of its fleet (if it says), whether it wants another data session."""

    link: socket.socket
    tasks: frozenset[TaskId] | None
    reopens: bool


class Successors:
    """The way by which another daemon reaches this relay."""

    def __init__(self, listener: socket.socket, daemon: RelayHello, *, reopens: bool = False) -> None:
        """``daemon`` is the one that started this relay; ``reopens``: it can open another data session."""
        self._listener = listener
        self._daemon = daemon
        self._reopens = reopens

    def wait(self, timeout_s: float) -> Successor | None:
        """The next daemon, or ``None`` when none came within ``timeout_s``, while the machine was awake.

        One that is at the door at the end is let in: this process may have stood still until then.
        """
        until = awake_s() + timeout_s
        poller = select.poll()
        poller.register(self._listener, select.POLLIN)
        is_over = False
        while not is_over:
            left_s = max(0.0, until - awake_s())
            is_over = left_s == 0.0
            if not poller.poll(left_s * 1000):
                continue
            link, _ = self._listener.accept()
            found = self._greet(link)
            if isinstance(found, Successor):
                return found
            _log.warning("a daemon was not let in: %s", found)
            link.close()
        return None

    def _greet(self, link: socket.socket) -> Successor | str:
        """Let the daemon behind ``link`` in, or tell it why not."""
        set_timeout(link, HELLO_S)
        try:
            frame = read_frame(link.fileno())
            if frame is None:
                return "it went away"
            hello = wire.decode(frame, RelayHello)
            reason = self._objection(hello, user_of(link))
            reopens = reason is None and hello.session != self._daemon.session
            answer = RelayHere(pid=os.getpid(), reopens=reopens) if reason is None else RelayRefused(reason=reason)
            write_frame(link.fileno(), wire.encode(answer))
        except (OSError, WireError) as error:
            return f"no greeting ({error})"
        if reason is not None:
            return reason
        self._daemon = replace(self._daemon, incarnation=hello.incarnation, session=hello.session)
        set_timeout(link, 0.0)
        return Successor(link=link, tasks=None if hello.tasks is None else frozenset(hello.tasks), reopens=reopens)

    def _objection(self, hello: RelayHello, user: int) -> str | None:
        mine = self._daemon
        if user != os.getuid():
            return f"it is user {user}'s, this relay is user {os.getuid()}'s"
        if (hello.fleet, hello.node) != (mine.fleet, mine.node):
            return f"it is {hello.fleet}/{hello.node}, this is the relay of {mine.fleet}/{mine.node}"
        if hello.incarnation <= mine.incarnation:
            return f"incarnation {hello.incarnation} is not after {mine.incarnation}, whose relay this is"
        if hello.digest != mine.digest:
            return "its protocol, its Python or its host's own side are not those that this relay was started with"
        if hello.threads > mine.threads:
            return f"the fleet has grown: {hello.threads} threads are needed, this relay has {mine.threads}"
        if hello.session != mine.session and not self._reopens:
            return "its data session is another one, and the host's applications are on that of this relay"
        return None
