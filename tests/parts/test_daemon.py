"""The composition root: endpoints, exit codes, logs, an orderly end from its first moment on."""

from __future__ import annotations

import contextlib
import json
import math
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh

from support.fleets import fleet_of, node_of
from support.sessions import matches
from support.waiting import until
from zsched import daemon
from zsched.core.values import events as ev
from zsched.core.values.errors import AdapterError
from zsched.core.values.exits import EXIT_CONFIG, EXIT_FAILED, EXIT_OK
from zsched.core.values.fleet import Fleet, LinkSpec, NodeSpec
from zsched.core.values.model import NodeKind
from zsched.core.values.profile import DeviceSample, LinkSource
from zsched.core.vote.clocks import is_bad
from zsched.host import clock
from zsched.host.clock import ClockWatch, Drift, SleepWatch
from zsched.host.log_limit import BURST, RATE_HZ
from zsched.host.operator_client import ask
from zsched.host.paths import relay_path, socket_path
from zsched.host.state_file import StateFile
from zsched.link.keyspace import Keyspace
from zsched.link.pipe.relay_socket import relay_pid
from zsched.link.sessions.config import worker_config
from zsched.link.sessions.endpoints import (
    MAX_PORT,
    MIN_PORT,
    PORT_RANGE,
    Endpoints,
    claim_port,
    endpoints_for,
    free_port,
    is_here,
)
from zsched.runtime.inbox import Inbox
from zsched.runtime.sampler import Sampler
from zsched_lab.fleet.testbed import echo_fleet

Json = dict[str, Any]


# --- endpoints -------------------------------------------------------------------------------------------------------


def spec(name: str, *, host: str = "", control: str = "", data: str = "") -> NodeSpec:
    return node_of(name, kind=NodeKind.EDGE, host=host, listen_control=control, listen_data=data)


def fleet(*nodes: NodeSpec, seeds: tuple[str, ...] = ()) -> Fleet:
    return fleet_of(of=nodes, tasks=(), seeds=seeds)


def endpoints(me: NodeSpec, *others: NodeSpec, seeds: tuple[str, ...] = ()) -> Endpoints:
    return endpoints_for(fleet(me, *others, seeds=seeds), me, lambda: 50000)


def test_node_listens_where_the_file_says_and_its_workers_dial_it_on_this_machine() -> None:
    found = endpoints(spec("a", host="192.0.2.1", control="tcp/0.0.0.0:7457", data="tcp/0.0.0.0:7458"))
    assert found == Endpoints(
        control_listen=("tcp/0.0.0.0:7457",),
        control_connect=(),
        data_listen=("tcp/0.0.0.0:7458",),
        data_connect=(),
        worker_connect=("tcp/127.0.0.1:7458",),
        control_by_gossip=False,
        data_by_gossip=False,
        worker_by_gossip=False,
    )


def test_node_without_endpoints_takes_free_ports_and_knows_the_one_that_its_workers_need() -> None:
    found = endpoints(spec("a"))
    assert found.control_listen == ("tcp/0.0.0.0:0",)
    assert found.data_listen == ("tcp/0.0.0.0:50000",)
    assert found.worker_connect == ("tcp/127.0.0.1:50000",)


@pytest.mark.parametrize(
    ("data", "connect"),
    [
        ("tcp/127.0.0.1:7458", "tcp/127.0.0.1:7458"),
        ("tcp/127.0.0.2:7458", "tcp/127.0.0.2:7458"),
        ("tcp/[::1]:7458", "tcp/[::1]:7458"),
        ("tcp/192.0.2.1:7458", "tcp/192.0.2.1:7458"),
        ("tcp/[::]:7458", "tcp/127.0.0.1:7458"),
        ("tls/0.0.0.0:7458", "tls/127.0.0.1:7458"),
    ],
)
def test_workers_dial_their_own_relay_where_it_listens(data: str, connect: str) -> None:
    assert endpoints(spec("a", data=data)).worker_connect == (connect,)


def test_what_the_file_does_not_say_listens_with_tls_where_there_is_tls() -> None:
    found = endpoints_for(fleet(spec("a")), spec("a"), lambda: 50000, protocol="tls")
    assert (found.control_listen, found.data_listen) == (("tls/0.0.0.0:0",), ("tls/0.0.0.0:50000",))
    assert found.worker_connect == ("tls/127.0.0.1:50000",)


def test_port_zero_is_replaced_by_a_port_that_workers_can_dial() -> None:
    found = endpoints(spec("a", data="tcp/0.0.0.0:0"))
    assert found.data_listen == ("tcp/0.0.0.0:50000",)
    assert found.worker_connect == ("tcp/127.0.0.1:50000",)


def test_seeds_are_dialled_at_their_host_except_ourselves_and_who_cannot_be() -> None:
    me = spec("f", host="192.0.2.1", control="tcp/0.0.0.0:7457", data="tcp/0.0.0.0:7458")
    both = spec("b", host="192.0.2.2", control="tcp/0.0.0.0:7457", data="tcp/0.0.0.0:7458")
    six = spec("c", host="2001:db8::3", control="tcp/[::]:7457", data="tcp/192.0.2.3:1")
    nowhere = spec("d", control="tcp/0.0.0.0:7457", data="tcp/0.0.0.0:7458")
    any_port = spec("e", host="192.0.2.5", control="tcp/0.0.0.0:0")
    no_seed = spec("g", host="192.0.2.7", control="tcp/0.0.0.0:7457", data="tcp/0.0.0.0:7458")
    found = endpoints(me, both, six, nowhere, any_port, no_seed, seeds=("f", "b", "c", "d", "e"))
    assert (found.control_connect, found.data_connect) == ((), ())  # the first seed is dialled by all others
    found = endpoints(replace(me, name="z"), both, six, nowhere, any_port, no_seed, seeds=("b", "c", "d", "e"))
    assert found.control_connect == ("tcp/192.0.2.2:7457", "tcp/[2001:db8::3]:7457", "tcp/192.0.2.7:7457")
    assert found.data_connect == ("tcp/192.0.2.2:7458", "tcp/192.0.2.3:1", "tcp/192.0.2.7:7458")


def test_every_control_link_is_dialled_by_one_side_and_by_somebody() -> None:
    nodes = [
        spec(name, host=f"192.0.2.{n}", control=f"tcp/0.0.0.0:{n}", data=f"tcp/0.0.0.0:{n}0")
        for n, name in enumerate("abcd", 1)
    ]
    nodes += [spec("e")]  # says nothing: it dials everybody
    whole = fleet(*nodes, seeds=("c", "a"))
    dialled = {node.name: endpoints_for(whole, node, lambda: 50000).control_connect for node in nodes}
    assert {name: len(targets) for name, targets in dialled.items()} == {"a": 1, "b": 2, "c": 0, "d": 3, "e": 4}
    assert dialled["b"] == ("tcp/192.0.2.1:1", "tcp/192.0.2.3:3")
    assert endpoints_for(whole, nodes[1], lambda: 50000).data_connect == ("tcp/192.0.2.1:10", "tcp/192.0.2.3:30")


def test_only_who_gives_no_address_dials_by_gossip_and_only_if_there_are_two() -> None:
    known = replace(spec("a", host="192.0.2.1", control="tcp/0.0.0.0:1", data="tcp/0.0.0.0:2"), kind=NodeKind.ROBOT)
    hidden = [replace(spec(name), kind=NodeKind.ROBOT) for name in "bc"]

    def gossip(me: NodeSpec, *nodes: NodeSpec) -> tuple[bool, bool, bool]:
        found = endpoints_for(fleet(*nodes), me, lambda: 1)
        return found.control_by_gossip, found.data_by_gossip, found.worker_by_gossip

    assert gossip(known, known, *hidden) == (False, False, True), "its workers look for the hidden robots"
    assert gossip(hidden[0], known, *hidden) == (True, True, True)
    assert gossip(hidden[0], known, hidden[0]) == (False, True, False), "others' workers look for it"
    assert gossip(known, known) == (False, False, False)
    assert endpoints_for(fleet(known, *hidden), hidden[0], lambda: 1).worker_connect[1:] == ("tcp/192.0.2.1:2",)


def test_workers_dial_their_own_relay_first_and_then_the_robots() -> None:
    nodes = [
        replace(spec(name, host=f"192.0.2.{n}", control="tcp/0.0.0.0:1", data="tcp/0.0.0.0:2"), kind=kind)
        for n, (name, kind) in enumerate({"e": NodeKind.EDGE, "r": NodeKind.ROBOT, "s": NodeKind.ROBOT}.items(), 1)
    ]
    found = endpoints_for(fleet(*nodes), nodes[0], lambda: 1).worker_connect
    assert found == ("tcp/127.0.0.1:2", "tcp/192.0.2.2:2", "tcp/192.0.2.3:2")


def test_own_address_on_another_machine_is_dialled_for_there_may_be_a_twin() -> None:
    me = spec("a", host="192.0.2.1", control="tcp/0.0.0.0:7457")
    assert endpoints_for(fleet(me), me, lambda: 1, lambda _: False).control_connect == ("tcp/192.0.2.1:7457",)
    assert endpoints_for(fleet(me), me, lambda: 1, lambda _: True).control_connect == ()


def test_an_address_is_here_when_it_can_be_bound() -> None:
    assert is_here("127.0.0.1")
    assert not is_here("192.0.2.1")  # RFC 5737: nobody's


def test_free_port_is_none_that_an_outgoing_connection_may_get() -> None:
    low, high = (int(word) for word in PORT_RANGE.read_text().split())
    if low <= MIN_PORT and high == MAX_PORT:
        pytest.skip("this machine gives them all to outgoing connections")
    for _ in range(20):
        port = free_port()
        assert MIN_PORT <= port <= MAX_PORT
        assert not low <= port <= high


@pytest.mark.parametrize(
    ("outgoing", "expected"),
    [(range(32768, 61000), range(61000, 65536)), (range(32768, 65536), range(MIN_PORT, 32768))],
)
def test_free_port_lies_above_the_outgoing_ones_or_below(outgoing: range, expected: range) -> None:
    assert free_port(outgoing) in expected


def test_free_port_is_any_when_no_other_is_free() -> None:
    with socket.socket() as taken:
        with contextlib.suppress(OSError):  # somebody else has it: as good
            taken.bind(("127.0.0.1", MAX_PORT))
        assert free_port(range(1024, MAX_PORT)) not in (0, MAX_PORT)


def test_a_port_is_claimed_by_one_of_several_that_find_it_free() -> None:
    port = free_port()
    first = claim_port(port)
    assert first is not None
    assert (first.port, claim_port(port)) == (port, None)
    first.close()
    second = claim_port(port)
    assert second is not None
    second.close()


def test_a_port_on_which_somebody_listens_is_not_claimed() -> None:
    port = free_port()
    with socket.socket() as other:
        other.bind(("127.0.0.1", port))
        other.listen()
        assert claim_port(port) is None
    after = claim_port(port)
    assert after is not None, "the refused claim was given back"
    after.close()


def test_a_node_without_a_data_endpoint_takes_the_default_port_and_the_next_one_here_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Applications find a robot's relay without the fleet file; several daemons on one machine are a lab."""
    default = free_port()
    monkeypatch.setattr(daemon, "DATA_PORT", default)
    file = tmp_path / "fleet.yaml"
    file.write_text(json.dumps(echo_fleet(robots=1, edges=1)))
    options = daemon.Options(config=file, node="robot1", state_dir=tmp_path / "state", runtime_dir=tmp_path)
    with contextlib.ExitStack() as first, contextlib.ExitStack() as second:
        assert daemon.Daemon(options)._data_port(first) == default
        assert daemon.Daemon(options)._data_port(second) != default
        first.close()
        assert daemon.Daemon(options)._data_port(second) == default


# --- the sampler -----------------------------------------------------------------------------------------------------


def test_samplers_problem_is_told_once_and_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A driver that fails for a while: one problem, one end, and samples again."""
    inbox, shell = Inbox(), SimpleNamespace(crew=SimpleNamespace(supervisor=None, sessions={}))
    sampler = Sampler(spec("a"), 0.001, tmp_path, shell, inbox)  # type: ignore[arg-type]
    sample, failures = sampler._device.sample, iter([True] * 3)

    def fails_at_first(workers: Any) -> Any:
        if next(failures, False):
            raise OSError("no /proc")
        return sample(workers)

    monkeypatch.setattr(sampler._device, "sample", fails_at_first)
    sampler.start()
    first, second = inbox.take(60.0), inbox.take(60.0)
    assert isinstance(first, ev.ProblemReported)
    assert isinstance(second, ev.ProblemReported)
    assert [first.problem, second.problem] == ["cannot measure: no /proc", None]
    samples: list[ev.Event] = []

    def sampled() -> bool:
        samples.extend(event for event in inbox.waiting() if isinstance(event, ev.ProfileSampled))
        return len(samples) >= 3

    until(sampled, "samples again")
    sampler.stop()
    assert inbox.take(0.0) is None, "and told once"


def test_a_link_that_leaves_the_fleet_file_takes_its_problem_along(tmp_path: Path) -> None:
    inbox, shell = Inbox(), SimpleNamespace(crew=SimpleNamespace(supervisor=None, sessions={}))
    links = tuple(LinkSpec(source=LinkSource.FIXED, peer=peer, value="none") for peer in ("b", "c"))
    sampler = Sampler(replace(spec("a"), links=links), 0.001, tmp_path, shell, inbox)  # type: ignore[arg-type]
    problems: dict[str, str | None] = {}

    def told() -> set[str]:
        list(inbox.waiting())
        while (one := inbox.take(0.0)) is not None:
            if isinstance(one, ev.ProblemReported):
                problems[one.source] = one.problem
        return {source for source, problem in problems.items() if problem is not None}

    sampler.start()
    until(lambda: told() == {"profile/link0", "profile/link1"}, "both cannot be read")
    sampler.measure(replace(spec("a"), links=links[1:]), 0.001)
    until(lambda: told() == {"profile/link0"}, "the other one only")
    sampler.measure(spec("a"), 0.001)
    until(lambda: told() == set(), "none")
    sampler.stop()


def test_work_wakes_a_sampler_at_rest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The readings are ours: the machine that runs this test is not at rest."""
    inbox, shell = Inbox(), SimpleNamespace(crew=SimpleNamespace(supervisor=None, sessions={}))
    sampler = Sampler(spec("a"), 0.001, tmp_path, shell, inbox, is_watched=False)  # type: ignore[arg-type]
    idle = DeviceSample(cpu_cores=1.0, cpu_used_cores=0.0, memory_mb=1024.0, memory_used_mb=100.0)
    monkeypatch.setattr(sampler._device, "sample", lambda _: idle)
    monkeypatch.setattr("zsched.core.profile.sampling.CHANGING_S", 0.05)
    monkeypatch.setattr("zsched.core.profile.sampling.REST_S", 3600.0)
    sampler.start()
    until(lambda: sampler._wait_s == 3600.0, "rest")
    list(inbox.waiting())
    closely: list[None] = []
    monkeypatch.setattr(sampler._device, "look_closely", lambda: closely.append(None))
    sampler.hurry()
    until(lambda: next(inbox.waiting(), None) or inbox.take(0.0), "a sample")
    assert closely, "at all threads, too"
    until(lambda: sampler._wait_s == 3600.0, "rest again")
    sampler.stop()
    assert not sampler._thread.is_alive(), "and a stop does not wait"


def test_work_makes_a_sampler_look_closely_that_never_rests(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot's: its radio is measured often at all times. Reports of jobs that follow closely wait for their turn."""
    inbox, shell = Inbox(), SimpleNamespace(crew=SimpleNamespace(supervisor=None, sessions={}))
    links = (LinkSpec(source=LinkSource.FIXED, peer="b", value="-60"),)
    robot = replace(spec("a"), links=links)
    sampler = Sampler(robot, 0.001, tmp_path, shell, inbox, is_watched=False)  # type: ignore[arg-type]
    idle = DeviceSample(cpu_cores=1.0, cpu_used_cores=0.0, memory_mb=1024.0, memory_used_mb=100.0)
    steps: list[str] = []

    def sample(_: Any) -> DeviceSample:
        steps.append("sample")
        return idle

    def wait_for_samples() -> None:
        past = len(steps)
        until(lambda: steps[past:].count("sample") >= 3, "samples")

    monkeypatch.setattr(sampler._device, "sample", sample)
    monkeypatch.setattr(sampler._device, "look_closely", lambda: steps.append("closely"))
    monkeypatch.setattr("zsched.runtime.sampler.RESTING_LOOK_S", 3600.0)
    sampler.start()
    wait_for_samples()
    assert "closely" not in steps, "nothing has happened"
    assert sampler._wait_s == 0.001
    for _ in range(2):
        sampler.hurry()
        wait_for_samples()
    assert steps.count("closely") == 1
    monkeypatch.setattr("zsched.runtime.sampler.RESTING_LOOK_S", 0.0)
    until(lambda: steps.count("closely") == 2, "its turn")
    sampler.stop()


def test_the_sampler_tells_the_node_of_a_slew_and_a_jump(tmp_path: Path) -> None:
    """What is wrong wakes the loop, what is well does not; the readings are ours, the watch and its judgement real."""
    inbox, shell = Inbox(), SimpleNamespace(crew=SimpleNamespace(supervisor=None, sessions={}))
    sampler = Sampler(spec("a"), 0.001, tmp_path, shell, inbox)  # type: ignore[arg-type]
    rest = [(10.0 + 0.2 * n, 5.0) for n in range(4)]
    slew = [(10.8 + 0.2 * n, 5.0 + 0.083 * 0.2 * (n + 1)) for n in range(3)]
    jump = [(12.0 + 0.2 * n, 65.0) for n in range(2)]
    readings = iter((*rest, *slew, *jump))
    compared, is_over = ClockWatch(), threading.Event()

    def look() -> Drift | None:
        reading = next(readings, None)
        if reading is None:
            is_over.set()
            return None
        return compared.judge(*reading)

    sampler._clocks.look = look  # type: ignore[method-assign]
    sampler.start()
    assert is_over.wait(60.0)
    sampler.stop()
    aloud = [event for event in iter(lambda: inbox.take(0.0), None) if isinstance(event, ev.ClockCompared)]
    quiet = [event for event in inbox.waiting() if isinstance(event, ev.ClockCompared)]
    assert all(is_bad(event) for event in aloud), aloud
    assert not any(is_bad(event) for event in quiet), quiet
    assert [round(event.error_ratio, 3) for event in aloud] == [0.021, 0.033, 0.05, 0.0], "a slew, and one jump"
    assert [round(event.jump_s, 2) for event in aloud[-1:]] == [59.95]
    assert len(quiet) == 4, "three before, one after"


def test_a_node_hears_of_a_sleep_before_what_is_judged_by_the_time_after_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """The watch looks a second later: by then a clock that counts too long a sleep has ended a grant's hold."""
    heard: list[ev.Event] = []

    class Hearing:
        def absorb(self, event: ev.Event, _now: float) -> None:
            heard.append(event)

        def handle(self, event: ev.Event, now: float) -> tuple[()]:
            self.absorb(event, now)
            return ()

        def next_deadline(self) -> float:
            return math.inf

    node: Any = Hearing()
    frame = ev.StopRequested()  # any event
    shell: Any = SimpleNamespace(carry_out=lambda _batch: None, waiting_frames=lambda: iter([frame]))
    one = object.__new__(daemon.Daemon)
    one._inbox, one._sleeps, one._is_ready = Inbox(), SleepWatch(), True
    one._alert_until = -math.inf
    one._absorb_waiting(node, shell)
    assert heard == [frame], "nothing is told of no sleep"
    for step in (lambda: one._absorb_waiting(node, shell), lambda: one._turn(node, shell, frame)):
        heard.clear()
        monkeypatch.setattr(clock._Slept, "seconds", clock._Slept.seconds + 60.0)
        step()
        told, *rest = heard
        assert isinstance(told, ev.ClockCompared)
        assert is_bad(told)
        assert (round(told.jump_s), rest) == (60, [frame])


# --- the process -----------------------------------------------------------------------------------------------------

NOT_ITS_OWN = frozenset({"JOURNAL_STREAM", "ZENOH_RUNTIME", "NOTIFY_SOCKET", "WATCHDOG_USEC"})
FIRST_LIFE = """
import os, signal, sys
from zsched import daemon
if "BEGUN" not in os.environ:
    from zsched.runtime.session_watch import SessionWatch
    os.environ["BEGUN"], SessionWatch.is_due = "1", lambda *_: DUE
    sys.exit(daemon.main(sys.argv[1:]))
from pathlib import Path
from zsched.link.pipe.relay_socket import relay_pid
for pid in filter(None, map(relay_pid, Path(sys.argv[-1]).glob("*.relay"))):
    os.kill(pid, signal.SIGKILL)  # it has our stderr, of which the test waits for the end
"""


class Place:
    """A fleet file and folders of its own; runs the daemon's command line in a process."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.file = folder / "fleet.yaml"
        self.file.write_text(json.dumps(echo_fleet(robots=1, edges=1)))
        self.processes: list[subprocess.Popen[str]] = []

    def start(self, *arguments: str, node: str | None = "edge1", env: Mapping[str, str] | None = None) -> Any:
        places = ["--state-dir", str(self.folder / "state"), "--runtime-dir", str(self.folder)]
        named = [] if node is None else ["--node", node]
        process = subprocess.Popen(
            [sys.executable, "-m", "zsched.daemon", "--config", str(self.file), *named, *places, *arguments],
            stderr=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**{k: v for k, v in os.environ.items() if k != "JOURNAL_STREAM"}, **(env or {})},
        )
        self.processes.append(process)
        return process

    def run(self, *arguments: str, node: str | None = "edge1", env: Mapping[str, str] | None = None) -> tuple[int, str]:
        process = self.start(*arguments, node=node, env=env)
        out, error = process.communicate(timeout=60)
        assert out == "", "stdout is data"
        return process.returncode, error

    def status(self) -> Json | None:
        try:
            return ask(socket_path(self.folder, "edge1"), {"verb": "status"}, 10.0)
        except AdapterError:
            return None


@pytest.fixture
def place(tmp_path: Path) -> Iterator[Place]:
    made = Place(tmp_path)
    yield made
    for process in made.processes:
        if process.poll() is None:
            process.kill()
            if (relay := relay_pid(relay_path(made.folder, "edge1"))) is not None:
                os.kill(relay, signal.SIGKILL)
        process.communicate(timeout=60)


def test_help_goes_to_stdout_and_is_fine(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        daemon.main(["--help"])
    assert stopped.value.code == EXIT_OK
    assert "--runtime-dir" in capsys.readouterr().out


def test_unknown_argument_is_a_usage_error(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        daemon.main(["--nonsense"])
    assert stopped.value.code == 2
    assert "--nonsense" in capsys.readouterr().err


def test_wrong_file_and_wrong_name_end_with_78_and_say_why(place: Place) -> None:
    code, error = place.run(node="ghost")
    assert code == EXIT_CONFIG
    assert "no node 'ghost' under 'nodes' (there are edge1, robot1)" in error
    code, error = place.run(node="robott1")
    assert code == EXIT_CONFIG
    assert "did you mean 'robot1'? Say which one this machine is" in error
    place.file.write_text("fleet: [")
    code, error = place.run()
    assert code == EXIT_CONFIG
    assert "fleet.yaml:1:" in error
    assert "Traceback" not in error


def test_a_worker_s_session_that_cannot_be_written_ends_with_1_and_is_named(place: Place) -> None:
    path = place.folder / "edge1-echo.zenoh.json5"
    path.mkdir()
    code, error = place.run()
    assert (code, f"zsched up: cannot write {path}: Is a directory" in error) == (EXIT_FAILED, True), error
    assert "Traceback" not in error


def test_folder_in_use_ends_with_1_and_names_the_process(place: Place) -> None:
    with StateFile(place.folder / "state", fleet="testbed", node="edge1"):
        code, error = place.run()
    assert code == EXIT_FAILED
    assert f"in use by process {os.getpid()}" in error
    assert "Traceback" not in error


def test_node_comes_from_the_environment_and_logs_carry_times_outside_the_journal(place: Place) -> None:
    """Also: no state is a warning, the node works, its status says what is wrong, SIGTERM ends it with 0 in time."""
    process = place.start(node=None, env={"ZSCHED_NODE": "edge1"})
    status = until(place.status, "its status")
    assert status["node"] == "edge1"
    assert any("run `zsched init`" in problem for problem in status["problems"])
    process.send_signal(signal.SIGTERM)
    _, error = process.communicate(timeout=60)
    assert process.returncode == EXIT_OK
    lines = error.splitlines()
    assert all(line[:2] == "20" and line[4] == "-" for line in lines), error
    assert any("WARNING zsched.daemon no_state" in line for line in lines)
    assert any("INFO zsched.daemon stopping node=edge1" in line for line in lines)
    assert not socket_path(place.folder, "edge1").exists()
    assert not list(place.folder.glob("*.zenoh.json5"))


def test_journal_stamps_its_own_times_and_an_early_stop_is_an_orderly_one(place: Place) -> None:
    """SIGTERM while the adapters still open: the sockets, files and processes that there are go all the same."""
    process = place.start("--log-level", "DEBUG", env={"JOURNAL_STREAM": "1:2"})
    until(lambda: socket_path(place.folder, "edge1").exists(), "the first thing that it opens")
    process.send_signal(signal.SIGTERM)
    _, error = process.communicate(timeout=60)
    assert process.returncode == EXIT_OK, error
    assert not socket_path(place.folder, "edge1").exists()
    assert {line.split()[0] for line in error.splitlines()} <= {"DEBUG", "INFO", "WARNING"}, error


def begin_anew(place: Place, second_life: str, env: Mapping[str, str] | None = None, due: str = "True") -> Any:
    """A daemon whose turn it is at once; what its process becomes runs ``second_life`` in place of a daemon's start.

    ``due``: what tells that it is its turn.
    """
    places = ["--state-dir", str(place.folder / "state"), "--runtime-dir", str(place.folder)]
    process = subprocess.Popen(
        [
            sys.executable,
            "-c",
            FIRST_LIFE.replace("DUE", due) + second_life,
            "--config",
            str(place.file),
            "--node",
            "edge1",
            *places,
        ],
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**{name: value for name, value in os.environ.items() if name not in NOT_ITS_OWN}, **(env or {})},
    )
    place.processes.append(process)
    return process


@pytest.mark.parametrize("of_operator", [None, "(rx: (worker_threads: 5))"])
def test_the_daemon_that_follows_in_the_process_sizes_zenoh_s_pools_itself(
    place: Place, of_operator: str | None
) -> None:
    """It took those of the one before for an operator's, and gave them to all of its workers."""
    env = {} if of_operator is None else {"ZENOH_RUNTIME": of_operator}
    process = begin_anew(place, "print('begun with', os.environ.get('ZENOH_RUNTIME'), file=sys.stderr)", env)
    _, error = process.communicate(timeout=60)
    assert process.returncode == EXIT_OK, error
    assert error.splitlines()[-1] == f"begun with {of_operator}"


def test_a_daemon_that_is_stopped_while_it_looks_whether_it_begins_anew_ends(place: Place) -> None:
    """It went on as another daemon, which nobody had told to stop."""
    stopped = "os.kill(os.getpid(), signal.SIGTERM) or True"
    process = begin_anew(place, "print('begun', file=sys.stderr)", due=stopped)
    _, error = process.communicate(timeout=60)
    assert process.returncode == EXIT_OK, error
    assert "begun" not in error
    assert "INFO zsched.daemon stopping node=edge1" in error
    assert not list(place.folder.glob("*.again"))


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGUSR2], ids=["reload", "restart"])
def test_a_signal_that_comes_while_the_next_daemon_of_the_process_loads_is_taken_by_it(
    place: Place, number: signal.Signals
) -> None:
    """It ended the process; also: systemd is told in time that it lives."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        name = f"zsched-test-{os.getpid()}"
        systemd.bind(f"\0{name}")
        told_twice = f"""
for number in ({int(number)}, signal.SIGTERM):
    os.kill(os.getpid(), number)
sys.exit(daemon.main(sys.argv[1:]))
"""
        process = begin_anew(place, told_twice, {"NOTIFY_SOCKET": f"@{name}"})
        _, error = process.communicate(timeout=60)
        assert process.returncode == EXIT_OK, error
        assert error.count("INFO zsched.daemon stopping node=edge1") == 2, error
        systemd.setblocking(False)
        heard = []
        with contextlib.suppress(BlockingIOError):
            while True:
                heard.append(systemd.recv(4096))
    assert heard.count(b"WATCHDOG=1") == 1, "nobody has asked the loop for it"


def test_daemon_and_relay_limit_what_they_log(place: Place) -> None:
    """1000 lines that a library prints in it, 1000 bad acknowledgements: a burst, and how many were left out."""
    process = place.start(env={"RUST_LOG": ""})
    until(lambda: place.status() is not None, "its status")
    endpoint = json.loads(place.file.read_text())["nodes"]["edge1"]["listen"]["data"]
    config = worker_config(connect=(endpoint,), shared_memory=False)
    printed = Path(f"/proc/{process.pid}/fd/1")
    began = time.monotonic()
    with zenoh.open(zenoh.Config.from_json5(config)) as stranger, printed.open("w") as standard_output:
        relay = until(lambda: next(iter(stranger.info.peers_zid()), None), "the relay")
        bad = stranger.declare_publisher(
            Keyspace("testbed").ack("edge1", "echo", 1, str(relay)), congestion_control=zenoh.CongestionControl.BLOCK
        )
        until(lambda: matches(bad), "the relay to listen for acknowledgements")
        for number, count in enumerate((1000, 1, 1, 1, 1)):
            for _ in range(count):
                bad.put(b"no frame")
            standard_output.write("printed by a library\n" * count)
            standard_output.flush()
            room_at = began + number + 1.0
            until(lambda: time.monotonic() > room_at, "room for another line")  # noqa: B023 - called at once
        until(lambda: place.status() is not None, "an answer behind it all")
        took_s = time.monotonic() - began + 1.0
    process.send_signal(signal.SIGTERM)
    _, error = process.communicate(timeout=60)
    for text in ("zsched.relay WARNING an unreadable acknowledgement", "zsched.zenoh printed by a library"):
        lines = [line for line in error.splitlines() if text in line]
        assert BURST <= len(lines) <= BURST + RATE_HZ * took_s, (text, len(lines))
        assert any("more from here were left out" in line for line in lines), text


def test_options_are_found_in_arguments_and_environment(
    place: Place, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    seen: list[daemon.Options] = []

    class Recorder:
        begins_anew = False

        def __init__(self, options: daemon.Options) -> None:
            seen.append(options)

        def run(self) -> int:
            return 0

    monkeypatch.setattr(daemon, "Daemon", Recorder)
    for name in ("CONFIG", "NODE", "STATE_DIR", "RUNTIME_DIR"):
        monkeypatch.setenv(f"ZSCHED_{name}", str(tmp_path / name))
    assert daemon.main([]) == 0
    assert daemon.main(["--node", "robot1", "--config", str(place.file)]) == 0
    folders = {"state_dir": tmp_path / "STATE_DIR", "runtime_dir": tmp_path / "RUNTIME_DIR"}
    expected = daemon.Options(config=tmp_path / "CONFIG", node=str(tmp_path / "NODE"), **folders)
    assert seen == [expected, replace(expected, node="robot1", config=place.file)]
