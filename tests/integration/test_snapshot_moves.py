"""A worker's state moves with its task: real worker processes, told their roles as a relay tells them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import zenoh

from support.waiting import free_endpoint, until
from zsched.core.values import codec as wire
from zsched.core.values.plan import Role, WorkerRole
from zsched.core.values.relay_protocol import WorkerTrouble
from zsched.link.keyspace import Keyspace
from zsched.link.pipe.frames import decode_word
from zsched.link.sessions.config import data_config, worker_config

TASK, FLEET = "sum", "test"
KEYS = Keyspace(FLEET)

WORKER = '''
"""Adds up; its state is the total, padded so that it takes several chunks."""
import sys, time
from zsched.worker import Worker

total, size, mode = 0, int(sys.argv[1]), sys.argv[2]

def add(received):
    global total
    number = int(received.payload.to_bytes())
    total += number
    if mode != "quiet" or number == 0:
        out.put(str(total).encode())
    worker.session.put(f"{worker.prefix}/seen", received.payload)

def snapshot():
    worker.session.put(f"{worker.prefix}/asked", str(total))
    if mode in ("long", "slow"):
        time.sleep(3 if mode == "slow" else 0.8)
    return str(total).encode().rjust(size)

def restore(content):
    global total
    total = int(content)

with Worker.from_env() as worker:
    out = worker.publisher("{prefix}/{epoch}/total")
    worker.on_snapshot(restore)
    worker.subscribe("{prefix}/in", add, keep_last=None)
    if mode != "none":
        worker.offer_snapshot(snapshot)
    worker.ready()
    while worker.wait(1.0):
        pass
'''


@dataclass
class Hub:
    """One session that all workers join: it tells roles, feeds inputs, hears outputs and tokens."""

    folder: Path
    roles: dict[str, Role] = field(default_factory=dict)
    tokens: set[str] = field(default_factory=set)
    totals: list[tuple[str, int]] = field(default_factory=list)
    seen: list[str] = field(default_factory=list)
    asked: list[str] = field(default_factory=list)
    troubles: list[WorkerTrouble] = field(default_factory=list)
    workers: dict[str, subprocess.Popen[str]] = field(default_factory=dict)
    lives: int = 0

    def start(self) -> None:
        (self.folder / "worker.py").write_text(WORKER)
        self.endpoint = free_endpoint()
        text = data_config(listen=(self.endpoint,), connect=(), shared_memory=False)
        self.session = zenoh.open(zenoh.Config.from_json5(text))
        self._kept = [
            self.session.declare_queryable(KEYS.role("*", "*"), self._answer),
            self.session.liveliness().declare_subscriber(f"@zsched/{FLEET}/**", self._token, history=True),
            self.session.declare_subscriber(f"*/{TASK}/*/total", self._total),
            self.session.declare_subscriber(f"*/{TASK}/seen", lambda s: self.seen.append(s.payload.to_string())),
            self.session.declare_subscriber(f"*/{TASK}/asked", lambda s: self.asked.append(str(s.key_expr)[:5])),
            self.session.declare_subscriber(KEYS.trouble("*", "*", "*"), self._trouble),
        ]

    def _answer(self, query: zenoh.Query) -> None:
        with query:
            for key, role in tuple(self.roles.items()):
                if query.key_expr.intersects(key):
                    query.reply(key, wire.encode(role))

    def _trouble(self, sample: zenoh.Sample) -> None:
        word = decode_word(sample.payload.to_bytes())
        if isinstance(word, WorkerTrouble):
            self.troubles.append(word)

    def _token(self, sample: zenoh.Sample) -> None:
        act = self.tokens.add if sample.kind == zenoh.SampleKind.PUT else self.tokens.discard
        act(str(sample.key_expr))

    def _total(self, sample: zenoh.Sample) -> None:
        node, _, epoch, _ = str(sample.key_expr).split("/")
        self.totals.append((f"{node}@{epoch}", int(sample.payload.to_bytes())))

    def start_worker(self, node: str, size: int = 600_000, mode: str = "offers") -> subprocess.Popen[str]:
        self.lives += 1
        path = self.folder / f"{node}.json5"
        path.write_text(worker_config(connect=(self.endpoint,), shared_memory=False))
        env = os.environ | {
            "ZSCHED_FLEET": FLEET,
            "ZSCHED_NODE": node,
            "ZSCHED_TASK": TASK,
            "ZSCHED_INCARNATION": str(self.lives),
            "ZSCHED_ZENOH_CONFIG": str(path),
        }
        command = [sys.executable, str(self.folder / "worker.py"), str(size), mode]
        worker = subprocess.Popen(command, env=env, stderr=subprocess.PIPE, text=True)
        self.workers[node] = worker
        until(lambda: KEYS.worker(node, TASK, self.lives) in self.tokens, f"worker of {node}")
        return worker

    def tell(self, node: str, role: WorkerRole, epoch: int = 0, predecessor: str | None = None) -> None:
        value = Role(task=TASK, role=role, epoch=epoch, predecessor=predecessor)
        key = KEYS.role(node, TASK)
        self.roles[key] = value
        self.session.put(key, wire.encode(value), congestion_control=zenoh.CongestionControl.BLOCK)

    def feed(self, node: str, number: int) -> None:
        key = f"{node}/{TASK}/in"
        self.session.put(key, str(number).encode(), congestion_control=zenoh.CongestionControl.BLOCK)

    def shows(self, node: str, epoch: int) -> bool:
        return f"{KEYS.role(node, TASK)}/{epoch}" in self.tokens

    def said_by(self, node: str) -> str:
        """All that a worker wrote on stderr; ends it."""
        worker = self.workers[node]
        worker.kill()
        _, text = worker.communicate(timeout=60)
        return text

    def stop(self) -> None:
        for worker in self.workers.values():
            worker.send_signal(signal.SIGCONT)
            worker.kill()
            worker.communicate(timeout=60)
        self.session.close()


@pytest.fixture
def hub(tmp_path: Path) -> Iterator[Hub]:
    made = Hub(folder=tmp_path)
    made.start()
    try:
        yield made
    finally:
        made.stop()


def owns(hub: Hub, node: str, epoch: int) -> None:
    """Wait until a worker has heard its role and has its state; an input before that is a warm-up, taken twice."""
    until(lambda: hub.shows(node, epoch), f"{node} is the owner of epoch {epoch}")


def owned_by_edge1(hub: Hub, mode: str = "offers", standby: str = "offers") -> None:
    """edge1 has added up to 10 in epoch 1; edge2 stands by."""
    hub.start_worker("edge1", mode=mode)
    hub.start_worker("edge2", mode=standby)
    hub.tell("edge1", WorkerRole.ACTIVE, 1)
    owns(hub, "edge1", 1)
    for number in (1, 2, 3, 4):
        hub.feed("edge1", number)
    until(lambda: ("edge1@1", 10) in hub.totals, "the total of edge1")


def test_the_new_owner_goes_on_from_the_old_ones_state(hub: Hub) -> None:
    owned_by_edge1(hub)
    hub.tell("edge1", WorkerRole.DRAINING, 1)
    hub.tell("edge2", WorkerRole.ACTIVE, 2, "edge1")
    hub.feed("edge2", 100)  # at once: it waits for the state
    until(lambda: ("edge2@2", 110) in hub.totals, "the total of edge2")
    assert [total for name, total in hub.totals if name == "edge2@2"] == [110]
    assert hub.shows("edge2", 2)


def test_an_owner_that_is_long_in_giving_its_state_is_waited_for(hub: Hub) -> None:
    """Longer than a dead one: it is left because its machine is busy."""
    owned_by_edge1(hub, mode="long")
    hub.tell("edge1", WorkerRole.DRAINING, 1)
    hub.tell("edge2", WorkerRole.ACTIVE, 2, "edge1")
    hub.feed("edge2", 100)
    until(lambda: any(name == "edge2@2" for name, _ in hub.totals), "the total of edge2")
    assert [total for name, total in hub.totals if name == "edge2@2"] == [110]


def test_there_and_back_and_there_again(hub: Hub) -> None:
    owned_by_edge1(hub)
    total, owner = 10, "edge1"
    for epoch in range(2, 6):
        new = "edge2" if owner == "edge1" else "edge1"
        hub.tell(owner, WorkerRole.DRAINING, epoch - 1)
        hub.tell(new, WorkerRole.ACTIVE, epoch, owner)
        owns(hub, new, epoch)  # as a relay does: it flips when it sees the token
        hub.feed(new, epoch)
        total += epoch
        found = (f"{new}@{epoch}", total)
        until(lambda found=found: found in hub.totals, f"{found}")  # type: ignore[misc] # bound at once
        owner = new


@pytest.mark.parametrize("third", ["edge1", "edge3"])
def test_an_owner_of_a_moment_hands_on_the_state_that_it_still_waits_for(hub: Hub, third: str) -> None:
    """The task moves twice at once, or back at once. An empty state took the place of the owner's."""
    owned_by_edge1(hub, mode="long")
    if third == "edge3":
        hub.start_worker("edge3")
    hub.tell("edge1", WorkerRole.DRAINING, 1)
    hub.tell("edge2", WorkerRole.ACTIVE, 2, "edge1")
    until(lambda: hub.asked, "edge1 is asked for its state, and is long about it")
    hub.tell("edge2", WorkerRole.DRAINING, 2, "edge1")
    hub.tell(third, WorkerRole.ACTIVE, 3, "edge2")
    owns(hub, third, 3)
    hub.feed(third, 100)
    until(lambda: (f"{third}@3", 110) in hub.totals, f"the total of {third}")
    assert [total for name, total in hub.totals if name == f"{third}@3"] == [110]
    assert "cold_start" not in hub.said_by(third)


def test_an_owner_of_a_moment_that_hears_of_it_too_late_hands_on_the_state(hub: Hub) -> None:
    """It is told only that it drains."""
    owned_by_edge1(hub)
    hub.start_worker("edge3")
    hub.tell("edge1", WorkerRole.DRAINING, 1)
    hub.tell("edge2", WorkerRole.DRAINING, 2, "edge1")
    until(lambda: hub.asked, "edge2 has heard that, and asks edge1")
    hub.tell("edge3", WorkerRole.ACTIVE, 3, "edge2")
    owns(hub, "edge3", 3)
    hub.feed("edge3", 100)
    until(lambda: ("edge3@3", 110) in hub.totals, "the total of edge3")


def test_a_standby_that_was_not_the_owner_before_has_no_state_to_give(hub: Hub) -> None:
    """Its machine has not heard of its epoch. What it has is a standby's, or that of an older epoch."""
    owned_by_edge1(hub)
    hub.start_worker("edge3")
    hub.tell("edge3", WorkerRole.ACTIVE, 3, "edge2")
    owns(hub, "edge3", 3)
    hub.feed("edge3", 100)
    until(lambda: ("edge3@3", 100) in hub.totals, "edge3, cold")
    assert "why='refused: its worker was not the owner of epoch 2'" in hub.said_by("edge3")
    assert hub.asked == []


def test_a_standby_that_took_warm_up_values_starts_from_the_state_instead(hub: Hub) -> None:
    owned_by_edge1(hub)
    hub.feed("edge2", 1000)  # processed in standby; put out once it is the owner, behind the state
    until(lambda: "1000" in hub.seen, "the warm-up value is processed")
    hub.tell("edge1", WorkerRole.DRAINING, 1)
    hub.tell("edge2", WorkerRole.ACTIVE, 2, "edge1")
    until(lambda: ("edge2@2", 1010) in hub.totals, "the warm-up value on top of the state")


def test_an_input_that_outran_the_role_is_in_the_state_although_nothing_was_put_out_for_it(hub: Hub) -> None:
    """A robot flips after 0.3 s, told or not. What the standby did with it is lost when it takes the owner's state."""
    owned_by_edge1(hub, standby="quiet")
    hub.feed("edge2", 1000)
    until(lambda: "1000" in hub.seen, "it is processed before the role has come")
    hub.tell("edge1", WorkerRole.DRAINING, 1)
    hub.tell("edge2", WorkerRole.ACTIVE, 2, "edge1")
    hub.feed("edge2", 1)
    owns(hub, "edge2", 2)
    hub.feed("edge2", 0)
    until(lambda: any(name == "edge2@2" for name, _ in hub.totals), "the total of edge2")
    assert [total for name, total in hub.totals if name == "edge2@2"] == [1011]


def test_an_input_that_outran_the_role_counts_once_where_the_standbys_state_stays(hub: Hub) -> None:
    owned_by_edge1(hub, mode="none", standby="quiet")
    hub.feed("edge2", 1000)
    until(lambda: "1000" in hub.seen, "it is processed before the role has come")
    hub.tell("edge1", WorkerRole.DRAINING, 1)
    hub.tell("edge2", WorkerRole.ACTIVE, 2, "edge1")
    owns(hub, "edge2", 2)
    hub.feed("edge2", 0)
    until(lambda: ("edge2@2", 1000) in hub.totals, "once")


def test_a_killed_owner_means_a_cold_start_that_waits_for_no_answer(hub: Hub) -> None:
    owned_by_edge1(hub)
    hub.workers["edge1"].kill()
    until(lambda: not any("/worker/edge1/" in token for token in hub.tokens), "edge1's token is gone")
    hub.tell("edge2", WorkerRole.ACTIVE, 2, "edge1")
    owns(hub, "edge2", 2)
    hub.feed("edge2", 100)
    until(lambda: ("edge2@2", 100) in hub.totals, "edge2, cold")
    assert "cold_start epoch=2 from=edge1 why='nobody offers one'" in hub.said_by("edge2")


def test_an_owner_that_does_not_run_for_a_moment_is_waited_for(hub: Hub) -> None:
    """A full machine lets its threads wait; that is why the task leaves it, and no reason to lose its state."""
    owned_by_edge1(hub)
    hub.workers["edge1"].send_signal(signal.SIGSTOP)
    hub.tell("edge2", WorkerRole.ACTIVE, 2, "edge1")
    hub.feed("edge2", 100)
    time.sleep(0.7)
    hub.workers["edge1"].send_signal(signal.SIGCONT)
    until(lambda: ("edge2@2", 110) in hub.totals, "the state of edge1")


def test_a_frozen_owner_is_waited_for_until_its_link_ends(hub: Hub) -> None:
    owned_by_edge1(hub)
    hub.workers["edge1"].send_signal(signal.SIGSTOP)
    hub.tell("edge2", WorkerRole.ACTIVE, 2, "edge1")
    owns(hub, "edge2", 2)
    hub.feed("edge2", 100)
    until(lambda: ("edge2@2", 100) in hub.totals, "edge2, cold")
    assert "cold_start epoch=2 from=edge1" in hub.said_by("edge2")


def test_a_silent_owner_costs_two_seconds_and_one_whose_machine_is_gone_none(hub: Hub) -> None:
    silent = hub.session.declare_queryable(KEYS.snapshot("edge3", TASK), zenoh.handlers.FifoChannel(4))
    owned_by_edge1(hub)
    hub.tell("edge2", WorkerRole.ACTIVE, 2, "edge3")
    owns(hub, "edge2", 2)
    hub.tell("edge2", WorkerRole.ACTIVE, 3, "edge3")
    until(lambda: not hub.shows("edge2", 2), "edge2 has heard of epoch 3")
    hub.tell("edge2", WorkerRole.ACTIVE, 3)  # its daemon hears that edge3 is gone
    owns(hub, "edge2", 3)
    hub.feed("edge2", 100)  # it comes behind the line of the cold start
    until(lambda: ("edge2@3", 100) in hub.totals, "edge2, cold")
    said = hub.said_by("edge2")
    assert "cold_start epoch=2 from=edge3 why='no answer within 2 s'" in said
    assert "cold_start epoch=3 from=edge3 why='its machine is gone'" in said
    for epoch, why in ((2, "no answer within 2 s"), (3, "its machine is gone")):
        text = f"began epoch {epoch} without the state of edge3: {why}"
        assert text in [one.text for one in hub.troubles if one.is_cold]
    silent.undeclare()


@pytest.mark.parametrize(("mode", "why"), [("none", "nobody offers one"), ("slow", "late: it had not come in time")])
def test_an_owner_without_a_state_to_give_is_a_cold_start(hub: Hub, mode: str, why: str) -> None:
    owned_by_edge1(hub, mode)
    hub.tell("edge1", WorkerRole.DRAINING, 1)
    hub.tell("edge2", WorkerRole.ACTIVE, 2, "edge1")
    owns(hub, "edge2", 2)
    hub.feed("edge2", 100)
    until(lambda: ("edge2@2", 100) in hub.totals, "edge2, cold")
    assert why in hub.said_by("edge2")


def test_a_cold_standby_that_starts_as_the_owner_fetches_too(hub: Hub) -> None:
    hub.start_worker("edge1")
    hub.tell("edge1", WorkerRole.ACTIVE, 1)
    owns(hub, "edge1", 1)
    hub.feed("edge1", 7)
    until(lambda: ("edge1@1", 7) in hub.totals, "the total of edge1")
    hub.tell("edge1", WorkerRole.DRAINING, 1)
    hub.tell("edge2", WorkerRole.ACTIVE, 2, "edge1")
    hub.start_worker("edge2")
    hub.feed("edge2", 1)
    until(lambda: ("edge2@2", 8) in hub.totals, "edge2, started as the owner")
