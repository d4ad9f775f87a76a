"""Tells systemd that the daemon is ready, what it does, that it lives, and that it stops.

The protocol is sd_notify(3): newline-separated fields in one datagram to the socket that NOTIFY_SOCKET names. Without
that variable nothing happens. The watchdog must be fed from the decision loop itself: a daemon whose loop is wedged
still has living threads (zenoh's keep-alives go on), so any other place would lie. A daemon that begins anew feeds it
once between two loops.

Knows: NOTIFY_SOCKET, WATCHDOG_USEC, WATCHDOG_PID. Does not know: what ready means, or when to stop.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping

MAX_STATUS = 400
"""Characters of a status line; `systemctl status` shows one line."""


class Notifier:
    """The way to systemd, or to nowhere. Never raises and never blocks: a notice that does not fit is dropped."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        name = environment.get("NOTIFY_SOCKET", "")
        self._address = "\0" + name[1:] if name.startswith("@") else name
        self._socket: socket.socket | None = None
        if self._address.startswith(("/", "\0")):
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
            self._socket.setblocking(False)

    @property
    def is_connected(self) -> bool:
        """Whether somebody wants to be told."""
        return self._socket is not None

    def ready(self, status: str = "") -> bool:
        """The session is open and the first profile is taken."""
        return self._send("READY=1", *_status(status))

    def status(self, status: str) -> bool:
        """One line for people, as `systemctl status` shows it."""
        return self._send(*_status(status))

    def watchdog(self) -> bool:
        """The decision loop has just turned."""
        return self._send("WATCHDOG=1")

    def stopping(self, status: str = "") -> bool:
        """The first thing after SIGTERM."""
        return self._send("STOPPING=1", *_status(status))

    def close(self) -> None:
        """Close the socket; nothing is sent from now on."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, *fields: str) -> bool:
        if self._socket is None or not fields:
            return False
        try:
            self._socket.sendto("\n".join(fields).encode(), self._address)
        except OSError:
            return False
        return True


def watchdog_interval_s(environment: Mapping[str, str] = os.environ) -> float | None:
    """How often to call `Notifier.watchdog`, in seconds: half of what systemd waits; ``None``: it does not watch us."""
    usec, pid = environment.get("WATCHDOG_USEC", ""), environment.get("WATCHDOG_PID", "")
    if not usec.isdecimal() or int(usec) == 0 or (pid and pid != str(os.getpid())):
        return None
    return int(usec) / 2e6


def _status(text: str) -> tuple[str, ...]:
    line = " ".join(text.split())[:MAX_STATUS]
    return (f"STATUS={line}",) if line else ()
