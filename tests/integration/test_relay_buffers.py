"""Real relays and workers size the send buffers of their links, whatever class a stream has, and keep no memory."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from support.relay_rig import ROBOT, Application, Rig, relay_rig, slot
from support.sessions import matches
from support.waiting import until
from zsched.core.hop.room import LARGE, SMALL
from zsched.core.values.plan import StreamClass

MIB = 1 << 20
SEND_BUFFER = re.compile(r"skmem:\(.*?,tb(\d+)")


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with relay_rig(tmp_path) as made:
        yield made


def largest(pid: int) -> int:
    """The largest send buffer of a process, as large as the kernel makes it."""
    told = subprocess.run(["ss", "-tnmpHO"], capture_output=True, text=True, check=True).stdout.splitlines()
    return max((int(size) for one in told if f"pid={pid}," in one for size in SEND_BUFFER.findall(one)), default=0)


@pytest.mark.long
@pytest.mark.skipif(shutil.which("ss") is None, reason="ss (iproute2) tells of another process's sockets")
@pytest.mark.parametrize("stream_class", StreamClass)
def test_large_samples_there_and_back_get_large_buffers_on_both_sides(rig: Rig, stream_class: StreamClass) -> None:
    rig.start_worker("edge1", *(["--latest"] if stream_class is StreamClass.LATEST else []))
    rig.move(slot(1, "edge1", stream_class, 1))
    publisher = rig.app.declare_publisher(f"{ROBOT}/in")
    back: list[int] = []
    kept = rig.app.declare_subscriber(f"{ROBOT}/out", lambda sample: back.append(len(sample.payload)))
    until(lambda: matches(publisher), "the relay takes it")
    pids = {"relay": rig.relays[ROBOT].pid, "worker": rig.workers["edge1"].pid}
    assert largest(pids["relay"] or 0) == 2 * SMALL, "which the kernel doubles"

    def are_large() -> bool:
        publisher.put(bytes(MIB))
        return all(pid is not None and largest(pid) > 2 * LARGE for pid in pids.values())

    until(are_large, "the relay's towards the application, the worker's towards the relay")
    assert set(back) == {MIB}
    kept.undeclare()


@pytest.mark.long
def test_a_relay_gives_back_what_large_samples_took(rig: Rig) -> None:
    """Samples of 80 MiB left 360 MB with it for good."""
    rig.start_worker("edge1")
    app = Application(rig.app)
    rig.move(slot(1, "edge1", StreamClass.RELIABLE, 1))
    until(app.connected, "the application sees the relay's subscription")
    relay = psutil.Process(rig.relays[ROBOT].pid)
    before = relay.memory_full_info().uss
    app.padding = bytes(80 * MIB)
    for _ in range(3):
        app.put()
        until(lambda: len(app.back) == app.sent, "the large answer")
    app.padding = b""

    def is_small() -> bool:
        app.put()
        return bool(relay.memory_full_info().uss < before + 20 * MIB)

    until(is_small, "the memory is given back")
