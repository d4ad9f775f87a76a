"""Decision rules that the product does not have, for comparison: each robot's real daemon judges by one of them.

Knows: how a rule changes the joint utilities before they are judged. Does not know: scenarios, processes.

A rule only replaces what a robot thinks of the candidates. Profiles, gathering, votes, the commit by a majority, the
handover and the streams stay the product's own. Some rules follow a plan, a JSON file that the lab writes when the
robots start: ``{"zero_s", "seed", "best": [[from_s, node], ...]}``; before it is there they judge by the utilities.
"""

from __future__ import annotations

import json
import random
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

from zsched.core.scheduler.judge import Judge, Judgement
from zsched.core.scheduler.standing import Standing
from zsched.core.values.model import Allocation, NodeId

PENALTY = 0.05
RANDOM_PERIOD_S = 10.0
EVERY_S = 25.0
CERTAIN = 1.0


class RuleName(StrEnum):
    """The rules."""

    UNDAMPED = "undamped"  # the product's rule without the cap of moves
    PENALTY = "penalty"  # the literal reading of the paper: its cost lowers the owner
    RANDOM = "random"
    FIRST = "first"
    EVERY = "every"
    ORACLE = "oracle"


@dataclass(frozen=True, slots=True, kw_only=True)
class RulePlan:
    """What the lab has laid down for this run; ``best`` by start, in seconds since ``zero_s``."""

    zero_s: float
    seed: int = 0
    best: tuple[tuple[float, NodeId], ...] = ()

    def best_at(self, t_s: float) -> NodeId | None:
        """The node that is best at ``t_s``; ``None`` before the first."""
        return next((node for start, node in reversed(self.best) if start <= t_s), None)

    def save(self, path: Path) -> None:
        """Write it so that nobody reads half of it."""
        half = path.with_suffix(".part")
        half.write_text(json.dumps({"zero_s": self.zero_s, "seed": self.seed, "best": self.best}), encoding="utf-8")
        half.rename(path)


def read_plan(path: Path) -> RulePlan | None:
    """The plan, or ``None`` while it is not there."""
    try:
        body = json.loads(path.read_text(encoding="utf-8"))
    except OSError:
        return None
    best = tuple((float(start), str(node)) for start, node in body["best"])
    return RulePlan(zero_s=float(body["zero_s"]), seed=int(body["seed"]), best=best)


@dataclass(slots=True)
class Rule:
    """One rule with its memory: turns what the robots think of the candidates into what the rule wants.

    A candidate that may not have the task is never in ``aggregates``, so no rule can choose it.
    """

    name: RuleName
    plan_path: Path | None = None
    _plan: RulePlan | None = None
    _decided: int = -1

    def apply(
        self, aggregates: Mapping[NodeId, float], owner: NodeId | None, now: float, *, is_called: bool
    ) -> Mapping[NodeId, float]:
        """The joint utilities as the rule sees them, at ``now`` (monotonic seconds)."""
        match self.name:
            case RuleName.PENALTY:
                return {n: max(value - PENALTY * (n == owner), 0.0) for n, value in aggregates.items()}
            case RuleName.FIRST:
                return _only(aggregates, min(aggregates, default=None), owner)
            case RuleName.RANDOM:
                return self._random(aggregates, owner, now)
            case RuleName.ORACLE:
                return self._oracle(aggregates, owner, now)
            case RuleName.EVERY:
                return self._every(aggregates, owner, now, is_called=is_called)
            case _:
                return aggregates

    def _random(self, aggregates: Mapping[NodeId, float], owner: NodeId | None, now: float) -> Mapping[NodeId, float]:
        plan = self._current()
        if plan is None or not aggregates:
            return aggregates
        window = int((now - plan.zero_s) // RANDOM_PERIOD_S)
        lot = random.Random(f"{plan.seed}/{window}").choice(sorted(aggregates))
        return _only(aggregates, lot, owner)

    def _oracle(self, aggregates: Mapping[NodeId, float], owner: NodeId | None, now: float) -> Mapping[NodeId, float]:
        plan = self._current()
        return aggregates if plan is None else _only(aggregates, plan.best_at(now - plan.zero_s), owner)

    def _every(
        self, aggregates: Mapping[NodeId, float], owner: NodeId | None, now: float, *, is_called: bool
    ) -> Mapping[NodeId, float]:
        plan = self._current()
        if plan is None or owner not in aggregates:
            return aggregates
        window = int((now - plan.zero_s) // EVERY_S)
        if window <= self._decided and not is_called:
            return _only(aggregates, owner, owner)
        self._decided = max(window, self._decided)
        return aggregates

    def _current(self) -> RulePlan | None:
        if self._plan is None and self.plan_path is not None:
            self._plan = read_plan(self.plan_path)
        return self._plan


def _only(aggregates: Mapping[NodeId, float], chosen: NodeId | None, owner: NodeId | None) -> Mapping[NodeId, float]:
    """``chosen`` is certain, all others are out of the question; the owner, when ``chosen`` may not have the task."""
    wanted = chosen if chosen in aggregates else owner
    if wanted not in aggregates:
        return aggregates
    return {name: CERTAIN if name == wanted else 0.0 for name in aggregates}


class RuledJudge(Judge):
    """The product's judge, who sees the candidates as a rule wants, and neither damps nor caps moves."""

    __slots__ = ("rule",)
    rule: Rule

    def judge(self, standing: Standing, allocation: Allocation, **given: Any) -> Judgement:
        """As `Judge.judge`."""
        aggregates = self.rule.apply(
            standing.aggregates, allocation.owner, given["now"], is_called=bool(given["is_called"])
        )
        return super().judge(replace(standing, aggregates=aggregates), allocation, **{**given, "fuse": None})


@dataclass(frozen=True, slots=True, kw_only=True)
class JudgeMaker:
    """Stands where the product makes its judges: ``JudgeMaker(...)(spec=task)``."""

    name: RuleName
    plan_path: Path | None = None
    made: list[RuledJudge] = field(default_factory=list)

    def __call__(self, **given: Any) -> RuledJudge:
        """A judge with a rule of its own (one per task)."""
        judge = RuledJudge(**given)
        judge.rule = Rule(name=self.name, plan_path=self.plan_path)
        self.made.append(judge)
        return judge
