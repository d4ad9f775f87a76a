"""Loops through relays and clashing writers are found, worker cycles are named, chains are left alone."""

import random
import time

import pytest

from support.fleets import task_of, tuning_of
from zsched.config.rulecheck import RuleConflict, rule_conflicts
from zsched.core.route import keyexpr
from zsched.core.route.route import named_rules, routes_for
from zsched.core.values.fleet import StreamRule, TaskSpec
from zsched.core.values.plan import Direction

ROBOTS = ("robot1", "robot2", "robot3")
EDGES = ("edge1", "edge2")


def task(
    name: str,
    inputs: tuple[tuple[str, str], ...] = (),
    outputs: tuple[tuple[str, str], ...] = (),
    candidates: tuple[str, ...] = EDGES,
) -> TaskSpec:
    pairs = [(Direction.INPUT, pair) for pair in inputs] + [(Direction.OUTPUT, pair) for pair in outputs]
    return task_of(
        name,
        candidates,
        tuning=tuning_of(cpu=1.0, memory=0.0),
        rules=tuple(StreamRule(direction=way, from_template=one, to_template=two) for way, (one, two) in pairs),
    )


def conflicts(
    *tasks: TaskSpec, robots: tuple[str, ...] = ROBOTS, split: tuple[str, ...] = ()
) -> tuple[RuleConflict, ...]:
    return rule_conflicts(tasks, robots, split)


MAP_IN = ("{robot}/map", "{target}/merge/{robot}/map")
MAP_OUT = ("{target}/merge/{epoch}/map", "{robot}/global_map")


def test_map_merging_has_no_conflict_even_with_robots_as_candidates() -> None:
    assert conflicts(task("merge", (MAP_IN,), (MAP_OUT,), candidates=(*EDGES, *ROBOTS))) == ()


def test_input_that_lands_on_a_candidate_robots_own_key_is_a_loop() -> None:
    (found,) = conflicts(
        task("t", (("{robot}/map", "{target}/map"),), candidates=("edge1", "robot1")), robots=ROBOTS[:1]
    )
    assert found.is_fatal
    assert found.streams == ("t/in/0",)
    assert "robot1/map -> robot1/map" in found.message


def test_cycle_through_workers_is_a_warning_with_all_its_rules() -> None:
    first = task("a", (("{robot}/plan", "{target}/a/{robot}/plan"),), (("{target}/a/{epoch}/map", "{robot}/map"),))
    second = task("b", (("{robot}/map", "{target}/b/{robot}/map"),), (("{target}/b/{epoch}/plan", "{robot}/plan"),))
    (found,) = conflicts(first, second)
    assert not found.is_fatal
    assert set(found.streams) == {"a/in/0", "a/out/0", "b/in/0", "b/out/0"}


def test_a_circle_through_a_worker_is_none_of_relays_though_their_open_keys_meet() -> None:
    """No robot is called like the task: only with any name for {robot} would the two relays feed each other."""
    (found,) = conflicts(task("t", (("{robot}/x", "{target}/{robot}/m"),), (("{target}/{task}/m", "{robot}/x"),)))
    assert not found.is_fatal
    assert "a worker's output comes back" in found.message


@pytest.mark.parametrize(("pairs", "more"), [(3, ""), (4, "then 2 more")])
def test_a_long_loop_is_told_by_its_first_six_steps(pairs: int, more: str) -> None:
    inputs = tuple((f"{{robot}}/k{number}", f"{{target}}/k{number}") for number in range(pairs))
    outputs = tuple((f"{{target}}/k{number}", f"{{robot}}/k{(number + 1) % pairs}") for number in range(pairs))
    (found,) = conflicts(task("t", inputs, outputs, candidates=("edge1",)), robots=("robot1",))
    assert found.is_fatal
    assert found.message.count("->") == 6
    assert found.message.endswith(more) if more else "more" not in found.message


def test_loop_of_relays_across_two_tasks_is_refused_with_both_rules() -> None:
    first = task("a", (("{robot}/x", "{target}/ping/{robot}"),))
    second = task("b", (), (("{target}/ping/{robot}", "{robot}/x"),))
    (found,) = conflicts(first, second)
    assert found.is_fatal
    assert set(found.streams) == {"a/in/0", "b/out/0"}


def test_two_rules_into_one_key_clash() -> None:
    first = task("a", (), (("{target}/a/{epoch}/map", "{robot}/map"),))
    second = task("b", (), (("{target}/b/{epoch}/map", "{robot}/map"),))
    (found,) = conflicts(first, second)
    assert found.is_fatal
    assert found.streams == ("a/out/0", "b/out/0")


def test_all_robots_into_one_key_clash_but_one_robot_does_not() -> None:
    mixed = task("a", (("{robot}/image", "{target}/a/image"),))
    (found,) = conflicts(mixed)
    assert "add {robot}" in found.message
    assert conflicts(mixed, robots=("robot1",)) == ()


def test_names_that_meet_only_by_chance_are_found() -> None:
    """A robot may be called like a chunk of another rule."""
    first = task("a", (("{robot}/x", "{target}/{robot}/map"),))
    second = task("b", (("{robot}/y", "{target}/merge/map"),), candidates=EDGES)
    assert not any(found.streams == ("a/in/0", "b/in/0") for found in conflicts(first, second))
    found = conflicts(first, second, robots=("merge",))
    assert [one.streams for one in found] == [("a/in/0", "b/in/0")]


def test_wildcards_that_meet_in_to_clash() -> None:
    first = task("a", (("{robot}/x/**", "{target}/in/{robot}/**"),))
    second = task("b", (("{robot}/y", "{target}/in/{robot}/y"),))
    (found,) = conflicts(first, second)
    assert found.is_fatal
    assert set(found.streams) == {"a/in/0", "b/in/0"}


def test_robots_whose_wild_keys_meet_clash() -> None:
    """robot1's cam*, and robot10's: no equal key, but common ones."""
    mixed = task("a", (("{robot}/cam$*", "{target}/a/{robot}$*"),))
    (found,) = conflicts(mixed, robots=("robot1", "robot10"))
    assert "would both publish" in found.message


def test_a_clash_within_one_local_side_is_found_and_shown_without_its_room() -> None:
    first = task("a", (), (("{target}/a/{epoch}/map", "map"),))
    second = task("b", (), (("{target}/b/{epoch}/map", "map"),))
    (found,) = conflicts(first, second, split=ROBOTS)
    assert "two rules publish 'map'" in found.message
    assert "on robot1" in found.message


def test_a_loop_between_the_sides_is_found() -> None:
    first = task("a", (("x", "{target}/ping/{robot}"),))
    second = task("b", (), (("{target}/ping/{robot}", "x"),))
    (found,) = conflicts(first, second, split=ROBOTS)
    assert found.is_fatal
    assert "@local" not in found.message


def dumb_has_relay_loop(tasks: tuple[TaskSpec, ...], robots: tuple[str, ...]) -> bool:
    """All routes of all robots and candidates, and a walk from each; epochs stand for each other."""
    edges = [
        (one.from_expr.replace("/9/", "/*/"), one.to_expr)
        for each in tasks
        for robot in robots
        for candidate in each.candidates
        for one in routes_for(each, robot, candidate, 9)
    ]
    after = {
        at: [to for to in range(len(edges)) if keyexpr.intersects(edges[at][1], edges[to][0])]
        for at in range(len(edges))
    }
    for start, reached in after.items():
        seen, row = set[int](), list(reached)
        while row:
            here = row.pop()
            if here == start:
                return True
            if here not in seen:
                seen.add(here)
                row.extend(after[here])
    return False


def test_loops_agree_with_a_dumb_second_implementation() -> None:
    random_source = random.Random(7)
    froms_in = ("{robot}/a", "{robot}/b", "x", "edge1/t/robot1", "{robot}/t/{robot}")
    tos_in = ("{target}/t/{robot}", "{target}/a", "{target}/{robot}/b", "{target}/t/{robot}/a", "{target}/b")
    froms_out = ("{target}/t/{robot}", "{target}/{epoch}/a", "{target}/a", "{target}/b")
    tos_out = ("{robot}/a", "{robot}/b", "{robot}/t/{robot}", "{robot}/9/a")
    seen = {True: 0, False: 0}
    for _ in range(400):
        tasks = tuple(
            task(
                name,
                tuple(
                    (random_source.choice(froms_in), random_source.choice(tos_in))
                    for _ in range(random_source.randint(0, 2))
                ),
                tuple(
                    (random_source.choice(froms_out), random_source.choice(tos_out))
                    for _ in range(random_source.randint(0, 2))
                ),
                candidates=tuple(
                    sorted(random_source.sample(("edge1", "robot1", "robot2"), random_source.randint(1, 3)))
                ),
            )
            for name in ("p", "q")
        )
        expected = dumb_has_relay_loop(tasks, ROBOTS[:2])
        found = any(one.is_fatal and one.message.startswith("loop") for one in conflicts(*tasks, robots=ROBOTS[:2]))
        assert found == expected, [(name, rule) for each in tasks for name, rule in named_rules(each)]
        seen[expected] += 1
    assert min(seen.values()) > 40


def test_a_large_fleet_is_checked_quickly() -> None:
    robots = tuple(f"robot{number}" for number in range(40))
    everybody = (*robots, *(f"edge{number}" for number in range(10)))
    tasks = [
        task(
            f"t{number}",
            (("{robot}/map", "{target}/{task}/{robot}/map"), ("{robot}/scan", "{target}/{task}/{robot}/scan")),
            (("{target}/{task}/{epoch}/out", "{robot}/{task}/out"),),
            candidates=everybody,
        )
        for number in range(5)
    ]
    start = time.process_time()
    assert rule_conflicts(tasks, robots) == ()
    assert time.process_time() - start < 10  # typically far below one second; the bound only catches a blow-up


def test_thousands_of_rules_are_checked_in_seconds() -> None:
    """8000 took over a minute, for each was compared with each."""
    ways_in = tuple((f"{{robot}}/in{i}", f"{{target}}/t/{{robot}}/in{i}") for i in range(4000))
    ways_out = tuple((f"{{target}}/t/{{epoch}}/{{robot}}/out{i}", f"{{robot}}/out{i}") for i in range(4000))
    began = time.process_time()
    assert conflicts(task("t", ways_in, ways_out)) == ()
    assert time.process_time() - began < 10.0


@pytest.mark.parametrize("shape", ["{{robot}}/**/x{}", "{{robot}}/**/x{}/**", "**/{{robot}}/x{}"])
def test_rules_that_could_meet_in_too_many_ways_are_refused_in_seconds(shape: str) -> None:
    ways_in = tuple((shape.format(i), "{target}/" + shape.format(i)) for i in range(3000))
    began = time.process_time()
    (found,) = conflicts(task("t", ways_in))
    assert time.process_time() - began < 30.0
    assert found.is_fatal
    assert found.message.startswith("3000 rules could meet in so many ways")
