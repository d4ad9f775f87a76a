"""Makes control groups with a quota, for nodes of the lab, where the user may (v1, v2 or both).

Knows: the files of both versions (kernel: admin-guide/cgroup-v1, admin-guide/cgroup-v2). Does not know: which group
limits a process (`zsched.host.machine.cgroup`), nodes.
"""

from __future__ import annotations

import contextlib
import os
import time
from pathlib import Path

from zsched.core.values.errors import AdapterError
from zsched.host.machine.cgroup import MIB, CgroupTree, text_of

PERIOD_US = 20_000
"""Period of the quotas we set: a throttled process stands still for less than 20 ms instead of the usual 100."""
MIN_QUOTA_US = 1000
"""The kernel refuses less."""
REMOVE_WITHIN_S = 1.0
"""A group is busy until its killed processes are reaped, and for a moment after."""


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
        return tuple(
            sorted({int(word) for folder in self.folders for word in text_of(folder / "cgroup.procs").split()})
        )

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
        is_offered = needed <= set(text_of(folder / "cgroup.controllers").split())
        has_no_processes = is_root or not text_of(folder / "cgroup.procs").split()
        if is_offered and has_no_processes and os.access(folder, os.W_OK):
            _delegate(folder, controller)
            return folder
    raise AdapterError(
        f"no control group above this process may have children with {' and '.join(sorted(needed))}; "
        "run as root on the host, or with `systemd-run --user --scope -p Delegate=yes`"
    )


def _delegate(folder: Path, controller: str) -> None:
    """Hand ``controller`` down to the children of a v2 group."""
    if controller in text_of(folder / "cgroup.subtree_control").split():
        return
    try:
        (folder / "cgroup.subtree_control").write_text(f"+{controller}", encoding="ascii")
    except OSError as error:
        raise AdapterError(f"cannot hand {controller!r} down in {folder}: {error}; run as root") from error
