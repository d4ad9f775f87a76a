"""What a rule's moves were worth to the task: lost service, outputs, late jobs, wasted moves, how soon it reacted.

Knows: a history's truth, the price of a move. Does not know: how a rule came to its moves.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from zsched_lab.decisions.loads import Array
from zsched_lab.decisions.rules import Move
from zsched_lab.decisions.service.history import Begin, History, mask_of, rank_of
from zsched_lab.decisions.service.oracle import best_path
from zsched_lab.decisions.world import DT_S

SKIP_S: Final = 10.0
"""The first placement waits for figures: nothing counts before."""
FELT: Final = 0.05
"""A load is felt when it takes so much service, and worth a move when another machine gives so much more."""
Where = tuple[int | None, ...]


@dataclass(frozen=True, slots=True, kw_only=True)
class Figures:
    """One rule on one history, every move at ``price_s`` seconds without the task.

    A move while no job comes costs nothing: nobody misses the task then.
    """

    price_s: float
    hours: float
    lost: float
    """Share of the service that the tasks did not get, moves paid."""
    outputs_hz: float
    """Jobs done per second and task."""
    missed: float
    """Share of the jobs that were not done, or later than the deadline."""
    slow: float
    """Share of the jobs that were not done, or took twice as long as on the idle median machine."""
    moves: int
    wasted: int
    """Moves that lost more than they gained until the task's next one."""
    felt: int
    """Loads that took service from a task while another machine had more."""
    reactions_s: tuple[float, ...]
    """From the beginning of each such load to the move away, where there was one before its end."""


@dataclass(frozen=True, slots=True, kw_only=True)
class _Run:
    """Steps ``begin`` to ``end`` under one placement."""

    begin: int
    end: int
    placed: Where


@dataclass(frozen=True, slots=True, kw_only=True)
class _Past:
    """A move as it is judged."""

    task: int
    step: int
    left: int


def truth(history: History, placed: Where, begin: int, end: int, name: str = "service") -> Array:
    """[end - begin, K] of one field of `Shared` under ``placed``; a task without a machine does nothing."""
    out = np.full((end - begin, len(placed)), 1.0 if name in {"missed", "slow"} else 0.0)
    stretch = history.stretch[begin:end]
    for task, machine in enumerate(placed):
        if machine is not None:
            there = history.on[machine][mask_of(placed, machine)]
            out[:, task] = getattr(there, name)[stretch, rank_of(placed, task)]
    return out


def judge(history: History, moves: Sequence[Sequence[Move]], prices_s: Sequence[float]) -> list[Figures]:
    """What one rule's moves (one list per task) were worth on one history, at every price."""
    runs, past = _course(history, moves)
    rates = np.array([work.rate_hz for work in history.works])
    served, done, missed, slow, jobs = (np.zeros(len(rates)) for _ in range(5))
    for run in runs:
        come = rates * history.activity[history.stretch[run.begin : run.end]] * DT_S
        got = truth(history, run.placed, run.begin, run.end)
        served += got.sum(axis=0) * DT_S
        done += (come * got).sum(axis=0)
        missed += (come * truth(history, run.placed, run.begin, run.end, "missed")).sum(axis=0)
        slow += (come * truth(history, run.placed, run.begin, run.end, "slow")).sum(axis=0)
        jobs += come.sum(axis=0)
    total_s = (history.steps - round(SKIP_S / DT_S)) * DT_S
    comes = np.array([history.activity[history.stretch[one.step], one.task] for one in past])
    paid = comes > 0.0
    tasks = np.array([one.task for one in past], dtype=int)
    moved = np.bincount(tasks, weights=paid, minlength=len(rates))
    held_hz = np.bincount(tasks, weights=comes, minlength=len(rates)) * rates
    gains = [_gain(history, runs, past, index) for index in range(len(past))]
    felt, reactions = _reactions(history, runs, past)
    return [
        Figures(
            price_s=price_s,
            hours=total_s / 3600,
            lost=float(1.0 - (served - moved * price_s).sum() / (total_s * len(rates))),
            outputs_hz=float((done - held_hz * price_s).sum() / (total_s * len(rates))),
            missed=float((missed + held_hz * price_s).sum() / jobs.sum()),
            slow=float((slow + held_hz * price_s).sum() / jobs.sum()),
            moves=len(past),
            wasted=sum(gain < (price_s if pays else 0.0) for gain, pays in zip(gains, paid, strict=True)),
            felt=felt,
            reactions_s=tuple(reactions),
        )
        for price_s in prices_s
    ]


def _course(history: History, moves: Sequence[Sequence[Move]]) -> tuple[list[_Run], list[_Past]]:
    """The placements over time and the moves that count, both from `SKIP_S` on."""
    column = {name: index for index, name in enumerate(history.fleet.tasks[0].candidates)}
    skip = round(SKIP_S / DT_S)
    made = sorted(
        (int(np.ceil(move.at_s / DT_S - 1e-9)), task, column[move.owner], move.left)
        for task, mine in enumerate(moves)
        for move in mine
    )
    placed: list[int | None] = [None] * len(moves)
    runs: list[_Run] = []
    past: list[_Past] = []
    since = skip
    for step, task, owner, left in made:
        if step >= history.steps:
            break
        if step > since:
            runs.append(_Run(begin=since, end=step, placed=tuple(placed)))
            since = step
        if left is not None and step >= skip:
            past.append(_Past(task=task, step=step, left=column[left]))
        placed[task] = owner
    runs.append(_Run(begin=since, end=history.steps, placed=tuple(placed)))
    return runs, past


def _gain(history: History, runs: list[_Run], past: list[_Past], index: int) -> float:
    """Service seconds of all tasks that a move gained until its task's next one, against staying."""
    move = past[index]
    until = next((one.step for one in past[index + 1 :] if one.task == move.task), history.steps)
    gain = 0.0
    for run in runs:
        begin, end = max(run.begin, move.step), min(run.end, until)
        if begin < end:
            stayed = (*run.placed[: move.task], move.left, *run.placed[move.task + 1 :])
            gain += float((truth(history, run.placed, begin, end) - truth(history, stayed, begin, end)).sum()) * DT_S
    return gain


def _reactions(history: History, runs: list[_Run], past: list[_Past]) -> tuple[int, list[float]]:
    """(how many loads were felt, seconds to the move away from each that was left before its end)."""
    felt, took_s = 0, []
    for begin in history.begins:
        run = next((run for run in runs if run.begin <= begin.step - 1 and begin.step < run.end), None)
        if run is None:
            continue  # before the beginning, or a task moves at this very moment
        for task in range(len(run.placed)):
            if run.placed[task] != begin.machine or not _is_felt(history, run.placed, task, begin):
                continue
            felt += 1
            left_at = next((one.step for one in past if one.task == task and one.step >= begin.step), history.steps)
            if left_at < begin.end:
                took_s.append((left_at - begin.step) * DT_S)
    return felt, took_s


def _is_felt(history: History, placed: Where, task: int, begin: Begin) -> bool:
    before, after = truth(history, placed, begin.step - 1, begin.step + 1)[:, task]
    if before - after < FELT:
        return False
    others = (
        truth(history, (*placed[:task], other, *placed[task + 1 :]), begin.step, begin.step + 1)[0, task]
        for other in range(len(history.machines))
        if other != begin.machine
    )
    return bool(max(others) - after >= FELT)


def oracle(history: History, price_s: float) -> list[list[Move]]:
    """The moves of the best sequence of placements at ``price_s`` a move, one list per task."""
    skip = round(SKIP_S / DT_S)
    stretches, first, steps = np.unique(history.stretch[skip:], return_index=True, return_counts=True)
    worth = history.service()[stretches].sum(axis=2) * steps[:, None] * DT_S
    shape = (len(history.machines),) * len(history.works)
    prices = np.where(history.activity[stretches] > 0.0, price_s, 0.0)
    _, path = best_path(worth, prices, shape)
    placements = history.placements
    return [
        _changes(history, [placements[place][task] for place in path], (first + skip).tolist())
        for task in range(len(history.works))
    ]


def _changes(history: History, owners: list[int], steps: list[int]) -> list[Move]:
    """The same as moves."""
    names = history.fleet.tasks[0].candidates
    moves = [Move(at_s=0.0, owner=names[owners[0]], left=None)]
    for (before, after), step in zip(itertools.pairwise(owners), steps[1:], strict=True):
        if before != after:
            moves.append(Move(at_s=step * DT_S, owner=names[after], left=names[before]))
    return moves


def fixed(history: History) -> list[list[list[Move]]]:
    """Every way to place the tasks for the whole history."""
    names = history.fleet.tasks[0].candidates
    return [[[Move(at_s=0.0, owner=names[where], left=None)] for where in placed] for placed in history.placements]
