"""Runs inside the booted machine: installs, upgrades, downgrades, removes and purges zsched; writes what it saw.

By the package, or, where /opt/way says so, by pip and `zsched install` (for package/prove.py). Only the standard
library: this file is copied into a fresh Debian. The verdict is the test's; here is only evidence.
"""

from __future__ import annotations

import contextlib
import json
import os
import pwd
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

RESULT = Path("/result/report.json")
DEBS = Path("/debs")
BY_PIP = Path("/opt/way").exists()
HOME = Path("/opt/zsched")
ZSCHED = "/usr/local/bin/zsched" if BY_PIP else "/usr/bin/zsched"
SHARE = "/usr/local/share" if BY_PIP else "/usr/share"
FLEET = "/etc/zsched/fleet.yaml"
EDGE = Path("/srv/edge1")
NOT_OURS = frozenset(
    f"/{name}"
    for name in ("proc", "sys", "dev", "run", "tmp", "result", "debs", "srv", "var/log", "var/lib/dpkg", "var/cache")
)
"""Not looked at: what the kernel, dpkg, the journal and this test write. (/run/zsched is looked at on its own.)"""
Report = dict[str, Any]
LAST: dict[str, Any] = {}
"""What a daemon said last, for the report of a failure."""


def run(*command: str, timeout_s: float = 90.0, **options: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False, **options)


def said(*command: str, **options: Any) -> dict[str, Any]:
    began = time.monotonic()
    done = run(*command, **options)
    return {
        "code": done.returncode,
        "said": done.stdout + done.stderr,
        "seconds": round(time.monotonic() - began, 2),
    }


def dpkg(*arguments: str) -> dict[str, Any]:
    """By dpkg without its waits for the disk: this machine has no power loss to survive."""
    return said("dpkg", "--force-unsafe-io", *arguments, timeout_s=240.0)


def put(package: str) -> dict[str, Any]:
    """Install ``package`` ("old" or "new"), over another one or afresh."""
    if not BY_PIP:
        return dpkg("-i", str(DEBS / f"{package}.deb"))
    (wheel,) = (DEBS / package).glob("*.whl")
    steps = [f"{HOME}/bin/pip install --quiet --no-index --find-links {DEBS} {wheel}", f"{HOME}/bin/zsched install"]
    steps = [*steps, "systemctl restart zsched"] if HOME.exists() else [f"python3 -m venv {HOME}", *steps]
    return said("sh", "-ec", "; ".join(steps), timeout_s=240.0)


def take_away() -> dict[str, Any]:
    return said(f"{HOME}/bin/zsched", "uninstall") if BY_PIP else dpkg("-r", "zsched")


def purge() -> dict[str, Any]:
    """With pip as docs/guide/install.md says."""
    by_hand = (
        f"rm -rf /etc/zsched /var/lib/zsched /var/lib/zsched-workers {HOME}; userdel zsched; userdel zsched-worker"
    )
    return said("sh", "-ec", by_hand) if BY_PIP else dpkg("-P", "zsched")


def wait_for(condition: Callable[[], bool], timeout_s: float, what: str) -> None:
    end_s = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > end_s:
            raise TimeoutError(what)
        time.sleep(0.1)


def listing() -> list[str]:
    """Every file, user and group of the machine."""
    found = [f"user {line}" for line in Path("/etc/passwd").read_text().splitlines()]
    found += [f"group {line}" for line in Path("/etc/group").read_text().splitlines()]
    for folder, folders, files in os.walk("/"):
        folders[:] = [name for name in folders if str(Path(folder, name)) not in NOT_OURS]
        found += [str(Path(folder, name)) for name in (*files, *folders)]
    return sorted([*found, *(str(path) for path in Path("/run").glob("zsched*"))])


def ask(path: Path, request: Report) -> Report:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
        connection.settimeout(5.0)
        connection.connect(str(path))
        connection.sendall(json.dumps(request).encode() + b"\n")
        with connection.makefile("rb") as lines:
            answer: Report = json.loads(lines.readline())
    return answer


def status_of(path: Path) -> Report:
    try:
        return ask(path, {"verb": "status"})
    except (OSError, ValueError):
        return {}


def is_settled(path: Path, owner: str | None = None) -> bool:
    status = status_of(path)
    tasks, nodes = status.get("tasks", []), status.get("nodes", [])
    LAST.update(tasks=tasks, nodes=nodes, problems=status.get("problems"))
    return bool(
        tasks
        and tasks[0]["phase"] in {"settled", "idle"}
        and tasks[0]["owner"] is not None
        and owner in {None, tasks[0]["owner"]}
        and all(node["state"] == "alive" for node in nodes)
    )


ROBOT_SOCKET = Path("/run/zsched/robot1.sock")
EDGE_SOCKET = EDGE / "run/edge1.sock"


def begin_fleet(report: Report) -> None:
    """The service as robot1, and beside it a daemon as edge1."""
    Path(FLEET).parent.mkdir(exist_ok=True)
    Path(FLEET).write_text(Path("/opt/fleet.yaml").read_text())
    report["init"] = said(ZSCHED, "init", "--config", FLEET, "--node", "robot1")
    edge = ["--config", FLEET, "--node", "edge1", "--state-dir", str(EDGE / "state")]
    report["init_edge"] = said(ZSCHED, "init", *edge)
    report["start"] = said("systemctl", "enable", "--now", "zsched.service", "zsched-renew.timer")
    command = ["systemd-run", "--unit=edge1", "--service-type=exec", "-p", "KillMode=mixed", ZSCHED, "up", *edge]
    report["start_edge"] = said(*command, "--runtime-dir", str(EDGE / "run"))
    wait_for(lambda: is_settled(ROBOT_SOCKET), 60.0, "the fleet settles")


def relay() -> int:
    return int(run("systemctl", "show", "zsched-relay.service", "-p", "MainPID", "--value").stdout)


def daemon() -> str:
    return run("systemctl", "show", "zsched.service", "-p", "MainPID", "--value").stdout.strip()


def as_user(name: str, *command: str) -> dict[str, Any]:
    return said("setpriv", f"--reuid={name}", f"--regid={name}", "--init-groups", *command)


def users_of(word: str) -> list[str]:
    """The users of all processes whose command line has a word."""
    found = []
    for folder in Path("/proc").iterdir():
        with contextlib.suppress(OSError):
            if folder.name.isdecimal() and word.encode() in (folder / "cmdline").read_bytes():
                found.append(pwd.getpwuid(folder.stat().st_uid).pw_name)
    return sorted(found)


def members(report: Report) -> None:
    """Two people: one in the group, one not."""
    for name in ("ada", "eve"):
        run("useradd", "--create-home", name)
    run("usermod", "-aG", "zsched", "ada")
    report["member"] = as_user("ada", ZSCHED, "status", "--json")
    report["stranger"] = as_user("eve", ZSCHED, "status")
    report["socket"] = [pwd.getpwuid(ROBOT_SOCKET.stat().st_uid).pw_name, oct(ROBOT_SOCKET.stat().st_mode & 0o777)]
    for name in ("ada", "eve"):
        run("userdel", "--remove", name)


class Stream:
    """An application that sends and counts while the package changes."""

    def __init__(self, name: str) -> None:
        self.stop, self.report = Path(f"/tmp/{name}.stop"), Path(f"/tmp/{name}.json")  # noqa: S108 - this machine's own
        endpoint = Path("/opt/endpoint").read_text()
        command = ["/opt/zsched/bin/python", "/opt/app.py", endpoint, str(self.stop), str(self.report)]
        self.process = subprocess.Popen(command)
        wait_for(lambda: self.heard() > 20, 60.0, "the stream flows")

    def heard(self) -> int:
        try:
            return int(self.report.with_suffix(".now").read_text())
        except (OSError, ValueError):
            return 0

    def end(self) -> Report:
        """Stop sending, wait for the last answer; what was lost."""
        before = self.heard()
        wait_for(lambda: self.heard() > before + 20, 60.0, "the stream flows again")
        self.stop.touch()
        self.process.wait(timeout=90.0)
        found: Report = json.loads(self.report.read_text())
        return found


def changed(package: str) -> Report:
    """Another version is installed under a stream; the robot owns the task when it begins."""
    moved = said(ZSCHED, "move", "echo", "robot1", "--yes", "--json")
    wait_for(lambda: is_settled(ROBOT_SOCKET, "robot1"), 60.0, "robot1 owns the task")
    before = {"relay": relay(), "daemon": daemon()}
    stream = Stream(package)
    done = put(package)
    wait_for(lambda: daemon() not in {"0", before["daemon"]}, 60.0, "another daemon")
    wait_for(lambda: is_settled(ROBOT_SOCKET), 60.0, "settled after the change")
    return {
        "dpkg": done,
        "moved": moved,
        "stream": stream.end(),
        "same_relay": relay() == before["relay"],
        "version": run(ZSCHED, "--version").stdout.strip(),
        "running": status_of(ROBOT_SOCKET).get("version"),
        "counts": [task.get("streams") for task in status_of(ROBOT_SOCKET).get("tasks", [])],
    }


def removed() -> Report:
    """Taken away while it owns the task: the other node has it then."""
    run(ZSCHED, "move", "echo", "robot1", "--yes")
    wait_for(lambda: is_settled(ROBOT_SOCKET, "robot1"), 60.0, "robot1 owns the task")
    done = take_away()
    told = status_of(EDGE_SOCKET)
    processes = run("ps", "-eo", "args").stdout if Path("/usr/bin/ps").exists() else ""
    journal = run("journalctl", "--no-pager", "-u", "zsched", "-o", "cat").stdout
    return {
        "dpkg": done,
        "owner": [task.get("owner") for task in told.get("tasks", [])],
        "kept": [name for name in (FLEET, "/var/lib/zsched/") if Path(name).exists()],
        "gone": [name for name in (str(HOME), ZSCHED) if not Path(name).exists()],
        "active": run("systemctl", "is-active", "zsched.service").stdout.strip(),
        "processes": processes,
        "journal": journal[-4000:],
    }


def active(*units: str) -> list[str]:
    """What systemd says of each, whether it runs."""
    return [run("systemctl", "is-active", unit).stdout.strip() for unit in units]


def comes_back() -> Report:
    """Installed again after a removal; then stopped by hand and upgraded; then purged under an installation by pip."""
    units = ("zsched.service", "zsched-renew.timer")
    again = put("new")
    found: Report = {"again": again, "back": active(*units)}
    run("systemctl", "stop", *units)
    found |= {"upgrade": put("old"), "stopped": active(*units), "taken": take_away()}
    HOME.mkdir(exist_ok=True)
    (HOME / "pyvenv.cfg").write_text("home = /usr/bin\n")
    found["spared"] = dpkg("-P", "zsched")
    found["kept"] = [name for name in (FLEET, "/var/lib/zsched/", str(HOME)) if Path(name).exists()]
    shutil.rmtree(HOME)
    found["last"] = put("new")
    run("systemctl", "stop", *units)
    take_away()
    return found


def refused() -> dict[str, Any]:
    """Where pip has installed already."""
    HOME.mkdir()
    (HOME / "pyvenv.cfg").write_text("home = /usr/bin\n")
    done = dpkg("-i", str(DEBS / "old.deb"))
    (HOME / "pyvenv.cfg").unlink()
    HOME.rmdir()
    run("dpkg", "--purge", "zsched")
    return done


def observe(report: Report) -> None:
    run("useradd", "--create-home", "first")  # leaves /etc/subuid- and the like, as `members` will
    run("userdel", "--remove", "first")
    before = listing()
    if not BY_PIP:
        report["refused"] = refused()
    report["install"] = put("old")
    report["idle"] = run("systemctl", "show", "zsched.service", "-p", "ActiveState,UnitFileState").stdout.split()
    report["cached"] = bool(list(HOME.glob("lib/**/zsched/__pycache__/daemon*.pyc")))
    bash = ["bash", "-c", f". {SHARE}/bash-completion/completions/zsched; complete -p zsched"]
    report["completion"] = run(*bash).stdout.strip()
    begin_fleet(report)
    report["first"] = status_of(ROBOT_SOCKET).get("version")
    members(report)
    report["upgrade"] = changed("new")
    report["users"] = users_of("zsched.tasks.echo")
    report["downgrade"] = changed("old")
    if BY_PIP:
        changed("new")  # whose `uninstall` knows all that was made
    report["remove"] = removed()
    if not BY_PIP:
        report["back"] = comes_back()
    run("systemctl", "stop", "edge1")
    report["purge"] = purge()
    after = listing()
    report["left"] = sorted(set(after) - set(before))
    report["lost"] = sorted(set(before) - set(after))


def main() -> int:
    report: Report = {}
    try:
        observe(report)
    except Exception as error:  # noqa: BLE001 - whatever happens, the report is written and the machine goes off
        report["error"] = repr(error)
        report["last"] = LAST
    report["journal"] = run("journalctl", "--no-pager", "-u", "zsched", "-u", "edge1", "-o", "cat", "-n", "150").stdout
    RESULT.write_text(json.dumps(report, indent=1))
    run("systemctl", "poweroff", "--force")
    return 0


if __name__ == "__main__":
    sys.exit(main())
