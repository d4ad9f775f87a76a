"""A benchmark's rows on disk, one JSON object a line: a run that was interrupted goes on where it stopped.

Knows: files, rows, progress lines. Does not know: what is measured.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.common import percentile

Row = dict[str, Any]


class Record:
    """Rows of one benchmark in ``<folder>/<name>.jsonl``; without a folder they are kept in memory only."""

    def __init__(self, folder: Path | None, name: str) -> None:
        """Read what earlier runs have left (a line that was cut short is forgotten)."""
        self._file = None if folder is None else folder / f"{name}.jsonl"
        self.rows: list[Row] = []
        if self._file is None:
            return
        self._file.parent.mkdir(parents=True, exist_ok=True)
        if self._file.exists():
            self.rows = [row for line in self._file.read_text().splitlines() if (row := _row(line)) is not None]
            self._file.write_text("".join(json.dumps(row) + "\n" for row in self.rows))

    def add(self, row: Row) -> None:
        """Keep one row, at once."""
        self.rows.append(row)
        if self._file is not None:
            with self._file.open("a") as file:
                file.write(json.dumps(row) + "\n")

    def having(self, **wanted: object) -> list[Row]:
        """The rows with these fields."""
        return [row for row in self.rows if all(row.get(name) == value for name, value in wanted.items())]


def _row(line: str) -> Row | None:
    try:
        row = json.loads(line)
    except ValueError:
        return None
    return row if isinstance(row, dict) else None


def summary(values: Sequence[float]) -> dict[str, float]:
    """n, p50, p90, max, and p99 where n allows it (from 100 on)."""
    found = {"n": float(len(values)), "p50": percentile(values, 0.5), "p90": percentile(values, 0.9)}
    if len(values) >= 100:
        found["p99"] = percentile(values, 0.99)
    return found | {"max": max(values)}


def table(rows: Sequence[tuple[str, Sequence[float], str]], unit: str) -> str:
    """(name, values, goal) as a Markdown table."""
    lines = [f"| {unit} | n | p50 | p90 | p99 | max | goal |", "| --- | --- | --- | --- | --- | --- | --- |"]
    for name, values, goal in rows:
        if not values:
            continue
        found = summary(values)
        p99 = f"{found['p99']:.0f}" if "p99" in found else "-"
        figures = f"{len(values)} | {found['p50']:.0f} | {found['p90']:.0f} | {p99} | {found['max']:.0f}"
        lines.append(f"| {name} | {figures} | {goal} |")
    return "\n".join(lines)


def progress(text: str) -> None:
    """Say how far it is, with the time of day."""
    print(f"{time.strftime('%H:%M:%S')} {text}", flush=True)


def save(folder: Path | None, name: str, found: Row) -> None:
    """Write the end's figures as ``<folder>/<name>.json``, with the machine and the commit."""
    if folder is None:
        return
    commit = subprocess.run(
        ("git", "rev-parse", "--short", "HEAD"), capture_output=True, text=True, check=False, timeout=10
    ).stdout.strip()
    head = {"commit": commit, "cores": os.cpu_count(), "python": platform.python_version(), "argv": sys.argv[1:]}
    (folder / f"{name}.json").write_text(json.dumps(head | found, indent=1) + "\n")


def together(module: str, each: Sequence[Sequence[str]], shared: Sequence[str]) -> int:
    """Run ``python -m module`` once per list of arguments, all at the same time; the worst exit code."""
    children = [subprocess.Popen([sys.executable, "-m", module, *own, *shared]) for own in each]
    try:
        return max(child.wait() for child in children)
    except BaseException:
        for child in children:
            child.terminate()
        for child in children:
            child.wait(60)
        raise
