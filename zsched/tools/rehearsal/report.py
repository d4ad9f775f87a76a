"""What a rehearsal has found, as JSON (``zsched.rehearse/1``) and as one table.

Knows: rows, figures, PASS and FAIL. Does not know: how anything was measured.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Mapping, Sequence
from typing import Final

from zsched.commands.base.common import Json
from zsched.commands.base.page import cut
from zsched.commands.look.history import wall_text
from zsched.core.values.rehearsal import Promised, Step
from zsched.host.screen import wrapped
from zsched.tools.rehearsal.programme import TELLS_S, Over, Result

SCHEMA: Final = "zsched.rehearse/1"
COUNTS: Final = ("lost", "at most lost")
LEFT_OUT: Final = "left out"
HEADS: Final = ("STEP", "WHAT", "WHERE", "P50", "MAX", "N", "USUAL", "PROMISED", "RESULT")
WHERE: Final = HEADS.index("WHERE")


def as_json(
    *,
    name: str,
    at: float,
    asked: Json,
    order: Json,
    timing: str,
    promised: Mapping[Step, Promised],
    results: Sequence[Result],
    over: Over,
    way_back: str,
) -> Json:
    """The whole outcome; what is kept, and what ``--json`` prints."""
    return {
        "id": name,
        "at": wall_text(at),
        "by": asked["by"],
        "reason": asked["reason"],
        **order,
        "timing": timing,
        "is_kept": over.is_kept,
        "why": over.why,
        "way_back": way_back,
        "steps_done": [_step(result) for result in results],
        "rows": list(rows(results, promised)),
    }


def _step(result: Result) -> Json:
    return {
        "round": result.round,
        "step": result.step.value,
        "node": result.node,
        "taker": result.taker,
        "decide_s": _rounded(result.decide_s),
        "hand_over_s": _rounded(result.hand_over_s),
        "whole_s": _rounded(result.whole_s),
        "gaps": [
            {"robot": gap.robot, "stream": gap.stream, "usual_s": _rounded(gap.usual_s), "gap_s": _rounded(gap.gap_s)}
            for gap in result.gaps
        ],
        "lost": result.lost,
        "at_most_lost": result.at_most_lost,
        "doubled": result.doubled,
        "broken": list(result.broken),
        "left_out": result.left_out,
    }


def _rounded(seconds: float | None) -> float | None:
    return None if seconds is None else round(seconds, 4)


# --- rows ------------------------------------------------------------------------------------------------------------


def rows(results: Sequence[Result], promised: Mapping[Step, Promised]) -> Iterator[Json]:
    """One row per step and figure, over all rounds; times are seconds, a gap is what is more than usual."""
    for step in dict.fromkeys(result.step for result in results):
        of_step = [result for result in results if result.step is step]
        done = [result for result in of_step if not result.left_out]
        if not done:
            yield _row(step, LEFT_OUT, of_step[0].left_out, [], None, None)
            continue
        promise = promised[step]
        for robot, stream in sorted({(gap.robot, gap.stream) for result in done for gap in result.gaps}):
            gaps = [gap for result in done for gap in result.gaps if (gap.robot, gap.stream) == (robot, stream)]
            more = [gap.more_s for gap in gaps if gap.more_s is not None]
            yield _row(step, "gap", f"{robot} {stream}", more, max(gap.usual_s for gap in gaps), promise.gap_s)
        for what, values, limit in (
            ("decide", [one.decide_s for one in done], promise.decide_s),
            ("hand over", [one.hand_over_s for one in done], None),
            ("whole again", [one.whole_s for one in done], None),
        ):
            if known := [value for value in values if value is not None]:
                yield _row(step, what, "", known, None, limit)
        yield _counts(step, "lost", [one.lost for one in done], done, promise)
        yield _counts(step, "at most lost", [one.at_most_lost for one in done], done, None)


def _row(step: Step, what: str, where: str, values: Sequence[float], usual: float | None, limit: float | None) -> Json:
    has = bool(values)
    is_kept = None if limit is None or not has else max(values) <= limit + TELLS_S
    return {
        "step": step.value,
        "what": what,
        "where": where,
        "p50": _rounded(statistics.median(values)) if has else None,
        "max": _rounded(max(values)) if has else None,
        "n": len(values),
        "usual": _rounded(usual),
        "promised": _rounded(limit),
        "is_kept": is_kept,
    }


def _counts(step: Step, what: str, values: Sequence[int], done: Sequence[Result], promise: Promised | None) -> Json:
    row = _row(step, what, "", [float(value) for value in values], None, None)
    if promise is not None and promise.whole:
        row["where"] = ", ".join(promise.whole)
        row["promised"] = 0.0
        row["is_kept"] = not any("has lost" in text for result in done for text in result.broken)
    return row


# --- text ------------------------------------------------------------------------------------------------------------


def table(body: Json, width: int | None) -> str:
    """The outcome for people, in ``width`` columns; ``None``: as many as it takes.

    What was left out stands below, for why takes a sentence.
    """
    verdict = "every promise was kept" if body["is_kept"] else f"STOPPED: {body['why']}"
    head = (
        f"rehearsal {body['id']} of {body['task']}, {body['at']}, by {body['by']}, timing {body['timing']}: {verdict}"
    )
    played = [row for row in body["rows"] if row["what"] != LEFT_OUT]
    lines = list(_lines([HEADS, *map(_cells, played)], width)) if played else []
    left_out = [f"{row['step']} left out: {row['where']}" for row in body["rows"] if row["what"] == LEFT_OUT]
    told = [head, *lines, *left_out, str(body["way_back"])]
    return "\n".join(told if width is None else [wrapped(line, width) for line in told]) + "\n"


def _lines(cells: Sequence[tuple[str, ...]], width: int | None) -> Iterator[str]:
    """The cells as columns; where they are too wide, columns are closer, and what WHERE says is cut."""
    widths = [max(len(line[at]) for line in cells) for at in range(len(HEADS))]
    gap = "  "
    if width is not None and sum(widths) + len(gap) * (len(widths) - 1) > width:
        gap = " "
        rest = sum(widths) - widths[WHERE] + len(widths) - 1
        widths[WHERE] = min(widths[WHERE], max(width - rest, len(HEADS[WHERE])))
    for line in cells:
        yield gap.join(cut(cell, wide).ljust(wide) for cell, wide in zip(line, widths, strict=True)).rstrip()


def _cells(row: Json) -> tuple[str, ...]:
    is_count = row["what"] in COUNTS
    told = _count if is_count else _seconds
    result = {True: "PASS", False: "FAIL", None: "-"}[row["is_kept"]]
    limit = "-" if row["promised"] is None else f"{'' if is_count else '<= '}{told(row['promised'])}"
    n = str(row["n"] or "-")
    return (
        row["step"],
        row["what"],
        row["where"],
        told(row["p50"]),
        told(row["max"]),
        n,
        told(row["usual"]),
        limit,
        result,
    )


def _count(value: float | None) -> str:
    return "-" if value is None else f"{value:g}"


def _seconds(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value * 1000:.0f} ms" if value < 1.0 else f"{value:.2f} s"
