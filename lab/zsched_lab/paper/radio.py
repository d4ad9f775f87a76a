"""Gives every link a drive to follow: a recorded one where there is a folder of them, else a simulated one.

Knows: the CSV of a drive, a radio model. Does not know: who uses the link, or how it is scored.

Simulated: log-distance path loss over a robot that drives to and fro, with correlated shadowing (Gudmundson,
Electronics Letters 27(23), 1991) and fast scatter of 2 dB, as seen in recorded drives. It is a stand-in and says so.
"""

from __future__ import annotations

import math
import random
from pathlib import Path

from zsched.core.values.errors import ConfigError
from zsched.core.values.model import NodeId
from zsched_lab.paper.scenario import Radio

STEP_S = 0.2
DRIVE_S = 300.0
LEG_S = 45.0
"""From one end of the drive to the other."""
NEAR_M, FAR_M = 3.0, 45.0
LOSS_EXPONENT, NEAR_DBM = 2.6, -42.0
SHADOW_DB, SHADOW_S = 5.0, 6.0
SCATTER_DB = 2.0


def simulated_drive(seed: str) -> str:
    """A drive as CSV (``time_stamp`` in ns, ``c_rssi`` in dBm); the same seed, the same drive."""
    generator = random.Random(seed)
    phase_s, shadow = generator.uniform(0.0, 2 * LEG_S), generator.gauss(0.0, SHADOW_DB)
    keep = math.exp(-STEP_S / SHADOW_S)
    rows = ["time_stamp,c_rssi"]
    for index in range(int(DRIVE_S / STEP_S)):
        along = abs((index * STEP_S + phase_s) / LEG_S % 2.0 - 1.0)
        metres = NEAR_M + along * (FAR_M - NEAR_M)
        shadow = keep * shadow + math.sqrt(1 - keep * keep) * generator.gauss(0.0, SHADOW_DB)
        dbm = NEAR_DBM - 10 * LOSS_EXPONENT * math.log10(metres / NEAR_M) + shadow + generator.gauss(0.0, SCATTER_DB)
        rows.append(f"{int((index + 1) * STEP_S * 1e9)},{min(max(round(dbm), -95), -20)}")
    return "\n".join(rows) + "\n"


def drive_file(node: NodeId, radio: Radio, drives: Path | None, folder: Path, seed: int) -> Path:
    """The file that ``node``'s link follows: the recorded drive, or a simulated one written into ``folder``.

    Raises:
        ConfigError: a folder of drives is given, and this one is not in it.
    """
    if drives is not None:
        path = (drives / radio.file).absolute()
        if not path.is_file():
            raise ConfigError(f"{path}: there is no such drive; give --drives the folder with {radio.file}")
        return path
    path = folder / f"drive-{node}.csv"
    path.write_text(simulated_drive(f"{seed}/{node}"), encoding="ascii")
    return path.absolute()
