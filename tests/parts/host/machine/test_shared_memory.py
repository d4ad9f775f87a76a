"""Shared memory is for machines that can bear it: what is looked at, and that a session really uses it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
import zenoh

from support.waiting import free_endpoint, until
from zsched.host.machine.cgroup import CgroupTree
from zsched.host.machine.shared_memory import POOL_BYTES, why_not
from zsched.link.sessions.config import data_config, worker_config

UNLIMITED = CgroupTree(Path("/nowhere"))
PUBLISHER = """
import sys, zenoh
with zenoh.open(zenoh.Config.from_json5(sys.argv[1])) as session:
    publisher = session.declare_publisher("key", congestion_control=zenoh.CongestionControl.BLOCK)
    for line in sys.stdin:
        publisher.put(bytes(1 << 20))
"""


def plenty(monkeypatch: pytest.MonkeyPatch, free: int) -> None:
    facts = os.statvfs("/")
    values = list(facts)
    values[1], values[4] = 4096, free // 4096  # f_frsize, f_bavail
    monkeypatch.setattr(os, "statvfs", lambda _path: os.statvfs_result(values))


def same_network(root: Path) -> Path:
    for pid in ("self", "1"):
        (root / pid / "ns").mkdir(parents=True)
        (root / pid / "ns/net").symlink_to("net:[1]")
    return root


def test_a_fit_machine_may(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plenty(monkeypatch, 4 * POOL_BYTES)
    proc = same_network(tmp_path / "proc")
    assert why_not(2, tmp_path, UNLIMITED, proc) == ""
    assert [path.name for path in tmp_path.iterdir()] == ["proc"]  # the probe is gone


def test_too_small_not_there_or_read_only(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plenty(monkeypatch, 4 * POOL_BYTES - 4096)
    proc = same_network(tmp_path / "proc")
    assert why_not(2, tmp_path, UNLIMITED, proc).endswith("has 63 MiB left, 64 are needed")
    assert "cannot be written to: No such file" in why_not(1, tmp_path / "none", UNLIMITED, proc)


def test_under_a_quota_or_in_a_network_of_its_own(tmp_path: Path) -> None:
    root = tmp_path / "root"
    for name, text in {
        "proc/self/mountinfo": "30 25 0:26 / /sys/fs/cgroup rw - cgroup2 cgroup2 rw\n",
        "proc/self/cgroup": "0::/edge\n",
        "sys/fs/cgroup/edge/cpu.max": "50000 100000\n",
    }.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)
    proc = same_network(tmp_path / "proc")
    assert "CPU quota" in why_not(1, tmp_path, CgroupTree(root), proc)
    (proc / "self/ns/net").unlink()
    (proc / "self/ns/net").symlink_to("net:[2]")
    assert "network namespace" in why_not(1, tmp_path, UNLIMITED, proc)


@pytest.mark.parametrize("is_on", [False, True])
def test_large_puts_go_through_it_when_both_ends_have_it_on(*, is_on: bool) -> None:
    endpoint = free_endpoint()
    hub = data_config(listen=(endpoint,), connect=(), shared_memory=is_on)
    taken: list[bool] = []
    with zenoh.open(zenoh.Config.from_json5(hub)) as session:
        subscriber = session.declare_subscriber("key", lambda sample: taken.append(sample.payload.as_shm() is not None))
        command = [sys.executable, "-c", PUBLISHER, worker_config(connect=(endpoint,), shared_memory=is_on)]
        process = subprocess.Popen(command, stdin=subprocess.PIPE, text=True, bufsize=1)
        assert process.stdin is not None
        try:

            def sent() -> bool:
                assert process.stdin is not None
                process.stdin.write("\n")
                return len(taken) >= 10

            until(sent, "ten messages")
        finally:
            process.stdin.close()
            process.wait(60)
        subscriber.undeclare()
    assert any(taken) is is_on  # the first ones may come before the pool is made
