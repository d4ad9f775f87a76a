"""Finds the control groups that limit a process (v1, v2 or both), and makes a group with a quota where the user may.

The limit that counts is the smallest of all ancestors, for CPU and for memory each. Its group's own accounting is then
"what is in use": for a node inside a group the machine is that group.

Knows: /proc/*/cgroup, mountinfo, the files of both versions (kernel: admin-guide/cgroup-v1, admin-guide/cgroup-v2).
Does not know: samples, rates, tasks, nodes.
"""

from __future__ import annotations

import contextlib
import os
import re
import time
from pathlib import Path

from zsched.core.values.struct import Struct
from zsched.errors import AdapterError

MIB = 1024.0 * 1024.0
PERIOD_US = 20_000
"""Period of the quotas we set: a throttled process stands still for less than 20 ms instead of the usual 100."""
MIN_QUOTA_US = 1000
"""The kernel refuses less."""
REMOVE_WITHIN_S = 1.0
"""A group is busy until its killed processes are reaped, and for a moment after."""
_UNLIMITED_V1 = 2**62


class CgroupMount(Struct, frozen=True, kw_only=True):
    """One cgroup file system: its controllers (v1 only; v2 lists them per group) and the group at its mount point."""

    point: Path
    root: str
    controllers: frozenset[str]
    is_v2: bool


class CpuQuota(Struct, frozen=True, kw_only=True):
    """The smallest CPU quota over a process, in cores, and its group; `used_s` reads what the group has used."""

    cores: float
    folder: Path
    usage_folder: Path | None
    is_v2: bool

    def used_s(self) -> float | None:
        """CPU seconds used by the group since it was made; ``None`` when it does not tell."""
        if self.usage_folder is None:
            return None
        if not self.is_v2:
            used_ns = _number(self.usage_folder / "cpuacct.usage")
            return None if used_ns is None else used_ns / 1e9
        used_us = parse_flat(_text(self.folder / "cpu.stat")).get("usage_usec")
        return None if used_us is None else used_us / 1e6

    def pressure_file(self) -> str | None:
        """Where the kernel tells how long the group's processes lacked a CPU (version 2 only)."""
        return str(self.folder / "cpu.pressure") if self.is_v2 else None


class MemoryQuota(Struct, frozen=True, kw_only=True):
    """The smallest memory limit over a process, in MiB, and its group."""

    limit_mb: float
    folder: Path
    is_v2: bool

    def used_mb(self) -> float | None:
        """The working set in MiB: all pages charged to the group except the file cache that can be dropped at once."""
        usage = _number(self.folder / ("memory.current" if self.is_v2 else "memory.usage_in_bytes"))
        if usage is None:
            return None
        inactive = parse_flat(_text(self.folder / "memory.stat")).get(
            "inactive_file" if self.is_v2 else "total_inactive_file", 0
        )
        return max(0.0, (usage - inactive) / MIB)


def parse_mounts(mountinfo: str) -> tuple[CgroupMount, ...]:
    """The cgroup mounts of a /proc/PID/mountinfo; lines that are none, or malformed, are left out (proc(5))."""
    mounts = []
    for line in mountinfo.splitlines():
        before, separator, after = line.partition(" - ")
        fields, kind = before.split(" "), after.split(" ")
        if not separator or len(fields) < 5 or len(kind) < 3 or kind[0] not in {"cgroup", "cgroup2"}:
            continue
        point, is_v2 = Path(_unescape(fields[4])), kind[0] == "cgroup2"
        controllers = frozenset() if is_v2 else frozenset(kind[2].split(","))
        mounts.append(CgroupMount(point=point, root=_unescape(fields[3]), controllers=controllers, is_v2=is_v2))
    return tuple(mounts)


def parse_membership(text: str) -> dict[str, str]:
    """``{controller: path}`` of a /proc/PID/cgroup; the v2 hierarchy stands under the empty name."""
    paths = {}
    for line in text.splitlines():
        number, _, rest = line.partition(":")
        controllers, separator, path = rest.partition(":")
        if separator and (controllers or number == "0"):
            paths.update(dict.fromkeys(controllers.split(","), path))
    return paths


def parse_flat(text: str) -> dict[str, int]:
    """A flat-keyed file such as cpu.stat or memory.stat as numbers; other lines are left out."""
    pairs = (line.split() for line in text.splitlines())
    return {pair[0]: int(pair[1]) for pair in pairs if len(pair) == 2 and pair[1].isdecimal()}


class CgroupTree:
    """The groups of one process, read below ``root`` ("/" but in tests)."""

    def __init__(self, root: Path = Path("/"), pid: str = "self") -> None:
        self._root = root
        proc = root / "proc" / pid
        self._mounts = parse_mounts(_text(proc / "mountinfo"))
        self._paths = parse_membership(_text(proc / "cgroup"))

    def folders(self, controller: str) -> tuple[Path, ...]:
        """The process's groups that ``controller`` may limit, innermost first up to the mount point; empty: none."""
        mount = self.mount(controller)
        path = self._paths.get("" if mount is not None and mount.is_v2 else controller)
        if mount is None or path is None:
            return ()
        top = self._root / mount.point.relative_to("/")
        parts = _below(path, mount.root)
        return tuple(top.joinpath(*parts[:depth]) for depth in range(len(parts), -1, -1))

    def mount(self, controller: str) -> CgroupMount | None:
        """Where ``controller`` lives: its v1 hierarchy if there is one, else v2."""
        v1 = (mount for mount in self._mounts if controller in mount.controllers)
        v2 = (mount for mount in self._mounts if mount.is_v2)
        return next(v1, None) or next(v2, None)

    def is_v2(self, controller: str) -> bool:
        """Whether ``controller`` is found in the v2 hierarchy."""
        mount = self.mount(controller)
        return mount is not None and mount.is_v2

    def cpu_quota(self) -> CpuQuota | None:
        """The smallest CPU quota over the process; ``None``: no limit."""
        is_v2 = self.is_v2("cpu")
        limits = [(cores, folder) for folder in self.folders("cpu") if (cores := _quota(folder, is_v2=is_v2))]
        if not limits:
            return None
        cores, folder = min(limits, key=lambda limit: limit[0])
        usage = folder if is_v2 else self._accounting_of(folder)
        return CpuQuota(cores=cores, folder=folder, usage_folder=usage, is_v2=is_v2)

    def memory_quota(self) -> MemoryQuota | None:
        """The smallest memory limit over the process; ``None``: no limit."""
        is_v2 = self.is_v2("memory")
        names = ("memory.max", "memory.high") if is_v2 else ("memory.limit_in_bytes",)
        limits = [
            (limit, folder)
            for folder in self.folders("memory")
            for name in names
            if (limit := _number(folder / name)) is not None and limit < _UNLIMITED_V1
        ]
        if not limits:
            return None
        limit, folder = min(limits, key=lambda pair: pair[0])
        return MemoryQuota(limit_mb=limit / MIB, folder=folder, is_v2=is_v2)

    def _accounting_of(self, folder: Path) -> Path | None:
        """The group of v1's separate accounting hierarchy that matches ``folder`` of the cpu hierarchy."""
        chain, cpu = self.folders("cpuacct"), self.folders("cpu")
        if chain and folder == cpu[-1]:
            return chain[-1]
        return next((other for other in chain[:-1] if other.name == folder.name), None)


class LimitedGroup:
    """A control group with a CPU quota and a memory limit, made for a node of the lab."""

    def __init__(self, folders: tuple[Path, ...]) -> None:
        """Wrap existing groups; use `create`."""
        self.folders = folders

    @classmethod
    def create(
        cls,
        name: str,
        *,
        cpu_cores: float | None = None,
        memory_mb: float | None = None,
        tree: CgroupTree | None = None,
    ) -> LimitedGroup:
        """Make a group inside this process's own (v2: inside the nearest ancestor that may have children).

        ``tree`` is this process's but in tests.

        Raises:
            AdapterError: the user may not, or the machine has no such controller; nothing is left behind.
        """
        tree = tree or CgroupTree()
        values = _settings(tree, cpu_cores, memory_mb)
        parents = {controller: _parent(tree, controller, tuple(values)) for controller in values}
        group = cls(tuple(dict.fromkeys(parent / name for parent in parents.values())))
        made: list[Path] = []
        try:
            for folder in group.folders:
                folder.mkdir()
                made.append(folder)
            for controller, settings in values.items():
                for file, value in settings:
                    (parents[controller] / name / file).write_text(value, encoding="ascii")
        except OSError as error:
            for folder in made:
                with contextlib.suppress(OSError):
                    folder.rmdir()
            raise AdapterError(
                f"cannot make the control group {name!r}: {error}; run as root, or inside a delegated group"
            ) from error
        return group

    def inner(self, name: str, *, cpu_cores: float | None = None) -> LimitedGroup:
        """Make a group inside this one, which holds no process of its own (version 2 asks for that).

        Raises:
            AdapterError: the user may not; nothing is left behind.
        """
        made: list[Path] = []
        try:
            for parent in self.folders:
                if (parent / "cgroup.subtree_control").exists() and cpu_cores is not None:
                    _delegate(parent, "cpu")
                (parent / name).mkdir()
                made.append(parent / name)
                for file, value in [] if cpu_cores is None else _cpu_settings(parent / name, cpu_cores):
                    (parent / name / file).write_text(value, encoding="ascii")
        except (OSError, AdapterError) as error:
            for folder in made:
                with contextlib.suppress(OSError):
                    folder.rmdir()
            raise AdapterError(f"cannot make the control group {name!r} in {self.folders[0]}: {error}") from error
        return LimitedGroup(tuple(made))

    def give_way(self) -> None:
        """Let processes of other groups run at once where they want to, instead of in their turn (Linux >= 5.15).

        The group is of the class of idle ones (sched(7), SCHED_IDLE; its own quota holds all the same). On an older
        kernel nothing is done: then it has its turns by its weight.
        """
        for folder in self.folders:
            with contextlib.suppress(OSError):
                if (folder / "cpu.idle").exists():
                    (folder / "cpu.idle").write_text("1", encoding="ascii")

    @classmethod
    def why_not(cls, *, cpu: bool = True, memory: bool = True) -> str | None:
        """Why this user cannot limit processes here; ``None`` when they can (found out by making a group)."""
        name = f"zsched-probe-{os.getpid()}"
        try:
            cls.create(name, cpu_cores=1.0 if cpu else None, memory_mb=64.0 if memory else None).remove()
        except AdapterError as error:
            return str(error)
        return None

    def add(self, pid: int) -> None:
        """Move the process ``pid`` with all its threads into the group; its later children are born there.

        Raises:
            AdapterError: there is no such process, or the user may not move it.
        """
        try:
            for folder in self.folders:
                (folder / "cgroup.procs").write_text(str(pid), encoding="ascii")
        except OSError as error:
            raise AdapterError(f"cannot move process {pid} into {self.folders[0]}: {error}") from error

    def pids(self) -> tuple[int, ...]:
        """The processes in the group."""
        return tuple(sorted({int(word) for folder in self.folders for word in _text(folder / "cgroup.procs").split()}))

    def remove(self) -> None:
        """Remove the group; kills nothing.

        Raises:
            AdapterError: processes are still inside (they are named).
        """
        end_s = time.monotonic() + REMOVE_WITHIN_S
        for folder in self.folders:
            while folder.exists():
                try:
                    folder.rmdir()
                except OSError as error:
                    if time.monotonic() >= end_s:
                        raise AdapterError(f"cannot remove {folder}: {error}; inside: {self.pids()}") from error
                    time.sleep(0.005)


def _settings(
    tree: CgroupTree, cpu_cores: float | None, memory_mb: float | None
) -> dict[str, tuple[tuple[str, str], ...]]:
    """``{controller: ((file, value), ...)}`` that the wanted limits need."""
    values: dict[str, tuple[tuple[str, str], ...]] = {}
    if cpu_cores is not None:
        values["cpu"] = _quota_files(cpu_cores, is_v2=tree.is_v2("cpu"))
        if not tree.is_v2("cpu"):
            values["cpuacct"] = ()
    if memory_mb is not None:
        file = "memory.max" if tree.is_v2("memory") else "memory.limit_in_bytes"
        values["memory"] = ((file, str(int(memory_mb * MIB))),)
    return values


def _quota_files(cpu_cores: float, *, is_v2: bool) -> tuple[tuple[str, str], ...]:
    """((file, value), ...) of a quota, in the order in which they are written."""
    quota_us = max(MIN_QUOTA_US, round(cpu_cores * PERIOD_US))
    if is_v2:
        return (("cpu.max", f"{quota_us} {PERIOD_US}"),)
    return (("cpu.cfs_period_us", str(PERIOD_US)), ("cpu.cfs_quota_us", str(quota_us)))


def _cpu_settings(folder: Path, cpu_cores: float) -> tuple[tuple[str, str], ...]:
    """The same for a group that is there; none for one of another controller."""
    if (folder / "cpu.max").exists():
        return _quota_files(cpu_cores, is_v2=True)
    return _quota_files(cpu_cores, is_v2=False) if (folder / "cpu.cfs_quota_us").exists() else ()


def _parent(tree: CgroupTree, controller: str, wanted: tuple[str, ...]) -> Path:
    """The group in which a child with ``controller`` can be made (v2: with all the v2 ones of ``wanted``).

    Raises:
        AdapterError: there is none.
    """
    folders = tree.folders(controller)
    if not folders:
        raise AdapterError(f"no {controller} control groups are mounted on this machine")
    if not tree.is_v2(controller):
        return folders[0]
    needed = {name for name in wanted if tree.is_v2(name)}
    for folder in folders:
        is_root = not (folder / "cgroup.type").exists()
        is_offered = needed <= set(_text(folder / "cgroup.controllers").split())
        has_no_processes = is_root or not _text(folder / "cgroup.procs").split()
        if is_offered and has_no_processes and os.access(folder, os.W_OK):
            _delegate(folder, controller)
            return folder
    raise AdapterError(
        f"no control group above this process may have children with {' and '.join(sorted(needed))}; "
        "run as root on the host, or with `systemd-run --user --scope -p Delegate=yes`"
    )


def _delegate(folder: Path, controller: str) -> None:
    """Hand ``controller`` down to the children of a v2 group."""
    if controller in _text(folder / "cgroup.subtree_control").split():
        return
    try:
        (folder / "cgroup.subtree_control").write_text(f"+{controller}", encoding="ascii")
    except OSError as error:
        raise AdapterError(f"cannot hand {controller!r} down in {folder}: {error}; run as root") from error


def _quota(folder: Path, *, is_v2: bool) -> float | None:
    """The CPU quota of one group in cores; ``None`` when it has none."""
    if is_v2:
        quota, _, period = _text(folder / "cpu.max").partition(" ")
        return int(quota) / int(period) if quota.isdecimal() and period.strip().isdecimal() and int(period) else None
    quota_us, period_us = _number(folder / "cpu.cfs_quota_us"), _number(folder / "cpu.cfs_period_us")
    return quota_us / period_us if quota_us and period_us else None


def _below(path: str, root: str) -> tuple[str, ...]:
    """The parts of a group's ``path`` under the group ``root`` that is mounted (both as the kernel shows them).

    Inside a cgroup namespace the mount's root is "/" and a process outside it shows as "/.."; bind mounts of one group
    (containers without a namespace) show that group as the mount's root.
    """
    parts, top = Path(path).parts[1:], Path(root).parts[1:]
    if ".." in parts or parts[: len(top)] != top:
        return ()
    return parts[len(top) :]


def _unescape(field: str) -> str:
    """A mountinfo field with its octal escapes (blank, tab, newline, backslash) undone."""
    return re.sub(r"\\([0-7]{3})", lambda match: chr(int(match[1], 8)), field)


def _text(path: Path) -> str:
    """A small kernel file's text; empty when it cannot be read."""
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""


def _number(path: Path) -> int | None:
    """A kernel file that holds one number; ``None`` for anything else, "max" and negative numbers included."""
    text = _text(path).strip()
    return int(text) if text.isdecimal() else None
