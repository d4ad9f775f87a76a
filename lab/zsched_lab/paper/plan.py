"""Tells before anything runs what a bench will do and how long it takes, and what cannot be run on this machine.

Knows: the blocks' sizes, how long a run lasts at most. Does not know: how anything is run.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

from zsched_lab.paper.cells import Cell, bandwidth_of, merge_of, world_of
from zsched_lab.paper.scenario import MATRIX, MergeTask, Scenario

AROUND_S = 18.0
"""Of a run, before and after the robots' drive, on two cores: daemons, first owner, last maps, figures."""
NARROW_S = 4.0
"""What a run behind narrow links takes more: namespaces, and daemons that start side by side."""
NO_WORLD = "its world is only for robots that explore (--input explore)"


def without(scenario: Scenario, *, is_exploring: bool, why_not: Callable[[], str | None]) -> dict[str, str]:
    """{block: why it cannot be run}; ``why_not`` says why there can be no namespaces and is only asked when needed."""
    skipped = {}
    for name, block in scenario.blocks.items():
        if (block.world is not None or name == scenario.main) and not is_exploring:
            skipped[name] = NO_WORLD
        elif block.links.bandwidth_mbit is not None and (why := why_not()) is not None:
            skipped[name] = f"no network namespaces: {why}"
    return skipped


def leave_out(scenario: Scenario, skipped: Mapping[str, str]) -> Scenario:
    """The scenario without these blocks."""
    return replace(scenario, blocks={name: block for name, block in scenario.blocks.items() if name not in skipped})


def cell_s(scenario: Scenario, cell: Cell) -> float:
    """How long a cell lasts at most, in seconds, unless it is repeated."""
    return (
        scenario.duration_s
        + scenario.warm_up_s
        + AROUND_S
        + (0.0 if bandwidth_of(scenario, cell) is None else NARROW_S)
    )


def plan_text(
    scenario: Scenario,
    cells: Sequence[Cell],
    todo: Sequence[Cell],
    radio_s: float,
    skipped: Mapping[str, str],
    world: str | None,
) -> str:
    """The plan for people; ``world`` names the log where robots do not explore, ``radio_s`` is for robots alone."""
    rows = ["block           runs  at most  what", *_rows(scenario, cells, world)]
    if radio_s > 0:
        rows.append(f"{'robots alone':<15} {'':>4}  {clock(radio_s):>7}  three robots, no edges, the radio decides")
    rows += [f"{name:<15} {0:>4}  {'-':>7}  left out: {why}" for name, why in skipped.items()]
    left = sum(cell_s(scenario, cell) for cell in todo) + radio_s
    done = "" if len(todo) == len(cells) else f", {len(cells) - len(todo)} of them done already"
    cores = sum(share.quota_cores for share in scenario.nodes.values())
    rows.append(f"{len(cells)} runs{done}; at most {clock(left)} on two cores, without repeats")
    warm = f"{clock(scenario.warm_up_s)} of warm-up in every run; " if scenario.warm_up_s > 0.0 else ""
    rows.append(f"{warm}quotas {cores:g} cores in all; a run over pressure {scenario.pressure_limit:g} is repeated")
    return "\n".join(rows)


def _rows(scenario: Scenario, cells: Sequence[Cell], log: str | None) -> list[str]:
    """One row per block, and one per level of the matrix's own."""
    groups: dict[str, list[Cell]] = {}
    for cell in cells:
        groups.setdefault(cell.level if cell.block == MATRIX else cell.block, []).append(cell)
    rows = []
    for name, own in groups.items():
        schemes = dict.fromkeys(cell.scheme.name for cell in own)
        worlds = [log] if log else list(dict.fromkeys(world_of(scenario, cell) for cell in own))
        what = f"{len(schemes)} schemes, load {own[0].level}, {worlds[0]}" + (f" to {worlds[-1]}" if worlds[1:] else "")
        rate = bandwidth_of(scenario, own[0])
        what += "" if rate is None else f", links of {rate:g} Mbit/s"
        merge = merge_of(scenario, own[0])
        what += "" if merge == scenario.merge and scenario.main == MATRIX else f", {merge_text(merge)}"
        title = f"matrix ({name})" if name == scenario.level else name
        rows.append(f"{title:<15} {len(own):>4}  {clock(sum(cell_s(scenario, c) for c in own)):>7}  {what}")
    return rows


def merge_text(merge: MergeTask) -> str:
    """What the task is, for people.

    >>> merge_text(MergeTask())
    'mode known, at most 4 maps/s of 5 cm cells'
    """
    rule = "" if merge.min_agreeing == MergeTask().min_agreeing else f", joined at {merge.min_agreeing} wall cells"
    return f"mode {merge.mode}, at most {merge.rate_hz:g} maps/s of {merge.resolution_m * 100:g} cm cells{rule}"


def clock(seconds: float) -> str:
    """A duration for people.

    >>> clock(3725), clock(59)
    ('1 h 02 min', '59 s')
    """
    if seconds < 60:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes // 60} h {minutes % 60:02d} min" if minutes >= 60 else f"{minutes} min"
