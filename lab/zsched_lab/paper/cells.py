"""Which runs there are: the matrix by run and scheme, the sweep over the other levels, and the scenario's blocks.

Knows: a cell's name, what a block changes for it. Does not know: how a run is made, or whether it is done.

Cells are ordered by run, then scheme: whatever is done when somebody stops is balanced over the schemes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from zsched_lab.paper.scenario import MATRIX, MergeTask, Scenario
from zsched_lab.paper.schemes import Family, Scheme, find_schemes


@dataclass(frozen=True, slots=True, kw_only=True)
class Cell:
    """One run to be made."""

    scheme: Scheme
    level: str
    run: int
    block: str = MATRIX

    @property
    def name(self) -> str:
        """Its folder's name."""
        return cell_name(self.block, self.level, self.scheme.name, self.run)


def cell_name(block: str, level: str, scheme: str, run: int) -> str:
    """The name of a run's folder; ``run`` counts from 0."""
    return f"{level if block == MATRIX else block}-{scheme}-{run + 1}"


def cells_of(scenario: Scenario, names: tuple[str, ...], runs: int | None = None) -> tuple[Cell, ...]:
    """The matrix at the scenario's level, then the sweep over the other levels and the blocks, each by run and scheme.

    ``runs`` (``None``: the scenario's) bounds the runs of every scheme; with ``names`` sweep and blocks keep to them.

    Raises:
        ConfigError: an unknown scheme.
    """
    most = scenario.runs if runs is None else runs
    has_matrix = scenario.main == MATRIX
    cells = list(_by_run(scenario, find_schemes(names or scenario.schemes), most)) if has_matrix else []
    if has_matrix and (swept := _kept(scenario.sweep.schemes, names)):
        others = [level for level in scenario.levels if level != scenario.level]
        for run in range(min(scenario.sweep.runs, most)):
            cells += [Cell(scheme=s, level=level, run=run) for level in others for s in swept]
    for name, block in scenario.blocks.items():
        kept = _kept(block.schemes, names)
        for run in range(min(block.runs, most)):
            order = kept[::-1] if block.alternates and run % 2 else kept
            cells += [Cell(scheme=s, level=block.level or scenario.level, run=run, block=name) for s in order]
    return tuple(cells)


def _kept(schemes: tuple[str, ...], names: tuple[str, ...]) -> tuple[Scheme, ...]:
    kept = tuple(name for name in schemes if not names or name in names)
    return find_schemes(kept) if kept else ()


def _by_run(scenario: Scenario, schemes: Sequence[Scheme], most: int) -> Iterator[Cell]:
    for run in range(most):
        for scheme in schemes:
            if scheme.family is Family.YARDSTICK and run >= min(scenario.yardstick_runs, most):
                continue
            yield Cell(scheme=scheme, level=scenario.level, run=run)


def world_of(scenario: Scenario, cell: Cell) -> str:
    """The world that the cell's robots explore: the block's, else the scenario's, by the run's seed.

    Independent of the scheme, so that all schemes meet the same worlds.
    """
    block = scenario.blocks.get(cell.block)
    world = scenario.explore.world if block is None or block.world is None else block.world
    return world.replace("{seed}", str(scenario.run_seed(cell.run)))


def bandwidth_of(scenario: Scenario, cell: Cell) -> float | None:
    """What every node's link carries in Mbit/s; ``None``: no limit."""
    block = scenario.blocks.get(cell.block)
    return None if block is None else block.links.bandwidth_mbit


def merge_of(scenario: Scenario, cell: Cell) -> MergeTask:
    """What the task is in this cell."""
    block = scenario.blocks.get(cell.block)
    return scenario.merge if block is None else replace(scenario.merge, **block.merge)
