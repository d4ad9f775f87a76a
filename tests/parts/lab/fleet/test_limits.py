from __future__ import annotations

import os
import secrets
import subprocess
import sys
import time
from pathlib import Path

import pytest

from support.waiting import until
from zsched_lab.fleet.groups import LimitedGroup
from zsched_lab.fleet.janitor import clean, groups_of
from zsched_lab.fleet.limits import LimitKind, by_affinity, make_limits

BUSY = [sys.executable, "-c", "while True: pass"]
WHY_NOT = LimitedGroup.why_not(memory=False)


def cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


@pytest.mark.skipif(WHY_NOT is not None, reason=f"no control groups here: {WHY_NOT}")
def test_a_nodes_share_is_its_own_and_is_removed() -> None:
    token = secrets.token_hex(8)
    limits = make_limits(f"zsched-{token}", {"edge1": 0.2, "edge2": 0.5}, 256.0)
    busy = subprocess.Popen(BUSY)
    try:
        assert limits.kind is LimitKind.CGROUP
        limits.put("edge1", busy.pid)
        until(lambda: cpu_s(busy.pid) >= 0.1, "the loop runs", 60.0)  # the interpreter's start, and what was saved up
        before, started = cpu_s(busy.pid), time.monotonic()
        until(lambda: cpu_s(busy.pid) >= before + 0.2, "it goes on", 60.0)
        took_s = time.monotonic() - started
    finally:
        busy.kill()
        busy.wait()
        limits.remove()
    assert took_s >= 0.6  # a fifth of a CPU: 1 s, less a period of what was saved up; more on a busy machine
    assert groups_of(token) == []


@pytest.mark.skipif(WHY_NOT is not None, reason=f"no control groups here: {WHY_NOT}")
def test_groups_within_a_nodes_are_cleaned_away_with_it() -> None:
    """Only the node's own has the run's token in its name."""
    token = secrets.token_hex(8)
    outer = LimitedGroup.create(f"zsched-{token}-edge1", cpu_cores=0.5)
    inner = outer.inner("work", cpu_cores=0.2)
    assert set(groups_of(token)) == {*outer.folders, *inner.folders}
    assert clean(token, [], time.time()) == {"killed": [], "left": []}
    assert groups_of(token) == []


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="one CPU only")
def test_without_groups_each_edge_gets_a_cpu() -> None:
    limits = by_affinity(("edge1", "edge2"), "not root")
    busy = subprocess.Popen(BUSY)
    try:
        assert limits.kind is LimitKind.AFFINITY
        assert "not root" in limits.says
        limits.put("edge1", busy.pid)
        first = os.sched_getaffinity(busy.pid)
        limits.put("edge2", busy.pid)
        second = os.sched_getaffinity(busy.pid)
        limits.put("robot1", busy.pid)
        assert os.sched_getaffinity(busy.pid) == second
    finally:
        busy.kill()
        busy.wait()
    assert len(first) == len(second) == 1
    assert first != second
