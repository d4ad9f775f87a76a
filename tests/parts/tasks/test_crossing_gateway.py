"""A gateway of another cell on real sessions: what its node's answers and silences mean, and who is asked next."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import zenoh

from support.waiting import until
from zsched.clock import monotonic_s
from zsched.core.values.struct import replace
from zsched.sessions.config import client_config
from zsched.tasks.crossing import gateway as module
from zsched.tasks.crossing.gateway import NOBODY, Gateway
from zsched.tasks.crossing.parcels import LASTING, NOT_OWNER, TAKEN, Parcel, given_key
from zsched.tasks.crossing.ways import Ways
from zsched_lab.fleet.loopback import free_endpoint

PARCEL = Parcel(name="robot1/map", life="a1", number=1, payload=b"x", attachment=b"a", encoding="text/plain")


class There:
    """A node of the other cell whose takers are played."""

    def __init__(self) -> None:
        self.endpoint = free_endpoint()
        self.asked: list[tuple[str, bytes]] = []
        self._held: list[zenoh.Query] = []
        self._queryables: list[zenoh.Queryable[None]] = []
        self.open()

    def open(self) -> None:
        config = zenoh.Config()
        for path, value in (
            ("mode", '"peer"'),
            ("listen/endpoints", f'["{self.endpoint}"]'),
            ("scouting/multicast/enabled", "false"),
        ):
            config.insert_json5(path, value)
        self.session = zenoh.open(config)

    def takes(self, node: str, answer: str, *, is_error: bool = False) -> None:
        """A taker there answers so; empty: not at all."""
        served = given_key(f"{node}/take", "hall-a", "**")

        def on_query(query: zenoh.Query) -> None:
            self.asked.append((node, b"" if query.payload is None else query.payload.to_bytes()))
            if not answer:
                self._held.append(query)
                return
            with query:
                query.reply_err(answer) if is_error else query.reply(served, answer)

        self._queryables.append(self.session.declare_queryable(served, on_query, complete=True))

    def forget(self) -> None:
        while self._queryables:
            self._queryables.pop().undeclare()

    def close(self) -> None:
        self._held.clear()
        self.session.close()


@pytest.fixture
def there() -> Iterator[There]:
    node = There()
    yield node
    node.close()


@pytest.fixture
def way(there: There) -> Iterator[Gateway]:
    config = client_config(connect=(there.endpoint,), connect_s=1.0)
    gateway = Gateway(there.endpoint, "hall-a", config)
    yield gateway
    gateway.end()


def test_who_took_is_asked_alone_from_then_on(there: There, way: Gateway) -> None:
    there.takes("edge1", NOT_OWNER, is_error=True)
    there.takes("edge2", TAKEN)
    assert way.reach() == ""
    there.asked.clear()
    assert way.give(PARCEL) == ""
    asked = {node for node, payload in there.asked if payload == b"x"}
    assert "edge2" in asked
    there.asked.clear()
    assert way.give(replace(PARCEL, number=2)) == ""
    assert there.asked == [("edge2", b"x")]


def test_a_standby_is_reached_and_takes_nothing(there: There, way: Gateway) -> None:
    there.takes("edge1", NOT_OWNER, is_error=True)
    assert way.reach() == ""
    assert way.give(PARCEL) == NOT_OWNER


def test_where_nobody_takes_it_says_so_until_somebody_does(there: There, way: Gateway) -> None:
    assert way.give(PARCEL) == NOBODY
    assert way.reach() == NOBODY
    there.takes("edge1", TAKEN)
    assert way.give(PARCEL) == ""


def test_a_taker_that_moves_is_found_again(there: There, way: Gateway) -> None:
    there.takes("edge1", TAKEN)
    assert way.give(PARCEL) == ""
    there.forget()
    there.takes("edge2", TAKEN)
    assert way.give(PARCEL) == NOBODY  # edge1 alone was asked
    assert way.give(PARCEL) == ""


def test_silence_is_told_with_its_length(there: There, way: Gateway, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "ANSWER_S", 0.5)
    monkeypatch.setattr(module, "BYTES_S", 2.0)
    there.takes("edge1", "")
    assert way.give(PARCEL) == "nobody answers within 1 s"
    assert way.reach() == "nobody answers within 0 s"


def test_a_node_that_is_gone_is_told_and_joined_again(there: There, way: Gateway) -> None:
    there.takes("edge1", TAKEN)
    assert way.give(PARCEL) == ""
    there.close()
    assert way.give(PARCEL) == NOBODY
    assert way.give(PARCEL) == f"cannot be joined: nobody answers at {there.endpoint} in time"
    there.open()
    there.takes("edge1", TAKEN)
    assert way.give(PARCEL) == ""


def test_after_the_end_nothing_is_asked(there: There, way: Gateway) -> None:
    there.takes("edge1", TAKEN)
    way.end()
    assert way.give(PARCEL) == "the session has ended"
    assert there.asked == []


def test_an_owner_that_refuses_for_good_is_asked_once_whatever_standbys_say(there: There, way: Gateway) -> None:
    refused = f"failed: AdapterError: {LASTING}hall-a/robot1/map: 4096 keys have come already"
    there.takes("edge1", NOT_OWNER, is_error=True)
    there.takes("edge2", refused, is_error=True)
    there.takes("edge3", NOT_OWNER, is_error=True)
    began_at = monotonic_s()
    assert Ways([way]).give(PARCEL, 10.0, lambda _pause_s: True) == f"at {there.endpoint} {refused}"
    assert monotonic_s() - began_at < 5.0
    until(lambda: len(there.asked) >= 3, "the question at all of them, whose word is not waited for")
    assert sorted(node for node, _ in there.asked) == ["edge1", "edge2", "edge3"]
