"""Samples of fake machines (v1, v2, broken) and of this one, against psutil and a real busy process tree."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path

import psutil
import pytest

from support.waiting import until
from zsched.core.values.profile import WorkerState
from zsched.host.machine import device_profiler
from zsched.host.machine.device_profiler import (
    DeviceProfiler,
    _ProcessTrees,
    parse_cpu_list,
    parse_cpu_stat,
)
from zsched.host.procfs import parse_process_stat, parse_schedstat
from zsched_lab.fleet.groups import LimitedGroup

MEMINFO = "MemTotal:        4096000 kB\nMemFree: 100 kB\nMemAvailable:    3072000 kB\nHugePages_Total: 0\n"
V2 = "30 25 0:26 / /sys/fs/cgroup rw - cgroup2 cgroup2 rw\n"


class Clock:
    """The profiler's, moved by hand."""

    now = 1000.0


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(device_profiler, "awake_s", lambda: made.now)
    return made


def stat(*cpus: str) -> str:
    return (
        "".join(f"cpu{'' if n == 0 else n - 1} {cpu}\n" for n, cpu in enumerate(("0 0 0 0 0 0 0 0 0 0", *cpus)))
        + "intr 1\n"
    )


def write(root: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)


def machine(root: Path, **more: str) -> DeviceProfiler:
    write(root, {"proc/stat": stat("100 0 0 100 0 0 0 0 0 0", "100 0 0 100 0 0 0 0 0 0"), "proc/meminfo": MEMINFO})
    write(root, more)
    return DeviceProfiler(root)


def test_first_sample_has_no_cpu_and_iowait_is_idle_and_steal_is_not(tmp_path: Path) -> None:
    profiler = machine(tmp_path)
    first = profiler.sample({})
    assert (first.cpu_cores, first.cpu_used_cores) == (2.0, None)
    assert (first.memory_mb, first.memory_used_mb) == (4000.0, 1000.0)
    write(tmp_path, {"proc/stat": stat("110 2 3 130 50 0 0 5 9 9", "100 0 0 200 0 0 0 0 0 0")})
    assert profiler.sample({}).cpu_used_cores == pytest.approx(2.0 * 20 / 200)


def test_only_allowed_cpus_count(tmp_path: Path) -> None:
    profiler = machine(tmp_path, **{"proc/self/status": "Name:\tx\nCpus_allowed_list:\t1\nMems_allowed:\t1\n"})
    assert profiler.sample({}).cpu_cores == 1.0
    write(tmp_path, {"proc/stat": stat("900 0 0 100 0 0 0 0 0 0", "150 0 0 150 0 0 0 0 0 0")})
    assert profiler.sample({}).cpu_used_cores == pytest.approx(0.5)


def test_cpu_in_use_is_measured_on_when_a_cpu_leaves_or_comes(tmp_path: Path) -> None:
    """Its ticks since boot leave or come with it."""
    profiler = machine(tmp_path)
    profiler.sample({})
    write(tmp_path, {"proc/stat": stat("100 0 0 200 0 0 0 0 0 0", "150 0 0 150 0 0 0 0 0 0")})
    assert profiler.sample({}).cpu_used_cores == pytest.approx(0.5)
    write(tmp_path, {"proc/stat": stat("110 0 0 200 0 0 0 0 0 0")})
    assert profiler.sample({}).cpu_used_cores is None, "sums of other CPUs tell no difference"
    write(tmp_path, {"proc/stat": stat("160 0 0 200 0 0 0 0 0 0")})
    sample = profiler.sample({})
    assert [sample.cpu_cores, sample.cpu_used_cores] == pytest.approx([1.0, 1.0])
    write(tmp_path, {"proc/stat": stat("170 0 0 200 0 0 0 0 0 0", "150 0 0 150 0 0 0 0 0 0")})
    assert profiler.sample({}).cpu_used_cores is None
    write(tmp_path, {"proc/stat": stat("180 0 0 200 0 0 0 0 0 0", "150 0 0 160 0 0 0 0 0 0")})
    assert profiler.sample({}).cpu_used_cores == pytest.approx(1.0)


def test_cpu_in_use_is_measured_anew_on_other_cpus_of_the_same_number(tmp_path: Path, clock: Clock) -> None:
    allowed = "Name:\tx\nCpus_allowed_list:\t{}\nMems_allowed:\t1\n"
    profiler = machine(tmp_path, **{"proc/self/status": allowed.format(0)})
    profiler.sample({})
    clock.now += device_profiler.LIMITS_EVERY_S
    cpus = ("200 0 0 100 0 0 0 0 0 0", "100 0 0 900 0 0 0 0 0 0")
    write(tmp_path, {"proc/self/status": allowed.format(1), "proc/stat": stat(*cpus)})
    assert profiler.sample({}).cpu_used_cores is None
    write(tmp_path, {"proc/stat": stat(cpus[0], "150 0 0 950 0 0 0 0 0 0")})
    assert profiler.sample({}).cpu_used_cores == pytest.approx(0.5)


def test_quota_makes_the_group_the_machine(tmp_path: Path, clock: Clock) -> None:
    files = {
        "proc/self/mountinfo": V2,
        "proc/self/cgroup": "0::/a\n",
        "sys/fs/cgroup/a/cpu.max": "50000 100000\n",
        "sys/fs/cgroup/a/cpu.stat": "usage_usec 1000000\n",
        "sys/fs/cgroup/a/memory.max": str(512 * 2**20),
        "sys/fs/cgroup/a/memory.current": str(300 * 2**20),
        "sys/fs/cgroup/a/memory.stat": f"inactive_file {100 * 2**20}\n",
    }
    profiler = machine(tmp_path, **files)
    first = profiler.sample({})
    assert (first.cpu_cores, first.memory_mb, first.memory_used_mb) == (0.5, 512.0, 200.0)
    clock.now += 0.1
    write(tmp_path, {"sys/fs/cgroup/a/cpu.stat": "usage_usec 1030000\n"})
    assert profiler.sample({}).cpu_used_cores == pytest.approx(0.3)


def test_a_group_that_does_not_tell_its_cpu_time_is_as_busy_as_the_machine(tmp_path: Path, clock: Clock) -> None:
    """Else it would not be measured, and could have no task."""
    quota = {"proc/self/mountinfo": V2, "proc/self/cgroup": "0::/a\n", "sys/fs/cgroup/a/cpu.max": "150000 100000\n"}
    profiler = machine(tmp_path, **quota)
    profiler.sample({})
    write(tmp_path, {"proc/stat": stat("140 0 0 160 0 0 0 0 0 0", "110 0 0 190 0 0 0 0 0 0")})
    sample = profiler.sample({})
    assert [sample.cpu_cores, sample.cpu_used_cores] == pytest.approx([1.5, 1.5 * 50 / 200])
    assert "does not tell" in (profiler.problem or "")
    clock.now += 0.1
    write(tmp_path, {"sys/fs/cgroup/a/cpu.stat": "usage_usec 1000000\n"})
    assert profiler.sample({}).cpu_used_cores is None, "another account"
    clock.now += 0.1
    write(tmp_path, {"sys/fs/cgroup/a/cpu.stat": "usage_usec 1060000\n"})
    assert profiler.sample({}).cpu_used_cores == pytest.approx(0.6)
    assert profiler.problem is None


def test_machine_with_less_memory_left_than_the_group_may_use_tells_so(tmp_path: Path) -> None:
    files = {
        "proc/self/mountinfo": V2,
        "proc/self/cgroup": "0::/a\n",
        "sys/fs/cgroup/a/memory.max": str(3500 * 2**20),
        "sys/fs/cgroup/a/memory.current": "0",
    }
    sample = machine(tmp_path, **files).sample({})
    assert (sample.memory_mb, sample.memory_used_mb) == (3500.0, 500.0)


RUNNING = "ctxt 9\nprocesses 7\nprocs_running 6\nprocs_blocked 1\n"


def test_who_wants_to_run_is_counted_without_the_profiler(tmp_path: Path) -> None:
    profiler = machine(tmp_path)
    assert profiler.sample({}).runnable is None, "this kernel does not tell"
    text = (tmp_path / "proc/stat").read_text()
    write(tmp_path, {"proc/stat": text + RUNNING})
    assert profiler.sample({}).runnable == 5.0
    write(tmp_path, {"proc/stat": text + RUNNING.replace("6", "0")})
    assert profiler.sample({}).runnable == 0.0


def test_on_some_of_the_cpus_or_under_a_quota_nobody_counts_who_else_wants_them(tmp_path: Path) -> None:
    some = {"proc/self/status": "Name:\tx\nCpus_allowed_list:\t1\n"}
    quota = {
        "proc/self/mountinfo": V2,
        "proc/self/cgroup": "0::/a\n",
        "sys/fs/cgroup/a/cpu.max": "50000 100000\n",
        "sys/fs/cgroup/a/cpu.stat": "usage_usec 1000000\n",
    }
    for number, files in enumerate((some, quota)):
        root = tmp_path / str(number)
        profiler = machine(root, **files)
        write(root, {"proc/stat": (root / "proc/stat").read_text() + RUNNING})
        assert profiler.sample({}).runnable is None


def test_unreadable_machine_gives_none_and_never_raises(tmp_path: Path) -> None:
    sample = DeviceProfiler(tmp_path).sample({"merge": (WorkerState.READY, 5)})
    assert sample.cpu_used_cores is None
    assert sample.memory_used_mb is None
    assert sample.cpu_cores >= 1.0
    assert sample.memory_mb > 1.0
    assert sample.workers[0].cpu_cores is None


def test_stat_lines_are_parsed_by_the_last_bracket_and_garbage_is_none() -> None:
    line = b"7 (a) b (c) S 3 7 7 0 -1 4194560 9 9 0 0 100 50 30 20 20 0 4 0 500 1000 256 18446744073709551615\n"
    times = parse_process_stat(line)
    assert times is not None
    assert (times.parent, times.own_s, times.waited_s, times.threads, times.start_s) == (3, 1.5, 0.5, 4, 5.0)
    assert times.rss_mb == 1.0
    assert parse_process_stat(b"") is None
    assert parse_process_stat(line[:40]) is None
    assert parse_cpu_stat(b"intr 5\n", None) is None
    assert parse_cpu_list("0-2,8,x,4-\n") == {0, 1, 2, 8}


def process(pid: int, parent: int, *, own: int, waited: int = 0, start: int = 100, pages: int = 256) -> dict[str, str]:
    times = f"{own} 0 {waited} 0"
    return {f"proc/{pid}/stat": f"{pid} (w) S {parent} 1 1 0 -1 0 0 0 0 0 {times} 20 0 1 0 {start} 0 {pages}\n"}


def test_tree_keeps_the_time_of_a_child_that_ended(tmp_path: Path, clock: Clock) -> None:
    profiler = machine(tmp_path, **process(10, 1, own=100), **process(11, 10, own=50), **process(12, 1, own=7))
    workers = {"merge": (WorkerState.READY, 10)}
    load = profiler.sample(workers).workers[0]
    assert (load.cpu_cores, load.memory_mb) == (None, 2.0)
    clock.now += 0.1
    (tmp_path / "proc/11/stat").unlink()
    write(tmp_path, process(10, 1, own=102, waited=51))
    load = profiler.sample(workers).workers[0]
    assert load.cpu_cores == pytest.approx(0.3)
    assert load.memory_mb == 1.0


def test_adopted_old_process_does_not_make_a_spike(tmp_path: Path) -> None:
    profiler = machine(tmp_path, **process(10, 1, own=100))
    workers = {"merge": (WorkerState.READY, 10)}
    profiler.sample(workers)
    time.sleep(0.05)
    write(tmp_path, process(11, 10, own=100_000, start=1))  # 1000 s of CPU time, since boot
    load = profiler.sample(workers).workers[0]
    assert load.cpu_cores is not None
    assert load.cpu_cores < 1000.0 / time.clock_gettime(time.CLOCK_BOOTTIME) * 2.0


@pytest.mark.parametrize("ahead_s", [-40.0, 0.0, 40.0])
def test_a_young_child_counts_whole_however_far_the_clocks_have_parted(
    tmp_path: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch, ahead_s: float
) -> None:
    """The kernel tells its start by a clock that time services slew, 30 ppm say: 26 s in ten days."""
    monkeypatch.setattr(device_profiler, "boot_s", lambda: clock.now - ahead_s)
    profiler = machine(tmp_path, **process(10, 1, own=100))
    workers = {"merge": (WorkerState.READY, 10)}
    profiler.sample(workers)
    clock.now += 0.2
    born = round((clock.now - ahead_s - 0.1) * 100)
    write(tmp_path, process(11, 10, own=8, start=born))
    (load,) = profiler.sample(workers).workers
    assert load.cpu_cores == pytest.approx(0.08 / 0.2)


def queued(pid: int, *threads: tuple[float, float]) -> dict[str, str]:
    """Threads of a process, and for how many seconds each has run and has waited to run."""
    return {
        f"proc/{pid}/task/{pid + number}/schedstat": f"{run_s * 1e9:.0f} {wait_s * 1e9:.0f} 5\n"
        for number, (run_s, wait_s) in enumerate(threads)
    }


def test_a_thread_that_always_wants_to_run_wants_a_core_and_one_that_rests_what_it_uses(
    tmp_path: Path, clock: Clock
) -> None:
    """The first thread gets half a core and waits for the rest; the second has work for 0.2 s a second."""
    profiler = machine(tmp_path, **process(10, 1, own=0), **queued(10, (0.0, 0.0), (0.0, 0.0)))
    workers = {"merge": (WorkerState.READY, 10)}
    seen = []
    for step in range(60):
        at_s = 0.2 * step
        write(tmp_path, queued(10, (0.5 * at_s, 0.5 * at_s), (0.2 * at_s, 0.0)))
        seen.append(profiler.sample(workers).workers[0].wanted_cores)
        clock.now += 0.2
    first = next(number for number, wanted in enumerate(seen) if wanted is not None)
    assert 3.0 < 0.2 * first < 6.0, "so long it takes to tell it from one with pauses"
    assert seen[-1] == pytest.approx(1.2, abs=0.02)


def test_a_worker_tells_how_many_of_its_threads_run_or_wait_also_those_with_pauses(
    tmp_path: Path, clock: Clock
) -> None:
    profiler = machine(tmp_path, **process(10, 1, own=0), **queued(10, (0.0, 0.0), (0.0, 0.0)))
    workers = {"merge": (WorkerState.READY, 10)}
    assert profiler.sample(workers).workers[0].runnable is None
    for step in range(1, 20):
        clock.now += 0.2
        write(tmp_path, process(10, 1, own=10 * step) | queued(10, (0.1 * step, 0.04 * step), (0.0, 0.02 * step)))
        assert profiler.sample(workers).workers[0].runnable == pytest.approx(0.8)
    for _ in range(3):
        clock.now += 0.2
        load = profiler.sample(workers).workers[0]
    assert load.runnable == load.cpu_cores == 0.0, "it rests"


def test_a_worker_with_pauses_wants_nothing_beyond_what_it_uses(tmp_path: Path, clock: Clock) -> None:
    """Jobs of 0.6 s a second, half of it in the queue."""
    profiler = machine(tmp_path, **process(10, 1, own=0), **queued(10, (0.0, 0.0)))
    workers = {"merge": (WorkerState.READY, 10)}
    busy_s = 0.0
    for step in range(100):
        busy_s += 0.2 if step % 5 < 3 else 0.0
        clock.now += 0.2
        write(tmp_path, queued(10, (busy_s / 2, busy_s / 2)))
        assert profiler.sample(workers).workers[0].wanted_cores is None


def test_a_wait_that_is_told_when_it_ends_counts_in_full(tmp_path: Path, clock: Clock) -> None:
    """0.1 s in the queue, then 0.1 s on the CPU, looked at every 0.05 s."""
    profiler = machine(tmp_path, **process(10, 1, own=0), **queued(10, (0.0, 0.0)))
    workers = {"merge": (WorkerState.READY, 10)}
    seen = []
    for step in range(1, 400):
        clock.now += 0.05
        waits = 0.1 * ((step + 1) // 4)
        runs = 0.1 * (step // 4) + 0.05 * max(step % 4 - 2, 0)
        write(tmp_path, queued(10, (runs, waits)))
        seen.append(profiler.sample(workers).workers[0].wanted_cores)
    assert all(wanted is not None and wanted > 0.9 for wanted in seen[120:])


def test_the_threads_and_children_of_a_worker_that_rests_are_looked_at_now_and_then(
    tmp_path: Path, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks: list[float] = []
    threads = _ProcessTrees._threads

    def count(trees: _ProcessTrees, tree: Iterable[int]) -> dict[tuple[int, str], tuple[float, float]]:
        looks.append(clock.now)
        return threads(trees, tree)

    monkeypatch.setattr(_ProcessTrees, "_threads", count)
    profiler = machine(tmp_path, **process(10, 1, own=0), **queued(10, (0.0, 0.0)))
    workers = {"merge": (WorkerState.READY, 10)}

    def sample(times: int) -> int:
        before = len(looks)
        for _ in range(times):
            profiler.sample(workers)
            clock.now += 0.2
        return len(looks) - before

    sample(5)
    assert sample(50) == 10, "nobody knows whether it lacks a CPU"
    write(tmp_path, {"proc/pressure/cpu": "some avg10=0 avg60=0 avg300=0 total=5\n"})
    sample(20)
    assert 3 <= sample(50) <= 4, "it is still, and nobody lacks a CPU: every 3 s"
    profiler.look_closely()
    assert sample(1) == 1, "work has come"
    write(tmp_path, process(10, 1, own=2))
    assert sample(10) >= 1, "it runs a little: within a second"
    found = 0
    for step in range(10):
        write(tmp_path, process(10, 1, own=100 + 10 * step))
        found += sample(1)
    assert found >= 9, "it runs: each sample looks, but perhaps the first"


def test_without_schedstat_nothing_is_said_and_garbage_is_none(tmp_path: Path, clock: Clock) -> None:
    profiler = machine(tmp_path, **process(10, 1, own=0), **{"proc/10/task/10/schedstat": "what\n"})
    for _ in range(3):
        clock.now += 1.0
        assert profiler.sample({"merge": (WorkerState.READY, 10)}).workers[0].wanted_cores is None
    assert parse_schedstat(b"") is parse_schedstat(b"5\n") is parse_schedstat(b"a b c\n") is None
    assert parse_schedstat(b"1500000000 250000000 7\n") == (1.5, 0.25)


SPIN = "import os\nos.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\nprint('up', flush=True)\nwhile True: pass"


def test_a_real_process_that_shares_its_cpu_wants_all_of_it() -> None:
    """Two endless loops on one CPU; the kernel tells that the one which is our worker has to wait."""
    command = [sys.executable, "-c", SPIN]
    profiler = DeviceProfiler()
    with (
        subprocess.Popen(command, stdout=subprocess.PIPE) as worker,
        subprocess.Popen(command, stdout=subprocess.DEVNULL) as other,
    ):
        try:
            assert worker.stdout is not None
            worker.stdout.readline()
            workers = {"merge": (WorkerState.READY, worker.pid)}

            looked_at = time.monotonic()

            def wants() -> bool:
                nonlocal looked_at
                if time.monotonic() - looked_at < 0.2:
                    return False  # as often as a daemon looks
                looked_at = time.monotonic()
                load = profiler.sample(workers).workers[0]
                return load.wanted_cores is not None and load.cpu_cores is not None and load.cpu_cores < 0.8

            until(wants, "it wants a core and gets less")
        finally:
            other.kill()
            worker.kill()


PRESSURE = "some avg10=1.00 avg60=1.00 avg300=1.00 total={}\nfull avg10=0.00 avg60=0.00 avg300=0.00 total=9\n"


def test_pressure_is_the_share_of_the_time_in_which_somebody_lacked_a_cpu(tmp_path: Path, clock: Clock) -> None:
    profiler = machine(tmp_path, **{"proc/pressure/cpu": PRESSURE.format(5_000_000)})
    assert profiler.sample({}).cpu_pressure is None, "nothing to compare with"
    for passed_s, total_us, share in ((0.2, 5_100_000, 0.5), (0.2, 5_100_000, 0.0), (1.0, 9_000_000, 1.0)):
        clock.now += passed_s
        write(tmp_path, {"proc/pressure/cpu": PRESSURE.format(total_us)})
        assert profiler.sample({}).cpu_pressure == pytest.approx(share)
    clock.now += 0.001
    assert profiler.sample({}).cpu_pressure == pytest.approx(1.0), "too soon: the figure stands"
    (tmp_path / "proc/pressure/cpu").unlink()
    clock.now += 1.0
    assert profiler.sample({}).cpu_pressure is None


def used_s(process: psutil.Process) -> float:
    times = process.cpu_times()
    return float(times.user + times.system)


BUSY_TREE = """
import os, subprocess, sys, time
child = subprocess.Popen([sys.executable, "-c", "x = bytearray(64 << 20)\\nprint('up', flush=True)\\nwhile True: pass"])
while True: time.sleep(60)
"""


def test_real_busy_child_is_measured_like_psutil_does() -> None:
    profiler = DeviceProfiler()
    with subprocess.Popen([sys.executable, "-c", BUSY_TREE], stdout=subprocess.PIPE) as worker:
        assert worker.stdout is not None
        child = None
        try:
            worker.stdout.readline()
            child = psutil.Process(worker.pid).children()[0]
            workers = {"merge": (WorkerState.READY, worker.pid)}
            outer, began = used_s(child), time.monotonic()
            profiler.sample(workers)
            inner, began_within = used_s(child), time.monotonic()
            until(lambda: used_s(child) > inner + 0.3, "it works")
            within_s, inner = time.monotonic() - began_within, used_s(child) - inner
            sample = profiler.sample(workers)
            longest_s, outer = time.monotonic() - began, used_s(child) - outer
            load = sample.workers[0]
            rss_mb = (child.memory_info().rss + psutil.Process(worker.pid).memory_info().rss) / 2**20
            assert load.cpu_cores is not None
            assert inner / longest_s - 0.1 < load.cpu_cores < outer / within_s + 0.1
            assert load.memory_mb == pytest.approx(rss_mb, abs=2.0)
            assert sample.cpu_used_cores is not None
            assert sample.cpu_used_cores > inner / longest_s - 0.15
            assert sample.memory_mb == pytest.approx(psutil.virtual_memory().total / 2**20, rel=0.001)
        finally:
            if child is not None:
                child.kill()
            worker.kill()


def test_real_group_is_what_its_processes_measure() -> None:
    if (reason := LimitedGroup.why_not()) is not None:
        pytest.skip(reason)
    group = LimitedGroup.create(f"zsched-test-profile-{os.getpid()}", cpu_cores=0.3, memory_mb=256)
    try:
        waits = "import sys\nsys.stdin.readline()\n"  # its child must not be born before it is in the group
        with subprocess.Popen(
            [sys.executable, "-c", waits + BUSY_TREE], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        ) as worker:
            assert worker.stdin is not None
            assert worker.stdout is not None
            group.add(worker.pid)
            worker.stdin.write(b"go\n")
            worker.stdin.flush()
            try:
                worker.stdout.readline()
                profiler = DeviceProfiler(pid=str(worker.pid))
                profiler.sample({})
                child = psutil.Process(worker.pid).children()[0]
                before = used_s(child)
                until(lambda: used_s(child) > before + 0.1, "it works")
                sample = profiler.sample({})
                assert (sample.cpu_cores, sample.memory_mb) == (0.3, 256.0)
                assert sample.cpu_used_cores is not None
                assert 0 < sample.cpu_used_cores < 0.45
                assert sample.memory_used_mb is not None
                assert 60.0 < sample.memory_used_mb < 120.0
            finally:
                for pid in group.pids():
                    psutil.Process(pid).kill()
                worker.kill()
    finally:
        group.remove()
