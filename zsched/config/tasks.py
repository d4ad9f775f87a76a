"""Decides what the `tasks:` of a fleet file say: candidates, tuning, workers, stream rules.

Knows: how the values of one task, and the rules of all tasks, relate. Does not know: YAML, timing.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

from zsched.config.blocks import Located, Section
from zsched.config.drivers import Driver, command_of
from zsched.config.nodes import Cast, select
from zsched.config.reader import Collector, Place, nearest
from zsched.config.ros2 import ros2_rules
from zsched.config.rulecheck import RuleConflict, rule_conflicts
from zsched.core.route.ros2 import DOMAIN
from zsched.core.route.route import NOBODY, PLACEHOLDERS, named_rules, placeholders
from zsched.core.route.templates import merges_keys, rule_fault, shared_key_fault, template_fault
from zsched.core.values.deadline import TELLS_NOTHING, DeadlineFault, deadline_fault, tells_jobs
from zsched.core.values.fleet import (
    DEFAULT_BONUS,
    DEFAULT_SCORE,
    TASK_RULES,
    TUNED_RULES,
    Demand,
    LinkLimits,
    OnIsolation,
    Standby,
    StreamRule,
    TaskSpec,
    WorkerSpec,
)
from zsched.core.values.gauges import BY_NAME
from zsched.core.values.model import NodeKind, Objective, ScoreForm, Tuning, Weights
from zsched.core.values.plan import (
    Direction,
    HandoverRule,
    OnCrash,
    ReadyWhen,
    RosGraph,
    ServiceSettings,
    StreamClass,
    StreamSettings,
)
from zsched.core.values.words import PAPER_METRICS, Readings

_ANY_TUNING: Final = Tuning(weights=Weights(cpu=1.0, memory=0.0, network=0.0))
"""Stands in for a faulty one, so that the task's rules are checked in the same pass; such a file gives no fleet."""
_ANY_CANDIDATES: Final = (NOBODY,)
"""The same for candidates: of a task without any the file has a fault."""
_Places = dict[str, Place]
"""Where each rule stands, by stream name."""


def read_tasks(section: Section, cast: Cast, out: Collector) -> tuple[TaskSpec, ...]:
    """All tasks that could be read, with what is wrong in and between them reported."""
    entries: dict[str, Located[Section | None]] = section.get("tasks", {})
    if not entries and "tasks" not in section.places:
        out.warn(section.where("nodes"), "the fleet has no tasks: nothing will be scheduled")
    places: _Places = {}
    tasks: list[TaskSpec] = []
    for name, entry in entries.items():
        if entry.value is None:
            continue
        task = _task(name, entry, entry.value, cast, places, out)
        if task is not None:
            tasks.append(task)
            _advise_network(task, entry.value, cast, out)
            _advise_deadline(task.tuning, task.worker, entry.value, out)
            _advise_domain(task.worker, entry.value, out)
            _advise_gpu(task, entry.value, out)
            _advise_gpu_limit(task, entry.value, out)
            for other in (one for one, _ in task.beside if one == name or one not in entries):
                place = entry.value.get("scheduling").place
                out.error(place, f"{name} names {other!r}, which is no other task", nearest(other, tuple(entries)))
    split = frozenset(node.name for node in cast.nodes if node.local is not None)
    for conflict in rule_conflicts(tasks, cast.of_kind(NodeKind.ROBOT), split):
        _report(conflict, places, out)
    return tuple(tasks)


def _task(
    name: str, entry: Located[Section | None], given: Section, cast: Cast, places: _Places, out: Collector
) -> TaskSpec | None:
    candidates = _candidates(given, cast, out)
    tuning = _tuning(given, out)
    worker = _worker(given, out)
    limits = _limits(given, out)
    streams = tuple(_streams(given, cast, candidates, out))
    _check_exclusive(given, worker, streams, out)
    _advise_ready(given, worker, streams, out)
    _check_mirrors(given, streams, out)
    scheduling: Section | None = given.get("scheduling")
    more = {} if scheduling is None else {**_of(scheduling, *TASK_RULES), **_head_starts(scheduling, cast, out)}
    demand: Section | None = given.get("demand")
    gauge_limits: Section | None = given.get("limits")
    task = TaskSpec(
        name=name,
        candidates=candidates or _ANY_CANDIDATES,
        tuning=tuning or _ANY_TUNING,
        demand=(demand.build(Demand, out) if demand is not None else None) or Demand(),
        limits=limits,
        gauge_limits=() if gauge_limits is None else tuple(sorted(gauge_limits.values.items())),
        worker=worker,
        rules=tuple(stream.value for stream in streams),
        **_of(given, "on_isolation", "exclusive", "drain_s"),
        **more,
    )
    by_rule = {id(stream.value): stream.place for stream in streams}
    places.update({stream: by_rule.get(id(rule), entry.place) for stream, rule in named_rules(task)})
    return task


def check_secured(section: Section, out: Collector) -> None:
    """What no task of a secured fleet can have: services of a ROS node are under no rule that lets them through."""
    entries: dict[str, Located[Section | None]] = section.get("tasks", {})
    for entry in entries.values():
        worker: Section | None = None if entry.value is None else entry.value.get("worker")
        if worker is not None and worker.get("driver") is Driver.ROS2_LIFECYCLE:
            message = "a secured fleet lets nobody lead a managed node: its services are no streams of the fleet"
            out.error(worker.where("driver"), message, "start the node by `command:` alone, and leave `driver:` out")


def _of(section: Section, *names: str) -> dict[str, Any]:
    return {name: section.values[name] for name in names if name in section.values}


# --- the parts of a task ---------------------------------------------------------------------------------------------


def _candidates(given: Section, cast: Cast, out: Collector) -> tuple[str, ...]:
    selection = given.get("candidates")
    if selection is None:
        return ()
    before = out.count
    candidates = select(selection, cast, out)
    if not candidates and cast.is_whole and out.count == before:
        known = cast.labels()
        hint = f"labels in this file: {', '.join(known[:12])}" if known else "no node of this file has a label"
        out.error(given.where("candidates"), "no node is a candidate", hint)
    return candidates


def _head_starts(scheduling: Section, cast: Cast, out: Collector) -> dict[str, Readings]:
    """What `prefer`, `together` and `spread` say; of a node that has several labels the largest counts."""
    prefer: dict[str, float] = {}
    for told, held in scheduling.get("prefer", {}).items():
        key, is_label, value = told.partition("=")
        nodes = [one.name for one in cast.nodes if (key, value) in one.labels] if is_label else [told]
        if cast.is_whole and not (nodes and set(nodes) <= set(cast.names)):
            what, known = ("label", cast.labels()) if is_label else ("node", cast.names)
            out.error(held.place, f"there is no {what} {told!r}", nearest(told, known))
        prefer |= {name: max(held.value or 0.0, prefer.get(name, 0.0)) for name in nodes}
    beside = {task: held.value or 0.0 for task, held in scheduling.get("together", {}).items()}
    for task, held in scheduling.get("spread", {}).items():
        if task in beside:
            out.error(held.place, f"{task!r} is under `together` as well", "leave it in one of them")
        beside[task] = -(held.value or 0.0)
    return {"prefer": tuple(sorted(prefer.items())), "beside": tuple(sorted(beside.items()))}


def _tuning(given: Section, out: Collector) -> Tuning | None:
    weights_given: Section | None = given.get("weights")
    if weights_given is None:
        return None
    gauges = tuple((name, weights_given.values[name]) for name in sorted(BY_NAME) if weights_given.get(name))
    three = {name: weights_given.get(name, 0.0) for name in PAPER_METRICS}
    weights = weights_given.build(Weights, out, **three, gauges=gauges)
    if weights is None:
        return None
    scheduling: Section | None = given.get("scheduling")
    score = _score(scheduling)
    deadline = {} if scheduling is None else _deadline(scheduling, score, weights, out)
    default: dict[str, Any] = {"bonus": DEFAULT_BONUS}
    if scheduling is None:
        return Tuning(weights=weights, score=score, **default)
    more = {"score": score, **default, **_of(scheduling, *default), **deadline}
    return scheduling.build(Tuning, out, weights=weights, **more, **dict.fromkeys(TUNED_RULES))


_INSTEAD_OF_A_DEADLINE: Final = {
    DeadlineFault.PAPER: "score: service, or objective: service without deadline_ms",
    DeadlineFault.NO_CPU: "a weight for cpu, or objective: service without deadline_ms",
}


def _deadline(scheduling: Section, score: ScoreForm, weights: Weights, out: Collector) -> dict[str, float | None]:
    """``deadline_ms`` as the tuning has it, which is the objective at the same time."""
    objective = scheduling.values.get("objective", Objective.SERVICE)
    deadline_ms: float | None = scheduling.values.get("deadline_ms")
    is_told = "objective" in scheduling.values  # one with a fault is not there, and has been told of
    if objective is Objective.LATENCY and deadline_ms is None and scheduling.is_whole:
        message = "objective latency needs a deadline: when is a job too late?"
        out.error(scheduling.where("objective"), message, "deadline_ms: 100 (milliseconds from input to output)")
    elif objective is Objective.SERVICE and deadline_ms is not None and (is_told or scheduling.is_whole):
        message = "deadline_ms counts for objective latency only, and this task has objective service"
        out.error(scheduling.where("deadline_ms"), message, "add objective: latency, or delete it")
    elif objective is Objective.LATENCY and (fault := deadline_fault(score, weights.cpu)) is not None:
        out.error(scheduling.where("objective"), fault.value, _INSTEAD_OF_A_DEADLINE[fault])
    else:
        return {"deadline_ms": deadline_ms}
    return {"deadline_ms": None}


def _score(scheduling: Section | None) -> ScoreForm:
    values = {} if scheduling is None else scheduling.values
    score: ScoreForm = values.get("score", DEFAULT_SCORE)
    return score


def _limits(given: Section, out: Collector) -> LinkLimits:
    section: Section | None = given.get("link")
    if section is None:
        return LinkLimits()
    limits = section.build(LinkLimits, out) or LinkLimits()
    if section.is_whole and limits.nu_dbm >= limits.rho_dbm:
        place = section.where("nu_dbm" if "nu_dbm" in section.places else "rho_dbm")
        out.error(place, f"nu_dbm ({limits.nu_dbm:g}) must be below rho_dbm ({limits.rho_dbm:g})")
    return limits


def _worker(given: Section, out: Collector) -> WorkerSpec:
    section: Section | None = given.get("worker")
    if section is None:
        return WorkerSpec()
    env = section.get("env", {})
    pairs = tuple(sorted((key, held.value) for key, held in env.items() if held.value is not None))
    ready = {"ready_when": section.get("ready")} if "ready" in section.values else {}
    for key, held in env.items():
        if key.startswith("ZSCHED_"):
            out.error(held.place, f"{key} is set by zsched itself", "choose another name")
    command = command_of(section, out)
    words = {} if command is None else {"command": command}
    if section.is_whole and section.get("standby") is Standby.COLD and not (command or section.get("command")):
        message = "a cold standby is started on the move, and this worker has no `command` to start it with"
        hint = "give its `command`, or delete `standby`: a worker that somebody else starts counts wherever it runs"
        out.error(section.where("standby"), message, hint)
    if "user" in section.places and section.is_whole and not (command or section.get("command")):
        out.error(section.where("user"), "nobody starts this worker: it has no `command`", "leave `user:` out")
    return section.build(WorkerSpec, out, env=pairs, **ready, **words) or WorkerSpec()


def _check_exclusive(
    given: Section, worker: WorkerSpec, streams: tuple[Located[StreamRule], ...], out: Collector
) -> None:
    if not given.get("exclusive", False):
        return
    for stream in streams:
        is_output = stream.value.direction is Direction.OUTPUT
        if is_output and "epoch" not in placeholders(stream.value.from_template):
            hint = 'for example from: "{target}/TASK/{epoch}/NAME"'
            out.error(stream.place, "an exclusive task needs {epoch} in every output's 'from': it is the fence", hint)
    if given.get("on_isolation") is OnIsolation.LOCAL:
        message = "an exclusive task may not run on every robot that is cut off"
        out.error(given.where("on_isolation"), message, "on_isolation: hold")
    if worker.ready_when is ReadyWhen.MATCHING:
        message = "an exclusive task's worker must hold the lease: only one that uses zsched.worker (ready: token) does"
        section: Section | None = given.get("worker")
        out.error(section.where("ready") if section is not None else given.where("exclusive"), message)


def _advise_ready(given: Section, worker: WorkerSpec, streams: tuple[Located[StreamRule], ...], out: Collector) -> None:
    section: Section | None = given.get("worker")
    if worker.ready_when is not ReadyWhen.MATCHING or section is None:
        return
    # An input with a fault is no rule, but it is there.
    if given.is_whole and all(stream.value.direction is Direction.OUTPUT for stream in streams):
        message = "nothing goes to this worker, so nothing tells whether it is there: it always counts as ready"
        out.warn(section.where("ready"), message, "give it an input or a service, or use zsched.worker (ready: token)")
    for stream in streams:
        settings = stream.value.settings
        if settings.on_crash is OnCrash.REPLAY:
            message = "a worker that acknowledges nothing (ready: matching) does not say what it left undone"
            out.error(stream.place, message, "on_crash: report, or use zsched.worker (ready: token)")
        elif settings.stream_class is StreamClass.RELIABLE:
            message = "class reliable, but this worker (ready: matching) acknowledges nothing: what is lost on its link"
            message += " is not sent again, and what it is sent counts as unconfirmed"
            out.warn(stream.place, message, "use zsched.worker (ready: token), or class: latest or best_effort")


def _advise_deadline(tuning: Tuning, worker: WorkerSpec, given: Section, out: Collector) -> None:
    if tuning.deadline_ms is not None and not tells_jobs(worker):
        scheduling: Section = given.get("scheduling")
        out.warn(
            scheduling.where("objective"),
            TELLS_NOTHING,
            "use zsched.worker (ready: token), or delete objective and deadline_ms",
        )


def _advise_domain(worker: WorkerSpec, given: Section, out: Collector) -> None:
    """The worker's nodes and the rules' keys belong to two domains: nothing that one puts reaches the other."""
    ros2, domain = given.get("ros2"), dict(worker.env).get(DOMAIN)
    if ros2 is None or domain is None or ros2.get("bridge", RosGraph.RMW_ZENOH) is not RosGraph.RMW_ZENOH:
        return
    rules = (entry for word in ("inputs", "outputs", "services", "actions") for entry in ros2.get(word, ()))
    is_node = any({"worker_topic", "worker_service", "worker_action"} & {*entry.places} for entry in rules)
    if is_node and not (domain.isdecimal() and int(domain) == ros2.get("domain", 0)):
        section: Section = given.get("worker")
        message = f"{DOMAIN} is {domain} for the worker, and the task's streams are of domain {ros2.get('domain', 0)}"
        out.warn(section.get("env")[DOMAIN].place, message, f"ros2: {{domain: {domain}}}, or {DOMAIN}: of that one")


def _advise_gpu(task: TaskSpec, given: Section, out: Collector) -> None:
    """The GPU counts, and how much of it the task uses is not said; a limit of all of it only asks for a GPU."""
    gpu = BY_NAME["gpu"]
    is_weighed = bool(dict(task.tuning.weights.gauges).get(gpu.name))
    is_limited = dict(task.gauge_limits).get(gpu.name, gpu.high) < gpu.high
    if task.demand.gpu or not (is_weighed or is_limited):
        return
    section: Section = given.get("weights" if is_weighed else "limits")
    what, then = ("weight", "it counts nothing") if is_weighed else ("limit", "it only asks for a GPU")
    message = f"the GPU has a {what}, but nothing says how much of it the task uses, and no driver tells: {then}"
    hint = "demand: {gpu: 0.3} (its share of one GPU; `zsched status` shows a machine's use with and without the task)"
    out.warn(section.where(gpu.name), message, hint)


def _advise_gpu_limit(task: TaskSpec, given: Section, out: Collector) -> None:
    """A limit that the task's own use breaks on an idle machine keeps it from all of them.

    Within the margin a machine may have it, and none gets it from another one.
    """
    gpu = BY_NAME["gpu"]
    limit = dict(task.gauge_limits).get(gpu.name, gpu.high)
    back = gpu.back_from(limit)
    if limit < gpu.high and task.demand.gpu > back:
        section: Section = given.get("limits")
        whose = "" if task.demand.gpu > limit else " from another one"
        message = (
            f"no machine can get the task{whose}: its own demand of {task.demand.gpu:g} is above {back:g}, "
            f"which is the limit less the margin of {gpu.margin:g}"
        )
        enough = min(task.demand.gpu + gpu.margin, gpu.high)
        out.warn(section.where(gpu.name), message, f"limits: {{gpu: {enough:g}}}, or more")


def _advise_network(task: TaskSpec, given: Section, cast: Cast, out: Collector) -> None:
    """Links that the network's weight needs: none at all count nothing, and one that is missing shuts its node out.

    A candidate's own way, or any node's link to it, is one. A robot that votes alone always reaches itself.
    """
    if not task.tuning.weights.network > 0:
        return
    weights: Section = given.get("weights")
    hint = "`wifi: wlan0`, `wired: true`, `fixed:` or `trace:`"
    measured = {node.name for node in cast.nodes if any(link.peer is None for link in node.links)}
    measured |= {link.peer for node in cast.nodes for link in node.links if link.peer is not None}
    robots = cast.of_kind(NodeKind.ROBOT)
    mute = [name for name in task.candidates if name not in measured and (name,) != tuple(robots)]
    if not measured & {*task.candidates}:
        message = "the network has a weight, but no node says where its link figure comes from: it will not count"
        if any(node.links for node in cast.nodes):
            message = "the network has a weight, but nobody measures a link of any candidate: it will not count"
        out.warn(weights.where("network"), message, f"give robots and candidates {hint}")
    elif mute:
        message = f"the network has a weight, and nobody measures a link of {', '.join(mute)}: beside candidates that "
        message += "have one, such a node cannot have the task"
        out.warn(weights.where("network"), message, f"give {mute[0]} {hint}")


# --- stream rules ----------------------------------------------------------------------------------------------------


def _streams(given: Section, cast: Cast, candidates: tuple[str, ...], out: Collector) -> Iterator[Located[StreamRule]]:
    """Every rule of a task: those written as keys first, then those written as ROS names."""
    named = [(direction, section) for direction in Direction for section in given.get(f"{direction}s", ())]
    ros2: Section | None = given.get("ros2")
    if ros2 is not None:
        named += ros2_rules(ros2, cast.of_kind(NodeKind.ROBOT), candidates, out)
    for direction, section in named:
        rule = _rule(section, direction, out)
        if rule is None:
            continue
        _check_keys(rule, section, cast, out)
        yield Located(rule, section.where("to"))


def _check_mirrors(given: Section, streams: tuple[Located[StreamRule], ...], out: Collector) -> None:
    """Feeding two owners at a time only makes sense where one answer is enough, and where two may be given."""
    mirrored = [stream for stream in streams if stream.value.settings.mirror]
    whole = [stream for stream in streams if stream.value.settings.handover is HandoverRule.ALL]
    for stream in mirrored:
        if given.get("exclusive"):
            out.error(
                stream.place, "an exclusive task may not work twice, and mirror feeds two owners", "mirror: false"
            )
        elif whole:
            where = whole[0].place.told()
            message = f"mirror has both owners answer, and the output at {where} lets all answers through"
            out.error(stream.place, message, "handover: latest there, or mirror: false here")


def _check_keys(rule: StreamRule, section: Section, cast: Cast, out: Collector) -> None:
    """What depends on the robots' local sides, and what is worth a word."""
    robots = [node for node in cast.nodes if node.kind is NodeKind.ROBOT]
    without = [node.name for node in robots if node.local is None and node.name in cast.sound]
    problem = shared_key_fault(rule)
    if problem is not None and without:
        held: Located[str] = section.get("to" if rule.direction is Direction.OUTPUT else "from")
        hint = f"add {{robot}}, or give every robot a `local:` side ({', '.join(without[:4])} has none)"
        out.error(held.place, f"{held.value!r}: {problem}", hint)
    if merges_keys(rule) and rule.settings.graph is RosGraph.NONE:
        message = "'to' has fewer wildcards than 'from': several keys become one, and nobody can tell them apart"
        out.warn(section.where("to"), message)


def _rule(section: Section, direction: Direction, out: Collector) -> StreamRule | None:
    """The rule, of which only the keys need be right: what else is wrong says nothing of how it goes with others."""
    has_keys = True
    for side in ("from", "to"):
        held: Located[str] | None = section.get(side)
        problem = template_fault(held.value, direction, side) if held is not None else None
        has_keys &= held is not None and problem is None
        if held is not None and problem is not None:
            out.error(held.place, f"{held.value!r}: {problem}", _placeholder_hint(held.value))
    _check_settings(section, direction, out)
    if not has_keys:
        return None
    rule = StreamRule(
        direction=direction,
        from_template=section.get("from").value,
        to_template=section.get("to").value,
        settings=StreamSettings(
            **{"stream_class" if name == "class" else name: value for name, value in _settings(section).items()}
        ),
        service=ServiceSettings(**_of(section, "retry", "timeout_s", "hold_s", "max_pending")),
    )
    problem = rule_fault(rule)
    if problem is not None:
        out.error(section.where("to"), problem)
        return None
    return rule


def _settings(section: Section) -> dict[str, Any]:
    return _of(section, "class", "keep_last", "depth", "handover", "max_hz", "mirror", "graph", "on_crash")


def _check_settings(section: Section, direction: Direction, out: Collector) -> None:
    if "keep_last" in section.values and section.get("class") is not StreamClass.LATEST and section.is_whole:
        out.error(section.where("keep_last"), "only streams of class latest keep samples", "add class: latest")
    if direction is Direction.INPUT and "handover" in section.values:
        out.error(section.where("handover"), "only outputs have a handover: an input switches in one step", "delete it")
    if direction is not Direction.INPUT and section.get("mirror"):
        out.error(section.where("mirror"), "only inputs are mirrored: an output has one owner at a time", "delete it")
    is_reliable_input = direction is Direction.INPUT and section.get("class") is StreamClass.RELIABLE
    if section.get("on_crash") is OnCrash.REPLAY and not is_reliable_input and section.is_whole:
        out.error(section.where("on_crash"), "only inputs of class reliable have something to replay", "delete it")
    if section.get("max_hz") is not None and section.get("class") is StreamClass.RELIABLE:
        out.error(section.where("max_hz"), "class reliable loses nothing, max_hz drops", "class: best_effort")
    if section.get("class") is StreamClass.LATEST and section.get("handover") is HandoverRule.ALL:
        message = "class latest keeps only the newest, handover all loses nothing"
        out.warn(section.where("handover"), message, "class: reliable")
    is_reliable_output = direction is Direction.OUTPUT and section.get("class") is StreamClass.RELIABLE
    if is_reliable_output and "handover" not in section.values and section.is_whole:
        message = "class reliable, and at a move the old owner's last answers are dropped (handover: latest)"
        out.warn(section.where("class"), message, "handover: all; or handover: latest, if that is meant")


def _placeholder_hint(template: str) -> str:
    unknown = [name for name in placeholders(template) if name not in PLACEHOLDERS]
    return nearest(unknown[0], PLACEHOLDERS) if unknown else ""


def _report(conflict: RuleConflict, places: _Places, out: Collector) -> None:
    """Every rule of a conflict is named with its place; the fault stands at the last of them in the file."""
    ordered = sorted(conflict.streams, key=lambda name: (places[name].file, places[name].line, places[name].col, name))
    named = ", ".join(f"{name} at {places[name].told()}" for name in ordered)
    tell = out.error if conflict.is_fatal else out.warn
    tell(places[ordered[-1]], conflict.message, f"rules: {named}")
