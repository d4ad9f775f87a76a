"""What a move costs: the outputs missing around it, whatever the rate, and nothing when nothing was asked."""

from __future__ import annotations

import pytest

from support.fleets import tuning_of
from support.robots import Decider
from zsched.core.gateway.gateway import Gateway
from zsched.core.scheduler.costs import NEWEST, WINDOW_S, MoveCost
from zsched.core.values.fleet import Fleet, NodeSpec, TaskSpec, Timing
from zsched.core.values.model import NodeKind
from zsched.core.values.plan import StreamCount


class Relay:
    """Counts as a relay does: once a second, of a task that answers every input, but for its silences."""

    def __init__(self, hz: float = 10.0, outputs: float = 1.0) -> None:
        """``outputs`` of one input."""
        self.cost, self.now, self.hz, self.outputs = MoveCost("merge"), 100.0, hz, outputs
        self.taken = self.given = 0.0

    def run(self, seconds: int, *, silent_s: float = 0.0, asks: bool = True) -> None:
        """``silent_s`` of the outputs of this time are missing."""
        for _ in range(seconds):
            quiet = min(silent_s, 1.0)
            silent_s -= quiet
            self.taken += self.hz if asks else 0.0
            self.given += self.hz * self.outputs * (1.0 - quiet) if asks else 0.0
            self.now += 1.0
            counts = (
                StreamCount(stream="merge/in/0", messages=round(self.taken)),
                StreamCount(stream="merge/out/0", messages=round(self.given)),
                StreamCount(stream="other/out/0", messages=999),
            )
            self.cost.absorb(counts, self.now)

    def move(self, *, is_planned: bool = True) -> None:
        self.cost.on_moved(is_planned=is_planned, now=self.now + 0.4)


@pytest.mark.parametrize("hz", [1.0, 10.0, 500.0])
@pytest.mark.parametrize("silent_s", [0.0, 2.0])
def test_the_cost_is_the_work_that_is_missing_at_any_rate(hz: float, silent_s: float) -> None:
    relay = Relay(hz)
    relay.run(20)
    relay.move()
    relay.run(8, silent_s=silent_s)
    assert relay.cost.moves == 1
    assert relay.cost.seconds == pytest.approx(silent_s, abs=0.05)


@pytest.mark.parametrize("outputs", [0.1, 10.0])
def test_inputs_and_outputs_have_each_a_rate_of_their_own(outputs: float) -> None:
    relay = Relay(100.0, outputs)
    relay.run(20)
    relay.move()
    relay.run(8, silent_s=2.0)
    assert relay.cost.seconds == pytest.approx(2.0, abs=0.05)
    relay.hz = 30.0
    relay.move()
    relay.run(8, silent_s=2.0)
    assert relay.cost.moves == 1, "so few inputs as these are not usual: nothing was missing that anybody asked for"


def test_what_is_usual_follows_the_rate_and_not_one_odd_second() -> None:
    relay = Relay()
    relay.run(20)
    relay.hz = 100.0
    relay.run(60)
    relay.hz = 50.0
    relay.run(1)
    relay.hz = 100.0
    relay.move()
    relay.run(8, silent_s=2.0)
    assert relay.cost.seconds == pytest.approx(2.0, abs=0.4)
    relay.hz = 30.0
    relay.move()
    relay.run(8)
    assert relay.cost.moves == 1, "many at the beginning, few now"


def test_a_silence_shorter_than_the_relays_reports_is_seen() -> None:
    relay = Relay(100.0)
    relay.run(20)
    relay.move()
    relay.run(8, silent_s=0.3)
    assert relay.cost.seconds == pytest.approx(0.3, abs=0.05)


def test_later_moves_count_more_than_earlier_ones() -> None:
    relay = Relay()
    relay.run(20)
    for silent_s in (2.0, 0.0):
        relay.move()
        relay.run(20, silent_s=silent_s)
    assert relay.cost.seconds == pytest.approx(2.0 * (1.0 - NEWEST), abs=0.1)


def test_escapes_and_first_placements_are_not_measured() -> None:
    relay = Relay()
    relay.run(20)
    relay.move(is_planned=False)
    relay.run(10, silent_s=3.0)
    assert (relay.cost.moves, relay.cost.seconds) == (0, 0.0)


def test_a_task_that_nobody_asks_anything_costs_nothing() -> None:
    relay = Relay()
    relay.run(20)
    relay.move()
    relay.run(10, asks=False)
    assert relay.cost.moves == 0


def test_half_of_the_usual_inputs_is_enough_to_miss_outputs() -> None:
    relay = Relay()
    relay.run(20)
    relay.move()
    relay.hz = 5.0
    relay.run(8)
    assert relay.cost.moves == 1


@pytest.mark.parametrize("second", [(5, 20), (2000, 5)])
def test_a_relay_that_counts_from_the_beginning_again_has_no_usual_rate_yet(second: tuple[int, int]) -> None:
    cost = MoveCost("merge")

    def absorb(taken: int, given: int, now: float) -> None:
        names = ("merge/in/0", "merge/out/0")
        cost.absorb(tuple(map(counted, names, (taken, given))), now)

    def counted(name: str, messages: int) -> StreamCount:
        return StreamCount(stream=name, messages=messages)

    absorb(1000, 10, 1.0)
    absorb(*second, 2.0)
    cost.on_moved(is_planned=True, now=2.5)
    absorb(second[0] + 100, second[1] + 100, 10.0)
    assert cost.moves == 0


def test_two_reports_at_the_same_time_have_no_rate() -> None:
    relay = Relay()
    relay.run(20)
    relay.now -= 1.0
    relay.run(1)
    relay.move()
    relay.run(8, silent_s=2.0)
    assert relay.cost.seconds == pytest.approx(2.0, abs=0.05)


def test_a_move_before_anything_is_usual_is_not_measured() -> None:
    relay = Relay()
    relay.run(1)
    relay.move()
    relay.run(8, silent_s=2.0)
    assert relay.cost.moves == 0


@pytest.mark.parametrize(("horizon_s", "known_s"), [(60.0, 2.0), (None, 0.0)])
def test_a_robots_rounds_tell_the_judge_what_planned_moves_have_cost(horizon_s: float | None, known_s: float) -> None:
    spec = TaskSpec(
        name="merge",
        candidates=("edge1",),
        tuning=tuning_of(cpu=1.0, memory=0.0),
        pays_off_in_s=horizon_s,
    )
    nodes = (NodeSpec(name="edge1", kind=NodeKind.EDGE), NodeSpec(name="robot1", kind=NodeKind.ROBOT))
    fleet = Fleet(name="lab", timing=Timing(), nodes=nodes, tasks=(spec,), electors=("robot1",))
    rounds = Decider(fleet, "robot1", Gateway(fleet)).rounds
    for second in range(1, 40):
        if second == 20:
            rounds.on_moved("merge", "edge1", has_failed=False, now=19.5)
        given = 10 * (second if second < 20 else max(second - 2, 19))
        counts = (
            StreamCount(stream="merge/in/0", messages=10 * second),
            StreamCount(stream="merge/out/0", messages=given),
        )
        rounds.absorb_counts(counts, float(second))
    assert rounds.tasks["merge"].judge.move_cost_s == pytest.approx(known_s, abs=0.05)


def test_two_moves_within_a_window_and_a_new_relay_are_not_measured() -> None:
    relay = Relay()
    relay.run(20)
    relay.move()
    relay.run(1, silent_s=1.0)
    relay.move()
    relay.run(round(WINDOW_S) + 4, silent_s=1.0)
    assert relay.cost.moves == 0
    relay.run(20)
    relay.move()
    relay.taken = relay.given = 0.0
    relay.run(round(WINDOW_S) + 4)
    assert relay.cost.moves == 0
