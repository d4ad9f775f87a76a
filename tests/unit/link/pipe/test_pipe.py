from __future__ import annotations

import os
import struct
from collections.abc import Iterator

import pytest

from zsched.core.values import codec as wire
from zsched.core.values.errors import WireError
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
from zsched.core.values.relay_protocol import EndMarker, WorkerSeen
from zsched.link.pipe.frames import (
    COMMANDS,
    MAX_FRAME,
    REPORTS,
    decode_end,
    encode_end,
    read_frame,
    write_frame,
)

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
