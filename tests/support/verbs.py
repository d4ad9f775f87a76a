"""zsched's own verbs, said to a running fleet as an operator would."""

from __future__ import annotations

import subprocess
import sys

from zsched.core.values.model import NodeId
from zsched_lab.fleet.testbed import TASK, Testbed

VERB_S = 60.0


def command(bed: Testbed, *words: str, node: NodeId = "robot1") -> str:
    """What a verb says, on both streams."""
    done = subprocess.run(
        [sys.executable, "-m", "zsched.cli", *words, "--node", node, "--runtime-dir", str(bed.folder)],
        capture_output=True,
        text=True,
        timeout=VERB_S,
        check=False,
    )
    return done.stdout + done.stderr


def move(bed: Testbed, owner: NodeId) -> None:
    """Give the first task to a node, by order, and wait until its streams have settled there."""
    said = command(bed, "move", TASK, owner, "--yes")
    bed.wait(lambda: bed.owner() == owner, 60, f"the move, of which was said: {said}")
    bed.wait_settled()
