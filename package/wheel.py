"""Builds zsched's own wheel from this tree, as it lies here, and leaves nothing in it: `make wheel`.

    python package/wheel.py DIR

It is built from a copy: setuptools would otherwise take what an earlier build left (`build/lib`), and write beside the
sources. The version comes from git's tags, or from the sdist or archive that the tree is of (pyproject.toml).
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

REPO = Path(__file__).parents[1]
LEFT_OUT = shutil.ignore_patterns(".git", ".venv", "build", "dist", "__pycache__", "*.egg-info", "_version.py", "out")
PIP_S = 900.0


class BuildError(Exception):
    """Something cannot be built: what is wrong, and what to do."""


class FetchError(BuildError):
    """The index does not give what is needed."""


def pip(*arguments: str, env: dict[str, str] | None = None) -> None:
    """Run pip. Raises `BuildError`; `FetchError` where it got nothing from the index.

    An index that has other versions than the locked ones is there: the lock is at fault.
    """
    command = [sys.executable, "-m", "pip", "--disable-pip-version-check", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PIP_S, check=False, env=env)
    if done.returncode != 0:
        is_away = any(words in done.stderr for words in ("from versions: none", "Connection", "Max retries"))
        kind = FetchError if is_away else BuildError
        raise kind(f"pip {arguments[0]} failed:\n{done.stdout[-1000:]}{done.stderr[-2000:]}")


def copied(folder: Path) -> Path:
    """A copy of the sources, which git takes for this tree."""
    source = folder / "source"
    command = ["git", "-C", str(REPO), "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    try:
        listed = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    except OSError:
        listed = None
    if listed is None or listed.returncode != 0:
        shutil.copytree(REPO, source, ignore=LEFT_OUT)
        return source
    for name in listed.stdout.split("\0"):
        if name and (REPO / name).is_file():
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(REPO / name, source / name, follow_symlinks=False)
    git = REPO / ".git"
    (source / ".git").write_text(git.read_text() if git.is_file() else f"gitdir: {git}\n")
    return source


def own_wheel(out: Path) -> Path:
    """Build the wheel into ``out``. Raises `BuildError`."""
    out.mkdir(parents=True, exist_ok=True)
    has_tools = all(importlib.util.find_spec(name) for name in ("setuptools_scm", "setuptools"))
    with tempfile.TemporaryDirectory(prefix="zsched-wheel-") as name:
        source = copied(Path(name))
        flags = ["--no-build-isolation"] if has_tools else []
        env = {**os.environ, "GIT_OPTIONAL_LOCKS": "0"}
        pip("wheel", "--quiet", "--no-deps", *flags, "-w", str(Path(name) / "out"), str(source), env=env)
        (found,) = (Path(name) / "out").glob("zsched-*.whl")
        target = out / found.name
        shutil.move(found, target)
    return target


if __name__ == "__main__":
    try:
        print(own_wheel(Path(sys.argv[1] if len(sys.argv) > 1 else "dist")))
    except BuildError as error:
        sys.exit(f"wheel: {error}")
