"""Measures this machine, or the control group it stands for, and the load of each worker's process tree.

CPU in use is a difference, so the first sample has none, and the first one on other CPUs. Without a quota it is taken
from the CPUs this process may run on: everything but idle and iowait (a CPU that waits for a disk can run a task; one
that the hypervisor stole cannot). Under a quota the machine *is* the group that holds the smallest quota: its cores,
its own accounting; where it has none, the machine's share in use counts for those cores. Memory in use is
total - MemAvailable, or under a limit the group's working set, or what the machine has left if that is less.

A worker's load is its whole process tree. CPU: the difference of user and system time, children that were waited for
included, so short-lived ones count. How long its threads have run and waited to run (schedstat) tells what it wants
beyond that (`zsched.core.profile.appetite`). Memory: the sum of resident sets, which counts shared pages once per
process; the exact figure (PSS) would cost milliseconds per sample. How many threads want to run is what /proc/stat
counts at the moment of the sample.

Knows: /proc and /sys/fs/cgroup (proc(5)), below a root that tests can set. Does not know: smoothing, demand, tasks'
meaning. Nothing here raises: what cannot be read is ``None``.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path

from zsched.core.profile.appetite import Appetite, Thread
from zsched.core.values.model import TaskId
from zsched.core.values.profile import DeviceSample, WorkerLoad, WorkerState
from zsched.core.values.struct import Struct
from zsched.host.clock import awake_s, boot_s
from zsched.host.machine.cgroup import CgroupTree, CpuQuota, MemoryQuota
from zsched.host.procfs import PAGE_MB, TICKS_PER_S, ProcessTimes, names, parse_process_stat, parse_schedstat, read_file

LIMITS_EVERY_S = 5.0
"""How often quotas, limits and the set of CPUs are looked up again; they change by an operator's hand only."""
MIN_INTERVAL_S = 0.02
"""Two samples closer than this would divide one tick by nothing: the previous figure stands."""
RESTING_CORES = 0.05
RESTING_LOOK_S = 1.0
"""Threads and children of a worker that uses less are read this often: there may be dozens, with two files each."""
STILL_CORES = 0.015
STILL_LOOK_S = 3.0
"""The same of a worker that uses less than this (two of the kernel's ticks in a second), where nobody lacks a CPU."""
CALM_PRESSURE = 0.05
"""Where some process lacks a CPU for this share of the time, a worker may use little because it does not run..."""
CALM_USE = 0.5
"""...and, where the kernel does not tell that, where this share of the cores is in use."""


class CpuTimes(Struct, frozen=True, kw_only=True):
    """Busy and total seconds summed over some CPUs since boot."""

    busy_s: float
    total_s: float
    cpus: int


def parse_cpu_stat(content: bytes, allowed: frozenset[int] | None) -> CpuTimes | None:
    """Read /proc/stat for the CPUs in ``allowed`` (``None``: all); ``None`` when it lists none of them."""
    busy = total = cpus = 0
    for line in content.split(b"\n"):
        name, _, rest = line.partition(b" ")
        if not name.startswith(b"cpu"):
            break
        if name == b"cpu" or (allowed is not None and int(name[3:]) not in allowed):
            continue
        # user nice system idle iowait irq softirq steal; guest times are inside user and nice already
        times = [int(field) for field in rest.split()[:8]]
        idle = sum(times[3:5])
        busy, total, cpus = busy + sum(times) - idle, total + sum(times), cpus + 1
    if not cpus:
        return None
    return CpuTimes(busy_s=busy / TICKS_PER_S, total_s=total / TICKS_PER_S, cpus=cpus)


def parse_running(content: bytes) -> int | None:
    """Threads that run or wait to run on the whole machine, of /proc/stat; ``None`` when it does not tell."""
    _, found, rest = content.partition(b"\nprocs_running ")
    count = rest.partition(b"\n")[0].strip()
    return int(count) if found and count.isdigit() else None


def parse_meminfo(content: bytes, name: bytes) -> int | None:
    """One figure of /proc/meminfo in KiB; ``None`` without. Fifty others are not wanted, five times a second."""
    _, found, rest = (b"\n" + content).partition(b"\n" + name + b":")
    figure = rest.partition(b"\n")[0].removesuffix(b"kB").strip()
    return int(figure) if found and figure.isdigit() else None


def parse_pressure(content: bytes) -> float | None:
    """Seconds in which some process was stalled, of a PSI file (``some ... total=MICROSECONDS``); ``None`` without."""
    for line in content.split(b"\n"):
        kind, _, rest = line.partition(b" ")
        if kind == b"some":
            _, _, total = rest.partition(b"total=")
            return int(total) / 1e6 if total.isdigit() else None
    return None


def parse_cpu_list(text: str) -> frozenset[int]:
    """A kernel CPU list such as ``0-3,8`` as a set; malformed parts are left out."""
    cpus: set[int] = set()
    for part in text.strip().split(","):
        first, dash, last = part.partition("-")
        if first.isdecimal() and (last.isdecimal() or not dash):
            cpus.update(range(int(first), int(last or first) + 1))
    return frozenset(cpus)


class DeviceProfiler:
    """Takes raw samples of this machine. Used by one thread."""

    def __init__(self, root: Path = Path("/"), pid: str = "self") -> None:
        """Read everything below ``root`` ("/" but in tests), as process ``pid`` sees it."""
        self.speed: float | None = None
        """How fast a core is, when somebody has measured it."""
        self.problem: str | None = None
        """What the kernel does not tell."""
        self._root, self._pid = root, pid
        self._proc = str(root / "proc")
        self._trees = _ProcessTrees(self._proc)
        self._limits_at_s: float | None = None
        self._allowed: frozenset[int] | None = None
        self._has_all_cpus = False
        self._cpu_quota: CpuQuota | None = None
        self._memory_quota: MemoryQuota | None = None
        self._usage: tuple[float, float, int | None] | None = None
        """Seconds in use, seconds of the clock that goes with them, and of how many CPUs (``None``: of a group)."""
        self._stalled: tuple[float, float] | None = None
        self._pressure: float | None = None
        self._used_cores: float | None = None

    def sample(self, workers: Mapping[TaskId, tuple[WorkerState, int | None]]) -> DeviceSample:
        """Measure now; ``workers`` gives each task's state and process id (``None``: no process)."""
        now = awake_s()  # processes and the kernel's ticks stand still during a suspend, too
        if self._limits_at_s is None or now - self._limits_at_s >= LIMITS_EVERY_S:
            self._look_up_limits(now)
        stat = read_file(f"{self._proc}/stat")
        times = parse_cpu_stat(stat, self._allowed)
        memory_mb, memory_used_mb = self._memory()
        cores, used_cores, pressure = self._capacity(times), self._cpu_used(times, now), self._cpu_pressure(now)
        is_calm = (
            pressure < CALM_PRESSURE
            if pressure is not None
            else used_cores is not None and used_cores < CALM_USE * cores
        )
        return DeviceSample(
            cpu_cores=cores,
            cpu_used_cores=used_cores,
            memory_mb=memory_mb,
            memory_used_mb=memory_used_mb,
            workers=self._trees.loads(workers, now, is_calm=is_calm),
            speed=self.speed,
            cpu_pressure=pressure,
            runnable=self._runnable(stat),
        )

    def look_closely(self) -> None:
        """Work has come: the next sample looks at all threads and children of the workers."""
        self._trees.forget_rest()

    def _cpu_pressure(self, now: float) -> float | None:
        """Share of the last seconds in which some process of this machine, or of the group that it is, lacked a CPU.

        ``None`` on the first sample, and where the kernel has no pressure stall information.
        """
        path = f"{self._proc}/pressure/cpu" if self._cpu_quota is None else self._cpu_quota.pressure_file()
        stalled_s = None if path is None else parse_pressure(read_file(path))
        before, self._stalled = self._stalled, None if stalled_s is None else (now, stalled_s)
        if stalled_s is None or before is None:
            self._pressure = None
        elif now - before[0] < MIN_INTERVAL_S:
            self._stalled = before
        else:
            self._pressure = min(max(stalled_s - before[1], 0.0) / (now - before[0]), 1.0)
        return self._pressure

    def _runnable(self, stat: bytes) -> float | None:
        """Of the whole machine only: under a quota, or on some of its CPUs, nobody counts who else wants them."""
        running = parse_running(stat) if self._cpu_quota is None and self._has_all_cpus else None
        return None if running is None else max(running - 1.0, 0.0)  # one of them is this thread

    def _look_up_limits(self, now: float) -> None:
        self._limits_at_s = now
        tree = CgroupTree(self._root, self._pid)
        self._memory_quota = tree.memory_quota()
        quota, status = tree.cpu_quota(), read_file(f"{self._proc}/{self._pid}/status").decode(errors="replace")
        _, _, allowed = status.partition("Cpus_allowed_list:")
        before, self._allowed = self._allowed, parse_cpu_list(allowed.partition("\n")[0]) or None
        stat = read_file(f"{self._proc}/stat")
        times, every = parse_cpu_stat(stat, self._allowed), parse_cpu_stat(stat, None)
        self._has_all_cpus = times is not None and every is not None and times.cpus == every.cpus
        if quota is not None and times is not None and quota.cores >= times.cpus:
            quota = None  # wider than the machine: no limit
        if quota != self._cpu_quota:
            self._usage = self._stalled = None  # another account: its difference to the old one means nothing
        elif quota is None and self._allowed != before:
            self._usage = None  # so are the sums of other CPUs
        self._cpu_quota = quota

    def _capacity(self, times: CpuTimes | None) -> float:
        if self._cpu_quota is not None:
            return self._cpu_quota.cores
        return float(times.cpus if times is not None else os.cpu_count() or 1)

    def _cpu_used(self, times: CpuTimes | None, now: float) -> float | None:
        quota = self._cpu_quota
        used_s = None if quota is None else quota.used_s()
        is_silent = quota is not None and used_s is None
        self.problem = "the control group does not tell its CPU time: the machine's share counts" if is_silent else None
        if used_s is not None:
            clock_s, scale, cpus = now, 1.0, None
        elif times is not None:  # the kernel's own ticks are the clock: no jitter between two reads
            used_s, clock_s, scale, cpus = times.busy_s, times.total_s, self._capacity(times), times.cpus
        else:
            self._usage = self._used_cores = None
            return None
        new = (used_s, clock_s, cpus)
        # A CPU that leaves or comes takes all its ticks since boot along.
        if self._usage is None or self._usage[2] != cpus or clock_s < self._usage[1]:
            self._usage, self._used_cores = new, None
            return None
        elapsed_s = clock_s - self._usage[1]
        if elapsed_s >= MIN_INTERVAL_S:
            self._used_cores = max(0.0, scale * (used_s - self._usage[0]) / elapsed_s)
            self._usage = new
        return self._used_cores

    def _memory(self) -> tuple[float, float | None]:
        meminfo = read_file(f"{self._proc}/meminfo")
        total_mb = (parse_meminfo(meminfo, b"MemTotal") or 0) / 1024.0 or os.sysconf("SC_PHYS_PAGES") * PAGE_MB
        available_kb = parse_meminfo(meminfo, b"MemAvailable")
        available_mb = None if available_kb is None else available_kb / 1024.0
        quota = self._memory_quota
        if quota is None or quota.limit_mb >= total_mb:
            return total_mb, None if available_mb is None else max(0.0, total_mb - available_mb)
        used_mb = quota.used_mb()
        if used_mb is None or available_mb is None:
            return quota.limit_mb, used_mb
        return quota.limit_mb, max(used_mb, quota.limit_mb - available_mb)


class _ProcessTrees:
    """The load of some process trees, by differences between samples."""

    def __init__(self, proc: str) -> None:
        self._proc = proc
        self._has_children_files = os.path.exists(f"{proc}/self/task/{os.getpid()}/children")  # noqa: PTH110 - str paths
        self._seen: dict[TaskId, tuple[float, dict[int, ProcessTimes]]] = {}
        self._appetites: dict[TaskId, Appetite] = {}
        self._rests_until: dict[TaskId, float] = {}
        """Until when the threads and children of a worker that is at rest are not looked at..."""
        self._looked_at: dict[TaskId, float] = {}
        """...since they last were."""

    def forget_rest(self) -> None:
        """No worker counts as one at rest until the next look."""
        self._rests_until.clear()

    def loads(
        self, workers: Mapping[TaskId, tuple[WorkerState, int | None]], now: float, *, is_calm: bool
    ) -> tuple[WorkerLoad, ...]:
        """One load per worker, sorted by task; ``is_calm``: nobody lacks a CPU on this machine."""
        children = None if self._has_children_files else self._scan_children()
        seen = {task: (now, self._tree(task, pid, children, now)) for task, (_, pid) in workers.items() if pid}
        loads = tuple(self._load(task, workers[task][0], seen.get(task), is_calm) for task in sorted(workers))
        self._seen = seen
        self._appetites = {task: self._appetites[task] for task in seen if task in self._appetites}
        return loads

    def _load(
        self, task: TaskId, state: WorkerState, seen: tuple[float, dict[int, ProcessTimes]] | None, is_calm: bool
    ) -> WorkerLoad:
        if seen is None or not seen[1]:
            return WorkerLoad(task=task, state=state)
        now, tree = seen
        before = self._seen.get(task)
        cpu_cores = None if before is None else _cores(before[1], tree, now - before[0], boot_s())
        appetite = self._appetites.setdefault(task, Appetite())
        is_looked_at = not self._is_at_rest(task, now)
        if is_looked_at:
            appetite.look(self._threads(tree), now)
            self._looked_at[task] = now
        if cpu_cores is None or cpu_cores >= RESTING_CORES or appetite.wanted_cores() is not None:
            self._rests_until[task] = now
        else:
            rest_s = STILL_LOOK_S if is_calm and cpu_cores < STILL_CORES else RESTING_LOOK_S
            self._rests_until[task] = self._looked_at[task] + rest_s - MIN_INTERVAL_S
        return WorkerLoad(
            task=task,
            state=state,
            cpu_cores=cpu_cores,
            memory_mb=sum(times.rss_mb for times in tree.values()),
            wanted_cores=appetite.wanted_cores(),
            runnable=appetite.runnable if is_looked_at else cpu_cores,  # at rest it hardly runs, and waits for nothing
        )

    def _is_at_rest(self, task: TaskId, now: float) -> bool:
        """Whether its threads and children need no look now: it hardly runs, and lacked nothing at the last look."""
        return now < self._rests_until.get(task, now)

    def _threads(self, tree: Iterable[int]) -> dict[Thread, tuple[float, float]]:
        """Seconds that each has run, and has waited to run."""
        found = {}
        for pid in tree:
            folder = f"{self._proc}/{pid}/task"
            for thread in names(folder):
                times = parse_schedstat(read_file(f"{folder}/{thread}/schedstat"))
                if times is not None:
                    found[pid, thread] = times
        return found

    def _tree(
        self, task: TaskId, pid: int, children: dict[int, list[int]] | None, now: float
    ) -> dict[int, ProcessTimes]:
        known = self._seen[task][1] if task in self._seen and self._is_at_rest(task, now) else {}
        is_known = pid in known
        tree: dict[int, ProcessTimes] = {}
        waiting = [*known] if is_known else [pid]
        while waiting:
            process = waiting.pop()
            times = parse_process_stat(read_file(f"{self._proc}/{process}/stat"))
            if times is None or process in tree:
                continue
            tree[process] = times
            if not is_known:
                waiting += self._children(process) if children is None else children.get(process, [])
        return tree

    def _children(self, pid: int) -> list[int]:
        folder = f"{self._proc}/{pid}/task"
        return [int(child) for thread in names(folder) for child in read_file(f"{folder}/{thread}/children").split()]

    def _scan_children(self) -> dict[int, list[int]]:
        """``{parent: [child]}`` of the whole machine, for kernels without CONFIG_PROC_CHILDREN."""
        children: dict[int, list[int]] = {}
        for name in names(self._proc):
            if name.isdecimal() and (times := parse_process_stat(read_file(f"{self._proc}/{name}/stat"))) is not None:
                children.setdefault(times.parent, []).append(int(name))
        return children


def _cores(
    before: Mapping[int, ProcessTimes], after: Mapping[int, ProcessTimes], elapsed_s: float, since_boot_s: float
) -> float | None:
    """Cores a tree used in ``elapsed_s``, from its processes then and now; ``None``: not to be told.

    The sum over the tree keeps the time of a child that was waited for (it moves to its parent). A process that is new
    to us but older than the interval (adopted, or its parent was missed) brings in only its share.
    """
    if elapsed_s < MIN_INTERVAL_S:
        return None
    kept = {pid for pid, times in after.items() if pid in before and before[pid].start_s == times.start_s}
    if not kept:
        return None
    total_s = sum(times.own_s + times.waited_s for pid, times in after.items() if pid in kept)
    total_s += sum(_share(times, elapsed_s, since_boot_s) for pid, times in after.items() if pid not in kept)
    total_s -= sum(times.own_s + times.waited_s for times in before.values())
    survivors_s = sum(after[pid].own_s - before[pid].own_s for pid in kept)
    return max(total_s, survivors_s, 0.0) / elapsed_s


def _share(times: ProcessTimes, elapsed_s: float, since_boot_s: float) -> float:
    """What a newly seen process probably used in the last ``elapsed_s``: all if it is younger, else in proportion."""
    age_s = max(since_boot_s - times.start_s, elapsed_s)
    return (times.own_s + times.waited_s) * elapsed_s / age_s
