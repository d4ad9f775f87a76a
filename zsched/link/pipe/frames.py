"""The pipe between the daemon and its relay, and the end markers: frames of the codec behind a length.

Knows: framing, the classes that may pass, their size bounds. Does not know: processes, zenoh, what a value leads to.

A frame is 4 bytes of length (big endian) and that many bytes. Behind a daemon's greeting are the JSON texts of the
relay's zenoh sessions; every other frame is a `zsched.core.values.codec` frame. A length over `MAX_FRAME` is a broken
pipe, not a value.
"""

from __future__ import annotations

import os
import socket
import struct
from typing import Any, Final

from zsched.core.values import codec as wire
from zsched.core.values import events, relay_protocol
from zsched.core.values.errors import WireError
from zsched.core.values.plan import Role, RoutePlan
from zsched.link.pipe import protocol

MAX_FRAME: Final = 1 << 20
_LENGTH: Final = struct.Struct(">I")
_TIMEVAL: Final = struct.Struct("ll")
_SMALL: Final = 8 * 1024

_REGISTERED: Final[tuple[tuple[str, type, int], ...]] = (
    ("relay_stop", relay_protocol.RelayStop, _SMALL),
    ("task_ended", relay_protocol.TaskEnded, _SMALL),
    ("relay_started", relay_protocol.RelayStarted, _SMALL),
    ("relay_pulse", protocol.RelayPulse, _SMALL),
    ("relay_greeting", protocol.RelayHello, wire.LARGE),
    ("relay_question", protocol.RelayQuestion, _SMALL),
    ("relay_present", protocol.RelayHere, _SMALL),
    ("relay_refused", protocol.RelayRefused, _SMALL),
    ("worker_seen", relay_protocol.WorkerSeen, _SMALL),
    ("worker_watch", relay_protocol.WorkerWatch, wire.LARGE),
    ("worker_matched", relay_protocol.WorkerMatched, _SMALL),
    ("worker_trouble", relay_protocol.WorkerTrouble, _SMALL),
    ("worker_jobs", events.WorkerJobs, 1024),
    ("frame_dropped", events.FrameDropped, _SMALL),
    ("end_marker", relay_protocol.EndMarker, 256),
    ("snapshot_chunk", relay_protocol.SnapshotChunk, 256),
    ("stream_acks", relay_protocol.StreamAcks, wire.LARGE),
    ("slot_lost", relay_protocol.SlotLost, _SMALL),
    ("slot_ready", events.SlotReady, _SMALL),
    ("slot_flipped", events.SlotFlipped, _SMALL),
    ("slot_drained", events.SlotDrained, _SMALL),
    ("role_ended", events.RoleEnded, _SMALL),
    ("streams_counted", events.StreamsCounted, wire.LARGE),
    ("problem_reported", events.ProblemReported, _SMALL),
)
for _kind, _cls, _bound in _REGISTERED:
    wire.register(_kind, _cls, _bound)

COMMANDS: Final[tuple[type[Any], ...]] = (
    RoutePlan,
    Role,
    relay_protocol.WorkerWatch,
    relay_protocol.TaskEnded,
    relay_protocol.RelayStop,
)
REPORTS: Final[tuple[type[Any], ...]] = (
    relay_protocol.RelayStarted,
    protocol.RelayPulse,
    relay_protocol.WorkerSeen,
    relay_protocol.WorkerMatched,
    relay_protocol.WorkerTrouble,
    events.WorkerJobs,
    events.FrameDropped,
    relay_protocol.SlotLost,
    events.SlotReady,
    events.SlotFlipped,
    events.SlotDrained,
    events.RoleEnded,
    events.StreamsCounted,
    events.ProblemReported,
)


def write_frame(descriptor: int, body: bytes) -> None:
    """Write one frame whole; blocks while the pipe is full.

    Raises:
        OSError: the other side is gone.
        ValueError: the body is larger than `MAX_FRAME`.
    """
    if len(body) > MAX_FRAME:
        raise ValueError(f"frame of {len(body)} bytes, at most {MAX_FRAME}")
    rest = memoryview(_LENGTH.pack(len(body)) + body)
    while rest:
        rest = rest[os.write(descriptor, rest) :]


def read_frame(descriptor: int) -> bytes | None:
    """The next frame, or ``None`` at the end of the pipe (also in the middle of a frame: the writer died).

    Raises:
        WireError: the length is impossible ("size"): nothing after it can be read either.
    """
    head = _read_exactly(descriptor, _LENGTH.size)
    if head is None:
        return None
    (length,) = _LENGTH.unpack(head)
    if length > MAX_FRAME:
        raise WireError("size", f"frame of {length} bytes, at most {MAX_FRAME}")
    return _read_exactly(descriptor, length)


def set_timeout(link: socket.socket, seconds: float) -> None:
    """Bound every read and write on ``link`` (0: unbounded); over it they raise `BlockingIOError`."""
    value = _TIMEVAL.pack(int(seconds), int(seconds % 1 * 1e6))
    for option in (socket.SO_RCVTIMEO, socket.SO_SNDTIMEO):
        link.setsockopt(socket.SOL_SOCKET, option, value)


def encode_end(marker: relay_protocol.EndMarker) -> bytes:
    """The payload of an in-band end marker."""
    return wire.encode(marker)


def decode_end(payload: bytes) -> relay_protocol.EndMarker | None:
    """The end marker in a payload, or ``None`` when it is none."""
    try:
        return wire.decode(payload, relay_protocol.EndMarker)
    except WireError:
        return None


def decode_word(payload: bytes) -> relay_protocol.WorkerTrouble | events.WorkerJobs:
    """A worker's word about itself in a payload.

    Raises:
        WireError: it is none.
    """
    word: relay_protocol.WorkerTrouble | events.WorkerJobs
    word = wire.decode(payload, relay_protocol.WorkerTrouble, events.WorkerJobs)  # type: ignore[assignment] # one of both
    return word


def encode_chunk(chunk: relay_protocol.SnapshotChunk) -> bytes:
    """The attachment of one piece of a worker's snapshot."""
    return wire.encode(chunk)


def decode_chunk(attachment: bytes) -> relay_protocol.SnapshotChunk | None:
    """The word about a piece in its attachment, or ``None`` when it is none."""
    try:
        return wire.decode(attachment, relay_protocol.SnapshotChunk)
    except WireError:
        return None


def _read_exactly(descriptor: int, count: int) -> bytes | None:
    parts = []
    while count:
        part = os.read(descriptor, count)
        if not part:
            return None
        parts.append(part)
        count -= len(part)
    return b"".join(parts)
