"""Driver `systemd`: the worker is a unit of this machine's systemd, which the driver starts, follows and stops.

``python -m zsched.drivers.systemd --unit NAME.service [--env NAME ...]``. Of a template (``NAME@.service``) the
instance is ``<node>-<task>``, so that ``%i`` names the environment file.

Knows: systemctl(1), journalctl(1), what their answers mean. Does not know: D-Bus (docs/decisions/0057), tasks, zenoh.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Callable, Sequence
from typing import Final

from zsched.core.values.exits import EXIT_CONFIG
from zsched.drivers.engine import Ended, Look, ask, begin, said
from zsched.drivers.place import Place
from zsched.host.clock import wall_s
from zsched.host.paths import ENVIRONMENT_SUFFIX

SYSTEMCTL: Final = "systemctl"
SHOWN: Final = "LoadState,LoadError,ActiveState,Result,ExecMainStatus,ExecMainCode,MainPID,InvocationID,ControlGroup"
BY_SIGNAL: Final = ("2", "3")
"""CLD_KILLED and CLD_DUMPED of waitid(2)."""
MOST_LINE: Final = 160


def unit_name(unit: str, node: str, task: str) -> str:
    """The unit that is started here.

    >>> unit_name("shout@.service", "edge1", "shout"), unit_name("shout.service", "edge1", "shout")
    ('shout@edge1-shout.service', 'shout.service')
    """
    return unit.replace("@.service", f"@{node}-{task}.service")


def quoted(name: str, value: str) -> str:
    """A line of an environment file, as systemd.exec(5) reads it: quoted, four signs with a backslash before them."""
    for char in '\\"`$':
        value = value.replace(char, f"\\{char}")
    return f'{name}="{value}"'


def properties(text: str) -> dict[str, str]:
    """What `systemctl show` has printed."""
    return dict(line.partition("=")[::2] for line in text.splitlines() if "=" in line)


def why_it_ended(unit: str, shown: dict[str, str], last_line: str) -> Ended:
    """The reason by the unit's properties, and what the worker has said last."""
    result, status = shown.get("Result", ""), shown.get("ExecMainStatus", "0")
    tail = f": {last_line[:MOST_LINE]}" if last_line else ""
    if result == "success" and status == "0":
        return Ended(reason=f"{unit} has ended or was stopped by somebody else{tail}")
    if shown.get("ExecMainCode") in BY_SIGNAL:
        return Ended(reason=f"{unit} was killed by signal {status} ({result}){tail}")
    return Ended(reason=f"{unit} failed with status {status} ({result}){tail}", is_final=status == str(EXIT_CONFIG))


class SystemdUnit:
    """One unit (`zsched.drivers.engine.Engine`)."""

    is_child = False
    leaves_nothing = True

    def __init__(self, unit: str, place: Place) -> None:
        self.unit = unit_name(unit, place.node, place.task)
        self._place = place

    def begin(self, tell_end: Callable[[Ended], None]) -> Ended | None:
        """Look whether systemd knows the unit, and write its environment file."""
        del tell_end  # `run` shows every end
        shown = self._show()
        state = shown.get("LoadState", "")
        if not state:
            return Ended(reason=f"systemd does not answer: {shown.get('said', '')}")
        if state != "loaded":
            why = {"not-found": "there is no such unit on this machine", "masked": "it is masked"}.get(state, state)
            return Ended(reason=f"{self.unit} cannot be started: {why} (systemctl status {self.unit})", is_final=True)
        try:
            self._place.write_environment([quoted(name, value) for name, value in self._place.variables])
        except OSError as error:
            return Ended(reason=f"cannot write {self._place.environment_file}: {error.strerror}")
        ask(SYSTEMCTL, "reset-failed", self.unit)  # how often it may be started is zsched's to say
        return None

    def run(self) -> Sequence[str]:
        """Start it, or start it again where it runs already: it must read this life's environment."""
        return (SYSTEMCTL, "--no-ask-password", "restart", "--wait", self.unit)

    def log(self) -> Sequence[str]:
        """What the unit's processes print from now on; the follower itself may take a second to start."""
        since = f"--since=@{wall_s():.6f}"
        match = f"_SYSTEMD_UNIT={self.unit}"
        return ("journalctl", "--quiet", "--no-pager", "-o", "cat", "-f", "-n", "all", since, match)

    def pid(self) -> int | None:
        """The unit's main process."""
        text = self._show().get("MainPID", "0")
        return int(text) if text.isdigit() and text != "0" else None

    def stop(self, *, is_hard: bool) -> None:
        """As `systemctl stop`; hard: SIGKILL to all of its processes."""
        if is_hard:
            ask(SYSTEMCTL, "kill", "--signal=SIGKILL", self.unit)
        ask(SYSTEMCTL, "--no-ask-password", "stop", "--no-block", self.unit)

    def why(self, status: int) -> Ended:
        """By the unit's state; where it was never started, by what `systemctl` has said."""
        shown = self._show()
        if shown.get("InvocationID", "") == "" and status != 0:
            return Ended(reason=f"{self.unit} was not started: systemctl ended with status {status}")
        return why_it_ended(self.unit, shown, self._last_line(shown.get("InvocationID", "")))

    def last_resort(self) -> str:
        """End the unit, whatever has become of this driver."""
        unit = shlex.quote(self.unit)
        return f"{SYSTEMCTL} stop --no-block {unit}; {SYSTEMCTL} kill --signal=SIGKILL {unit}"

    def _show(self) -> dict[str, str]:
        done = ask(SYSTEMCTL, "show", "-p", SHOWN, self.unit)
        return properties(done.stdout) if done.returncode == 0 else {"said": said(done)}

    def _last_line(self, invocation: str) -> str:
        if not invocation:
            return ""
        match = f"_SYSTEMD_INVOCATION_ID={invocation}"
        done = ask("journalctl", "--quiet", "--no-pager", "-o", "cat", "-n", "1", match)
        return done.stdout.strip() if done.returncode == 0 else ""


def look(arguments: Sequence[str], node: str, task: str) -> Look:
    """Whether this machine's systemd knows the unit that the driver would start with these ``arguments``."""
    unit = unit_name(_parser().parse_args(arguments).unit, node, task)
    done = ask(SYSTEMCTL, "show", "-p", "LoadState,UnitFileState,EnvironmentFiles,Restart", unit)
    if done.returncode != 0:
        return Look(told=f"systemd does not answer: {said(done)}", fix="driver: process, on a machine without systemd")
    return judged(unit, properties(done.stdout), f"{node}-{task}{ENVIRONMENT_SUFFIX}")


def judged(unit: str, shown: dict[str, str], file: str) -> Look:
    """What is to be said of a unit with these properties, whose environment file is called ``file``."""
    state = shown.get("LoadState", "")
    if state != "loaded":
        return Look(told=f"{unit} is {state}", fix=f"systemctl status {unit} says why; then: systemctl daemon-reload")
    if file not in shown.get("EnvironmentFiles", "") and "*" not in shown.get("EnvironmentFiles", ""):
        fix = f"EnvironmentFile=/run/zsched/{file} in its [Service] (of a template: %i{ENVIRONMENT_SUFFIX})"
        return Look(told=f"{unit} does not read the worker's variables", fix=fix, is_fatal=False)
    if shown.get("UnitFileState") == "enabled":
        fix = f"systemctl disable {unit}"
        return Look(told=f"{unit} is enabled: it also starts at boot, without zsched", fix=fix, is_fatal=False)
    if (restart := shown.get("Restart", "no")) != "no":
        told = f"{unit} has Restart={restart}: systemd starts the worker again beside zsched, which counts failures"
        return Look(told=told, fix="Restart=no in its [Service], then: systemctl daemon-reload", is_fatal=False)
    return Look(told=f"{unit} is there")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m zsched.drivers.systemd", description="a worker that is a unit")
    parser.add_argument("--unit", required=True)
    parser.add_argument("--env", action="append", default=[], metavar="NAME")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """The driver's command line; the exit status."""
    given = _parser().parse_args(arguments)
    return begin(lambda place: SystemdUnit(given.unit, place), given.env)


if __name__ == "__main__":
    sys.exit(main())
