"""What sessions that are opened anew cost a stream: a robot joins, renewal, revocation, another authority.

``python -m benchmarks.reopened [--hz 100] [--rounds 1]``. Three daemons on one machine, founded by the verbs, and a
`reliable` stream from an application on the robot's local side to the owner and back. One line for each step: messages
that were sent, had no answer, had two; the longest pause between answers, which holds the owner's moves as well.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

from benchmarks.common import machine
from zsched_lab.fleet.openings import Openings


def main() -> None:
    """Print one line for each step."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--hz", type=float, default=100.0)
    parser.add_argument("--rounds", type=int, default=1)
    parser.add_argument("--log", action="store_true", help="also print what the robot's relay says of each opening")
    given = parser.parse_args()
    print(machine())
    for _ in range(given.rounds):
        with tempfile.TemporaryDirectory() as name, Openings(Path(name), given.hz) as fleet:
            for one in fleet.steps():
                print(
                    f"{one.step:<32} sent {one.sent:5}  lost {one.lost}  doubled {one.doubled}  "
                    f"longest pause {1000 * one.longest_s:.0f} ms",
                    flush=True,
                )
            if given.log:
                print(*(line for line in fleet.hall.log("robot1").splitlines() if "opened anew" in line), sep="\n")


if __name__ == "__main__":
    main()
