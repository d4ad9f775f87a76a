"""Builds the ground truth of a log in a process of its own, gently, while the fleet runs: ``LOG OUT.cdr``.

Knows: a laser log, the file to write. Does not know: robots, merging, figures.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

from zsched.tasks.map_merge.cdr import encode_grid
from zsched_lab.maps.laser_log import load_log
from zsched_lab.maps.mapping import truth_grid


def main(arguments: list[str] | None = None) -> int:
    """Entry point: 0 when the truth is written, 2 on wrong usage."""
    given = sys.argv[1:] if arguments is None else arguments
    if len(given) != 2:
        sys.stderr.write("usage: python -m zsched_lab.maps.truth LOG OUT.cdr\n")
        return 2
    os.nice(19)
    log, out = Path(given[0]), Path(given[1])
    payload = encode_grid(truth_grid(load_log(log)))
    # A process that waits for the file must never see half of it.
    half = out.with_suffix(".part")
    half.write_bytes(payload)
    half.rename(out)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
