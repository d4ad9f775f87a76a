"""When a daemon goes on with a relay of other words, and what such a relay cannot be told."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import pytest

from zsched.core.relay_protocol import RelayStop, TaskEnded
from zsched.core.values.plan import (
    Direction,
    OnCrash,
    ReadyWhen,
    Route,
    RoutePhase,
    RoutePlan,
    ServiceSettings,
    Slot,
    StreamSettings,
)
from zsched.ipc.vocabulary import Vocabulary, lack, misunderstanding, own, read, written

Change = Callable[[Any], object]


def other(*changes: Change) -> Vocabulary:
    """Another version's words: ours, changed."""
    found = json.loads(written(own()))
    for change in changes:
        change(found)
    vocabulary = read(json.dumps(found))
    assert vocabulary is not None
    return vocabulary


def without(side: str, name: str, field: str = "") -> Change:
    return lambda found: found[side][name].pop(field) if field else found[side].pop(name)


def with_field(side: str, name: str, field: str, default: str) -> Change:
    return lambda found: found[side][name].update({field: ["int", default]})


def with_member(side: str, name: str, member: str) -> Change:
    return lambda found: found[side][name].append(member)


def plan(route: StreamSettings | None = None, **fields: Any) -> RoutePlan:
    one = Route(
        stream="t/in/0", direction=Direction.INPUT, from_expr="a", to_expr="b", settings=route or StreamSettings()
    )
    slot = Slot(epoch=1, owner="edge1", routes=(one,), ready_when=ReadyWhen.TOKEN)
    return RoutePlan(task="t", phase=RoutePhase.PREPARE, current=slot, **fields)


def test_what_was_written_is_read() -> None:
    assert read(written(own())) == own()
    assert misunderstanding(own(), own()) == ""


@pytest.mark.parametrize("text", ["", "{", "[]", "7", "{}", '{"told": 1}', '{"told": {"A": 5}}', b"\xff\xfe"])
def test_anything_else_is_no_vocabulary(text: str | bytes) -> None:
    assert read(text) is None


@pytest.mark.parametrize("side", ["told", "heard"])
def test_a_class_that_is_described_as_nonsense_is_no_vocabulary(side: str) -> None:
    found = json.loads(written(own()))
    found[side]["Route"] = 5
    assert read(json.dumps(found)) is None


@pytest.mark.parametrize(
    "change",
    [
        without("told", "RoutePlan", "exclusive"),
        without("told", "TaskEnded"),
        without("told", "ServiceSettings", "retry"),
        with_field("told", "RoutePlan", "urgency", "0"),
        with_field("told", "ServiceSettings", "urgency", "0"),
        with_member("told", "OnCrash", "pray"),
        without("heard", "StreamCount", "hz"),
        with_field("heard", "StreamCount", "age", "0"),
        with_field("heard", "StreamCount", "age", "always said"),
        without("heard", "SlotLost"),
        lambda found: found["heard"].update({"Fresh": {"a": ["int", "always said"]}}),
    ],
)
def test_words_that_were_added_or_are_not_said_any_more_harm_nobody(change: Change) -> None:
    assert misunderstanding(other(change), own()) == ""


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (without("told", "Slot", "epoch"), "Slot.epoch is always said, and the relay does not know it"),
        (with_field("told", "Slot", "place", "always said"), "the relay wants Slot.place, which is not said"),
        (with_field("told", "Role", "epoch", "7"), "Role.epoch is int = 7 to the relay, not int = 0"),
        (with_field("told", "Role", "task", "always said"), "Role.task is int = always said to the relay, not str"),
        (without("heard", "SlotLost", "samples"), "the daemon wants SlotLost.samples, which is not said"),
        (with_field("heard", "SlotReady", "is_ready", "True"), "SlotReady.is_ready is bool = True to the daemon"),
        (lambda found: found["told"].update({"Role": ["idle"]}), "Role is another kind of word"),
        (lambda found: found.update({"wire": 2}), "frames of version 2, not 1"),
        (lambda found: found["bounds"].update({"role": 9}), "role: 9 bytes, not 8192"),
    ],
)
def test_what_would_be_taken_for_something_else_is_another_language(change: Change, why: str) -> None:
    assert why in misunderstanding(other(change), own())


def test_a_relay_that_may_answer_by_an_unknown_member_is_another_language() -> None:
    ours = other(lambda found: found["heard"].update({"Mood": ["calm"]}))
    assert misunderstanding(ours, ours) == ""
    theirs = other(lambda found: found["heard"].update({"Mood": ["calm", "cross"]}))
    assert misunderstanding(theirs, ours) == "Mood cross is not known to the daemon"
    assert misunderstanding(ours, theirs) == ""


@pytest.mark.parametrize(
    ("change", "value", "found"),
    [
        (without("told", "RoutePlan", "exclusive"), plan(exclusive=True), "RoutePlan.exclusive"),
        (without("told", "RoutePlan", "exclusive"), plan(), ""),
        (without("told", "StreamSettings", "max_hz"), plan(StreamSettings(max_hz=3.0)), "StreamSettings.max_hz"),
        (without("told", "StreamSettings", "max_hz"), plan(), ""),
        (
            lambda found: found["told"]["OnCrash"].remove("replay"),
            plan(StreamSettings(on_crash=OnCrash.REPLAY)),
            "OnCrash replay",
        ),
        (without("told", "TaskEnded"), TaskEnded(task="t"), "TaskEnded"),
        (without("told", "TaskEnded"), RelayStop(), ""),
    ],
)
def test_what_a_relay_does_not_know_is_named_and_only_where_it_is_used(
    change: Change, value: object, found: str
) -> None:
    assert lack(value, other(change)) == found


def test_a_class_in_a_class_is_looked_at_where_it_stands() -> None:
    """A default that is a class has more fields one day, and stays the same default."""
    theirs = other(without("told", "ServiceSettings", "retry"))
    route = plan().current
    assert route is not None
    assert lack(route.routes[0], theirs) == ""
    assert (
        lack(
            Route(
                stream="s",
                direction=Direction.SERVICE,
                from_expr="a",
                to_expr="b",
                settings=StreamSettings(),
                service=ServiceSettings(retry=True),
            ),
            theirs,
        )
        == "ServiceSettings.retry"
    )
