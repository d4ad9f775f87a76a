"""Runs inside the booted machine: drives a service whose workers have users of their own, and writes what it saw.

Only the standard library, and what `deb_drive.py` beside it has. The verdict is the test's; here is only evidence.
"""

from __future__ import annotations

import json
import os
import pwd
import signal
import socket
import sys
import time
from collections.abc import Callable
from pathlib import Path

from booted.deb_drive import (
    EDGE,
    EDGE_SOCKET,
    FLEET,
    RESULT,
    ROBOT_SOCKET,
    ZSCHED,
    Report,
    Stream,
    daemon,
    is_settled,
    run,
    said,
    status_of,
    wait_for,
)

USER = "zsched-worker"


def processes(word: str = "") -> dict[int, str]:
    """{pid: user} of the processes of workers' users, whose command line has a word."""
    found = {}
    for folder in Path("/proc").iterdir():
        try:
            user = pwd.getpwuid(folder.stat().st_uid).pw_name if folder.name.isdecimal() else ""
            line = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode() if user in {USER, "ros"} else ""
        except (OSError, KeyError):
            continue
        if line and word in line:
            found[int(folder.name)] = user
    return found


def workers() -> dict[str, list[str]]:
    """{word: users of processes that have it} of this machine's workers."""
    return {word: sorted(processes(word).values()) for word in ("probe.py", "stubborn", "sleep 1002")}


def robot_loads() -> dict[str, Report]:
    nodes = {node["name"]: node for node in status_of(ROBOT_SOCKET).get("nodes", [])}
    return {load["task"]: load for load in nodes.get("robot1", {}).get("workers", [])}


def holds(condition: Callable[[], bool], timeout_s: float = 30.0) -> bool:
    try:
        wait_for(condition, timeout_s, "")
    except TimeoutError:
        return False
    return True


def begin(report: Report) -> None:
    report["users"] = said("systemd-sysusers", "/usr/lib/sysusers.d/zsched.conf")
    run("useradd", "--system", "ros")
    edge = ["--config", FLEET, "--node", "edge1", "--state-dir", str(EDGE / "state")]
    report["init"] = [said(ZSCHED, "init", "--config", FLEET, "--node", "robot1"), said(ZSCHED, "init", *edge)]
    run("systemctl", "enable", "--now", "zsched-worker@ros.socket")
    report["failed_starts"] = starts_of_nobody(2.0)
    report["start"] = said("systemctl", "start", "zsched.service")
    command = ["systemd-run", "--unit=edge1", "--service-type=exec", "-p", "KillMode=mixed", ZSCHED, "up", *edge]
    report["start_edge"] = said(*command, "--runtime-dir", str(EDGE / "run"))
    wait_for(lambda: is_settled(ROBOT_SOCKET), 60.0, "somebody owns the task")
    run(ZSCHED, "move", "echo", "robot1", "--yes")
    wait_for(lambda: is_settled(ROBOT_SOCKET, "robot1"), 60.0, "robot1 owns the task")


def starts_of_nobody(seconds: float) -> int:
    """How often systemd tries in this time to start who has been asked for, as a user that is not there."""
    run("systemctl", "start", "zsched-worker@nobody-there.socket")
    with socket.socket(socket.AF_UNIX) as link:
        link.connect("/run/zsched-workers/nobody-there.sock")
    time.sleep(seconds)
    run("systemctl", "stop", "zsched-worker@nobody-there.socket")
    return run("journalctl", "-u", "zsched-worker@nobody-there.service").stdout.count("Failed with result")


def observe(report: Report) -> None:
    begin(report)
    stream = Stream("first")
    wait_for(lambda: robot_loads().get("echo", {}).get("memory_mb") is not None, 30.0, "the worker is measured")
    report["loads"], report["workers"] = robot_loads(), workers()
    report["logs"] = said(ZSCHED, "logs", "echo", "robot1")
    report["refused"] = holds(lambda: robot_loads().get("ghost", {}).get("state") == "failed")
    report["ghost"] = robot_loads().get("ghost")
    report["doctor"] = said(ZSCHED, "doctor", "--json")
    report["moved"] = said(ZSCHED, "move", "echo", "edge1", "--yes")
    report["ended"] = holds(lambda: not processes("probe.py"))
    stubborn = set(processes("stubborn"))
    report["restarted"] = said(ZSCHED, "restart", "slow", "robot1", "--yes")
    report["killed"] = holds(lambda: bool(processes("stubborn")) and not set(processes("stubborn")) & stubborn)
    report["back"] = said(ZSCHED, "move", "echo", "robot1", "--yes")
    wait_for(lambda: is_settled(ROBOT_SOCKET, "robot1"), 60.0, "robot1 owns the task again")
    report["stream"] = stream.end()
    crash(report)
    first = set(processes("probe.py"))
    for pid in processes("workers.starter"):
        os.kill(pid, signal.SIGKILL)
    report["starters_killed"] = holds(lambda: bool(processes("probe.py")) and not set(processes("probe.py")) & first)
    report["stop"] = said("systemctl", "stop", "zsched.service")
    report["handed_over"] = holds(lambda: status_of(EDGE_SOCKET)["tasks"][0].get("owner") == "edge1")
    drop_in = Path("/etc/systemd/system/zsched.service.d/own.conf")
    drop_in.write_text("[Service]\nEnvironment=ZSCHED_STARTERS=\n")
    run("systemctl", "daemon-reload")
    run("systemctl", "start", "zsched.service")
    wait_for(lambda: is_settled(ROBOT_SOCKET), 60.0, "somebody owns the task")
    run(ZSCHED, "move", "echo", "robot1", "--yes")
    report["as_daemon"] = holds(lambda: is_settled(ROBOT_SOCKET, "robot1")) and workers()
    for pid in processes("workers.starter"):
        os.kill(pid, signal.SIGSTOP)
    run("systemctl", "stop", "zsched.service")
    report["left"] = holds(lambda: not processes(), 5.0) or processes()
    run("systemctl", "stop", "zsched-worker@*")
    report["run"] = sorted(str(path) for path in Path("/run").glob("zsched*"))


def observe_secured(report: Report) -> None:
    """The service as edge1, whose worker has not its key, and beside it robot1, whose application asks."""
    run("systemd-sysusers", "/usr/lib/sysusers.d/zsched.conf")
    robot = ["--config", "/srv/robot1/fleet.yaml", "--node", "robot1", "--state-dir", "/srv/robot1/state"]
    report["init"] = [said(ZSCHED, "init", "--config", FLEET, "--node", "edge1"), said(ZSCHED, "init", *robot)]
    report["start"] = said("systemctl", "start", "zsched.service")
    command = ["systemd-run", "--unit=robot1", "--service-type=exec", "-p", "KillMode=mixed", ZSCHED, "up", *robot]
    report["start_robot"] = said(*command, "--runtime-dir", "/srv/robot1/run")
    robot_socket = Path("/srv/robot1/run/robot1.sock")
    wait_for(lambda: is_settled(robot_socket, "edge1"), 60.0, "edge1 owns the task")
    stream = Stream("secured")
    report["workers"], report["logs"] = workers(), said(ZSCHED, "logs", "echo", "edge1")
    report["restarted"] = said("systemctl", "restart", "zsched.service")  # the relay stays
    stream_goes_on = stream.heard()
    report["goes_on"] = holds(lambda: stream.heard() > stream_goes_on + 50, 60.0)
    report["stream"] = stream.end()
    report["problems"] = status_of(robot_socket).get("problems")
    report["stop"] = said("systemctl", "stop", "zsched.service")
    report["left"] = holds(lambda: not processes(), 5.0)


def crash(report: Report) -> None:
    before, old = processes(), daemon()
    os.kill(int(old), signal.SIGKILL)
    report["crashed"] = holds(lambda: not set(processes()) & set(before), 2.0) or sorted(set(processes()) & set(before))
    wait_for(lambda: daemon() not in {"0", old}, 30.0, "another daemon")
    wait_for(lambda: is_settled(ROBOT_SOCKET), 60.0, "somebody owns the task")
    run(ZSCHED, "move", "echo", "robot1", "--yes")
    report["again"] = holds(lambda: bool(processes("sleep 1002")))


def main() -> int:
    report: Report = {}
    try:
        (observe_secured if Path("/opt/secured").exists() else observe)(report)
    except Exception as error:  # noqa: BLE001 - whatever happens, the report is written and the machine goes off
        report["error"] = repr(error)
    journal = (
        "journalctl",
        "--no-pager",
        "-o",
        "short-monotonic",
        "-n",
        "200",
        "-u",
        "zsched*",
        "-u",
        "edge1",
        "-u",
        "robot1",
    )
    report["journal"] = run(*journal).stdout
    RESULT.write_text(json.dumps(report, indent=1))
    run("systemctl", "poweroff", "--force")
    return 0


if __name__ == "__main__":
    sys.exit(main())
