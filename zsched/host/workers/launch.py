"""Becomes a worker's command after making sure that it cannot outlive the daemon that started it.

Run as a script, by path: ``python -I -S launch.py PARENT_PID COMMAND [ARGUMENT...]``. It keeps its process id.
A ``preexec_fn`` would do the same inside the daemon's own fork, where other threads may hold locks.

Knows: prctl(2), signals, exec. Does not know: tasks, supervisors, or any other module of zsched (it imports none).
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
from pathlib import Path

EXIT_CANNOT = 78
"""EX_CONFIG of sysexits.h: "I cannot run here, do not try again"."""
PR_SET_PDEATHSIG = 1
"""linux/prctl.h"""
OOM_SCORE = 300
"""Workers die of an exhausted memory before their daemon does: a dead worker is moved, a dead daemon moves nothing."""


def tie_to_parent(parent: int) -> bool:
    """Ask the kernel to kill this process with its parent; ``False`` when the parent has gone already.

    The kernel watches the parent's *thread* (prctl(2)), so the caller must start us from one that stays.
    """
    import ctypes  # noqa: PLC0415 - here, so that the daemon, which wants our constants only, need not load it

    ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    return os.getppid() == parent


def restore_signals() -> None:
    """Undo what this interpreter and the daemon's shell have ignored: a worker starts with the defaults."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGPIPE, signal.SIGXFSZ):
        signal.signal(number, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_SETMASK, ())


def main(arguments: list[str]) -> int:
    """Tie, restore, exec; returns (an exit status) only when that failed."""
    restore_signals()
    parent, command = int(arguments[0]), arguments[1:]
    if not tie_to_parent(parent):
        return 1
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text(str(OOM_SCORE), encoding="ascii")
    try:
        os.execvp(command[0], command)  # noqa: S606 - the operator's command, on purpose without a shell
    except OSError as error:
        print(f"cannot run {command[0]!r}: {error.strerror}", file=sys.stderr)
    return EXIT_CANNOT


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
