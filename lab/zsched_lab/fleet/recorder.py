"""Keeps what happened as NDJSON, one file per source: written as it happens, so that an interrupted run keeps it too.

Knows: how records are appended, read and followed. Does not know: what they mean.
"""

from __future__ import annotations

import json
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TextIO

Record = dict[str, Any]
"""One line: a JSON object; by custom it has ``t_s`` (seconds on the daemon's clock) and ``kind``."""


class Recorder:
    """Appends records to ``<folder>/<source>.ndjson``, a line each, flushed at once."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self._files: dict[str, TextIO] = {}

    def write(self, source: str, record: Record) -> None:
        """Append one record of ``source``. Raises `OSError` when the disk refuses."""
        file = self._files.get(source)
        if file is None:
            file = (self._folder / f"{source}.ndjson").open("a", encoding="utf-8")
            self._files[source] = file
        file.write(json.dumps(record, separators=(",", ":")) + "\n")
        file.flush()

    def close(self) -> None:
        """Close every file; idempotent."""
        for file in self._files.values():
            file.close()
        self._files.clear()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class Follower:
    """Reads the records that another process appends to a file, as far as whole lines are there."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._offset = 0

    def new(self) -> list[Record]:
        """The records appended since the last call; none while the file is not there. A damaged line is skipped."""
        try:
            with self._path.open("rb") as file:
                file.seek(self._offset)
                chunk = file.read()
        except FileNotFoundError:
            return []
        whole = chunk[: chunk.rfind(b"\n") + 1]
        self._offset += len(whole)
        return [record for line in whole.splitlines() if (record := parse(line)) is not None]


def parse(line: bytes) -> Record | None:
    """One line as a record, or ``None`` when it is no JSON object."""
    try:
        record = json.loads(line)
    except ValueError:
        return None
    return record if isinstance(record, dict) else None


def read_records(path: Path) -> list[Record]:
    """Every record of a file; empty when it is not there."""
    return Follower(path).new()
