"""The schemes that are compared: the paper's six and its network variant, ours, and yardsticks.

Knows: each scheme as settings of the fleet file, and which need another decision rule (`zsched_lab.paper.rules`).
Does not know: runs, figures.

What the paper does not give is fixed here, once, and told in the report: the "predefined cost" is `PAPER_BONUS`, a
decision is taken every `PAPER_PERIOD_S`, its profilers average over one second; nothing else restrains a move (no
price, no damping). `zsched` is the product as it comes: no setting of it is
touched.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any

from zsched.core.values.errors import ConfigError
from zsched.core.values.model import NodeId
from zsched_lab.paper.rules import RuleName

PAPER_BONUS = 0.05
PAPER_PERIOD_S = 1.0
PAPER_SMOOTHING_S = 1.0

Tree = dict[str, Any]


class Family(StrEnum):
    """What a scheme is there for."""

    FIXED = "fixed"
    PAPER = "paper"
    OURS = "zsched"
    YARDSTICK = "yardstick"


@dataclass(frozen=True, slots=True, kw_only=True)
class Scheme:
    """One scheme.

    ``weights`` are (cpu, memory, network), ``None`` leaves the fleet file's; ``only`` is the number of the one
    candidate that is left (from 0, by name); ``labels`` restricts candidates; ``scheduling`` and
    ``timing`` are laid over the fleet file's blocks; ``rule`` replaces the robots' decision rule.
    """

    name: str
    family: Family
    says: str
    weights: tuple[float, float, float] | None = None
    only: int | None = None
    labels: Mapping[str, str] = field(default_factory=dict)
    scheduling: Mapping[str, float | str] = field(default_factory=dict)
    timing: Mapping[str, float] = field(default_factory=dict)
    rule: RuleName | None = None
    moves_slam: bool = False
    """Whether the tasks beside the first, the robots' SLAM, may go to every edge; else each stays where it is."""


CPU, MEMORY, BOTH, NETWORK = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.5, 0.5, 0.0), (0.0, 0.0, 1.0)
_FREE: Mapping[str, float | str] = {"score": "paper", "bonus": 0.0, "price_s": 0.0}
_TIMING = {"smoothing_s": PAPER_SMOOTHING_S, "decide_s": PAPER_PERIOD_S}


def _fixed(number: int) -> Scheme:
    return Scheme(
        name=f"fixed_e{number}",
        family=Family.FIXED,
        says=f"the task stays on candidate {number}; no other keeps it warm",
        weights=BOTH,
        only=number - 1,
    )


def _dyna(name: str, weights: tuple[float, float, float], says: str) -> Scheme:
    return Scheme(
        name=name,
        family=Family.PAPER,
        says=f"{says}; bonus {PAPER_BONUS:g}, no other restraint",
        weights=weights,
        scheduling={**_FREE, "bonus": PAPER_BONUS},
        timing=_TIMING,
        rule=RuleName.UNDAMPED,
    )


def _yardstick(name: str, rule: RuleName, says: str, labels: Mapping[str, str] | None = None) -> Scheme:
    return Scheme(
        name=name,
        family=Family.YARDSTICK,
        says=says,
        weights=BOTH,
        labels=labels or {},
        scheduling=_FREE,
        timing=_TIMING,
        rule=rule,
    )


SCHEMES: Mapping[str, Scheme] = {
    scheme.name: scheme
    for scheme in (
        _fixed(1),
        _fixed(2),
        _fixed(3),
        _dyna("dyna_cpu", CPU, "free CPU alone"),
        _dyna("dyna_mem", MEMORY, "free memory alone"),
        _dyna("dyna_both", BOTH, "CPU and memory, half each"),
        _dyna("dyna_net", NETWORK, "the radio alone"),
        Scheme(name="zsched", family=Family.OURS, says="the product's defaults; the fleet file's weights"),
        _yardstick("dyna_both_penalty", RuleName.PENALTY, "as dyna_both, but the cost is taken off the owner"),
        _yardstick("argmax", RuleName.UNDAMPED, "the highest utility, at every decision"),
        _yardstick("random", RuleName.RANDOM, "a candidate by lot every 10 s"),
        _yardstick("first_match", RuleName.FIRST, "the first candidate with the label size=large", {"size": "large"}),
        _yardstick("every_25s", RuleName.EVERY, "the highest utility, once in 25 s"),
        _yardstick("oracle", RuleName.ORACLE, "knows the schedule of the injected load"),
        replace(
            _dyna("dyna_both_slam", BOTH, "as dyna_both, and the robots' SLAM moves, too"),
            family=Family.YARDSTICK,
            moves_slam=True,
        ),
        Scheme(
            name="zsched_slam",
            family=Family.OURS,
            says="as zsched, and the robots' SLAM moves, too",
            moves_slam=True,
        ),
    )
}
PAPER_SCHEMES = ("dyna_cpu", "dyna_mem", "dyna_both")
FIXED_SCHEMES = ("fixed_e1", "fixed_e2", "fixed_e3")
QUICK_SCHEMES = (*FIXED_SCHEMES, "dyna_both", "zsched")


def find_schemes(names: tuple[str, ...]) -> tuple[Scheme, ...]:
    """The schemes of these names; for none all but those that move SLAM, which is no task in the paper's fleet.

    Raises:
        ConfigError: one is unknown.
    """
    unknown = [name for name in names if name not in SCHEMES]
    if unknown:
        raise ConfigError(f"no scheme {', '.join(unknown)}; there are {', '.join(SCHEMES)}")
    return tuple(SCHEMES[name] for name in names or [name for name, one in SCHEMES.items() if not one.moves_slam])


def scheme_tree(tree: Tree, scheme: Scheme) -> Tree:
    """A copy of a fleet file's tree as ``scheme`` wants it."""
    tree = copy.deepcopy(tree)
    candidates, (first, *others) = candidates_of(tree, scheme), tree["tasks"].values()
    for task in (first, *(others if scheme.moves_slam else ())):
        _lay(task, scheme)
        task["candidates"] = list(candidates)
    if scheme.timing:
        timing = tree.get("timing", "wifi")
        tree["timing"] = {**({"profile": timing} if isinstance(timing, str) else timing), **scheme.timing}
    return tree


def _lay(task: Tree, scheme: Scheme) -> None:
    """The scheme's settings over one task's."""
    if scheme.weights is not None:
        task["weights"] = dict(zip(("cpu", "memory", "network"), scheme.weights, strict=True))
    if scheme.scheduling:
        task["scheduling"] = {**task.get("scheduling", {}), **scheme.scheduling}


def candidates_of(tree: Tree, scheme: Scheme) -> list[NodeId]:
    """The first task's candidates under ``scheme``, by name.

    Raises:
        ConfigError: there is no such candidate.
    """
    wanted = next(iter(tree["tasks"].values()))["candidates"]
    nodes: Tree = tree["nodes"]
    names = sorted(nodes) if isinstance(wanted, dict) else sorted(wanted)
    if isinstance(wanted, dict) and "kind" in wanted:
        names = [name for name in names if nodes[name]["kind"] == wanted["kind"]]
    labelled = [n for n in names if scheme.labels.items() <= dict(nodes[n].get("labels", {})).items()]
    names = labelled or names
    if scheme.only is None:
        return names
    if scheme.only >= len(names):
        raise ConfigError(f"{scheme.name}: the fleet has only {len(names)} candidates")
    return [names[scheme.only]]
