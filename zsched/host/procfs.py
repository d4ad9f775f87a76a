"""Reads what the kernel says of processes and threads (proc(5)); what cannot be read, or is malformed, is ``None``.

Knows: the formats of /proc/PID/stat and schedstat. Does not know: which processes are ours.
"""

from __future__ import annotations

import os

from zsched.core.values.struct import Struct

TICKS_PER_S = float(os.sysconf("SC_CLK_TCK"))
PAGE_MB = os.sysconf("SC_PAGE_SIZE") / 1048576.0
READ_BYTES = 65536


class ProcessTimes(Struct, frozen=True, kw_only=True):
    """One line of /proc/PID/stat, as far as anybody here needs it (times in seconds, memory in MiB)."""

    state: str
    """One letter: ``R`` runs or wants to, ``D`` waits for a disk, ``S`` sleeps..."""
    parent: int
    own_s: float
    waited_s: float
    """User and system time of children that ended and were waited for."""
    threads: int
    start_s: float
    """After boot: with the id, the process's identity."""
    rss_mb: float


def parse_process_stat(content: bytes) -> ProcessTimes | None:
    """Read /proc/PID/stat; the name in it may hold blanks and brackets. ``None`` when it is malformed."""
    fields = content[content.rfind(b")") + 2 :].split()
    try:
        user, system, waited_user, waited_system = (int(field) for field in fields[11:15])
        return ProcessTimes(
            state=fields[0].decode(errors="replace"),
            parent=int(fields[1]),
            own_s=(user + system) / TICKS_PER_S,
            waited_s=(waited_user + waited_system) / TICKS_PER_S,
            threads=int(fields[17]),
            start_s=int(fields[19]) / TICKS_PER_S,
            rss_mb=max(0, int(fields[21])) * PAGE_MB,
        )
    except (ValueError, IndexError):
        return None


def parse_schedstat(content: bytes) -> tuple[float, float] | None:
    """Seconds a thread has run, and has waited to run, of /proc/PID/task/TID/schedstat; ``None`` when malformed.

    A wait counts when it ends, also one while the thread's cgroup is throttled (Documentation/scheduler/sched-stats).
    """
    try:
        run_ns, wait_ns = (int(field) for field in content.split()[:2])
    except ValueError:
        return None
    return run_ns / 1e9, wait_ns / 1e9


def names(folder: str) -> list[str]:
    """The names in a folder; empty when it cannot be read."""
    try:
        return os.listdir(folder)  # noqa: PTH208 - names are all we need, 5 times a second
    except OSError:
        return []


def read_file(path: str) -> bytes:
    """A small kernel file, with three system calls; empty when it cannot be read."""
    try:
        fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        return b""
    try:
        return os.read(fd, READ_BYTES)
    except OSError:
        return b""
    finally:
        os.close(fd)
