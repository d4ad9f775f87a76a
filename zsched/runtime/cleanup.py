"""Ends what a stopped service has left in its control group; a relay may stay, for the daemon that follows.

Knows: control groups, what systemd tells ``ExecStopPost=`` (systemd.exec(5), "$SERVICE_RESULT"), where relays are found
again. Does not know: why the daemon ended.

``python -m zsched.runtime.cleanup``, by systemd after every end of the daemon. The unit's ``KillMode=process`` leaves
the relay alone, and everything else with it: workers are gone by then, but not what moved to a session of its own.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from zsched.clock import monotonic_s
from zsched.exits import EXIT_CONFIG, EXIT_LEFT, EXIT_USAGE
from zsched.ipc.relay_socket import relay_pid

DEADLINE_S: Final = 1.0
POLL_S: Final = 0.01
GROUPS: Final = Path("/sys/fs/cgroup")


def spares_relay(environment: Mapping[str, str]) -> bool:
    """Whether another daemon follows, or this one has ended its relay itself.

    Not after a stop that had to be forced ("timeout"), nor after an exit that systemd does not answer with a restart.
    """
    is_last = environment.get("EXIT_STATUS") in (str(EXIT_USAGE), str(EXIT_CONFIG), str(EXIT_LEFT))
    return environment.get("SERVICE_RESULT") != "timeout" and not is_last


def own_group(text: str, root: Path = GROUPS) -> Path | None:
    """The folder of our control group by ``/proc/self/cgroup``; ``None`` when it is the root or cannot be told.

    systemd keeps its units in the hierarchy of its own name, where there is one (version 1), else in the unified one.
    """
    lines = [line.split(":", 2) for line in text.splitlines()]
    named = [path for _, controllers, path in lines if controllers == "name=systemd"]
    unified = [path for number, _, path in lines if number == "0"]
    path = (named or unified or ["/"])[0]
    if path == "/":
        return None
    return (root / "systemd" if named else root) / path.lstrip("/")


def end_all(group: Path, spared: frozenset[int]) -> list[int]:
    """SIGKILL every process in ``group`` but ``spared``; returns those that were there."""
    found: dict[int, None] = {}
    until = monotonic_s() + DEADLINE_S
    while left := [pid for pid in members(group) if pid not in spared]:
        for pid in left:
            found[pid] = None
            with contextlib.suppress(OSError):
                os.kill(pid, signal.SIGKILL)
        if monotonic_s() > until:
            break
        time.sleep(POLL_S)
    return list(found)


def members(group: Path) -> list[int]:
    """The processes in ``group``; none when it cannot be read."""
    with contextlib.suppress(OSError):
        return [int(word) for word in (group / "cgroup.procs").read_text().split()]
    return []


def main(environment: Mapping[str, str] = os.environ) -> int:
    """Sweep; 0 unless the control group is unknown."""
    group = own_group(Path("/proc/self/cgroup").read_text())
    if group is None:
        return 1
    relays: frozenset[int] = frozenset()
    if spares_relay(environment):
        folder = Path(environment.get("RUNTIME_DIRECTORY", "/run/zsched").partition(":")[0])
        relays = frozenset(pid for path in folder.glob("*.relay") if (pid := relay_pid(path)) is not None)
    if ended := end_all(group, relays | {os.getpid()}):
        print(f"left over and ended: {', '.join(map(str, ended))}", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
