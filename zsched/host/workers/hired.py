"""A worker's process that another user runs: its starter keeps it, and does with it what the daemon may not.

Knows: the starter's socket and words (`zsched.host.workers.starter`). Does not know: tasks, phases, output.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from zsched.core.values.errors import AdapterError

FOLDER: Final = "ZSCHED_STARTERS"
"""Where the sockets are, `USER.sock`; the unit says it. Without: workers whose task names no user are the daemon's."""
STARTERS: Final = "/run/zsched-workers"
RELAYS: Final = ".relay"
"""The folder beside the sockets, of the daemon and the group of all workers' users."""
USER: Final = "zsched-worker"
"""Of a task that names none."""
START_S: Final = 3.0
"""For a starter that systemd has to start first."""


def starter_of(user: str, env: Mapping[str, str] = os.environ) -> Path | None:
    """The socket for workers of a user; ``user`` empty: of the usual one, where that is there. ``None``: the daemon's.

    A user that is named is never replaced by the daemon's own: its socket may not be there.
    """
    path = Path(env.get(FOLDER) or STARTERS, f"{user or USER}.sock")
    return path if user or (env.get(FOLDER) and path.exists()) else None


def relay_socket(node: str, env: Mapping[str, str] = os.environ) -> Path:
    """Where the relay of a secured fleet listens for such workers: its folder lets nobody else through."""
    return Path(env.get(FOLDER) or STARTERS, RELAYS, f"{node}.sock")


class Hired:
    """One worker, from its start to its end. The end of the connection, however that comes, is the worker's."""

    group: Final = None
    """Not ours to kill."""

    def __init__(self, starter: Path, command: Sequence[str], environment: Mapping[str, str], session: str) -> None:
        """Raises `AdapterError`: nobody starts it."""
        self._link = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._said = b""
        self._status: int | None = None
        self.output_fd, output = os.pipe2(os.O_CLOEXEC)
        order = os.memfd_create("order", os.MFD_CLOEXEC)
        try:
            told = {"command": command, "environment": dict(environment), "session": session}
            with open(order, "w", encoding="utf-8", closefd=False) as file:
                json.dump(told, file)
            self._link.settimeout(START_S)
            self._link.connect(str(starter))
            socket.send_fds(self._link, [b"+"], [order, output])
            self.pid = self._begun(starter)
        except AdapterError:
            self.close()
            raise
        except OSError as error:
            self.close()
            do = f"sudo systemctl enable --now zsched-worker@{starter.stem}.socket"
            why = error.strerror or "it does not answer"
            raise AdapterError(f"nobody starts workers as user {starter.stem} here ({why}): {do}") from error
        finally:
            os.close(order)
            os.close(output)

    @property
    def end_fd(self) -> int:
        """Becomes readable when the worker has ended."""
        return self._link.fileno()

    def has_exited(self) -> bool:
        """Whether it has ended."""
        self._link.settimeout(0.0)
        with contextlib.suppress(BlockingIOError):
            self._read_end()
        return self._status is not None

    def signal_group(self, number: signal.Signals) -> None:
        """Have a signal sent to it and all in its group."""
        with contextlib.suppress(OSError):
            self._link.send(bytes([number]))

    def wait(self) -> int:
        """How it ended, as `subprocess` says it; of one whose starter is silent, that it was killed."""
        self._link.settimeout(START_S)
        with contextlib.suppress(TimeoutError):
            self._read_end()
        return -signal.SIGKILL if self._status is None else self._status

    def close(self) -> None:
        """Let go of it."""
        self._link.close()
        os.close(self.output_fd)

    def _begun(self, starter: Path) -> int:
        word, _, rest = self._line().partition(" ")
        if word != "pid":
            raise AdapterError(f"{starter}: {rest or 'it refuses this daemon'}")
        return int(rest)

    def _read_end(self) -> None:
        if self._status is None:
            word, _, rest = self._line().partition(" ")
            self._status = int(rest) if word == "exit" else -signal.SIGKILL

    def _line(self) -> str:
        """The starter's next line, which comes as a whole; empty once it has gone.

        It is as good as its workers, who may do with it what they like: it is waited for once, whatever it says.
        """
        if b"\n" not in self._said:
            with contextlib.suppress(ConnectionError):
                self._said += self._link.recv(4096)
        line, _, self._said = self._said.partition(b"\n")
        return line.decode(errors="replace")
