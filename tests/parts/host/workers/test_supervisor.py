"""Real processes under the supervisor: start, readiness, failure, restart, stop, output, and the daemon's own death."""

from __future__ import annotations

import logging
import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType

import psutil
import pytest

from zsched.core.values.fleet import WorkerSpec
from zsched.core.values.profile import WorkerState
from zsched.host.workers.process import LINES_BURST, WorkerGuard
from zsched.host.workers.supervisor import RestartPolicy, WorkerContext, WorkerSupervisor

QUICK = RestartPolicy(first_s=0.02, most_s=0.1)
SLEEP = "import time; time.sleep(60)"


class Recorder:
    """Keeps what the supervisor tells."""

    def __init__(self) -> None:
        self.calls: list[tuple[object, ...]] = []
        self._changed = threading.Condition()

    def on_started(self, task: str, pid: int, incarnation: int) -> None:
        self._add("started", task, pid, incarnation)

    def on_exited(self, task: str, incarnation: int, returncode: int, reason: str) -> None:
        self._add("exited", task, incarnation, returncode, reason)

    def on_failed(self, task: str, reason: str) -> None:
        self._add("failed", task, reason)

    def on_reset(self, task: str) -> None:
        self._add("reset", task)

    def on_stopped(self, task: str) -> None:
        self._add("stopped", task)

    def on_compared(self, task: str, *, is_old: bool) -> None:
        self._add("compared", task, is_old)

    def _add(self, *call: object) -> None:
        with self._changed:
            self.calls.append(call)
            self._changed.notify_all()

    def wait(self, kind: str, count: int = 1, timeout_s: float = 60.0) -> tuple[object, ...]:
        def found() -> list[tuple[object, ...]]:
            return [call for call in self.calls if call[0] == kind]

        with self._changed:
            assert self._changed.wait_for(lambda: len(found()) >= count, timeout_s), self.calls
            return found()[count - 1]


def wait_until(condition: Callable[[], bool], timeout_s: float = 60.0) -> None:
    end_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end_s, "condition not met in time"
        time.sleep(0.005)


def is_running(pid: int) -> bool:
    try:
        return bool(psutil.Process(pid).status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False


def python(code: str, **changes: object) -> WorkerSpec:
    return WorkerSpec(command=("python", "-c", code), **{"stop_grace_s": 0.2, **changes})  # type: ignore[arg-type]


@contextmanager
def supervised(
    spec: WorkerSpec,
    policy: RestartPolicy = QUICK,
    made: Mapping[str, str] = MappingProxyType({}),
    **environment: str,
) -> Iterator[tuple[WorkerSupervisor, Recorder]]:
    """``made``: variables that the test may change."""
    recorder = Recorder()
    supervisor = WorkerSupervisor(
        specs={"merge": spec},
        context=WorkerContext(fleet="hall", node="edge1", incarnation=7),
        events=recorder,
        environment=lambda task: {"TASK_SEEN": task, **environment, **made},
        rng=random.Random(1),
        policy=policy,
    )
    try:
        yield supervisor, recorder
    finally:
        pids = list(supervisor.pids().values())
        supervisor.close(within_s=10.0)
        assert not supervisor.pids()
        assert not [pid for pid in pids if is_running(pid)]


def read_pid(path: Path) -> int:
    wait_until(lambda: path.exists() and path.read_text().endswith("\n"))
    return int(path.read_text())


def test_start_gives_the_worker_its_environment_and_pid(tmp_path: Path) -> None:
    out = tmp_path / "env"
    code = (
        "import os, time; names = ['ZSCHED_FLEET', 'ZSCHED_NODE', 'ZSCHED_TASK', 'ZSCHED_INCARNATION', 'TASK_SEEN',"
        " 'OWN', 'NOTIFY_SOCKET', 'PYTHONUNBUFFERED']\n"
        f"open({str(out)!r}, 'w').write(' '.join(os.environ.get(n, '-') for n in names) + '\\n'); time.sleep(60)"
    )
    os.environ["NOTIFY_SOCKET"] = "/nowhere"
    try:
        with supervised(python(code, env=(("OWN", "x"),))) as (supervisor, recorder):
            supervisor.start("merge")
            _, _, pid, incarnation = recorder.wait("started")
            wait_until(lambda: out.exists() and out.read_text().endswith("\n"))
            assert out.read_text().split() == ["hall", "edge1", "merge", "700001", "merge", "x", "-", "1"]
            assert incarnation == 700001
            assert supervisor.pids() == {"merge": pid}
            assert supervisor.states() == {"merge": WorkerState.STARTING}
    finally:
        del os.environ["NOTIFY_SOCKET"]


def test_ready_is_believed_only_from_the_running_incarnation() -> None:
    with supervised(python(SLEEP)) as (supervisor, recorder):
        supervisor.start("merge")
        recorder.wait("started")
        supervisor.mark_ready("merge", 699999)
        supervisor.mark_gone("merge", 700001)
        assert supervisor.states()["merge"] is WorkerState.STARTING
        supervisor.mark_ready("merge", 700001)
        wait_until(lambda: supervisor.states()["merge"] is WorkerState.READY)
        supervisor.mark_gone("merge", 700001)
        wait_until(lambda: supervisor.states()["merge"] is WorkerState.STARTING)


def test_stop_uses_sigint_first_and_start_runs_it_again() -> None:
    with supervised(python(SLEEP, stop_grace_s=10.0)) as (supervisor, recorder):
        supervisor.start("merge")
        recorder.wait("started")
        supervisor.mark_ready("merge", 700001)
        supervisor.stop("merge")
        supervisor.start("merge")
        _, _, _, _, reason = recorder.wait("exited")
        assert reason == "stopped by SIGINT"
        _, _, _, incarnation = recorder.wait("started", 2)
        assert incarnation == 700002
        assert not [call for call in recorder.calls if call[0] == "failed"]


def test_renew_stops_a_worker_as_stop_does_and_starts_it_again_without_a_failure() -> None:
    with supervised(python(f"print('here', flush=True); {SLEEP}", stop_grace_s=60.0, max_failures=1)) as (
        supervisor,
        recorder,
    ):
        supervisor.renew("merge")  # nothing runs: nothing to do
        supervisor.start("merge")
        recorder.wait("started")
        supervisor.mark_ready("merge", 700001)
        kept = supervisor.output("merge")
        assert kept is not None
        wait_until(lambda: kept.behind(0)[1] >= 1)
        supervisor.renew("merge")
        assert recorder.wait("exited")[-1] == "stopped by SIGINT"
        assert recorder.wait("started", 2)[-1] == 700002
        wait_until(lambda: [line.text for line in kept.behind(0)[0]].count("here") == 2)
        assert not [call for call in recorder.calls if call[0] == "failed"]


def test_renew_starts_no_worker_that_is_not_wanted() -> None:
    with supervised(python(SLEEP, stop_grace_s=10.0)) as (supervisor, recorder):
        supervisor.start("merge")
        recorder.wait("started")
        supervisor.mark_ready("merge", 700001)
        supervisor.renew("merge")
        supervisor.stop("merge")
        recorder.wait("exited")
        wait_until(lambda: supervisor.states()["merge"] is WorkerState.STOPPED)
        assert [call[0] for call in recorder.calls].count("started") == 1


def test_output_is_kept_of_workers_that_are_started_here() -> None:
    with supervised(WorkerSpec(command=())) as (supervisor, _):
        assert supervisor.output("merge") is None
        assert supervisor.output("other") is None


def test_a_worker_that_is_starting_is_stopped_without_a_traceback(caplog: pytest.LogCaptureFixture) -> None:
    """It has no handlers yet: Python would answer SIGINT with a KeyboardInterrupt in the middle of an import."""
    caplog.set_level("INFO")
    code = "print('up', flush=True); import time; time.sleep(60)"
    with supervised(python(code, stop_grace_s=10.0)) as (supervisor, recorder):
        supervisor.start("merge")
        wait_until(lambda: "up" in caplog.text)
        supervisor.stop("merge")
        _, _, _, _, reason = recorder.wait("exited")
        assert reason == "stopped by SIGTERM"
    assert "Traceback" not in caplog.text


def test_stop_kills_a_stubborn_worker_and_its_grandchildren(tmp_path: Path) -> None:
    code = (
        "import signal, subprocess, time\n"
        "for number in (signal.SIGINT, signal.SIGTERM): signal.signal(number, signal.SIG_IGN)\n"
        "child = subprocess.Popen(['sleep', '60'])\n"
        f"open({str(tmp_path / 'pid')!r}, 'w').write(f'{{child.pid}}\\n')\n"
        "while True: time.sleep(60)"
    )
    with supervised(python(code)) as (supervisor, recorder):
        supervisor.start("merge")
        grandchild = read_pid(tmp_path / "pid")
        supervisor.stop("merge")
        _, _, _, returncode, reason = recorder.wait("exited")
        assert (returncode, reason) == (-signal.SIGKILL, "stopped by SIGKILL")
        wait_until(lambda: not is_running(grandchild))


def test_worker_that_keeps_failing_fails_for_good_until_it_is_renewed() -> None:
    with supervised(python("print('no camera'); raise SystemExit(3)")) as (supervisor, recorder):
        supervisor.start("merge")
        assert recorder.wait("failed") == ("failed", "merge", "exited with status 3: no camera")
        kinds = [call[0] for call in recorder.calls]
        assert kinds == ["started", "exited"] * 3 + ["failed"]
        wait_until(lambda: supervisor.states()["merge"] is WorkerState.FAILED)
        supervisor.start("merge")
        supervisor.renew("merge")
        recorder.wait("started", 4)
        assert [call[0] for call in recorder.calls][7:9] == ["reset", "started"]


@pytest.mark.parametrize(
    ("command", "reason"),
    [
        (("python", "-c", "print('no GPU here'); raise SystemExit(78)"), "exited with status 78: no GPU here"),
        (("no-such-program",), "exited with status 78: cannot run 'no-such-program': No such file or directory"),
    ],
)
def test_worker_that_says_it_cannot_fails_at_once(command: tuple[str, ...], reason: str) -> None:
    with supervised(WorkerSpec(command=command)) as (supervisor, recorder):
        supervisor.start("merge")
        assert recorder.wait("failed") == ("failed", "merge", reason)
        assert [call[0] for call in recorder.calls] == ["started", "exited", "failed"]


@pytest.mark.parametrize(
    ("said", "asks"),
    [
        ("ModuleNotFoundError: No module named 'rclpy'", True),
        ("ModuleNotFoundError: No module named 'nav_msgs'", True),
        ("librclcpp.so: cannot open shared object file: No such file or directory", True),
        ("bash: line 1: ros2: command not found", True),
        ("ModuleNotFoundError: No module named 'numpy'", False),
        ("the map is broken", False),
    ],
)
def test_a_worker_that_lacks_ros_is_asked_for_its_environment(said: str, *, asks: bool) -> None:
    with supervised(python(f"print({said!r}); raise SystemExit(78)")) as (supervisor, recorder):
        supervisor.start("merge")
        reason = str(recorder.wait("failed")[2])
        assert reason.startswith(f"exited with status 78: {said}")
        assert reason.endswith("; is ROS there, and its setup.bash sourced in the command?") == asks


def test_crashed_worker_is_started_again_with_a_new_incarnation() -> None:
    with supervised(python(SLEEP)) as (supervisor, recorder):
        supervisor.start("merge")
        pid = recorder.wait("started")[2]
        assert isinstance(pid, int)
        os.kill(pid, signal.SIGSEGV)
        _, _, incarnation, returncode, reason = recorder.wait("exited")
        assert (incarnation, returncode) == (700001, -signal.SIGSEGV)
        assert "signal 11" in str(reason)
        assert recorder.wait("started", 2)[3] == 700002


def test_worker_that_is_never_ready_is_ended_and_counted() -> None:
    with supervised(python(SLEEP, start_deadline_s=0.1, max_failures=2)) as (supervisor, recorder):
        supervisor.start("merge")
        assert recorder.wait("failed") == ("failed", "merge", "not ready within 0.1 s")
        assert [call[0] for call in recorder.calls] == ["started", "exited"] * 2 + ["failed"]


def test_worker_that_is_never_ready_fails_however_long_that_takes() -> None:
    """Three starts of 40 s each do not fit into a window of a minute."""
    spec = python(SLEEP, start_deadline_s=0.1, max_failures=3, failure_window_s=0.01)
    with supervised(spec) as (supervisor, recorder):
        supervisor.start("merge")
        recorder.wait("failed")
        assert [call[0] for call in recorder.calls] == ["started", "exited"] * 3 + ["failed"]


def test_failures_before_a_worker_was_ready_are_forgotten_behind_the_window() -> None:
    with supervised(python(SLEEP, max_failures=2, failure_window_s=0.01)) as (supervisor, recorder):
        supervisor.start("merge")
        for count in range(1, 5):
            _, _, pid, incarnation = recorder.wait("started", count)
            assert isinstance(pid, int)
            assert isinstance(incarnation, int)
            supervisor.mark_ready("merge", incarnation)
            wait_until(lambda: supervisor.states()["merge"] is WorkerState.READY)
            os.kill(pid, signal.SIGKILL)
            recorder.wait("exited", count)
        recorder.wait("started", 5)


def test_hung_worker_is_killed_and_started_again() -> None:
    with supervised(python(SLEEP, stop_grace_s=30)) as (supervisor, recorder):
        supervisor.start("merge")
        pid = recorder.wait("started")[2]
        assert isinstance(pid, int)
        os.kill(pid, signal.SIGSTOP)
        supervisor.report_hung("merge", 700000, "an older one")
        supervisor.report_hung("merge", 700001, "no output for 5 s")
        assert recorder.wait("exited")[3:] == (-signal.SIGKILL, "no output for 5 s")
        recorder.wait("started", 2)


def test_a_hung_worker_of_somebody_else_is_left_alone() -> None:
    with supervised(WorkerSpec()) as (supervisor, _):
        supervisor.mark_ready("merge", 0)
        supervisor.report_hung("merge", 0, "no output for 5 s")
        supervisor.mark_gone("merge", 0)
        wait_until(lambda: supervisor.states()["merge"] is WorkerState.STOPPED)


def test_stop_during_the_backoff_starts_nothing() -> None:
    with supervised(python("raise SystemExit(1)", max_failures=1000)) as (supervisor, recorder):
        supervisor.start("merge")
        recorder.wait("exited", 3)
        supervisor.stop("merge")
        wait_until(lambda: not supervisor.pids())
        time.sleep(0.15)  # longer than the longest delay
        count = len(recorder.calls)
        time.sleep(0.15)
        assert len(recorder.calls) == count
        assert supervisor.states()["merge"] is WorkerState.STOPPED


def test_who_is_stopped_while_it_waits_for_its_next_start_is_told_of() -> None:
    """It was said to restart for as long as nobody started it."""
    patient = RestartPolicy(first_s=600.0, most_s=600.0)
    with supervised(python("raise SystemExit(1)"), policy=patient) as (supervisor, recorder):
        supervisor.start("merge")
        recorder.wait("exited")
        assert supervisor.why_again("merge")
        supervisor.stop("merge")
        recorder.wait("stopped")
        assert [call[0] for call in recorder.calls] == ["started", "exited", "stopped"]
        assert supervisor.why_again("merge") == ""


def test_foreign_worker_is_never_started_but_may_be_ready() -> None:
    with supervised(WorkerSpec()) as (supervisor, recorder):
        supervisor.start("merge")
        supervisor.mark_ready("merge", 0)
        wait_until(lambda: supervisor.states()["merge"] is WorkerState.READY)
        supervisor.mark_gone("merge", 0)
        wait_until(lambda: supervisor.states()["merge"] is WorkerState.STOPPED)
        assert recorder.calls == []


def test_a_worker_that_gets_its_command_is_started_though_somebody_else_s_was_ready() -> None:
    """It counted as running for good: neither restart nor retry did anything."""
    with supervised(WorkerSpec()) as (supervisor, recorder):
        supervisor.start("merge")
        supervisor.mark_ready("merge", 0)
        wait_until(lambda: supervisor.states()["merge"] is WorkerState.READY)
        supervisor.keep({"merge": python(SLEEP)})
        recorder.wait("started")
        supervisor.mark_gone("merge", 0)
        wait_until(lambda: supervisor.states()["merge"] is WorkerState.STARTING)


def test_a_worker_that_loses_its_command_is_stopped_by_all_signals_and_another_one_s_is_seen_then() -> None:
    """It closes its session and hangs: that its token goes is no end of its process."""
    code = (
        "import signal, time; [signal.signal(n, signal.SIG_IGN) for n in (2, 15)]; print('up')\nwhile 1: time.sleep(9)"
    )
    with supervised(python(code)) as (supervisor, recorder):
        supervisor.start("merge")
        output = supervisor.output("merge")
        assert output is not None
        wait_until(lambda: bool(output.behind(0)[0]))
        supervisor.keep({"merge": WorkerSpec(stop_grace_s=0.2)})
        supervisor.mark_gone("merge", 0)
        supervisor.mark_ready("merge", 0)
        assert recorder.wait("exited")[-1] == "stopped by SIGKILL"
        wait_until(lambda: supervisor.states()["merge"] is WorkerState.READY)
        assert [call for call in recorder.calls if call[0] == "failed"] == []


def test_close_ends_a_stubborn_worker_in_time() -> None:
    code = (
        "import signal, time; [signal.signal(n, signal.SIG_IGN) for n in (2, 15)]; print('up')\nwhile 1: time.sleep(9)"
    )
    with supervised(python(code, stop_grace_s=30.0)) as (supervisor, recorder):
        supervisor.start("merge")
        recorder.wait("started")
        begin_s = time.monotonic()
        supervisor.close(within_s=1.0)
        assert time.monotonic() - begin_s < 20.0, "not its grace time of 30 s"
        assert not supervisor.pids()
        supervisor.start("merge")  # after the end: no error, no worker


def test_a_worker_whose_restart_is_due_while_another_one_ends_is_not_started_any_more() -> None:
    """Nobody would have stopped it: the end took longer, and the log blamed the kernel."""
    stubborn = (
        "import signal, time; [signal.signal(n, signal.SIG_IGN) for n in (2, 15)]; print('up')\nwhile 1: time.sleep(9)"
    )
    recorder = Recorder()
    supervisor = WorkerSupervisor(
        specs={"crashes": python("raise SystemExit(1)", max_failures=1000), "stubborn": python(stubborn)},
        context=WorkerContext(fleet="hall", node="edge1", incarnation=7),
        events=recorder,
        policy=RestartPolicy(first_s=0.6, most_s=0.6, jitter_ratio=0.0),
    )
    try:
        supervisor.start("stubborn")
        output = supervisor.output("stubborn")
        assert output is not None
        wait_until(lambda: bool(output.behind(0)[0]))
        supervisor.start("crashes")
        assert recorder.wait("exited")[1] == "crashes"
    finally:
        supervisor.close(within_s=1.5)
    assert [call[1] for call in recorder.calls if call[0] == "started"] == ["stubborn", "crashes"]
    assert not supervisor.pids()


def test_handler_that_raises_does_not_stop_the_supervisor(caplog: pytest.LogCaptureFixture) -> None:
    class Broken(Recorder):
        def on_started(self, task: str, pid: int, incarnation: int) -> None:
            super().on_started(task, pid, incarnation)
            raise RuntimeError("bug")

    recorder = Broken()
    context = WorkerContext(fleet="hall", node="edge1", incarnation=1)
    supervisor = WorkerSupervisor(specs={"merge": python(SLEEP)}, context=context, events=recorder)
    supervisor.start("merge")
    recorder.wait("started")
    supervisor.stop("merge")
    recorder.wait("exited")
    supervisor.close()
    assert "event_handler_failed" in caplog.text


def test_a_worker_that_starts_keeps_its_time_when_the_machine_is_suspended(monkeypatch: pytest.MonkeyPatch) -> None:
    """It slept, too: boot time is a minute later at once, its 20 s to start are not over."""
    real, slept = time.clock_gettime, [0.0]
    monkeypatch.setattr(
        time, "clock_gettime", lambda clock: real(clock) + (slept[0] if clock == time.CLOCK_BOOTTIME else 0.0)
    )
    with supervised(python(SLEEP)) as (supervisor, recorder):
        supervisor.start("merge")
        recorder.wait("started")
        slept[0] = 60.0
        for _ in range(20):
            supervisor.start("merge")  # its thread looks at the clock
            time.sleep(0.02)
        assert [call for call in recorder.calls if call[0] == "exited"] == []
        assert supervisor.states() == {"merge": WorkerState.STARTING}


def test_flooding_worker_is_bounded_in_log_lines_and_cpu(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "zsched.worker.merge")
    code = "import sys\nwhile True: sys.stdout.write('x' * 99 + '\\n')"
    spec = WorkerSpec(command=("python", "-u", "-c", code), env=(("PYTHONUNBUFFERED", ""),))
    with supervised(spec) as (supervisor, recorder):
        supervisor.start("merge")
        recorder.wait("started")
        begin_s, cpu_s = time.monotonic(), time.process_time()
        time.sleep(1.0)
        used = (time.process_time() - cpu_s) / (time.monotonic() - begin_s)
        lines = [record for record in caplog.records if record.getMessage().startswith("xxx")]
        assert 0 < len(lines) <= LINES_BURST + 100 + 100 * (time.monotonic() - begin_s)
        assert used < 0.3


def test_restart_delays_double_up_to_the_cap_with_jitter() -> None:
    policy, rng = RestartPolicy(first_s=0.5, most_s=10.0, jitter_ratio=0.2), random.Random(3)
    delays = [policy.delay_s(n, rng) for n in range(1, 9)]
    for n, delay_s in enumerate(delays, start=1):
        assert delay_s == pytest.approx(min(10.0, 0.5 * 2 ** (n - 1)), rel=0.2)
    assert delays == [policy.delay_s(n, again) for again in [random.Random(3)] for n in range(1, 9)]


DAEMON = """
import sys, time
from zsched.host.workers.supervisor import WorkerContext, WorkerSupervisor
from zsched.core.values.fleet import WorkerSpec
class Events:
    def on_started(self, task, pid, incarnation): print(pid, flush=True)
    def on_exited(self, *call): pass
    def on_failed(self, *call): pass
code = '''
import signal, subprocess, time
for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP): signal.signal(number, signal.SIG_IGN)
child = subprocess.Popen(["sleep", "60"])
open("PIDFILE", "w").write(f"{child.pid}\\\\n")
while True: time.sleep(60)
'''
spec = WorkerSpec(command=("python", "-c", code))
context = WorkerContext(fleet="f", node="n", incarnation=1)
supervisor = WorkerSupervisor(specs={"a": spec}, context=context, events=Events())
supervisor.start("a")
time.sleep(60)
"""


def test_workers_and_their_children_die_with_a_killed_daemon(tmp_path: Path) -> None:
    code = DAEMON.replace("PIDFILE", str(tmp_path / "pid"))
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as daemon:
        assert daemon.stdout is not None
        worker, grandchild = int(daemon.stdout.readline()), read_pid(tmp_path / "pid")
        guards = [child.pid for child in psutil.Process(daemon.pid).children() if child.pid != worker]
        daemon.kill()
        daemon.wait(timeout=60.0)
        wait_until(lambda: not any(is_running(pid) for pid in (worker, grandchild, *guards)))
    assert len(guards) == 1


def test_environment_that_cannot_be_made_is_a_failure_of_that_worker() -> None:
    def broken(task: str) -> dict[str, str]:
        raise OSError(f"no folder for {task}")

    recorder = Recorder()
    supervisor = WorkerSupervisor(
        specs={"merge": python(SLEEP)},
        context=WorkerContext(fleet="hall", node="edge1", incarnation=1),
        events=recorder,
        environment=broken,
        policy=QUICK,
    )
    supervisor.start("merge")
    assert recorder.wait("failed") == ("failed", "merge", "cannot start: no folder for merge")
    assert [call[0] for call in recorder.calls] == ["failed"]
    supervisor.close()


def test_a_worker_that_could_outlive_its_daemon_is_ended_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """It was started and not known, and another one was started every 0.1 to 5 s."""
    pids: list[int] = []

    def refused(_self: WorkerGuard, group: int) -> None:
        pids.append(group)
        raise OSError(11, "Resource temporarily unavailable")

    monkeypatch.setattr(WorkerGuard, "add", refused)
    with supervised(python(SLEEP, max_failures=2)) as (supervisor, recorder):
        supervisor.start("merge")
        assert recorder.wait("failed")[2] == "cannot start: [Errno 11] Resource temporarily unavailable"
        assert len(pids) == 2
        assert not [pid for pid in pids if is_running(pid)]
        assert not supervisor.pids()


def test_kernel_without_pidfd_is_polled(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(_pid: int) -> int:
        raise OSError(38, "Function not implemented")

    monkeypatch.setattr(os, "pidfd_open", refused)
    with supervised(python("raise SystemExit(5)")) as (supervisor, recorder):
        supervisor.start("merge")
        assert recorder.wait("failed")[2] == "exited with status 5"


# --- a changed fleet file --------------------------------------------------------------------------------------------


def test_a_changed_command_waits_for_the_order_and_then_runs() -> None:
    with supervised(python(SLEEP)) as (supervisor, recorder):
        supervisor.start("merge")
        recorder.wait("started")
        supervisor.keep({"merge": python(f"{SLEEP} # another")})
        assert recorder.wait("compared") == ("compared", "merge", True)
        assert [call for call in recorder.calls if call[0] == "exited"] == [], "nobody has asked for an end"
        supervisor.renew("merge")
        recorder.wait("started", 2)
        assert recorder.wait("compared", 2) == ("compared", "merge", False)
        supervisor.keep({"merge": python(f"{SLEEP} # another", start_deadline_s=50.0)})
        supervisor.keep({"merge": python(f"{SLEEP} # a third")})
        assert recorder.wait("compared", 3) == ("compared", "merge", True), "a deadline alone makes nothing old"


def test_a_fleet_that_grows_makes_no_worker_old() -> None:
    """zenoh's threads follow the number of nodes and tasks: who runs keeps those of the start."""
    made = {"ZENOH_RUNTIME": "few", "ZSCHED_OUTPUT_KEYS": "{}"}
    with supervised(python(SLEEP), made=made) as (supervisor, recorder):
        supervisor.start("merge")
        recorder.wait("started")
        made["ZENOH_RUNTIME"] = "many"
        supervisor.keep({"merge": python(SLEEP)})
        supervisor.keep({"merge": python(SLEEP), "other": python(SLEEP)})
        supervisor.start("other")
        recorder.wait("started", 2)
        assert [call for call in recorder.calls if call[0] == "compared"] == []
        supervisor.keep({"merge": python(SLEEP, env=(("ZENOH_RUNTIME", "an operator's own"),))})
        assert recorder.wait("compared") == ("compared", "merge", True), "what the file names is a change"
        supervisor.keep({"merge": python(SLEEP)})
        assert recorder.wait("compared", 2) == ("compared", "merge", False)
        made["ZSCHED_OUTPUT_KEYS"] = "{1}"
        supervisor.keep({"merge": python(SLEEP)})
        assert recorder.wait("compared", 3) == ("compared", "merge", True)


def test_workers_come_and_go_with_the_file() -> None:
    with supervised(python(SLEEP)) as (supervisor, recorder):
        supervisor.start("merge")
        recorder.wait("started")
        supervisor.keep({"other": python(SLEEP)})
        supervisor.start("other")
        assert recorder.wait("started", 2)[1] == "other"
        assert "merge" in supervisor.pids(), "it works until it is told to stop"
        supervisor.stop("merge")
        wait_until(lambda: set(supervisor.states()) == {"other"})
        supervisor.start("merge")
        supervisor.stop("other")
        wait_until(lambda: not supervisor.pids())
        assert len([call for call in recorder.calls if call[0] == "started"]) == 2, "nobody runs what is not there"


def test_a_mended_command_is_tried_although_the_one_before_has_failed_for_good() -> None:
    with supervised(python("raise SystemExit(78)")) as (supervisor, recorder):
        supervisor.start("merge")
        recorder.wait("failed")
        supervisor.keep({"merge": python(SLEEP)})
        recorder.wait("started", 2)


def test_mended_variables_are_tried_although_the_worker_has_failed_for_good_with_those_before() -> None:
    """What a task says of its deadline and its outputs reaches a worker by its environment alone."""
    made = {"ZSCHED_OUTPUT_KEYS": "wrong"}
    code = f"import os, time; os.environ['ZSCHED_OUTPUT_KEYS'] != 'wrong' or os._exit(78); {SLEEP}"
    with supervised(python(code), made=made) as (supervisor, recorder):
        supervisor.start("merge")
        recorder.wait("failed")
        supervisor.keep({"merge": python(code), "other": python(code)})
        wait_until(lambda: len(supervisor.states()) == 2)
        made["ZSCHED_OUTPUT_KEYS"] = "right"
        supervisor.keep({"merge": python(code)})
        recorder.wait("started", 2, timeout_s=10.0)
        assert len([call for call in recorder.calls if call[0] == "reset"]) == 1, "the same recipe is no reason"


def test_a_failed_worker_whose_command_goes_is_not_started_without_one() -> None:
    with supervised(python("raise SystemExit(78)")) as (supervisor, recorder):
        supervisor.start("merge")
        recorder.wait("failed")
        supervisor.keep({"merge": WorkerSpec()})
        recorder.wait("reset")
        wait_until(lambda: supervisor.states() == {"merge": WorkerState.STOPPED})
        assert len([call for call in recorder.calls if call[0] == "started"]) == 1


def test_a_worker_that_is_wanted_before_it_is_known_starts_with_the_file() -> None:
    """The file is followed later than it is gone by where a session could not be written at once."""
    with supervised(python(SLEEP)) as (supervisor, recorder):
        for task in ("early", "stopped"):
            supervisor.start(task)
        supervisor.stop("stopped")
        supervisor.keep({task: python(SLEEP) for task in ("early", "merge", "stopped")})
        assert recorder.wait("started")[1] == "early"
        wait_until(lambda: len(supervisor.states()) == 3)
        supervisor.stop("early")
        recorder.wait("exited")
        supervisor.keep({task: python(SLEEP) for task in ("early", "merge", "stopped")})
        supervisor.start("stopped")
        assert recorder.wait("started", 2)[1] == "stopped", "once told, the wish is not kept"
