"""Stands in for `zsched init` and `zsched up` in the lab's own tests: a real process on a real operator socket.

``STUB_FAILS=init|up`` makes that verb end with an error. The task moves from edge1 to edge2 after a second.
"""

from __future__ import annotations

import argparse
import os
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Any

from zsched.host.operator_socket import OperatorSocket


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("verb")
    for name in ("--config", "--node", "--state-dir", "--runtime-dir"):
        parser.add_argument(name, type=str)
    given = parser.parse_args()
    if os.environ.get("STUB_FAILS") == given.verb:
        sys.stderr.write("the disk is full\n")
        return 1
    state = Path(given.state_dir) / "state"
    if given.verb == "init":
        state.parent.mkdir(parents=True)
        state.write_text(given.node)
        return 0
    assert state.read_text() == given.node
    return serve(given.node, Path(given.runtime_dir) / f"{given.node}.sock")


def serve(node: str, path: Path) -> int:
    stop = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stop.set())
    start = time.monotonic()
    door = OperatorSocket(path, lambda _: status(node, time.monotonic() - start))
    door.open()
    while not stop.is_set():
        time.sleep(0.02)
    door.close()
    return 0


def status(node: str, up_s: float) -> dict[str, Any]:
    history = [{"epoch": 1, "revision": 1, "owner": "edge1", "age_s": up_s, "reason": "the first"}]
    if up_s > 1.0:
        history.append({"epoch": 2, "revision": 2, "owner": "edge2", "age_s": up_s - 1.0, "reason": "edge1 is busy"})
    task = {
        "name": "map_merge",
        "owner": history[-1]["owner"],
        "epoch": len(history),
        "candidates": ["edge1", "edge2"],
        "history": history,
    }
    me = {"name": node, "state": "alive", "cpu_ratio": 0.5, "memory_ratio": 0.25, "links": [{"source": "wired"}]}
    return {"schema": "zsched.status/1", "nodes": [me], "tasks": [task], "problems": []}


if __name__ == "__main__":
    sys.exit(main())
