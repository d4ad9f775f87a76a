"""Which life of a relay is over, on real sessions: one whose token has gone while another one of its node is there."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import zenoh

from support.sessions import opened
from support.waiting import free_endpoint, until
from zsched.link.keyspace import Keyspace
from zsched.link.sessions.config import data_config, worker_config
from zsched.worker import lives
from zsched.worker.lives import RelayLives

KEYS = Keyspace("test")


@pytest.fixture
def sessions() -> Iterator[tuple[zenoh.Session, zenoh.Session]]:
    """A relay's and a worker's."""
    endpoint = free_endpoint()
    with (
        opened(data_config(listen=(endpoint,), connect=(), shared_memory=False)) as relay,
        opened(worker_config(connect=(endpoint,), shared_memory=False)) as worker,
    ):
        yield relay, worker


def test_a_life_is_over_once_it_has_gone_and_another_one_of_its_node_is_there(
    sessions: tuple[zenoh.Session, zenoh.Session],
) -> None:
    """One that has only gone may come again: its link was cut. One that has come again is not over."""
    relay, worker = sessions

    def shown(node: str, session: str) -> zenoh.LivelinessToken:
        return relay.liveliness().declare_token(KEYS.relay(node, session))

    first, other = shown("robot1", "a1"), shown("robot2", "b1")
    watch = RelayLives(worker, KEYS)
    first.undeclare()
    heard = shown("robot2", "b2")  # behind it: what was before is known
    other.undeclare()
    until(lambda: watch.is_over("b1"), "the life before of robot2's relay")
    assert not watch.is_over("a1"), "no other life of robot1's relay is there"
    assert not watch.is_over("b2")
    assert not watch.is_over("c1"), "nobody knows that one"
    second = shown("robot1", "a2")
    until(lambda: watch.is_over("a1"), "the life before of robot1's relay")
    again = shown("robot1", "a1")
    until(lambda: not watch.is_over("a1"), "it has come again")
    for token in (heard, second, again):
        token.undeclare()
    watch.undeclare()


def test_only_so_many_lives_are_remembered(
    sessions: tuple[zenoh.Session, zenoh.Session], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lives, "MAX_LIVES", 2)
    relay, worker = sessions
    watch = RelayLives(worker, KEYS)
    there = relay.liveliness().declare_token(KEYS.relay("robot1", "a9"))
    for number in range(4):
        relay.liveliness().declare_token(KEYS.relay("robot1", f"a{number}")).undeclare()
    until(lambda: watch.is_over("a3"), "the newest that has gone")
    assert [watch.is_over(f"a{number}") for number in range(4)] == [False, False, True, True]
    there.undeclare()
    watch.undeclare()
