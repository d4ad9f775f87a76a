"""A bench that is interrupted or killed loses the run it was making; what is done stays done."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from support.waiting import until
from zsched_lab.fleet.groups import LimitedGroup
from zsched_lab.fleet.janitor import TOKEN_VARIABLE
from zsched_lab.paper.places import scenario_path

pytestmark = pytest.mark.long

WHY_NOT = LimitedGroup.why_not()
CELL_S = 300.0
"""A run takes under half a minute where the machine is free; this is for one that is busy with other tests."""
RUN = "one-zsched-1"


def short_scenario(folder: Path) -> Path:
    """The paper's, with one cell of a few seconds, valid on a busy machine, too."""
    tree = YAML(typ="safe").load(scenario_path())
    fleet = scenario_path().parent / tree["fleet"]
    (folder / fleet.name).write_text(fleet.read_text())
    tree |= {"duration_s": 5, "runs": 1, "pressure_limit": 1.0, "schemes": ["zsched"]}
    tree |= {"sweep": {}, "blocks": {}, "quick": "matrix"}
    path = folder / "short.scenario.yml"
    with path.open("w") as file:
        YAML().dump(tree, file)
    return path


@contextmanager
def bench(scenario: Path, out: Path, *more: str) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "zsched.cli", "bench", "paper", "--input", "log", "--scenario", str(scenario)]
    command += ["--schemes", "zsched", "--out", str(out), *more]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        yield process
    finally:
        process.send_signal(signal.SIGINT)
        try:
            process.communicate(timeout=30.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()


def tokens(runs: Path) -> set[str]:
    """What the processes of the runs bear in their environment, by the fleet's sockets in the daemons' logs."""
    found = set()
    for pid in (entry for entry in Path("/proc").iterdir() if entry.name.isdecimal()):
        try:
            environment = (pid / "environ").read_bytes().split(b"\0")
            here = str(runs) in (pid / "cmdline").read_bytes().decode(errors="replace")
        except OSError:
            continue
        found |= {entry.decode() for entry in environment if here and entry.startswith(TOKEN_VARIABLE.encode())}
    return found


def alive(found: set[str]) -> list[str]:
    """The processes that bear one of these tokens."""
    names = []
    for pid in (entry for entry in Path("/proc").iterdir() if entry.name.isdecimal()):
        try:
            environment = (pid / "environ").read_bytes().decode(errors="replace").split("\0")
        except OSError:
            continue
        if found & set(environment) and int(pid.name) != os.getpid():
            names.append(pid.name)
    return names


@pytest.mark.root
@pytest.mark.timeout(1200)
@pytest.mark.skipif(WHY_NOT is not None, reason=f"no control groups: {WHY_NOT}")
def test_a_killed_and_an_interrupted_bench_lose_the_run_they_were_in(tmp_path: Path) -> None:
    scenario, out = short_scenario(tmp_path), tmp_path / "out"
    runs = out / "runs"
    run = runs / RUN

    with bench(scenario, out) as killed:
        until((run / "logs" / "daemon-edge1.log").exists, "the run began", CELL_S)
        begun = until(lambda: tokens(runs), "its processes", CELL_S)
        killed.kill()
        killed.wait(30.0)
    until(lambda: not alive(begun), "nothing of the killed run is left", CELL_S)
    assert not (run / "metrics.json").exists()

    with bench(scenario, out, "--resume") as interrupted:
        until((runs / f"{RUN}.interrupted-1").exists, "what the killed run left was put aside", CELL_S)
        until((run / "logs" / "daemon-edge1.log").exists, "the run began again", CELL_S)
        interrupted.send_signal(signal.SIGINT)
        told, _ = interrupted.communicate(timeout=CELL_S)
    assert interrupted.returncode == 128 + signal.SIGINT, told
    assert not (run / "metrics.json").exists()

    with bench(scenario, out, "--resume") as resumed:
        told, _ = resumed.communicate(timeout=CELL_S)
    assert resumed.returncode == 0, told
    aside = sorted(path.name for path in runs.iterdir() if "interrupted" in path.name)
    assert aside == [f"{RUN}.interrupted-1", f"{RUN}.interrupted-2"]
    metrics = (run / "metrics.json").read_bytes()

    with bench(scenario, out, "--resume") as again:
        told, _ = again.communicate(timeout=CELL_S)
    assert again.returncode == 0, told
    assert "1 of 1 runs are done already" in told
    assert (run / "metrics.json").read_bytes() == metrics
    results = json.loads((out / "results.json").read_text())
    assert [figures["scheme"] for figures in results["runs"]] == ["zsched"]
    assert results["missing"] == []
    assert (out / "report.md").exists()
