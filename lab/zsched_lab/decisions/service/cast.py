"""Who takes part: today's rule, the same with ``score: paper``, the paper's, plain argmax, and described ones.

Knows: every rule's name and settings. Does not know: histories, results.
"""

from __future__ import annotations

import types
from collections.abc import Callable, Mapping
from dataclasses import fields
from enum import Enum
from typing import Any, Final, Literal, get_args, get_origin, get_type_hints

from zsched.core.values.fleet import DEFAULT_BONUS, DEFAULT_SCORE, TaskSpec
from zsched.core.values.model import ScoreForm, Tuning, Weights
from zsched_lab.decisions.entries import CPU_ONLY, MEMORY_ONLY, PAPER_COST, RAW
from zsched_lab.decisions.rules import CoreRule, PickRule, Rule
from zsched_lab.decisions.service.replay import Deadline, Player, is_of_task
from zsched_lab.decisions.view import Look, Sight
from zsched_lab.decisions.world import EVEN, RADIO_ONLY
from zsched_lab.paper.schemes import PAPER_BONUS

OWN: Final = ("smoothing_s", "is_told", "tells_jobs")
"""Settings of a rule that are neither of `Tuning` nor of `TaskSpec`; ``is_told=0``: run queues are not read;
``tells_jobs=0``: the worker says nothing of its jobs."""


def players() -> tuple[Player, ...]:
    """The rules that are always compared; the paper's with a cost of 0.1, and two of them with what they have live."""
    return (
        zsched("service"),
        zsched("paper", score=ScoreForm.PAPER),
        _picks("dyna_cpu", CPU_ONLY, PAPER_COST),
        _picks("dyna_mem", MEMORY_ONLY, PAPER_COST),
        _picks("dyna_both", EVEN, PAPER_COST),
        _picks("dyna_cpu, cost 0.05", CPU_ONLY, PAPER_BONUS),
        _picks("dyna_both, cost 0.05", EVEN, PAPER_BONUS),
        _picks("dyna_net", RADIO_ONLY, PAPER_COST),
        _picks("argmax", EVEN, 0.0),
    )


def zsched(name: str, **settings: Any) -> Player:
    """The production's decision. What ``settings`` do not say is what a fleet file gets that does not say it.

    They are fields of `Tuning` and `TaskSpec`, those of `OWN`, and ``deadline`` (`Deadline`).
    """
    given = dict(settings)
    smoothing_s = given.pop("smoothing_s", Look().smoothing_s)
    is_told, tells_jobs = bool(given.pop("is_told", True)), bool(given.pop("tells_jobs", True))
    deadline = given.pop("deadline", None)
    changes = {key: given.pop(key) for key in tuple(given) if is_of_task(key)}
    tuning = Tuning(**{"weights": EVEN, "score": DEFAULT_SCORE, "bonus": DEFAULT_BONUS, **given})
    return Player(
        name=name,
        make=_core(tuning, changes),
        tuning=tuning,
        look=Look(smoothing_s=smoothing_s),
        changes=changes,
        is_told=is_told,
        tells_jobs=tells_jobs,
        deadline=deadline,
    )


def _core(tuning: Tuning, changes: Mapping[str, Any]) -> Callable[[Sight], Rule]:
    own = {name: changes[name] for name in ("price_s", "memory_s") if name in changes}
    return lambda view: CoreRule(view, tuning, **own)


def _picks(name: str, weights: Weights, cost: float) -> Player:
    """The paper's scheduler by its own equations: once a second the argmax, with a cost for leaving."""
    tuning = Tuning(weights=weights, score=ScoreForm.PAPER)
    return Player(name=name, make=lambda view: PickRule(view, cost=cost), tuning=tuning, look=RAW)


def described(text: str) -> Player:
    """A rule by its description, ``NAME:key=value,key=value``. Raises `ValueError` when there is no such setting.

    >>> described("hasty:smoothing_s=0.5,price_s=0.2,weights=0.7/0.3/0").tuning.weights
    Weights(cpu=0.7, memory=0.3, network=0.0)
    """
    name, _, rest = text.partition(":")
    settings: dict[str, Any] = {}
    for part in filter(None, rest.split(",")):
        key, sign, value = part.partition("=")
        if not sign:
            raise ValueError(f"{part!r} is no key=value")
        settings[key] = _value(key, value)
    if not name:
        raise ValueError("a rule needs a name")
    return zsched(name, **settings)


def _value(key: str, text: str) -> Any:
    kinds = _kinds()
    if key not in kinds:
        raise ValueError(f"no setting {key!r}; there are {', '.join(sorted(kinds))}")
    kind = kinds[key]
    if text == "none" and type(None) in get_args(kind):
        return None
    if isinstance(kind, types.UnionType):
        kind = next(one for one in get_args(kind) if one is not type(None))
    if kind is Weights:
        cpu, memory, network = (float(one) for one in text.split("/"))
        return Weights(cpu=cpu, memory=memory, network=network)
    if kind is bool or get_origin(kind) is Literal:
        found = {str(one).lower(): one for one in ((False, True) if kind is bool else get_args(kind))}
        if text not in found:
            raise ValueError(f"{key} is one of {', '.join(found)}, not {text!r}")
        return found[text]
    if isinstance(kind, type) and issubclass(kind, Enum | int | float | str):
        return kind(text)
    raise ValueError(f"{key} cannot be given here")


def _kinds() -> Mapping[str, Any]:
    hints = {**get_type_hints(TaskSpec), **get_type_hints(Tuning)}
    names = {one.name for one in fields(Tuning)} | {name for name in hints if is_of_task(name)}
    return {**{name: hints[name] for name in names}, **dict.fromkeys(OWN, float), "deadline": Deadline}
