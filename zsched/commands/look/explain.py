"""`zsched explain`: the last judgement of a task with its sums, and what another one would take.

With ``--at`` a judgement of the past, out of the decision log of the node that is asked.

Knows: which daemon to ask, the text, the schema ``zsched.explain/1``. Does not know: how a sum comes about
(`zsched.core.scheduler.explain`: the daemon tells the sums of its last judgement, others are made here, by
`zsched.commands.look.replay`), where a log lies (`zsched.host.decision_log`).
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from zsched.commands.base.ask import Door, ask_door
from zsched.commands.base.common import CliError, Json, print_json, wants_color, warn
from zsched.commands.base.options import Answers, NoColorOption
from zsched.commands.base.page import Cell, Page, age_s_of, memory, name_room, page_width, shares, short_name, span
from zsched.commands.look.history import is_known, is_move, wall_text, when_of, where_of
from zsched.core.values.exits import EXIT_FAILED, EXIT_OK, EXIT_USAGE, EXIT_WOULD_CHANGE
from zsched.core.values.struct import Struct, replace
from zsched.core.values.veto import Filter
from zsched.core.values.words import PAPER_METRICS, meant, shown

SCHEMA = "zsched.explain/1"
MAX_DIGITS = 16
"""Of an epoch (`zsched.core.values.model.MAX_COUNTER`)."""
COLUMNS = {"memory": "mem", "network": "net"}
"""The short titles of columns."""
OUTCOMES = {"stay": "green", "none": "red"}


def explain(
    asked: Answers,
    task: Annotated[str | None, typer.Argument(metavar="[TASK]", help="A task; not with --replay.")] = None,
    plan: Annotated[
        str | None, typer.Option("--plan", metavar="NODE=down", help="Reckon again without that node; 10: it moves.")
    ] = None,
    at: Annotated[
        str | None,
        typer.Option("--at", metavar="EPOCH|AGE|TIME", help="The judgement before that, from this machine's log."),
    ] = None,
    robot: Annotated[
        str | None, typer.Option("--robot", metavar="NAME", help="Only what this robot sees: its terms, whom it hears.")
    ] = None,
    replay: Annotated[
        Path | None,
        typer.Option("--replay", metavar="FILE", help="Judge all of a decision log again (also .gz); 1: one differs."),
    ] = None,
    no_color: NoColorOption = False,
) -> int:
    """Show a robot's last judgement of a task with all its figures, and what would have to change for a move.

    Example: zsched explain map_merge

    On an edge, which decides nothing, a robot is asked in its place. With --at 12 it shows the judgement that came
    before the move to epoch 12, and that move; with an age or a time, the one of that moment.
    """
    if (task is None) == (replay is None):
        raise CliError(EXIT_USAGE, "name a task, or a decision log with --replay FILE")
    if replay is not None:
        from zsched.commands.look.replay import replay as make_again  # noqa: PLC0415 - loads the scheduler

        return make_again(replay, is_json=asked.json_)
    assert task is not None
    door, gone = asked.door(), None if plan is None else _planned(plan)
    if at is not None:
        body, written = _past(door, task, _point_of(at))
    else:
        body, written = explanation(door, task) if robot is None else _of_robot(door, task, robot)
    if robot is not None:
        from zsched.commands.look.replay import sight  # noqa: PLC0415 - loads the scheduler, which takes as long as this

        body["robot"] = sight(written, robot, str(body["node"]))
    code = EXIT_OK
    if gone is not None:
        from zsched.commands.look.replay import planned  # noqa: PLC0415 - as above

        body["plan"] = planned(written, gone)
        code = EXIT_WOULD_CHANGE if body["plan"]["would_move"] else EXIT_OK
    if asked.json_:
        print_json(body)
    else:
        sys.stdout.write(render(body, page_width(), wants_color(no_color)))
    return code


def explanation(door: Door, task: str) -> tuple[Json, Json]:
    """Why a task is where it is, as ``zsched.explain/1`` has it, and the written judgement that this is made of.

    Raises:
        CliError: nobody answers, there is no such task, or no judgement yet.
    """
    answer = _asked(door, task)
    told = answer["explanation"]
    written: Json | None = told.get("decision")
    if written is None:
        raise CliError(EXIT_FAILED, f"{told['node']} has judged nothing of {task} yet; ask again in a second")
    vote = told.get("vote")
    more = {
        "newest_revision": told["allocation"]["revision"],
        "vote": None if vote is None else {**vote, "votes": dict(vote["votes"])},
        "plan": None,
        "knows_jobs": told.get("knows_jobs"),
    }
    head = {"schema": SCHEMA, "node": told["node"], "age_s": told.get("age_s", 0.0)}
    return {**head, **answer["sums"], **more, "at": None, "made": None, "robot": None}, written


def _of_robot(door: Door, task: str, robot: str) -> tuple[Json, Json]:
    """A robot's own judgement; where it does not answer, another one's, which knows what it has told."""
    body, written = explanation(door, task)
    if body["node"] == robot or robot not in written["figures"]["voters"]:
        return body, written
    try:
        return explanation(door.to(robot), task)
    except CliError as error:
        warn(f"zsched explain: {error}; this is what {body['node']} has heard of {robot}")
        return body, written


# --- a judgement of the past -----------------------------------------------------------------------------------------


class Point(Struct, frozen=True, kw_only=True):
    """Which judgement of a log is meant: the one before an epoch, an age or a time."""

    word: str
    epoch: int | None = None
    age_s: float | None = None
    wall_s: float | None = None

    def told(self) -> str:
        """Which judgements it means, in words."""
        if self.epoch is not None:
            return f"before epoch {shown(self.epoch)}"
        return f"until {self.word}" if self.age_s is None else f"of {self.word} ago or before"


def _point_of(word: str) -> Point:
    """What ``--at`` says: ``12``, ``10m``, ``2026-11-23T18:46:15Z``.

    Raises:
        CliError: it is none of them.
    """
    if word.isascii() and word.isdigit() and len(word) <= MAX_DIGITS:
        return Point(word=word, epoch=int(word))
    age_s = age_s_of(word)
    if age_s is not None:
        return Point(word=word, age_s=age_s)
    try:
        moment = datetime.fromisoformat(word)
    except ValueError:
        forms = "an epoch (12), an age (90s, 10m, 2h, 1d) or a time (2026-11-23T18:46:15Z)"
        raise CliError(EXIT_USAGE, f"--at {word}: expected {forms}; `zsched history` lists epochs and times") from None
    return Point(word=word, wall_s=(moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp())


def _past(door: Door, task: str, point: Point) -> tuple[Json, Json]:
    """The newest judgement before the point in the log of this machine's node, and the move that began the epoch.

    Raises:
        CliError: another machine's log is meant, or this one has no such epoch or judgement.
    """
    if door.node is not None or door.endpoint:
        raise CliError(EXIT_USAGE, "--at reads the decision log, which lies on each robot: run it there")
    answer = _ask(door, task)  # names an unknown task
    if point.epoch is not None:
        point = replace(point, epoch=meant(point.epoch, answer["explanation"]["allocation"]["epoch"]))
    node, now, entry, move = _search(door, task, point)
    if entry is None:
        is_edge = answer["explanation"]["kind"] == "edge"
        edge = f"; {node} is an edge and decides nothing: ask on a robot" if is_edge else ""
        raise CliError(EXIT_FAILED, f"the log of {node} has no judgement of {task} {point.told()}{edge}")
    from zsched.commands.look.replay import sums  # noqa: PLC0415 - as above

    written: Json = entry["decision"]
    head = {"schema": SCHEMA, "node": node, "age_s": max(now - float(entry["at"]), 0.0)}
    made = None if move is None else _move(move, now)
    revision = written["figures"]["allocation"]["revision"]
    more = {"newest_revision": revision, "vote": None, "plan": None, "knows_jobs": None}
    return {**head, **sums(written), **more, "at": wall_text(entry["at"]), "made": made, "robot": None}, written


def _move(entry: Json, now: float) -> Json:
    move = entry["move"]
    where = {"epoch": move["epoch"], "revision": move["revision"], "from": move["left"], "to": move["owner"]}
    why = {"is_known": is_known(move), "reason": move["reason"]}
    return {**when_of(entry, now), **where, **why, "votes": dict(move.get("votes", ()))}


def _search(door: Door, task: str, point: Point) -> tuple[str, float, Json | None, Json | None]:
    """(node, its wall clock, the judgement's entry, the move's entry), page by page through the whole log."""
    wish = {"task": task, "epoch": point.epoch, "until": point.wall_s}
    if point.age_s is not None:
        wish["until"] = float(ask_door(door, {"verb": "log", "judgement": wish})["now"]) - point.age_s
    judgement: Json | None = None
    move: Json | None = None
    cursor = ""
    epochs: list[int] = []
    while True:
        answer = ask_door(door, {"verb": "log", "judgement": wish, "cursor": cursor})
        judgement = answer["judgement"] or judgement
        told = answer["move"]
        move = told if told is not None and (move is None or is_move(told)) else move
        epochs += answer["epochs"]
        cursor = str(answer["cursor"])
        if not answer["more"]:
            break
    if point.epoch is not None and move is None:
        told = f"has no move of {task} to epoch {shown(point.epoch)}{_known(epochs)}"
        raise CliError(EXIT_FAILED, f"the log of {answer['node']} {told}")
    return str(answer["node"]), float(answer["now"]), judgement, move


def _known(epochs: Sequence[int]) -> str:
    return f"; it knows epochs {shown(min(epochs))} to {shown(max(epochs))}" if epochs else "; it knows no move of it"


# --- the judgement of now --------------------------------------------------------------------------------------------


def _planned(word: str) -> str:
    node, _, state = word.partition("=")
    if not node or state != "down":
        raise CliError(EXIT_USAGE, f"--plan {word}: expected NODE=down, e.g. --plan edge2=down")
    return node


def _asked(door: Door, task: str) -> Json:
    """A robot's answer; an edge decides nothing, so it names the robots, and one of them is asked in its place."""
    answer = _ask(door, task)
    told = answer["explanation"]
    robots = told["robots"]
    if told["kind"] != "edge" or door.node is not None or not robots:
        if told["kind"] == "edge":
            whom = f"ask a robot: --node {robots[0]}" if robots else "and no robot is alive"
            raise CliError(EXIT_FAILED, f"{told['node']} is an edge and decides nothing; {whom}")
        return answer
    failures = []
    for robot in robots:
        try:
            return _ask(door.to(robot), task)
        except CliError as error:
            failures.append(error)
    raise failures[0]


def _ask(door: Door, task: str) -> Json:
    """The daemon's answer: ``explanation`` (`zsched.core.values.decision.Explanation`), and the ``sums``."""
    answer = ask_door(door, {"verb": "explain", "task": task})
    if "explanation" not in answer:
        raise CliError(EXIT_USAGE, str(answer.get("detail") or "the daemon is of another version"))
    return answer


# --- text ------------------------------------------------------------------------------------------------------------


def render(body: Json, width: int, color: bool) -> str:
    """An explanation for people, in ``width`` columns."""
    page = Page(width, color)
    when = f" ({body['at']})" if body["at"] else ""
    head = f"task {body['task']} · as {body['node']} judged it {span(body['age_s'])} ago{when}"
    page.row((head, width, "bold"))
    page.lines.append("")
    _judgement(page, "DECISION", body)
    _made(page, body)
    _tuning(page, body)
    _robots(page, body)
    _filters(page, body)
    if body["at"] is None:
        _vote(page, body)
    page.lines.append("")
    if body["robot"] is not None:
        _seen(page, body)
    else:
        _candidates(page, body)
        if body["margin"] is not None:
            page.block("MARGIN", (f"{body['margin']:.4f} between the first two", ""))
        _changes(page, body)
    if body["plan"] is not None:
        plan = body["plan"]
        page.lines.append("")
        _judgement(page, f"WITHOUT {plan['without']}", plan)
        _candidates(page, plan)
        _changes(page, plan)
    return "\n".join(page.lines) + "\n"


def _judgement(page: Page, title: str, body: Json) -> None:
    chosen = f" {body['candidate']}" if body["candidate"] else ""
    parts: list[Cell] = [
        (f"{body['outcome']}{chosen}", OUTCOMES.get(body["outcome"], "yellow")),
        (body["reason"], ""),
        (f"owner {body['owner'] or 'nobody'}, epoch {shown(body['epoch'])}, revision {shown(body['revision'])}", "dim"),
    ]
    if body.get("newest_revision", body["revision"]) != body["revision"]:
        parts.append((f"the value has changed since: revision {shown(body['newest_revision'])}", "yellow"))
    page.block(title, *parts)


def _made(page: Page, body: Json) -> None:
    """The move that this judgement came before."""
    move = body["made"]
    if move is None:
        return
    votes = ", ".join(f"{voter} for {choice}" for voter, choice in move["votes"].items())
    page.block(
        "THEN",
        (f"{where_of(move)}, epoch {shown(move['epoch'])}", "bold"),
        (move["reason"], ""),
        (votes or "no votes heard", "" if votes else "dim"),
        (f"{span(move['age_s'])} ago ({move['at']})", "dim"),
    )


def _seen(page: Page, body: Json) -> None:
    """One robot's terms of every candidate, and the nodes that it hears."""
    sight = body["robot"]
    robot = sight["robot"]
    if sight["is_own"]:
        page.block("HEARS", *_heard(sight))
    elif not sight["is_heard"]:
        page.row((f"{body['node']} has no worth from {robot}: its answer did not come in time", page.width, "yellow"))
    first = name_room(page.width, 9, *(len(one["node"]) for one in body["candidates"]))
    columns = (first, -7, -7, -7, -8, page.width)
    page.row(*zip(("CANDIDATE", "cpu", "mem", "net", "worth", ""), columns, ("stage", *["dim"] * 5), strict=True))
    for one in body["candidates"]:
        view = next((view for view in one["robots"] if view["robot"] == robot), None)
        if view is None:
            page.row((short_name(one["node"], first), first, ""), ("-", -7, "dim"))
            continue
        terms = [_number(view[term]) for term in ("cpu", "memory", "network", "utility")]
        note = view["refused"] or ("" if view["reachable"] else f"{robot} does not reach it")
        is_best = one["node"] == sight["best"]
        note, style = (note, "red") if note else ("highest" if is_best else "", "green")
        page.row(
            *zip(
                (short_name(one["node"], first), *terms, note),
                columns,
                ("bold" if one["is_owner"] else "", *[""] * 4, style),
                strict=True,
            )
        )
    page.block(
        "ITS CHOICE",
        (sight["best"] or "none", "bold"),
        (f"the robots together: {body['outcome']} {body['candidate'] or ''}".rstrip(), ""),
    )


def _heard(sight: Json) -> list[Cell]:
    parts: list[Cell] = [(f"robots {', '.join(sight['robots']) or 'none'}", "")]
    parts += [(f"gone: {', '.join(sight['gone'])}", "yellow")] if sight["gone"] else []
    parts.append((f"electors {', '.join(sight['electors']) or 'none'}", ""))
    silent = sight["electors_silent"]
    return [*parts, *([(f"electors not heard: {', '.join(silent)}", "yellow")] if silent else [])]


def _tuning(page: Page, body: Json) -> None:
    tuning = body["tuning"]
    weights = " ".join(f"{name} {value:g}" for name, value in shares(tuning["weights"]).items())
    deadline: list[Cell] = []
    if tuning["deadline_ms"] is not None:
        deadline = [(f"deadline {tuning['deadline_ms']:g} ms", "")]
        if body["knows_jobs"] is False:
            deadline.append(("which does not count yet: how long a job takes is not known", "yellow"))
    page.block(
        "TUNING",
        (weights, ""),
        ("sum" if tuning["score"] == "paper" else "product", ""),
        (f"bonus {tuning['bonus']:g}", ""),
        (f"a move costs {body['price_s']:g} s", ""),
        (f"owner known for {span(body['known_for_s'])}", ""),
        *deadline,
    )
    if formula := formula_of(body):
        page.block("WORTH", (formula, "dim"))


def formula_of(body: Json) -> str:
    """How the terms of a robot's row make its utility, in the names of the columns; empty: nothing is measured.

    A metric that nobody measured has no part in it (`zsched.core.scheduler.utility.Total`).
    """
    views = [view for one in body["candidates"] for view in one["robots"]]
    weights = {
        name: weight
        for name, weight in shares(body["tuning"]["weights"]).items()
        if weight > 0.0
        and any((view.get(name) if name in PAPER_METRICS else view["gauges"].get(name)) is not None for view in views)
    }
    if not weights:
        return ""
    named = [(COLUMNS.get(name, name), weight) for name, weight in weights.items()]
    if body["tuning"]["score"] == "paper":
        whole = sum(weights.values())
        return " + ".join(f"{weight / whole:.4g} {name}" for name, weight in named)
    most = max(weights.values())
    return " x ".join(name if weight == most else f"{name}^{weight / most:.4g}" for name, weight in named)


def _robots(page: Page, body: Json) -> None:
    silent = [(f"silent: {', '.join(body['silent'])}", "yellow")] if body["silent"] else []
    page.block("ROBOTS", (f"{len(body['heard'])} heard, {body['needed']} needed", ""), *silent)


def _filters(page: Page, body: Json) -> None:
    """Which filters keep candidates out, in the order in which they are looked at."""
    kept_out: dict[str, list[str]] = {}
    for one in body["candidates"]:
        if name := one.get("filter"):  # a later field of the schema's major version
            kept_out.setdefault(name, []).append(one["node"])
    left = len(body["candidates"]) - sum(map(len, kept_out.values()))
    parts: list[Cell] = [(f"{one} keeps out {', '.join(kept_out[one])}", "yellow") for one in Filter if one in kept_out]
    page.block("FILTERS", (f"{left} of {len(body['candidates'])} candidates pass", ""), *parts)


def _vote(page: Page, body: Json) -> None:
    vote = body["vote"]
    if vote is None:
        page.block("VOTE", ("none seen by this node", "dim"))
        return
    won = f" {vote['winner']}" if vote["winner"] else ""
    votes = ", ".join(f"{voter} for {choice}" for voter, choice in vote["votes"].items())
    page.block(
        "VOTE",
        (f"{vote['outcome'].replace('_', ' ')}{won}", ""),
        (votes or "no proposals", ""),
        (f"on revision {shown(vote['base_revision'])}", "dim"),
        (f"{span(vote['age_s'])} ago", "dim"),
    )


def _candidates(page: Page, body: Json) -> None:
    robots = [view["robot"] for one in body["candidates"] for view in one["robots"]]
    first = name_room(page.width, 9, *map(len, robots), *(len(one["node"]) for one in body["candidates"]))
    gauges = [name for name in shares(body["tuning"]["weights"]) if name not in PAPER_METRICS]
    columns = (first, first, -7, -7, -7, *(-max(len(name), 7) for name in gauges), -8, page.width)
    titles = ("CANDIDATE", "robot", "cpu", "mem", "net", *gauges, "worth", "")
    page.row(*zip(titles, columns, ("stage", *["dim"] * (len(columns) - 1)), strict=True))
    for one in body["candidates"]:
        for number, view in enumerate(one["robots"]):
            name = "" if number else short_name(one["node"], first)
            note = view["refused"] or ("" if view["reachable"] else "does not reach it")
            terms = [_number(view[term]) for term in PAPER_METRICS]
            terms += [_number(view["gauges"].get(gauge)) for gauge in gauges]
            cells = (name, short_name(view["robot"], first), *terms, _number(view["utility"]), note)
            styles = ("bold" if one["is_owner"] else "", *[""] * (len(columns) - 2), "red")
            page.row(*zip(cells, columns, styles, strict=True))
        if not one["robots"]:
            page.row((one["node"], first, "bold" if one["is_owner"] else ""))
        _sum(page, one, first)


def _sum(page: Page, one: Json, indent: int) -> None:
    need = "" if one["need_cpu_cores"] is None else f"{one['need_cpu_cores']:.2f} cores {memory(one['need_memory_mb'])}"
    text, style = "", ""
    if one["joint"] is not None:
        text = f"mean {one['joint']:.4f}"
        text += f" - not kept {one['unkept']:.4f}" if one.get("unkept") else ""
        text += f" + bonus {one['bonus']:g}" if one["bonus"] else ""
    if one["total"] is not None:
        text += f" = {one['total']:.4f}"
    if one.get("owed_s") is not None:
        text += f"; owed {one['owed_s']:.2f} s"
    if one["why_not"]:
        text, style = f"{text}; {one['why_not']}" if text else one["why_not"], "red"
    tail = f" (needs {need})" if need else " (owner)" if one["is_owner"] else ""
    page.row((f"{text}{tail}", page.width - indent - 1, style), indent=indent + 1)


def _changes(page: Page, body: Json) -> None:
    for number, text in enumerate(body["changes"]):
        page.block("" if number else "TO MOVE", (text, ""))


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4f}"
