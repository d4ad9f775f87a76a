"""`zsched metrics`: a status as Prometheus text (version 0.0.4), on stdout or in a file for node_exporter.

Names follow Prometheus' conventions: a unit as suffix, ``_total`` for what only rises. Epochs and revisions are gauges:
a new generation sets them again. Nothing listens here: a file is written by a timer of the operator's, and
`zsched web` answers with the same text.

Knows: names, labels, the format, atomic writing. Does not know: what a figure means for a decision.
"""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Final

import typer

from zsched.commands.base.ask import ask_door
from zsched.commands.base.common import CliError, Json, uninterrupted
from zsched.commands.base.options import Asks, new_group
from zsched.commands.base.report import all_problems, degradations
from zsched.core.values.errors import ZschedError
from zsched.core.values.exits import EXIT_FAILED, EXIT_OK
from zsched.core.values.problems import Problem, of_kind

MIB: Final = 1 << 20
NODE_STATES: Final = ("alive", "suspect", "gone", "unknown")
HEARD: Final = ("alive", "suspect")
WORKER_STATES: Final = ("starting", "ready", "stopped", "failed")
COUNTED: Final = {
    "acknowledged": "Samples of an input that workers have processed.",
    "lost": "Samples whose number never came.",
    "doubled": "Samples that came twice and were dropped.",
    "reordered": "Samples that came behind newer ones and were dropped.",
    "replayed": "Samples that were sent again.",
    "at_most_lost": "Samples that were in flight to workers that died.",
    "repeated": "Samples of an input that were given to one more receiver: kept values and mirrors.",
    "unsent": "Values of class latest that came while there was no owner.",
    "unconfirmed": "Samples sent to a worker that acknowledges nothing.",
}

Labels = Mapping[str, str]
Sample = tuple[Labels, float]


def metrics_text(status: Json) -> str:
    """All figures of a status, family by family."""
    families = (*_of_daemon(status), *_of_nodes(status["nodes"]), *_of_tasks(status["tasks"]))
    return "".join(_family(*family) for family in families)


def down_text() -> str:
    """What is said of a node whose daemon does not answer."""
    return _family("zsched_up", "gauge", "Whether the daemon answers.", [({}, 0.0)])


Family = tuple[str, str, str, Sequence[Sample]]


def _of_daemon(status: Json) -> Iterator[Family]:
    quorum = status["quorum"]
    named = {"fleet": status["fleet"], "node": status["node"], "kind": status["kind"], "version": status["version"]}
    yield "zsched_up", "gauge", "Whether the daemon answers.", [({}, 1.0)]
    yield "zsched_info", "gauge", "Who answers.", [(named, 1.0)]
    yield "zsched_uptime_seconds", "gauge", "Since the daemon's start.", [({}, status["up_s"])]
    says = "Longest delay of the decision loop in the last half minute."
    yield "zsched_loop_lag_seconds", "gauge", says, [({}, status["loop_lag_s"])]
    for key, text in (("electors", "Electors."), ("alive", "Electors that can answer."), ("needed", "Majority.")):
        yield f"zsched_quorum_{key}", "gauge", text, [({}, quorum[key])]
    yield "zsched_quorum_ok", "gauge", "Whether anything can be agreed.", [({}, quorum["ok"])]
    yield "zsched_degraded", "gauge", "No quorum, or a task without a live owner.", [({}, bool(degradations(status)))]
    yield "zsched_problems", "gauge", "Problems that are shown.", [({}, len(all_problems(status)))]
    counters = [({"event": name}, count) for name, count in status["counters"].items()]
    yield "zsched_events_total", "counter", "Dropped frames and other events, by name.", counters


def _of_nodes(every: list[Json]) -> Iterator[Family]:
    states = [({"node": n["name"], "state": s}, n["state"] == s) for n in every for s in NODE_STATES]
    yield "zsched_node_state", "gauge", "1 for the state that the node is in.", states
    flags = [({"node": n["name"], "kind": f["kind"]}, 1.0) for n in every for f in n.get("flags", ())]
    yield "zsched_node_flag", "gauge", "1 for what an operator has said of the node: drain, ineligible, leave.", flags
    yield "zsched_node_profile_age_seconds", "gauge", "Age of its newest profile.", _each(every, "age_s")
    nodes = [node for node in every if node["state"] in HEARD]  # the last figures of one that is gone are no samples
    yield "zsched_node_draining", "gauge", "Whether it hands over what it owns.", _each(nodes, "draining")
    yield "zsched_node_cpu_cores", "gauge", "Cores.", _each(nodes, "cpu_cores")
    yield "zsched_node_cpu_used_cores", "gauge", "Cores in use.", _each(nodes, "cpu_used_cores")
    yield "zsched_node_memory_bytes", "gauge", "Memory.", _each(nodes, "memory_mb", MIB)
    yield "zsched_node_memory_used_bytes", "gauge", "Memory in use.", _each(nodes, "memory_used_mb", MIB)
    readings = [(n["name"], name, value) for n in nodes for name, value in n.get("gauges", {}).items()]
    told = [({"node": node, "gauge": name}, value) for node, name, value in readings]
    yield "zsched_node_gauge", "gauge", "GPU in use and battery as ratios, temperature in Celsius.", told
    links = [(n["name"], link) for n in nodes for link in n["links"] if link["rssi_dbm"] is not None]
    signals = [({"node": name, "peer": link["peer"] or ""}, link["rssi_dbm"]) for name, link in links]
    yield "zsched_link_rssi_dbm", "gauge", "Signal of a radio link; peer is empty where it is to all.", signals
    workers = [(n["name"], worker) for n in nodes for worker in n["workers"]]
    labels = [({"node": name, "task": worker["task"]}, worker) for name, worker in workers]
    shown = [({**label, "state": s}, worker["state"] == s) for label, worker in labels for s in WORKER_STATES]
    yield "zsched_worker_state", "gauge", "1 for the state that the worker is in.", shown
    for key, name, text, factor in (
        ("cpu_cores", "cpu_cores", "Cores that it uses.", 1),
        ("memory_mb", "memory_bytes", "Memory that it uses.", MIB),
    ):
        found = [(label, worker[key] * factor) for label, worker in labels if worker[key] is not None]
        yield f"zsched_worker_{name}", "gauge", text, found


def _each(nodes: list[Json], key: str, factor: float = 1.0) -> list[Sample]:
    return [({"node": node["name"]}, node[key] * factor) for node in nodes if node[key] is not None]


def _of_tasks(tasks: list[Json]) -> Iterator[Family]:
    owners = [({"task": t["name"], "node": c}, t["owner"] == c) for t in tasks for c in t["candidates"]]
    yield "zsched_task_owner", "gauge", "1 for the candidate that owns the task.", owners
    for key, text in (("epoch", "Newest allocation."), ("revision", "Newest change of its value.")):
        yield f"zsched_task_{key}", "gauge", text, [({"task": task["name"]}, task[key]) for task in tasks]
    ages = [({"task": task["name"]}, task["since_s"]) for task in tasks if task["since_s"] is not None]
    yield "zsched_task_owner_known_seconds", "gauge", "Since this node learnt of the owner.", ages
    # An older daemon tells no kinds.
    alone = [({"task": t["name"]}, bool(of_kind(t, Problem.NO_SPARE))) for t in tasks if "problem_kinds" in t]
    yield "zsched_task_without_spare", "gauge", "No other living candidate could take it over.", alone
    joint = [
        (t["name"], name, value) for t in tasks if t["decision"] for name, value in t["decision"]["aggregates"].items()
    ]
    scores = [({"task": task, "node": name}, value) for task, name, value in joint]
    yield "zsched_task_utility_ratio", "gauge", "What a candidate was worth in the last round.", scores
    yield from _of_streams([(task["name"], stream) for task in tasks for stream in task["streams"]])


def _of_streams(streams: list[tuple[str, Json]]) -> Iterator[Family]:
    labels = [({"task": task, "stream": one["stream"].removeprefix(f"{task}/")}, one) for task, one in streams]
    for key, text in (("messages", "Messages taken."), ("bytes", "Bytes taken.")):
        yield f"zsched_stream_{key}_total", "counter", text, [(label, one[key]) for label, one in labels]
    drops = [({**label, "reason": r}, count) for label, one in labels for r, count in one["drops"].items()]
    yield "zsched_stream_dropped_total", "counter", "Samples dropped, by reason.", drops
    for key, text in COUNTED.items():
        found = [(label, one[key]) for label, one in labels if one.get(key) is not None]
        yield f"zsched_stream_{key}_total", "counter", text, found
    for key, name, text in (
        ("in_flight", "in_flight", "Samples of an input that are not processed yet."),
        ("last_seen_s", "last_message_age_seconds", "Since the newest message."),
        ("answer_s", "answer_seconds", "From inputs to their answers, newest mean."),
    ):
        found = [(label, one[key]) for label, one in labels if one.get(key) is not None]
        yield f"zsched_stream_{name}", "gauge", text, found


# --- the format ------------------------------------------------------------------------------------------------------


def _family(name: str, kind: str, text: str, samples: Iterable[Sample]) -> str:
    """``# HELP``, ``# TYPE`` and a line per sample; nothing where there is no sample."""
    lines = [f"{name}{_labels(labels)} {_value(value)}" for labels, value in samples]
    return "\n".join((f"# HELP {name} {text}", f"# TYPE {name} {kind}", *lines, "")) if lines else ""


def _labels(labels: Labels) -> str:
    told = ",".join(f'{name}="{_escaped(value)}"' for name, value in labels.items())
    return f"{{{told}}}" if told else ""


def _escaped(value: str) -> str:
    return value.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")


def _value(value: float) -> str:
    """A number as the format has it.

    >>> _value(True), _value(3), _value(0.25)
    ('1', '3', '0.25')
    """
    number = float(value)
    return str(int(number)) if number.is_integer() else repr(number)


# --- the verbs -------------------------------------------------------------------------------------------------------


def metrics_print(asked: Asks) -> int:
    """Print a node's figures in Prometheus' text format.

    Example: zsched metrics print
    """
    sys.stdout.write(metrics_text(ask_door(asked.door(), {"verb": "status"})))
    return EXIT_OK


def metrics_write(
    asked: Asks,
    path: Annotated[Path, typer.Argument(metavar="PATH", help="As /var/lib/node_exporter/zsched.prom.")],
) -> int:
    """Write them to a file, whole or not at all, for node_exporter's textfile collector.

    Example: zsched metrics write /var/lib/prometheus/node-exporter/zsched.prom

    Where nobody answers the file says zsched_up 0, and this exits with 3.
    """
    try:
        text = metrics_text(ask_door(asked.door(), {"verb": "status"}))
    except ZschedError:
        _replace(path, down_text())
        raise
    _replace(path, text)
    return EXIT_OK


def _replace(path: Path, text: str) -> None:
    """Put a file in the place of another: a reader sees the old or the new one, and no third one stays."""
    try:
        with uninterrupted():
            descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
            try:
                with os.fdopen(descriptor, "w", encoding="utf-8") as file:
                    file.write(text)
                    os.fchmod(file.fileno(), 0o644)  # node_exporter is another user
                Path(name).replace(path)
            except OSError:
                with contextlib.suppress(OSError):
                    Path(name).unlink()
                raise
    except OSError as error:
        raise CliError(EXIT_FAILED, f"{path} cannot be written: {error.strerror}; see its folder") from error


metrics = new_group("metrics", "Figures for Prometheus.", {"print": metrics_print, "write": metrics_write})
