"""Records a fleet that grows from one machine to four, and shrinks to three.

``python -m benchmarks.growth --cast FILE``; about two minutes. Machines have folders of their own on loopback: a
secured fleet, one task, and an application that asks robot1's task ten times a second.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from pathlib import Path
from typing import Final

from benchmarks.common import machine
from benchmarks.tour import PER_NODE, TASK, Seen, Step, application, played, write_cast
from zsched_lab.fleet.hall import Hall, block_of_ports

COMERS: Final = ("robot2", "edge1", "robot3")
LEAVER: Final = "robot2"
ELECTORS_S: Final = 120.0
"""A fleet takes machines that it has heard for a while as electors, until there are three."""


class Recording:
    """The steps that were played; each must end with 0."""

    def __init__(self, hall: Hall, size: tuple[int, int]) -> None:
        self.seen: list[Seen] = []
        self._hall, self._size = hall, size

    def play(self, node: str, words: str, into: str = "") -> None:
        """Play a verb on a node's machine.

        Raises:
            SystemExit: it failed.
        """
        (self._hall.folder / node).mkdir(exist_ok=True)
        one = played(self._hall, Step(node=node, words=words, into=into), self._size)
        print(f"{one.seconds:5.1f} s  {node}$ {one.step.line}", flush=True)
        if one.code != 0:
            raise SystemExit(f"{one.code}: {one.text}")
        self.seen.append(one)

    def begin(self, node: str) -> None:
        """Start a node's daemon; in service: ``systemctl enable --now zsched``."""
        self._hall.start(node)


def grow(recording: Recording, hall: Hall, port: int) -> None:
    """Three machines come."""
    for at, name in enumerate(COMERS, 1):
        kind = name.rstrip("0123456789")
        words = f"invite {name} --kind {kind} --address 127.0.0.1:{port + PER_NODE * at} --candidate-for echo --yes"
        words += " --accept pause-task" if at == 1 else ""  # the only candidate's worker starts again
        recording.play("robot1", words, into=f"{name}.invite")
        (hall.folder / name).mkdir(exist_ok=True)
        shutil.copy(hall.folder / "robot1" / f"{name}.invite", hall.folder / name)
        recording.play(name, f"join {name}.invite")
        recording.begin(name)
        recording.play(name, "wait --for quorum --timeout 60")
        recording.play("robot1", "wait --for healthy --timeout 60")
    end = time.monotonic() + ELECTORS_S
    while hall.status("robot1").get("quorum", {}).get("electors") != len(COMERS) and time.monotonic() < end:
        time.sleep(0.5)
    recording.play("robot1", "status")
    recording.play("robot1", "fleet show")


def main() -> None:
    """Found the fleet, let machines come and go, write the recording."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cast", type=Path, help="the recording")
    parser.add_argument("--columns", type=int, default=100)
    parser.add_argument("--rows", type=int, default=30)
    options = parser.parse_args()
    size = (options.rows, options.columns)
    print(machine(), flush=True)
    port = block_of_ports(40)
    with tempfile.TemporaryDirectory(prefix="growth-", dir="/tmp") as name, Hall(Path(name)) as hall:
        recording = Recording(hall, size)
        recording.play("robot1", f"fleet create hall --address 127.0.0.1:{port}")
        recording.begin("robot1")
        (hall.folder / "robot1" / "echo.yaml").write_text(TASK)
        recording.play("robot1", "wait --for quorum --timeout 60")
        recording.play("robot1", "task add echo.yaml --yes")
        recording.play("robot1", "wait --for settled=echo --timeout 60")
        recording.play("robot1", "status")
        with application(hall):
            began = time.monotonic()
            grow(recording, hall, port)
            recording.play(LEAVER, "leave --yes -m workshop")
            recording.play("robot1", "status")
            recording.play("robot1", "history echo")
            print(f"{time.monotonic() - began:.0f} s from the first invitation to the end of the leave")
    if options.cast:
        title = "zsched: from one machine to four and back to three"
        write_cast(options.cast, recording.seen, size, Path(name), title)


if __name__ == "__main__":
    main()
