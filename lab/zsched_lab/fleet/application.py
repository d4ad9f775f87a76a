"""What every application process of the lab begins and ends with: a session on a node's data side, a stop signal.

Knows: endpoints, stop signals, exit codes. Does not know: what the application does.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

import zenoh

from zsched.host.clock import monotonic_s
from zsched.link.sessions.config import client_config
from zsched_lab.fleet.signals import StopFlag

CONNECT_S = 30.0
LOOK_S = 0.2
"""How often a waiting application looks whether it is to stop."""


def connect(endpoint: str, stop: StopFlag) -> zenoh.Session | None:
    """A session with a node's data side, tried again for `CONNECT_S`; ``None`` when stopped meanwhile.

    Raises:
        zenoh.ZError: the endpoint did not answer in time.
    """
    deadline = monotonic_s() + CONNECT_S
    while not stop.is_set:
        try:
            return zenoh.open(zenoh.Config.from_json5(client_config(connect=(endpoint,))))
        except zenoh.ZError:
            if monotonic_s() > deadline:
                raise
            time.sleep(0.2)
    return None


def wait_until(begin_s: float | None, stop: StopFlag) -> None:
    """Wait for ``begin_s`` (`monotonic_s`; ``None``: do not), or until stopped."""
    while begin_s is not None and not stop.is_set and (left_s := begin_s - monotonic_s()) > 0.0:
        time.sleep(min(left_s, LOOK_S))


def run(name: str, endpoint: str, work: Callable[[zenoh.Session, StopFlag], None]) -> int:
    """Do ``work`` on a session with ``endpoint`` until it returns; ``name`` is how errors call the application.

    Returns:
        The exit code: 0 after ``work`` or a stop signal, 1 when the endpoint never answered (said on standard error).
    """
    stop = StopFlag()
    stop.install()
    try:
        session = connect(endpoint, stop)
    except zenoh.ZError as error:
        sys.stderr.write(f"{name}: {endpoint} does not answer: {error}\n")
        return 1
    if session is not None:
        with session:
            work(session, stop)
    return 0
