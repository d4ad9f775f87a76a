"""Finds the control groups that limit a process (v1, v2 or both).

The limit that counts is the smallest of all ancestors, for CPU and for memory each. Its group's own accounting is then
"what is in use": for a node inside a group the machine is that group.

Knows: /proc/*/cgroup, mountinfo, the files of both versions (kernel: admin-guide/cgroup-v1, admin-guide/cgroup-v2).
Does not know: samples, rates, tasks, nodes.
"""

from __future__ import annotations

import re
from pathlib import Path

from zsched.core.values.struct import Struct

MIB = 1024.0 * 1024.0
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
        used_us = parse_flat(text_of(self.folder / "cpu.stat")).get("usage_usec")
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
        inactive = parse_flat(text_of(self.folder / "memory.stat")).get(
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
        self._mounts = parse_mounts(text_of(proc / "mountinfo"))
        self._paths = parse_membership(text_of(proc / "cgroup"))

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


def _quota(folder: Path, *, is_v2: bool) -> float | None:
    """The CPU quota of one group in cores; ``None`` when it has none."""
    if is_v2:
        quota, _, period = text_of(folder / "cpu.max").partition(" ")
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


def text_of(path: Path) -> str:
    """A small kernel file's text; empty when it cannot be read."""
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""


def _number(path: Path) -> int | None:
    """A kernel file that holds one number; ``None`` for anything else, "max" and negative numbers included."""
    text = text_of(path).strip()
    return int(text) if text.isdecimal() else None
