"""The programme of a rehearsal: which step comes next, what it has shown, and when to stop.

Knows: guard rails, looks at the fleet, promises. Does not know: how the fleet is asked, or how a step is done.

=========  ================================================  =====================================================
in         when                                              then
=========  ================================================  =====================================================
calm       the task was whole for ``calm_s`` without a       `Strike` (the next step), or a step that a guard rail
           change of owner                                   was refused is left out
calm       the node that a step drained is drained yet       `Lift` (that drain), again until it is lifted
calm       the task is paused or bound, no other node is     stopped
           fit, or it is not calm within ``limit_s``
struck     the task is whole again and every stream that     judged: the next step, or the end
           flowed flows again, and both were counted
struck     a promise is broken, or it is not whole within    broken: the end
           ``limit_s``
=========  ================================================  =====================================================

So there is never a second fault while one is under way, and never one without a second fit candidate. A step that was
refused is left out and told. Whoever runs the programme lifts its drain also when it ends within that step.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final

from zsched.core.values.model import NodeId
from zsched.core.values.rehearsal import Promised, Step
from zsched.core.values.struct import Struct, field, replace

COUNTED_S: Final = 2.2
"""A rehearsal waits this long for counters after a step; relays count once a second."""
MIN_CALM_S: Final = 11.0
"""A shorter calm would take the gap of one step for the usual one of the next (`zsched.core.route.gaps`)."""
PLANNED: Final = (Step.MOVE, Step.DRAIN)
"""Steps that take nothing from the task: it is whole all the time."""
TELLS_S: Final = 0.05
"""What a look at a daemon may add to a measured time."""


class Sight(Struct, frozen=True, kw_only=True):
    """One stream at one robot, as the robot's daemon tells it."""

    robot: NodeId
    stream: str
    messages: int
    lost: int
    at_most_lost: int
    doubled: int
    gap_s: float | None = None
    """The longest gap of the last seconds; ``None``: it is no output, or nothing flows."""
    move_gap_s: float | None = None
    """The gap of the move to the owner of `move_epoch`."""
    move_epoch: int = 0


class Look(Struct, frozen=True, kw_only=True):
    """What was seen of the fleet at once."""

    now: float
    owner: NodeId | None
    epoch: int
    since_s: float = math.inf
    """Seconds since the owner was learnt."""
    switched_s: float | None = None
    """Of the slowest robot."""
    hold: str = ""
    """Why nobody may touch the task; empty: one may."""
    lacks: tuple[str, ...] = ()
    """What the task still lacks at full strength."""
    fit: tuple[NodeId, ...] = ()
    """The other nodes that could have the task at once."""
    drained: tuple[NodeId, ...] = ()
    """The nodes that this rehearsal has drained."""
    sights: tuple[Sight, ...] = ()


class Gap(Struct, frozen=True, kw_only=True):
    """The longest time without an answer at one robot, and what is usual there."""

    robot: NodeId
    stream: str
    usual_s: float
    gap_s: float | None
    """``None``: not measured."""

    @property
    def more_s(self) -> float | None:
        """How much longer than usual it was."""
        return None if self.gap_s is None else max(0.0, self.gap_s - self.usual_s)


class Result(Struct, frozen=True, kw_only=True):
    """What one step has shown; times are seconds from the step."""

    round: int
    step: Step
    node: NodeId
    """The owner before."""
    taker: NodeId | None = None
    """The owner afterwards."""
    decide_s: float | None = None
    hand_over_s: float | None = None
    whole_s: float | None = None
    gaps: tuple[Gap, ...] = ()
    lost: int = 0
    at_most_lost: int = 0
    """Not acknowledged by an owner that died: they may have had no answer."""
    doubled: int = 0
    broken: tuple[str, ...] = ()
    """The promises that were not kept; empty: all were."""
    left_out: str = ""
    """Why it was not done; empty: it was."""


class Do(Struct, frozen=True, kw_only=True):
    """Do this step now, and tell `Programme.struck` or `Programme.leave_out`."""

    round: int
    step: Step
    node: NodeId
    """The owner."""
    target: NodeId
    """Where a move goes."""


class Lift(Struct, frozen=True, kw_only=True):
    """End the drains of this rehearsal now."""

    nodes: tuple[NodeId, ...]


class Wait(Struct, frozen=True, kw_only=True):
    """Look again soon."""

    why: str


class Over(Struct, frozen=True, kw_only=True):
    """Nothing more is done."""

    is_kept: bool
    """Every step that was done kept its promises, and none was cut short."""
    why: str


Action = Do | Lift | Wait | Over


class _Struck(Struct):
    """A step under way."""

    do: Do
    at: float
    before: Look
    usual: Mapping[tuple[NodeId, str], float]
    was_hurt: bool = False
    whole_at: float | None = None
    whole: Look | None = None
    gaps: dict[tuple[NodeId, str], float] = field(default_factory=dict)
    decide_s: float | None = None
    hand_over_s: float | None = None


class Programme:
    """The steps of one rehearsal."""

    def __init__(
        self,
        steps: Sequence[Step],
        promised: Mapping[Step, Promised],
        *,
        rounds: int,
        calm_s: float,
        limit_s: float,
    ) -> None:
        """Plan ``steps`` in their order, ``rounds`` times.

        Args:
            steps: at least one.
            promised: what each of them must keep.
            rounds: at least 1.
            calm_s: how long the task must be whole before each step, in seconds; at least `MIN_CALM_S`.
            limit_s: how long the fleet may take to be whole, before and after each step, in seconds.

        Raises:
            ValueError: one of these is out of its range.
        """
        if not steps or rounds < 1 or calm_s < MIN_CALM_S:
            raise ValueError(f"expected steps, rounds from 1, a calm of {MIN_CALM_S:g} s or more")
        self._left = [(number, step) for number in range(1, rounds + 1) for step in steps]
        self._promised, self._calm_s, self._limit_s = promised, calm_s, limit_s
        self._calm_since: float | None = None
        self._waits_since: float | None = None
        self._owner: tuple[NodeId | None, int] = (None, -1)
        self._next: tuple[Do, Look] | None = None
        self._struck: _Struck | None = None
        self._over: Over | None = None
        self.results: list[Result] = []

    def advance(self, look: Look) -> Action:
        """Take a look in; what to do now."""
        if self._over is not None:
            return self._over
        if self._struck is not None:
            return self._watch(self._struck, look)
        return self._rest(look)

    def struck(self, at: float) -> None:
        """The step of the newest `Do` was begun at ``at`` (monotonic seconds)."""
        assert self._next is not None
        do, look = self._next
        usual = {(one.robot, one.stream): one.gap_s for one in look.sights if one.gap_s is not None}
        self._struck, self._next = _Struck(do=do, at=at, before=look, usual=usual), None
        self._left.pop(0)

    def leave_out(self, why: str) -> None:
        """The step of the newest `Do` was refused: nothing has happened."""
        assert self._next is not None
        do, _ = self._next
        self.results.append(Result(round=do.round, step=do.step, node=do.node, left_out=why))
        self._left.pop(0)
        self._next = None

    @property
    def is_all_left_out(self) -> bool:
        """Whether the programme is through, and no step was done."""
        return not self._left and self._struck is None and all(result.left_out for result in self.results)

    # --- before a step -----------------------------------------------------------------------------------------------

    def _rest(self, look: Look) -> Action:
        """Wait for calm, then name the next step."""
        now = look.now
        self._waits_since = now if self._waits_since is None else self._waits_since
        if look.drained:
            self._calm_since = None
            if now - self._waits_since >= self._limit_s:
                why = f"{', '.join(look.drained)} is still drained after {self._limit_s:g} s"
                return self._end(is_kept=False, why=why)
            return Lift(nodes=look.drained)
        if not self._left:
            if self.is_all_left_out:  # a promise that was not tried was not kept
                return self._end(is_kept=False, why="every step was left out")
            return self._end(is_kept=True, why="every step is done")
        if look.hold:
            return self._end(is_kept=False, why=look.hold)
        is_same = self._owner == (look.owner, look.epoch)
        self._owner = (look.owner, look.epoch)
        if look.lacks or look.owner is None or not is_same:
            self._calm_since = None
            if now - self._waits_since >= self._limit_s:
                lacks = "; ".join(look.lacks) or "its owner changes"
                return self._end(is_kept=False, why=f"not whole within {self._limit_s:g} s: {lacks}")
            return Wait(why=look.lacks[0] if look.lacks else "the owner has changed")
        if not look.fit:
            return self._end(is_kept=False, why=f"no other candidate is fit to take it from {look.owner}")
        self._calm_since = now if self._calm_since is None else self._calm_since
        if now - self._calm_since < self._calm_s:
            return Wait(why=f"calm for {now - self._calm_since:.0f} of {self._calm_s:g} s")
        number, step = self._left[0]
        do = Do(round=number, step=step, node=look.owner, target=look.fit[0])
        self._next = (do, look)
        return do

    def _end(self, *, is_kept: bool, why: str) -> Over:
        is_kept = is_kept and not any(result.broken for result in self.results)
        self._over = Over(is_kept=is_kept, why=why)
        return self._over

    # --- after it ----------------------------------------------------------------------------------------------------

    def _watch(self, struck: _Struck, look: Look) -> Action:
        """Measure until the task is whole and counted, or it takes too long."""
        after_s = look.now - struck.at
        for one in look.sights:
            key = (one.robot, one.stream)
            move_gap_s = one.move_gap_s if one.move_epoch > struck.before.epoch else None
            seen = [gap_s for gap_s in (one.gap_s, move_gap_s, struck.gaps.get(key)) if gap_s is not None]
            if seen and key in struck.usual:
                struck.gaps[key] = max(seen)
        if look.epoch > struck.before.epoch:
            if struck.decide_s is None:
                struck.decide_s = max(0.0, after_s - look.since_s)
            struck.hand_over_s = look.switched_s
        struck.was_hurt |= bool(look.lacks)
        is_hurt = struck.was_hurt or struck.do.step in PLANNED
        if look.lacks or not is_hurt or (struck.do.step is not Step.WORKER and look.epoch == struck.before.epoch):
            struck.whole_at = struck.whole = None
        elif struck.whole_at is None:
            struck.whole_at, struck.whole = look.now, look
        is_counted = struck.whole_at is not None and look.now - struck.whole_at >= COUNTED_S
        if is_counted and not _resting(struck, look):
            return self._judge(struck, look, late="")
        if after_s >= self._limit_s:
            lacks = "; ".join(look.lacks or _resting(struck, look)) or "it has had no effect"
            return self._judge(struck, look, late=f"not whole within {self._limit_s:g} s: {lacks}")
        return Wait(why=look.lacks[0] if look.lacks else "its counters are still to come")

    def _judge(self, struck: _Struck, look: Look, late: str) -> Action:
        result = _result(struck, look)
        broken = (
            *((late,) if late else ()),
            *broken_promises(result, self._promised[struck.do.step], look, struck.before),
        )
        self.results.append(replace(result, broken=broken))
        self._struck = self._calm_since = self._waits_since = None
        if broken:
            return self._end(is_kept=False, why=f"{struck.do.step} of {struck.do.node}: {broken[0]}")
        return self._rest(look)


def _resting(struck: _Struck, look: Look) -> list[str]:
    """The output streams that flowed before the step and have not since the task was whole."""
    if struck.whole is None:
        return []
    before = {(one.robot, one.stream): one.messages for one in struck.whole.sights}
    now = {(one.robot, one.stream): one.messages for one in look.sights}
    return [f"{key[1]} at {key[0]} rests" for key in sorted(struck.usual) if now.get(key) == before.get(key)]


def _result(struck: _Struck, look: Look) -> Result:
    total = {(one.robot, one.stream): one for one in struck.before.sights}
    rises = [(one, total[one.robot, one.stream]) for one in look.sights if (one.robot, one.stream) in total]
    return Result(
        round=struck.do.round,
        step=struck.do.step,
        node=struck.do.node,
        taker=look.owner,
        decide_s=struck.decide_s,
        hand_over_s=struck.hand_over_s,
        whole_s=None if struck.whole_at is None else struck.whole_at - struck.at,
        gaps=tuple(
            Gap(robot=robot, stream=stream, usual_s=usual_s, gap_s=struck.gaps.get((robot, stream)))
            for (robot, stream), usual_s in sorted(struck.usual.items())
        ),
        lost=sum(max(0, now.lost - before.lost) for now, before in rises),
        at_most_lost=sum(max(0, now.at_most_lost - before.at_most_lost) for now, before in rises),
        doubled=sum(max(0, now.doubled - before.doubled) for now, before in rises),
    )


def broken_promises(result: Result, promised: Promised, after: Look, before: Look) -> tuple[str, ...]:
    """The promises that a step has broken, in words; what was not measured breaks none."""
    found = []
    worst = max((gap for gap in result.gaps if gap.more_s is not None), key=lambda gap: gap.more_s or 0.0, default=None)
    if worst is not None and worst.more_s is not None and worst.more_s > promised.gap_s + TELLS_S:
        found.append(
            f"{worst.robot} had no answer for {worst.more_s:.2f} s more than usual, at most {promised.gap_s:.2f} s are "
            "promised"
        )
    decide_s, limit_s = result.decide_s, promised.decide_s
    if decide_s is not None and limit_s is not None and decide_s > limit_s + TELLS_S:
        found.append(f"deciding took {decide_s:.2f} s, at most {limit_s:.2f} s are promised")
    totals = {(one.robot, one.stream): one.lost for one in before.sights}
    for one in after.sights:
        lost = one.lost - totals.get((one.robot, one.stream), one.lost)
        if lost > 0 and one.stream in promised.whole:
            found.append(f"{one.stream} of {one.robot} has lost {lost}, and loses nothing by promise")
    return tuple(found)
