"""Writes report.md: what placing gains, every claim with its verdict, all schemes, the sweep, the blocks, the runs.

Knows: Markdown, which figure stands where. Does not know: how a figure or a verdict comes
about.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from zsched_lab.paper.claims import (
    CLAIMS,
    LEAST_RUNS,
    Difference,
    Verdict,
    better_than_ours,
    compared,
    judged,
    led,
    one_by_one,
    over,
    over_best_fixed,
    shared,
)
from zsched_lab.paper.coverage_report import coverage_parts
from zsched_lab.paper.plan import merge_text
from zsched_lab.paper.remarks import declared_parts, ended_text, losses_text
from zsched_lab.paper.scenario import MATRIX, MergeTask
from zsched_lab.paper.schemes import FIXED_SCHEMES, PAPER_SCHEMES, SCHEMES
from zsched_lab.paper.tables import (
    SMALL_COLUMNS,
    TITLES,
    Gains,
    Json,
    gains_table,
    head_of,
    known_columns,
    mean_text,
    scheme_rows,
    schemes_text,
)

PROMISE = (
    "For readers who want the figures: what placing gains, and for every claim of the paper and every goal of ours an "
    "interval and a verdict. docs/evaluation/README.md defines every figure; `results.json` has those of every run.\n"
)
PAIRED = "Differences are relative, between the same runs, with 95 % intervals (Student's t).\n"
NOT_COMPARED = (
    "Not measured: map frequency and accuracy of the network variant on the real robots. "
    "*Robot to robot* tells whether it follows the strongest signal.\n"
)
GAINS_SAY = (
    "Against the mean of the three fixed schemes. The oracle knows the load beforehand and is at the best node by "
    "Eq. 1 and 2 at every moment.\n"
)
MOVING_SAY = "zsched against schemes that move, too, in the runs that both have:\n"
EACH_SAY = "zsched against each other scheme, in the runs that both have:\n"
BEST_SAY = "zsched against the best fixed scheme of each figure, which is known only afterwards:\n"
COUNTED = {6: "six", 9: "nine"}
RANKED = ("zsched", "dyna_both", "oracle")
"""The schemes in the table of gains."""
EXHAUSTED = 0.95
"""Of a node's memory: beyond, the kernel reclaims what is in use."""
FOLLOWS_DB = 1.5
"""A task follows the strongest signal when it is no further under the best of every moment, and above any one robot."""
FOLLOWS_RULE = (
    f"(At most {FOLLOWS_DB:g} dB under the best robot of every moment, and above the best single one; one drive.)"
)


# --- the text --------------------------------------------------------------------------------------------------------


def report(results: Json, pictures: Sequence[str]) -> str:
    """The whole report."""
    scenario, main, groups = results["scenario"], main_runs(results), judged_groups(results)
    runs = in_block(results["runs"], main_block(results))
    placed = {"gains.png", "sweep.png", *(f"{name}.png" for name in scenario.get("blocks", {}))}
    others = [name for name in pictures if name not in placed]
    parts = [
        "# The paper's evaluation, by zsched\n",
        PROMISE,
        headline(results),
        PAIRED,
        *gains_parts(results, pictures),
        "## The claims\n",
        claims_text(groups),
        memory_text(main),
        NOT_COMPARED,
        "## No scheme of the paper better than ours?\n",
        better_text(groups),
        *declared_parts(groups_of(results), scenario),
        "## All schemes\n",
        uneven_text(main),
        ended_text(main, scenario),
        schemes_text(main),
        others_text(main),
        *coverage_parts(main),
        *[shown(name) for name in others],
        "## Strength of the injected load\n",
        sweep_text(runs, scenario),
        *[shown(name) for name in pictures if name == "sweep.png"],
        *blocks_parts(results, pictures),
        "## Lost and dropped messages\n",
        losses_text(groups_of(results)),
        "## What was run\n",
        conditions_text(results),
    ]
    if results.get("radio"):
        parts += ["## Robot to robot\n", radio_text(results["radio"])]
    return "\n".join(part for part in parts if part)


def shown(picture: str) -> str:
    """A picture, in Markdown."""
    return f"![{picture}]({picture})\n"


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


def judged_groups(results: Json) -> dict[str, list[Json]]:
    """{name: runs}: the main block, and every other block that is a whole matrix."""
    main = main_block(results)
    blocks = {name: in_block(results["runs"], name) for name in results["scenario"].get("blocks", {}) if name != main}
    return {main: main_runs(results)} | {name: own for name, own in blocks.items() if is_whole(own)}


def claims_text(groups: Mapping[str, Sequence[Json]]) -> str:
    """A row per claim: our difference and the verdict in every group."""
    titles = " | ".join(f"{name} | verdict" for name in groups)
    lines = [f"| from | claim | {titles} |", "| --- " * (2 + 2 * len(groups)) + "|"]
    found = [judged(runs) for runs in groups.values()]
    for index, claim in enumerate(CLAIMS):
        cells = [
            f"{'-' if one is None else one.text()} | **{outcome}**" for _, one, outcome in (g[index] for g in found)
        ]
        lines.append(f"| {claim.source} | {claim.says} | {' | '.join(cells)} |")
    counts = {one.runs for group in found for _, one, _ in group if one is not None}
    if counts:
        fewest, most = min(counts), max(counts)
        lines += ["", f"Paired runs of each claim: {fewest if fewest == most else f'{fewest} to {most}'}."]
    return "\n".join(lines) + "\n"


def gains_parts(results: Json, pictures: Sequence[str] = ()) -> list[str]:
    """What the `RANKED` schemes gain, under its heading; nothing without enough runs."""
    groups = groups_of(results)
    moving: Gains = {
        (title, name): over(runs, "zsched", (name,)) for title, runs in groups.items() for name in one_by_one(runs)
    }
    parts: list[str] = []
    if table := gains_text(results, RANKED):
        best = gains_table(("where",), {(title,): over_best_fixed(runs, "zsched") for title, runs in groups.items()})
        picture = [shown("gains.png")] if "gains.png" in pictures else []
        parts += [GAINS_SAY, table, *picture, BEST_SAY, best]
    if beside := gains_table(("where", "against"), moving):
        has_fixed = any(name in FIXED_SCHEMES for _, name in moving)
        parts += [EACH_SAY if has_fixed else MOVING_SAY, beside]
    return ["## Where placing pays\n", *parts] if parts else []


def gains_text(results: Json, schemes: Sequence[str]) -> str:
    """What the schemes, where they were run, gain over fixed placement in the matrix and in every block.

    Within a block the best one in merged maps stands first: each scheme stands where it stands.
    """
    rows: dict[tuple[str, ...], Mapping[str, Difference]] = {}
    for title, runs in groups_of(results).items():
        found = {scheme: over(runs, scheme) for scheme in schemes}
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


def better_text(groups: Mapping[str, Sequence[Json]]) -> str:
    """Where the paper's schemes beat ours, beyond the interval: a line per group."""
    lines = []
    for name, runs in groups.items():
        if sum(figures["scheme"] == "zsched" for figures in runs) < LEAST_RUNS:
            lines.append(f"* {name}: zsched was run less than {LEAST_RUNS} times: no verdict.")
            continue
        found = [f"{scheme} {TITLES[metric]} {one.text()}" for scheme, metric, one in better_than_ours(runs)]
        says = "; ".join(found) or f"none, on none of the {COUNTED[len(compared(runs))]} metrics, beyond the interval"
        lines.append(f"* {name}, against zsched: {says}.")
    return "\n".join(lines) + "\n"


def uneven_text(runs: Sequence[Json]) -> str:
    """What to mind where some schemes have more runs than others; else empty."""
    if len(shared(runs, "scheme")) == len(runs):
        return ""
    return (
        "Means over each scheme's runs. Where the numbers of runs differ, so do the worlds: compare by differences.\n"
    )


def others_text(runs: Sequence[Json]) -> str:
    """How far the schemes that the table of gains leaves out are from the mean of the fixed ones; empty without any."""
    rows: Gains = {(name,): over(runs, name) for name in SCHEMES if name not in (*FIXED_SCHEMES, *RANKED)}
    table = gains_table(("scheme",), rows)
    return f"The other schemes against the mean of the three fixed ones:\n\n{table}" if table else ""


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


def sweep_text(runs: Sequence[Json], scenario: Json) -> str:
    """The main figures of each scheme at every level, over the runs that all levels have."""
    metrics = (
        ("map_hz", "maps/s", 2),
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


def blocks_parts(results: Json, pictures: Sequence[str] = ()) -> list[str]:
    """Every block but the main one: a heading for each that has most schemes, one table for all others."""
    alone, notes, rows = [], [], []
    named = [name for name in results["scenario"].get("blocks", {}) if name != main_block(results)]
    small = [figures for name in named for figures in in_block(results["runs"], name)]
    columns = known_columns(small, SMALL_COLUMNS)
    for name in named:
        says = block_text(results, name)
        why = results.get("skipped", {}).get(name)
        own = comparable(in_block(results["runs"], name))
        if why or not own:
            notes.append(f"* `{name}`: {says}. {f'Left out: {why}' if why else 'Not run'}.")
        elif is_whole(own) or led(own):
            picture = [shown(f"{name}.png")] if f"{name}.png" in pictures else []
            alone += [f"## Block {name}\n", f"As the matrix, but for: {says}.\n"]
            alone += [ended_text(own, results["scenario"]), schemes_text(own), others_text(own)]
            alone += [*coverage_parts(own), *picture]
        else:
            notes.append(f"* `{name}`: {says}.")
            rows += scheme_rows(own, columns, f"| {name} ")
    if not notes:
        return alone
    table = "\n".join([*head_of(("block", "scheme"), columns), *rows]) + "\n"
    return [
        *alone,
        "## Other blocks\n",
        "As the matrix, but for:\n",
        "\n".join(notes) + "\n",
        *([table] if rows else []),
    ]


def block_text(results: Json, name: str) -> str:
    """What a block does otherwise than the matrix."""
    block = results["scenario"]["blocks"][name]
    rate = (block.get("links") or {}).get("bandwidth_mbit")
    world = f"world {block['world']}" if block.get("world") else "the matrix's worlds"
    links = "" if rate is None else f", every node sends at most {rate:g} Mbit/s"
    level = f", load {block['level']}" if block.get("level") else ""
    merge = {**results["scenario"]["merge"], **(block.get("merge") or {})}
    task = f", {merge_text(MergeTask(**merge))}" if block.get("merge") else ""
    return f"{world}{links}{level}{task}"


def is_whole(runs: Sequence[Json]) -> bool:
    """Whether the runs of a block can be judged as the matrix is."""
    schemes = (*FIXED_SCHEMES, *PAPER_SCHEMES, "zsched")
    counts = [sum(bool(figures["scheme"] == name) for figures in runs) for name in schemes]
    return min(counts) >= LEAST_RUNS


def conditions_text(results: Json) -> str:
    """Shares, levels, limits, and what was invalid."""
    scenario = results["scenario"]
    shares = [
        f"{node} {s['cpu_cores']:g} cores (and {s.get('overhead_cores', 0.0):g} for zsched, "
        f"{s.get('work_cores', 0.0):g} for what programs take beyond their shares), {s['memory_mb']:g} MiB, "
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
        f"* Load levels: {'; '.join(levels)}. Block `{main_block(results)}` ran at {main_level(results)}.",
        f"* Merging: {merge_text(MergeTask(**scenario['merge']))}; done at coverage {scenario['target_coverage']:g}.",
        f"* Links: {', '.join(sorted({f['links'] for f in results['runs']})) or '-'} drives.",
        f"* Warm-up before the drive: {scenario.get('warm_up_s', 0.0):g} s.",
        f"* Pressure outside the quotas: at most {scenario['pressure_limit']:g} allowed, at most {worst} seen.",
    ]
    for name, says in (("version", "Program"), ("machine", "Machine")):  # runs may be made on several days
        kinds = Counter(str(figures.get(name) or "not kept") for figures in results["runs"])
        told = "; ".join(f"{kind}: {count} runs" for kind, count in sorted(kinds.items()))
        lines.append(f"* {says}: {told or '-'}.")
    broken = results.get("interrupted", ())
    lines += [f"* Broken off or failed, and made again: {', '.join(broken)}."] if broken else []
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
    verdicts = []
    for name in ("dyna_net", "zsched"):
        row = radio["schemes"].get(name)
        if row is not None:
            is_best = row["under_best_db"] <= FOLLOWS_DB and row["mean_dbm"] > radio["best_fixed_dbm"]
            verdicts.append(f"{name}: **{Verdict.REPRODUCED if is_best else Verdict.NOT_REPRODUCED}**")
    if verdicts:
        lines += ["", f"The task follows the strongest signal, says the paper: {', '.join(verdicts)}. {FOLLOWS_RULE}"]
    return "\n".join([*lines, "", shown(radio["picture"])])
