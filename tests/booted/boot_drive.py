"""Runs inside the booted machine as a one-shot unit: drives zsched.service through its life and writes what it saw.

Only the standard library: this file is copied into a fresh Debian. The verdict is the test's; here is only evidence.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable
from pathlib import Path

UNIT = "zsched.service"
WEB = "zsched-web.service"
RESULT = Path("/result/report.json")
EXPECTED = Path("/opt/expected").read_text() if Path("/opt/expected").exists() else ""
"""What the status line says once all is well."""


def run(*command: str) -> str:
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    return done.stdout + done.stderr


def show() -> dict[str, str]:
    names = "ActiveState,SubState,StatusText,MainPID,NRestarts,Result,ExecMainStatus,ControlGroup"
    lines = run("systemctl", "show", UNIT, "-p", names).splitlines()
    return dict(line.partition("=")[::2] for line in lines)


def wait_for(condition: Callable[[dict[str, str]], bool], timeout_s: float) -> dict[str, str]:
    end_s = time.monotonic() + timeout_s
    while True:
        state = show()
        if condition(state) or time.monotonic() >= end_s:
            return state
        time.sleep(0.1)


def processes(user_of: int | None = None) -> list[str]:
    """Command lines of all processes but kernel threads, or of one user only."""
    found = []
    for folder in Path("/proc").iterdir():
        try:
            if folder.name.isdecimal() and (user_of is None or folder.stat().st_uid == user_of):
                line = (folder / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace").strip()
                found += [f"{folder.name} {line[:200]}"] if line else []
        except OSError:
            continue
    return sorted(found)


def timed(*command: str) -> tuple[float, str]:
    begin_s = time.monotonic()
    output = run(*command)
    return time.monotonic() - begin_s, output


def is_back(state: dict[str, str], old_pid: int) -> bool:
    """Whether another process than ``old_pid`` has taken over and says what is expected."""
    is_new = state["MainPID"] not in {"0", str(old_pid)} and state["ActiveState"] == "active"
    return is_new and EXPECTED in state["StatusText"]


def relays() -> list[str]:
    return [line.split()[0] for line in processes() if "zsched.relay" in line]


def groups_of(pid: int) -> list[Path]:
    """Where to write a process id for the process to join ``pid``'s control group, in each hierarchy that has it."""
    path = next(line for line in Path(f"/proc/{pid}/cgroup").read_text().splitlines() if line.startswith("0::"))[3:]
    found = [Path(f"/sys/fs/cgroup{kind}{path}", "cgroup.procs") for kind in ("", "/unified", "/systemd")]
    return [file for file in found if file.exists()]


def crash_and_restart(report: dict[str, object], pid: int) -> int:
    """SIGKILL the daemon, then `systemctl restart`: each time another daemon, and the relay stays; the newest's pid."""
    user = os.stat(f"/proc/{pid}").st_uid  # noqa: PTH116 - a /proc path, nothing to gain
    stray = subprocess.Popen(["sleep", "1001"], start_new_session=True, user=user)
    for group in groups_of(pid):
        group.write_text(str(stray.pid))
    os.kill(pid, 9)
    back = wait_for(lambda state: is_back(state, pid), 20.0)
    stray.poll()
    report["crashed"] = back | {"relay": relays(), "escaped": [one for one in processes() if "sleep 1001" in one]}
    run("systemctl", "restart", UNIT)
    again = wait_for(lambda state: is_back(state, int(back["MainPID"])), 20.0)
    report["restarted"] = again | {"relay": relays()}
    return int(again["MainPID"])


def look_at_the_page() -> dict[str, object]:
    """Start the page's unit, ask it for the status, stop it."""
    run("systemctl", "start", WEB)
    report: dict[str, object] = {}
    end_s = time.monotonic() + 20.0
    address = f"http://127.0.0.1:{Path('/opt/web_port').read_text()}/api/status"
    while not report.get("status") and time.monotonic() < end_s:
        try:
            with urllib.request.urlopen(address, timeout=5.0) as answer:
                report = json.loads(answer.read())
        except OSError as error:
            report = {"why": str(error)}
        time.sleep(0.1)
    pid = int(run("systemctl", "show", WEB, "-p", "MainPID").strip().partition("=")[2])
    report["user"] = Path(f"/proc/{pid}").stat().st_uid if pid else None
    run("systemctl", "stop", WEB)
    report["said"] = run("journalctl", "--no-pager", "-u", WEB, "-o", "cat", "-n", "30")
    return report


def observe() -> dict[str, object]:
    report: dict[str, object] = {}
    start_s, start_said = timed("systemctl", "start", UNIT)
    report["start"] = show() | {"seconds": round(start_s, 3), "said": start_said}
    running = report["running"] = wait_for(lambda state: EXPECTED in state["StatusText"], 30.0)
    report["status"] = run("systemctl", "status", "--no-pager", "--lines=0", UNIT)
    pid = int(running["MainPID"])
    if pid == 0:
        return report
    user = os.stat(f"/proc/{pid}").st_uid  # noqa: PTH116 - a /proc path, nothing to gain
    before = set(processes(user))
    report["processes"] = sorted(before)
    report["runtime"] = {
        path.name: path.read_text(errors="replace")[:2000] for path in Path("/run/zsched").glob("*.txt")
    }
    report["relay"] = relays()
    report["web"] = look_at_the_page() if report["relay"] else None
    if report["relay"]:
        pid = crash_and_restart(report, pid)
    os.kill(pid, 19)  # SIGSTOP: the loop is wedged, the process lives
    report["watchdog"] = wait_for(lambda state: is_back(state, pid), 40.0) | {"relay": relays()}
    report["survivors"] = sorted(set(processes(user)) & before)
    stop_s, stop_said = timed("systemctl", "stop", UNIT)
    report["stop"] = show() | {"seconds": round(stop_s, 3), "said": stop_said}
    report["left"] = processes(user)
    report["left_folders"] = {name: Path(name).exists() for name in ("/run/zsched", "/var/lib/zsched/")}
    return report


def depart() -> dict[str, object]:
    """The machine leaves its fleet: the daemon ends, and no restart follows."""
    run("systemctl", "start", UNIT)
    running = wait_for(lambda state: EXPECTED in state["StatusText"], 30.0)
    user = os.stat(f"/proc/{running['MainPID']}").st_uid  # noqa: PTH116 - as above
    done = subprocess.run(
        ["/opt/zsched/bin/zsched", "leave", "--yes", "--accept", "last-node"],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    wait_for(lambda state: state["ActiveState"] == "inactive", 10.0)
    time.sleep(2.5)
    kept = [str(path) for folder in ("/etc/zsched", "/var/lib/zsched") for path in sorted(Path(folder).iterdir())]
    said = done.stdout + done.stderr
    return {"said": said, "code": done.returncode, "later": show(), "left": processes(user), "kept": kept}


def misconfigure() -> dict[str, object]:
    """A wrong fleet file: exit 78 and no restart, however long we wait."""
    Path("/etc/zsched/fleet.yaml").write_text("fleet: [this is no fleet\n")
    said = run("systemctl", "start", UNIT)
    first = wait_for(lambda state: state["ActiveState"] == "failed", 15.0)
    time.sleep(2.5)
    return {"said": said, "first": first, "later": show()}


def main() -> int:
    report: dict[str, object] = {}
    try:
        report = observe()
        if report.get("relay"):
            report["departed"] = depart()
        report["misconfigured"] = misconfigure()
    except Exception as error:  # noqa: BLE001 - whatever happens, the report is written and the machine goes off
        report["error"] = repr(error)
    report["journal"] = run("journalctl", "--no-pager", "-u", UNIT, "-o", "cat", "-n", "200")
    RESULT.write_text(json.dumps(report, indent=1))
    run("systemctl", "poweroff", "--force")
    return 0


if __name__ == "__main__":
    sys.exit(main())
