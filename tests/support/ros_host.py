"""A ROS 2 robot's host: a router of its own, the relay beside it, one task of a fleet file that the test moves.

Knows: rmw_zenoh's router, local sides, the executor's steps. Does not know: what the nodes on either side say.
"""

from __future__ import annotations

import contextlib
import os
import signal
import tempfile
from functools import partial
from pathlib import Path

import zenoh

from support.books import assert_nothing_is_unaccounted
from support.relay_rig import Reports
from support.waiting import free_endpoint, until
from zsched.config.load import check_bytes
from zsched.core.route.route import plan_for, slot_for
from zsched.core.values.events import RelayChanged, SlotFlipped, SlotReady
from zsched.core.values.fleet import LocalSide
from zsched.core.values.plan import RoutePhase, Slot
from zsched.link.sessions.config import client_config, data_config, local_config
from zsched.runtime.relay.streams import RelayHandle
from zsched_lab.fleet.relays import hello_of

ROBOT = "robot1"


def opened(text: str, mode: str = "", listen: str = "") -> zenoh.Session:
    """A session with timestamps, as in rmw_zenoh's configurations."""
    config = zenoh.Config.from_json5(text)
    config.insert_json5("timestamping/enabled", "true")
    if mode:
        config.insert_json5("mode", f'"{mode}"')
        config.insert_json5("listen/endpoints", f'["{listen}"]')
    return zenoh.open(config)


class RosHost:
    """``host`` is the router's endpoint, ``seed`` the data network's; edges have no daemons."""

    def __init__(self, stack: contextlib.ExitStack, file: str) -> None:
        """Start what ``stack`` closes; ``file`` is the text of a fleet file, its first task the one that moves."""
        result = check_bytes(file.encode())
        assert result.fleet is not None, result.report()
        self._task = result.fleet.tasks[0]
        self._now: Slot | None = None
        self.host, self.seed = free_endpoint(), free_endpoint()
        stack.callback(opened(client_config(connect=()), "router", self.host).close)
        self.reports = Reports()
        self._relay = RelayHandle(
            hello=hello_of("test", ROBOT),
            path=Path(stack.enter_context(tempfile.TemporaryDirectory())) / "relay",
            zenoh_config=data_config(listen=(self.seed,), connect=(), shared_memory=False),
            on_report=self.reports.add,
            local_config=local_config(LocalSide(connect=(self.host,))),
        )
        self._relay.start()
        stack.callback(self._relay.stop, 2.0)
        until(lambda: self.reports.find(RelayChanged, is_running=True), "the relay runs")

    def assert_nothing_is_unaccounted(self) -> None:
        """Every sample that came in is somewhere in the counters, of every stream (`zsched.core.hop.books`)."""
        assert_nothing_is_unaccounted(self.reports.told)

    def kill_relay(self) -> None:
        """Without a word, as the kernel does when memory is short; another one follows, and opens the owner's slot."""
        pid = self._relay.pid
        assert pid is not None
        os.kill(pid, signal.SIGKILL)
        until(lambda: self._relay.pid not in (None, pid), "another relay runs")

    def move(self, owner: str) -> None:
        """To a new owner, whose predecessor is closed at the end."""
        old = self._now
        new = self._now = slot_for(self._task, ROBOT, owner, 1 if old is None else old.epoch + 1)
        for phase, kind in ((RoutePhase.PREPARE, SlotReady), (RoutePhase.FLIP, SlotFlipped)):
            self._relay.apply(plan_for(self._task, phase, new, () if old is None else (old,)))
            until(partial(self.reports.find, kind, epoch=new.epoch), f"{phase} {owner}")
        self._relay.apply(plan_for(self._task, RoutePhase.CLOSE, new, ()))
