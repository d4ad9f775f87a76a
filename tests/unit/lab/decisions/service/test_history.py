"""What a task gets on a machine that it shares, in every history, and the oracle that knows it."""

from __future__ import annotations

import doctest
import itertools

import numpy as np
import pytest

from zsched_lab.decisions.rules import Move
from zsched_lab.decisions.service import history as histories
from zsched_lab.decisions.service import machines
from zsched_lab.decisions.service.history import BURSTS_S, IDLE_SHARE, Activity, History, build
from zsched_lab.decisions.service.judge import SKIP_S, judge, oracle, truth
from zsched_lab.decisions.service.machines import Machine, Work, share, share_out
from zsched_lab.decisions.service.oracle import best_path
from zsched_lab.decisions.service.present import LAG_S, present
from zsched_lab.decisions.world import DT_S

HOURS = 0.05
NOBODY = np.zeros((1, 0, 2))
NO_MEMORY = np.zeros((1, 0))


def work(*, cores: float, rate_hz: float = 1.0, processes: int = 4, memory_mb: float = 100.0) -> Work:
    return Work(
        name="a",
        cpu_s=cores / rate_hz,
        rate_hz=rate_hz,
        memory_mb=memory_mb,
        processes=processes,
        deadline_s=1.5,
        slow_s=1.0,
    )


def machine(cores: float = 4.0, speed: float = 1.0) -> Machine:
    return Machine(cores=cores, speed=speed, memory_mb=1000.0)


@pytest.mark.parametrize("busy", [0, 1, 2, 4, 8, 20])
@pytest.mark.parametrize("demand", [0.3, 1.0, 3.0, 4.0])
def test_a_task_gets_its_demand_or_what_is_free_or_its_fair_share(demand: float, busy: int) -> None:
    processes = int(np.ceil(demand))
    others = np.array([[[float(busy), float(busy)]]])
    given = share(machine(), (work(cores=demand, processes=processes),), others, NO_MEMORY)
    fair = 4.0 * processes / (processes + busy)
    assert given.cores[0, 0] == pytest.approx(min(demand, max(4.0 - busy, fair)))
    assert given.service[0, 0] == pytest.approx(given.cores[0, 0] / demand)


def test_nothing_is_given_twice_and_nothing_is_kept_back() -> None:
    rng = np.random.default_rng(1)
    wanted = rng.uniform(0.0, 3.0, (200, 4))
    heads = np.ceil(wanted)
    got = share_out(4.0, wanted, heads)
    assert np.all(got <= wanted + 1e-12)
    assert got.sum(axis=1) == pytest.approx(np.minimum(wanted.sum(axis=1), 4.0))


def test_a_slow_machine_takes_more_of_its_cores_for_the_same_jobs() -> None:
    slow, fast = (share(machine(speed=speed), (work(cores=2.0),), NOBODY, NO_MEMORY) for speed in (0.4, 2.0))
    assert fast.cores[0, 0] == pytest.approx(1.0)
    assert slow.cores[0, 0] == pytest.approx(4.0), "5 of 4 cores"
    assert (fast.service[0, 0], slow.service[0, 0]) == (pytest.approx(1.0), pytest.approx(0.8))


def test_a_job_that_takes_longer_than_its_deadline_is_missed() -> None:
    """Four processes beside n others: the job's 2 CPU seconds run on max(4 - n, 16 / (4 + n)) cores."""
    missed, slow = [], []
    for busy in (0.0, 1.0, 4.0, 6.0, 16.0):
        others = np.array([[[busy, busy]]])
        given = share(machine(), (work(cores=2.0),), others, NO_MEMORY)
        missed.append((float(given.service[0, 0]), float(given.missed[0, 0])))
        slow.append(float(given.slow[0, 0]))
    assert missed[:3] == [(1.0, 0.0)] * 3
    assert missed[3] == pytest.approx((0.8, 0.2)), "1.25 s a job: those that are done are in time"
    assert missed[4] == pytest.approx((0.4, 1.0)), "2.5 s a job: all of them are late"
    assert slow == [0.0, 0.0, 0.0, 1.0, 1.0], "1 s a job beside four others is just not slow, 1.25 s is"


def test_memory_has_a_floor_and_the_scarcer_one_decides() -> None:
    given = share(machine(), (work(cores=1.0, memory_mb=800.0),), NOBODY, np.array([[900.0]]))
    assert given.memory[0, 0] == pytest.approx(500.0), "half of the machine, however much the other one wants"
    assert given.service[0, 0] == pytest.approx(500.0 / 800.0)


def test_tasks_on_one_machine_share_it_with_each_other() -> None:
    history = build(seed=7, hours=HOURS, load_s=0.0, tasks=3)
    together, apart = truth(history, (0, 0, 0), 0, 1)[0], truth(history, (0, 1, 2), 0, 1)[0]
    alone = [truth(history, tuple(0 if k == task else None for k in range(3)), 0, 1)[0, task] for task in range(3)]
    assert together.sum() < sum(alone), "three tasks are more than one machine"
    assert apart[0] == pytest.approx(alone[0])


def test_histories_hold_what_they_promise() -> None:
    made = [build(seed=seed, hours=HOURS, load_s=15.0) for seed in range(1, 25)]
    sizes = [one.size for one in made]
    assert min(sizes) < 0.2
    assert max(sizes) > 1.0
    speeds = [machine.speed for one in made for machine in one.machines]
    assert 0.5 <= min(speeds) < 0.6
    assert 1.8 < max(speeds) <= 2.0
    lengths = {begin.end - begin.step for one in made for begin in one.begins if begin.end < one.steps}
    assert lengths == {round(15.0 / DT_S)}
    assert made[0].machines == build(seed=1, hours=HOURS, load_s=60.0).machines, "one bed for all lengths"
    assert np.any(made[0].service() < 1.0)


@pytest.mark.parametrize("activity", list(Activity))
def test_machines_and_loads_are_the_same_whenever_jobs_come(activity: Activity) -> None:
    steady, other = (build(seed=3, hours=HOURS, load_s=15.0, activity=one) for one in (Activity.STEADY, activity))
    assert (other.machines, other.works, other.begins) == (steady.machines, steady.works, steady.begins)
    assert np.array_equal(other.cpu_error, steady.cpu_error)


def test_a_task_to_which_no_job_comes_wants_nothing_and_lacks_nothing() -> None:
    busy = np.array([[[8.0, 8.0]]] * 2)
    given = share(machine(), (work(cores=3.0), work(cores=3.0)), busy, NO_MEMORY[[0, 0]], np.array([[0.0, 1], [1, 1]]))
    assert (given.cores[0, 0], given.service[0, 0], given.missed[0, 0], given.slow[0, 0]) == (0.0, 1.0, 0.0, 0.0)
    assert given.cores[0, 1] == pytest.approx(4.0 * 4 / 12), "only the load is beside it"
    assert given.cores[1].tolist() == pytest.approx([4.0 * 4 / 16] * 2)


def test_an_idle_task_gets_all_that_it_wants_beside_a_full_load() -> None:
    full = np.array([[[8.0, 8.0]]])
    given = share(machine(), (work(cores=3.0),), full, NO_MEMORY, np.array([[IDLE_SHARE]]))
    assert given.service[0, 0] == 1.0
    assert given.cores[0, 0] == pytest.approx(IDLE_SHARE * 3.0)
    assert given.slow[0, 0] == 1.0, "but each of its jobs takes longer"


def test_bursts_and_pauses_are_as_long_as_is_said_and_each_task_has_its_own() -> None:
    history = build(seed=4, hours=0.5, load_s=0.0, tasks=3, activity=Activity.BURSTY)
    comes = history.activity[history.stretch]
    assert set(comes.ravel()) == {0.0, 1.0}
    for task in range(3):
        changes = np.flatnonzero(np.diff(comes[:, task]))
        lengths_s = np.diff(changes) * DT_S
        assert BURSTS_S[0][0] <= lengths_s.min()
        assert lengths_s.max() <= BURSTS_S[0][1]
        assert 0.25 < comes[:, task].mean() < 0.75
    assert not np.array_equal(comes[:, 0], comes[:, 1])


def test_only_jobs_that_come_are_missed() -> None:
    """A task without a machine misses all of its jobs, however few of them come."""
    for activity in Activity:
        history = build(seed=5, hours=HOURS, load_s=15.0, activity=activity)
        names = history.fleet.tasks[0].candidates
        nowhere = judge(history, [[]], (0.3,))[0]
        assert [nowhere.missed, nowhere.slow] == pytest.approx([1.0, 1.0]), activity
        stayed = judge(history, [[Move(at_s=0.0, owner=names[0], left=None)]], (0.3,))[0]
        assert 0.0 <= stayed.missed <= stayed.slow <= 1.0
        assert stayed.outputs_hz <= history.works[0].rate_hz * float(history.activity[history.stretch].mean()) * 1.2


def tries(history: History, price_s: float, rng: np.random.Generator) -> float:
    """The least lost service of many random sequences of placements that change only with a load."""
    names = history.fleet.tasks[0].candidates
    steps = [0.0] + [begin.step * DT_S for begin in history.begins] + [begin.end * DT_S for begin in history.begins]
    best = 1.0
    for _ in range(30):
        moves = []
        for _work in history.works:
            at = sorted(rng.choice(steps, size=int(rng.integers(0, 4))).tolist())
            owners = rng.integers(0, len(names), len(at) + 1).tolist()
            mine = [Move(at_s=0.0, owner=names[owners[0]], left=None)]
            for at_s, (left, owner) in zip(at, itertools.pairwise(owners), strict=True):
                if owner != left and at_s > 0.0:
                    mine.append(Move(at_s=at_s, owner=names[owner], left=mine[-1].owner))
            moves.append(mine)
        best = min(best, judge(history, moves, (price_s,))[0].lost)
    return best


@pytest.mark.parametrize("tasks", [1, 3])
def test_nobody_beats_the_oracle_and_a_dearer_move_is_made_less_often(tasks: int) -> None:
    history = build(seed=5, hours=HOURS, load_s=15.0, tasks=tasks)
    lost, moves = [], []
    for price_s in (0.0, 0.3, 3.0, 1e6):
        (figures,) = judge(history, oracle(history, price_s), (price_s,))
        assert figures.lost <= tries(history, price_s, np.random.default_rng(1)) + 1e-9
        assert figures.wasted == 0
        lost.append(figures.lost)
        moves.append(figures.moves)
    assert lost == sorted(lost)
    assert moves == sorted(moves, reverse=True)
    assert moves[0] > moves[-1] == 0


@pytest.mark.parametrize("tasks", [1, 3])
def test_who_knows_the_present_is_between_the_oracle_and_who_stays(tasks: int) -> None:
    """On histories where staying costs something: at a price it moves once staying has cost half of that."""
    for seed in (3, 6):
        history = build(seed=seed, hours=HOURS, load_s=15.0, tasks=tasks)
        moves = present(history, 0.3)
        (known,) = judge(history, moves, (0.3,))
        (best,) = judge(history, oracle(history, 0.3), (0.3,))
        (stays,) = judge(history, [mine[:1] for mine in moves], (0.3,))
        assert best.lost <= known.lost <= stays.lost
        assert len(present(history, 1e9)[0]) == 1


def test_who_knows_the_present_leaves_when_staying_has_cost_half_a_move_and_not_before() -> None:
    history = next(
        one
        for one in (build(seed=seed, hours=HOURS, load_s=60.0) for seed in range(1, 60))
        if judge(one, present(one, 0.3), (0.3,))[0].felt
    )
    soon, late = (next(move.at_s for move in present(history, price_s)[0] if move.left) for price_s in (0.0, 2.0))
    place = history.fleet.tasks[0].candidates.index(present(history, 0.0)[0][0].owner)
    steps = range(round((soon - LAG_S) / DT_S), round((late - LAG_S) / DT_S) + 1)
    gives = history.service()[history.stretch[steps], :, 0]
    cost = ((gives.max(axis=1) - gives[:, place]) * DT_S).cumsum()
    assert cost[-1] >= 1.0 > cost[-2], "half of 2 s of work"


@pytest.mark.parametrize("shape", [(3,), (2, 2), (3, 2)])
def test_the_oracle_is_what_trying_everything_finds(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(5)
    places = list(itertools.product(*map(range, shape)))
    for highest in (0.0, 0.2, 0.6):
        worth = rng.uniform(0.0, 1.0, (4, len(places)))
        price = rng.uniform(0.0, 1.0, (4, len(shape))).round() * highest

        def paid(path: tuple[int, ...], worth: np.ndarray = worth, price: np.ndarray = price) -> float:
            moved = 0.0
            for stretch, (a, b) in enumerate(itertools.pairwise(path), 1):
                changed = [x != y for x, y in zip(places[a], places[b], strict=True)]
                moved += float(price[stretch][changed].sum())
            return float(worth[np.arange(4), list(path)].sum()) - moved

        best = max(map(paid, itertools.product(range(len(places)), repeat=4)))
        total, path = best_path(worth, price, shape)
        assert total == pytest.approx(best)
        assert paid(tuple(path)) == pytest.approx(best)


def test_a_move_in_a_pause_costs_nothing_and_one_in_a_burst_its_price() -> None:
    history = build(seed=4, hours=HOURS, load_s=0.0, activity=Activity.BURSTY)
    comes = history.activity[history.stretch, 0]
    first, second = history.fleet.tasks[0].candidates[:2]
    later = np.arange(history.steps) * DT_S > SKIP_S + 1.0
    for is_burst in (False, True):
        step = int(np.flatnonzero(later & (comes == float(is_burst)))[3])
        moves = [Move(at_s=0.0, owner=first, left=None), Move(at_s=step * DT_S, owner=second, left=first)]
        free, paid = judge(history, [moves], (0.0, 2.0))
        total_s = paid.hours * 3600
        assert (paid.lost - free.lost) * total_s == pytest.approx(2.0 * is_burst)
        assert (free.outputs_hz - paid.outputs_hz) * total_s == pytest.approx(2.0 * is_burst * history.works[0].rate_hz)


def test_figures_of_a_move_by_hand() -> None:
    """One move away from a loaded machine and back: what is lost is what the truth says, and twice the price."""
    history = next(
        one
        for one in (build(seed=seed, hours=HOURS, load_s=15.0) for seed in range(1, 40))
        for first in one.begins
        if first.machine == 0
        and first.step * DT_S > SKIP_S
        and first.end < one.steps
        and one.service()[one.stretch[first.step], 0, 0] < 0.7 < one.service()[one.stretch[first.step], 1, 0]
    )
    begin = next(one for one in history.begins if one.machine == 0 and one.step * DT_S > SKIP_S)
    names = history.fleet.tasks[0].candidates
    away, back = (begin.step + 5) * DT_S, begin.end * DT_S
    moves = [
        Move(at_s=0.0, owner=names[0], left=None),
        Move(at_s=away, owner=names[1], left=names[0]),
        Move(at_s=back, owner=names[0], left=names[1]),
    ]
    cheap, dear = judge(history, [moves], (0.05, 100.0))
    column = np.zeros(history.steps, dtype=int)
    column[begin.step + 5 : begin.end] = 1
    served = history.service()[history.stretch, column, 0][round(SKIP_S / DT_S) :]
    assert cheap.lost == pytest.approx(1.0 - served.mean() + 2 * 0.05 / (len(served) * DT_S))
    assert cheap.outputs_hz == pytest.approx(history.works[0].rate_hz * (1.0 - cheap.lost))
    assert (cheap.moves, dear.wasted) == (2, 2)
    assert cheap.wasted <= 1
    assert cheap.reactions_s[0] == pytest.approx(1.0)


def test_the_examples_hold() -> None:
    for module in (machines, histories):
        assert doctest.testmod(module).failed == 0
        assert doctest.testmod(module).attempted > 1
