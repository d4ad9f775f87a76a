"""Where the shipped scenarios are: beside the package's data, as links to configs/lab.

Knows: file names. Does not know: what is in them.
"""

from __future__ import annotations

from pathlib import Path

DATA = Path(__file__).parents[1] / "data"


def scenario_path() -> Path:
    """The paper's simulation: three robots, three edges."""
    return DATA / "paper.scenario.yml"


def robots_scenario_path() -> Path:
    """The paper's real-world demonstration: three robots, no edges."""
    return DATA / "paper-robots.scenario.yml"
