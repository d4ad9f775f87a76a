"""What a driver gets from its daemon, and what it reports: the environment file of the worker, and its process.

Knows: the variables of a worker, the two files beside its session file. Does not know: engines.

``<node>-<task>.env`` holds the worker's variables for an engine that starts it elsewhere. ``<node>-<task>.pid`` holds
the worker's process and the driver's, so that the daemon measures the right one (`zsched.runtime.sampler`).
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from zsched.core.values.errors import ConfigError
from zsched.core.values.struct import Struct
from zsched.host.paths import ENVIRONMENT_SUFFIX, PID_SUFFIX, beside_session

TOLD: Final = ("ZSCHED_FLEET", "ZSCHED_NODE", "ZSCHED_TASK", "ZSCHED_INCARNATION", "ZSCHED_ZENOH_CONFIG")
ALSO: Final = (
    "ZENOH_RUNTIME",
    "ZENOH_SESSION_CONFIG_URI",
    "ZENOH_CONFIG",
    "ZSCHED_DEADLINE_MS",
    "ZSCHED_OUTPUT_KEYS",
    "PYTHONUNBUFFERED",
    "PYTHONFAULTHANDLER",
)
MODE: Final = 0o600


class Place(Struct, frozen=True, kw_only=True):
    """Whose worker this is."""

    fleet: str
    node: str
    task: str
    session: Path
    """The file with the session that the worker opens."""
    variables: tuple[tuple[str, str], ...]
    """All that the worker gets."""

    @classmethod
    def from_env(cls, env: Mapping[str, str], names: Sequence[str] = ()) -> Place:
        """By the daemon's variables; ``names``: the task's own ones of ``env:``.

        Raises:
            ConfigError: one is missing: no daemon has started this driver.
        """
        missing = [name for name in TOLD if not env.get(name)]
        if missing:
            raise ConfigError(f"a driver is started by its node's daemon (zsched up): no {', '.join(missing)}")
        return cls(
            fleet=env["ZSCHED_FLEET"],
            node=env["ZSCHED_NODE"],
            task=env["ZSCHED_TASK"],
            session=Path(env["ZSCHED_ZENOH_CONFIG"]),
            variables=tuple((name, env[name]) for name in (*TOLD, *ALSO, *names) if name in env),
        )

    @property
    def environment_file(self) -> Path:
        """Where the worker's variables are."""
        return beside_session(self.session, ENVIRONMENT_SUFFIX)

    @property
    def pid_file(self) -> Path:
        """Where the worker's process is noted."""
        return beside_session(self.session, PID_SUFFIX)

    def write_environment(self, lines: Sequence[str]) -> None:
        """Write the environment file, readable by its owner only: it may hold secrets. Raises `OSError`."""
        _write(self.environment_file, "".join(f"{line}\n" for line in lines))

    def note(self, pid: int | None) -> None:
        """Note the worker's process; a file that cannot be written leaves its load unmeasured."""
        try:
            if pid is None:
                self.pid_file.unlink(missing_ok=True)
            else:
                _write(self.pid_file, f"{pid} {os.getpid()}\n")
        except OSError as error:
            print(f"the worker's process cannot be noted in {self.pid_file}: {error.strerror}", flush=True)

    def forget(self) -> None:
        """Remove the files."""
        for path in (self.environment_file, self.pid_file):
            path.unlink(missing_ok=True)


def _write(path: Path, text: str) -> None:
    part = path.with_name(f"{path.name}.part")
    descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC, MODE)
    with os.fdopen(descriptor, "w", encoding="utf-8") as file:
        file.write(text)
    part.replace(path)
