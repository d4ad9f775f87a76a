"""Measures how long a node's session takes to answer from here: a client session of a moment, and a few questions.

Knows: zenoh sessions, round trips. Does not know: which question it is, what the answers mean.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from typing import Final

import zenoh

from zsched.core.values.struct import Struct, field
from zsched.host.clock import monotonic_s
from zsched.host.guard import guarded

CONNECT_S: Final = 2.0
"""How long an address is waited for that neither takes a connection nor refuses it."""
SIZES: Final = {"": 1 << 10, "64 KiB": 1 << 16, "1 MiB": 1 << 20}
"""{name: bytes} of what a data session is asked with: a way may carry small packets and lose each full one."""
LARGE_S: Final = 10.0
"""A large question has so long, for a radio of 1 Mbit/s."""


class Pinged(Struct, kw_only=True):
    """What came back so far; another thread may still fill it in."""

    opened_s: float | None = None
    """How long the session took to open; ``None``: it did not."""
    round_trips_s: list[float] = field(default_factory=list)
    missed: int = 0
    """Questions without an answer in time."""
    error: str = ""
    """Why there is no session."""
    answers: list[bytes] = field(default_factory=list)
    """To the last question that was answered."""


def ping(
    config: str, selector: str, *, count: int, timeout_s: float, interval_s: float, needs_answer: bool, size: int = 0
) -> Pinged:
    """Ask ``selector`` on a session of ``config``, ``count`` times; blocks until all is said, or late.

    Without ``needs_answer`` it is enough that the other end says that nobody has more to say. Each question carries
    ``size`` bytes.
    """
    zenoh.init_log_from_env_or("off")
    found = Pinged()
    ask = partial(_ask, selector=selector, timeout_s=timeout_s, needs_answer=needs_answer, size=size, found=found)
    errand = guarded(_ask_on, config, count, interval_s, ask, found, name="ping", is_lasting=False)
    errand.start()
    errand.join(CONNECT_S + count * (timeout_s + interval_s))
    if found.opened_s is None and not found.error:
        found.error = f"no answer within {CONNECT_S:g} s"
    return found


def _ask_on(config: str, count: int, interval_s: float, ask: Callable[[zenoh.Session], None], found: Pinged) -> None:
    began = monotonic_s()
    try:
        session = zenoh.open(zenoh.Config.from_json5(config))
    except zenoh.ZError as error:
        found.error = str(error).partition(" at ")[0]
        return
    with session:
        found.opened_s = monotonic_s() - began
        for number in range(count):
            if number:
                threading.Event().wait(interval_s)
            ask(session)


def _ask(session: zenoh.Session, selector: str, timeout_s: float, needs_answer: bool, size: int, found: Pinged) -> None:
    began, before = monotonic_s(), {str(link.src) for link in session.info.links()}
    replies = session.get(
        selector,
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
        timeout=timeout_s,
        payload=bytes(size) if size else None,
        priority=zenoh.Priority.INTERACTIVE_HIGH,
        express=True,
    )
    answers = [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]
    took_s = monotonic_s() - began
    is_cut = before.isdisjoint(str(link.src) for link in session.info.links())  # that ends the question, too
    if took_s >= timeout_s or is_cut or (needs_answer and not answers):
        found.missed += 1
        return
    found.round_trips_s.append(took_s)
    found.answers = answers
