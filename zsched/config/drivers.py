"""Decides which command a worker's `driver:` stands for: each is a program of zsched's that keeps an engine's worker.

Knows: the keys of each driver, the words of each program (`zsched.drivers`). Does not know: what the programs do.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from enum import StrEnum
from pathlib import Path
from typing import Final

from zsched.config.blocks import Choice, Field, Here, ListOf, Located, Section, Text
from zsched.config.reader import Collector
from zsched.core.route.ros2 import name_fault
from zsched.core.values.fleet import Fleet, WorkerSpec
from zsched.core.values.plan import ReadyWhen
from zsched.host.workers.hired import starter_of


class Driver(StrEnum):
    """What keeps the worker's process."""

    PROCESS = "process"
    SYSTEMD = "systemd"
    CONTAINER = "container"
    ROS2_LIFECYCLE = "ros2_lifecycle"


class ContainerEngine(StrEnum):
    """What runs containers (`zsched.drivers.container`)."""

    PODMAN = "podman"
    DOCKER = "docker"


AS_THE_DAEMON: Final = (Driver.SYSTEMD, Driver.CONTAINER)
"""What keeps the worker of these is a program of ours, which needs the daemon's rights towards its engine."""

_UNIT: Final = re.compile(r"[A-Za-z0-9_][A-Za-z0-9:_.\\-]{0,200}(@[A-Za-z0-9:_.\\-]*)?\.service")
_OWN: Final[Mapping[Driver, tuple[str, ...]]] = {
    Driver.PROCESS: ("command",),
    Driver.SYSTEMD: ("unit",),
    Driver.CONTAINER: ("image", "args", "mounts", "options", "engine"),
    Driver.ROS2_LIFECYCLE: ("node", "command"),
}
"""The keys of each driver, the first one needed (but that of a process: somebody else may start it), of a node both."""

TARGET: Final = "{target}"


def _unit_fault(text: str) -> str | None:
    if _UNIT.fullmatch(text) is not None:
        return None
    return "NAME.service, or NAME@.service of a template"


_IMAGE: Final = re.compile(r"[a-z0-9][A-Za-z0-9._/:@-]{0,254}")
_MOUNT: Final = re.compile(r"/[^:,]*:/[^:,]*(:(ro|rw))?")
_OPTION: Final = re.compile(r"--?[a-z][A-Za-z0-9-]*(=.*)?", re.DOTALL)


def _image_fault(text: str) -> str | None:
    return None if _IMAGE.fullmatch(text) is not None else "NAME:TAG or NAME@DIGEST, with its registry where it has one"


def _mount_fault(text: str) -> str | None:
    return None if _MOUNT.fullmatch(text) is not None else "/ON/THE/HOST:/INSIDE, and `:ro` where it is only read"


def _option_fault(text: str) -> str | None:
    return None if _OPTION.fullmatch(text) is not None else "one word, its value after '='"


def _word_fault(text: str) -> str | None:
    return "it has a NUL" if "\0" in text else None


def _node_fault(text: str) -> str | None:
    if text.count(TARGET) != 1 or "*" in text or set(text.replace(TARGET, "")) & set("{}"):
        return f"/{TARGET}/NAME: each machine has a node of its own, and all see each other's services"
    return name_fault(text)


DRIVER_KEYS: Final = {
    "driver": Field(
        Choice.of(Driver),
        "What keeps the worker: its `command`, a `unit`, an `image`, or a managed `node` that its `command` starts.",
        default=f"`{Driver.PROCESS}`",
    ),
    "unit": Field(
        Here(Text("a systemd service", _unit_fault)),
        "Driver `systemd`: the unit; of `NAME@.service` the instance NODE-TASK.",
    ),
    "image": Field(
        Text("an image", _image_fault),
        "Driver `container`: the image, which must be on the machine.",
    ),
    "args": Field(ListOf(Text("a word", _word_fault)), "Driver `container`: what runs inside."),
    "mounts": Field(
        ListOf(Text("a mount", _mount_fault)),
        "Driver `container`: `/HOST:/INSIDE` or `/HOST:/INSIDE:ro`.",
    ),
    "options": Field(
        ListOf(Text("an option", _option_fault)),
        "Driver `container`: options of `run`, one word each, as `--gpus=all`.",
    ),
    "engine": Field(
        Choice.of(ContainerEngine),
        "Driver `container`: what runs it; without the key podman, else docker.",
    ),
    "node": Field(
        Text("a managed node", _node_fault),
        "Driver `ros2_lifecycle`: the node's full name, as `/{target}/slam`.",
    ),
}


def command_of(section: Section, out: Collector) -> tuple[str, ...] | None:
    """The command that the worker's driver stands for; ``None``: the driver is a process, or has a fault."""
    if "driver" in section.places and section.get("driver") is None:
        return None  # that it is none is said already
    driver: Driver = section.get("driver", Driver.PROCESS)
    for other, own in _OWN.items():
        for name in own if other is not driver else ():
            if name in section.places and name not in _OWN[driver]:
                is_word = (driver, name) == (Driver.CONTAINER, "command")
                hint = "what the container runs is `args`" if is_word else f"delete it, or say driver: {other}"
                out.error(section.where(name), f"driver {driver} has no {name!r}", hint)
                return None
    if driver is Driver.PROCESS:
        return None
    if driver in AS_THE_DAEMON and "user" in section.places:
        hint = "the unit has a `User=`" if driver is Driver.SYSTEMD else "`options: [--user=NAME]` says it"
        out.error(section.where("user"), f"driver {driver} has no 'user'", hint)
        return None
    for needed in _OWN[driver] if driver is Driver.ROS2_LIFECYCLE else _OWN[driver][:1]:
        if needed not in section.places:
            out.error(section.where("driver"), f"driver {driver} needs the key {needed!r}", f"{needed}: ...")
            return None
    if not section.is_whole:
        return None
    if driver is Driver.ROS2_LIFECYCLE and section.get("ready") is not ReadyWhen.MATCHING:
        message = "a ROS 2 node shows no token of zsched.worker: it is ready when it subscribes"
        out.error(section.where("driver"), message, "ready: matching")
        return None
    names = (word for name in section.get("env", {}) for word in ("--env", name))
    return (*_program(driver), *_WORDS[driver](section), *names)


def runs_as_the_daemon(command: tuple[str, ...]) -> bool:
    """Whether a worker's command is a driver that needs the daemon's rights."""
    return command[:3] in [_program(driver) for driver in AS_THE_DAEMON]


def starter_for(worker: WorkerSpec, fleet: Fleet, env: Mapping[str, str] = os.environ) -> Path | None:
    """Who starts a worker, as another user.

    In a secured fleet, or by an operator's zenoh file, sessions may need a key that only the daemon's user reads: there
    another user must be asked for. In a secured fleet it then joins by its own relay alone.
    """
    may_need_key = fleet.security is not None or fleet.zenoh_config
    if runs_as_the_daemon(worker.command) or (may_need_key and not worker.user):
        return None
    return starter_of(worker.user, env)


def _program(driver: Driver) -> tuple[str, ...]:
    return ("python", "-m", f"zsched.drivers.{driver}")


def _systemd_words(section: Section) -> tuple[str, ...]:
    unit: Located[str] = section.get("unit")
    return ("--unit", unit.value)


def _container_words(section: Section) -> tuple[str, ...]:
    engine: ContainerEngine | None = section.get("engine")
    return (
        f"--image={section.get('image')}",
        *((f"--engine={engine}",) if engine is not None else ()),
        *(f"--mount={mount}" for mount in section.get("mounts", ())),
        *(f"--option={option}" for option in section.get("options", ())),
        *(f"--arg={word}" for word in section.get("args", ())),
    )


def _lifecycle_words(section: Section) -> tuple[str, ...]:
    return (f"--node={section.get('node')}", *(f"--arg={word}" for word in section.get("command")))


_WORDS: Final[Mapping[Driver, Callable[[Section], tuple[str, ...]]]] = {
    Driver.SYSTEMD: _systemd_words,
    Driver.CONTAINER: _container_words,
    Driver.ROS2_LIFECYCLE: _lifecycle_words,
}
