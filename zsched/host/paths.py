"""Where things are on this machine: the fleet file, the state and runtime folders, this node's own name.

Knows: defaults for root, for a user and under systemd, and the environment's words. Does not know: what lies there.
"""

from __future__ import annotations

import os
import re
import socket
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from zsched.core.values.model import NodeId  # loads every value, which no verb needs that asks

SYSTEM_CONFIG = Path("/etc/zsched/fleet.yaml")
SYSTEM_RUNTIME = Path("/run/zsched")
SYSTEM_STATE = Path("/var/lib/zsched")
SESSION_SUFFIX = ".zenoh.json5"
"""Of a worker's session file, ``<node>-<task>`` before it; other files of the worker stand beside it."""
PID_SUFFIX = ".pid"
ENVIRONMENT_SUFFIX = ".env"
AUTHORITY_RECORD = "authority.json"
"""What is in every authority's folder."""


def beside_session(session: Path, suffix: str) -> Path:
    """Another file of the worker whose session file this is.

    >>> beside_session(Path("/run/zsched/edge1-echo.zenoh.json5"), PID_SUFFIX).name
    'edge1-echo.pid'
    """
    return session.with_name(session.name.removesuffix(SESSION_SUFFIX) + suffix)


def config_path(given: Path | None, env: Mapping[str, str]) -> Path:
    """The fleet file: the argument, ``ZSCHED_CONFIG``, ``/etc/zsched/fleet.yaml`` or the user's own."""
    if given is not None:
        return given
    if "ZSCHED_CONFIG" in env:
        return Path(env["ZSCHED_CONFIG"])
    user = Path(env.get("XDG_CONFIG_HOME") or Path.home() / ".config") / "zsched" / "fleet.yaml"
    return user if is_there(user) and not is_there(SYSTEM_CONFIG) else SYSTEM_CONFIG


def is_there(file: Path) -> bool:
    """Whether a file exists, or is in a folder into which we may not look: there it is told when it is read."""
    try:
        os.stat(file)  # noqa: PTH116 - since Python 3.14 `exists` says of such a file that it is not there
    except PermissionError:
        return True
    except (OSError, ValueError):
        return False
    return True


def state_folder(given: Path | None, env: Mapping[str, str]) -> Path:
    """The state folder: the argument, ``ZSCHED_STATE_DIR``, systemd's, ``/var/lib/zsched`` or the user's own."""
    return _folder(given, env, "ZSCHED_STATE_DIR", "STATE_DIRECTORY", SYSTEM_STATE, "XDG_STATE_HOME")


def runtime_folder(given: Path | None, env: Mapping[str, str]) -> Path:
    """Where the operator socket is: the argument, ``ZSCHED_RUNTIME_DIR``, systemd's, ``/run/zsched`` or the user's."""
    return _folder(given, env, "ZSCHED_RUNTIME_DIR", "RUNTIME_DIRECTORY", SYSTEM_RUNTIME, "XDG_RUNTIME_DIR")


def asked_folder(given: Path | None, env: Mapping[str, str], system: Path = SYSTEM_RUNTIME) -> Path:
    """Where a tool looks for a daemon: as `runtime_folder`, but the service's where there is none of theirs.

    Into the service's folder a user may not look who is not in its group: what is there tells then to ask as root.

    ``system``: but in tests the service's folder.
    """
    own = runtime_folder(given, env)
    is_told = given is not None or bool(env.get("ZSCHED_RUNTIME_DIR"))
    if is_told or local_sockets(own):
        return own
    return system if local_sockets(system) or is_closed(system) else own


def asked_state_folder(
    given: Path | None, env: Mapping[str, str], runtime: Path, system: Path = SYSTEM_RUNTIME
) -> Path:
    """Where the state of a daemon is that a tool has found in ``runtime``: the service's has the service's state.

    ``system``: but in tests the service's folder.
    """
    is_told = given is not None or bool(env.get("ZSCHED_STATE_DIR"))
    return SYSTEM_STATE if not is_told and runtime == system else state_folder(given, env)


def authority_folder(given: Path | None, env: Mapping[str, str], fleet: str) -> Path:
    """Where a fleet's authority lies: the argument, ``ZSCHED_AUTHORITY``, or below the user's own data."""
    if given is not None:
        return given
    if env.get("ZSCHED_AUTHORITY"):
        return Path(env["ZSCHED_AUTHORITY"])
    return _authorities(env) / fleet


def has_authority(folder: Path) -> bool:
    """Whether an authority lies there."""
    return (folder / AUTHORITY_RECORD).exists()


def authority_folders(env: Mapping[str, str]) -> list[Path]:
    """All that lie below the user's own data, of whatever fleet."""
    return [record.parent for record in sorted(_authorities(env).glob(f"*/{AUTHORITY_RECORD}"))]


def _authorities(env: Mapping[str, str]) -> Path:
    return Path(env.get("XDG_DATA_HOME") or Path.home() / ".local" / "share") / "zsched" / "authority"


def _folder(given: Path | None, env: Mapping[str, str], own: str, systemd: str, system: Path, xdg: str) -> Path:
    if given is not None:
        return given
    if env.get(own):
        return Path(env[own])
    if env.get(systemd):
        return Path(env[systemd].partition(":")[0])
    if os.geteuid() == 0:
        return system
    fallback = Path.home() / ".local" / "state"
    return Path(env.get(xdg) or fallback) / "zsched"


def socket_path(runtime: Path, node: NodeId) -> Path:
    """The operator socket of one node on this machine."""
    return runtime / f"{node}.sock"


def relay_path(runtime: Path, node: NodeId) -> Path:
    """The socket at which one node's relay waits for its daemon: the unit's, if there is one, knows of no node."""
    unit = runtime / "relay"
    return unit if is_there(unit) else runtime / f"{node}.relay"


def again_path(runtime: Path, node: NodeId) -> Path:
    """The mark of a daemon on this machine that begins again in its process, until its operator socket is there."""
    return runtime / f"{node}.again"


def local_marks(runtime: Path) -> tuple[Path, ...]:
    """Every such mark in the runtime folder, sorted; none where we may not look into it."""
    try:
        return tuple(sorted(runtime.glob("*.again")))
    except PermissionError:
        return ()


def local_sockets(runtime: Path) -> tuple[Path, ...]:
    """Every operator socket in the folder, sorted: usually one, several in a lab; none where we may not look into it.

    The service's folder is closed to all but root as long as its user has no name (`DynamicUser`).
    """
    try:
        return tuple(sorted(runtime.glob("*.sock")))
    except PermissionError:
        return ()


def is_closed(folder: Path) -> bool:
    """Whether it is there, as far as one can tell, and we may not look into it."""
    try:
        with os.scandir(folder):
            return False
    except PermissionError:
        return True
    except OSError:
        return False


def node_name(given: str | None, env: Mapping[str, str]) -> NodeId:
    """This node's name: ``--node``, ``ZSCHED_NODE`` or the host name, as the fleet file would spell it.

    The host name loses its domain and is put into the alphabet of names (``Robot.1.local`` becomes ``robot``).
    """
    if given:
        return given
    if env.get("ZSCHED_NODE"):
        return env["ZSCHED_NODE"]
    return re.sub(r"[^a-z0-9_-]", "-", socket.gethostname().partition(".")[0].lower()).strip("-_")
