from __future__ import annotations

import os
import signal
import struct
import threading
from collections.abc import Iterator

import pytest

from zsched.core.relay_protocol import EndMarker, WorkerSeen
from zsched.core.values.plan import (
    Direction,
    ReadyWhen,
    Role,
    Route,
    RoutePhase,
    RoutePlan,
    Slot,
    StreamSettings,
    WorkerRole,
)
from zsched.errors import WireError
from zsched.ipc.pipe import (
    COMMANDS,
    MAX_FRAME,
    REPORTS,
    decode_end,
    encode_end,
    read_frame,
    wait_readable,
    write_frame,
)
from zsched.wire import codec as wire

ROUTE = Route(
    stream="t/in/0",
    direction=Direction.INPUT,
    from_expr="robot1/map",
    to_expr="edge1/t/robot1/map",
    settings=StreamSettings(),
)


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    ends = os.pipe()
    yield ends
    for end in ends:
        try:
            os.close(end)
        except OSError:
            continue  # the test closed it


def test_frames_come_out_as_they_went_in(pipe: tuple[int, int]) -> None:
    reading, writing = pipe
    plan = RoutePlan(
        task="t",
        phase=RoutePhase.FLIP,
        current=Slot(epoch=2, owner="edge1", routes=(ROUTE,), ready_when=ReadyWhen.TOKEN),
    )
    role = Role(task="t", role=WorkerRole.ACTIVE, epoch=2)
    for command in (plan, role):
        write_frame(writing, wire.encode(command))
    assert [wire.decode(read_frame(reading) or b"", *COMMANDS) for _ in range(2)] == [plan, role]


def test_the_end_of_the_pipe_is_none_even_inside_a_frame(pipe: tuple[int, int]) -> None:
    reading, writing = pipe
    os.write(writing, struct.pack(">I", 10) + b"half")
    os.close(writing)
    assert read_frame(reading) is None
    assert read_frame(reading) is None


def test_an_impossible_length_is_an_error_not_an_allocation(pipe: tuple[int, int]) -> None:
    reading, writing = pipe
    os.write(writing, struct.pack(">I", MAX_FRAME + 1))
    with pytest.raises(WireError, match="size"):
        read_frame(reading)
    with pytest.raises(ValueError, match="at most"):
        write_frame(writing, bytes(MAX_FRAME + 1))


def test_commands_are_no_reports() -> None:
    seen = WorkerSeen(node="edge1", task="t", incarnation="1", is_present=True)
    assert wire.decode(wire.encode(seen), *REPORTS) == seen
    with pytest.raises(WireError, match="kind"):
        wire.decode(wire.encode(seen), *COMMANDS)


def test_an_end_marker_is_read_or_is_none() -> None:
    marker = EndMarker(epoch=3, count=7)
    assert decode_end(encode_end(marker)) == marker
    assert decode_end(b"not one") is None


@pytest.fixture
def wakeups() -> Iterator[tuple[int, int]]:
    """Reading and writing end, as `signal.set_wakeup_fd` wants them."""
    ends = os.pipe()
    for end in ends:
        os.set_blocking(end, False)
    before = signal.set_wakeup_fd(ends[1])
    yield ends
    signal.set_wakeup_fd(before)
    for end in ends:
        os.close(end)


def test_a_signal_that_came_before_the_wait_ends_no_wait_for_a_frame(
    pipe: tuple[int, int], wakeups: tuple[int, int]
) -> None:
    """Its handler has run; what is left of it is taken away, or every further wait would spin."""
    os.write(wakeups[1], b"\x0f")
    writer = threading.Timer(0.2, os.write, (pipe[1], b"x"))
    writer.start()
    wait_readable(pipe[0], wakeups[0])
    assert os.read(pipe[0], 1) == b"x"
    with pytest.raises(BlockingIOError):
        os.read(wakeups[0], 1)
    writer.join(10)


def test_a_handler_that_raises_ends_the_wait(pipe: tuple[int, int], wakeups: tuple[int, int]) -> None:
    def stop(_number: int, _frame: object) -> None:
        raise SystemExit(0)

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, 0.1)
    try:
        with pytest.raises(SystemExit):
            wait_readable(pipe[0], wakeups[0])
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def test_the_end_of_the_pipe_can_be_read(pipe: tuple[int, int], wakeups: tuple[int, int]) -> None:
    os.close(pipe[1])
    wait_readable(pipe[0], wakeups[0])
    assert read_frame(pipe[0]) is None
