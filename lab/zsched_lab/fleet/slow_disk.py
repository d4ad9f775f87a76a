"""A disk that takes its time: every fsync of the processes that begin inside waits first, as a stalling SD card's does.

Knows: how to build and load the library that is between a program and its C library. Does not know: who syncs, and why.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

_SOURCE = """
#define _GNU_SOURCE
#include <dlfcn.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

static void stall(void) {
    const char *path = getenv("LAB_FSYNC_MS");
    FILE *file = path ? fopen(path, "re") : NULL;
    long ms = 0;
    if (file) {
        if (fscanf(file, "%ld", &ms) != 1) ms = 0;
        fclose(file);
    }
    struct timespec left = {ms / 1000, (ms % 1000) * 1000000};
    while (ms > 0 && nanosleep(&left, &left) != 0) { }
}

int fsync(int fd) {
    stall();
    return ((int (*)(int)) dlsym(RTLD_NEXT, "fsync"))(fd);
}

int fdatasync(int fd) {
    stall();
    return ((int (*)(int)) dlsym(RTLD_NEXT, "fdatasync"))(fd);
}
"""
COMPILER = shutil.which("cc")
"""``None``: there is none here, and no slow disk either."""


class SlowDisk:
    """How long every fsync takes, in ``folder``; it may change at any time."""

    def __init__(self, folder: Path) -> None:
        self._source, self._library, self._ms = folder / "slow.c", folder / "slow.so", folder / "fsync-ms"
        self.take(0)
        self._source.write_text(_SOURCE)
        build = [COMPILER or "cc", "-shared", "-fPIC", "-o", str(self._library), str(self._source), "-ldl"]
        subprocess.run(build, check=True, timeout=60)

    def take(self, ms: int) -> None:
        """From now on an fsync takes so many milliseconds longer."""
        new = self._ms.with_suffix(".new")
        new.write_text(f"{ms}\n")
        new.replace(self._ms)

    @contextlib.contextmanager
    def under(self) -> Iterator[None]:
        """The processes that begin inside have this disk, and their children, too."""
        added = {"LD_PRELOAD": str(self._library), "LAB_FSYNC_MS": str(self._ms)}
        before = {name: os.environ.get(name) for name in added}
        os.environ.update(added)
        try:
            yield
        finally:
            for name, value in before.items():
                os.environ.pop(name, None) if value is None else os.environ.update({name: value})
