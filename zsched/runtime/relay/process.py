"""The process of a relay: finds it by its link, ends it, starts one where there is none.

Knows: spawning, waiting, ending. Does not know: what passes the link, when a relay should end.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import time
from pathlib import Path

from zsched.host.clock import awake_s
from zsched.host.procfs import parse_process_stat, read_file
from zsched.link.pipe.frames import set_timeout
from zsched.link.pipe.relay_socket import process_behind

POLL_S = 0.01
ENDING_S = 0.5
"""A relay whose link has ended is about to end itself."""


class RelayProcess:
    """One relay process, and the link to it once there is one; every method may be called from any thread."""

    def __init__(self, pid: int, link: socket.socket | None = None) -> None:
        """``pid`` 0: it is told by the link."""
        self.pid = pid or (0 if link is None else process_behind(link))
        self.ending = "its link ended"
        self._link = link

    def meet(self, link: socket.socket) -> None:
        """The process listens now, and this is the link to it."""
        self._link, self.pid = link, process_behind(link)

    @property
    def descriptor(self) -> int:
        """The link's; -1 without."""
        return -1 if self._link is None else self._link.fileno()

    def wait_for_ever(self) -> None:
        """Reads and writes on the link are bounded no more."""
        if self._link is not None:
            set_timeout(self._link, 0.0)

    def has_ended(self) -> bool:
        """Whether the process is gone; a child is reaped by this, also one of this process before it began anew."""
        found = parse_process_stat(read_file(f"/proc/{self.pid}/stat"))
        with contextlib.suppress(ChildProcessError):
            pid, status = os.waitpid(self.pid, os.WNOHANG) if self.pid > 0 else (0, 0)
            if pid:
                self.ending = f"exit code {os.waitstatus_to_exitcode(status)}"
        # The first thread may be dead before the others, whose files are open.
        return found is None or (found.state in ("Z", "X") and found.threads <= 1)

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
            with contextlib.suppress(OSError):
                os.kill(self.pid, signal.SIGKILL)
        self.wait(10 * ENDING_S)  # a busy machine takes its time, and until then its socket listens

    def hang_up(self) -> None:
        """End the link, for the relay as for us: its commands are over."""
        if self._link is not None:
            with contextlib.suppress(OSError):
                self._link.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        """Give the link's descriptor back; nobody may use it any more."""
        if self._link is not None:
            self._link.close()


def start_relay(python: str, path: Path) -> RelayProcess:
    """Start a relay that listens at ``path`` soon, in a session of its own: nobody but its daemon ends it.

    Raises:
        OSError: it cannot be run.
    """
    # Not `subprocess`: its objects insist on reaping, and this child may outlive us.
    pid = os.posix_spawn(
        python,
        [python, "-P", "-m", "zsched.relay", "--socket", str(path)],
        os.environ,
        file_actions=[(os.POSIX_SPAWN_OPEN, 0, os.devnull, os.O_RDONLY, 0), (os.POSIX_SPAWN_DUP2, 2, 1)],
        setsid=True,
    )
    return RelayProcess(pid)
