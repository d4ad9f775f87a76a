"""Whose CPU an edge's is: SLAM's, the merger's, the model's, navigation's, zsched's own; and how it is shared out when.

Knows: processes and their command lines, /proc, what a run's records hold. Does not know: schemes, what is good.

A node's group tells its CPU as a whole. What each process of it took is in /proc; a process that ends between two
readings loses what it took since the last one.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from zsched.core.values.model import NodeId
from zsched.host.procfs import parse_process_stat, read_file

ROLES = (
    ("zsched_lab.explore.slam", "slam"),
    ("zsched_lab.explore.navigate", "navigation"),
    ("zsched.tasks.map_merge", "merge"),
    ("zsched_lab.paper.cameras", "model"),
)
"""(what a command line holds, what such a process is)."""
REST = "zsched"
"""Everything else in a node's group: the daemon, its relay."""
Json = Mapping[str, Any]


def role_of(command: str) -> str:
    """What a process is, by its command line.

    >>> role_of("python -m zsched_lab.explore.slam --robot robot1"), role_of("zsched up")
    ('slam', 'zsched')
    """
    return next((role for part, role in ROLES if part in command), REST)


class RoleMeter:
    """The CPU of a node's processes by role; ``pids`` names them."""

    def __init__(self, pids: Callable[[], Iterable[int]], proc: Path = Path("/proc")) -> None:
        self._pids = pids
        self._proc = proc
        self._seen: dict[int, tuple[str, float]] = {}
        """{process: (role, CPU seconds so far)}."""
        self._ended: dict[str, float] = {}

    def read(self) -> dict[str, float]:
        """{role: CPU seconds so far}, of all that ran since the first reading."""
        running = set()
        for pid in self._pids():
            if (spent_s := cpu_s(self._proc / str(pid) / "stat")) is None:
                continue
            running.add(pid)
            known = self._seen.get(pid)
            # A process that has just been started is still its starter: ask until it has said what it is.
            role = known[0] if known is not None and known[0] != REST else self._role(pid)
            self._seen[pid] = (role, spent_s)
        for pid in self._seen.keys() - running:
            role, spent_s = self._seen.pop(pid)
            self._ended[role] = self._ended.get(role, 0.0) + spent_s
        total = dict(self._ended)
        for role, spent_s in self._seen.values():
            total[role] = total.get(role, 0.0) + spent_s
        return {role: round(spent_s, 3) for role, spent_s in sorted(total.items())}

    def _role(self, pid: int) -> str:
        try:
            return role_of(
                (self._proc / str(pid) / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace")
            )
        except OSError:
            return REST


def cpu_s(stat: Path) -> float | None:
    """CPU seconds of a process by its ``/proc/PID/stat`` (proc(5)), of all its threads; ``None``: it has ended."""
    times = parse_process_stat(read_file(str(stat)))
    return None if times is None else times.own_s


def role_figures(
    records: Sequence[Json], shares: Mapping[NodeId, Json], owners: Callable[[float], NodeId | None]
) -> Json:
    """{node: {"idle" | "model" | "merge" | "both": {"s": seconds, role: share of the node's ``cpu_cores``}}}.

    By what was there between two readings: the injected model, the task's owner, both of them, or neither. ``owners``
    tells who owned the task when. Empty for runs whose records have no roles.
    """
    found: dict[NodeId, dict[str, dict[str, float]]] = {}
    known = [record for record in records if record.get("roles")]
    for before, after in itertools.pairwise(known):
        seconds = float(after["t_s"]) - float(before["t_s"])
        for node, spent in after["roles"].items():
            state = state_of(node in before["loaded"] and node in after["loaded"], owners(float(before["t_s"])) == node)
            row = found.setdefault(node, {}).setdefault(state, {"s": 0.0})
            row["s"] += seconds
            for role, total_s in spent.items():
                row[role] = row.get(role, 0.0) + total_s - float(before["roles"].get(node, {}).get(role, 0.0))
    return {
        node: {state: shares_of(row, float(shares[node]["cpu_cores"])) for state, row in sorted(states.items())}
        for node, states in sorted(found.items())
        if node in shares
    }


def state_of(has_model: bool, has_merge: bool) -> str:
    """The name of what is on a node beside its SLAM."""
    return {(True, True): "both", (True, False): "model", (False, True): "merge"}.get((has_model, has_merge), "idle")


def shares_of(row: Mapping[str, float], cores: float) -> dict[str, float]:
    """CPU seconds of a state as shares of a node's cores; the seconds themselves stay as ``s``."""
    seconds = row["s"]
    shares = {role: spent_s / seconds / cores for role, spent_s in row.items() if role != "s" and seconds > 0.0}
    return {"s": round(seconds, 1), **{role: round(share, 4) for role, share in sorted(shares.items())}}


def mean_shares(figures: Iterable[Json], state: str | None = None) -> dict[str, float]:
    """{role: share of an edge} over all nodes of runs, weighted by time, in one state (``None``: in all)."""
    seconds, total = 0.0, dict[str, float]()
    for nodes in figures:
        for states in nodes.values():
            for name, row in states.items():
                if state is not None and name != state:
                    continue
                seconds += row["s"]
                for role, share in row.items():
                    if role != "s":
                        total[role] = total.get(role, 0.0) + share * row["s"]
    return {role: value / seconds for role, value in sorted(total.items())} if seconds > 0.0 else {}
