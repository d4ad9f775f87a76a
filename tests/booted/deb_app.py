"""An application of a robot, inside the booted machine: numbers go in and come back, until it is told to end.

    deb_app.py ENDPOINT STOP REPORT

It publishes 50 a second until the file STOP is there, then waits for the answers that are missing, and writes REPORT.
"""

from __future__ import annotations

import json
import sys
import time
from itertools import pairwise
from pathlib import Path
from typing import Any

import zenoh

PERIOD_S = 0.02
WAIT_S = 60.0


def main(endpoint: str, stop: Path, report: Path) -> None:
    """Send until told to end, then say what came back."""
    config = zenoh.Config.from_json5(
        json.dumps(
            {
                "mode": "client",
                "connect": {"endpoints": [endpoint]},
                "scouting": {"multicast": {"enabled": False}},
                "transport": {"shared_memory": {"enabled": False}},
            }
        )
    )
    heard: list[tuple[int, float]] = []
    with zenoh.open(config) as session:
        session.declare_subscriber(
            "robot1/out", lambda sample: heard.append((int(sample.payload.to_bytes()), time.monotonic()))
        )
        into: Any = session.declare_publisher(
            "robot1/in",
            congestion_control=zenoh.CongestionControl.BLOCK,
            reliability=zenoh.Reliability.RELIABLE,
        )
        while not into.matching_status.matching:
            time.sleep(0.02)
        sent = 0
        while not stop.exists():
            into.put(str(sent).encode())
            sent += 1
            report.with_suffix(".now").write_text(str(len(heard)))
            time.sleep(PERIOD_S)
        until = time.monotonic() + WAIT_S
        while len({number for number, _ in heard}) < sent and time.monotonic() < until:
            time.sleep(0.05)
        numbers = [number for number, _ in heard]
        times = [when for _, when in heard]
        body = {
            "sent": sent,
            "missing": sorted(set(range(sent)) - set(numbers)),
            "doubled": len(numbers) - len(set(numbers)),
            "in_order": numbers == sorted(numbers),
            "longest_pause_s": round(max((after - before for before, after in pairwise(times)), default=0.0), 3),
        }
    report.with_suffix(".part").write_text(json.dumps(body))
    report.with_suffix(".part").rename(report)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]), Path(sys.argv[3]))
