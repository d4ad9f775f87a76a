"""The whole demo with real daemons: it shows what it promises, and leaves nothing behind at whatever moment it ends."""

from __future__ import annotations

import contextlib
import json
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from support.mcap_files import read_mcap
from zsched.tasks.map_merge.cdr import decode_grid, decode_transforms
from zsched_lab.fleet.janitor import TOKEN_VARIABLE, groups_of, tagged_processes

DEMO = (sys.executable, "-m", "zsched.cli", "demo", "--headless")


class Run:
    """One demo as a process, and the token by which everything of it is known."""

    def __init__(self, out: Path, duration_s: float) -> None:
        self.out = out
        self.output = out.with_suffix(".txt")
        with self.output.open("wb") as output:
            command = [*DEMO, "--out", str(out), "--duration", str(duration_s)]
            self.process = subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT)
        self.tokens: set[str] = set()

    def text(self) -> str:
        return self.output.read_text()

    def look_for_token(self) -> None:
        for child in Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split():
            try:
                words = Path(f"/proc/{child}/environ").read_bytes().decode().split("\0")
            except OSError:
                continue
            self.tokens |= {word.partition("=")[2] for word in words if word.startswith(f"{TOKEN_VARIABLE}=")}

    def wait_for(self, condition: Callable[[], bool], deadline_s: float) -> None:
        end = time.monotonic() + deadline_s
        while not condition():
            assert self.process.poll() is None, self.text()
            assert time.monotonic() < end, self.text()
            self.look_for_token()
            time.sleep(0.02)

    def left(self) -> list[str]:
        """What is there yet of the run: processes, control groups, runtime folder."""
        found = [f"process {pid}" for token in self.tokens for pid in tagged_processes(token)]
        found += [str(path) for token in self.tokens for path in groups_of(token)]
        return found + [str(path) for token in self.tokens for path in Path(tempfile.gettempdir()).glob(f"*{token}*")]

    def segments(self) -> set[Path]:
        """The shared memory that the run's processes have mapped."""
        found: set[str] = set()
        for pid in (pid for token in self.tokens for pid in tagged_processes(token)):
            with contextlib.suppress(OSError):
                found.update(re.findall(r"/dev/shm/\S+", Path(f"/proc/{pid}/maps").read_text(errors="replace")))  # noqa: S108 - what to look for
        return {Path(name) for name in found}


@pytest.fixture
def run(tmp_path: Path) -> Iterator[Callable[[float], Run]]:
    runs: list[Run] = []

    def start(duration_s: float) -> Run:
        runs.append(Run(tmp_path / "out", duration_s))
        return runs[-1]

    yield start
    for one in runs:
        one.process.kill()
        one.process.wait()


@pytest.mark.long
def test_the_demo_moves_the_task_and_merges_the_map(run: Callable[[float], Run]) -> None:
    demo = run(45.0)
    demo.wait_for(lambda: bool(demo.tokens), 60.0)

    assert demo.process.wait(timeout=120.0) == 0, demo.text()

    assert demo.left() == []
    summary = json.loads((demo.out / "summary.json").read_text())
    assert summary["schema"] == "zsched.demo/1"
    if "one CPU only" not in summary["limits"]:
        # It leaves each load where the machine does nothing else; beside other work no edge may be better.
        assert summary["moves"] >= 1, demo.text()
    assert summary["coverage"] >= 0.9
    assert summary["wall_f1"] >= 0.8
    assert summary["merges"] >= 20
    assert {row["attach"]["state"] for row in summary["robots"].values()} == {"attached"}
    epochs = [move["epoch"] for move in summary["allocations"]]
    assert epochs == sorted(set(epochs))
    for name in ("map.png", "timeline.png"):
        assert np.asarray(cv2.imread(str(demo.out / name))).std() > 10
    recorded = read_mcap(demo.out / "run.mcap")
    kinds = {topic: kind for topic, kind, _, _ in recorded}
    assert kinds["/robot1/global_map"] == kinds["/robot1/map"] == "nav_msgs/msg/OccupancyGrid"
    assert kinds["/robot1/map_merge/tf"] == "tf2_msgs/msg/TFMessage"
    merged = [decode_grid(data).known_area_m2 for topic, _, _, data in recorded if topic == "/robot1/global_map"]
    assert merged[-1] > merged[0], "it grows"
    frames = [decode_transforms(data) for topic, _, _, data in recorded if topic == "/robot1/map_merge/tf"]
    assert {one.child for one in frames[-1]} == {f"robot{number}/map" for number in (1, 2, 3)}
    moves = [json.loads(data) for topic, _, _, data in recorded if topic == "/zsched/moves"]
    assert {move["owner"] for move in moves} <= {move["node"] for move in summary["allocations"]}
    assert moves
    assert (demo.out / "fleet.yaml").exists()
    assert (demo.out / "logs" / "daemon-robot1.log").read_text() != ""
    assert re.search(r"map_merge moves edge\d -> edge\d \(epoch 2\)", demo.text())


MOMENTS = {
    "starting": lambda demo: bool(demo.tokens),
    "coming up": lambda demo: "daemons started" in demo.text(),
    "driving": lambda demo: "start to drive" in demo.text(),
    "loaded": lambda demo: "neural load on" in demo.text(),
}


@pytest.mark.parametrize(
    ("number", "moment"),
    [
        *(
            pytest.param(*other, marks=pytest.mark.long)
            for other in (
                (signal.SIGINT, "starting"),
                (signal.SIGINT, "coming up"),
                (signal.SIGINT, "loaded"),
                (signal.SIGKILL, "starting"),
                (signal.SIGKILL, "driving"),
            )
        ),
        (signal.SIGKILL, "loaded"),
    ],
)
def test_nothing_is_left_at_whatever_moment_it_ends(
    run: Callable[[float], Run], moment: str, number: signal.Signals
) -> None:
    demo = run(30.0)
    demo.wait_for(lambda: bool(demo.tokens) and MOMENTS[moment](demo), 100.0)

    segments = demo.segments()
    demo.process.send_signal(number)
    demo.process.wait(timeout=40.0)

    end = time.monotonic() + 60
    while (demo.left() or any(path.exists() for path in segments)) and time.monotonic() < end:
        time.sleep(0.05)
    assert not [path for path in segments if path.exists()]
    assert demo.left() == []
    if number == signal.SIGINT:
        assert demo.process.returncode == 128 + signal.SIGINT
        assert "nothing is left running" in demo.text()
