"""Says whether zenoh may use shared memory between this machine's processes, or why not.

Knows: /dev/shm, control groups' quotas, network namespaces. Does not know: zenoh, which streams there are.

zenoh maps a pool of 16 MiB per process, and a receiver that gets no processor for some tenths of a second loses what it
was sent by this way without a trace, so it stays off under a CPU quota.
"""

from __future__ import annotations

import contextlib
import os
import secrets
from pathlib import Path
from typing import Final

from zsched.host.machine.cgroup import CgroupTree

FOLDER: Final = Path("/dev/shm")  # noqa: S108 - the kernel's place for it, not a temporary file
POOL_BYTES: Final = 16 << 20
"""zenoh's ``transport_optimization/pool_size``."""
SPARE: Final = 2
"""Pools beside those of our own processes: applications have theirs."""


def why_not(processes: int, folder: Path = FOLDER, tree: CgroupTree | None = None, proc: Path = Path("/proc")) -> str:
    """Why ``processes`` of ours should not use shared memory here; ``""`` when they may."""
    quota = (tree or CgroupTree()).cpu_quota()
    if quota is not None:
        return "a CPU quota holds here: a receiver that is not scheduled in time would lose messages silently"
    if _is_other_network(proc):
        return f"this is a network namespace of its own, and {folder} is not"
    try:
        probe = folder / f"zsched-{secrets.token_hex(8)}"
        descriptor = os.open(probe, os.O_CREAT | os.O_EXCL | os.O_RDWR, 0o600)
    except OSError as error:
        return f"{folder} cannot be written to: {error.strerror}"
    os.close(descriptor)
    probe.unlink(missing_ok=True)
    facts = os.statvfs(folder)
    free, needed = facts.f_bavail * facts.f_frsize, (processes + SPARE) * POOL_BYTES
    if free < needed:
        return f"{folder} has {free >> 20} MiB left, {needed >> 20} are needed"
    return ""


def _is_other_network(proc: Path) -> bool:
    """Whether our network is not that of the machine's (or container's) first process, as far as we may look."""
    with contextlib.suppress(OSError):
        return (proc / "self/ns/net").readlink() != (proc / "1/ns/net").readlink()
    return False
