"""Writes report.md: every claim beside our figure, all schemes, the sweep over load, the blocks, what was run and how.

Knows: Markdown, which figure stands where. Does not know: how a figure or a verdict comes
about.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from zsched_lab.paper.claims import (
    GAINS,
    LEAST_RUNS,
    Claim,
    Difference,
    Verdict,
    best_fixed,
    better_than_ours,
    judged,
    over_best_fixed,
    over_fixed,
    shared,
)
from zsched_lab.paper.coverage_report import coverage_parts
from zsched_lab.paper.plan import merge_text
from zsched_lab.paper.scenario import MATRIX, MergeTask
from zsched_lab.paper.schemes import FIXED_SCHEMES, PAPER_SCHEMES, SCHEMES

Json = Mapping[str, Any]
Gains = Mapping[tuple[str, ...], Mapping[str, Difference]]
"""{names of a row: {metric: difference}}."""
NOT_COMPARED = (
    "Not measured: better map frequency and accuracy of the network variant on the real robots (they replay a log "
    "here). That it follows the strongest signal is under *Robot to robot*.\n"
)
GAINS_SAY = (
    "Against the mean of the three fixed schemes, same runs, 95 %. The oracle knows the load beforehand and is at the "
    "best node by Eq. 1 and 2 at every moment.\n"
)
EXHAUSTED = 0.95
"""Of a node's memory: beyond, the kernel reclaims what is in use."""
FOLLOWS_DB = 1.5
"""A task follows the strongest signal when it is no further under the best of every moment, and above any one robot."""
FOLLOWS_RULE = (
    f"(At most {FOLLOWS_DB:g} dB under the best robot of every moment, and above the best single one; one drive.)"
)
COLUMNS = (
    ("map_hz", "maps/s", 2),
    ("throughput_mb_s", "MB/s", 1),
    ("received_mb_s", "received MB/s", 2),
    ("mb_per_map", "MB/map", 2),
    ("task_latency_s", "task s", 1),
    ("is_done", "done", 2),
    ("merge_latency_p50_s", "p50 s", 2),
    ("merge_latency_p95_s", "p95 s", 2),
    ("merge_latency_p99_s", "p99 s", 2),
    ("cpu_peak", "CPU peak", 2),
    ("cpu_mean", "CPU mean", 2),
    ("memory_mean", "mem mean", 2),
    ("memory_peak", "mem peak", 2),
    ("ssim_rebased", "SSIM", 3),
    ("held_ssim_rebased", "SSIM held", 3),
    ("wall_f1", "wall F1", 3),
    ("coverage", "coverage", 3),
    ("coverage_mean", "covered on the way", 3),
    ("stopped_ratio", "stood", 2),
    ("moves", "moves", 1),
    ("wasted_moves", "wasted", 1),
    ("other_moves", "moves of others", 1),
    ("move_gap_mean_s", "gap s", 2),
    ("move_gap_max_s", "max gap s", 2),
    ("lost_per_move", "lost/move", 1),
    ("regret", "regret", 3),
    ("ssim_crop", "<sub>plain SSIM</sub>", 3),
)


FLOORS = {MATRIX: -0.10, "heavy": -0.17, "heavy_again": -0.17}
"""{block: the task latency of a merger that costs nothing, against fixed placement}, no scheduler can gain more there.

`zsched_lab.paper.latency_floor` printed them of docs/evaluation/results.json."""


# --- the text --------------------------------------------------------------------------------------------------------


def report(results: Json, pictures: Sequence[str]) -> str:
    """The whole report."""
    scenario, main = results["scenario"], main_runs(results)
    runs = in_block(results["runs"], main_block(results))
    parts = [
        "# The paper's evaluation, by zsched\n",
        headline(results),
        "Definitions of every figure: [docs/evaluation/README.md](README.md). Intervals: 95 %, paired, Student's t.\n",
        "## The claims\n",
        claims_text(main),
        memory_text(main),
        NOT_COMPARED,
        *gains_parts(results),
        "## No scheme of the paper better than ours?\n",
        better_text(main),
        "## All schemes\n",
        schemes_text(main),
        over_fixed_text(main),
        *coverage_parts(main),
        *same_runs_parts(main),
        "## Strength of the injected load\n",
        sweep_text(runs, scenario),
        *blocks_parts(results),
        "## What was run\n",
        conditions_text(results),
    ]
    parts += [f"![{name}]({name})\n" for name in pictures]
    if results.get("radio"):
        parts += ["## Robot to robot\n", radio_text(results["radio"])]
    return "\n".join(parts)


def in_block(runs: Sequence[Json], block: str) -> list[Json]:
    """The runs of one block."""
    return [figures for figures in runs if figures.get("block", MATRIX) == block]


def main_runs(results: Json) -> list[Json]:
    """The runs that are judged: those of the main block, or the matrix's own, without the sweep."""
    main, level = main_block(results), main_level(results)
    return [figures for figures in in_block(results["runs"], main) if figures["level"] == level]


def main_block(results: Json) -> str:
    """The block whose runs are judged; `MATRIX` for the matrix."""
    return str(results["scenario"].get("main", MATRIX))


def main_level(results: Json) -> str:
    """At which level these are."""
    scenario = results["scenario"]
    block = scenario.get("blocks", {}).get(main_block(results), {})
    return str(block.get("level") or scenario["level"])


def headline(results: Json) -> str:
    """What was run, in a few lines."""
    scenario = results["scenario"]
    what = f"scenario `{scenario['name']}`, seed {scenario['seed']}, input {results['input']}"
    count = f"{len(results['runs'])} runs that count, {len(results['invalid'])} invalid ones"
    return f"`{results['command']}`: {what}, {count}. zsched {results['version']}, {results['machine']}.\n"


def claims_text(runs: Sequence[Json]) -> str:
    """Each claim beside our figure."""
    lines = ["| from | claim | figure | ours | against | difference | runs | verdict |", "| --- " * 8 + "|"]
    for claim, found, outcome in judged(runs):
        says = claim.says + floor_text(claim, runs)
        shown = (
            "- | - | - | 0"
            if found is None
            else f"{found.mine:.3g} | {found.theirs:.3g} | {found.text()} | {found.runs}"
        )
        lines.append(f"| {claim.source} | {says} | {claim.metric} | {shown} | **{outcome}** |")
    return "\n".join(lines) + "\n"


def floor_text(claim: Claim, runs: Sequence[Json]) -> str:
    """What stands beside a goal for the task latency: how much of it is within any scheduler's reach."""
    block = next((str(figures.get("block", MATRIX)) for figures in runs), "")
    floor = FLOORS.get(block) if claim.metric == "task_latency_s" else None
    return (
        ""
        if floor is None
        else f" (out of reach here: a merger that costs nothing gains {-floor:.0%})".replace("%", " %")
    )


def gains_parts(results: Json) -> list[str]:
    """What zsched and the oracle gain, under its heading; nothing without enough runs."""
    table = gains_text(results, ("zsched", "oracle"))
    return ["## Where placing pays\n", GAINS_SAY, table] if table else []


def gains_text(results: Json, schemes: Sequence[str]) -> str:
    """What the schemes, where they were run, gain over fixed placement in the matrix and in every block.

    Within a block the best one in merged maps stands first: each scheme stands where it stands.
    """
    rows: dict[tuple[str, ...], Mapping[str, Difference]] = {}
    for title, runs in groups_of(results).items():
        found = {scheme: over_fixed(runs, scheme) for scheme in schemes}
        for scheme in sorted(found, key=lambda name: -found[name]["map_hz"].value if "map_hz" in found[name] else 0.0):
            rows[title, scheme] = found[scheme]
    return gains_table(("where", "scheme"), rows)


def groups_of(results: Json) -> dict[str, list[Json]]:
    """{title: runs}: the matrix and every block that was run."""
    scenario, main = results["scenario"], main_runs(results)
    blocks = {name: in_block(results["runs"], name) for name in scenario.get("blocks", {})}
    if main_block(results) != MATRIX:
        return {name: own for name, own in blocks.items() if own}
    return {f"matrix ({scenario['level']})": main} | {name: own for name, own in blocks.items() if own}


def better_text(runs: Sequence[Json]) -> str:
    """Where the paper's schemes beat ours, beyond the interval."""
    if sum(figures["scheme"] == "zsched" for figures in runs) < LEAST_RUNS:
        return f"zsched was run less than {LEAST_RUNS} times: no verdict.\n"
    found = better_than_ours(runs)
    if not found:
        return "None is, on none of the six metrics, beyond the interval.\n"
    return "\n".join(f"* {scheme}: {metric} {one.text()} against zsched" for scheme, metric, one in found) + "\n"


def schemes_text(runs: Sequence[Json]) -> str:
    """One row per scheme: means over its runs."""
    columns = [column for column in COLUMNS if any(figures.get(column[0]) is not None for figures in runs)]
    lines = [
        "| scheme | runs | " + " | ".join(title for _, title, _ in columns) + " |",
        "| --- " * (len(columns) + 2) + "|",
    ]
    for name in SCHEMES:
        own = [figures for figures in runs if figures["scheme"] == name]
        if own:
            cells = [mean_text([figures.get(metric) for figures in own], digits) for metric, _, digits in columns]
            lines.append(f"| {name} | {len(own)} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def over_fixed_text(runs: Sequence[Json]) -> str:
    """How far the dynamic schemes are from the mean of the fixed ones, zsched from each; empty without runs enough."""
    to_mean: Gains = {(name,): over_fixed(runs, name) for name in SCHEMES if name not in FIXED_SCHEMES}
    to_best: Gains = {(name,): over_best_fixed(runs, name) for name in SCHEMES if name not in FIXED_SCHEMES}
    to_each: Gains = {(name,): over_fixed(runs, "zsched", (name,)) for name in FIXED_SCHEMES}
    told = (
        ("Against the mean of the three fixed schemes, same runs, 95 %:\n", "scheme", to_mean),
        (f"Against the best fixed scheme, chosen in hindsight by {best_text(runs)}:\n", "scheme", to_best),
        ("zsched against each of them:\n", "against", to_each),
    )
    return "\n".join(f"{says}\n{table}" for says, who, rows in told if (table := gains_table((who,), rows)))


def best_text(runs: Sequence[Json]) -> str:
    """Which fixed scheme is the best one of each figure.

    >>> best_text([])
    'nothing'
    """
    heads = {metric: title for metric, title, _ in COLUMNS}
    best = {heads[metric]: name for metric in GAINS if (name := best_fixed(runs, metric)) is not None}
    return ", ".join(f"{title}: {name}" for title, name in best.items()) or "nothing"


def gains_table(titles: Sequence[str], rows: Gains) -> str:
    """Rows of differences in `GAINS`, those without any left out; ``titles`` head their names. Empty without rows."""
    known = {names: found for names, found in rows.items() if found}
    metrics = [metric for metric in GAINS if any(metric in found for found in known.values())]
    if not known:
        return ""
    heads = {metric: title for metric, title, _ in COLUMNS}
    lines = [
        f"| {' | '.join(titles)} | runs | " + " | ".join(heads[metric] for metric in metrics) + " |",
        "| --- " * (len(titles) + 1 + len(metrics)) + "|",
    ]
    for names, found in known.items():
        cells = [found[metric].text() if metric in found else "-" for metric in metrics]
        lines.append(f"| {' | '.join(names)} | {min(one.runs for one in found.values())} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def same_runs_parts(runs: Sequence[Json]) -> list[str]:
    """The table again over the runs that every scheme has, where some have more: each run has a world of its own."""
    common = shared(runs, "scheme")
    if not common or len(common) == len(runs):
        return []
    numbers = ", ".join(str(number + 1) for number in sorted({int(figures["run"]) for figures in common}))
    return [f"Only the runs that every scheme has ({numbers}), so that rows compare:\n", schemes_text(common)]


def comparable(runs: Sequence[Json]) -> Sequence[Json]:
    """The runs that every scheme has, so that rows compare; all of them where there is none."""
    return shared(runs, "scheme") or runs


def memory_text(runs: Sequence[Json]) -> str:
    """The paper's "none of the servers exhausted their memory": the highest share that any node of a run reached."""
    highest = {}
    for title, schemes in (("the paper's variants", PAPER_SCHEMES), ("zsched", ("zsched",)), ("fixed", FIXED_SCHEMES)):
        peaks = [
            float(node["memory_peak"])
            for figures in runs
            if figures["scheme"] in schemes
            for node in figures["nodes"].values()
            if node.get("memory_peak") is not None
        ]
        if peaks:
            highest[title] = max(peaks)
    if not highest:
        return ""
    shown = ", ".join(f"{title} {peak:.2f}" for title, peak in highest.items())
    told = f"No server exhausted its memory, says the paper. The highest share at any node in any run: {shown}."
    variants = highest.get("the paper's variants")
    if variants is None:
        return told + "\n"
    outcome = Verdict.REPRODUCED if variants < EXHAUSTED else Verdict.NOT_REPRODUCED
    same = " (but so it is under fixed placement)" if highest.get("fixed", 1.0) < EXHAUSTED else ""
    return f"{told} **{outcome}**{same}.\n"


def mean_text(values: Sequence[float | None], digits: int) -> str:
    """The mean of what was measured; a dash for nothing."""
    known = [float(value) for value in values if value is not None]
    return f"{statistics.fmean(known):.{digits}f}" if known else "-"


def sweep_text(runs: Sequence[Json], scenario: Json) -> str:
    """The main figures of each scheme at every level, over the runs that all levels have."""
    metrics = (
        ("map_hz", "maps/s", 2),
        ("throughput_mb_s", "MB/s", 1),
        ("task_latency_s", "task s", 1),
        ("regret", "regret", 3),
    )
    runs = shared(runs, "level", "scheme")
    levels = [level for level in scenario["levels"] if any(figures["level"] == level for figures in runs)]
    if len(levels) < 2:
        return "Only one level was run.\n"
    swept = [
        name for name in SCHEMES if all(any(f["scheme"] == name and f["level"] == lv for f in runs) for lv in levels)
    ]
    lines = ["| metric | scheme | " + " | ".join(levels) + " |", "| --- " * (len(levels) + 2) + "|"]
    for metric, title, digits in metrics:
        for name in swept:
            cells = [
                mean_text([f.get(metric) for f in runs if f["scheme"] == name and f["level"] == lv], digits)
                for lv in levels
            ]
            lines.append(f"| {title} | {name} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def blocks_parts(results: Json) -> list[str]:
    """Each block's table under its own heading, or why there is none."""
    parts = []
    for name, block in results["scenario"].get("blocks", {}).items():
        if name == main_block(results):
            continue  # its tables stand where the matrix's would
        rate = (block.get("links") or {}).get("bandwidth_mbit")
        world = f"world {block['world']}" if block.get("world") else "the matrix's worlds"
        links = "" if rate is None else f", every node sends at most {rate:g} Mbit/s"
        level = f", load {block['level']}" if block.get("level") else ""
        merge = {**results["scenario"]["merge"], **(block.get("merge") or {})}
        task = f", {merge_text(MergeTask(**merge))}" if block.get("merge") else ""
        why = results.get("skipped", {}).get(name)
        own = comparable(in_block(results["runs"], name))
        shown = "\n".join((schemes_text(own), over_fixed_text(own), *coverage_parts(own), *judged_parts(own)))
        text = f"Left out: {why}.\n" if why else shown if own else "Not run.\n"
        parts += [f"## Block {name}\n", f"As the matrix, but for: {world}{links}{level}{task}.\n", text]
    return parts


def is_whole(runs: Sequence[Json]) -> bool:
    """Whether the runs of a block can be judged as the matrix is."""
    schemes = (*FIXED_SCHEMES, *PAPER_SCHEMES, "zsched")
    counts = [sum(bool(figures["scheme"] == name) for figures in runs) for name in schemes]
    return min(counts) >= LEAST_RUNS


def judged_parts(runs: Sequence[Json]) -> list[str]:
    """The claims again, for a block that has every scheme of the paper and enough runs; else nothing."""
    if not is_whole(runs):
        return []
    return ["The claims, here:\n", claims_text(runs), "Schemes of the paper better than ours:\n", better_text(runs)]


def conditions_text(results: Json) -> str:
    """Shares, levels, limits, and what was invalid."""
    scenario = results["scenario"]
    shares = [
        f"{node} {s['cpu_cores']:g} cores (and {s.get('overhead_cores', 0.0):g} for zsched), {s['memory_mb']:g} MiB, "
        f"ballast {s['ballast_mb']:g} MiB"
        for node, s in scenario["nodes"].items()
    ]
    levels = [
        f"{name}: {v['streams']} x {v['share'] or 'all'} of an edge, frames of {v['side']} px"
        for name, v in scenario["levels"].items()
    ]
    waits = [figures["host"]["pressure"] for figures in results["runs"] if figures["host"]["pressure"] is not None]
    worst = f"{max(waits):.2f}" if waits else "not measured"
    lines = [
        f"* Nodes: {'; '.join(shares) or 'no shares'}.",
        f"* Load levels: {'; '.join(levels)}. {main_block(results).capitalize()} was run at {main_level(results)}.",
        f"* Merging: {merge_text(MergeTask(**scenario['merge']))}; done at coverage {scenario['target_coverage']:g}.",
        f"* Links: {', '.join(sorted({f['links'] for f in results['runs']})) or '-'} drives.",
        f"* Warm-up before the drive: {scenario.get('warm_up_s', 0.0):g} s.",
        f"* Pressure outside the quotas: at most {scenario['pressure_limit']:g} allowed, at most {worst} seen.",
    ]
    missing = results.get("missing", ())
    lines += [f"* No valid run of {len(missing)} cells: {', '.join(missing)}."] if missing else []
    lines += [f"* Repeated: {one['cell']}: {one['reason'].splitlines()[0]}" for one in results["invalid"]]
    return "\n".join(lines) + "\n"


def radio_text(radio: Json) -> str:
    """What each scheme made of the radio: moves, and the signal of the robot that held the task."""
    lines = [
        f"Three robots, no edges, the radio alone counts; {radio['links']} drives, {radio['duration_s']:.0f} s.",
        f"Best robot at every moment {radio['best_dbm']:.1f} dBm, best single one {radio['best_fixed_dbm']:.1f} dBm.\n",
        "| scheme | moves | wasted | owner's signal, dBm | under the best | time below -70 dBm |",
        "| --- " * 6 + "|",
    ]
    for name, row in radio["schemes"].items():
        lines.append(
            f"| {name} | {row['moves']} | {row['wasted_moves']} | {row['mean_dbm']:.1f} | "
            f"{row['under_best_db']:.1f} dB | {row['below_70_ratio']:.0%} |".replace("%", " %")
        )
    for name in ("dyna_net", "zsched"):
        row = radio["schemes"].get(name)
        if row is not None:
            is_best = row["under_best_db"] <= FOLLOWS_DB and row["mean_dbm"] > radio["best_fixed_dbm"]
            outcome = Verdict.REPRODUCED if is_best else Verdict.NOT_REPRODUCED
            lines += [
                "",
                f"The task follows the strongest signal, says the paper: {name}: **{outcome}**. {FOLLOWS_RULE}",
            ]
    return "\n".join([*lines, "", f"![{radio['picture']}]({radio['picture']})\n"])
