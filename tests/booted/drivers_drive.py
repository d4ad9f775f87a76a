"""Runs inside the booted machine: a fleet of three daemons whose workers are units; moves and fails them over.

Only the standard library: this file is copied into a fresh Debian. The verdict is the test's; here is only evidence.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

NODES = ("robot1", "edge1", "edge2")
RUN = Path("/run/fleet")
RESULT = Path("/result/report.json")
ZSCHED = "/opt/zsched/bin/zsched"


def run(*command: str) -> str:
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    return done.stdout + done.stderr


def unit(edge: str) -> str:
    return f"echoer@{edge}-echo.service"


def shown(name: str) -> dict[str, str]:
    lines = run("systemctl", "show", name, "-p", "ActiveState,Result,MainPID").splitlines()
    return dict(line.partition("=")[::2] for line in lines)


def status() -> dict[str, Any]:
    done = subprocess.run(
        [ZSCHED, "status", "--json", "--node", "robot1", "--runtime-dir", str(RUN)],
        capture_output=True,
        text=True,
        timeout=30,
        check=False,
    )
    found: dict[str, Any] = json.loads(done.stdout) if done.stdout.startswith("{") else {"nodes": [], "tasks": []}
    return found


def owner(seen: dict[str, Any]) -> str:
    return next((task["owner"] or "" for task in seen["tasks"]), "")


def workers(seen: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {node["name"]: load for node in seen["nodes"] for load in node["workers"]}


def wait_for(condition: Callable[[dict[str, Any]], bool], timeout_s: float = 40.0) -> dict[str, Any]:
    """Owner, workers and units as soon as ``condition`` holds, or as they are then."""
    end_s = time.monotonic() + timeout_s
    while True:
        seen = status()
        holds = condition(seen)
        if holds or time.monotonic() >= end_s:
            units = {edge: shown(unit(edge)) for edge in ("edge1", "edge2")}
            return {"holds": holds, "owner": owner(seen), "workers": workers(seen), "units": units}
        time.sleep(0.05)


def is_well(seen: dict[str, Any]) -> bool:
    states = [load["state"] for load in workers(seen).values()]
    return bool(owner(seen)) and states == ["ready", "ready"]


def start() -> None:
    for node in NODES:
        places = ("--config", "/etc/zsched/fleet.yaml", "--node", node, "--state-dir", f"/var/lib/fleet/{node}")
        run(ZSCHED, "init", *places)
        run("systemd-run", f"--unit={node}", "-p", "KillMode=process", ZSCHED, "up", *places, "--runtime-dir", str(RUN))


def observe() -> dict[str, object]:
    RUN.mkdir()
    report: dict[str, object] = {}
    start()
    began = report["began"] = wait_for(is_well)
    first = began["owner"]
    other = "edge2" if first == "edge1" else "edge1"
    report["environment"] = (RUN / f"{first}-echo.env").read_text()
    report["mode"] = oct((RUN / f"{first}-echo.env").stat().st_mode & 0o777)
    measured = lambda seen: (workers(seen)[first].get("cpu_cores")) is not None  # noqa: E731 - one line says it
    report["measured"] = wait_for(measured)
    report["noted"] = {edge: (RUN / f"{edge}-echo.pid").read_text().split()[0] for edge in (first, other)}
    report["move"] = run(ZSCHED, "move", "echo", other, "--yes", "--node", "robot1", "--runtime-dir", str(RUN))
    report["moved"] = wait_for(lambda seen: owner(seen) == other)
    report["logs"] = run(ZSCHED, "logs", "echo", "--node", other, "--runtime-dir", str(RUN))
    run("systemctl", "kill", "--signal=SIGKILL", unit(other))
    report["killed"] = wait_for(lambda seen: "killed by signal 9" in workers(seen)[other].get("reason", ""))
    report["again"] = wait_for(is_well)
    run("systemctl", "stop", unit(other))
    stopped = wait_for(lambda seen: workers(seen)[other]["state"] == "failed" and owner(seen) == first)
    report["stopped"], report["why"] = stopped, stopped["workers"][other]["reason"]
    report["restart"] = run(ZSCHED, "restart", "echo", other, "--yes", "--node", "robot1", "--runtime-dir", str(RUN))
    report["retried"] = wait_for(is_well)
    os.kill(int(shown(first)["MainPID"]), signal.SIGKILL)
    report["daemon_killed"] = wait_for(lambda seen: owner(seen) == other and ended(first))
    run("systemctl", "stop", other)
    report["daemon_stopped"] = wait_for(lambda _: ended(other))
    report["left"] = sorted(path.name for path in RUN.glob(f"{other}-*"))
    return report


def ended(edge: str) -> bool:
    return shown(unit(edge))["ActiveState"] in {"inactive", "failed"}


def main() -> int:
    report: dict[str, object] = {}
    try:
        report = observe()
    except Exception as error:  # noqa: BLE001 - whatever happens, the report is written and the machine goes off
        report["error"] = repr(error)
    report["journal"] = run("journalctl", "--no-pager", "-o", "short-precise", "-n", "300", *(f"-u{n}" for n in NODES))
    RESULT.write_text(json.dumps(report, indent=1))
    run("systemctl", "poweroff", "--force")
    return 0


if __name__ == "__main__":
    sys.exit(main())
