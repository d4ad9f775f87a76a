"""The relay's process as a daemon holds it: a child that it has started, or one that an earlier daemon left.

Knows: spawning, waiting, ending. Does not know: the pipe's frames, when a relay should end.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import select
import signal
import socket
import threading
import time
from collections.abc import Callable

from zsched import __version__
from zsched.clock import awake_s
from zsched.errors import AdapterError
from zsched.ipc.takeover import Claim, Door, Note

POLL_S = 0.01
ENDING_S = 0.5
"""A relay whose pipe has ended is about to end itself."""
_FIRST_FREE = 10
"""Descriptors that the child gets are moved above those it gets them as."""


class RelayChild:
    """One relay process and the link to it; every method may be called from any thread."""

    def __init__(
        self, *, pid: int, link: socket.socket | None, door: Door | None = None, is_child: bool = False
    ) -> None:
        """``link`` may be missing where the process only has to end; ``door`` tells whether another's child runs."""
        self.pid = pid
        self.is_child = is_child
        self.ending = "its pipe ended"
        self._link = link
        self._door = door
        self._lock = threading.Lock()
        self._has_ended = False

    @property
    def descriptor(self) -> int:
        """The link's; -1 once closed."""
        return -1 if self._link is None else self._link.fileno()

    def has_ended(self) -> bool:
        """Whether the process is gone; a child is reaped by this."""
        with self._lock:
            if self._has_ended:
                return True
            if not self.is_child:
                with contextlib.suppress(ChildProcessError):  # it may be one of this process before it began again
                    os.waitpid(self.pid, os.WNOHANG)
                note = None if self._door is None else self._door.note()
                self._has_ended = note is None or note.pid not in (0, self.pid)
                return self._has_ended
            with contextlib.suppress(ChildProcessError):
                pid, status = os.waitpid(self.pid, os.WNOHANG)
                if pid == 0:
                    return False
                self.ending = f"exit code {os.waitstatus_to_exitcode(status)}"
            self._has_ended = True
            return True

    def speaks(self, timeout_s: float) -> bool:
        """Whether there is a word of it to read within ``timeout_s``."""
        poller = select.poll()
        poller.register(self.descriptor, select.POLLIN)
        return bool(poller.poll(timeout_s * 1000))

    def wait(self, timeout_s: float) -> bool:
        """Whether the process is gone within ``timeout_s``."""
        until = awake_s() + timeout_s
        while not self.has_ended():
            if awake_s() >= until:
                return False
            time.sleep(POLL_S)
        return True

    def kill(self) -> None:
        """SIGKILL; returns when it is gone."""
        if not self.has_ended():
            self._send(signal.SIGKILL)
        self.wait(ENDING_S)

    def end(self, timeout_s: float) -> None:
        """SIGTERM, SIGKILL after half the time; returns when it is gone, or after ``timeout_s``."""
        if not self.has_ended():  # else its number may be another process's
            self._send(signal.SIGTERM)
        if not self.wait(timeout_s / 2):
            self._send(signal.SIGKILL)
            self.wait(timeout_s / 2)

    def hang_up(self) -> None:
        """End the link, for the relay as for us: its commands are over."""
        if self._link is not None:
            with contextlib.suppress(OSError):
                self._link.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Give the link's descriptor back; nobody may use it any more."""
        if self._link is not None:
            self._link.close()

    def _send(self, number: signal.Signals) -> None:
        if self.pid > 0:
            with contextlib.suppress(OSError):
                os.kill(self.pid, number)


def start_relay(
    command: list[str],
    door: Door | None = None,
    listen: str = "",
    ends_other: Callable[[RelayChild], None] = lambda _next: None,
) -> RelayChild:
    """Start a relay; with ``door`` it can be found again there, with where its session listens.

    ``ends_other`` is called when it runs, before it has the place: the relay that has it yet ends then.

    Raises:
        AdapterError: the door is another relay's, or its folder cannot be used.
        OSError: the command cannot be run.
    """
    ours, theirs = socket.socketpair()
    with contextlib.ExitStack() as stack:
        stack.callback(theirs.close)
        stack.callback(ours.close)
        claim = None if door is None else door.prepare()
        if claim is not None:
            stack.callback(claim.close)
        child = RelayChild(pid=_spawn(command, theirs, claim), link=ours.dup(), door=door, is_child=True)
        if claim is None or door is None:
            return child
        try:
            ends_other(child)
            door.take(claim)
        except AdapterError:
            child.kill()
            child.close()
            raise
        door.sign(claim, Note(pid=child.pid, listen=listen, version=__version__))
    return child


def _spawn(command: list[str], link: socket.socket, claim: Claim | None) -> int:
    """Not `subprocess`: its objects insist on reaping, and this child may outlive us."""
    given = [(link.fileno(), 0), (link.fileno(), 1)]
    if claim is not None:
        given += [(claim.listener.fileno(), 3), (claim.lock, 4)]
        command = [*command, "--door", "3"]
    moved = [(fcntl.fcntl(source, fcntl.F_DUPFD_CLOEXEC, _FIRST_FREE), target) for source, target in given]
    try:
        actions = [(os.POSIX_SPAWN_DUP2, source, target) for source, target in moved]
        return os.posix_spawn(command[0], command, os.environ, file_actions=actions)
    finally:
        for source, _ in moved:
            os.close(source)
