"""The programme of a rehearsal, played against a fleet of figures: each guard rail, each promise, each end."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import pytest

from zsched.core.values.rehearsal import Promised, Step
from zsched.tools.rehearsal.programme import MIN_CALM_S, Action, Do, Lift, Look, Over, Programme, Sight, Wait

STEP_S = 0.25
PROMISED = {
    Step.MOVE: Promised(step=Step.MOVE, gap_s=0.3, decide_s=0.7, whole=("echo/in/0",)),
    Step.DRAIN: Promised(step=Step.DRAIN, gap_s=0.3),
    Step.WORKER: Promised(step=Step.WORKER, gap_s=20.0),
    Step.DAEMON: Promised(step=Step.DAEMON, gap_s=1.8, decide_s=1.5),
}


@dataclass
class Fleet:
    """A task on edge1 that recovers from each step after a while, seen four times a second."""

    programme: Programme
    look: Look
    heals_s: float = 1.0
    gap_s: float = 0.2
    loses: int = 0
    moves: bool = True
    flows: bool = True
    after: Callable[[Look], Look] = field(default=lambda look: look)
    done: list[Do] = field(default_factory=list)
    lifts: bool = True
    lifted: list[float] = field(default_factory=list)
    whole_since: float = 0.0
    _heals_at: float | None = None

    def play(self, seconds: float = 300.0) -> Action:
        until = self.look.now + seconds
        action: Action = Wait(why="")
        while self.look.now < until:
            action = self.programme.advance(self.after(self.look))
            if isinstance(action, Over):
                return action
            if isinstance(action, Lift):
                assert action.nodes == self.look.drained
                self.lifted.append(self.look.now)
                self.look = replace(self.look, drained=() if self.lifts else self.look.drained)
            if isinstance(action, Do):
                assert not self.look.drained, "never a step while another one's drain is in force"
                assert not self.look.lacks, "never a second fault"
                assert self.look.now - self.whole_since >= MIN_CALM_S
                self.done.append(action)
                self.programme.struck(self.look.now)
                self._strike(action)
            self._tick()
        return action

    def _strike(self, do: Do) -> None:
        self._heals_at = self.look.now + self.heals_s
        if do.step is Step.DRAIN:
            self.look = replace(self.look, drained=(do.node,))
        self.look = replace(self.look, lacks=("its owner is gone",))
        if self.moves and do.step is not Step.WORKER:
            self.look = replace(self.look, owner=do.target, epoch=self.look.epoch + 1, since_s=0.0, fit=())

    def _tick(self) -> None:
        look = replace(self.look, now=self.look.now + STEP_S, since_s=self.look.since_s + STEP_S)
        sight = look.sights[0]
        sight = replace(sight, gap_s=0.05, messages=sight.messages + int(self.flows or not self.done))
        if self._heals_at is not None and look.now >= self._heals_at:
            self._heals_at, self.whole_since = None, look.now
            others = tuple(name for name in ("edge1", "edge2") if name != look.owner)
            look = replace(look, lacks=(), fit=others, switched_s=0.1)
            sight = replace(sight, gap_s=self.gap_s, lost=sight.lost + self.loses)
        self.look = replace(look, sights=(sight, *look.sights[1:]))


def fleet(*steps: Step, rounds: int = 1, **given: Any) -> Fleet:
    sights = (
        Sight(robot="robot1", stream="echo/out/0", messages=10, lost=0, at_most_lost=0, doubled=0, gap_s=0.05),
        Sight(robot="robot1", stream="echo/in/0", messages=10, lost=0, at_most_lost=0, doubled=0),
    )
    look = Look(now=100.0, owner="edge1", epoch=3, since_s=60.0, fit=("edge2",), sights=sights)
    programme = Programme(steps, PROMISED, rounds=rounds, calm_s=MIN_CALM_S, limit_s=30.0)
    return Fleet(programme=programme, look=look, whole_since=100.0, **given)


def test_every_step_of_every_round_is_done_in_its_order_and_measured() -> None:
    played = fleet(Step.MOVE, Step.WORKER, Step.DAEMON, rounds=2)
    over = played.play()
    assert over == Over(is_kept=True, why="every step is done")
    assert [(one.round, one.step) for one in played.done] == [
        (number, step) for number in (1, 2) for step in (Step.MOVE, Step.WORKER, Step.DAEMON)
    ]
    assert [(one.node, one.target) for one in played.done[:3]] == [
        ("edge1", "edge2"),
        ("edge2", "edge1"),
        ("edge2", "edge1"),
    ], "each is done to the owner of the day"
    move, worker, daemon = played.programme.results[:3]
    assert (move.taker, move.decide_s, move.hand_over_s, move.whole_s) == ("edge2", 0.0, 0.1, 1.0)
    assert (worker.taker, worker.decide_s, worker.whole_s) == ("edge2", None, 1.0)
    assert daemon.taker == "edge1"
    (gap,) = move.gaps
    assert (gap.robot, gap.usual_s, gap.gap_s) == ("robot1", 0.05, 0.2)
    assert gap.more_s == pytest.approx(0.15)


def test_a_drain_is_judged_as_a_move_and_lifted_before_the_next_step() -> None:
    played = fleet(Step.DRAIN, Step.MOVE)
    over = played.play()
    assert over == Over(is_kept=True, why="every step is done")
    drain, move = played.programme.results
    assert (drain.node, drain.taker, move.node) == ("edge1", "edge2", "edge2")
    assert len(played.lifted) == 1
    assert [one.step for one in played.done] == [Step.DRAIN, Step.MOVE]


def test_a_drain_that_nobody_can_lift_ends_the_rehearsal() -> None:
    played = fleet(Step.DRAIN, Step.MOVE, lifts=False)
    assert played.play() == Over(is_kept=False, why="edge1 is still drained after 30 s")
    assert [one.step for one in played.done] == [Step.DRAIN]
    assert len(played.lifted) > 10, "it is tried again and again"


def test_nothing_is_done_without_another_fit_candidate() -> None:
    played = fleet(Step.DAEMON)
    played.look = replace(played.look, fit=())
    assert played.play() == Over(is_kept=False, why="no other candidate is fit to take it from edge1")
    assert played.done == []


def test_nothing_is_done_to_a_task_that_is_held() -> None:
    played = fleet(Step.MOVE, Step.DAEMON)
    played.after = lambda look: replace(look, hold="echo is paused" if len(played.done) == 1 else "")
    over = played.play()
    assert isinstance(over, Over)
    assert not over.is_kept
    assert [one.step for one in played.done] == [Step.MOVE], "an order that came meanwhile ends it"


def test_a_fleet_that_never_calms_is_left_alone() -> None:
    played = fleet(Step.MOVE)
    played.after = lambda look: replace(look, lacks=("edge3 is gone to robot1",))
    assert played.play() == Over(is_kept=False, why="not whole within 30 s: edge3 is gone to robot1")
    assert played.done == []


def test_a_change_of_owner_begins_the_calm_anew() -> None:
    played = fleet(Step.MOVE)
    turns = iter(range(10_000))
    played.after = lambda look: replace(look, epoch=3 + next(turns) // 4)
    assert played.play() == Over(is_kept=False, why="not whole within 30 s: its owner changes")
    assert played.done == []


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"gap_s": 0.5}, "robot1 had no answer for 0.45 s more than usual, at most 0.30 s are promised"),
        ({"heals_s": 60.0}, "not whole within 30 s: its owner is gone"),
        ({"flows": False}, "not whole within 30 s: echo/out/0 at robot1 rests"),
        ({"moves": False}, "not whole within 30 s: it has had no effect"),
    ],
)
def test_the_first_broken_promise_is_the_last_step(given: dict[str, Any], said: str) -> None:
    played = fleet(Step.MOVE, Step.WORKER, **given)
    assert played.play() == Over(is_kept=False, why=f"move of edge1: {said}")
    assert [one.step for one in played.done] == [Step.MOVE]
    assert said in played.programme.results[0].broken


def test_a_loss_breaks_the_promise_of_its_own_stream_only() -> None:
    lossy = fleet(Step.MOVE, loses=2)
    assert isinstance(lossy.play(), Over)
    assert lossy.programme.results[0].lost == 2
    assert lossy.programme.results[0].broken == (), "the output is not promised to be whole"
    whole = fleet(Step.MOVE, loses=2)
    whole.programme = Programme(
        [Step.MOVE],
        {Step.MOVE: replace(PROMISED[Step.MOVE], whole=("echo/out/0",))},
        rounds=1,
        calm_s=MIN_CALM_S,
        limit_s=30.0,
    )
    over = whole.play()
    assert isinstance(over, Over)
    assert over.why == "move of edge1: echo/out/0 of robot1 has lost 2, and loses nothing by promise"


def test_deciding_too_late_breaks_the_promise() -> None:
    played = fleet(Step.DAEMON)
    began: list[float] = []

    def later(look: Look) -> Look:
        began.extend([look.now] if played.done and not began else [])
        is_decided = not began or look.now >= began[0] + 2.0
        return look if is_decided else replace(look, epoch=3, owner="edge1", lacks=("edge1 is gone",))

    played.after = later
    over = played.play()
    assert isinstance(over, Over)
    assert played.programme.results[0].decide_s == pytest.approx(0.0), "the owner's age counts, not the look"
    played = fleet(Step.DAEMON)
    played.after = lambda look: replace(look, since_s=look.since_s - 1.75) if look.epoch > 3 else look
    over = played.play()
    assert isinstance(over, Over)
    assert over.why == "daemon of edge1: deciding took 1.75 s, at most 1.50 s are promised"


def test_a_step_that_is_refused_is_left_out() -> None:
    played = fleet(Step.WORKER, Step.MOVE)
    while not isinstance(action := played.programme.advance(played.look), Do):
        played._tick()
    assert action.step is Step.WORKER
    played.programme.leave_out("its worker was killed 12 s ago")
    assert played.play() == Over(is_kept=True, why="every step is done")
    assert [one.step for one in played.done] == [Step.MOVE]
    left, done = played.programme.results
    assert (left.step, left.left_out, left.whole_s) == (Step.WORKER, "its worker was killed 12 s ago", None)
    assert (done.step, done.left_out) == (Step.MOVE, "")


def test_the_gap_of_a_move_counts_though_the_status_was_away_when_it_ended() -> None:
    played = fleet(Step.DAEMON)

    def told(look: Look) -> Look:
        sight = replace(look.sights[0], gap_s=0.05, move_gap_s=1.2, move_epoch=look.epoch)
        return replace(look, sights=(sight, *look.sights[1:]))

    played.after = told
    assert isinstance(played.play(), Over)
    assert played.programme.results[0].gaps[0].gap_s == 1.2
