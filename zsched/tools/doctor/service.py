"""Checks of the systemd unit: is it there, does it start at boot, can it see what it needs.

Knows: where units lie, what `ProtectHome=` and a user without a name may see. Does not know: systemd's bus; it reads
files.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import pwd
import shlex
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from zsched.config.drivers import starter_for
from zsched.core.values.fleet import WorkerSpec, runs_worker
from zsched.core.values.struct import Struct
from zsched.host.workers.hired import FOLDER
from zsched.link.sessions.secured import CERTIFICATE, KEY, TRUSTED
from zsched.tools.doctor.model import Result, Scene, failed, joined, passed, skipped, warned

UNIT: Final = "zsched.service"
RUNNING: Final = Path("/run/systemd/system")
"""There while systemd is the machine's first process (sd_booted(3))."""
FOLDERS: Final = ("/etc/systemd/system", "/run/systemd/system", "/usr/lib/systemd/system", "/lib/systemd/system")
HOMES: Final = ("/home", "/root", "/run/user")
"""What `ProtectHome=yes` hides."""

SYSTEMD_PATH: Final = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin"
"""``$PATH`` of a service that says nothing (systemd.exec(5))."""
LINE_BYTES: Final = 512

Settings = list[tuple[str, str]]
NOBODY: Final = 65534
"""The ids of `nobody`, for a user that is not there yet."""


def is_installed(scene: Scene) -> Result:
    """Whether there is a unit."""
    if not scene.at(RUNNING).is_dir():
        return skipped("systemd does not run here")
    unit = _unit(scene)
    if unit is not None:
        return passed(f"{unit}")
    return warned(
        f"there is no {UNIT} in {', '.join(FOLDERS[:2])}: the daemon does not start by itself",
        fix="sudo /opt/zsched/bin/zsched install",
    )


def is_enabled(scene: Scene) -> Result:
    """Whether the unit starts at boot."""
    masks = [link for folder in FOLDERS[:2] if (link := scene.at(folder) / UNIT).is_symlink()]
    if any(str(link.readlink()) == "/dev/null" for link in masks):
        return failed(f"{UNIT} is masked", fix="sudo systemctl unmask zsched && sudo systemctl enable zsched")
    if _unit(scene) is None:
        return skipped("there is no unit")
    if any(any(scene.at(folder).glob(f"*.wants/{UNIT}")) for folder in FOLDERS[:2]):
        return passed(f"{UNIT} is wanted at boot")
    return warned(f"{UNIT} does not start at boot", fix="sudo systemctl enable zsched")


def can_see_its_files(scene: Scene) -> Result:
    """Whether the unit's user sees the program, the fleet file, the certificates and the workers' programs."""
    unit = _unit(scene)
    if unit is None:
        return skipped("there is no unit")
    settings = _settings(scene, unit)
    command = shlex.split(_last(settings, "ExecStart").lstrip("-@:+!"))
    if not command:
        return failed(f"{unit} has no ExecStart", fix="install the unit that comes with zsched")
    hides_homes = _last(settings, "ProtectHome").lower() not in ("", "no", "false", "off", "0")
    reader = _reader(settings)
    found = [*_program(scene, Path(command[0]), hides_homes=hides_homes)]
    for path in _files(scene, command):
        found += _file(scene, path, hides_homes=hides_homes, reader=reader)
    found += _key(scene, settings, reader)
    return joined(found, passed(f"{unit}: the service sees {command[0]} and all files that it needs"))


def _program(scene: Scene, program: Path, *, hides_homes: bool) -> Iterator[Result]:
    """The program, the interpreter that it runs in, and the workers' programs."""
    here = scene.at(program)
    if not here.exists() and not here.is_symlink():
        fix = "install zsched there, or name the program with a drop-in: systemctl edit zsched"
        yield failed(f"the unit starts {program}, which is not there", fix=fix)
        return
    if not hides_homes:
        return
    needed = [program, *_interpreter(scene, here)]
    for task in scene.fleet.tasks:
        if runs_worker(task, scene.node, scene.me.kind):
            needed += [Path(word) for word in task.worker.command if word.startswith("/")]
    for path in needed:
        if hidden := _home_of(path):
            fix = "install to /opt, Python too (docs/guide/install.md), or ProtectHome=no in a drop-in"
            yield failed(f"{path} is or leads to {hidden}, which the service cannot see (ProtectHome)", fix=fix)


def _interpreter(scene: Scene, program: Path) -> Iterator[Path]:
    """What the first line of a script names."""
    with contextlib.suppress(OSError), program.open("rb") as file:
        first, *words = file.readline(LINE_BYTES).split() or [b""]
        name = first.removeprefix(b"#!") or next(iter(words), b"")
        if first.startswith(b"#!") and name:
            yield scene.at(name.decode(errors="replace"))


def _files(scene: Scene, command: list[str]) -> Iterator[Path]:
    """What the daemon reads."""
    given = [after for word, after in itertools.pairwise(command) if word in ("--config", "-c")]
    yield from (Path(path) for path in given)
    if scene.fleet.zenoh_config:
        yield Path(scene.fleet.zenoh_config)
    if scene.fleet.security is not None:
        yield from (Path(scene.fleet.security.folder, name) for name in (CERTIFICATE, TRUSTED))


class _Reader(Struct, frozen=True):
    """As whom the service reads."""

    uid: int
    """-1: nobody that this machine knows; 0: root, who reads all."""
    groups: frozenset[int]
    group: int = -1
    """The first of them."""

    def reads(self, found: os.stat_result) -> bool:
        """Whether it may read a file."""
        if self.uid in (0, found.st_uid):
            return self.uid == 0 or bool(found.st_mode & stat.S_IRUSR)
        return bool(found.st_mode & (stat.S_IRGRP if found.st_gid in self.groups else stat.S_IROTH))


def _reader(settings: Settings) -> _Reader:
    """The unit's user: systemd makes one (`DynamicUser`), it has a name, or it is root."""
    name = _last(settings, "User")
    is_made = _last(settings, "DynamicUser").lower() in ("yes", "true", "on", "1")
    if not is_made and name in ("", "root", "0"):
        return _Reader(0, frozenset())
    try:
        user = pwd.getpwnam(name)
    except KeyError:
        return _Reader(-1, frozenset())
    return _Reader(user.pw_uid, frozenset(os.getgrouplist(name, user.pw_gid)), user.pw_gid)


def user_of_service(scene: Scene) -> tuple[int, int] | None:
    """(user id, group id) as which the daemon starts workers; ``None``: there is no unit, or it is root.

    A user that systemd makes is not there yet: then that of nobody.
    """
    unit = _unit(scene)
    reader = _Reader(0, frozenset()) if unit is None else _reader(_settings(scene, unit))
    if reader.uid == 0:
        return None
    return (reader.uid, reader.group) if reader.uid > 0 else (NOBODY, NOBODY)


def starter_of_service(scene: Scene, worker: WorkerSpec) -> Path | None:
    """The socket of who starts a worker for the service, as another user; ``None``: the daemon starts it."""
    unit = _unit(scene)
    said = [] if unit is None else [value for name, value in _settings(scene, unit) if name == "Environment"]
    env = dict(word.partition("=")[::2] for value in said for word in value.split())
    return starter_for(worker, scene.fleet, {FOLDER: str(scene.at(env[FOLDER]))} if env.get(FOLDER) else {})


def path_of_service(scene: Scene) -> str | None:
    """Where the daemon looks for programs, as ``PATH`` says it; ``None``: there is no unit, or it is not plain there.

    A file of variables may say another one, and systemd's specifiers (``%h``) are not read here.
    """
    unit = _unit(scene)
    if unit is None:
        return None
    settings, path = _settings(scene, unit), SYSTEMD_PATH
    for value in (value for name, value in settings if name == "Environment"):
        if not value:  # all that was said before counts no more
            path = SYSTEMD_PATH
        with contextlib.suppress(ValueError):  # systemd passes over such a line, too
            path = next((word[5:] for word in reversed(shlex.split(value)) if word.startswith("PATH=")), path)
    return None if "%" in path or _last(settings, "EnvironmentFile") else path


def _key(scene: Scene, settings: Settings, reader: _Reader) -> Iterator[Result]:
    """Of a secured fleet: the key, which a user that may not read it gets from systemd."""
    security = scene.fleet.security
    handed = [value for name, value in settings if name == "LoadCredential"]
    if security is None:
        return
    path = Path(security.folder, KEY)
    here = _seen(scene, path)
    if f"{KEY}:{path}" in handed or (here.exists() and reader.reads(here.stat())) or reader.uid == 0:
        return
    fix = f"systemctl edit zsched: [Service] LoadCredential={KEY}:{path} (docs/guide/secure.md)"
    yield failed(f"{path} is not handed over to the service's user, which may not read it", fix=fix)


def _seen(scene: Scene, path: Path) -> Path:
    return scene.at(path) if scene.root != Path("/") and not path.is_relative_to(scene.root) else path


def _file(scene: Scene, path: Path, *, hides_homes: bool, reader: _Reader) -> Iterator[Result]:
    here = _seen(scene, path)
    if not here.exists():
        yield failed(f"the unit reads {path}, which is not there", fix=f"sudo install -D -m 644 FILE {path}")
    elif hides_homes and (hidden := _home_of(path)):
        yield failed(f"{path} is below {hidden}, which the service cannot see (ProtectHome)", fix="move it to /etc")
    elif not reader.reads(here.stat()):
        fix = (
            f"sudo chgrp {reader.group} {path} && sudo chmod 640 {path}"
            if reader.group > 0
            else f"sudo chmod o+r {path}"
        )
        yield failed(f"{path} is not readable by the service's user", fix=fix)


def _home_of(path: Path) -> str:
    """Below which hidden folder a path lies, or leads by links; empty: none."""
    seen = (str(path), str(path.resolve()))
    return next((home for home in HOMES if any(one.startswith(f"{home}/") for one in seen)), "")


def _unit(scene: Scene) -> Path | None:
    return next((Path(folder) / UNIT for folder in FOLDERS if (scene.at(folder) / UNIT).is_file()), None)


def _settings(scene: Scene, unit: Path) -> Settings:
    """Every setting of the unit and its drop-ins, in the order in which they count."""
    files = [unit]
    for folder in reversed(FOLDERS):
        files += sorted(
            Path("/", *one.relative_to(scene.root).parts) for one in scene.at(folder).glob(f"{UNIT}.d/*.conf")
        )
    found: Settings = []
    for file in files:
        text = scene.at(file).read_text(encoding="utf-8", errors="replace").replace("\\\n", " ")
        pairs = (line.partition("=") for line in text.splitlines() if line[:1] not in ("#", ";", "["))
        found += [(name.strip(), value.strip()) for name, equals, value in pairs if equals]
    return found


def _last(settings: Settings, wanted: str) -> str:
    return next((value for name, value in reversed(settings) if name == wanted and value), "")
