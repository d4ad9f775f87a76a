"""Notices that a file of a worker's command has been saved.

Knows: modification times. Does not know: workers, processes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from zsched.core.values.model import TaskId

Stamp = tuple[int, int]


class Watched:
    """The files that the commands of some tasks name, looked at whenever somebody asks."""

    def __init__(self, commands: Mapping[TaskId, Sequence[str]], folder: Path) -> None:
        """Relative names are meant from ``folder``; a program that is found by PATH is not watched.

        A Python file that is not there yet is: its name may be wrong, or it is still to be written.
        """
        self.files: dict[TaskId, tuple[Path, ...]] = {
            task: tuple(path for word in words if (path := folder / word).is_file() or path.suffix == ".py")
            for task, words in commands.items()
        }
        self._stamps = {path: _stamp(path) for paths in self.files.values() for path in paths}

    def changed(self) -> dict[TaskId, str]:
        """{task: the file that was saved} since the last look; a file that is away for a moment has not changed."""
        new = {path: stamp for path in self._stamps if (stamp := _stamp(path)) not in (None, self._stamps[path])}
        self._stamps.update(new)
        return {
            task: next(path.name for path in paths if path in new)
            for task, paths in self.files.items()
            if any(path in new for path in paths)
        }


def _stamp(path: Path) -> Stamp | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size
