"""Plays the first hour in a clean Debian: own tasks in Python and by zenoh, the ROS 2 example; each owner is killed.

``python -m benchmarks.first_hour [--only ros2] [--report FILE]``; root, debootstrap and systemd-nspawn, and once the
network or a package index (`tests/support/debian.py`). The machine has Debian's minimum, python3 and python3-venv, a
clone of this checkout's last commit, and no network. The commands are those of docs/guide/first-task.md, from there.

Packages come from a folder that is filled beforehand, so downloading is not in the minutes. Typing and reading are not
either: the words of the guide are printed instead. A command is a line that is typed or pasted into a terminal, from
the example to the answers after a kill. The installation is counted apart, and keys of `zsched dev` are no commands.
There is no ROS: `rclpy_standin.py` takes rclpy's place.
"""

from __future__ import annotations

import argparse
import json
import re
import subprocess
import sys
import tempfile
import textwrap
import tomllib
from pathlib import Path
from typing import Any, Final

from benchmarks.common import machine

HERE, REPO = Path(__file__).parent, Path(__file__).parents[2]
GUIDE: Final = REPO / "docs" / "guide" / "first-task.md"
README: Final = REPO / "README.md"
PLAY_S: Final = 900.0
WORDS_A_MINUTE: Final = 200
GOAL: Final = "8 minutes, 3 files, 3 commands"
SITE: Final = "usr/lib/python3/dist-packages"

PYTHON_FLEET: Final = """\
    demand: {cpu_cores: 0.7, memory_mb: 40}
    worker: {command: [python, worker.py]}
    inputs: [{from: "{robot}/number", to: "{target}/mean/{robot}/number", class: reliable}]
    outputs: [{from: "{target}/mean/{epoch}/{robot}/mean", to: "{robot}/mean", class: reliable, handover: all}]
"""
PYTHON_WORKER: Final = '''\
"""mean: the mean of the numbers so far."""
from zsched.worker import Worker

with Worker.from_env() as worker:
    here = worker.prefix.split("/")[0]
    mean = worker.publisher("{prefix}/{epoch}/robot1/mean", reliable=True)
    numbers = []

    def on_number(sample):
        numbers.append(float(sample.payload.to_string()))
        mean.put(f"{sum(numbers) / len(numbers):.2f} (by {here})".encode())

    worker.subscribe("{prefix}/robot1/number", on_number)
    worker.ready()
    while worker.wait(1.0):
        pass
'''
ZENOH_FLEET: Final = """\
    worker: {command: [python, worker.py], ready: matching}
    inputs: [{from: "{robot}/number", to: "{target}/mean/{robot}/number", class: latest}]
    outputs: [{from: "{target}/mean/{robot}/mean", to: "{robot}/mean", class: latest}]
"""
ZENOH_WORKER: Final = '''\
"""mean: the mean of the numbers so far, by plain zenoh."""
import os, signal, threading
import zenoh

end = threading.Event()
signal.signal(signal.SIGTERM, lambda *_: end.set())
node, numbers = os.environ["ZSCHED_NODE"], []

def on_number(sample):
    numbers.append(float(sample.payload.to_string()))
    mean = f"{sum(numbers) / len(numbers):.2f} (by {node})"
    session.put(f"{node}/mean/robot1/mean", mean, timestamp=sample.timestamp)

with zenoh.open(zenoh.Config.from_file(os.environ["ZSCHED_ZENOH_CONFIG"])) as session:
    session.declare_subscriber(f"{node}/mean/robot1/number", on_number)
    end.wait()
'''
APPLICATION: Final = '''\
"""Sends numbers and prints their mean."""
import sys, time
import zenoh

config = zenoh.Config.from_json5("""
    {mode: "client", connect: {endpoints: ["tcp/127.0.0.1:7458"]},
     scouting: {multicast: {enabled: false}}, transport: {shared_memory: {enabled: false}}}
""")
with zenoh.open(config) as session:
    session.declare_subscriber("robot1/mean", lambda mean: print(mean.payload.to_string(), flush=True))
    numbers = session.declare_publisher("robot1/number")
    try:
        for number in range(1_000_000):
            numbers.put(str(number))
            time.sleep(0.1)
    except KeyboardInterrupt:
        pass
'''


def own_fleet(example: str, streams: str) -> str:
    """The example's fleet file with another task and its streams, as its author changes it."""
    text = (REPO / "zsched" / "tools" / "examples" / example / "fleet.yaml").read_text()
    head, _, _ = text.partition("    # What the task needs at least")
    return head.replace("  shout:\n", "  mean:\n") + streams


def own_files(example: str, fleet: str, worker: str) -> dict[str, str]:
    """The three files of an own task."""
    return {"fleet.yaml": own_fleet(example, fleet), "worker.py": worker, "ask.py": APPLICATION}


def blocks(page: Path) -> list[list[str]]:
    """The command lines of each block of shell on a page."""
    found = re.findall(r"^```sh\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)
    return [[line.partition("  #")[0].rstrip() for line in text.splitlines()] for text in found]


def the_play(only: str | None) -> dict[str, Any]:
    """The guide's commands, and the tasks."""
    install, begin, run = blocks(GUIDE)[:3]
    tasks = {
        "python": {"files": own_files("python", PYTHON_FLEET, PYTHON_WORKER), "answer": r"\d\.\d\d \(by \w+\)"},
        "zenoh": {"files": own_files("zenoh", ZENOH_FLEET, ZENOH_WORKER), "answer": r"\d\.\d\d \(by \w+\)"},
        "ros2": {"files": {}, "answer": r"QUESTION \d+ \(by \w+\)"},
    }
    if only:
        tasks = {only: tasks[only]}
    return {"install": install, "begin": begin[-1], "run": run[-1], "tasks": tasks}


def checked(command: list[str], timeout_s: float = 300.0) -> None:
    """Run a command of the preparation."""
    done = subprocess.run(command, capture_output=True, text=True, timeout=timeout_s, check=False)
    if done.returncode != 0:
        sys.exit(f"{' '.join(command)}: {(done.stdout + done.stderr).strip()[-1000:]}")


def fill(wheels: Path) -> None:
    """Fetch what the clean machine installs, unless it has been fetched."""
    wheels.mkdir(exist_ok=True)
    builds_with = tomllib.loads((REPO / "pyproject.toml").read_text())["build-system"]["requires"]
    for wanted in ([str(REPO), *builds_with], ["zenoh-ros2-sdk"]):
        checked([sys.executable, "-m", "pip", "download", "-q", "-d", str(wheels), "-f", str(wheels), *wanted])


def furnish(root: Path, only: str | None) -> None:
    """Give the machine its clone, the play, and what takes the place of ROS."""
    checked(["git", "clone", "-q", str(REPO), str(root / "root" / "zsched")])
    (root / "opt" / "play.json").write_text(json.dumps(the_play(only)))
    (root / "opt" / "drive.py").write_text((HERE / "drive.py").read_text())
    (root / SITE).mkdir(parents=True, exist_ok=True)
    (root / SITE / "rclpy.py").write_text((HERE / "rclpy_standin.py").read_text())
    (root / SITE / "ros.pth").write_text("/opt/ros\n")
    (root / "etc" / "hosts").write_text("127.0.0.1 localhost\n")  # as Debian's installer does; ROS nodes listen there


def play(folder: Path, wheels: Path, only: str | None) -> dict[str, Any]:
    """Boot nothing: one container whose first process plays."""
    from support.debian import debian_root  # noqa: PLC0415 - the tests' folder is added to the path by main
    from support.machine import overlaid  # noqa: PLC0415 - likewise

    result = folder / "result"
    result.mkdir()
    with overlaid(debian_root(), folder) as root:
        furnish(root, only)
        inside = ["systemd-nspawn", "-q", "-D", str(root), "--as-pid2", "--register=no", "--keep-unit"]
        inside += ["--private-network", f"--bind-ro={wheels}:/wheels", f"--bind={result}:/result"]
        inside += ["--setenv=PIP_NO_INDEX=1", "--setenv=PIP_FIND_LINKS=/wheels"]
        ros = ["sh", "-c", "python3 -m venv /tmp/ros && /tmp/ros/bin/pip install -q --target /opt/ros zenoh-ros2-sdk"]
        checked([*inside, *ros])
        checked([*inside, "python3", "/opt/drive.py", "/opt/play.json", "/result/report.json"], PLAY_S)
    report: dict[str, Any] = json.loads((result / "report.json").read_text())
    return report


def told(report: dict[str, Any]) -> list[str]:
    """The report as lines."""
    lines = []
    if "install" in report:
        install = report["install"]
        lines.append(f"install: {install['seconds'] / 60:.1f} minutes, {len(install['commands'])} commands, once")
    for name, task in report["tasks"].items():
        lines.append(
            f"{name:6}: {task['seconds'] / 60:.1f} minutes, {len(task['files'])} files written, "
            f"{len(task['commands'])} command lines; first answer after {task['answered_s']:.1f} s; "
            f"{task['killed']} killed, {task['answered_by']} answers "
            f"after {1000 * task['other_answers_after_s']:.0f} ms; "
            f"ends with {task['ended_with']}, leaves {len(task['left'])} processes and files"
        )
        lines += [f"        $ {line}" for line in task["commands"]]
    words = len(GUIDE.read_text().split())
    lines.append(
        f"to read: {words} words of the guide, {words / WORDS_A_MINUTE:.1f} minutes at {WORDS_A_MINUTE} words a minute"
    )
    lines.append(f"goal: {GOAL} each")
    if "stumbled" in report:
        lines.append(f"STUMBLED: {report['stumbled']}")
    return lines


def main() -> None:
    """Play, and print minutes, files and commands."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--report", type=Path, help="where to write all that was seen, as JSON")
    parser.add_argument("--wheels", type=Path, help="a folder for the packages, kept for the next run")
    parser.add_argument("--only", choices=["python", "zenoh", "ros2"], help="one of the three")
    parser.add_argument("--fetch", action="store_true", help="only fill that folder")
    options = parser.parse_args()
    sys.path.insert(0, str(REPO / "tests"))
    if options.fetch:
        fill(options.wheels)
        return
    print(machine(), flush=True)
    with tempfile.TemporaryDirectory(prefix="zsched-first-hour-") as name:
        wheels = options.wheels or Path(name) / "wheels"
        fill(wheels)
        report = play(Path(name), wheels, options.only)
    if options.report:
        options.report.write_text(json.dumps(report, indent=1))
    print(textwrap.dedent("\n".join(told(report))))
    sys.exit("stumbled" in report)


if __name__ == "__main__":
    main()
