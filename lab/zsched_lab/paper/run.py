"""Runs one cell of the matrix: one scheme, one seed, one level, with real daemons, workers, streams and load.

Knows: the order of a run and what is kept of it. Does not know: other runs, figures (`zsched_lab.paper.metrics`).

A run's folder holds ``run.json`` (written last: what the run was), ``fleet.yaml``, ``records/*.ndjson`` (allocations,
decisions, accounting, what each robot saw), ``streams*.mcap`` and ``logs/``.
"""

from __future__ import annotations

import json
import os
import platform
import sys
import tempfile
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from zsched import __version__
from zsched.core.values.model import NodeId
from zsched.host.clock import monotonic_s
from zsched.host.machine.core_speed import processor
from zsched.host.operator_client import ask
from zsched.tasks.map_merge.merger import Mode
from zsched_lab.demo.run import worker_options
from zsched_lab.fleet.children import ChildError, Children
from zsched_lab.fleet.limits import LimitKind, NodeLimits
from zsched_lab.fleet.netns import Network
from zsched_lab.fleet.observer import Observer
from zsched_lab.fleet.recorder import Follower, Recorder
from zsched_lab.fleet.runner import CLI, FleetRunner, LabFleet, read_tree, write_fleet
from zsched_lab.fleet.view import find_task
from zsched_lab.paper.cells import Cell, bandwidth_of, merge_of
from zsched_lab.paper.load import Loads, Window, schedule
from zsched_lab.paper.node_state import is_calm, node_limits, own_links, owners_of, ready_workers, task_streams
from zsched_lab.paper.oracle import best_nodes
from zsched_lab.paper.radio import drive_file
from zsched_lab.paper.record import HostGauge, NodeMeter
from zsched_lab.paper.robots import Place, Robots
from zsched_lab.paper.roles import RoleMeter
from zsched_lab.paper.rules import RulePlan
from zsched_lab.paper.scenario import LinkView, Scenario
from zsched_lab.paper.schemes import scheme_tree
from zsched_lab.paper.spaces import NodeChildren, narrow_links, spaced

TICK_S = 0.1
SAMPLE_S = 0.5
OWNED_S = 40.0
"""The task must have its first owner, and every node its worker ready, within this time."""
RECORDER_S = 20.0
CALM_S = 8.0
"""The robots wait for at most this long for the start-up's CPU to fade from the nodes' smoothed figures."""
LEAD_S = 2.0
"""From the start of the robots' programs to their begin: by then they are up (0.4 to 0.8 s here)."""
SETTLE_S = 2.0
"""After the robots' drive: their last maps are merged and come back."""
RUN_SCHEMA = "zsched.paper.run/1"

Tree = dict[str, Any]


@dataclass(frozen=True, slots=True, kw_only=True)
class Inputs:
    """What the robots see, and the folder of recorded radio drives if there is one."""

    robots: Robots
    drives: Path | None = None


@dataclass(frozen=True, slots=True)
class _Parts:
    """What a running cell is made of."""

    fleet: LabFleet
    runner: FleetRunner
    limits: NodeLimits
    loads: Loads
    observer: Observer
    gauge: HostGauge


class Seen:
    """Which robots have said that the map they hold covers the target."""

    def __init__(self, robots: tuple[NodeId, ...], records: Path) -> None:
        self._waiting = {robot: Follower(records / f"{robot}.ndjson") for robot in robots}

    def is_covered(self) -> bool:
        """Whether all have."""
        for robot, follower in tuple(self._waiting.items()):
            if any(record.get("kind") == "covered" for record in follower.new()):
                del self._waiting[robot]
        return not self._waiting


class CellRun:
    """One cell in one folder. For the main thread only (see `Children`)."""

    def __init__(self, scenario: Scenario, cell: Cell, inputs: Inputs, folder: Path) -> None:
        self._scenario, self._cell, self._inputs, self._folder = scenario, cell, inputs, folder
        self._records = folder / "records"
        self._recorder = Recorder(self._records)
        self._plan_path = folder / "plan.json"
        self._seed = scenario.run_seed(cell.run)
        self._untold: dict[NodeId, dict[str, float]] = {}
        self._bandwidth_mbit = bandwidth_of(scenario, cell)
        self.left_behind: list[str] = []
        """What could not be removed when the run had ended."""
        self._windows: tuple[Window, ...] = ()
        self._meters: dict[NodeId, NodeMeter] = {}
        self._roles: dict[NodeId, RoleMeter] = {}
        self._decided: dict[NodeId, object] = {}
        self._next_sample_s = 0.0
        self._zero_s, self._zero_wall_ns = 0.0, 0

    def run(self) -> dict[str, Any]:
        """Make the run; returns what ``run.json`` holds.

        Raises:
            ChildError: a process of the run failed, or the fleet did not come up.
        """
        nodes, logs = sorted(read_tree(self._scenario.fleet)["nodes"]), self._folder / "logs"
        with (
            self._recorder,
            narrow_links(nodes, self._bandwidth_mbit) as network,
            NodeChildren(logs, network, nodes) as children,
        ):
            parts = self._build(children, network)
            try:
                body = self._play(children, parts)
            finally:
                parts.loads.stop(monotonic_s() - self._zero_s)
        self.left_behind = children.left_behind
        return body

    def _build(self, children: Children, network: Network | None) -> _Parts:
        runtime = Path(tempfile.gettempdir()) / f"zsched-{children.token}"
        children.janitor.remove(runtime)
        runtime.mkdir(mode=0o700)
        fleet = self.write_fleet()
        fleet = fleet if network is None else spaced(fleet, network)
        shares = {node: share for node, share in self._scenario.nodes.items() if node in fleet.kinds}
        limits = node_limits(f"zsched-{children.token}", self._scenario, fleet)
        candidates = sorted(shares)
        self._windows = schedule(self._scenario.load, candidates, self._scenario.duration_s, self._seed)
        level = self._scenario.levels[self._cell.level]
        full = self._scenario.full_cores
        self._roles = {node: RoleMeter(partial(limits.pids, node)) for node in shares}
        loads = Loads(self._windows, level, full, children, limits, self._records, self._tell)
        runner = FleetRunner(fleet, children, runtime, limits, self._cli())
        return _Parts(
            fleet=fleet,
            runner=runner,
            limits=limits,
            loads=loads,
            observer=Observer(runner.sockets(), fleet.task, ask, fleet.others),
            gauge=HostGauge.create(f"zsched-{children.token}-host"),
        )

    def _cli(self) -> tuple[str, ...]:
        rule = self._cell.scheme.rule
        if rule is None:
            return CLI
        module = (sys.executable, "-m", "zsched_lab.paper.ruled_daemon")
        return (*module, "--rule", rule.value, "--plan", str(self._plan_path.absolute()))

    def write_fleet(self) -> LabFleet:
        """The effective fleet file: the template, the scheme's settings, the links, free ports, true poses."""
        tree = scheme_tree(read_tree(self._scenario.fleet), self._cell.scheme)
        self._lay_links(tree["nodes"])
        template = self._folder / "template.yaml"
        with template.open("w", encoding="utf-8") as file:
            YAML().dump(tree, file)
        robots = sorted(name for name, node in tree["nodes"].items() if node["kind"] == "robot")
        frames = dict(zip(robots, self._inputs.robots.frames(len(robots), self._seed), strict=True))
        merge = merge_of(self._scenario, self._cell)
        # The merger is told the first robot's start at least, so that its maps lie in the truth's frame; where another
        # robot's map came first, they lie in that one's.
        told = dict(list(frames.items())[:1]) if merge.mode == Mode.ESTIMATE else frames
        self._untold = {robot: asdict(pose) for robot, pose in frames.items() if robot not in told}
        options = worker_options(Mode.KNOWN, told) | {
            "--mode": (merge.mode,),
            "--rate": (f"{merge.rate_hz:g}",),
            "--resolution": (f"{merge.resolution_m:g}",),
            "--min-agreeing": (f"{merge.min_agreeing}",),
        }
        loop = self._scenario.explore
        slam = {
            "--match": (f"{(loop.slam_share or 0.0) * self._scenario.full_cores:g}",),
            "--map-period": (f"{loop.map_period_s:g}",),
        }
        return write_fleet(template, self._folder / "fleet.yaml", options, slam)

    def _lay_links(self, nodes: Tree) -> None:
        traces = {}
        for node, radio in self._scenario.links.items():
            path = drive_file(node, radio, self._inputs.drives, self._folder, self._seed)
            traces[node] = {"file": str(path), "column": radio.column, "offset_s": radio.offset_s}
            nodes[node].pop("wired", None)
            nodes[node]["trace"] = traces[node]
        if self._scenario.link_view is not LinkView.DIRECT:
            return
        for node in traces:
            nodes[node]["links"] = {other: {"trace": dict(traces[other])} for other in traces if other != node}

    # --- the run -----------------------------------------------------------------------------------------------------

    def _play(self, children: Children, parts: _Parts) -> dict[str, Any]:
        for node, share in self._scenario.nodes.items():
            if node in parts.fleet.kinds and parts.limits.kind is LimitKind.CGROUP:
                parts.loads.ballast(node, share)
        parts.runner.init()
        parts.runner.up()
        self._gauge_daemons(children, parts)
        with parts.observer:
            parts.runner.wait_up(parts.observer.statuses, lambda: time.sleep(TICK_S))
            for number, (node, command) in enumerate(self._inputs.robots.helpers(parts.fleet.data_endpoints), start=1):
                parts.limits.put_work(node, children.start(f"helper-{number}-{node}", command).process.pid)
            self._wait_owned(children, parts)
            self._record_streams(children, parts)
            self._start(children, parts)
            done_s = self._drive(children, parts)
            return self._finish(children, parts, done_s)

    def _drive(self, children: Children, parts: _Parts) -> float:
        """The robots' time and a moment more; returns how long they drove."""
        seen = Seen(parts.fleet.robots, self._records)
        end_s = self._scenario.duration_s
        while (now := monotonic_s() - self._zero_s) < end_s + SETTLE_S:
            children.check()
            if now < end_s:
                parts.loads.tick(now)
                if self._inputs.robots.ends_when_covered and seen.is_covered():
                    # What was read now may be younger than `now`: a run ends no sooner than what ended it.
                    end_s = min(monotonic_s() - self._zero_s, end_s)
            self._sample(parts, now)
            time.sleep(TICK_S)
        return end_s

    def _gauge_daemons(self, children: Children, parts: _Parts) -> None:
        for node in parts.fleet.kinds:
            child = children.running(f"daemon-{node}")[0]
            if node in self._scenario.nodes and parts.limits.kind is LimitKind.CGROUP:
                self._meters[node] = NodeMeter.of(child.process.pid)
            else:
                parts.gauge.add(child.process.pid)

    def _wait_owned(self, children: Children, parts: _Parts) -> None:
        """Until the task has an owner and every candidate's worker is ready: nobody starts with a handicap."""
        tasks = (parts.fleet.task, *parts.fleet.others)
        given = read_tree(self._folder / "template.yaml")["tasks"]
        wanted = {(task, node) for task in tasks for node in given[task]["candidates"]}
        end = time.monotonic() + OWNED_S
        while True:
            children.check()
            views = parts.observer.statuses()
            ready = {(task, node) for task in tasks for view in views.values() for node in ready_workers(view, task)}
            owners = {owner for r in parts.fleet.robots if r in views for owner in owners_of(views[r], tasks)}
            if wanted <= ready and owners and None not in owners:
                break
            if time.monotonic() > end:
                late = ", ".join(f"{task} on {node}" for task, node in sorted(wanted - ready)) or "an owner"
                raise ChildError(f"no {late} within {OWNED_S:.0f} s; see {self._folder / 'logs'}")
            time.sleep(TICK_S)

        calm_by = time.monotonic() + CALM_S
        while time.monotonic() < calm_by and not is_calm(parts.observer.statuses(), tuple(self._scenario.nodes)):
            children.check()
            time.sleep(TICK_S)

    def _record_streams(self, children: Children, parts: _Parts) -> None:
        """One recorder for all robots, or behind narrow links one beside each: its copies must not pass the link."""
        robots = parts.fleet.robots
        groups = {"": robots} if self._bandwidth_mbit is None else {f"-{robot}": (robot,) for robot in robots}
        for suffix, heard in groups.items():
            command = [sys.executable, "-m", "zsched_lab.paper.record"]
            command += ["--out", str(self._folder / f"streams{suffix}.mcap")]
            for robot in heard:
                command += ["--robot", f"{robot}={parts.fleet.data_endpoints[robot]}"]
            parts.gauge.add(children.start(f"record{suffix}", command).process.pid)

    def _start(self, children: Children, parts: _Parts) -> None:
        """The robots drive; from here all times count.

        They begin together, once all of their programs are up: then each robot's maps come at its own moments of every
        half second, under every scheme the same ones. (Maps that come together are merged together: without that, how
        many merged maps there are was mostly a matter of which program was up first.)
        """
        robots = parts.fleet.robots
        warm_s = self._scenario.warm_up_s
        lead_s = LEAD_S + warm_s
        self._zero_s, self._zero_wall_ns = monotonic_s() + lead_s, time.time_ns() + round(lead_s * 1e9)
        for index, robot in enumerate(robots):
            place = Place(
                robot=robot,
                index=index,
                robots=len(robots),
                seed=self._seed,
                endpoint=parts.fleet.data_endpoints[robot],
                records=self._records,
                duration_s=self._scenario.duration_s,
                target_coverage=self._scenario.target_coverage,
                begin_s=self._zero_s - warm_s,
                drive_s=self._zero_s if warm_s > 0.0 else None,
            )
            child = children.start(f"app-{robot}", self._inputs.robots.command(place))
            parts.gauge.add(child.process.pid)
        while monotonic_s() < self._zero_s:
            children.check()
            time.sleep(TICK_S)
        parts.gauge.start()
        level = self._scenario.levels[self._cell.level]
        best = best_nodes(self._scenario, level, self._windows)
        RulePlan(zero_s=self._zero_s, seed=self._seed, best=best).save(self._plan_path)
        self._recorder.write("events", {"kind": "zero", "t_s": self._zero_s})

    def _sample(self, parts: _Parts, now: float) -> None:
        if now < self._next_sample_s:
            return
        self._next_sample_s = now + SAMPLE_S
        nodes = {node: meter.read(monotonic_s()) for node, meter in self._meters.items()}
        roles = {node: meter.read() for node, meter in self._roles.items()}
        record = {"kind": "nodes", "t_s": now, "loaded": sorted(parts.loads.loaded), "roles": roles, **nodes}
        self._recorder.write("nodes", record)
        for node, status in parts.observer.statuses().items():
            task = find_task(status, parts.fleet.task) or {}
            said = {"owner": task.get("owner"), "epoch": task.get("epoch"), "decision": task.get("decision")}
            said |= {"vote": task.get("vote"), "links": own_links(status, node)}
            if node in parts.fleet.robots and said != self._decided.get(node):
                self._decided[node] = said
                self._recorder.write("decisions", {"kind": "decision", "t_s": now, "node": node, **said})

    def _finish(self, children: Children, parts: _Parts, drove_s: float) -> dict[str, Any]:
        host = parts.gauge.result()
        parts.loads.stop(monotonic_s() - self._zero_s)
        told = {task: parts.observer.moves(task) for task in (parts.fleet.task, *parts.fleet.others)}
        since = {task: [asdict(move) | {"t_s": move.t_s - self._zero_s} for move in own] for task, own in told.items()}
        streams = {node: task_streams(status, parts.fleet.task) for node, status in parts.observer.statuses().items()}
        apps = [*children.running("app-"), *children.running("record"), *children.running("helper-")]
        children.stop(*apps, grace_s=RECORDER_S)
        children.stop(*children.running("daemon-"))
        body = {
            "schema": RUN_SCHEMA,
            "version": __version__,
            "machine": machine_text(),
            "scenario": self._scenario.name,
            "scheme": self._cell.scheme.name,
            "family": self._cell.scheme.family.value,
            "block": self._cell.block,
            "bandwidth_mbit": self._bandwidth_mbit,
            "level": self._cell.level,
            "run": self._cell.run,
            "seed": self._seed,
            "mode": merge_of(self._scenario, self._cell).mode,
            "input": self._inputs.robots.name,
            "links": "recorded" if self._inputs.drives else "simulated",
            "limits": parts.limits.says,
            "zero_s": self._zero_s,
            "zero_wall_ns": self._zero_wall_ns,
            "duration_s": drove_s,
            "warm_up_s": self._scenario.warm_up_s,
            "robots": parts.fleet.robots,
            "untold_frames": self._untold,
            "shares": {node: asdict(share) for node, share in self._scenario.nodes.items()},
            "windows": [asdict(window) for window in self._windows],
            "loads": [asdict(load) for load in parts.loads.past],
            "allocations": since.pop(parts.fleet.task),
            "others": since,
            "streams": streams,
            "host": host,
        }
        write_json(self._folder / "run.json", body)
        return body

    def _tell(self, t_s: float, text: str) -> None:
        self._recorder.write("events", {"kind": "event", "t_s": t_s, "text": text})


def machine_text() -> str:
    """What this run is made on, in a few words."""
    parts = (f"{os.cpu_count()} cores", processor() or platform.machine(), f"Linux {platform.release()}")
    return f"{', '.join(parts)}, Python {platform.python_version()}"


def write_json(path: Path, body: Mapping[str, Any]) -> None:
    """Write it so that nobody reads half of it."""
    half = path.with_suffix(".part")
    half.write_text(json.dumps(body, indent=1) + "\n", encoding="utf-8")
    half.rename(path)
