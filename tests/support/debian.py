"""A minimal Debian that systemd tests boot, made once and kept (in `ZSCHED_TEST_CACHE`, else ~/.cache/zsched).

``python3 tests/support/debian.py`` makes it beforehand: 45 s to 4 minutes, 300 MB of network. Only the standard library
is needed. Other suites are for ``package/prove.py``.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import subprocess
import sys
from pathlib import Path

SUITE = "bookworm"
PYTHON_IN_SUITE = (3, 11)
SUITES = ("bookworm", "trixie", "jammy")
"""What can be made: Debian 12 and 13, Ubuntu 22.04."""
UBUNTU, UBUNTU_KEYS = "http://archive.ubuntu.com/ubuntu", Path("/usr/share/keyrings/ubuntu-archive-keyring.gpg")
PACKAGES = "systemd,systemd-sysv,dbus,python3,python3-venv"
MAKE_TIMEOUT_S = 900.0


class NoDebianError(Exception):
    """It cannot be made here; says why."""


def cache_folder() -> Path:
    """Where it is kept."""
    return Path(os.environ.get("ZSCHED_TEST_CACHE") or Path.home() / ".cache" / "zsched")


def why_not(suite: str = SUITE) -> str | None:
    """Why a machine cannot be booted here."""
    if os.geteuid() != 0:
        return "booting a machine needs root"
    missing = [tool for tool in ("debootstrap", "systemd-nspawn", "mount") if shutil.which(tool) is None]
    if missing:
        return f"not installed: {', '.join(missing)} (Debian: debootstrap, systemd-container)"
    if suite == SUITE and sys.version_info[:2] != PYTHON_IN_SUITE:
        return f"the booted Debian has Python {PYTHON_IN_SUITE}, this is {sys.version_info[:2]}: no common packages"
    return None


def debian_root(suite: str = SUITE) -> Path:
    """The cached root; made when there is none. Raises `NoDebianError`."""
    if (reason := why_not(suite)) is not None:
        raise NoDebianError(reason)
    cache = cache_folder()
    cache.mkdir(parents=True, exist_ok=True)
    root, part = cache / suite, cache / f"{suite}.part"
    with (cache / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if root.exists():
            return root
        shutil.rmtree(part, ignore_errors=True)
        options = ["--variant=minbase", f"--include={PACKAGES}"]
        from_ubuntu = suite == "jammy"
        if from_ubuntu and not UBUNTU_KEYS.exists():
            options.append("--no-check-gpg")  # nothing of it is kept beyond a test
        command = ["debootstrap", *options, suite, str(part), *([UBUNTU] if from_ubuntu else [])]
        done = subprocess.run(command, capture_output=True, text=True, timeout=MAKE_TIMEOUT_S, check=False)
        if done.returncode != 0:
            shutil.rmtree(part, ignore_errors=True)
            said = (done.stdout + done.stderr).strip()[-300:]
            raise NoDebianError(f"debootstrap failed (no network?): {said}")
        part.rename(root)
    return root


if __name__ == "__main__":
    try:
        print(debian_root())
    except NoDebianError as error:
        sys.exit(f"no Debian to boot: {error}")
