"""Writes readme.md, the part of a bench's results for the README: what moves cost, what placing gains, every claim.

Knows: Markdown, what the README shows. Does not know: how a figure or a verdict comes about.
"""

from __future__ import annotations

from collections.abc import Sequence

from zsched_lab.paper.claims import Verdict, judged
from zsched_lab.paper.report import RANKED, floors_text, gains_text, groups_of, main_block, main_runs
from zsched_lab.paper.scenario import MATRIX
from zsched_lab.paper.tables import Json, mean_text


def snippet(results: Json, pictures: Sequence[str]) -> str:
    """What the README shows: what moves cost, where placing pays, the claims with verdicts, and a picture."""
    scenario, main = results["scenario"], main_runs(results)
    where = "the matrix" if main_block(results) == MATRIX else f"`{main_block(results)}`"
    outcomes = [outcome for _, _, outcome in judged(main)]
    judgeable = [outcome for outcome in outcomes if outcome not in (Verdict.NOT_MEASURED, Verdict.TOO_FEW)]
    kept = sum(outcome is not Verdict.NOT_REPRODUCED for outcome in judgeable)
    lines = [
        (
            f"`{results['command']}` (seed {scenario['seed']}, {len(results['runs'])} runs): "
            f"{kept} of {len(judgeable)} claims hold, {len(outcomes) - len(judgeable)} could not be judged."
        ),
        "",
        *([moved] if (moved := moves_text(results)) else []),
        *([table] if (table := gains_text(results, RANKED)) else []),
        f"| claim, in {where} | found, 95 % interval | verdict |",
        "| --- | --- | --- |",
    ]
    for claim, found, outcome in judged(main):
        lines.append(f"| {claim.source}: {claim.says} | {'-' if found is None else found.text()} | {outcome} |")
    lines += ["", *([floors] if (floors := floors_text({main_block(results): main})) else [])]
    if "gains.png" in pictures:
        lines += ["![What placing gains over fixed placement](docs/evaluation/gains.png)", ""]
    lines.append("All figures: [docs/evaluation/report.md](docs/evaluation/report.md).\n")
    return "\n".join(lines)


def moves_text(results: Json) -> str:
    """What moves cost zsched in every block that had any: the silence around them, and what was lost; else empty."""
    lines = ["| where | moves of zsched | silence, mean s | longest s | lost per move |", "| --- " * 5 + "|"]
    for title, runs in groups_of(results).items():
        own = [figures for figures in runs if figures["scheme"] == "zsched"]
        moves = sum(int(figures.get("moves") or 0) for figures in own)
        gaps = [float(figures["move_gap_max_s"]) for figures in own if figures.get("move_gap_max_s") is not None]
        if moves and gaps:
            cells = [
                mean_text([figures.get(name) for figures in own], 2) for name in ("move_gap_mean_s", "lost_per_move")
            ]
            lines.append(f"| {title} | {moves} in {len(own)} runs | {cells[0]} | {max(gaps):.2f} | {cells[1]} |")
    return "\n".join(lines) + "\n" if len(lines) > 2 else ""
