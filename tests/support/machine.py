"""A machine that systemd-nspawn boots on an overlay over a cached Debian (`support.debian`), and forgets.

Knows: overlays, nspawn's command, how a driver is started inside and its report comes out. Does not know: what runs in
it.
"""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

DRIVE_UNIT = """
[Unit]
After=multi-user.target
[Service]
Type=exec
ExecStart=/usr/bin/python3 /opt/drive.py
[Install]
WantedBy=multi-user.target
"""
ENOUGH_MB = 3000
"""Of memory that is available: a machine writes some hundred."""
LEGACY = "systemd.unified_cgroup_hierarchy=0 SYSTEMD_CGROUP_ENABLE_LEGACY_FORCE=1"
"""What a systemd from 256 on wants to be told where this machine's control groups are of the first version."""


@contextmanager
def overlaid(debian: Path, folder: Path) -> Iterator[Path]:
    """A writable view of ``debian`` that forgets everything afterwards.

    What it writes is kept in memory, where there is enough: packages are unpacked in a third of the time, and no disk
    is busy with them when the next fleet keeps real time.
    """
    disk, root = folder / "disk", folder / "root"
    upper, work = disk / "upper", disk / "work"
    disk.mkdir()
    root.mkdir()
    is_in_memory = available_mb() > ENOUGH_MB and _mounts("tmpfs", disk, "size=2g") == ""
    upper.mkdir()
    work.mkdir()
    try:
        if refusal := _mounts("overlay", root, f"lowerdir={debian},upperdir={upper},workdir={work}"):
            pytest.skip(f"cannot mount an overlay: {refusal}")
        try:
            yield root
        finally:
            subprocess.run(["umount", "--lazy", str(root)], timeout=20, check=True)
    finally:
        if is_in_memory:
            subprocess.run(["umount", "--lazy", str(disk)], timeout=20, check=True)


def available_mb() -> int:
    """Memory that this machine could give."""
    lines = Path("/proc/meminfo").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")) // 1024


def _mounts(kind: str, place: Path, options: str) -> str:
    """Mount a file system of a kind; what was said when it could not be."""
    command = ["mount", "-t", kind, kind, "-o", options, str(place)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
    return "" if done.returncode == 0 else done.stderr.strip() or "mount failed"


def furnish(root: Path, driver: Path, files: Mapping[str, str], programs: Mapping[str, str] | None = None) -> None:
    """Put ``files`` and ``programs`` ({path: text}) into the machine, and ``driver``, which runs once it has booted.

    The driver writes /result/report.json and turns the machine off.
    """
    programs = programs or {}
    fixed = {"etc/systemd/system/drive.service": DRIVE_UNIT, "opt/drive.py": driver.read_text()}
    for name, text in {**fixed, **files, **programs}.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        path.chmod(0o755 if name in programs else 0o644)
    (root / "result").mkdir()
    wants = root / "etc/systemd/system/multi-user.target.wants"
    wants.mkdir(parents=True, exist_ok=True)
    (wants / "drive.service").symlink_to("/etc/systemd/system/drive.service")


def options(root: Path, folder: Path, name: str, read_only: Mapping[str, Path]) -> list[str]:
    """Of nspawn: the machine's tree and name, ``read_only`` ({place inside: folder here}), and the report's folder."""
    binds = [f"--bind-ro={here}:{inside}" for inside, here in read_only.items()]
    for inside in read_only:
        (root / inside.lstrip("/")).mkdir(parents=True, exist_ok=True)
    (folder / "result").mkdir(exist_ok=True)
    machine = f"--machine=zsched-{name}-{os.getpid()}"
    return [
        "-q",
        "-D",
        str(root),
        machine,
        "--register=no",
        "--keep-unit",
        *binds,
        f"--bind={folder / 'result'}:/result",
    ]


def booted(folder: Path, arguments: Sequence[str], timeout_s: float) -> dict[str, Any]:
    """Boot the machine of `options`, let the driver run; its report."""
    legacy = [] if Path("/sys/fs/cgroup/cgroup.controllers").exists() else [f"--setenv=SYSTEMD_PROC_CMDLINE={LEGACY}"]
    done = nspawn(folder, [*arguments, *legacy, "-b"], timeout_s=timeout_s)
    report = folder / "result" / "report.json"
    console = (folder / "console.log").read_text(errors="replace")
    assert report.exists(), f"no report; nspawn said {done}:\n{console[-3000:]}"
    found: dict[str, Any] = json.loads(report.read_text())
    return found


def nspawn(folder: Path, arguments: list[str], timeout_s: float) -> int:
    """Run systemd-nspawn to its end, what it prints going to the folder's console.log; its exit status."""
    with (folder / "console.log").open("ab") as console:
        command = ["systemd-nspawn", *arguments]
        return subprocess.run(
            command, stdin=subprocess.DEVNULL, stdout=console, stderr=console, timeout=timeout_s, check=False
        ).returncode
