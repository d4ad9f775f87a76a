"""`zsched stream` against a real fleet whose robot publishes at a known rate."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from rosbags.typesys import Stores, get_typestore

from support.mcap_files import read_mcap
from support.waiting import between
from zsched.tasks.map_merge.cdr import encode_grid
from zsched.tasks.map_merge.grid import Grid
from zsched_lab.fleet.testbed import Testbed, echo_fleet

pytestmark = pytest.mark.long

HZ, SIZE = 50.0, 1000
GRID = Grid(data=np.arange(12, dtype=np.int8).reshape(3, 4), resolution=0.05)
VERB_S = 30.0


@dataclass
class Site:
    """A fleet of one robot and one edge; an application publishes ``robot1/in`` at `HZ`."""

    runtime: Path

    def run(self, *arguments: str, code: int = 0) -> str:
        command = [sys.executable, "-m", "zsched.cli", "stream", *arguments, "--runtime-dir", str(self.runtime)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=VERB_S, check=False)
        assert done.returncode == code, done.stderr
        return done.stdout if code == 0 else done.stderr


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    folder = tmp_path_factory.mktemp("verbs")
    with Testbed(folder, echo_fleet(robots=1, edges=1)) as bed:
        bed.init()
        bed.start()
        bed.wait_settled()
        bed.wait(lambda: bed.task("robot1")["streams"], 60, "the first counters")
        halt = threading.Event()
        thread = threading.Thread(target=_publish, args=(bed.app("robot1"), halt))
        thread.start()
        try:
            yield Site(runtime=folder)
        finally:
            halt.set()
            thread.join(60)


def _publish(session: zenoh.Session, halt: threading.Event) -> None:
    publisher = session.declare_publisher("robot1/in")
    due = time.monotonic()
    while not halt.is_set():
        publisher.put(bytes(SIZE), attachment=b"seven b", encoding="application/x")
        session.put("robot1/map", encode_grid(GRID))
        due += 1 / HZ
        time.sleep(max(0.0, due - time.monotonic()))


def rows(text: str) -> dict[str, dict[str, Any]]:
    """The keys of the one JSON line in ``text``."""
    (line,) = text.splitlines()
    return {row["key"]: row for row in json.loads(line)["keys"]}


def test_list_shows_rates_and_keys(site: Site) -> None:
    body = json.loads(site.run("list", "--node", "robot1", "--json", "--window", "3"))
    assert (body["schema"], body["node"]) == ("zsched.stream.list/1", "robot1")
    into, out = body["streams"]
    assert (into["stream"], into["kind"], into["from"], into["to"]) == (
        "echo/in/0",
        "input",
        "robot1/in",
        "edge1/echo/robot1/in",
    )
    assert (out["kind"], out["from"], out["to"]) == ("output", f"edge1/echo/{out['epoch']}/robot1/out", "robot1/out")
    between(0.5 * HZ, into["hz"], 1.7 * HZ)  # the relay counts once a second
    between(0.5 * HZ * SIZE, into["bytes_per_s"], 1.7 * HZ * SIZE)
    text = site.run("list", "in/0", "--node", "robot1", "--window", "0.5")
    assert "robot1/in -> edge1/echo/robot1/in" in text
    assert "out/0" not in text


def test_an_edge_has_no_streams(site: Site) -> None:
    assert "edge1: no streams" in site.run("list", "--node", "edge1", "--window", "0.2")


def test_hz_of_a_stream_shows_both_its_ends(site: Site) -> None:
    found = rows(site.run("hz", "in/0", "--node", "robot1", "--window", "2", "--count", "1", "--json"))
    assert set(found) == {"robot1/in", "edge1/echo/robot1/in"}
    for row in found.values():
        between(0.7 * HZ, row["hz"], 1.2 * HZ)
        assert row["max_gap_s"] > row["min_gap_s"] >= 0
        assert row["side"] == "fleet"


def test_bw_of_the_robot_s_own_keys(site: Site) -> None:
    found = rows(site.run("bw", "--node", "robot1", "--window", "2", "--count", "1", "--json"))
    assert set(found) == {"robot1/in", "robot1/out"}
    row = found["robot1/in"]
    assert (row["min_bytes"], row["max_bytes"]) == (SIZE, SIZE)
    between(0.7 * HZ * SIZE, row["bytes_per_s"], 1.2 * HZ * SIZE)


def test_any_node_sees_the_fleet_s_keys_by_wildcard(site: Site) -> None:
    text = site.run("hz", "**", "--node", "edge1", "--window", "1", "--count", "2")
    assert "robot1/in: " in text
    assert " Hz, " in text
    assert "@zsched" not in text


def test_tail_shows_messages_as_they_come(site: Site) -> None:
    lines = site.run("tail", "robot1/in", "--node", "robot1", "--count", "3", "--json").splitlines()
    found = [json.loads(line) for line in lines]
    assert [(one["key"], one["kind"], one["bytes"], one["attachment_bytes"]) for one in found] == [
        ("robot1/in", "put", SIZE, 7)
    ] * 3
    assert found[0]["encoding"] == "application/x"
    assert found[0]["head_hex"] == "00" * 64
    assert "robot1/in 1.0 KiB" in site.run("tail", "robot1/in", "--node", "robot1", "--count", "1")


def test_silence_and_mistakes_have_their_codes(site: Site) -> None:
    command = ["hz", "nobody/here", "--node", "robot1", "--window", "0.5", "--count", "1"]
    told = "no stream here is called 'nobody/here' or touches such a key (there are echo/in/0, echo/out/0)"
    assert site.run(*command, code=1) == f"{told}: listening on it as a key\n"
    assert "no key expression" in site.run("hz", "/scan", "--node", "robot1", code=2)
    assert "robot1" in site.run("hz", "--node", "robot9", code=2)


def test_ctrl_c_ends_a_window_at_once(site: Site) -> None:
    command = [sys.executable, "-m", "zsched.cli", "stream", "hz", "--node", "robot1", "--window", "0.5"]
    with subprocess.Popen([*command, "--runtime-dir", str(site.runtime)], stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            assert "robot1/" in process.stdout.readline()
            process.send_signal(signal.SIGINT)
            assert process.wait(60) == 0
        finally:
            process.kill()


def test_a_recording_holds_maps_as_they_came(site: Site, tmp_path: Path) -> None:
    """Read back without the library that wrote it; ROS 2's message by an implementation of its own."""
    file = tmp_path / "run.mcap"
    command = [sys.executable, "-m", "zsched.cli", "record", "-o", str(file), "--for", "1.5s", "--interval", "0.5"]
    done = subprocess.run(
        [*command, "--map", "robot1/map", "--node", "robot1", "--runtime-dir", str(site.runtime)],
        capture_output=True,
        text=True,
        timeout=VERB_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    messages = read_mcap(file)
    store = get_typestore(Stores.ROS2_HUMBLE)
    maps: list[Any] = [store.deserialize_cdr(data, kind) for topic, kind, _, data in messages if topic == "/robot1/map"]
    assert len(maps) > 0.3 * HZ
    for one in maps:
        assert (one.info.width, one.info.height, list(one.data)) == (4, 3, list(range(12)))
    owners = {json.loads(data)["owner"] for topic, _, _, data in messages if topic == "/zsched/tasks/echo"}
    assert owners == {"edge1"}
    assert sum(topic == "/zsched/streams/echo/in/0" for topic, *_ in messages) >= 3
