"""Ten situations of an operator: what `zsched check -v` and `zsched top` show, and what the fleet does next.

``python -m zsched_lab.decisions.situations`` prints them, so that a reader of docs/design/scheduling.md can foretell
each; with ``--answers`` what happened stands below.

Knows: what happens before each moment, how the product shows it. Does not know: what should happen then
(tests/unit/lab/decisions/test_situations.py), how a node decides.

The nodes of the product decide, in the simulator. The product reads the fleet file and tells its rules, and draws each
screen from a robot's status. Only machines, loads and workers are stand-ins.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

from zsched.commands.look.check import check as tell_rules
from zsched.config.load import check_file
from zsched.core.node.status import build_snapshot
from zsched.core.values import events as ev
from zsched.core.values.document import Flag, FlagKind
from zsched.core.values.fleet import Fleet
from zsched.core.values.messages import ChangeFleet, Hold, HoldTask
from zsched.core.values.model import Asked, NodeId, TaskId
from zsched.core.values.plan import WorkerRole
from zsched.core.values.profile import WorkerLoad, WorkerState
from zsched.core.values.report import snapshot_json
from zsched.core.values.struct import Struct
from zsched.core.values.words import Trouble
from zsched.tools.watch.feed import News, Past
from zsched.tools.watch.top import Frame, render_top
from zsched_lab.sim.simulator import CORES, WALL_MS, Simulator

ROBOTS: Final = ("robot1", "robot2", "robot3")
EDGES: Final = ("edge1", "edge2", "edge3")
BEFORE_S: Final = 2.0
"""The first screen is so much older than the second one."""
AFTER_S: Final = 10.0
"""A question is about so long."""
BANDS: Final = (2.0, 5.0, AFTER_S)
"""How soon a move comes, in seconds after the second screen: the ends of the three answers that there are."""
CALM_CORES, CALM_MB = 0.5, 1000.0
"""What others than the tasks use of a machine."""
STANDBY_MB: Final = 50.0
"""What a worker holds that has not got its task."""
BY: Final = Asked(by="ada@robot1", reason="inspection")
ASKED: Final = f"""\
From the second screen on nothing changes but by what zsched does: loads, workers, links and orders stay as they are.
Where will {{}} be {AFTER_S:g} s after that screen? If it moves, how soon after that screen:
within {BANDS[0]:g} s, {BANDS[0]:g} to {BANDS[1]:g} s, or {BANDS[1]:g} to {BANDS[2]:g} s?"""
TASK: Final = """\
  NAME:
    candidates: {kind: edge}
    weights: {cpu: 0.5, memory: 0.5, network: 0}
    demand: {cpu_cores: 2, memory_mb: 400}
    worker: {command: [/opt/NAME/worker]}
    inputs: [{from: "{robot}/scan", to: "{target}/NAME/{robot}/scan", class: reliable}]
    outputs: [{from: "{target}/NAME/{epoch}/{robot}/out", to: "{robot}/NAME", class: reliable, handover: all}]
"""


def task(name: TaskId, more: str = "") -> str:
    """A task of the fleet file, with a further line."""
    return TASK.replace("NAME", name) + (f"    {more}\n" if more else "")


def fleet_file(tasks: str, electors: tuple[NodeId, ...]) -> str:
    """A fleet file of three robots and three edges."""
    dialled = 'listen: {control: "tcp/0.0.0.0:7457", data: "tcp/0.0.0.0:7458"}'
    kinds = {**dict.fromkeys(ROBOTS, "robot"), **dict.fromkeys(EDGES, "edge")}
    hosts = enumerate(kinds.items(), 11)
    nodes = "".join(f"  {name}: {{kind: {kind}, host: 192.0.2.{n}, {dialled}}}\n" for n, (name, kind) in hosts)
    return f"fleet: hall\ntiming: wifi\nnodes:\n{nodes}electorate: [{', '.join(electors)}]\ntasks:\n{tasks}"


class Hall:
    """One fleet, what others use of its machines, and what a robot's `zsched top` has seen."""

    def __init__(self, fleet: Fleet, cores: Mapping[NodeId, float]) -> None:
        """``cores``: {machine: what others use of it from the start on}."""
        self.cores, self.memory_mb = dict(cores), dict[NodeId, float]()
        self.beside: dict[NodeId, float] = {}
        """{machine: cores that others use there for the sake of a task, while one works there}."""
        self.hung: set[tuple[NodeId, TaskId]] = set()
        """Workers that have exited and do not get ready again."""
        self.past = Past()
        self.sim = Simulator(fleet=fleet, seed=1, load=self._load, loads=self._loads)
        self.sim.start()

    def _at_work(self, node: NodeId) -> list[TaskId]:
        found = []
        for name, role in self.sim.machines[node].roles.items():
            has_lease = role.lease_until_s is None or self.sim.now < role.lease_until_s
            is_at_work = role.role is WorkerRole.ACTIVE and has_lease and (node, name) not in self.hung
            found += [name] if is_at_work else []
        return found

    def _others_cores(self, node: NodeId) -> float:
        helpers = self.beside.get(node, 0.0) if self._at_work(node) else 0.0
        return min(self.cores.get(node, CALM_CORES) + helpers, CORES)

    def _loads(self, node: NodeId, _now: float) -> tuple[WorkerLoad, ...]:
        """Tasks get equal parts of what others leave; a worker that gets less than it needs always wants to run."""
        at_work, found = self._at_work(node), []
        for spec in self.sim.fleet.tasks:
            is_at_work, need = spec.name in at_work, spec.demand
            got = min(need.cpu_cores, (CORES - self._others_cores(node)) / len(at_work)) if is_at_work else 0.0
            load = WorkerLoad(
                task=spec.name,
                state=WorkerState.READY,
                cpu_cores=got,
                memory_mb=need.memory_mb if is_at_work else STANDBY_MB,
                wanted_cores=need.cpu_cores if is_at_work and got < need.cpu_cores else None,
            )
            found += [load] if spec.name in self.sim.machines[node].workers else []
        return tuple(found)

    def _load(self, node: NodeId, now: float) -> tuple[float, float]:
        loads = self._loads(node, now)
        used_mb = self.memory_mb.get(node, CALM_MB) + sum(one.memory_mb or 0.0 for one in loads)
        return self._others_cores(node) + sum(one.cpu_cores or 0.0 for one in loads), used_mb

    def watch(self, seconds: float) -> str:
        """Let time pass, a robot being asked each second; what stands on the terminal then."""
        end = self.sim.now + seconds
        while self.sim.now < end:
            self.sim.run(min(1.0, end - self.sim.now))
            wall_s = WALL_MS / 1e3 + self.sim.now
            status = snapshot_json(build_snapshot(self.sim.node(ROBOTS[0]), self.sim.now))
            self.past.take(News(at=wall_s, status=status))
        frame = Frame(width=110, height=48, is_colored=False, now=wall_s, is_live=False)
        return "\n".join(line.rstrip() for line in render_top(self.past, frame))

    def tell(self, node: NodeId, event: ev.Event) -> None:
        """Something happens on a machine."""
        self.sim.deliver(self.sim.machines[node], event)

    def order(self, name: TaskId, hold: Hold) -> None:
        """An operator's order about a task; a pin is to its owner."""
        self.tell(ROBOTS[0], ev.HoldCommanded(request=1, command=HoldTask(task=name, hold=hold, asked=BY)))

    def drain(self, node: NodeId) -> None:
        """An operator drains a machine, in a new document of the fleet."""
        flag = Flag(kind=FlagKind.DRAIN, subject=node, reason=BY.reason, by=BY.by, revision=1)
        document = self.sim.documents.write(self.sim.fleet, (flag,))
        self.tell(ROBOTS[0], ev.FleetCommanded(request=1, command=ChangeFleet(document=document)))

    def hang(self, node: NodeId, name: TaskId) -> None:
        """A worker exits, and the one that is started in its place does not get ready."""
        self.hung.add((node, name))
        state, trouble = WorkerState.STARTING, Trouble.AGAIN
        self.tell(node, ev.WorkerChanged(task=name, state=state, trouble=trouble, reason="restarting: exit code 1"))


Happens = Callable[[Hall], None]


def load(node: NodeId, cores: float) -> Happens:
    """From now on others use so many cores there."""
    return lambda hall: hall.cores.update({node: cores})


class Situation(Struct, frozen=True, kw_only=True):
    """What happens before a moment."""

    name: str
    at_s: float
    """The moment, seconds since the start."""
    steps: tuple[tuple[float, Happens], ...]
    """(seconds since the start, what happens then)."""
    tasks: str = task("map")
    electors: tuple[NodeId, ...] = ROBOTS
    cores: tuple[tuple[NodeId, float], ...] = ()
    """(machine, what others use of it from the start on)."""


class Next(Struct, frozen=True, kw_only=True):
    """What one task does after the moment."""

    task: TaskId
    was: NodeId | None
    moves: tuple[tuple[float, NodeId | None, str], ...]
    """(seconds after the second screen, where to, the reason that the product gave)."""
    says: str
    """What the product says last of where it is then."""

    @property
    def owner(self) -> NodeId | None:
        """Where it is in the end."""
        return self.moves[-1][1] if self.moves else self.was

    def __str__(self) -> str:
        moves = [f"{after_s:.1f} s after the second screen to {to}: {reason}" for after_s, to, reason in self.moves]
        told = [f"{self.task} was at {self.was}, and {AFTER_S:g} s later is at {self.owner}", *moves]
        return "\n  ".join([*told, f"the last judgement: {self.says}"])


def play(situation: Situation) -> tuple[list[str], tuple[Next, ...]]:
    """(the answer of `zsched check -v` and both screens, what each task does then)."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "fleet.yaml")
        path.write_text(fleet_file(situation.tasks, situation.electors), encoding="utf-8")
        with contextlib.redirect_stdout(io.StringIO()) as check, contextlib.redirect_stderr(check):
            tell_rules(path, verbose=True)
        fleet = check_file(path).fleet
    assert fleet is not None, check.getvalue()
    hall = Hall(fleet, dict(situation.cores))
    for at_s, happens in situation.steps:
        hall.sim.later(at_s, lambda happens=happens: happens(hall))
    screens = [check.getvalue(), hall.watch(situation.at_s - BEFORE_S), hall.watch(BEFORE_S)]
    return screens, _followed(hall.sim)


def _followed(sim: Simulator) -> tuple[Next, ...]:
    """What each task does from now on, as a robot learns it."""
    began_at, node = sim.now, sim.node(ROBOTS[0])
    was = {name: register.value.owner for name, register in node.registers.items()}
    moves = {name: [(0.0, owner, "")] for name, owner in was.items()}

    def look() -> bool:
        for name, register in node.registers.items():
            if register.value.owner != moves[name][-1][1]:
                moves[name].append((sim.now - began_at, register.value.owner, node.history[name][-1].reason))
        return False

    sim.run_until(look, AFTER_S)
    last = {name: node.rounds.tasks[name].judgement for name in was}
    says = {name: "" if one is None else one.reason for name, one in last.items()}
    return tuple(Next(task=name, was=was[name], moves=tuple(moves[name][1:]), says=says[name]) for name in was)


SITUATIONS: Final = (
    Situation(name="within the bonus", at_s=28.0, steps=((25.0, load("edge1", 2.07)),)),
    Situation(
        name="a large lead, the best one drained",
        at_s=28.6,
        steps=((10.0, lambda hall: hall.drain("edge2")), (28.0, load("edge1", 2.7))),
        cores=(("edge3", 1.2),),
    ),
    Situation(name="a small lead", at_s=27.0, steps=((25.0, load("edge1", 2.25)),)),
    Situation(
        name="a worker that does not start",
        at_s=28.0,
        steps=((25.0, lambda hall: hall.hang("edge1", "map")),),
        tasks=task("map").replace("worker]", "worker], start_deadline_s: 8"),
        cores=(("edge2", 2.5),),
    ),
    Situation(
        name="paused, and its owner is gone",
        at_s=28.0,
        steps=((15.0, lambda hall: hall.order("map", Hold.PAUSE)), (25.0, lambda hall: hall.sim.crash("edge1"))),
    ),
    Situation(
        name="pinned to a machine that is back",
        at_s=26.0,
        steps=(
            (10.0, lambda hall: hall.order("map", Hold.PIN)),
            (15.0, load("edge1", 2.7)),
            (20.0, lambda hall: hall.sim.crash("edge1")),
            (25.0, lambda hall: hall.sim.start("edge1")),
        ),
    ),
    Situation(
        name="two tasks, room for one",
        at_s=25.4,
        steps=((20.0, load("edge1", 1.0)), (25.0, load("edge2", 0.5))),
        tasks=task("map", "scheduling: {bonus: 0.1}") + task("plan"),
        cores=(("edge2", 3.5), ("edge3", 3.5)),
    ),
    Situation(
        name="a machine that has not kept its promise",
        at_s=53.0,
        steps=(
            (0.0, lambda hall: hall.beside.update(edge2=2.2)),
            (15.0, load("edge1", 3.2)),
            (30.0, load("edge1", 0.5)),
            (50.0, load("edge1", 2.5)),
        ),
        cores=(("edge3", 3.0),),
    ),
    Situation(
        name="a preferred machine is free again",
        at_s=26.2,
        steps=((25.0, load("edge2", 0.5)),),
        tasks=task("map", "scheduling: {prefer: {edge2: 0.1}}"),
        cores=(("edge2", 3.0),),
    ),
    Situation(
        name="an exclusive owner that rests, and nobody else can",
        at_s=30.0,
        steps=(
            (15.0, lambda hall: hall.memory_mb.update(edge2=3700.0)),
            (20.0, lambda hall: hall.sim.work.fail(hall.sim.machines["edge3"], "map", is_final=True)),
            (25.0, lambda hall: hall.sim.cut(("edge1",), ("edge2", "edge3"))),
        ),
        tasks=task("map", "exclusive: true"),
        electors=EDGES,
    ),
)


def main(arguments: list[str] | None = None) -> int:
    """Print the situations, without their names, which would tell too much."""
    parser = argparse.ArgumentParser(prog="python -m zsched_lab.decisions.situations", description=__doc__)
    parser.add_argument("--answers", action="store_true", help="print what happened, too")
    given = parser.parse_args(arguments)
    for number, situation in enumerate(SITUATIONS, 1):
        (check, before, now), answers = play(situation)
        parts = [f"=== {number} ===", f"$ zsched check -v fleet.yaml\n{check}"]
        parts += [f"$ zsched top    ({BEFORE_S:g} s before)\n{before}", f"$ zsched top    (now)\n{now}"]
        parts.append(ASKED.format(" and ".join(one.task for one in answers)))
        parts += [f"ANSWER ({situation.name})", *map(str, answers)] if given.answers else []
        print("\n\n".join(parts), end="\n\n\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
