"""Checks of this machine's workers: can they be started, and do they run.

Knows: commands, programs, modules that cannot be imported. Does not know: what a worker does.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import pwd
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from zsched.core.values.fleet import TaskSpec, runs_worker
from zsched.core.values.words import Trouble, told_of_worker
from zsched.drivers import container, ros2_lifecycle, systemd
from zsched.drivers.engine import Look
from zsched.host.installer import is_debian_package
from zsched.tools.doctor.model import Json, Result, Scene, failed, joined, passed, skipped, warned
from zsched.tools.doctor.service import path_of_service, starter_of_service, user_of_service

IMPORT_S: Final = 60.0
"""numpy and OpenCV from an SD card take ten seconds and more."""
PYTHON: Final = ("python", "python3")
LOOKS: Final[Mapping[str, Callable[[Sequence[str], str, str], Look]]] = {
    "zsched.drivers.systemd": systemd.look,
    "zsched.drivers.container": container.look,
    "zsched.drivers.ros2_lifecycle": ros2_lifecycle.look,
}
FINDER: Final = Path(__file__).with_name("imports.py")


def _mine(scene: Scene) -> Iterator[TaskSpec]:
    """The tasks whose worker the daemon starts here."""
    for task in scene.fleet.tasks:
        if task.worker.command and runs_worker(task, scene.node, scene.me.kind):
            yield task


def commands_are_there(scene: Scene) -> Result:
    """Whether the program of each worker is there and may be run."""
    service_path = path_of_service(scene)
    found = [_command(task, service_path) for task in _mine(scene)]
    return joined(found, skipped("no worker is started by the daemon here"))


def _command(task: TaskSpec, service_path: str | None) -> Result:
    """``service_path``: where the service looks for programs; ``None``: the daemon is started by hand."""
    program, *words = task.worker.command
    fix = f"install it, or correct `worker: {{command:}}` of {task.name} (full paths)"
    path = dict(task.worker.env).get("PATH", service_path)
    where = program if program in PYTHON else shutil.which(program, path=path)
    if where is None:
        return failed(f"{task.name}: there is no program {program} that may be run", fix=fix)
    script = _script(words) if _is_python(program) else None
    if script is not None and not Path(script).is_file():
        return failed(f"{task.name}: there is no file {script}", fix=fix)
    if script is not None and not Path(script).is_absolute():
        told = f"{task.name}: {script} is looked for in the folder in which the daemon was started"
        return warned(told, fix=f"give the full path in `worker: {{command:}}` of {task.name}")
    return passed(f"{task.name}: {sys.executable} {' '.join(words)}" if program in PYTHON else f"{task.name}: {where}")


def _is_python(program: str) -> bool:
    """Whether a program is an interpreter of Python, by its name.

    >>> [_is_python(name) for name in ("python", "/usr/bin/python3.11", "/opt/worker", "pythonize")]
    [True, True, False, False]
    """
    return Path(program).name.rstrip("0123456789.") == "python"


def users_are_there(scene: Scene) -> Result:
    """Whether each worker can be started as its user."""
    return joined([_user(scene, task) for task in _mine(scene)], skipped("no worker is started by the daemon here"))


def _user(scene: Scene, task: TaskSpec) -> Result:
    starter = starter_of_service(scene, task.worker)
    if starter is None:
        return passed(f"{task.name}: runs as the daemon's user")
    if starter.exists():
        return passed(f"{task.name}: runs as {starter.stem}")
    fix = f"sudo systemctl enable --now zsched-worker@{starter.stem}.socket"
    return failed(f"{task.name}: nobody starts workers as user {starter.stem} here", fix=fix)


def packages_are_there(scene: Scene) -> Result:
    """Whether each worker in Python finds the packages that it imports."""
    service, is_root = user_of_service(scene), os.geteuid() == 0
    users = {task.name: _ids(starter_of_service(scene, task.worker), service) for task in _mine(scene) if is_root}
    found = [result for task in _mine(scene) if (result := _packages(task, users.get(task.name))) is not None]
    return joined(found, skipped("no worker in Python is started by the daemon here"))


def _ids(starter: Path | None, service: tuple[int, int] | None) -> tuple[int, int] | None:
    """(user id, group id) of the user whom a starter starts workers as; without one those of the ``service``."""
    with contextlib.suppress(KeyError):
        user = None if starter is None else pwd.getpwnam(starter.stem)
        return service if user is None else (user.pw_uid, user.pw_gid)
    return service


def _packages(task: TaskSpec, user: tuple[int, int] | None) -> Result | None:
    """``user``: as whom an operator's program may run here, where that is not who asks."""
    program, *words = task.worker.command
    if not _is_python(program):
        return None
    python = sys.executable if program in PYTHON else program
    module, script = _module(words), _script(words)
    if module is None and (script is None or not Path(script).is_file()):
        return None if script is None else skipped(f"{task.name}: there is no file {script}")
    kind, what = ("file", str(script)) if module is None else ("module", module)
    own: dict[str, Any] = {} if user is None else {"user": user[0], "group": user[1], "extra_groups": [], "cwd": "/"}
    try:
        done = subprocess.run(
            [python, FINDER, kind, what],
            **own,
            env={**os.environ, **dict(task.worker.env)},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=IMPORT_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return warned(
            f"{task.name}: {what} is not imported after {IMPORT_S:g} s",
            fix="does something that it imports work at its import?",
        )
    except OSError as error:
        return failed(f"{task.name}: {python}: {error.strerror}", fix="correct `worker: {command:}`")
    if done.returncode == 0:
        return passed(f"{task.name}: {what} finds what it imports")
    said = f"{done.stderr}\n{done.stdout}".strip().splitlines()
    why = said[-1] if said else f"status {done.returncode}"
    is_apts = program in PYTHON and is_debian_package()
    by = "apt install python3-PACKAGE" if is_apts else f"{python} -m pip install PACKAGE"
    fix = (
        f"install what is missing where {task.name} runs: `sudo {by}`, or let `command` begin with a Python that has it"
    )
    return failed(f"{task.name}: {what} lacks an import: {why}", fix=fix)


def _module(words: list[str]) -> str | None:
    """What follows ``-m``, before any script."""
    for word, after in itertools.pairwise(words):
        if word == "-m":
            return after
        if not word.startswith("-"):
            return None
    return None


def _script(words: list[str]) -> str | None:
    """The script, where one is named: the first word that is no option, nor the value of one."""
    is_value = False
    for word in words:
        if word in ("-m", "-c"):
            return None
        if is_value or word.startswith("-"):
            is_value = word in ("-W", "-X")
            continue
        return word if word.endswith(".py") or "/" in word else None
    return None


def engines_are_there(scene: Scene) -> Result:
    """Whether what each worker's driver keeps (a unit, an image) is on this machine."""
    found = [result for task in _mine(scene) if (result := _engine(scene.node, task)) is not None]
    return joined(found, skipped("every worker here is a process of the daemon's, or somebody else's"))


def _engine(node: str, task: TaskSpec) -> Result | None:
    look = LOOKS.get(_module(list(task.worker.command[1:])) or "")
    if look is None:
        return None
    seen = look(task.worker.command[3:], node, task.name)
    told = f"{task.name}: {seen.told}"
    if not seen.fix:
        return passed(told)
    return failed(told, fix=seen.fix) if seen.is_fatal else warned(told, fix=seen.fix)


def run_well(scene: Scene) -> Result:
    """Whether each worker of this machine is ready, as the daemon says."""
    mine = next((node for node in scene.status["nodes"] if node["name"] == scene.node), None)
    found = [_worker(scene.node, load) for load in (mine or {}).get("workers", ())]
    return joined(found, skipped("this machine has no workers"))


def _worker(node: str, load: Json) -> Result:
    task, state, trouble, reason = (str(load.get(key) or "") for key in ("task", "state", "trouble", "reason"))
    told = f"the worker of {task} {told_of_worker(state, trouble, reason)}"
    if state == "failed":
        return failed(told, fix=f"mend its cause, then: zsched restart {task} {node}")
    if trouble == Trouble.LOST:
        anew = f"zsched logs {task} {node}; zsched restart {task} {node} starts it anew"
        return failed(told, fix=anew if state == "starting" else "somebody else starts it: do so as the line says")
    if trouble == Trouble.AGAIN or (state == "ready" and reason):
        return warned(told, fix=f"zsched logs {task} {node} shows what it printed")
    return passed(told)
