"""Starts workers as the user that it runs as, for this machine's daemon: the program of `zsched-worker@.service`.

Each connection is one worker. It begins with a byte and two descriptors: the order (JSON), and where the output goes.
Answers are lines: ``pid NUMBER`` or ``no REASON``, and at last ``exit STATUS``. Each further byte is a signal for the
worker's process group; the connection's end is the worker's. Behind the last worker the starter ends, and systemd kills
what has escaped into sessions of its own.

Knows: processes, who may ask. Does not know: tasks, zenoh, or any module of zsched's that needs more than Python.
"""

from __future__ import annotations

import contextlib
import json
import os
import pwd
import selectors
import signal
import socket
import struct
import subprocess
import sys
from functools import partial
from pathlib import Path
from typing import Any, Final

LAUNCHER: Final = str(Path(__file__).with_name("launch.py"))
SESSION: Final = "ZSCHED_ZENOH_CONFIG"
"""Names the file of the worker's session: this user may not read the daemon's, and gets one of its own."""
LISTENER: Final = 3
"""Where systemd puts the socket (sd_listen_fds(3))."""
FOR_THE_STARTER: Final = frozenset({"LISTEN_FDS", "LISTEN_PID", "LISTEN_FDNAMES", "RUNTIME_DIRECTORY"})
_PEER: Final = struct.Struct("3i")


class Starter:
    """All workers of one user."""

    def __init__(self, listener: socket.socket, users: frozenset[int], folder: Path) -> None:
        """``users``: who may ask; ``folder``: for session files, which only this user reads."""
        self._listener, self._users, self._folder = listener, users, folder
        self._selector = selectors.DefaultSelector()
        self._selector.register(listener, selectors.EVENT_READ, self._accept)
        self._workers: dict[socket.socket, subprocess.Popen[bytes] | None] = {}
        """{connection: process}, until that is reaped."""

    def run(self) -> None:
        """Until all workers that there were have ended."""
        has_served = False
        while self._workers or not has_served:
            for key, _ in self._selector.select():
                key.data()
            has_served = True

    def _accept(self) -> None:
        link, _ = self._listener.accept()
        _, user, _ = _PEER.unpack(link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _PEER.size))
        if user not in self._users:
            print(f"user {user} may start no workers", file=sys.stderr, flush=True)
            link.close()
            return
        self._workers[link] = None
        self._selector.register(link, selectors.EVENT_READ, partial(self._begin, link))

    def _begin(self, link: socket.socket) -> None:
        descriptors: list[int] = []
        self._selector.unregister(link)
        try:
            _, descriptors, _, _ = socket.recv_fds(link, 1, 2)
            order, output = descriptors
            process = self._start(json.loads(os.pread(order, os.fstat(order).st_size, 0)), output)
        except (OSError, ValueError, KeyError) as error:
            _say(link, f"no {error}")
            del self._workers[link]
            link.close()
            return
        finally:
            for descriptor in descriptors:
                os.close(descriptor)
        self._workers[link] = process
        _say(link, f"pid {process.pid}")
        self._selector.register(link, selectors.EVENT_READ, partial(self._obey, link, process.pid))
        end = os.pidfd_open(process.pid)
        self._selector.register(end, selectors.EVENT_READ, partial(self._bury, link, process, end))

    def _start(self, order: dict[str, Any], output: int) -> subprocess.Popen[bytes]:
        given: dict[str, str] = order["environment"]
        if path := given.get(SESSION):
            own = self._folder / Path(path).name
            own.unlink(missing_ok=True)
            with open(own, "x", encoding="utf-8", opener=partial(os.open, mode=0o600)) as file:
                file.write(order["session"])
            given = {name: str(own) if value == path else value for name, value in given.items()}
        inherited = {name: value for name, value in os.environ.items() if name not in FOR_THE_STARTER}
        return subprocess.Popen(
            [sys.executable, "-I", "-S", LAUNCHER, str(os.getpid()), *order["command"]],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=inherited | given,
            start_new_session=True,
        )

    def _obey(self, link: socket.socket, group: int) -> None:
        if link not in self._workers:
            return  # its process was buried in this round
        try:
            signals = link.recv(64)
        except OSError:
            signals = b""
        if not signals:
            self._selector.unregister(link)
        for number in signals or bytes([signal.SIGKILL]):
            _kill(group, number)

    def _bury(self, link: socket.socket, process: subprocess.Popen[bytes], end: int) -> None:
        _kill(process.pid, signal.SIGKILL)  # before it is reaped: until then the group is its own
        _say(link, f"exit {process.wait()}")
        self._selector.unregister(end)
        os.close(end)
        if link in self._selector.get_map():
            self._selector.unregister(link)
        del self._workers[link]
        link.close()


def _kill(group: int, number: int) -> None:
    with contextlib.suppress(OSError):
        os.killpg(group, number)


def _say(link: socket.socket, line: str) -> None:
    with contextlib.suppress(OSError):
        link.sendall(f"{line}\n".encode())


def main(arguments: list[str]) -> int:
    """``arguments``: the daemon's user. Root may ask, too."""
    users = frozenset({0, pwd.getpwnam(arguments[0]).pw_uid})
    with socket.socket(fileno=LISTENER) as listener:
        Starter(listener, users, Path(os.environ["RUNTIME_DIRECTORY"])).run()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
