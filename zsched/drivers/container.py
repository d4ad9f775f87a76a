"""Driver `container`: the worker is a container of podman or docker, which the driver runs, follows and removes.

``python -m zsched.drivers.container --image IMAGE [--engine podman|docker] [--mount HOST:INSIDE[:ro] ...]
[--option WORD ...] [--env NAME ...] [--arg WORD ...]``. Nothing is pulled: an image that is not there is refused.

Knows: the command lines of podman(1) and docker(1), which agree in all that is used here; their exit statuses. Does not
know: registries, tasks, zenoh.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shlex
import shutil
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

from zsched.core.values.exits import EXIT_CONFIG
from zsched.drivers.engine import Ended, Look, ask, begin, said
from zsched.drivers.place import Place

ENGINES: Final = ("podman", "docker")
"""In the order in which they are looked for."""
LOG_DRIVERS: Final = {"podman": "k8s-file", "docker": "json-file"}
LOG_SIZE: Final = "1m"
"""The engine's own copy of the log; the daemon has it, too."""
LABEL: Final = "zsched.worker"
NOT_RUN: Final = 125
"""Status of `podman run` and `docker run`: the engine has failed. The next two: the command inside has not begun."""
NOT_EXECUTABLE: Final = 126
NOT_FOUND: Final = 127
SIGNALLED: Final = 128
MOST_LINE: Final = 160
CLEARED_WITHIN: Final = 3
"""This many times a container of the last life is removed before the worker counts as failed."""


def container_name(place: Place, driver: int) -> str:
    """What the container is called.

    Each life has a name of its own, by the driver's process: a container of the last life may still be being removed,
    by its name.
    """
    return f"zsched-{place.fleet}-{place.node}-{place.task}-{driver}"


def files_named(session: str) -> list[str]:
    """The certificates and keys that a session file names: the worker opens them under the same paths.

    >>> files_named('{"transport": {"link": {"tls": {"listen_private_key": "/a.key", "enable_mtls": true}}}}')
    ['/a.key']
    """
    with contextlib.suppress(ValueError):
        tls: Any = json.loads(session)
        for key in ("transport", "link", "tls"):
            tls = tls.get(key) if isinstance(tls, dict) else None
        if isinstance(tls, dict):
            names = (path for key, path in tls.items() if path and key.endswith(("_certificate", "_private_key")))
            return sorted({str(path) for path in names})
    return []


def why_it_ended(image: str, status: int, *, is_oom: bool, last_line: str) -> Ended:
    """The reason by the status of `run`, and what the worker has said last."""
    tail = f": {last_line[:MOST_LINE]}" if last_line else ""
    if status == NOT_RUN:
        return Ended(reason=f"a container of {image} was not started{tail}")
    if status in (NOT_EXECUTABLE, NOT_FOUND):
        what = "cannot be executed" if status == NOT_EXECUTABLE else "is not in the image"
        return Ended(reason=f"the command of {image} {what} (status {status}){tail}", is_final=True)
    if is_oom:
        return Ended(reason=f"the container of {image} was killed: out of memory{tail}")
    if SIGNALLED < status <= SIGNALLED + signal.SIGRTMAX:
        return Ended(reason=f"the container of {image} was killed by signal {status - SIGNALLED}{tail}")
    if status == 0:
        return Ended(reason=f"the container of {image} has ended or was stopped by somebody else{tail}")
    return Ended(reason=f"the container of {image} failed with status {status}{tail}", is_final=status == EXIT_CONFIG)


class Container:
    """One container (`zsched.drivers.engine.Engine`)."""

    is_child = False
    leaves_nothing = False

    def __init__(self, given: argparse.Namespace, place: Place) -> None:
        self._given, self._place = given, place
        self._engine = engine_of(given.engine)
        self._name = container_name(place, os.getpid())
        self._pid: int | None = None

    def begin(self, tell_end: Callable[[Ended], None]) -> Ended | None:
        """Look whether the image is there, and remove what a dead driver has left."""
        del tell_end  # `run` shows every end
        look = look_for(self._given)
        if look.fix:
            return Ended(reason=f"{look.told}; {look.fix}", is_final=look.is_fatal)
        return self._clear()

    def run(self) -> Sequence[str]:
        """Run it attached: the command lasts as long as the container, and prints what it prints.

        The host's network and IPC, as a process has them: the relay is on loopback, shared memory in /dev/shm. Values
        of variables are in no command line, where everybody could read them.
        """
        place, given = self._place, self._given
        mounts = [f"{path}:{path}:ro" for path in (str(place.session), *self._files())]
        return (
            *(self._engine, "run", "--name", self._name, "--label", f"{LABEL}={self._label}", "--pull=never"),
            *("--network=host", "--ipc=host", "--sig-proxy=false"),
            *(f"--log-driver={LOG_DRIVERS[self._engine]}", f"--log-opt=max-size={LOG_SIZE}"),
            *(word for name, _ in place.variables for word in ("--env", name)),
            *(word for mount in (*mounts, *given.mount) for word in ("--volume", mount)),
            *given.option,
            given.image,
            *given.arg,
        )

    def log(self) -> Sequence[str]:
        """`run` prints it."""
        return ()

    def pid(self) -> int | None:
        """The container's first process; asked for until it is there, for each question starts a program."""
        if self._pid is None:
            text = self._inspect("{{.State.Pid}}")
            self._pid = int(text) if text.isdigit() and text != "0" else None
        return self._pid

    def stop(self, *, is_hard: bool) -> None:
        """The image's own signal (SIGTERM where it names none); hard: SIGKILL."""
        signal = "KILL" if is_hard else self._inspect("{{.Config.StopSignal}}") or "TERM"
        ask(self._engine, "kill", f"--signal={signal}", self._name)

    def why(self, status: int) -> Ended:
        """By the status, and by what the engine knows of the container."""
        is_oom = self._inspect("{{.State.OOMKilled}}") == "true"
        logs = ask(self._engine, "logs", "--tail", "1", self._name)
        lines = (logs.stdout + logs.stderr).strip().splitlines() if logs.returncode == 0 else []
        return why_it_ended(self._given.image, status, is_oom=is_oom, last_line=lines[-1] if lines else "")

    def last_resort(self) -> str:
        """Remove the container, whatever has become of this driver."""
        name = shlex.quote(self._name)
        return f"{self._engine} kill --signal=KILL {name}; {self._engine} rm --force {name}"

    @property
    def _label(self) -> str:
        return f"{self._place.fleet}/{self._place.node}/{self._place.task}"

    def _clear(self) -> Ended | None:
        why = ""
        for _ in range(CLEARED_WITHIN):
            found = ask(self._engine, "ps", "--all", "--quiet", "--filter", f"label={LABEL}={self._label}")
            if found.returncode != 0:
                return Ended(reason=f"{self._engine} does not list its containers: {said(found)}")
            left = found.stdout.split()
            if not left:
                return None
            ask(self._engine, "kill", "--signal=KILL", *left)
            why = said(ask(self._engine, "rm", "--force", *left))  # or the last life's keeper was quicker
        return Ended(reason=f"{self._engine} does not remove a container of the last run: {why}")

    def _files(self) -> list[str]:
        try:
            return files_named(self._place.session.read_text(encoding="utf-8"))
        except OSError:
            return []

    def _inspect(self, form: str) -> str:
        done = ask(self._engine, "inspect", "--type", "container", "--format", form, self._name)
        return done.stdout.strip() if done.returncode == 0 else ""


def engine_of(given: str | None) -> str:
    """The engine that the file names, or the first that this machine has; podman's name where it has none."""
    return given or next((name for name in ENGINES if shutil.which(name) is not None), ENGINES[0])


def look_for(given: argparse.Namespace) -> Look:
    """Whether this machine has the engine and the image."""
    engine = engine_of(given.engine)
    if shutil.which(engine) is None:
        wanted = engine if given.engine else " or ".join(ENGINES)
        return Look(told=f"there is no {wanted} on this machine", fix=f"install {wanted}")
    found = ask(engine, "image", "inspect", "--format", "{{.Id}}", given.image)
    if found.returncode == 0:
        missing = [path for mount in given.mount if not Path(path := mount.partition(":")[0]).exists()]
        if missing:
            return Look(told=f"there is no {missing[0]} to be mounted", fix="make it, or correct `mounts:`")
        return Look(told=f"{given.image} is there ({engine}, {found.stdout.strip().removeprefix('sha256:')[:12]})")
    if "no such image" in (found.stderr + found.stdout).lower() or "image not known" in found.stderr.lower():
        return Look(told=f"the image {given.image} is not on this machine", fix=f"{engine} pull {given.image}")
    fix = f"{engine} image inspect {given.image} must work for the daemon's user"
    return Look(told=f"{engine} does not answer: {said(found)}", fix=fix, is_fatal=False)


def look(arguments: Sequence[str], node: str, task: str) -> Look:
    """Whether the driver could start a container with these ``arguments``."""
    del node, task  # the same image everywhere
    return look_for(_parser().parse_args(arguments))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m zsched.drivers.container", description="a worker in a container")
    parser.add_argument("--image", required=True)
    parser.add_argument("--engine", choices=ENGINES)
    for name in ("mount", "option", "env", "arg"):
        parser.add_argument(f"--{name}", action="append", default=[])
    return parser


def main(arguments: list[str] | None = None) -> int:
    """The driver's command line; the exit status."""
    given = _parser().parse_args(arguments)
    return begin(lambda place: Container(given, place), given.env)


if __name__ == "__main__":
    sys.exit(main())
