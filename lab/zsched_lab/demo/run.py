"""One run of the demo, from free ports to the last map: starts everything, injects load, shows and keeps the story.

Knows: the order of a run and its clock. Does not know: how a daemon decides: it starts the same `zsched up` as anybody
and asks the same operator sockets; nor how figures are made of what it keeps.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from zsched.core.values.model import NodeId
from zsched.host.clock import monotonic_s
from zsched.host.operator_client import ask
from zsched.tasks.map_merge.geometry import Pose2
from zsched_lab.demo.evaluate import RunFacts
from zsched_lab.demo.live_view import View
from zsched_lab.fleet.children import ChildError, Children
from zsched_lab.fleet.injector import Injector
from zsched_lab.fleet.limits import make_limits
from zsched_lab.fleet.observer import Observer
from zsched_lab.fleet.recorder import Recorder
from zsched_lab.fleet.runner import CLI, FleetRunner, LabFleet, read_tree, write_fleet
from zsched_lab.fleet.schedule import SchedulePolicy, make_schedule
from zsched_lab.fleet.view import FleetView, Move, NodeView, Status, TaskView, node_views, problems, task_view
from zsched_lab.maps.laser_log import LaserLog
from zsched_lab.maps.mapping import displacements
from zsched_lab.robots.watch import RobotWatch

TICK_S = 0.25
SAMPLE_S = 0.5
DRIVE_END_RATIO = 0.86
"""The robots' drives end here, so that their last maps are merged and come back before the run ends."""
MIN_DRIVE_S = 8.0
REASON_S = 0.8
"""A move is reported this late, so that the daemon that knows why has been asked too."""
TRUTH_S = 90.0
"""The truth may still take this long after the run (long logs on slow machines)."""
EDGE_CORES = (0.4, 0.5, 0.5)
"""CPU quotas of the edges in turn: the first is the weak one, as in the paper."""
EDGE_MEMORY_MB = 768.0


@dataclass(frozen=True, slots=True, kw_only=True)
class RunPlan:
    """What is to be run."""

    out: Path
    log_path: Path
    log: LaserLog
    duration_s: float
    mode: str
    seed: int
    policy: SchedulePolicy
    cli: tuple[str, ...] = CLI
    """The command behind which ``init`` and ``up`` follow."""

    @property
    def records(self) -> Path:
        """Folder of everything that is written down while it happens."""
        return self.out / "records"

    @property
    def recording(self) -> Path:
        """What `zsched record` writes of the run."""
        return self.out / "run.mcap"


def fleet_template() -> Path:
    """The demo's fleet file, shipped with the package."""
    return Path(__file__).parents[1] / "data" / "demo.yaml"


def worker_options(mode: str, frames: Mapping[NodeId, Pose2]) -> dict[str, tuple[str, ...]]:
    """The merging worker's mode, and the true poses of the robots' map frames unless it is to find them itself."""
    poses = tuple(f"{robot}={pose.x:.6f},{pose.y:.6f},{pose.yaw:.9f}" for robot, pose in frames.items())
    return {"--mode": (mode,), "--pose": () if mode == "estimate" else poses}


class DemoRun:
    """One run. For the main thread only: children follow the life of the thread that starts them."""

    def __init__(self, plan: RunPlan, children: Children, view: View) -> None:
        """Write the effective fleet file and prepare; no process is started yet but the truth's."""
        self._plan = plan
        self._children = children
        self._view = view
        self._events: deque[tuple[float, str]] = deque(maxlen=200)
        self._told_epoch = 0
        self._cpu: dict[NodeId, list[tuple[float, float]]] = {}
        self._memory: dict[NodeId, list[tuple[float, float]]] = {}
        self._next_sample_s = 0.0
        self._start_s = monotonic_s()
        self._phase = "starting"
        self._recorder = Recorder(plan.records)
        runtime = Path(tempfile.gettempdir()) / f"zsched-{children.token}"
        children.janitor.remove(runtime)
        runtime.mkdir(mode=0o700)
        self._truth = plan.records / "truth.cdr"
        children.start("truth", [sys.executable, "-m", "zsched_lab.maps.truth", str(plan.log_path), str(self._truth)])
        self._fleet, self._frames = make_fleet(plan)
        cores = {edge: EDGE_CORES[index % len(EDGE_CORES)] for index, edge in enumerate(self._fleet.edges)}
        self._limits = make_limits(f"zsched-{children.token}", cores, EDGE_MEMORY_MB)
        self._runner = FleetRunner(self._fleet, children, runtime, self._limits, plan.cli)
        self._observer = Observer(self._runner.sockets(), self._fleet.task, ask)
        self._robots = tuple(RobotWatch.of(robot, plan.records) for robot in self._fleet.robots)
        schedule = make_schedule(plan.policy, plan.duration_s, plan.seed, self._fleet.edges)
        self._injector = Injector(schedule, self._runner, children, plan.records, self._tell)

    def run(self) -> RunFacts:
        """Run to the end; the robots' last maps are in the records when it returns.

        Raises:
            ChildError: a process of the run failed.
        """
        with self._recorder:
            self._tell(0.0, self._limits.says)
            self._runner.init()
            self._start_s = monotonic_s()
            self._runner.up()
            self._tell(0.0, f"{len(self._fleet.kinds)} daemons started")
            with self._observer:
                self._runner.wait_up(self._observer.statuses, self._tick)
                self._start_recording()
                self._tell(self._now_s(), "all daemons answer; the robots start to drive")
                self._start_robots()
                self._phase = "running"
                while self._now_s() < self._plan.duration_s:
                    self._children.check()
                    self._tick()
                self._phase = "ending"
                self._tick()
            return self._end()

    def _now_s(self) -> float:
        return monotonic_s() - self._start_s

    def _tell(self, t_s: float, text: str) -> None:
        """Show and keep one event."""
        self._events.append((t_s, text))
        self._recorder.write("events", {"kind": "event", "t_s": self._start_s + t_s, "text": text})
        self._view.event(t_s, text)

    def _start_recording(self) -> None:
        """What an operator would type: the fleet as its first robot sees it, that robot's maps, and its frames."""
        robot = self._fleet.robots[0]
        command = [*self._plan.cli, "record", "--output", str(self._plan.recording), "--node", robot]
        command += ["--runtime-dir", str(self._runner.socket(robot).parent)]
        command += ["--map", f"{robot}/map", "--map", f"{robot}/global_map", "--tf", f"{robot}/map_merge/tf"]
        self._children.start("record", command)

    def _start_robots(self) -> None:
        replay_s = max(MIN_DRIVE_S, DRIVE_END_RATIO * self._plan.duration_s - self._now_s())
        robots = self._fleet.robots
        for index, robot in enumerate(robots):
            command = [sys.executable, "-m", "zsched_lab.robots.app", "--robot", robot, "--index", str(index)]
            command += ["--robots", str(len(robots)), "--seed", str(self._plan.seed), "--log", str(self._plan.log_path)]
            command += ["--endpoint", self._fleet.data_endpoints[robot], "--records", str(self._plan.records)]
            self._children.start(f"app-{robot}", [*command, "--replay-s", f"{replay_s:.3f}"])

    def _tick(self) -> None:
        """Look, act, show, and wait for the next tick."""
        now = self._now_s()
        statuses = self._observer.statuses()
        task = self._newest_task(statuses)
        self._tell_moves()
        if self._phase == "running":
            self._injector.tick(now, task.owner if task else None)
        for watch in self._robots:
            watch.update()
        owner = task.owner if task else None
        nodes = node_views(statuses, self._fleet.kinds, self._fleet.task, owner, self._injector.loaded)
        self._sample(now, nodes, task)
        self._view.show(self._fleet_view(now, nodes, task, problems(statuses)))
        time.sleep(max(0.0, TICK_S - (self._now_s() - now)))

    def _newest_task(self, statuses: Mapping[NodeId, Status]) -> TaskView | None:
        """The task as the robot sees it that has learnt most."""
        seen = (task_view(statuses[robot], self._fleet.task) for robot in self._fleet.robots if robot in statuses)
        return max((task for task in seen if task is not None), key=lambda task: task.epoch, default=None)

    def _tell_moves(self) -> None:
        moves = self._moves()
        for index, move in enumerate(moves):
            if move.epoch <= self._told_epoch or self._now_s() - move.t_s < REASON_S:
                continue
            self._told_epoch = move.epoch
            why = f": {move.reason}" if move.reason else ""
            what = f"moves {moves[index - 1].node} -> {move.node}" if index else f"goes to {move.node}"
            self._tell(move.t_s, f"{move.task} {what} (epoch {move.epoch}){why}")

    def _moves(self) -> tuple[Move, ...]:
        """All allocations so far, in seconds since the start."""
        return tuple(
            Move(task=move.task, epoch=move.epoch, node=move.node, t_s=move.t_s - self._start_s, reason=move.reason)
            for move in self._observer.moves()
        )

    def _sample(self, now: float, nodes: tuple[NodeView, ...], task: TaskView | None) -> None:
        """Keep the loads for the figures, twice a second."""
        if now < self._next_sample_s:
            return
        self._next_sample_s = now + SAMPLE_S
        cpu = {node.name: node.cpu_ratio for node in nodes if node.cpu_ratio is not None}
        memory = {node.name: node.memory_ratio for node in nodes if node.memory_ratio is not None}
        for kept, values in ((self._cpu, cpu), (self._memory, memory)):
            for node, ratio in values.items():
                kept.setdefault(node, []).append((now, ratio))
        record = {"kind": "sample", "t_s": self._start_s + now, "cpu": cpu, "memory": memory}
        if task is not None:
            record |= {"owner": task.owner, "epoch": task.epoch, "aggregates": dict(task.aggregates)}
        self._recorder.write("fleet", record)

    def _fleet_view(
        self, now: float, nodes: tuple[NodeView, ...], task: TaskView | None, faults: tuple[str, ...]
    ) -> FleetView:
        robots, edges = len(self._fleet.robots), len(self._fleet.edges)
        log, mode, seed = self._plan.log.name, self._plan.mode, self._plan.seed
        return FleetView(
            title=f"zsched demo: {robots} robots, {edges} edges, log {log}, mode {mode}, seed {seed}",
            phase=self._phase,
            elapsed_s=now,
            duration_s=self._plan.duration_s,
            nodes=nodes,
            task=task,
            maps=tuple(watch.view(monotonic_s()) for watch in self._robots),
            moves=max(0, self._told_epoch - 1),
            events=tuple(f"{t_s:6.1f} s  {text}" for t_s, text in sorted(self._events)),
            problems=faults,
        )

    def _end(self) -> RunFacts:
        """Stop everything, the applications first: they write their last maps."""
        duration_s = self._now_s()
        self._injector.stop(duration_s)
        self._children.stop(*self._children.running("app-"))
        self._children.stop(*self._children.running("record"))
        self._children.stop(*self._children.running("daemon-"))
        for watch in self._robots:
            watch.update()
        self._wait_truth()
        plan, fleet = self._plan, self._fleet
        return RunFacts(
            out=plan.out,
            log_name=plan.log.name,
            mode=plan.mode,
            seed=plan.seed,
            policy=plan.policy.value,
            limits=self._limits.says,
            start_s=self._start_s,
            duration_s=duration_s,
            task=fleet.task,
            kinds=fleet.kinds,
            candidates=fleet.edges,
            frames=self._frames,
            moves=self._moves(),
            loads=self._injector.loads,
            cpu=self._cpu,
            memory=self._memory,
            robots=self._robots,
            truth=self._truth,
        )

    def _wait_truth(self) -> None:
        end = time.monotonic() + TRUTH_S
        while not self._truth.exists():
            self._children.check()
            if time.monotonic() > end:
                raise ChildError(f"the truth of {self._plan.log_path} took longer than {TRUTH_S:.0f} s more")
            time.sleep(0.05)


def make_fleet(plan: RunPlan) -> tuple[LabFleet, dict[NodeId, Pose2]]:
    """Write the effective fleet file; returns the fleet and the true pose of each robot's map frame.

    Raises:
        ConfigError: the template is damaged.
    """
    nodes = read_tree(fleet_template())["nodes"]
    robots = sorted(name for name, node in nodes.items() if node["kind"] == "robot")
    frames = dict(zip(robots, displacements(len(robots), plan.seed), strict=True))
    return write_fleet(fleet_template(), plan.out / "fleet.yaml", worker_options(plan.mode, frames)), frames
