"""Debian packages of this tree, built as small as a test may have them: for one Python, packed fast.

Knows: `package/deb/build.py`, how a package becomes one of another version. Does not know: what is installed where.
"""

from __future__ import annotations

import fcntl
import hashlib
import importlib.util
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

from support.debian import PYTHON_IN_SUITE, cache_folder

REPO = Path(__file__).parents[2]
FAST = "-Zgzip -z1"
TIMEOUT_S = 240.0
NOT_FETCHED = 3
"""How `build.py` ends when the index does not give the wheels."""


def loaded(file: Path) -> ModuleType:
    """A program as a module."""
    spec = importlib.util.spec_from_file_location(f"loaded_{file.stem}", file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def builder() -> ModuleType:
    """The program that builds packages."""
    return loaded(REPO / "package/deb/build.py")


def wheels_folder() -> Path:
    """Where fetched wheels are kept from run to run."""
    return cache_folder() / "deb"


def own_wheel() -> Path:
    """The wheel of this tree, by the program that `make wheel` runs; built once for each state that git knows."""
    listed = git("ls-files", "-z", "--cached", "--others", "--exclude-standard").split("\0")
    state = hashlib.blake2s(git("describe", "--always", "--dirty", "--tags").encode(), digest_size=8)
    for name in listed:
        if name and (REPO / name).is_file():
            state.update(name.encode() + b"\0" + (REPO / name).read_bytes())
    folder = cache_folder() / "own" / state.hexdigest()
    folder.parent.mkdir(parents=True, exist_ok=True)
    with (folder.parent / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists() or listed == [""]:
            for old in folder.parent.iterdir():
                if old.is_dir():
                    shutil.rmtree(old)
            before, part = set(REPO.iterdir()), folder.with_suffix(".part")
            command = [sys.executable, str(REPO / "package/wheel.py"), str(part)]
            done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
            assert done.returncode == 0, done.stderr
            assert set(REPO.iterdir()) == before, "it leaves nothing in the tree"
            part.rename(folder)
        (wheel,) = folder.glob("*.whl")
    return wheel


def git(*arguments: str) -> str:
    """What git says of this tree; empty where there is none."""
    command = ["git", "-C", str(REPO), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False).stdout


def built(out: Path) -> Path:
    """This tree's package, for the Python of the booted Debian. Skips where the wheels cannot be had."""
    if shutil.which("dpkg-deb") is None:
        pytest.skip("not installed: dpkg-deb")
    python = ".".join(str(one) for one in PYTHON_IN_SUITE)
    command = [sys.executable, str(REPO / "package/deb/build.py"), "--python", python, "--compression", FAST]
    command += ["--work", str(wheels_folder())]
    fetched = subprocess.run([*command, "--fetch"], capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
    if fetched.returncode == NOT_FETCHED:
        pytest.skip(f"the locked wheels cannot be fetched (no network?): {fetched.stderr.strip()[-300:]}")
    command += ["--wheel", str(own_wheel()), "--out", str(out)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
    assert done.returncode == 0, done.stderr
    (package,) = out.glob("*.deb")
    return package


def another(package: Path, version: str, folder: Path, change: Callable[[Path], None] = lambda _home: None) -> Path:
    """The same package under another version; ``change`` may alter its /opt/zsched."""
    tree = folder / f"tree-{version}"
    subprocess.run(["dpkg-deb", "-R", str(package), str(tree)], timeout=120, check=True)
    told = tree / "DEBIAN/control"
    lines = [f"Version: {version}" if line.startswith("Version:") else line for line in told.read_text().splitlines()]
    told.write_text("\n".join(lines) + "\n")
    home = tree / "opt/zsched"
    (home / "lib/site-packages/zsched/_version.py").write_text(f'"""Of a test."""\n\n__version__ = "{version}"\n')
    change(home)
    target = folder / f"zsched_{version}.deb"
    command = ["dpkg-deb", "--root-owner-group", *FAST.split(), "--build", str(tree), str(target)]
    subprocess.run(command, capture_output=True, env={**os.environ, "LC_ALL": "C"}, timeout=120, check=True)
    shutil.rmtree(tree)
    return target
