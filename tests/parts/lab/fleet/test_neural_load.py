from __future__ import annotations

import importlib.util
import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from zsched_lab.fleet.neural_load import (
    LoadOptions,
    candidates,
    frames,
    load_network,
    run,
    synthetic_network,
)
from zsched_lab.fleet.signals import StopFlag

HAS_DETECTOR = importlib.util.find_spec("rapidocr") is not None


@pytest.mark.skipif(not HAS_DETECTOR, reason="rapidocr (the wheel with the detector) is not installed")
def test_the_detector_is_found_without_importing_its_package() -> None:
    names = [name for name, _ in candidates()]

    assert names[0].startswith("text detector")
    assert "rapidocr" not in sys.modules


@pytest.mark.skipif(not HAS_DETECTOR, reason="rapidocr (the wheel with the detector) is not installed")
def test_the_detector_looks_at_a_whole_frame() -> None:
    network = load_network(threads=1)

    result = np.asarray(network.infer(frames(64)[0]))[0]

    assert "yolo" not in network.name.lower()
    assert result.shape[-2:] == (64, 64)
    assert np.isfinite(result).all()


def test_a_set_frame_rate_is_kept() -> None:
    total = run(synthetic_network(), LoadOptions(hz=20.0, side=32, duration_s=0.5), StopFlag(), lambda _: None)

    assert 1 <= total <= 12


def test_it_reports_each_second_and_stops_on_sigterm(tmp_path: Path) -> None:
    output = tmp_path / "out"
    with output.open("wb") as file:
        process = subprocess.Popen(
            [sys.executable, "-m", "zsched_lab.fleet.neural_load", "--side", "64", "--hz", "20"],
            stdout=file,
            stderr=subprocess.DEVNULL,
        )
    try:
        deadline = time.monotonic() + 60.0
        while not output.read_bytes().endswith(b"\n") and time.monotonic() < deadline:
            time.sleep(0.05)
        process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=60.0) == 0
    finally:
        process.kill()
        process.wait()
    line = json.loads(output.read_bytes().splitlines()[0])
    assert line["frames"] >= 1
    assert line["fps"] > 0
    assert line["threads"] == 1
