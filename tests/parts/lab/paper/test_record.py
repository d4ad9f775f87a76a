from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_typestore

from support.waiting import free_endpoint, until
from zsched.tasks.map_merge.cdr import encode_grid
from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import Grid
from zsched.tools.watch.tracks import ROS_DEFINITIONS
from zsched_lab.fleet import application
from zsched_lab.fleet.children import Children
from zsched_lab.fleet.groups import LimitedGroup
from zsched_lab.fleet.limits import LimitKind, NodeLimits
from zsched_lab.fleet.signals import StopFlag
from zsched_lab.paper.load import Loads, Window
from zsched_lab.paper.record import (
    PRECEDENCE,
    Heard,
    HostGauge,
    NodeMeter,
    StreamFile,
    record,
    stamp_ns,
)
from zsched_lab.paper.scenario import LoadLevel, NodeShare

NO_GROUPS = LimitedGroup.why_not()
needs_groups = pytest.mark.skipif(NO_GROUPS is not None, reason=f"no control groups: {NO_GROUPS}")
SPIN = (sys.executable, "-c", "while True: pass")
GROW = (sys.executable, "-c", "held = []\nwhile True:\n    held = [bytes(1 << 20) * 2 for _ in range(4)]")
"""Takes memory again and again: only what is taken inside a group is charged to it."""


def a_map(stamp: int) -> bytes:
    return encode_grid(Grid(data=np.zeros((4, 5), dtype=np.int8), resolution=0.05, origin=Pose2(), stamp_ns=stamp))


# --- streams ---------------------------------------------------------------------------------------------------------


def test_a_stream_file_is_read_by_any_mcap_reader() -> None:
    out = io.BytesIO()
    file = StreamFile(out)
    for number in range(3):
        file.write(Heard("robot1/global_map", a_map(1000 + number), 5000 + number))
    file.write(Heard("robot1/map_merge/status", b"{}", 6000))
    file.close()

    read = list(make_reader(io.BytesIO(out.getvalue())).iter_messages())

    assert [channel.topic for _, channel, _ in read] == ["robot1/global_map"] * 3 + ["robot1/map_merge/status"]
    assert [(m.log_time, m.publish_time, m.sequence) for _, _, m in read[:3]] == [
        (5000, 1000, 0), (5001, 1001, 1), (5002, 1002, 2),
    ]  # fmt: skip
    schema, channel, message = read[0]
    assert (schema.name if schema else "", channel.message_encoding) == ("nav_msgs/msg/OccupancyGrid", "cdr")
    assert message.data == a_map(1000)
    assert stamp_ns(b"nonsense") == 0


@pytest.mark.parametrize("kind", ROS_DEFINITIONS)
def test_the_schema_is_that_of_ros(kind: str) -> None:
    store = get_typestore(Stores.ROS2_HUMBLE)
    text, _ = store.generate_msgdef(kind, ros_version=2)

    def fields(definition: str) -> set[str]:
        lines = (line.partition("#")[0].split() for line in definition.splitlines())
        return {" ".join(words) for words in lines if words and not words[0].startswith(("=", "MSG"))}

    assert fields(ROS_DEFINITIONS[kind]) == fields(text)


def test_the_recorder_hears_what_a_robot_sends_and_ends_whole(tmp_path: Path) -> None:
    endpoint, out = free_endpoint(), tmp_path / "streams.mcap"
    config = zenoh.Config()
    config.insert_json5("mode", '"peer"')
    config.insert_json5("listen/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as session:
        command = [sys.executable, "-m", "zsched_lab.paper.record", "--robot", f"robot1={endpoint}", "--out", str(out)]
        process = subprocess.Popen(command, stderr=subprocess.PIPE)
        try:
            publisher = session.declare_publisher("robot1/map")
            deadline = time.monotonic() + 60
            while not matches(publisher) and time.monotonic() < deadline:
                time.sleep(0.02)
            for number in range(5):
                publisher.put(a_map(number))
                time.sleep(0.02)
            process.send_signal(signal.SIGTERM)
            _, told = process.communicate(timeout=60)
        finally:
            process.kill()
            process.wait()
    assert process.returncode == 0, told
    with out.open("rb") as stream:
        assert [m.publish_time for _, _, m in make_reader(stream).iter_messages()][1:] == [1, 2, 3, 4]


def matches(publisher: zenoh.Publisher) -> bool:
    status: Any = publisher.matching_status  # its stubs call it a bool; it is an object that is always true
    return bool(status.matching)


def test_a_robot_that_is_not_there_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(application, "CONNECT_S", 0.1)
    endpoint = free_endpoint()

    with pytest.raises(zenoh.ZError):
        record({"robot1": endpoint}, tmp_path / "x", StopFlag())


# --- accounting ------------------------------------------------------------------------------------------------------


@pytest.fixture
def spinner() -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen(GROW)
    yield process
    process.kill()
    process.wait()


@needs_groups
@pytest.mark.root
def test_a_nodes_meter_reads_its_share_and_the_gauge_does_not_count_its_throttling(
    spinner: subprocess.Popen[bytes],
) -> None:
    group = LimitedGroup.create(f"zsched-test-{os.getpid()}", cpu_cores=0.1, memory_mb=128)
    gauge = HostGauge.create(f"zsched-test-{os.getpid()}-host")
    try:
        group.add(spinner.pid)
        meter = NodeMeter.of(spinner.pid)
        assert meter.read(time.monotonic())["cpu_ratio"] is None
        until(lambda: meter.read(time.monotonic())["memory_ratio"], "memory taken in the group")
        gauge.start()
        time.sleep(0.5)  # what is measured: some periods of the quota
        read = meter.read(time.monotonic())
        host = gauge.result()
    finally:
        spinner.kill()
        spinner.wait()
        group.remove()
        gauge.remove()
    assert read["cpu_ratio"] is not None
    assert read["memory_ratio"] is not None
    assert 0.0 < read["cpu_ratio"] < 2.0
    assert 0.0 < read["memory_ratio"] < 0.5
    if host["pressure"] is not None:
        assert host["pressure"] == 0.0  # nothing is in the gauge's group; the throttled loop is in its own


@needs_groups
@pytest.mark.root
def test_the_gauge_sees_that_the_host_is_short() -> None:
    gauge = HostGauge.create(f"zsched-test-{os.getpid()}-short")
    if gauge.folder is None:
        pytest.skip("no pressure per group here (needs the unified hierarchy)")
    if gauge.first is not None:
        assert int((gauge.first / "cpu.shares").read_text()) == 1024 * PRECEDENCE
    spinners = [subprocess.Popen(SPIN) for _ in range(2 + (os.cpu_count() or 1))]
    try:
        for spinner in spinners:
            gauge.add(spinner.pid)
        gauge.start()
        deadline = time.monotonic() + 60
        while (gauge.result()["pressure"] or 0.0) < 0.3 and time.monotonic() < deadline:
            time.sleep(0.1)
        pressure = gauge.result()["pressure"]
    finally:
        for spinner in spinners:
            spinner.kill()
            spinner.wait()
        gauge.remove()
    assert pressure is not None
    assert pressure >= 0.3


# --- loads -----------------------------------------------------------------------------------------------------------


def test_loads_come_and_go_by_the_schedule_and_ballast_stays(tmp_path: Path) -> None:
    windows = (Window(node="edge1", start_s=1.0, end_s=5.0), Window(node="edge2", start_s=2.0, end_s=3.0))
    limits = NodeLimits(LimitKind.NONE, "none")
    told: list[str] = []
    with Children(tmp_path) as children:
        loads = Loads(
            windows, LoadLevel(share=0.1, side=32), 1.0, children, limits, tmp_path, lambda _, text: told.append(text)
        )
        loads.ballast("edge3", NodeShare(cpu_cores=0.1, memory_mb=256, ballast_mb=64))
        loads.ballast("edge2", NodeShare(cpu_cores=0.1, memory_mb=256))
        ballast = children.running("ballast-")
        deadline = time.monotonic() + 60
        while resident_mb(ballast[0].process.pid) < 64 and time.monotonic() < deadline:
            time.sleep(0.05)
        assert [child.name for child in ballast] == ["ballast-edge3"]
        assert resident_mb(ballast[0].process.pid) >= 64
        seen = []
        for t_s in (0.0, 1.5, 2.5, 3.5, 6.0):
            loads.tick(t_s)
            seen.append((sorted(loads.loaded), len(children.running("load-"))))
        assert seen == [([], 0), (["edge1"], 1), (["edge1", "edge2"], 2), (["edge1"], 1), ([], 0)]
        assert [(load.node, load.start_s, load.end_s) for load in loads.past] == [
            ("edge2", 2.5, 3.5),
            ("edge1", 1.5, 6.0),
        ]
        assert len(told) == 4
    assert children.left_behind == []


def resident_mb(pid: int) -> float:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * 4096 / 2**20
