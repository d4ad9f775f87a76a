"""Who of a key's publishers has which place, and when it is another one's."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest
from zenoh import Sample

from zsched.relay.streams import places as module
from zsched.relay.streams.places import Places, PublisherId


class House:
    """Places on a clock that stands until it is moved, and tokens that a test sets."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 100.0
        self.tokens: dict[PublisherId, bool] = {}
        monkeypatch.setattr(module, "monotonic_s", lambda: self.now)
        self.places = Places(self.tokens.get)

    def hear(self, number: int | None, key: str = "a") -> int:
        info: Any = None if number is None else SimpleNamespace(source_id=SimpleNamespace(zid="z", eid=number))
        return self.places.of(cast("Sample", SimpleNamespace(key_expr=key, source_info=info)))


@pytest.fixture
def house(monkeypatch: pytest.MonkeyPatch) -> House:
    return House(monkeypatch)


def test_each_publisher_of_a_key_has_a_place_and_who_keeps_nothing_the_first(house: House) -> None:
    assert [house.hear(one) for one in (1, 2, 3, 2, 1, None, None)] == [0, 1, 2, 1, 0, 0, 0]
    assert house.hear(3, "b") == 0


def test_one_that_comes_takes_the_place_of_one_that_has_gone(house: House) -> None:
    house.tokens |= {("z", 1): True, ("z", 2): True, ("z", 3): True}
    assert [house.hear(one) for one in (1, 2, 3)] == [0, 1, 2]
    house.now += 3600.0
    assert house.hear(4) == 3, "they are silent, and there"
    house.tokens["z", 2] = False
    assert house.hear(2) == 1, "it was away for a moment"
    assert house.hear(5) == 1
    assert house.hear(2) == 4, "somebody has its place"


def test_one_without_a_token_has_gone_when_it_is_quiet(house: House) -> None:
    assert [house.hear(one) for one in (1, 2)] == [0, 1]
    house.now += module.QUIET_S * 1.5
    assert [house.hear(one) for one in (2, 3)] == [1, 0]


def test_places_and_keys_are_bounded(house: House, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MAX_PLACES", 2)
    monkeypatch.setattr(module, "MAX_KEYS", 2)
    for number in (1, 2):
        house.tokens["z", number] = True
        house.now += 1.0
        house.hear(number)
    assert house.hear(3) == 0, "who was heard longest ago gives way"
    for key in "bc":
        house.hear(1, key)
    assert list(house.places._keys) == ["b", "c"]
