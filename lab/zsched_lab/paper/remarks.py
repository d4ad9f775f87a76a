"""Says beside a report's tables what these cannot: runs that count wrongly, what was dropped, what was declared.

Knows: Markdown, a block's runs. Does not know: how a figure comes about, where in the report a remark stands.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from zsched_lab.paper.claims import LEAST_RUNS, Difference, declared
from zsched_lab.paper.scenario import MATRIX
from zsched_lab.paper.schemes import SCHEMES, Family
from zsched_lab.paper.tables import Json, losses_table

ENDED_SAY = (
    "Done, yet counted as not done, since the last robot's word came a moment after the end that was kept of the run"
)
DROPS_SAY = (
    "Of the task's streams, counted by the robots' relays since the daemons started. Lost: or at most lost. Dropped: "
    "taken by a relay, and thrown away for a reason; `cut` are the old owner's answers behind a move, in whose place "
    "the new owner's come. Schemes without any are left out."
)
JUDGED_SAY = "Better, or worse, is what has an interval clear of 0; the best fixed scheme is known only afterwards.\n"
WALLS_SAY = (
    "Share of the truth's walls that the newest merged map has where they are, mean over robots and time: a map whose "
    "parts lie in the wrong places knows as much as a right one."
)
DECLARED = (
    (
        "coverage_mean",
        "## Coverage on the way, as declared\n",
        f"Share of the truth that the newest merged map knows, mean over robots and time. {JUDGED_SAY}",
    ),
    (
        "walls_mean",
        "## Walls on the way\n",
        f"{WALLS_SAY} {JUDGED_SAY}",
    ),
)
"""(figure, heading, what it says) of the comparisons that were declared before their runs."""


def ended_text(runs: Sequence[Json], scenario: Json) -> str:
    """Which runs of before 2026-11-28 were done and count as not done; else empty.

    Only robots that hold the target end a run before its time. Such a run's end was taken a moment before the last
    robot's word was read, so that this word came after the end.
    """
    whole_s = float(scenario.get("duration_s", 0.0))
    ended = [one for one in runs if not one.get("is_done", True) and float(one.get("duration_s", whole_s)) < whole_s]
    told = []
    for figures in ended:
        name = figures["scheme"]
        own = [one for one in runs if one["scheme"] == name]
        done = sum(bool(one["is_done"]) for one in own) + sum(one["scheme"] == name for one in ended)
        told.append(f"run {figures['run']} of {name} ({figures['duration_s']:.1f} s; *done* is {done / len(own):.2f})")
    if not told:
        return ""
    return f"{ENDED_SAY}: {', '.join(told)}.\n"


def losses_text(groups: Mapping[str, Sequence[Json]]) -> str:
    """What was lost in the task's streams, and what was dropped, by reason."""
    return f"{DROPS_SAY}\n\n{losses_table(groups) or 'Nothing was lost or dropped.'}".rstrip() + "\n"


def declared_parts(groups: Mapping[str, Sequence[Json]], scenario: Json) -> list[str]:
    """What was declared before the runs of robots that are led, under its heading; nothing without any.

    There is no verdict before every declared run of a block is done.
    """
    parts = []
    for metric, heading, says in DECLARED:
        ours = [name for name, scheme in SCHEMES.items() if scheme.family is Family.OURS]
        tables = [table for name in ours if (table := _declared_table(groups, scenario, metric, name))]
        parts += [heading, says, *tables] if tables else []
    return parts


def _declared_table(groups: Mapping[str, Sequence[Json]], scenario: Json, metric: str, scheme: str) -> str:
    lines = []
    for title, runs in groups.items():
        block = scenario.get("blocks", {}).get(str(runs[0].get("block", MATRIX)) if runs else MATRIX, {})
        wanted = max(int(block.get("runs") or 0), LEAST_RUNS)
        for against, one in declared(runs, metric, scheme):
            cells = (title, against, f"{one.runs} of {wanted}", f"{one.mine:.3f}", f"{one.theirs:.3f}", one.text())
            lines.append(f"| {' | '.join(cells)} | {declared_verdict(one, wanted)} |")
    titles = ("where", f"{scheme} against", "runs", "its own", "theirs", "difference")
    head = [f"| {' | '.join(titles)} | {scheme} is |", "| --- " * (len(titles) + 1) + "|"]
    return "\n".join([*head, *lines]) + "\n" if lines else ""


def declared_verdict(one: Difference, wanted: int) -> str:
    """Whether ours covers more, by an interval that is clear of 0; nothing is said before all runs are done."""
    if one.runs < wanted:
        return "no verdict: too few runs"
    if one.low <= 0.0 <= one.high:
        return "not told apart"
    return "**better**" if one.low > 0.0 else "**worse**"
