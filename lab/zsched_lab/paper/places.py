"""Where the shipped scenarios are: beside the package's data, as links to configs/lab.

Knows: file names. Does not know: what is in them.
"""

from __future__ import annotations

from pathlib import Path

DATA = Path(__file__).parents[1] / "data"


def scenario_path() -> Path:
    """The paper's simulation: three robots, three edges."""
    return DATA / "paper.scenario.yml"


def shipped_scenario(name: str) -> Path | None:
    """A shipped scenario by its name (``nano``); ``None``: there is none of that name."""
    path = DATA / f"{name}.scenario.yml"
    return path if name.isascii() and name.replace("-", "").isalnum() and path.is_file() else None


def shipped_names() -> tuple[str, ...]:
    """The names of all shipped scenarios with edges."""
    names = sorted(path.name.removesuffix(".scenario.yml") for path in DATA.glob("*.scenario.yml"))
    return tuple(name for name in names if name != robots_scenario_path().name.removesuffix(".scenario.yml"))


def robots_scenario_path() -> Path:
    """The paper's real-world demonstration: three robots, no edges."""
    return DATA / "paper-robots.scenario.yml"
