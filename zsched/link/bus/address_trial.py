"""Tries addresses that a session dials in vain: looks each host up and connects once, and says what became of it.

Zenoh dials again and again and does not tell why nothing comes of it. A trial opens a connection of its own and closes
it at once. It runs in a thread: a name server or a silent host takes seconds.

Knows: sockets, the shape of zenoh's endpoints. Does not know: when a trial is due (`zsched.core.membership.solitude`).
"""

from __future__ import annotations

import errno
import socket
import threading
from collections.abc import Callable
from typing import Final

from zsched.core.membership.solitude import TAKEN
from zsched.core.values import events as ev
from zsched.core.values.endpoint import OVER_TCP, Endpoint
from zsched.host.guard import guarded

CONNECT_S: Final = 1.0
MAX_ADDRESSES: Final = 16
NO_ROUTE: Final = frozenset({errno.ENETUNREACH, errno.EHOSTUNREACH, errno.ENETDOWN, errno.EHOSTDOWN})


class AddressTrial:
    """Tries addresses when asked to; at most one trial at a time."""

    def __init__(self, post: Callable[[ev.Event], None]) -> None:
        self._post = post
        self._thread: threading.Thread | None = None

    def begin(self, addresses: tuple[str, ...]) -> None:
        """Begin, and return at once; nothing while a trial is under way. The result is an `AddressesTried`."""
        if self._thread is not None and self._thread.is_alive():
            return
        self._thread = guarded(self._run, addresses[:MAX_ADDRESSES], name="zsched-address-trial", is_lasting=False)
        self._thread.start()

    def _run(self, addresses: tuple[str, ...]) -> None:
        found: dict[str, str] = {}
        errands = [
            guarded(_try, address, found, name="zsched-address", kind="zsched-address", is_lasting=False)
            for address in addresses
        ]
        for errand in errands:
            errand.start()
        for errand in errands:
            errand.join()
        self._post(ev.AddressesTried(found=tuple((address, found.get(address, "")) for address in addresses)))


def _try(address: str, found: dict[str, str]) -> None:
    found[address] = outcome_of(address)


def outcome_of(endpoint: str) -> str:
    """What becomes of one attempt: a few words, empty when nothing can be said; blocks for `CONNECT_S` a connection."""
    end = Endpoint.of(endpoint)
    if not end.host or end.port is None:
        return ""
    try:
        socket.getaddrinfo(end.host, end.port, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError):
        return "name unknown"
    if end.protocol not in OVER_TCP:
        return ""  # of other protocols only the host is looked up
    try:
        with socket.create_connection((end.host, end.port), timeout=CONNECT_S):
            return TAKEN
    except TimeoutError:
        return f"no answer in {CONNECT_S:g} s"
    except ConnectionRefusedError:
        return "refused"
    except OSError as error:
        return "no route" if error.errno in NO_ROUTE else (error.strerror or "failed")
