"""The address plan: every key is canonical for zenoh, hidden from users' wildcards, and taken apart as it was built."""

from __future__ import annotations

import inspect
import itertools
from collections.abc import Callable

import pytest
import zenoh

from zsched.link.keyspace import END_CHUNK, ROOT, Keyspace, ParsedKey, counter, parse

KEYS = Keyspace("warehouse")
KIND_OF = {"learnt": "allocation", "beat_in_turn": "beat", "profile_in_turn": "profile"}
IN_TURN = {"beat_in_turn", "profile_in_turn"}
PUTS = {"beat", "profile", "proposal", "allocation"}
QUESTIONS = {"utility", "register", "learnt", "status", "command"}
BUILT: dict[str, tuple[str, ParsedKey]] = {}
"""{method: (its key, what it must be taken apart to)}."""
for _method, _arguments in {
    "alive": ("edge1", 7),
    "beat": ("edge1",),
    "beat_in_turn": ("edge1",),
    "profile": ("edge1",),
    "profile_in_turn": ("edge1",),
    "utility": ("robot1", "robot2"),
    "proposal": ("robot1",),
    "register": ("robot1", "robot2"),
    "allocation": ("edge1",),
    "learnt": ("edge1", "robot1"),
    "document": ("edge1", "robot1"),
    "worker": ("edge1", "map_merge", "7"),
    "relay": ("robot1", "a1b2c3"),
    "role": ("edge1", "map_merge"),
    "trouble": ("edge1", "map_merge", "7"),
    "ack": ("edge1", "map_merge", "7", "a1b2c3"),
    "received": ("robot1", "a1b2c3", "d4e5f6"),
    "snapshot": ("edge1", "map_merge"),
    "status": ("edge1", "robot1"),
    "command": ("edge1", "robot1"),
}.items():
    _build: Callable[..., str] = getattr(KEYS, _method)
    _rest = tuple(str(argument) for argument in _arguments[1:])
    _rest = ("in", "turn") if _method in IN_TURN else _rest
    _parsed = ParsedKey(fleet="warehouse", kind=KIND_OF.get(_method, _method), owner=str(_arguments[0]), rest=_rest)
    BUILT[_method] = (_build(*_arguments), _parsed)


def test_every_builder_is_covered_here() -> None:
    builders = {name for name, _ in inspect.getmembers(Keyspace, inspect.isfunction) if not name.startswith("_")}
    assert builders == set(BUILT) | {"all_puts", "all_in_turn", "all_questions"}


def test_selector_over_all_puts_matches_those_only() -> None:
    selector = zenoh.KeyExpr(KEYS.all_puts())
    assert {kind for kind, (key, _) in BUILT.items() if selector.includes(zenoh.KeyExpr(key))} == PUTS


def test_selector_over_what_comes_in_turn_matches_that_only() -> None:
    selector = zenoh.KeyExpr(KEYS.all_in_turn())
    assert {kind for kind, (key, _) in BUILT.items() if selector.includes(zenoh.KeyExpr(key))} == IN_TURN


def test_selector_over_all_questions_matches_every_question_to_that_node_and_no_put() -> None:
    ours = {
        kind
        for kind, (key, parsed) in BUILT.items()
        if zenoh.KeyExpr(KEYS.all_questions(parsed.owner)).includes(zenoh.KeyExpr(key))
    }
    others = {
        kind
        for kind, (key, _) in BUILT.items()
        if zenoh.KeyExpr(KEYS.all_questions("edge9")).includes(zenoh.KeyExpr(key))
    }
    assert ours >= QUESTIONS
    assert ours.isdisjoint(PUTS | IN_TURN | {"worker"})
    assert others == set()


@pytest.mark.parametrize("kind", BUILT)
def test_key_has_the_fleet_the_kind_and_then_the_node_that_owns_it(kind: str) -> None:
    key, parsed = BUILT[kind]
    assert key.split("/")[:4] == [ROOT, "warehouse", parsed.kind, parsed.owner]
    assert parse(key) == parsed


@pytest.mark.parametrize("kind", BUILT)
def test_key_is_canonical_for_zenoh(kind: str) -> None:
    key = BUILT[kind][0]
    assert str(zenoh.KeyExpr(key)) == key


@pytest.mark.parametrize("kind", BUILT)
@pytest.mark.parametrize("user", ["**", "*/**", "**/beat/**", "*/warehouse/**", "$*zsched/**", "**/edge1"])
def test_no_wildcard_of_a_user_receives_a_control_key(kind: str, user: str) -> None:
    assert not zenoh.KeyExpr(user).intersects(zenoh.KeyExpr(BUILT[kind][0]))


@pytest.mark.parametrize("kind", BUILT)
def test_selector_over_all_matches_its_own_kind_only(kind: str) -> None:
    build: Callable[..., str] = getattr(KEYS, kind)
    selector = zenoh.KeyExpr(build(*["*"] * len(inspect.signature(build).parameters)))
    matched = {other for other, (key, _) in BUILT.items() if selector.includes(zenoh.KeyExpr(key))}
    assert matched == {kind}


def test_other_fleets_keys_never_meet_ours() -> None:
    others = [key.replace("warehouse", "yard") for key, _ in BUILT.values()]
    builders = [getattr(KEYS, kind) for kind in BUILT]
    selectors = [build(*["*"] * len(inspect.signature(build).parameters)) for build in builders]
    for selector, other in itertools.product(selectors, others):
        assert not zenoh.KeyExpr(selector).intersects(zenoh.KeyExpr(other))


def test_keys_of_one_fleet_are_all_different() -> None:
    assert len({key for key, _ in BUILT.values()}) == len(BUILT)


@pytest.mark.parametrize(
    "key",
    [
        "",
        "/",
        "@zsched",
        "@zsched/warehouse/beat",
        "zsched/warehouse/beat/edge1",
        "@other/warehouse/beat/edge1",
        "@zsched/warehouse/beat/",
        "@zsched//beat/edge1",
        "@zsched/warehouse/beat/Edge1",
        "@zsched/warehouse/beat/*",
        "@zsched/warehouse/**",
        "@zsched/warehouse/beat/edge1/",
        "@zsched/warehouse/utility/edge1/a b",
        "@zsched/warehouse/beat/edge1\n",
        "@zsched/warehouse/beat/" + "a" * 64,
        "/@zsched/warehouse/beat/edge1",
        "robot1/map/@zsched/end",
    ],
)
def test_foreign_or_malformed_key_is_none(key: str) -> None:
    assert parse(key) is None


def test_end_marker_is_hidden_from_the_streams_own_subscribers() -> None:
    stream = "edge1/map_merge/robot1/map"
    marker = zenoh.KeyExpr(f"{stream}/{END_CHUNK}")
    assert str(marker) == f"{stream}/{END_CHUNK}"
    for user in (stream, "**", "edge1/**", f"{stream}/**", f"{stream}/*/*"):
        assert not zenoh.KeyExpr(user).intersects(marker)


@pytest.mark.parametrize(
    ("chunk", "number"),
    [("0", 0), ("17", 17), (str(2**53), 2**53), (str(2**53 + 1), None), ("9" * 25, None), ("9" * 5000, None)]
    + [(text, None) for text in ("", "-1", "+1", "1_0", " 1", "1e3", "\u0663", "x", "0x1")],
)
def test_a_counter_in_a_key_is_one_that_a_node_may_have(chunk: str, number: int | None) -> None:
    """A role token with an epoch of 25 digits ended every relay that saw it."""
    assert counter(chunk) == number
