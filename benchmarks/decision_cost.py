"""What one scheduling round costs a robot: ``python -m benchmarks.decision_cost [--repeat 20]``.

One round at one robot, with fresh profiles since the last one: its own utilities (Alg. 2, Calculate_Utility), the other
robots' answers out of their frames, the comparison, the judgement. CPU time of this process; radio between robots and
candidates, so that every utility has all three terms. A table each for the default score, the same with a deadline, and
the paper's. For the first two each machine tells its speed, its threads that wait, and a warm worker; the owner's tells
of its jobs. The last column says how the cost grows with the product of candidates and robots: 1 is proportional.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from benchmarks.common import machine, percentile
from zsched.core.gateway.gateway import Gateway
from zsched.core.scheduler.judge import Judge
from zsched.core.scheduler.scoring import score
from zsched.core.scheduler.standing import compare
from zsched.core.values import codec as wire
from zsched.core.values.fleet import Demand, Fleet, NodeSpec, TaskSpec, Timing
from zsched.core.values.in_force import InForce
from zsched.core.values.messages import Utilities
from zsched.core.values.model import Allocation, NodeKind, PeerState, ScoreForm, Tuning, UtilityVector, Weights
from zsched.core.values.profile import Jobs, Link, LinkSource, Profile, WorkerLoad, WorkerState

CANDIDATES, ROBOTS = (3, 10, 50, 200), (3, 10, 50)
GOAL_MS = 2.0
_WEIGHTS = Weights(cpu=0.4, memory=0.3, network=0.3)
TUNINGS = {
    "service": Tuning(weights=_WEIGHTS, score=ScoreForm.SERVICE),
    "service, with a deadline": Tuning(weights=_WEIGHTS, score=ScoreForm.SERVICE, deadline_ms=300.0),
    "paper": Tuning(weights=_WEIGHTS),
}
JOBS = Jobs(time_s=0.05, cpu_s=0.04, wait_s=0.002, age_s=0.055, done_hz=10.0, wanted_hz=10.0)


@dataclass(slots=True)
class Round:
    """One robot of a fleet, with everything that a round needs."""

    fleet: Fleet
    gateway: Gateway
    tuning: Tuning
    now: float = 100.0

    @classmethod
    def of(cls, candidates: int, robots: int, tuning: Tuning) -> Round:
        """A fleet of so many edges and robots, all of them just heard."""
        edges = tuple(f"edge{index:03d}" for index in range(candidates))
        names = tuple(f"robot{index:03d}" for index in range(robots))
        task = TaskSpec(
            name="task",
            candidates=edges,
            tuning=tuning,
            demand=Demand(cpu_cores=0.4, memory_mb=250.0),
        )
        nodes = [NodeSpec(name=name, kind=NodeKind.EDGE) for name in edges]
        nodes += [NodeSpec(name=name, kind=NodeKind.ROBOT) for name in names]
        fleet = Fleet(name="cost", timing=Timing(), nodes=tuple(nodes), tasks=(task,), electors=names)
        made, is_told = cls(fleet, Gateway(InForce(fleet)), tuning), tuning.score is ScoreForm.SERVICE
        for index, node in enumerate(fleet.nodes):
            link = Link(source=LinkSource.WIRELESS, rssi_dbm=-45.0 - index % 30)
            profile = Profile(
                node=node.name,
                incarnation=1,
                sequence=1,
                cpu_cores=4.0,
                cpu_used_cores=1.0 + index % 7 * 0.3,
                memory_mb=4000.0,
                memory_used_mb=1000.0 + index % 5 * 300.0,
                links=(link,),
                speed=0.5 + index % 4 * 0.4 if is_told else None,
                cpu_pressure=index % 3 * 0.2 if is_told else None,
                runnable=index % 6 * 0.9 if is_told else None,
                workers=(_worker(is_owner=index == 0),) if is_told and node.kind is NodeKind.EDGE else (),
            )
            made.gateway.absorb(profile, made.now)
        return made

    @property
    def allocation(self) -> Allocation:
        """The first candidate has the task."""
        task = self.fleet.tasks[0]
        return Allocation(task=task.name, revision=7, epoch=3, owner=task.candidates[0], tuning=self.tuning)

    def own(self) -> UtilityVector:
        """This robot's utilities."""
        states = dict.fromkeys((node.name for node in self.fleet.nodes), PeerState.ALIVE)
        return score(self.fleet.tasks[0], self.allocation, self.fleet.voters[0], self.gateway, states, self.now)


def _worker(*, is_owner: bool) -> WorkerLoad:
    if not is_owner:
        return WorkerLoad(task="task", state=WorkerState.READY, cpu_cores=0.0, memory_mb=60.0)
    return WorkerLoad(task="task", state=WorkerState.READY, cpu_cores=0.4, memory_mb=240.0, runnable=0.4, jobs=JOBS)


def milliseconds(action: Callable[[], object], repeat: int) -> float:
    """CPU time of ``action``, the median of ``repeat`` runs."""
    took = []
    for _ in range(repeat):
        began_at = time.process_time()
        action()
        took.append((time.process_time() - began_at) * 1000.0)
    return percentile(took, 0.5)


def measure(candidates: int, robots: int, repeat: int, tuning: Tuning) -> tuple[float, float, float, float, int]:
    """(score, decode, compare, judge) in ms, and the bytes of one answer."""
    one = Round.of(candidates, robots, tuning)
    task, allocation, voters = one.fleet.tasks[0], one.allocation, one.fleet.voters
    own = one.own()
    frames = [wire.encode(Utilities(voter=name, vectors=(replace(own, voter=name),))) for name in voters]
    answers = [wire.decode(frame, Utilities) for frame in frames]
    vectors = {answer.voter: answer.vectors[0] for answer in answers}
    standing = compare(task, allocation, vectors)

    def judge() -> None:
        Judge(spec=task).judge(standing, allocation, escape=None, is_called=False, now=one.now, fuse=None)

    return (
        milliseconds(one.own, repeat),
        milliseconds(lambda: [wire.decode(frame, Utilities) for frame in frames[1:]], repeat),
        milliseconds(lambda: compare(task, allocation, vectors), repeat),
        milliseconds(judge, repeat),
        len(frames[0]),
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.decision_cost", description=__doc__)
    parser.add_argument("--repeat", type=int, default=20)
    given = parser.parse_args()
    print(machine())
    for name, tuning in TUNINGS.items():
        print(f"\n{name}")
        _print_table(tuning, given.repeat)
    print(f"\ngoal: at most {GOAL_MS:g} ms for a round with 200 candidates and 3 robots; a round comes every 500 ms")


def _print_table(tuning: Tuning, repeat: int) -> None:
    print("candidates robots     score    decode   compare     judge     round  (ms)   answer  growth")
    first: tuple[int, float] | None = None
    for candidates in CANDIDATES:
        for robots in ROBOTS:
            *parts, size = measure(candidates, robots, repeat, tuning)
            total = sum(parts)
            first = first or (candidates * robots, total)
            ratio = candidates * robots / first[0]
            growth = math.log(total / first[1]) / math.log(ratio) if ratio > 1 else math.nan
            figures = " ".join(f"{part:9.3f}" for part in (*parts, total))
            print(f"{candidates:10d} {robots:6d} {figures}        {size:6d} B  {growth:5.2f}", flush=True)


if __name__ == "__main__":
    main()
