"""The classic faults as scenario files with full transcripts: `tests/sim/scenarios/*.txt`.

A line that begins with ``> `` is a command; what follows it, up to the next one, is all that the fleet said meanwhile;
how nodes meet is one line, "all alive".
``ZSCHED_REGENERATE=1 pytest tests/sim/test_scenarios.py`` writes the transcripts anew: read the difference.

Commands: ``fleet robots=3 edges=2 [exclusive] [seed=N]``, ``start [NODE...]``, ``settle [SECONDS]``, ``run SECONDS``,
``crash|power|wipe|damage NODE``, ``pause NODE SECONDS``, ``cut NODE... | NODE...``, ``one-way NODE... -> NODE...``,
``heal``, ``load NODE SHARE``, ``retune NODE CPU``, ``answers``, ``values``, ``unsettled``,
``sees NODE NODE``. ``owner`` is the owner that every running node knows.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from pathlib import Path
from random import Random

import pytest

from support.fleets import fleet_of, task_of, tuning_of
from zsched.core.values import events as ev
from zsched.core.values.fleet import Fleet, WorkerSpec
from zsched.core.values.messages import TuneTask
from zsched.core.values.model import Asked, Weights
from zsched.core.values.struct import replace
from zsched_lab.sim.simulator import CORES, Simulator

FOLDER = Path(__file__).parent / "scenarios"
FILES = sorted(FOLDER.glob("*.txt"))
TASK = "merge"
MET = " unknown -> alive: beats"


def fleet(words: list[str]) -> Fleet:
    options = dict(word.split("=") for word in words if "=" in word)
    robots = tuple(f"robot{i}" for i in range(1, int(options.get("robots", 3)) + 1))
    edges = tuple(f"edge{i}" for i in range(1, int(options.get("edges", 2)) + 1))
    task = task_of(
        TASK,
        edges,
        tuning=tuning_of(cpu=1.0, memory=0.0),
        price_s=0.1,
        worker=WorkerSpec(command=("work",)),
        exclusive="exclusive" in words,
        drain_s=0.2,
    )
    return fleet_of(task, of=sorted((*robots, *edges)))


class Scene:
    """One scenario on its simulator; `do` returns what was said."""

    def __init__(self) -> None:
        self.sim = Simulator(fleet=fleet([]), seed=1)
        self.busy: dict[str, float] = {}
        self.owner = ""
        self.verbs: dict[str, Callable[[list[str]], list[str] | None]] = {
            "fleet": self.fleet,
            "start": lambda names: self.sim.start(*names),
            "settle": self.settle,
            "run": lambda words: self.sim.run(float(words[0])),
            "crash": lambda names: self.sim.crash(names[0]),
            "power": lambda names: self.sim.crash(names[0], is_power_lost=True),
            "wipe": lambda names: self.lose(names[0], wipe),
            "damage": lambda names: self.lose(names[0], damage),
            "pause": lambda words: self.sim.pause(self.sim.machines[words[0]], float(words[1])),
            "cut": lambda words: self.sim.cut(*self.sides(words, "|")),
            "one-way": self.one_way,
            "heal": lambda _: self.sim.heal(),
            "load": lambda words: self.busy.update({words[0]: float(words[1])}),
            "retune": self.retune,
            "values": self.values,
            "answers": lambda _: sorted(f"{one.result.outcome}: {one.result.detail}" for one in self.sim.answers),
            "unsettled": lambda _: [self.sim.unsettled() or "at rest"],
            "sees": lambda words: [f"{words[0]} sees {words[1]}: {self.sim.sees(words[0], words[1])}"],
        }

    def do(self, line: str) -> list[str]:
        verb, *words = line.split()
        self.owner = self.sim.agreed(TASK) or self.owner if self.sim.running() else self.owner
        before = len(self.sim.stories)
        said = self.verbs[verb]([self.owner if word == "owner" else word for word in words]) or []
        return [*self.met(self.sim.stories[before:]), *said]

    def met(self, stories: list[str]) -> list[str]:
        """The stories; where all that run have come to see one another, one line for all that say so."""
        running = self.sim.running()
        at = [number for number, story in enumerate(stories) if story.endswith(MET)]
        if not at or any(self.sim.sees(one, other) != "alive" for one, other in itertools.permutations(running, 2)):
            return stories
        last = f"{stories[at[-1]].split(' membership ')[0].rpartition(' ')[0]} all alive"
        return [last if number == at[-1] else story for number, story in enumerate(stories) if number not in at[:-1]]

    def fleet(self, words: list[str]) -> None:
        seed = next((int(word.partition("=")[2]) for word in words if word.startswith("seed=")), 1)
        self.sim = Simulator(
            fleet=fleet(words), seed=seed, load=lambda node, _: (CORES * self.busy.get(node, 0.25), 1000.0)
        )

    def settle(self, words: list[str]) -> list[str]:
        began = self.sim.now
        is_done = self.sim.run_until(lambda: not self.sim.unsettled(), float(words[0]) if words else 15.0)
        took = f"at rest after {self.sim.now - began:.3f} s"
        return [f"{took}, owner {self.sim.agreed(TASK)}" if is_done else f"not at rest: {self.sim.unsettled()}"]

    def lose(self, name: str, how: Callable[[Simulator, str], None]) -> None:
        self.sim.crash(name, is_power_lost=True)
        self.sim.machines[name].is_durable = False
        how(self.sim, name)

    @staticmethod
    def sides(words: list[str], mark: str) -> tuple[tuple[str, ...], ...]:
        middle = words.index(mark)
        return tuple(words[:middle]), tuple(words[middle + 1 :])

    def one_way(self, words: list[str]) -> None:
        sources, targets = self.sides(words, "->")
        self.sim.cuts.update(itertools.product(sources, targets))

    def retune(self, words: list[str]) -> None:
        cpu = float(words[1])
        value = self.sim.node(words[0]).registers[TASK].value
        tuning = replace(value.tuning, weights=Weights(cpu=cpu, memory=1.0 - cpu, network=0.0))
        command = TuneTask(task=TASK, tuning=tuning, base_revision=value.revision, asked=Asked(by="ada@robot1"))
        self.sim.deliver(self.sim.machines[words[0]], ev.TuneCommanded(request=1, command=command))

    def values(self, _words: list[str]) -> list[str]:
        found = []
        for name in self.sim.running():
            node, value = self.sim.node(name), self.sim.node(name).registers[TASK].value
            role = "elector" if node.agreement.is_elector else "no elector"
            found.append(f"{name}: revision {value.revision}, epoch {value.epoch}, owner {value.owner}, {role}")
        return found


def wipe(sim: Simulator, name: str) -> None:
    sim.machines[name].disk.wipe()


def damage(sim: Simulator, name: str) -> None:
    sim.machines[name].disk.damage(Random(1))


def played(text: str) -> str:
    scene, out = Scene(), []
    for line in text.splitlines():
        if line.startswith("#"):
            out.append(line)
        elif line.startswith("> "):
            out += [line, *scene.do(line[2:])]
    return "\n".join(out) + "\n"


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_scenario_goes_as_written(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    now = played(text)
    if os.environ.get("ZSCHED_REGENERATE"):
        path.write_text(now, encoding="utf-8")
        return
    assert now.splitlines() == text.splitlines(), "if this is meant: ZSCHED_REGENERATE=1, and read the difference"


def test_there_are_scenarios() -> None:
    assert len(FILES) >= 10
