"""A secured fleet of three machines whose sessions are opened anew, step by step, while a robot's stream runs.

Knows: the verbs by which a machine joins, and certificates are renewed, revoked and signed by another authority; what
became of each message of the stream. Does not know: what a test or a benchmark expects.
"""

from __future__ import annotations

import itertools
import json
import shutil
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import zenoh

from zsched.host import paths as places
from zsched.host.guard import guarded
from zsched.link.pipe.relay_socket import relay_pid
from zsched.link.sessions.config import client_config
from zsched_lab.fleet.hall import Hall, block_of_ports
from zsched_lab.fleet.testbed import TASK, echo_fleet

ROBOT, EDGES, GUEST = "robot1", ("edge1", "edge2"), "robot2"
DEADLINE_S = 240.0
"""An elector waits 2 min for one that is away, as a revoked one is."""
QUIET_S = 3.0
"""Behind a step its stream runs on for so long."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Outcome:
    """What became of the messages that were sent during one step."""

    step: str
    sent: int
    lost: int
    doubled: int
    longest_s: float
    """Between two answers."""


class Stream:
    """An application on a robot's local side: numbers at a rate, and when each came back."""

    def __init__(self, endpoint: str, robot: str, hz: float) -> None:
        """Join at ``endpoint``; `start` sends."""
        self._session = zenoh.open(zenoh.Config.from_json5(client_config(connect=(endpoint,), connect_s=20.0)))
        self.sent = 0
        self.answers: list[tuple[int, float]] = []
        self._session.declare_subscriber(f"{robot}/out", self._take)
        block = zenoh.CongestionControl.BLOCK
        self._publisher = self._session.declare_publisher(f"{robot}/in", congestion_control=block)
        self._period_s, self._halt = 1 / hz, threading.Event()
        self._thread = guarded(self._run, name="stream", is_lasting=False)

    def start(self) -> None:
        """Send from now on."""
        self._thread.start()

    def close(self) -> None:
        """Send no more, and leave."""
        self._halt.set()
        if self._thread.is_alive():
            self._thread.join(10)
        self._session.close()

    def _take(self, sample: zenoh.Sample) -> None:
        self.answers.append((int(sample.payload.to_bytes()), time.monotonic()))

    def _run(self) -> None:
        due = time.monotonic()
        while not self._halt.is_set():
            self._publisher.put(str(self.sent))
            self.sent += 1
            due = max(due + self._period_s, time.monotonic() - 1.0)
            self._halt.wait(max(0.0, due - time.monotonic()))


class Openings:
    """The fleet and the stream; use as a context manager, then take `steps` in their order."""

    def __init__(self, folder: Path, hz: float = 100.0) -> None:
        self.hall, self._folder, self._hz = Hall(folder), folder, hz
        self._port = block_of_ports(40)
        self._running = [ROBOT, *EDGES]
        self._stream: Stream | None = None

    def __enter__(self) -> Self:
        try:
            self._found()
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._stream is not None:
            self._stream.close()
        self.hall.stop()

    def steps(self) -> Iterator[Outcome]:
        """Take each step; what became of the stream meanwhile.

        Raises:
            AssertionError: a verb failed, or a step did not end in time.
        """
        yield self._step("a robot joins", self._join, (ROBOT, *EDGES))
        yield self._step("renewal", lambda: self._renew(ROBOT), (ROBOT,))
        yield self._step("revocation", self._revoke, (ROBOT, *EDGES))
        yield self._step("both authorities are trusted", self._rotate, (ROBOT, *EDGES))
        yield self._step("certificates of the new one", lambda: self._renew(ROBOT, *EDGES), (ROBOT, *EDGES))
        yield self._step("the old one is trusted no more", lambda: self._rotate("--finish"), (ROBOT, *EDGES))

    def relay(self) -> int | None:
        """The process id of the robot's relay."""
        return relay_pid(places.relay_path(self._folder / ROBOT / "run", ROBOT))

    # --- the fleet ---------------------------------------------------------------------------------------------------

    def _found(self) -> None:
        self.hall.zsched(ROBOT, "fleet", "create", "hall", "--address", f"127.0.0.1:{self._port}")
        self.hall.start(ROBOT)
        _until(lambda: self.hall.alive(ROBOT) == {ROBOT}, "the first daemon")
        for number, edge in enumerate(EDGES, 1):
            self._invite(edge, number, "--kind", "edge")
            self.hall.start(edge)
            members = {ROBOT, *EDGES[:number]}
            _until(lambda members=members: self.hall.alive(ROBOT) == members, f"{edge} in the fleet")  # type: ignore[misc]
        task = self._folder / "task.yaml"
        echo = echo_fleet(stream_class="reliable")["tasks"][TASK]
        echo["outputs"][0]["handover"] = "all"
        keys = "".join(f"    {key}: {json.dumps(value)}\n" for key, value in echo.items())
        task.write_text(f"tasks:\n  {TASK}:\n{keys}")
        self.hall.zsched(ROBOT, "task", "add", str(task), "--yes")
        _until(self._is_calm, "the fleet at rest, by the rules of the new task")
        endpoint = _until(lambda: self.hall.status(ROBOT).get("joins_at"), "the robot's local side")[0]
        self._stream = stream = Stream(endpoint, ROBOT, self._hz)
        stream.start()
        _until(lambda: len(stream.answers) > 2 * self._hz, "the stream")
        self._first = stream.answers[-1][0] + 1

    def _invite(self, name: str, number: int, *more: str) -> None:
        words = ("--address", f"127.0.0.1:{self._port + 10 * number}", "--yes", *more)
        file = self._folder / f"{name}.invite"
        file.write_text(self.hall.zsched(ROBOT, "invite", name, *words))
        self.hall.zsched(name, "join", str(file))

    def _lives(self, node: str) -> int:
        return self.hall.log(node).count("ready node=")

    def _is_calm(self) -> bool:
        """All live, an edge owns the task, and nobody has begun anew for a while."""
        lives = [self._lives(node) for node in self._running]
        time.sleep(QUIET_S)
        is_same = lives == [self._lives(node) for node in self._running]
        statuses = [self.hall.status(node) for node in self._running]
        return is_same and all(self._is_fit(status) for status in statuses)

    def _is_fit(self, status: dict[str, Any]) -> bool:
        alive = {str(one["name"]) for one in status.get("nodes", ()) if one["state"] == "alive"}
        owned = [task for task in status.get("tasks", ()) if task.get("owner") in EDGES]
        return set(self._running) <= alive and len(owned) == 1

    # --- steps -------------------------------------------------------------------------------------------------------

    def _join(self) -> None:
        self._invite(GUEST, 3)
        self.hall.start(GUEST)
        self._running.append(GUEST)

    def _renew(self, *nodes: str) -> None:
        for node in nodes:
            self.hall.zsched(ROBOT, "pki", "renew", node, "--deliver")

    def _revoke(self) -> None:
        self.hall.zsched(ROBOT, "pki", "revoke", GUEST)
        text = self.hall.zsched(ROBOT, "fleet", "export")
        file = self._folder / "revoked.yaml"
        file.write_text(text.replace("security: {}", f"security: {{revoked: [{GUEST}]}}"))
        self._running.remove(GUEST)
        self.hall.zsched(ROBOT, "apply", str(file), "--yes")

    def _rotate(self, *options: str) -> None:
        self.hall.zsched(ROBOT, "pki", "rotate", *options)
        for node in self._running:
            shutil.copy(self._folder / "stick" / "ca.pem", self._folder / node / "etc" / "pki" / "ca.pem")

    def _step(self, name: str, begin: Callable[[], None], anew: tuple[str, ...]) -> Outcome:
        stream = self._stream
        assert stream is not None
        first, lives = self._first, {node: self._lives(node) for node in anew}
        begin()
        _until(lambda: all(self._lives(node) > count for node, count in lives.items()), f"{name}: {anew} begin anew")
        _until(self._is_calm, f"{name}: the fleet at rest")
        end = stream.sent
        _until(lambda: any(number >= end for number, _ in stream.answers[-20:]), f"{name}: answers")
        time.sleep(1.0)  # what comes late
        self._first = end
        came = Counter(number for number, _ in tuple(stream.answers))
        times = [at for number, at in tuple(stream.answers) if first - 1 <= number <= end]
        return Outcome(
            step=name,
            sent=end - first,
            lost=sum(number not in came for number in range(first, end)),
            doubled=sum(came[number] - 1 for number in range(first, end) if number in came),
            longest_s=max(after - before for before, after in itertools.pairwise(times)),
        )


def _until(is_true: Callable[[], Any], what: str) -> Any:
    ends = time.monotonic() + DEADLINE_S
    while not (found := is_true()):
        if time.monotonic() > ends:
            raise AssertionError(f"not within {DEADLINE_S:g} s: {what}")
        time.sleep(0.1)
    return found
