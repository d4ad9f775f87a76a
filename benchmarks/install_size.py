"""What pip lays down on a robot: the wheel, zsched's own files, everything, and how many packages.

``python -m benchmarks.install_size [REVISION ...]``: a column for each git revision of this clone; none given: HEAD.
Each is built to a wheel and installed into an environment of its own that has nothing else, not even pip; what zsched
depends on comes from the index that pip is configured for, in the newest version that it takes. Sizes are those of the
files, as pip leaves them: with bytecode.
"""

from __future__ import annotations

import argparse
import csv
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final

from benchmarks.common import unpacked

MIB: Final = 1024 * 1024
STEP_S: Final = 900.0


def run(*command: str | Path) -> None:
    """Run a command. Raises `subprocess.CalledProcessError`."""
    subprocess.run([str(part) for part in command], stdout=subprocess.DEVNULL, timeout=STEP_S, check=True)


def pip(*arguments: str | Path) -> None:
    """Run the pip of this Python."""
    run(sys.executable, "-m", "pip", "-qq", "--disable-pip-version-check", *arguments)


def installed(revision: str, folder: Path) -> tuple[Path, Path]:
    """(wheel, the environment's site-packages) of a revision, built and installed in ``folder``."""
    tree, wheels, environment = folder / "tree", folder / "wheels", folder / "environment"
    pip("wheel", "--no-deps", "-w", wheels, unpacked(revision, tree))
    (wheel,) = wheels.glob("zsched-*.whl")
    run(sys.executable, "-m", "venv", "--without-pip", environment)
    pip("--python", environment / "bin" / "python", "install", wheel)
    (site,) = environment.glob("lib/python*/site-packages")
    return wheel, site


def recorded(info: Path) -> list[Path]:
    """The files of one installed package, by its RECORD."""
    with (info / "RECORD").open(encoding="utf-8", newline="") as lines:
        return [info.parent / row[0] for row in csv.reader(lines)]


def mib(files: list[Path]) -> str:
    """The size of all files."""
    return f"{sum(file.stat().st_size for file in files if file.is_file()) / MIB:.1f} MiB"


def rows_of(revision: str) -> dict[str, str]:
    """What is printed of one revision."""
    with tempfile.TemporaryDirectory(prefix="zsched-size-") as name:
        wheel, site = installed(revision, Path(name))
        (info,) = site.glob("zsched-*.dist-info")
        own = recorded(info)
        return {
            "the wheel": mib([wheel]),
            "zsched's own files": mib(own),
            "... of them bytecode": mib([file for file in own if file.suffix == ".pyc"]),
            "all of site-packages": mib(sorted(site.rglob("*"))),
            "packages": f"{len(list(site.glob('*.dist-info')))}",
        }


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="size of an installation", prog="python -m benchmarks.install_size")
    parser.add_argument("revision", nargs="*", help="git revisions of this clone; none: HEAD")
    revisions: list[str] = parser.parse_args().revision or ["HEAD"]
    columns = [rows_of(revision) for revision in revisions]
    print("| |", " | ".join(f"`{revision}`" for revision in revisions), "|")
    print("| --- |", " | ".join("---:" for _ in revisions), "|")
    for row in columns[0]:
        print(f"| {row} |", " | ".join(column[row] for column in columns), "|")


if __name__ == "__main__":
    main()
