"""Whose word a worker takes for its role, on real sessions: its own relay's, and nobody else's."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass, field

import pytest
import zenoh

from support.sessions import opened
from support.waiting import free_endpoint, until
from zsched.core.values import codec as wire
from zsched.core.values.plan import Role, WorkerRole
from zsched.link.keyspace import Keyspace
from zsched.link.sessions.config import data_config, relay_endpoint, worker_config
from zsched.relay.roles import RoleServer
from zsched.worker.roles import RoleWatch

KEYS = Keyspace("test")
KEY = KEYS.role("edge1", "task")
ACTIVE = Role(task="task", role=WorkerRole.ACTIVE, epoch=3)
FORGED = Role(task="task", role=WorkerRole.ACTIVE, epoch=10**12)


@dataclass
class Scene:
    """A relay, a worker that dials it, and a stranger who has found both."""

    relay: zenoh.Session
    worker: zenoh.Session
    stranger: zenoh.Session
    endpoint: str
    heard: list[Role] = field(default_factory=list)
    stop: threading.Event = field(default_factory=threading.Event)

    def watch(self, again_s: float | None = None) -> RoleWatch:
        made = RoleWatch(self.worker, KEY, self.heard.append, self.stop, self.endpoint, again_s)
        made.start()
        return made


@pytest.fixture
def scene() -> Iterator[Scene]:
    endpoint = free_endpoint()
    config = worker_config(connect=(endpoint,), shared_memory=False)
    with (
        opened(data_config(listen=(endpoint,), connect=(), shared_memory=False)) as relay,
        opened(config) as worker,
        opened(config) as stranger,
    ):
        made = Scene(relay, worker, stranger, relay_endpoint(config))
        yield made
        made.stop.set()


def test_a_stranger_s_role_is_neither_taken_from_a_put_nor_from_an_answer(scene: Scene) -> None:
    """Though its queryable calls itself complete, so that zenoh would ask it alone."""
    server = RoleServer(scene.relay, KEYS, "edge1")
    server.set(ACTIVE)
    answered = threading.Event()

    def answer(query: zenoh.Query) -> None:
        query.reply(KEY, wire.encode(FORGED))
        answered.set()

    queryable = scene.stranger.declare_queryable(KEY, answer, complete=True)
    watch = scene.watch()
    until(lambda: scene.heard == [ACTIVE], "the relay's role")

    def put_and_look() -> bool:
        scene.stranger.put(KEY, wire.encode(FORGED))
        return answered.is_set() and len(scene.heard) > 3

    until(put_and_look, "the stranger's puts to be asked about, and its answers to come")
    assert set(scene.heard) == {ACTIVE}
    queryable.undeclare()
    watch.undeclare()


def test_a_role_that_changes_is_asked_for_and_a_late_relay_is_waited_for(scene: Scene) -> None:
    watch = scene.watch()  # nobody answers yet
    server = RoleServer(scene.relay, KEYS, "edge1")
    server.set(ACTIVE)
    until(lambda: scene.heard == [ACTIVE], "the first role")
    idle = Role(task="task", role=WorkerRole.IDLE)
    server.set(idle)
    until(lambda: scene.heard[-1] == idle, "the next one")
    watch.undeclare()


def test_a_role_that_was_told_while_the_link_was_away_is_asked_for_again(scene: Scene) -> None:
    """Who declares no token is told once: a node of a driver stayed inactive beside a task that its machine owned."""
    server = RoleServer(scene.relay, KEYS, "edge1")
    idle = Role(task="task", role=WorkerRole.IDLE)
    server.set(idle)
    watch = scene.watch(again_s=0.2)
    until(lambda: idle in scene.heard, "the first role")
    assert watch._watch is not None
    watch._watch.undeclare()  # as a link that is away: it hears no put
    server.set(ACTIVE)
    until(lambda: scene.heard[-1] == ACTIVE, "the role that it did not hear", 10.0)


def test_a_role_is_told_again_when_its_token_goes_and_it_should_not(scene: Scene) -> None:
    server = RoleServer(scene.relay, KEYS, "edge1")
    told: list[Role] = []
    watch = scene.stranger.declare_subscriber(
        KEY, lambda sample: told.append(wire.decode(sample.payload.to_bytes(), Role))
    )

    idle = Role(task="task", role=WorkerRole.IDLE)

    def tell() -> bool:
        server.set(idle)
        return bool(told)

    until(tell, "a role is heard")
    server.set(ACTIVE)
    until(lambda: told[-1] == ACTIVE, "the newest role, behind all that was told before")
    told.clear()
    for epoch in (2, 4):
        server.remind("task", epoch)
    server.remind("other", 3)
    server.remind("task", 3)
    until(lambda: told == [ACTIVE], "the role again")
    watch.undeclare()


def test_where_no_relay_is_dialled_any_answer_counts() -> None:
    assert relay_endpoint("{}") == ""
    config = worker_config(connect=("tcp/127.0.0.1:7447", "tcp/10.0.0.2:7447"))
    assert relay_endpoint(config).partition("#")[0] == "tcp/127.0.0.1:7447"
