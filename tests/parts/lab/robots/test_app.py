from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest
import zenoh

from support.waiting import free_endpoint
from zsched.tasks.map_merge.cdr import decode_grid
from zsched_lab.fleet.recorder import read_records
from zsched_lab.maps.laser_log import LaserLog, load_log, malaga_path
from zsched_lab.robots.app import Drive


@pytest.fixture(scope="module")
def malaga() -> LaserLog:
    return load_log(malaga_path())


def test_a_drive_gives_each_scan_once_in_order_within_the_replay(malaga: LaserLog) -> None:
    drive = Drive(malaga, replay_s=99.0)
    total = len(malaga.scans)
    assert drive.due(0.0) is malaga.scans[0]
    assert drive.due(0.5) is None
    assert drive.wait_s(0.25) == pytest.approx(99.0 / total - 0.25)

    taken = [scan for second in range(99) for _ in range(3) if (scan := drive.due(float(second) + 1.0)) is not None]

    assert drive.done == drive.total == total
    assert taken == list(malaga.scans[1:])
    assert drive.due(1e9) is None
    assert drive.wait_s(0.0) == float("inf")


def peer(endpoint: str) -> zenoh.Session:
    config = {
        "mode": "peer",
        "listen": {"endpoints": [endpoint]},
        "scouting": {"multicast": {"enabled": False}},
        "transport": {"shared_memory": {"enabled": False}},
    }
    return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))


def test_it_publishes_its_growing_map_and_counts_the_merged_ones(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    command = [sys.executable, "-m", "zsched_lab.robots.app", "--robot", "robot1", "--index", "0", "--robots", "3"]
    command += ["--endpoint", endpoint, "--records", str(tmp_path), "--replay-s", "1.5"]
    process = subprocess.Popen(command)
    try:
        # The robot's side comes up later than its applications: they must wait for it.
        with (
            peer(endpoint) as session,
            session.declare_subscriber("robot1/map", zenoh.handlers.FifoChannel(64)) as maps,
        ):
            first = decode_grid(bytes(receive(maps).payload))
            second = decode_grid(bytes(receive(maps).payload))
            payload = bytes(receive(maps).payload)
            for name in ("global_map", "map_merge/status"):  # each is declared by itself
                wait_for_subscriber(session, f"robot1/{name}")
            put = partial(session.put, congestion_control=zenoh.CongestionControl.BLOCK)  # a map fills a queue
            put("robot1/global_map", b"no map")
            put("robot1/global_map", payload)
            put("robot1/map_merge/status", json.dumps({"robot1": "attached"}))
            put("robot1/map_merge/status", json.dumps({"robot1": "attached"}))
            wait_for_kinds(tmp_path / "robot1.ndjson", {"map", "bad_map", "status"})
            process.send_signal(signal.SIGTERM)
            assert process.wait(timeout=60.0) == 0
    finally:
        process.kill()
        process.wait()

    assert second.known_area_m2 > first.known_area_m2
    assert decode_grid((tmp_path / "robot1-global_map.cdr").read_bytes()).frame_id == "robot1/map"
    assert decode_grid((tmp_path / "robot1-map.cdr").read_bytes()).known_area_m2 >= second.known_area_m2
    records = read_records(tmp_path / "robot1.ndjson")
    kinds = [record["kind"] for record in records]
    assert (kinds.count("map"), kinds.count("bad_map"), kinds.count("status")) == (1, 1, 1)
    last = [record for record in records if record["kind"] == "progress"][-1]
    assert last["scans"] == last["scans_total"] == 33
    assert last["maps_received"] == 1
    assert last["bytes_received"] == len(payload)


def receive(subscriber: zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]]) -> zenoh.Sample:
    end = time.monotonic() + 60
    while time.monotonic() < end:
        sample = subscriber.try_recv()
        if sample is not None:
            return sample
        time.sleep(0.01)
    pytest.fail("no map within 60 s")


def wait_for_subscriber(session: zenoh.Session, key: str) -> None:
    with session.declare_publisher(key) as publisher:
        end = time.monotonic() + 60
        while not publisher.matching_status.matching:  # type: ignore[attr-defined]  # the stub says bool, it is none
            assert time.monotonic() < end, "the robot does not listen"
            time.sleep(0.01)


def wait_for_kinds(path: Path, kinds: set[str]) -> None:
    end = time.monotonic() + 60
    while missing := kinds - {record["kind"] for record in read_records(path)}:
        assert time.monotonic() < end, f"the robot did not record {missing}"
        time.sleep(0.05)
