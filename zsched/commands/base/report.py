"""A status, as JSON values, as text for people: 80 columns suffice, 100 show more (pure).

Knows: what stands where, in the order of the six stages. Does not know: terminals, sockets; it imports nothing of the
core, so that `zsched status` starts quickly.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

from zsched.commands.base.page import (
    DROPS_OVER_S,
    SINCE_START,
    Cell,
    Page,
    clock_time,
    cut,
    memory,
    missed_of,
    name_room,
    shares,
    short_name,
    short_span,
    since_drop,
    size,
    span,
)
from zsched.core.values.gauges import BY_NAME
from zsched.core.values.problems import Problem, of_kind
from zsched.core.values.words import COUNTED_ANEW, has_lost_its_worker, shown, told_of_worker

Json = dict[str, Any]

BUSY, FULL = 0.6, 0.85
"""From here a bar is yellow, from here red."""
MAX_CANDIDATES, MAX_HISTORY = 12, 3
TROUBLES = "PROBLEMS"
"""The title of the last block, which a low window keeps."""
MOST, LITTLE = 0.98, 0.8
"""From here on nearly all jobs are done; below that, many are not."""
JOBS_OVER_S = 10.0
"""What a profile says of jobs that is so old is history, too."""
WORDS_OF_SECURITY = {"secured": "secured", "encrypted": "TLS", "open": "NOT SECURED"}
"""What the first line says of a node's sessions; of one that only its own machine reaches nothing."""
NO_ANSWER_TO = 100
"""After this many inputs without one output, ever, the key of the output is doubted."""
STATE_STYLES = {"alive": "green", "ready": "green"} | dict.fromkeys(
    ("draining", "drained", "no new", "starting", "restarting", "stopped", "suspect", "unknown"), "yellow"
)
"""All others are red."""


def degradations(status: Json) -> tuple[str, ...]:
    """Why the fleet is degraded, as this node sees it: no quorum, or a task without a live owner; empty when fine."""
    quorum, reasons = status["quorum"], []
    if not quorum["ok"]:
        reasons.append(
            f"no quorum: {quorum['alive']} of {quorum['electors']} electors can answer, {quorum['needed']} needed"
        )
    for task in status["tasks"]:
        if task["owner"] is None:
            reasons.append(f"{task['name']} has no owner (`zsched explain {task['name']}` says why)")
        elif task["owner_state"] not in ("alive", "suspect"):
            reasons.append(f"{task['name']}: its owner {task['owner']} is {task['owner_state']}")
        elif (lack := _lack_of_worker(status, task)) is not None:
            reasons.append(f"{task['name']}: {lack}")
    return tuple(reasons)


def _lack_of_worker(status: Json, task: Json) -> str | None:
    """Why the owner does no work, in the words of the daemon's own problems; ``None`` when it does, or will soon."""
    owner = task["owner"]
    workers = (worker for node in status["nodes"] if node["name"] == owner for worker in node["workers"])
    load: Json = next((one for one in workers if one["task"] == task["name"]), {})
    state, trouble, why = (str(load.get(key) or "") for key in ("state", "trouble", "reason"))
    if not has_lost_its_worker(state, trouble):
        return None
    because = f": {why}" if why else ""
    if state != "failed":
        return f"the worker on {owner} {told_of_worker(state, trouble, why)}"
    return f"the worker on {owner} failed{because}; mend it, then `zsched restart {task['name']} {owner}`"


def render_status(status: Json, width: int, color: bool, at: float | None = None) -> str:
    """The whole status for people, in the order of the stages; problems come last.

    ``width`` in columns, from 60 (of more robots than fit, the table shows the first); ``color``: with ANSI colours.
    ``at``: when it was asked for (this machine's clock, seconds since 1970), for wall times beside ages; ``None``:
    without.
    """
    page = Page(width, color, at)
    header(page, status)
    page.lines.append("")
    node_rows(page, status, "PROFILE")
    flag_rows(page, status)
    _gauges(page, status["nodes"])
    _gateway(page, status["nodes"])
    _electors(page, status["quorum"])
    for task in status["tasks"]:
        page.lines.append("")
        _task(page, status, task)
    troubles(page, status)
    return "\n".join(page.lines) + "\n"


def header(page: Page, status: Json) -> None:
    """The first line: which fleet, who answers, the quorum, and in a word how it is."""
    quorum, troubles = status["quorum"], all_problems(status)
    health, style = (f"{len(troubles)} problem{'s'[: len(troubles) != 1]}", "yellow") if troubles else ("ok", "green")
    away = sum(node["state"] in ("gone", "unknown") for node in status["nodes"])
    if away and not troubles:
        health, style = f"ok, {away} node{'s'[: away != 1]} away", "yellow"
    if degradations(status):
        health, style = "DEGRADED", "alarm"
    roles = {"no_elector": "", "lost_state": ", no valid state"}  # it may never have had one
    role = roles.get(quorum["this_node"], ", " + quorum["this_node"].replace("_", " "))
    parts = [f"fleet {status['fleet']}", f"{status['node']} ({status['kind']}{role})"]
    parts.append(f"quorum {quorum['alive']} of {quorum['electors']}, needs {quorum['needed']}")
    security = WORDS_OF_SECURITY.get(status.get("security", ""))  # a later field of the schema's major version
    parts += [security] if security else []
    room = page.width - len(health) - 1
    revision = [f"revision {status['fleet_revision']}"] if status.get("document") else []
    for extra in (*revision, f"up {span(status['up_s'])}", f"zsched {status['version']}"):
        parts += [extra] if len(" · ".join([*parts, extra])) <= room else []
    page.row((" · ".join(parts), room, "bold"), (health, len(health), style))


def _electors(page: Page, quorum: Json) -> None:
    """Who elects once a change of the fleet was agreed, which robots do not vote, and what the pilot waits for."""
    if not quorum.get("number"):
        return
    page.lines.append("")
    told = [f"{', '.join(quorum['names'])} (number {quorum['number']})"]
    told += [f"robots that do not vote: {', '.join(quorum['away'])}"] if quorum["away"] else []
    page.row(("ELECTORS", page.indent - 1, "stage"), ("; ".join(told), page.width, ""))
    if quorum["pilot"]:
        page.row((quorum["pilot"], page.width, "dim"), indent=page.indent)


# --- PROFILE, GATEWAY ------------------------------------------------------------------------------------------------


def node_rows(page: Page, status: Json, title: str) -> None:
    """A line per node."""
    nodes: list[Json] = status["nodes"]
    name = name_room(page.width, page.indent - 1, *(len(node["name"]) + 1 for node in nodes))
    is_wide = page.width >= 96
    bar = 8 if is_wide else 4
    is_timed = is_wide and any(node.get("speed") is not None for node in nodes)
    columns = (name, 5, 8, -5, bar, -4, 11 if is_timed else 6, 9, 7, page.width)
    titles = (title, "kind", "state", "age", "cpu", "", "cores", "memory", "link", "workers")
    styles = ("stage", *["dim"] * (len(titles) - 1))
    page.row(*zip(titles, columns, styles, strict=True))
    room = page.width - sum(abs(width) + 1 for width in columns[:-1])
    for node in nodes:
        workers = _workers(node["workers"], room, is_single=len(status["tasks"]) == 1)
        texts = [*_node_cells(node, bar, name, is_me=node["name"] == status["node"], is_wide=is_wide), workers]
        if node["state"] in ("gone", "unknown"):  # its last figures are no news
            texts = [(text, style if index == 2 else "dim") for index, (text, style) in enumerate(texts)]
        page.row(*((text, width, style) for (text, style), width in zip(texts, columns, strict=True)))


def flag_rows(page: Page, status: Json) -> None:
    """A line for each thing that operators have said of nodes."""
    for node in status["nodes"]:
        for flag in node.get("flags", ()):  # a later field of the schema's major version
            text = f"{node['name']}: {told_flag(flag)}, known for {span(flag['known_s'])}"
            page.row((text, page.width, "yellow"))


def state_word(node: Json) -> str:
    """A node's state; of a living one what keeps tasks from it.

    >>> state_word({"state": "alive", "draining": False, "flags": [{"kind": "ineligible"}, {"kind": "drain"}]})
    'drained'
    """
    kinds = [flag["kind"] for flag in node.get("flags", ())]
    if node["state"] != "alive":
        return str(node["state"])
    if node["draining"]:
        return "draining"
    return "leaving" if "leave" in kinds else "drained" if "drain" in kinds else "no new" if kinds else "alive"


def _gauges(page: Page, nodes: Sequence[Json]) -> None:
    """The gauges of those nodes that measure any."""
    told = [(node["name"], node.get("gauges") or {}) for node in nodes]  # a later field of the schema's major version
    rows = [
        (" ".join((name, *(f"{gauge} {_reading(gauge, value)}" for gauge, value in gauges.items()))), "")
        for name, gauges in told
        if gauges
    ]
    if rows:
        page.block("GAUGES", *rows)


def _reading(gauge: str, value: float) -> str:
    """As its gauge shows it; a newer daemon may know others."""
    return BY_NAME[gauge].shown(value) if gauge in BY_NAME else f"{value:g}"


def _node_cells(node: Json, bar: int, room: int, *, is_me: bool, is_wide: bool) -> list[tuple[str, str]]:
    state = state_word(node)
    cpu, cores = node["cpu_ratio"], node["cpu_cores"]
    level = "" if cpu is None else "red" if cpu >= FULL else "yellow" if cpu >= BUSY else "green"
    filled = 0 if cpu is None else round(cpu * bar)
    is_tight = node["memory_ratio"] is not None and node["memory_ratio"] >= FULL
    return [
        (short_name(node["name"], room - is_me) + "*" * is_me, "bold" if is_me else ""),
        (node["kind"], ""),
        (state, STATE_STYLES.get(state, "red")),
        (short_span(node["age_s"]), ""),
        ("" if cpu is None else "█" * filled + "░" * (bar - filled), level),
        (_percent(cpu), ""),
        (_cores(cores, node.get("speed") if is_wide else None), "dim"),
        (_memory(node), "red" if is_tight else ""),
        (_link(node["links"]), ""),
    ]


def _cores(cores: float | None, speed: float | None) -> str:
    """How many, and how fast each is where that was measured.

    >>> _cores(4.0, 0.713), _cores(0.5, None)
    ('of 4 x0.71', 'of 0.5')
    """
    if cores is None:
        return ""
    return f"of {cores:.3g}" + ("" if speed is None else f" x{speed:.2g}")


def _memory(node: Json) -> str:
    total = node["memory_mb"]
    return "-" if total is None else f"{_percent(node['memory_ratio'])} {memory(total)}"


def _percent(ratio: float | None) -> str:
    return "-" if ratio is None else f"{ratio:.0%}"


def _link(links: Sequence[Json]) -> str:
    """The link to everybody, else the weakest one; its source when it has no signal."""
    if not links:
        return "-"
    common = [link for link in links if link["peer"] is None]
    measured = [link["rssi_dbm"] for link in (common or links) if link["rssi_dbm"] is not None]
    return f"{min(measured):.0f} dBm" if measured else str(links[0]["source"])


def _workers(workers: Sequence[Json], room: int, *, is_single: bool) -> Cell:
    """The workers' states, with as much beside as there is room for."""
    if not workers:
        return "-", "dim"
    states = [_worker_state(worker) for worker in workers]
    styles = [STATE_STYLES.get(state, "red") for state in states]
    style = next((style for style in ("red", "yellow") if style in styles), "green")
    full = ", ".join(f"{worker['task']} {state}" for worker, state in zip(workers, states, strict=True))
    short = ", ".join(f"{states.count(state)} {state}" for state in dict.fromkeys(states))
    if is_single:
        (worker,) = workers[:1]
        wants = "" if worker.get("wanted_cores") is None else f" of {worker['wanted_cores']:.2f}"
        load = [] if worker["cpu_cores"] is None else [f"{worker['cpu_cores']:.2f}{wants} cores"]
        load += [] if worker["memory_mb"] is None else [memory(worker["memory_mb"])]
        full, short = " ".join([states[0], *load]), states[0]
    return (full if len(full) <= room else short), style


def _worker_state(worker: Json) -> str:
    """In a word what the daemon's problems say at length (`told_of_worker`).

    >>> _worker_state({"state": "starting", "trouble": "lost"})
    'was ready'
    """
    words = {"lost": "was ready", "again": "restarting"}
    return words.get(worker.get("trouble", ""), str(worker["state"]))  # a later field of the schema's major version


def _gateway(page: Page, nodes: Sequence[Json]) -> None:
    held = [node for node in nodes if node["age_s"] is not None]
    parts: list[Cell] = [(f"{len(held)} of {len(nodes)} profiles held", "")]
    if held:
        oldest = max(held, key=lambda node: float(node["age_s"]))
        parts.append((f"oldest {span(oldest['age_s'])} ({oldest['name']})", ""))
    missing = ", ".join(node["name"] for node in nodes if node["age_s"] is None)
    page.block("GATEWAY", *parts, *([(f"none of {missing}", "yellow")] if missing else []))


# --- one task: SCHEDULER, VOTE, EXECUTOR, ROUTE ----------------------------------------------------------------------


def _task(page: Page, status: Json, task: Json) -> None:
    owner, state = task["owner"], task["owner_state"]
    parts: list[Cell] = [("no owner yet", "red")]
    if owner is not None:
        since_s = task["since_s"]
        known = [] if since_s is None else [(f"known here for {span(since_s)}{page.since(since_s)}", "")]
        parts = [(f"{owner} owns it", "bold"), *known, (state, STATE_STYLES.get(state, "red"))]
    counts = [(f"epoch {shown(task['epoch'])}", ""), (f"revision {shown(task['revision'])}", "")]
    pin = task.get("pin")  # a later field of the schema's major version
    held = [] if pin is None else [(f"pinned to {told_hold('pin', pin)}", "yellow")]
    rollout = task.get("rollout")
    held += [] if rollout is None else [(f"changed worker: {told_rollout(rollout)}", "yellow")]
    page.block(f"TASK {task['name']}", *parts, *counts, *held)
    _work(page, status, task)
    _scheduler(page, status, task)
    _vote(page, task, has_quorum=status["quorum"]["ok"])
    is_quiet = task["phase"] in ("idle", "settled")
    page.block("EXECUTOR", (str(task["phase"]), "" if is_quiet else "yellow"))
    _route(page, status, task)


def told_hold(kind: str, order: Json) -> str:
    """A pause or a pin in a few words, without its age.

    >>> told_hold("pin", {"node": "edge1", "is_hard": True, "by": "ada@robot1", "reason": "lens", "for_s": 7200.0})
    'edge1 (hard), for 2h00m, ada@robot1: lens'
    """
    words = [f"{order['node'] or 'its owner'}{' (hard)' if order['is_hard'] else ''}"] if kind == "pin" else ["paused"]
    return ", ".join((*words, *_asked(order)))


def _asked(order: Json) -> list[str]:
    """For how long an order holds, who gave it, and why."""
    words = [] if order.get("for_s") is None else [f"for {span(order['for_s'])}"]
    who = order.get("by") or "an unknown operator"
    return [*words, f"{who}: {order['reason']}" if order.get("reason") else str(who)]


def told_rollout(rollout: Json) -> str:
    """A changed worker that waits for a look, in a few words; ``rollout``: of a status.

    >>> told_rollout({"first": ["edge2"], "waiting": ["edge1", "robot1"], "by": "ada@robot1", "reason": "new net"})
    'edge2 first, edge1, robot1 wait, ada@robot1: new net'
    """
    first, waiting = (", ".join(rollout[key]) or "nobody" for key in ("first", "waiting"))
    return ", ".join((f"{first} first, {waiting} wait", *_asked(rollout)))


FLAGS: Final = {"drain": "drained", "ineligible": "gets nothing new", "leave": "leaving the fleet"}
"""{kind of a flag: the same in words}."""


def told_flag(flag: Json) -> str:
    """A flag of a node in a few words, without its age; ``flag``: of a status, or of a document.

    >>> told_flag({"kind": "drain", "by": "ada@robot1", "reason": "new fan", "for_s": 7200.0})
    'drained, for 2h00m, ada@robot1: new fan'
    """
    return ", ".join((FLAGS[str(flag["kind"])], *_asked(flag)))


def _work(page: Page, status: Json, task: Json) -> None:
    """What workers say of their jobs, the owner's first; nothing where none does, or the one that did does not now."""
    nodes = sorted(status["nodes"], key=lambda node: (node["name"] != task["owner"], node["name"]))
    told = [
        (node, worker["jobs"])
        for node in nodes
        for worker in node["workers"]
        if node["state"] == "alive" and (node["age_s"] or 0.0) <= JOBS_OVER_S and worker["state"] == "ready"
        if worker["task"] == task["name"] and worker.get("jobs")  # a later field of the schema's major version
    ]
    deadline_ms = task["tuning"].get("deadline_ms")
    for number, (node, jobs) in enumerate(told):
        wanted, done = jobs["wanted_hz"], jobs["done_hz"]
        share = min(done / wanted, 1.0) if wanted > 0 else None
        parts: list[Cell] = [
            (node["name"], "bold" if node["name"] == task["owner"] else ""),
            (f"{millis(jobs['time_s'])} a job, {millis(jobs['cpu_s'])} of CPU", ""),
            (f"{done:.3g} of {wanted:.3g} a second", ""),
        ]
        if share is not None:
            parts.append((f"{share:.0%} done", "red" if share < LITTLE else "yellow" if share < MOST else "green"))
        parts += [(f"{jobs['backlog']} wait", "yellow")] if jobs["backlog"] else []
        if deadline_ms is not None:
            late = jobs.get("late_ratio")
            told_late = "" if late is None else f", {late:.0%} {_late_by(task)}"
            age = "" if jobs.get("age_s") is None else f"{millis(jobs['age_s'])} from input to end, "
            parts.append((f"{age}deadline {deadline_ms:g} ms{told_late}", "yellow" if late and late > 1 - MOST else ""))
        page.block("" if number else "JOBS", *parts)


def _late_by(task: Json) -> str:
    """The word for late jobs. A worker counts by the file's deadline, which it was started with, not by a tuned one."""
    deadline_ms = (task.get("file_tuning") or task["tuning"]).get("deadline_ms")
    is_tuned = deadline_ms is not None and deadline_ms != task["tuning"].get("deadline_ms")
    return f"later than {deadline_ms:g} ms" if is_tuned else "late"


def millis(seconds: float) -> str:
    """A job's time.

    >>> millis(0.0352), millis(0.00006), millis(12.3)
    ('35 ms', '0.06 ms', '12 s')
    """
    return f"{seconds:.2g} s" if seconds >= 10.0 else f"{seconds * 1e3:.{2 if seconds < 1e-3 else 0}f} ms"


def _scheduler(page: Page, status: Json, task: Json) -> None:
    tuning, decision = task["tuning"], task["decision"]
    weights = " ".join(f"{name} {value:g}" for name, value in shares(tuning["weights"]).items())
    page.block(
        "SCHEDULER",
        (weights, ""),
        (f"bonus {tuning['bonus']:g}", ""),
        *([(f"a move costs {tuning['price_s']:g} s", "")] if tuning.get("price_s") is not None else []),
        *([(f"deadline {tuning['deadline_ms']:g} ms", "")] if tuning.get("deadline_ms") is not None else []),
        *([("by the paper's score", "")] if tuning.get("score") == "paper" else []),
    )
    if decision is None:
        why = "edges do not decide: ask a robot with --node" if status["kind"] == "edge" else "no round yet"
        page.block("", (why, "dim"))
        return
    winner = f" {decision['winner']}" if decision["winner"] else ""
    outcome = {"stay": "green", "none": "red"}.get(decision["outcome"], "yellow")
    parts: list[Cell] = [
        (f"{decision['outcome']}{winner}", outcome),
        (decision["reason"], ""),
        (f"{span(decision['age_s'])} ago", "dim"),
    ]
    silent = ", ".join(decision["silent"])
    page.block("", *parts, *([(f"silent: {silent}", "yellow")] if silent else []))
    _candidates(page, task, decision)


def _candidates(page: Page, task: Json, decision: Json) -> None:
    """Candidate by candidate: the joint utility, each robot's, the mean of its terms, and why it cannot be."""
    joint, voters = decision["aggregates"], list(decision["utilities"])
    names = sorted({*task["candidates"], *joint}, key=lambda name: (-joint.get(name, -1.0), name))
    if not names:
        return
    first = name_room(page.width, 9, *map(len, names))
    widths = [max(len(voter), 5) for voter in voters]
    room = page.width - page.indent - first - 7 - 3 * 6 - 11  # joint, three terms, a short note
    while widths and sum(widths) + len(widths) > room:
        widths.pop()
    hidden = len(voters) - len(widths)
    more = f"+{hidden}" if hidden else ""
    columns = [first, -6, *(-width for width in widths), -5, -5, -5, page.width]
    titles = ["candidate", "mean", *voters[: len(widths)], "cpu", "mem", "net", more]
    page.row(*((title, width, "dim") for title, width in zip(titles, columns, strict=True)), indent=page.indent)
    for name in names[:MAX_CANDIDATES]:
        veto = decision["vetoed"].get(name)
        if veto and not any(name in column for column in decision["utilities"].values()):
            told = short_name(name, first)
            page.row((told, first, "red"), (f"     - {veto}", page.width, "red"), indent=page.indent)
            continue
        cells = _candidate_cells(name, first, task, decision, voters[: len(widths)])
        page.row(
            *((text, width, style) for (text, style), width in zip(cells, columns, strict=True)), indent=page.indent
        )
    if len(names) > MAX_CANDIDATES:
        page.block("", (f"and {len(names) - MAX_CANDIDATES} more candidates: see --json", "dim"))


def _candidate_cells(name: str, room: int, task: Json, decision: Json, voters: Sequence[str]) -> list[Cell]:
    columns: dict[str, Json] = decision["utilities"]
    found = [column[name] for column in columns.values() if name in column]
    joint, veto = decision["aggregates"].get(name), decision["vetoed"].get(name)
    best = max(decision["aggregates"].values(), default=None)
    style = "red" if veto else "bold" if joint is not None and joint == best else ""
    notes = [f"owner +{task['tuning']['bonus']:g}"] if name == task["owner"] else []
    unkept = decision.get("unkept", {}).get(name)  # a later field of the schema's major version
    notes += [f"not kept -{unkept:.2g}"] if unkept else []
    return [
        (short_name(name, room), style),
        (_number(joint, 3), style),
        *((_opinion(columns[voter].get(name)), "") for voter in voters),
        *((_number(_mean([utility[term] for utility in found]), 2), "dim") for term in ("cpu", "memory", "network")),
        (veto or ", ".join(notes), "red" if veto else "dim"),
    ]


def _opinion(utility: Json | None) -> str:
    """One robot's utility of one candidate; ``cut`` when it does not reach it."""
    if utility is None:
        return "-"
    return f"{utility['value']:.2f}" if utility["reachable"] else "cut"


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _vote(page: Page, task: Json, *, has_quorum: bool) -> None:
    vote = task["vote"]
    if vote is None:
        page.block("VOTE", ("none seen by this node", "dim"))
    else:
        camps: dict[str, list[str]] = {}
        for voter, choice in vote["votes"].items():
            camps.setdefault(choice, []).append(voter)
        winner = f" {vote['winner']}" if vote["winner"] else ""
        is_won, is_agreed = vote["outcome"] == "won", vote["base_revision"] < task["revision"]
        lack = ", not agreed on yet" if has_quorum else ", no quorum to agree on it"
        so_far = lack if is_won and not is_agreed else ""
        page.block(
            "VOTE",
            (f"{vote['outcome'].replace('_', ' ')}{winner}{so_far}", "green" if is_won and is_agreed else "yellow"),
            *((f"{choice}: {', '.join(voters)}", "") for choice, voters in camps.items()),
            (f"on revision {shown(vote['base_revision'])}", "dim"),
            (f"{span(vote['age_s'])} ago{page.moment(vote['age_s'])}", "dim"),
        )
    for past in reversed(task["history"][-MAX_HISTORY:]):
        ago = f"{span(past['age_s']):>6} ago{page.moment(past['age_s'])}"
        what = f"{ago}  epoch {shown(past['epoch'])}  {past['owner'] or 'nobody'}: {past['reason']}"
        page.lines.append(" " * page.indent + page.paint(cut(what, page.width - page.indent), "dim"))


def _route(page: Page, status: Json, task: Json) -> None:
    prefix, parts = f"{task['name']}/", []
    for stream in task["streams"]:
        name, drops = stream["stream"].removeprefix(prefix), stream["drops"]
        text = f"{name} {stream['messages']} msg{rate(stream)} {size(stream['bytes'])}, {_last(status, stream)}"
        told = {
            "in flight": stream.get("in_flight"),
            "lost": stream.get("lost"),
            "out of order": stream.get("reordered"),
            "at most lost": stream.get("at_most_lost"),
            "repeated": stream.get("repeated"),
            "unsent": stream.get("unsent"),
            "unconfirmed": stream.get("unconfirmed"),
        }
        answer_s = stream.get("answer_s")  # a later field of the schema's major version
        text += "" if answer_s is None else f", {millis(answer_s)} behind its input"
        text += "".join(f", {count} {what}" for what, count in told.items() if count)
        if drops:
            text += ", dropped " + " ".join(f"{count} {reason}" for reason, count in drops.items())
            text += since_drop(stream)
        parts.append((text, "yellow" if missed_of(stream) and not since_drop(stream) else ""))
    parts += [(hint, "yellow") for hint in _unanswered(task)]
    unheard = [one for one in task["streams"] if one["last_seen_s"] is None and f"{prefix}in/" in one["stream"]]
    first = next((one["name"] for one in status["tasks"] if one["streams"]), None)
    if first is None and status["kind"] == "robot":  # no counts yet: an application may join all the same
        first = status["tasks"][0]["name"]
    if (unheard or task["name"] == first) and status.get("joins_at"):  # a later field of the schema's major version
        parts.append((f"applications here join at {', '.join(status['joins_at'])} (mode client)", "dim"))
    has_streams = bool(task["streams"])
    page.block("ROUTE", *([] if has_streams else [("no streams here", "dim")]), *parts)


def _last(status: Json, stream: Json) -> str:
    if stream["last_seen_s"] is not None:
        return f"last {span(stream['last_seen_s'])} ago"
    return _awaited(status, stream)


def _awaited(status: Json, stream: Json) -> str:
    """Of a stream without a message: for an input, which key it waits for, and where to publish it.

    It keeps its count when the relay starts anew, and when its key is changed.
    """
    told = f"none {COUNTED_ANEW}" if stream["messages"] else "nothing yet"
    key = stream.get("from_expr") if "/in/" in stream["stream"] else None  # later fields of the schema's major version
    if not key:
        return told
    where = ", ".join(status.get("joins_at", ()))
    return f"{told}: waits for a message on {key}" + (f" from an application at {where}" if where else "")


def rate(stream: Json) -> str:
    """How fast it flows, beside its total.

    >>> rate({"hz": 49.96}), rate({"hz": 0.0}), rate({})
    (' 50.0/s', ' 0/s', '')
    """
    hz = stream.get("hz")  # a later field of the schema's major version
    return "" if hz is None else f" {per_second(hz)}"


def per_second(hz: float) -> str:
    """A rate: ``50.0/s``, ``0.02/s``, ``0/s``."""
    return f"{hz:.{1 if hz >= 1 else 2}f}/s" if hz else "0/s"


def _unanswered(task: Json) -> list[str]:
    """A hint that the worker may put its outputs under other keys than the rule's; no problem: it may answer rarely."""
    streams = {way: [one for one in task["streams"] if f"/{way}/" in one["stream"]] for way in ("in", "out")}
    done = sum(one.get("acknowledged") or 0 for one in streams["in"])
    keys = [key for one in streams["out"] if (key := one.get("from_expr"))]
    is_silent = task["phase"] == "settled" and not any(one["messages"] for one in streams["out"])
    if not keys or not is_silent or done < NO_ANSWER_TO:
        return []
    what = f"{task['owner']} has done {done} inputs and nothing has ever come on {', '.join(keys)}"
    return [f"{what}: does its worker put its outputs under that key?"]


# --- problems --------------------------------------------------------------------------------------------------------


def all_problems(status: Json) -> list[str]:
    """What is wrong, causes first."""
    lacks = of_kind(status, Problem.NO_QUORUM)
    causes = [*of_kind(status, Problem.NEVER_INITIALISED, Problem.NOTHING_AGREED), *lacks]
    # That one is the first of why the fleet is degraded, in the daemon's words.
    found = [*causes, *degradations(status)[len(lacks) :], *status["problems"]]
    found += [f"{task['name']}: {problem}" for task in status["tasks"] for problem in task["problems"]]
    return list(dict.fromkeys(found))


def troubles(page: Page, status: Json) -> None:
    """The last block: frames that were dropped, and the problems."""
    ages = status.get("dropped_ages", {})  # later fields of the schema's major version
    found = [(name, n) for name, n in status["counters"].items() if "dropped_" in name]
    dropped = [f"{name.removeprefix('dropped_')} {n}" for name, n in found if ages.get(name, 0.0) <= DROPS_OVER_S]
    problems, refused = all_problems(status), status.get("refused", ())
    if dropped or refused or problems:
        page.lines.append("")
    if dropped:
        page.block("dropped", *((text, "") for text in dropped))
    for number, text in enumerate(refused):
        page.block("" if number else "refused", (text, "yellow"))
    for number, problem in enumerate(problems):
        page.block("" if number else TROUBLES, (problem, "alarm"))


# --- the short form ---------------------------------------------------------------------------------------------------


SINCE_ROOM = 15
TITLES = ("TASK", "owner", "state", "since", "phase", "in", "out", "missed")
NO_TASK = "none yet; `zsched task add FILE` gives the fleet one"


def render_brief(status: Json, width: int, color: bool, at: float | None = None) -> str:
    """The short form; arguments as of `zsched.commands.base.report.render_status`."""
    page = Page(width, color, at)
    header(page, status)
    node_rows(page, status, "NODE")
    flag_rows(page, status)
    task_rows(page, status, at)
    _pin_rows(page, status)
    troubles(page, status)
    return "\n".join(page.lines) + "\n"


def task_rows(page: Page, status: Json, at: float | None) -> None:
    """Titles and a line per task; ``at``: now, for wall times beside ages."""
    tasks: list[Json] = status["tasks"]
    if not tasks:
        page.row((TITLES[0], page.indent - 1, "stage"), (NO_TASK, page.width, "dim"))
        return
    task_room = name_room(page.width, 10, *(len(task["name"]) for task in tasks))
    owner_room = name_room(page.width, 6, *(len(task["owner"] or "nobody") + len(_marks(task)) for task in tasks))
    columns = (task_room, owner_room, 8, SINCE_ROOM if at is not None else 6, 9, -7, -7, page.width)
    page.row(*((t, w, "dim" if i else "stage") for i, (t, w) in enumerate(zip(TITLES, columns, strict=True))))
    for task in tasks:
        cells = _cells(task, at, task_room, owner_room)
        page.row(*((text, wide, style) for (text, style), wide in zip(cells, columns, strict=True)))


def _pin_rows(page: Page, status: Json) -> None:
    """A line for each pin, with who asked and why; a pause is among the problems."""
    for task in status["tasks"]:
        if (pin := task.get("pin")) is not None:
            text = f"{task['name']}: pinned to {told_hold('pin', pin)}, known for {span(pin['known_s'])}"
            page.row((text, page.width, "yellow"))


def _cells(task: Json, at: float | None, task_room: int, owner_room: int) -> list[Cell]:
    marks, owner, since_s, state = _marks(task), task["owner"], task["since_s"], task["owner_state"]
    since = span(since_s)
    if at is not None and since_s is not None:
        since += f" {clock_time(at - since_s, at)}"
        if len(since) > SINCE_ROOM:  # of another day
            since = f"{short_span(since_s)} {clock_time(at - since_s, at)}"
    missed, is_new = _missed(task)
    return [
        (short_name(task["name"], task_room), "bold"),
        (short_name(owner or "nobody", owner_room - len(marks)) + marks, "bold" if owner else "red"),
        (state, STATE_STYLES.get(state, "red")),
        (since, ""),
        (str(task["phase"]), "" if task["phase"] in ("idle", "settled") else "yellow"),
        (_flow(task, "in"), ""),
        (_flow(task, "out"), ""),
        (missed, "yellow" if is_new else "dim"),
    ]


def _marks(task: Json) -> str:
    """What an operator has ordered, in a word each; both are later fields of the schema's major version."""
    pin = task.get("pin")
    where = "" if pin is None or pin["node"] in (None, task["owner"]) else f" {pin['node']}"
    return f"{'' if pin is None else f' (pin{where})'}{' (rollout)' if task.get('rollout') else ''}"


def _flow(task: Json, way: str) -> str:
    """How fast all of a task's inputs or outputs of the answering node flow together; ``-`` when that is not known."""
    told = [stream.get("hz") for stream in task["streams"] if f"/{way}/" in stream["stream"]]
    known = [hz for hz in told if hz is not None]
    return per_second(sum(known)) if known else "-"


def _missed(task: Json) -> tuple[str, bool]:
    """How many samples somebody may miss, when that is over, and whether it is not."""
    losers = [stream for stream in task["streams"] if missed_of(stream)]
    if not losers:
        return "-", False
    over = [since_drop(stream) for stream in losers]
    told = SINCE_START if set(over) == {SINCE_START} else " (none in the last minute)"
    return f"{sum(map(missed_of, losers))}{told if all(over) else ''}", not all(over)
