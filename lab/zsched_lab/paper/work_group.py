"""`python -m zsched_lab.paper.work_group MODULE ...`: a worker that first goes to its node's group for tasks.

Knows: the groups of `zsched_lab.paper.node_state`. Does not know: what the worker does. The daemon starts workers, so
they are born in its own group, where they would share what zsched has on top.
"""

from __future__ import annotations

import os
import sys
from typing import Final

from zsched.host.machine.cgroup import CgroupTree
from zsched_lab.fleet.groups import LimitedGroup

OWN: Final = "own"
"""The group of the daemon and its relay, within the node's."""
WORK: Final = "work"
"""The tasks' group beside it."""


def work_group() -> LimitedGroup | None:
    """The tasks' group of the node whose process this is; ``None``: it has none of its own."""
    tree = CgroupTree()
    innermost = [folders[0] for one in ("cpu", "cpuacct", "memory") if (folders := tree.folders(one))]
    beside = [folder.parent / WORK for folder in dict.fromkeys(innermost) if folder.name == OWN]
    return LimitedGroup(tuple(beside)) if beside else None


def main(words: list[str]) -> None:
    """Become ``python -m words``.

    Raises:
        AdapterError: the group does not take this process.
    """
    if (group := work_group()) is not None:
        group.add(os.getpid())
    os.execv(sys.executable, [sys.executable, "-m", *words])  # noqa: S606 - the same program, and no shell


if __name__ == "__main__":
    main(sys.argv[1:])
