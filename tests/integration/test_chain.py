"""The whole chain on real daemons: allocate, carry streams, move, survive a death, teach late joiners, take garbage."""

from __future__ import annotations

import contextlib
import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import zenoh

from support.waiting import within
from zsched.core.values import codec as wire
from zsched.core.values.model import Proposal
from zsched.host.operator_client import ask
from zsched.host.paths import socket_path
from zsched.link.keyspace import Keyspace
from zsched.link.sessions import config as zenoh_config
from zsched_lab.fleet.groups import LimitedGroup
from zsched_lab.fleet.testbed import DAEMON, Testbed, echo_fleet

STOP_S = 4.0
"""A daemon gives its children 1.5 s; the rest is for a machine that is busy with other things."""


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Testbed]:
    with Testbed(tmp_path_factory.mktemp("fleet"), echo_fleet()) as testbed:
        testbed.init()
        yield testbed


@pytest.fixture
def bed(fleet: Testbed) -> Testbed:
    """The fleet that most tests share: whole again, with an owner, whatever the last test did to it."""
    fleet.wait_whole()
    return fleet


def answer_s(bed: Testbed) -> float:
    """How long the decision loop of robot1 takes to answer."""
    asked_at = time.monotonic()
    bed.status("robot1")
    return time.monotonic() - asked_at


@pytest.fixture
def ping(bed: Testbed) -> Iterator[Callable[[str], Pinger]]:
    """Starts an application on a robot; it stops with the test."""
    with contextlib.ExitStack() as stack:

        def start(robot: str) -> Pinger:
            pinger = Pinger(bed, robot)
            stack.callback(pinger.stop)
            return pinger

        yield start


@pytest.fixture
def fresh(tmp_path: Path) -> Iterator[Testbed]:
    """A fleet that has never run."""
    with Testbed(tmp_path, echo_fleet()) as testbed:
        testbed.init()
        yield testbed


class Pinger:
    """A robot's application: publishes numbered messages on its own key and notes what comes back."""

    def __init__(self, bed: Testbed, robot: str, hz: float = 50.0) -> None:
        self.session = bed.app(robot)
        self.received: list[int] = []
        self._publisher = self.session.declare_publisher(f"{robot}/in")
        self._subscriber = self.session.declare_subscriber(f"{robot}/out", self._on_sample)
        self._stop = threading.Event()
        self.sent = 0
        self._period_s = 1.0 / hz
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _on_sample(self, sample: zenoh.Sample) -> None:
        self.received.append(int(sample.payload.to_bytes()[:10]))

    def _run(self) -> None:
        while not self._stop.wait(self._period_s):
            self._publisher.put(f"{self.sent:010d}".encode())
            self.sent += 1

    def stop(self) -> None:
        self._stop.set()
        self._thread.join(60)
        self.session.close()

    def has_newer_than(self, number: int) -> bool:
        return bool(self.received) and self.received[-1] > number


def test_allocation_is_reached_and_streams_flow_through_the_owner(bed: Testbed, ping: Callable[[str], Pinger]) -> None:
    """Three robots agree on one edge; an application's messages come back on its own key, unchanged and in order."""
    owner = bed.wait_settled()
    assert owner in {"edge1", "edge2", "edge3"}
    pinger = ping("robot1")
    bed.wait(lambda: pinger.has_newer_than(20), 60, "echoes at robot1")
    pinger.stop()
    numbers = list(pinger.received)
    assert numbers == sorted(set(numbers)), "doubled or out of order"


def test_stopping_owner_hands_its_task_over_first(bed: Testbed, ping: Callable[[str], Pinger]) -> None:
    """SIGTERM: the owner says that it drains, the robots move the task while it still runs, then it leaves."""
    owner = bed.wait_settled()
    pinger = ping("robot1")
    bed.wait(lambda: pinger.has_newer_than(5), 60, "first echoes")
    held = bed.wait(partial(_next_decision, bed, owner), 60, "a decision")["unkept"].get(owner, 0.0)
    ((code, seconds),) = bed.stop(owner).values()
    assert code == 0
    within(seconds, STOP_S)
    moved = bed.wait(lambda: _other_owner(bed, owner), 60, f"a move away from {owner}")
    last = pinger.sent
    bed.wait(lambda: pinger.has_newer_than(last), 60, "echoes through the new owner")
    pinger.stop()
    history = bed.task("robot1")["history"]
    assert (history[-1]["owner"], history[-1]["epoch"]) == (moved, history[-2]["epoch"] + 1)
    decision = bed.wait(partial(_next_decision, bed, moved), 60, "a decision about the new owner")
    assert decision["unkept"].get(owner, 0.0) <= held, "it was told to stop: that is no failure"


def test_an_owner_that_nobody_relieves_says_what_it_leaves_behind(bed: Testbed) -> None:
    """The robots stand still, so nothing moves; the last line of its log names the task."""
    owner = bed.wait_settled()
    robots = [name for name in bed.names if name.startswith("robot")]
    for robot in robots:
        bed.send(robot, signal.SIGSTOP)
    ((code, _),) = bed.stop(owner).values()
    for robot in robots:
        bed.send(robot, signal.SIGCONT)
    assert code == 0
    *_, said = [line for line in bed.log(owner).splitlines() if "zsched.daemon stopping" in line]  # of several lives
    assert "WARNING" in said
    assert "leaves 1 task behind after 3." in said
    assert "(echo): nobody has taken over" in said


def _next_decision(bed: Testbed, owner: str | None) -> dict[str, Any]:
    """The newest decision when it is for ``owner``, else an empty one."""
    decision: dict[str, Any] | None = bed.task("robot1")["decision"]
    return decision if decision is not None and decision["winner"] == owner else {}


def _other_owner(bed: Testbed, owner: str) -> str | None:
    now = bed.owner()
    return now if now not in (None, owner) else None


@pytest.mark.root
def test_injected_load_moves_the_task_to_a_quiet_edge(tmp_path: Path) -> None:
    """Each edge has its own CPU quota; a busy process beside the owner's worker makes another edge the better one."""
    reason = LimitedGroup.why_not()
    if reason is not None:
        pytest.skip(f"no cgroups here: {reason}")
    tree = echo_fleet(weights={"cpu": 1.0, "memory": 0.0, "network": 0.0})
    with contextlib.ExitStack() as stack:
        bed = stack.enter_context(Testbed(tmp_path, tree))
        bed.init()
        bed.start("robot1", "robot2", "robot3")
        groups = {}
        for edge in ("edge1", "edge2", "edge3"):
            groups[edge] = LimitedGroup.create(f"zsched-test-{os.getpid()}-{edge}", cpu_cores=0.5)
            stack.callback(groups[edge].remove)
            bed.start(edge)
            groups[edge].add(bed.pid(edge))
        stack.callback(bed.stop)
        owner = bed.wait_settled()
        # it yields to the daemon beside it, which else looks dead on a busy machine; the quota is used up all the same
        busy = subprocess.Popen(["nice", "-n", "19", sys.executable, "-c", "while True: pass"])
        stack.callback(busy.wait, 10)
        stack.callback(busy.kill)
        groups[owner].add(busy.pid)
        moved = bed.wait(lambda: _other_owner(bed, owner), 60, f"a move away from {owner}")
        assert moved in {"edge1", "edge2", "edge3"} - {owner}
        reasons = [bed.task(robot)["history"][-1]["reason"] for robot in ("robot1", "robot2", "robot3")]
        assert any(" s more than " in reason for reason in reasons), reasons


def test_killed_owner_is_replaced_and_messages_flow_again(bed: Testbed, ping: Callable[[str], Pinger]) -> None:
    """SIGKILL of the owner's daemon: its workers die with it, the robots commit another edge, the stream goes on."""
    owner = bed.wait_settled()
    pinger = ping("robot2")
    bed.wait(lambda: pinger.has_newer_than(5), 60, "first echoes")
    bed.kill(owner)
    at, sent = time.monotonic(), pinger.sent
    bed.wait(lambda: pinger.has_newer_than(sent), 60, "echoes after the kill")
    within(time.monotonic() - at, 5.0, "until another owner answers")
    pinger.stop()
    assert bed.wait_settled() != owner
    reason = bed.task("robot1")["history"][-1]["reason"]
    assert owner in reason or "peer" in reason


def test_late_robot_learns_the_allocation_and_its_streams_start(bed: Testbed, ping: Callable[[str], Pinger]) -> None:
    """A robot that was not there when the owner was chosen routes to that owner and epoch after joining."""
    before = bed.wait_settled()
    bed.kill("robot3")
    bed.kill(before)
    bed.wait(lambda: _other_owner(bed, before), 60, f"another owner than {before}")
    epoch = bed.task("robot1")["epoch"]
    bed.start("robot3")

    def known() -> set[tuple[str, int]]:
        return {(task["owner"], task["epoch"]) for task in map(bed.task, ("robot1", "robot2", "robot3"))}

    # The others may have moved it once more meanwhile: all nodes share this machine, and it is busy.
    bed.wait(lambda: bed.task("robot3")["epoch"] >= epoch and len(known()) == 1, 60, "robot3 to know what all know")
    bed.wait(lambda: bed.task("robot3")["phase"] == "settled", 60, "robot3 to settle")
    pinger = ping("robot3")
    bed.wait(lambda: pinger.has_newer_than(3), 60, "echoes at robot3")


@pytest.mark.long
def test_restart_with_state_keeps_allocation_and_counts_lives(bed: Testbed) -> None:
    """All daemons stop and start again: the learnt owner and epoch are still there, every incarnation is higher."""
    owner = bed.wait_settled()
    before = bed.status("robot1")
    codes = bed.stop()
    assert {code for code, _ in codes.values()} == {0}
    within(max(seconds for _, seconds in codes.values()), STOP_S)
    bed.start()
    bed.wait_settled()
    after = bed.status("robot1")
    assert after["incarnation"] > before["incarnation"]
    assert after["tasks"][0]["epoch"] >= before["tasks"][0]["epoch"]
    assert after["tasks"][0]["history"][0]["owner"] == owner


def test_bad_frames_only_raise_counters(bed: Testbed) -> None:
    """Garbage, foreign, stale and oversized frames on every control key: counted; owner, epoch and loop untouched."""
    owner = bed.wait_settled()
    epoch = bed.task("robot1")["epoch"]
    config = zenoh_config.client_config(connect=(bed.fleet.node("robot1").listen_control,), timing=bed.fleet.timing)
    keys, rng = Keyspace(bed.fleet.name), random.Random(7)
    good = wire.encode(Proposal(voter="robot2", task="echo", base_revision=0, candidate="edge1", aggregate=1.0))

    def counted_after_more(session: zenoh.Session) -> bool:
        """Another 200 frames: of what nobody waits for, a busy machine may lose some on the way."""
        for round_number in range(200):
            key = rng.choice([keys.beat, keys.profile, keys.proposal, keys.allocation])(rng.choice(["robot2", "ghost"]))
            frame = bytearray(good if round_number % 2 else rng.randbytes(rng.choice([0, 3, 60, 20_000])))
            if frame and round_number % 4 == 1:
                frame[rng.randrange(len(frame))] ^= 0xFF
            session.put(key, bytes(frame))
        counters: dict[str, int] = bed.status("robot1")["counters"]
        return sum(counters.values()) > 100

    with zenoh.open(zenoh.Config.from_json5(config)) as session:
        for body in (b"", b"\xc1", good):
            list(session.get(keys.register("robot1", "ghost"), payload=body, timeout=0.3))
        bed.wait(lambda: counted_after_more(session), 60, "counters")
    bed.wait(lambda: answer_s(bed) < 0.5, 60, "the loop not held up")
    bed.wait_whole()
    status = bed.status("robot1")
    assert any(name.startswith("dropped_") for name in status["counters"])
    assert (status["tasks"][0]["owner"], status["tasks"][0]["epoch"]) == (owner, epoch)


def test_weights_change_on_the_running_fleet_for_every_robot(bed: Testbed) -> None:
    """The parameter server: one command, committed like an allocation, in force at every robot; owner untouched."""
    owner = bed.wait_settled()
    answer = bed.weigh("edge3", 0.2)
    assert answer["outcome"] == "ok", answer

    def everywhere() -> bool:
        expected = {"cpu": 0.2, "memory": 0.8, "network": 0.0, "gauges": {}}
        return all(bed.task(node)["tuning"]["weights"] == expected for node in bed.names)

    bed.wait(everywhere, 60, "the weights everywhere")
    assert bed.task("robot1")["owner"] == owner
    assert "is not in [0, 1]" in bed.weigh("edge3", 1.5)["error"]


def test_remote_status_answers_for_any_node(bed: Testbed) -> None:
    """`status --node`: any local daemon asks the mesh."""
    other, away = sorted({"edge1", "edge2", "edge3"} - {bed.wait_settled()})
    answer = ask(socket_path(bed.folder, "robot1"), {"verb": "status", "node": other})
    assert answer["node"] == other
    bed.kill(away)
    missing = ask(socket_path(bed.folder, "robot1"), {"verb": "status", "node": away}, timeout_s=60.0)
    assert "did not answer" in missing["error"]


@pytest.mark.long
def test_without_state_a_robot_votes_but_is_no_elector(tmp_path: Path) -> None:
    """A node without a valid state file works, is no elector, and says so; the other two electors suffice."""
    with Testbed(tmp_path, echo_fleet(edges=1)) as bed:
        bed.init("robot1", "robot2", "edge1")
        bed.start()
        bed.wait_settled()
        status = bed.status("robot3")
        assert status["quorum"]["this_node"] == "lost_state"
        assert any("no valid state file" in problem for problem in status["problems"])


def test_wrong_node_name_exits_78_and_names_the_known_ones(tmp_path: Path) -> None:
    """Bad configuration: exit code 78, so that systemd does not restart it."""
    bed = Testbed(tmp_path, echo_fleet(robots=1, edges=1))
    done = subprocess.run(
        [*DAEMON, "--config", bed.file, "--node", "nobody"],
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
        env={**os.environ, "ZSCHED_STATE_DIR": str(tmp_path), "ZSCHED_RUNTIME_DIR": str(tmp_path)},
    )
    assert done.returncode == 78
    assert "edge1, robot1" in done.stderr


def test_second_daemon_on_the_same_state_is_refused(bed: Testbed) -> None:
    """Two daemons must not share one durable state."""
    done = subprocess.run(
        [*DAEMON, "--config", bed.file, "--node", "robot1", "--state-dir", bed.folder / "robot1"],
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
        env={**os.environ, "ZSCHED_RUNTIME_DIR": str(bed.folder / "other")},
    )
    assert done.returncode == 1
    assert "in use" in done.stderr


def test_sigterm_right_after_start_leaves_nothing(fresh: Testbed) -> None:
    """A clean exit within 2 s from a state that is only half built."""
    bed = fresh
    for delay_s in (0.0, 0.15, 0.4, 0.8):
        bed.start("edge1")
        deadline = time.monotonic() + delay_s
        bed.wait(lambda end=deadline: time.monotonic() >= end, 60, "the delay")  # type: ignore[misc]
        ((code, seconds),) = bed.stop("edge1").values()
        within(seconds, STOP_S, f"after {delay_s} s")
        assert code in {0, -signal.SIGTERM}
    assert not list(bed.folder.glob("*.sock"))
