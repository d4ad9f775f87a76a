"""Outlives the lab by a moment and leaves nothing of it behind: processes, control groups, sockets, shared memory.

Knows: the run's token (an environment variable that every process of the run inherits), what to remove. Does not know:
why the lab ended: the end of its standard input is the sign, whether by exit, by Ctrl-C or by SIGKILL.

Started as ``python -m zsched_lab.fleet.janitor TOKEN`` in a session of its own, it reads one JSON object per line:
``{"remove": PATH}`` (a folder of ours). At the end of the input it waits `GRACE_S` for the run's processes to go by
themselves, kills the rest, removes the folders, every control group with the token in its name and those within, and
zenoh's orphaned shared memory, and prints one JSON object: ``{"killed": [pid], "left": [path or pid]}``.
Standard library only.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import sys
import time
from pathlib import Path
from typing import TextIO

TOKEN_VARIABLE = "ZSCHED_LAB_RUN"
GRACE_S = 0.5
"""For processes that are on their way out: an orderly stop waits itself, after a SIGKILL the death signal has been."""
KILL_S = 3.0
POLL_S = 0.05
CONTROL_GROUPS = Path("/sys/fs/cgroup")
SHARED_MEMORY = Path("/dev/shm")  # noqa: S108 - the very folder to clean


def tagged_processes(token: str) -> list[int]:
    """Pids of living processes that were started with ``token`` in their environment (ours to end, and only ours)."""
    mark = f"{TOKEN_VARIABLE}={token}".encode()
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit() or int(entry.name) == os.getpid():
            continue
        with contextlib.suppress(OSError):  # gone meanwhile, or another user's
            if mark in (entry / "environ").read_bytes().split(b"\0"):
                found.append(int(entry.name))
    return found


def wait_gone(token: str, deadline_s: float) -> list[int]:
    """Wait up to ``deadline_s`` for the run's processes to end; returns those that have not."""
    end = time.monotonic() + deadline_s
    while (left := tagged_processes(token)) and time.monotonic() < end:
        time.sleep(POLL_S)
    return left


def end_processes(token: str) -> tuple[list[int], list[int]]:
    """Wait, then SIGKILL what stayed; returns (killed, still there)."""
    stayed = wait_gone(token, GRACE_S)
    for pid in stayed:
        with contextlib.suppress(OSError):
            os.kill(pid, signal.SIGKILL)
    # A child forked between the look and the kill has the token too: look until there is none.
    end = time.monotonic() + KILL_S
    while (left := tagged_processes(token)) and time.monotonic() < end:
        for pid in left:
            with contextlib.suppress(OSError):
                os.kill(pid, signal.SIGKILL)
        time.sleep(POLL_S)
    return stayed, tagged_processes(token)


def groups_of(token: str) -> list[Path]:
    """The run's control groups in every hierarchy: those with the token in their name and all within, deepest first."""
    found = (Path(folder, name) for folder, names, _ in os.walk(CONTROL_GROUPS) for name in names)
    return sorted((path for path in found if any(token in part for part in path.parts)), reverse=True)


def remove_group(path: Path) -> bool:
    """Remove an empty control group (a kernel folder: rmdir); true when it is gone."""
    end = time.monotonic() + 1.0
    while path.is_dir():
        with contextlib.suppress(OSError):
            path.rmdir()
            break
        if time.monotonic() > end:
            break
        time.sleep(POLL_S)  # a killed process leaves its group a moment after it ends
    return not path.is_dir()


def mapped_files() -> set[str]:
    """Paths under /dev/shm that any process visible to us has mapped."""
    mapped: set[str] = set()
    for maps in Path("/proc").glob("[0-9]*/maps"):
        with contextlib.suppress(OSError):
            text = maps.read_text(errors="replace")
            mapped.update(line.split(None, 5)[5] for line in text.splitlines() if str(SHARED_MEMORY) in line)
    return mapped


def orphaned_segments(since: float) -> list[Path]:
    """Shared-memory files of zenoh, of this user, made since ``since`` (wall time), that no process has mapped."""
    segments = []
    for path in SHARED_MEMORY.glob("*.zenoh"):
        with contextlib.suppress(OSError):
            facts = path.stat()
            if facts.st_uid == os.getuid() and facts.st_mtime >= since:
                segments.append(path)
    if not segments:
        return []
    mapped = mapped_files()
    return [path for path in segments if str(path) not in mapped]


def clean(token: str, folders: list[Path], since: float) -> dict[str, list[int] | list[str]]:
    """End the run's processes and remove what it made; returns what was killed and what could not be removed."""
    killed, alive = end_processes(token)
    left = [str(path) for path in groups_of(token) if not remove_group(path)]
    for folder in folders:
        shutil.rmtree(folder, ignore_errors=True)
        if folder.exists():
            left.append(str(folder))
    for segment in orphaned_segments(since):
        with contextlib.suppress(OSError):
            segment.unlink()
    return {"killed": killed, "left": [*left, *map(str, alive)]}


def read_orders(stream: TextIO) -> list[Path]:
    """Read the folders to remove until the lab's end closes the pipe."""
    folders: list[Path] = []
    for line in stream:
        with contextlib.suppress(ValueError, KeyError):  # cut off in the middle by a SIGKILL
            folders.append(Path(json.loads(line)["remove"]))
    return folders


def main() -> int:
    """Entry point: ``TOKEN`` is the only argument; 0 when nothing is left, 1 otherwise, 2 on wrong usage."""
    if len(sys.argv) != 2 or not sys.argv[1]:
        sys.stderr.write("usage: python -m zsched_lab.fleet.janitor TOKEN\n")
        return 2
    since = time.time() - 1.0  # file times are coarser than the clock
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    folders = read_orders(sys.stdin)
    outcome = clean(sys.argv[1], folders, since)
    with contextlib.suppress(OSError):  # the lab may be gone
        sys.stdout.write(json.dumps(outcome) + "\n")
        sys.stdout.flush()
    return 1 if outcome["left"] else 0


if __name__ == "__main__":
    raise SystemExit(main())
