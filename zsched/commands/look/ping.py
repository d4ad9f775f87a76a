"""`zsched ping`: how long a node's control session and data session take to answer from this machine, and by which way.

Knows: the ways to a node, exit codes, how figures are shown. Does not know: zenoh (`zsched.link.bus`).
"""

from __future__ import annotations

import os
import statistics
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, Final

import typer

from zsched.commands.base.ask import Door, ask_door, fleet_here, name_here
from zsched.commands.base.common import CliError, Json, nearest, print_json, say
from zsched.commands.base.here import own_name
from zsched.commands.base.options import JsonOption, NameOption, RuntimeOption
from zsched.core.values import codec as wire
from zsched.core.values.errors import WireError
from zsched.core.values.exits import EXIT_FAILED, EXIT_OK, EXIT_UNREACHABLE, EXIT_USAGE
from zsched.core.values.fleet import Fleet
from zsched.core.values.model import NodeId
from zsched.core.values.snapshot import Snapshot
from zsched.core.values.struct import Struct
from zsched.host import paths as places
from zsched.host.clock import monotonic_s
from zsched.link.bus.node_ping import LARGE_S, SIZES, Pinged
from zsched.link.bus.node_ping import ping as measure
from zsched.link.keyspace import Keyspace
from zsched.link.sessions.tls import asker_in, visits

SCHEMA: Final = "zsched.ping/1"
CONTROL, DATA, DAEMON = "control", "data", "daemon"


class Question(Struct, frozen=True, kw_only=True):
    """What to measure."""

    node: NodeId
    count: int
    timeout_s: float
    interval_s: float


class Way(Struct, frozen=True, kw_only=True):
    """One way to the node, and what came of it."""

    name: str
    """``control``, ``data``, ``data`` with a size, or ``daemon``: through the daemon on this machine."""
    endpoint: str
    """The address that was dialled, or the socket."""
    found: Pinged


def ping(
    whom: Annotated[str, typer.Argument(metavar="NODE", help="A node of the fleet file.")],
    count: Annotated[int, typer.Option("--count", "-c", min=1, max=10_000, metavar="N", help="Questions.")] = 4,
    timeout: Annotated[float, typer.Option(min=0.1, max=60.0, metavar="S", help="Seconds for an answer.")] = 1.0,
    interval: Annotated[float, typer.Option(min=0.0, max=60.0, metavar="S", help="Seconds between two.")] = 0.2,
    json_: JsonOption = False,
    config: Annotated[
        Path | None, typer.Option("--config", metavar="FILE", help="Fleet file. [ZSCHED_CONFIG, else as for up]")
    ] = None,
    node: NameOption = None,
    runtime_dir: RuntimeOption = None,
) -> int:
    """Measure how long a node's control and data sessions take to answer, and by which address.

    Example: sudo zsched ping edge1

    Exits with 3 when the node answers by no way, with 1 when by some only.
    """
    own_name(node)
    question = Question(node=whom, count=count, timeout_s=timeout, interval_s=interval)
    me = name_here(node, runtime_dir)
    socket = places.socket_path(places.asked_folder(runtime_dir, os.environ), me)
    here = _own_status(socket)
    fleet = fleet_here(None if here is None else Door(socket=socket), places.config_path(config, os.environ))
    names = [spec.name for spec in fleet.nodes]
    if question.node not in names:
        raise CliError(EXIT_USAGE, f"fleet {fleet.name} has no node {question.node!r}{nearest(question.node, names)}")
    ways = list(_ways(fleet, me, question))
    if here is not None and me != question.node:
        ways.append(Way(name=DAEMON, endpoint=me, found=_through(socket, question)))
    if not ways:
        text = f"{question.node} has no address in the fleet file, and no daemon runs here that could ask it"
        raise CliError(EXIT_UNREACHABLE, f"{text}; run this on a node of the fleet, or give it `host:` and `listen:`")
    body = _as_json(question, ways, _hearing(question.node, me, ways, here))
    if json_:
        print_json(body)
    else:
        for line in _lines(question.node, ways, body["heard"]):
            say(line)
    answered = [bool(way.found.round_trips_s) for way in ways]
    return EXIT_OK if all(answered) else EXIT_FAILED if any(answered) else EXIT_UNREACHABLE


# --- the ways --------------------------------------------------------------------------------------------------------


def _ways(fleet: Fleet, me: NodeId, question: Question) -> Iterator[Way]:
    """The node's own addresses, measured at the same time."""
    spec, keys = fleet.node(question.node), Keyspace(fleet.name)
    selectors = {CONTROL: keys.status(spec.name, asker_in(fleet, me)), DATA: keys.role(spec.name, "*")}
    dialled = [
        (name, endpoint, large)
        for name, endpoint in ((CONTROL, spec.control_at), (DATA, spec.data_at))
        for large in (SIZES if name == DATA else ("",))
        if endpoint
    ]
    configs = visits(fleet, (endpoint for _, endpoint, _ in dialled))

    def measured(one: tuple[str, str, str], config: str) -> Way:
        name, endpoint, large = one
        found = measure(
            config,
            selectors[name],
            count=1 if large else question.count,
            timeout_s=LARGE_S if large else question.timeout_s,
            interval_s=question.interval_s,
            needs_answer=name == CONTROL,
            size=SIZES[large] if name == DATA else 0,
        )
        return Way(name=f"{name} {large}".strip(), endpoint=endpoint, found=found)

    pool = ThreadPoolExecutor(max_workers=len(dialled) or 1)
    try:
        yield from pool.map(measured, dialled, configs)
    finally:
        pool.shutdown(wait=False, cancel_futures=True)  # Ctrl-C waits for no answer


def _own_status(socket: Path) -> Json | None:
    """What the daemon on this machine says; ``None``: there is none."""
    try:
        return ask_door(Door(socket=socket), {"verb": "status"})
    except CliError:
        return None


def _through(socket: Path, question: Question) -> Pinged:
    """The same question through the daemon here: the way by which the nodes themselves talk."""
    found = Pinged(opened_s=0.0)
    door = Door(socket=socket, node=question.node)
    for number in range(question.count):
        if number:
            threading.Event().wait(question.interval_s)
        began = monotonic_s()
        try:
            ask_door(door, {"verb": "status"})
        except CliError as error:
            found.missed += 1
            found.error = str(error)
            continue
        found.round_trips_s.append(monotonic_s() - began)
    return found


# --- what is shown ---------------------------------------------------------------------------------------------------


def _hearing(node: NodeId, me: NodeId, ways: list[Way], here: Json | None) -> Json:
    """Which node hears which: {listener: {speaker: state}}."""
    heard: Json = {}
    if here is not None:
        heard[me] = {str(one["name"]): str(one["state"]) for one in here["nodes"] if one["name"] == node != me}
    for answer in next((way.found.answers for way in ways if way.name == CONTROL), []):
        try:
            snapshot = wire.decode(answer, Snapshot)
        except WireError:
            continue
        heard[snapshot.node] = {one.name: one.state for one in snapshot.nodes if one.name == me != node}
    return {listener: speakers for listener, speakers in heard.items() if speakers}


def _as_json(question: Question, ways: list[Way], heard: Json) -> Json:
    return {"schema": SCHEMA, "node": question.node, "ways": [_way_json(way) for way in ways], "heard": heard}


def _way_json(way: Way) -> Json:
    found, trips = way.found, way.found.round_trips_s
    return {
        "way": way.name,
        "endpoint": way.endpoint,
        "opened_s": found.opened_s,
        "answered": len(trips),
        "missed": found.missed,
        "least_s": min(trips, default=None),
        "mean_s": statistics.fmean(trips) if trips else None,
        "most_s": max(trips, default=None),
        "error": found.error,
    }


def _lines(node: NodeId, ways: list[Way], heard: Json) -> Iterator[str]:
    for way in ways:
        found, trips = way.found, way.found.round_trips_s
        place = f"through the daemon of {way.endpoint}" if way.name == DAEMON else way.endpoint
        head = f"{way.name:<11} {place}: "
        if not trips:
            why = found.error or f"no answer to {found.missed} questions"
            yield f"{head}{node} does not answer: {why}"
            continue
        figures = "/".join(f"{1000 * one:.1f}" for one in (min(trips), statistics.fmean(trips), max(trips)))
        opened = f", open after {1000 * found.opened_s:.0f} ms" if found.opened_s else ""
        yield f"{head}{len(trips)} of {len(trips) + found.missed} answered, {figures} ms (least/mean/most){opened}"
    for listener, speakers in heard.items():
        for speaker, state in speakers.items():
            yield f"{listener} finds {speaker} {state}"
