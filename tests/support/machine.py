"""A machine that systemd-nspawn boots on an overlay over the cached Debian (`support.debian`), and forgets.

Knows: overlays, nspawn's command. Does not know: what runs in it.
"""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest


@contextmanager
def overlaid(debian: Path, folder: Path) -> Iterator[Path]:
    """A writable view of ``debian`` that forgets everything afterwards."""
    upper, work, root = (folder / name for name in ("upper", "work", "root"))
    for path in (upper, work, root):
        path.mkdir()
    options = f"lowerdir={debian},upperdir={upper},workdir={work}"
    command = ["mount", "-t", "overlay", "overlay", "-o", options, str(root)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=20, check=False)
    if done.returncode != 0:
        pytest.skip(f"cannot mount an overlay: {done.stderr.strip()}")
    try:
        yield root
    finally:
        subprocess.run(["umount", "--lazy", str(root)], timeout=20, check=True)


def nspawn(folder: Path, arguments: list[str], timeout_s: float) -> int:
    """Run systemd-nspawn to its end, what it prints going to the folder's console.log; its exit status."""
    with (folder / "console.log").open("ab") as console:
        command = ["systemd-nspawn", *arguments]
        return subprocess.run(
            command, stdin=subprocess.DEVNULL, stdout=console, stderr=console, timeout=timeout_s, check=False
        ).returncode
