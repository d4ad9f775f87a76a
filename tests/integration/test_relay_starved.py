"""A relay on a machine that is far too busy: it is given time to start, and nobody begins again for it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from support.waiting import until
from zsched.core.values.errors import AdapterError
from zsched.core.values.events import ProblemReported, RelayChanged
from zsched.core.values.relay_protocol import HandleReport
from zsched.link.sessions.config import data_config
from zsched.runtime.relay import streams
from zsched.runtime.relay.streams import RelayHandle
from zsched_lab.fleet.groups import LimitedGroup
from zsched_lab.fleet.relays import hello_of

pytestmark = pytest.mark.long

CONFIG = data_config(listen=("tcp/127.0.0.1:0",), connect=())


@pytest.mark.root
def test_a_relay_that_starts_with_next_to_no_processor_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """About a hundredth of a core: it takes 10 s and more to start, and nobody kills it meanwhile; status says why."""
    try:
        group = LimitedGroup.create(f"zsched-starved-{os.getpid()}", cpu_cores=0.04)
    except AdapterError as error:
        pytest.skip(str(error))
    monkeypatch.setattr(streams, "START_S", 0.5)
    monkeypatch.setattr(streams, "STARVED_S", 1.0)
    reports: list[HandleReport] = []
    handle = RelayHandle(
        hello=hello_of("test", "robot1"), path=tmp_path / "relay", zenoh_config=CONFIG, on_report=reports.append
    )
    rivals = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(3)]
    for rival in rivals:  # the kernel gives a group a little more than so small a share
        group.add(rival.pid)
    handle.start()
    try:
        group.add(until(lambda: handle.pid, "a process"))
        until(lambda: any(isinstance(one, RelayChanged) for one in reports), "it runs, or is replaced", 240.0)
    finally:
        for rival in rivals:
            rival.kill()
            rival.wait(60)
        handle.stop(1.0)
        group.remove()
    assert next(one.is_running for one in reports if isinstance(one, RelayChanged))
    told = [one.problem for one in reports if isinstance(one, ProblemReported) and one.source == "relay/processor"]
    assert "waits for a processor" in (told[0] or "")
    assert told[-1] is None
