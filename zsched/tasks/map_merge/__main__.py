"""``python -m zsched.tasks.map_merge``: reads the arguments and starts the map-merging worker.

Knows: arguments, exit codes. Does not know: maps. numpy and OpenCV are only imported after their thread counts are set.

Exit codes: 0 told to stop, 2 usage, 78 bad poses or environment.
"""

from __future__ import annotations

import argparse
import logging
import os
import sys
from collections.abc import Sequence
from pathlib import Path

from zsched.core.values.errors import ConfigError
from zsched.core.values.exits import EXIT_CONFIG


def _positive(text: str) -> float:
    value = float(text)
    if not 0.0 < value < 1e6:
        raise argparse.ArgumentTypeError(f"{text} is not a positive number")
    return value


def _ratio(text: str) -> float:
    value = float(text)
    if not 0.0 <= value <= 1.0:
        raise argparse.ArgumentTypeError(f"{text} is not in [0, 1]")
    return value


def metres_per_cell(text: str) -> float:
    """A map's resolution off a command line, in [0.01, 1] m. Raises what argparse understands."""
    value = float(text)
    if not 0.01 <= value <= 1.0:
        raise argparse.ArgumentTypeError(f"{text} is not in [0.01, 1] metres per cell")
    return value


def parser() -> argparse.ArgumentParser:
    """The arguments of the worker."""
    arguments = argparse.ArgumentParser(
        prog="python -m zsched.tasks.map_merge", description="Merge the occupancy grids of several robots."
    )
    add = arguments.add_argument
    add("--mode", choices=("known", "track", "estimate"), default="estimate", help="how transforms come about")
    add("--pose", action="append", default=[], metavar="ROBOT=X,Y,YAW", help="pose of a robot's map frame (m, rad)")
    add("--poses", type=Path, metavar="FILE", help="poses as YAML or JSON: {robot1: [x, y, yaw]}")
    add("--resolution", type=metres_per_cell, default=0.05, help="of the merged map, metres per cell (0.05)")
    add("--rate", type=_positive, default=4.0, help="merges per second at most (4)")
    add("--threads", type=int, choices=range(1, 65), default=1, metavar="N", help="threads of OpenCV and BLAS (1)")
    add("--world-frame", default="world", help="frame_id of the merged map (world)")
    add("--min-score", type=_ratio, default=0.75, help="accept an alignment from this score on (0.75)")
    add("--min-agreeing", type=int, default=600, help="... and this number of agreeing wall cells of 0.05 m (600)")
    add("--min-margin", type=_positive, default=1.3, help="... and this margin over the next place that fits (1.3)")
    add("--ros2", action="store_true", help="hang rmw_zenoh's attachment on the map and the transforms, for ROS nodes")
    add("--standalone", action="store_true", help="run without a daemon, as the owner on node 'local'")
    return arguments


def main(argv: Sequence[str] | None = None) -> int:
    """Run until told to stop; returns the exit code."""
    options = parser().parse_args(argv)
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = str(options.threads)
    logging.basicConfig(level=logging.INFO, stream=sys.stderr, format="%(name)s: %(message)s")
    from zsched.tasks.map_merge.runner import run  # noqa: PLC0415 - numpy reads the thread counts when it is imported

    try:
        run(options)
    except ConfigError as error:
        print(error, file=sys.stderr)
        return EXIT_CONFIG
    return 0


if __name__ == "__main__":
    sys.exit(main())
