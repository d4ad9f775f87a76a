"""Decides what this node's workers are made with: commands, environments, and the sessions that they open.

Knows: the fleet file's workers, their session files in the runtime folder. Does not know: processes
(`zsched.host.workers.supervisor`), when a worker is started again.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from zsched.config.drivers import starter_for
from zsched.core.route.route import outputs_of
from zsched.core.values.errors import AdapterError
from zsched.core.values.fleet import Fleet, TaskSpec, WorkerLink, WorkerSpec, runs_worker
from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.struct import Struct
from zsched.host.files import write_regular
from zsched.host.paths import ENVIRONMENT_SUFFIX, PID_SUFFIX, SESSION_SUFFIX, beside_session
from zsched.link.sessions import config as zenoh_config
from zsched.runtime.sessions import SessionsRead

NOTHING: Final[Mapping[str, str]] = {}


class _Made(Struct, frozen=True, kw_only=True):
    """All workers of one fleet file; replaced as a whole, for the supervisor's thread reads it."""

    specs: Mapping[TaskId, WorkerSpec]
    sessions: Mapping[TaskId, str]
    environments: Mapping[TaskId, Mapping[str, str]]
    starters: Mapping[TaskId, Path | None]


class Recipes:
    """The recipes of one node's workers."""

    def __init__(
        self,
        me: NodeId,
        folder: Path,
        read: SessionsRead,
        *,
        shared_memory: bool,
        operator_json5: Mapping[WorkerLink, str],
        pools: str | None,
        by_socket: tuple[tuple[str, ...], str] = ((), ""),
    ) -> None:
        """``folder``: where the session files go; ``read``: of workers that somebody else starts.

        ``operator_json5``: {how a worker joins: the settings of zenoh that every such session has}; ``pools``: zenoh's
        pools of threads as an operator has set them for this node's processes; ``by_socket``: where a worker without
        the key of a secured fleet dials its relay, and its settings of zenoh.
        """
        self._me, self._folder, self.read = me, folder, read
        self._shared_memory, self._operator_json5, self._pools = shared_memory, operator_json5, pools
        self._by_socket = by_socket
        self._made = _Made(specs={}, sessions={}, environments={}, starters={})
        self._written: dict[TaskId, str] = {}
        """{task: the session in its file}, of another fleet than the recipes where one could not be written."""

    @property
    def specs(self) -> Mapping[TaskId, WorkerSpec]:
        """{task: how its worker is run} of the workers of this node."""
        return self._made.specs

    @property
    def paths(self) -> Mapping[TaskId, Path]:
        """{task: the file with the session that its worker opens}."""
        return {task: self._path(task) for task in self._made.specs}

    def environment(self, task: TaskId) -> Mapping[str, str]:
        """The variables of a task's worker beside those of the daemon, of its life and of the fleet file."""
        return self._made.environments.get(task, NOTHING)

    def session(self, task: TaskId) -> str:
        """The text of the session that a task's worker opens."""
        return self._made.sessions.get(task, "")

    def starter(self, task: TaskId) -> Path | None:
        """Who starts a task's worker, as another user; ``None``: the daemon."""
        return self._made.starters.get(task)

    def make(self, fleet: Fleet, connect: tuple[str, ...], *, dials_by_gossip: bool) -> None:
        """Make the recipes of a fleet file, and write the session files that have changed.

        Args:
            fleet: the file.
            connect: what workers dial, their own relay first.
            dials_by_gossip: whether they dial robots without an address, too.

        Raises:
            AdapterError: a file cannot be written; it and the recipes stay as they are.
        """
        kind = fleet.node(self._me).kind
        mine = [task for task in fleet.tasks if runs_worker(task, self._me, kind)]
        sessions = {}
        for task in mine:
            is_keyless = fleet.security is not None and task.worker.user
            dialled, settings = self._by_socket if is_keyless else (connect, self._operator_json5[task.worker.link])
            sessions[task.name] = zenoh_config.worker_config(
                connect=dialled,
                listen=(),
                timing=fleet.timing,
                link=fleet.link_of(task),
                shared_memory=self._shared_memory,
                operator_json5=settings,
                dials_by_gossip=dials_by_gossip,
            )
        for name, text in sessions.items():
            if text != self._written.get(name):
                self._write(name, text)
        for name in [name for name in self._made.specs if name not in sessions]:
            self._remove(name)
        for task in mine:
            if not task.worker.command:
                self.read.begin(task.name, sessions[task.name])
        if any(not task.worker.command for task in mine):
            self.read.save()
        pools = self._pools or zenoh_config.worker_pools(len(fleet.nodes), len(fleet.tasks))
        self._made = _Made(
            specs={task.name: task.worker_on(self._me) for task in mine},
            sessions=sessions,
            environments={task.name: self._environment(task, pools) for task in mine},
            starters={task.name: starter_for(task.worker, fleet) for task in mine},
        )

    def close(self) -> None:
        """Remove the session files, and those that a driver has left beside them when it had to be killed."""
        for name in self._made.specs:
            self._remove(name)

    def _remove(self, task: TaskId) -> None:
        path = self._path(task)
        self._written.pop(task, None)
        for one in (path, beside_session(path, ENVIRONMENT_SUFFIX), beside_session(path, PID_SUFFIX)):
            with contextlib.suppress(OSError):  # a folder that is read-only by now: nobody opens it any more
                one.unlink(missing_ok=True)

    def _path(self, task: TaskId) -> Path:
        return self._folder / f"{self._me}-{task}{SESSION_SUFFIX}"

    def _write(self, task: TaskId, text: str) -> None:
        path = self._path(task)
        new = path.with_name(f"{path.name}.new")  # where there is no room, the worker's next start needs the one before
        try:
            write_regular(new, text.encode())
            new.replace(path)
        except OSError as error:
            raise AdapterError(f"cannot write {path}: {error.strerror}; check --runtime-dir") from error
        self._written[task] = text

    def _environment(self, task: TaskSpec, pools: str) -> dict[str, str]:
        path = str(self._path(task.name))
        made = {
            "PYTHONFAULTHANDLER": "1",
            "ZENOH_RUNTIME": pools,
            "ZSCHED_ZENOH_CONFIG": path,
            "ZENOH_SESSION_CONFIG_URI": path,  # a ROS node (rmw_zenoh) joins the data network by this
            "ZENOH_CONFIG": path,  # and whatever opens a session by zenoh's own variable (`Config.from_env`)
        }
        if task.tuning.deadline_ms is not None:
            made |= {"ZSCHED_DEADLINE_MS": f"{task.tuning.deadline_ms:g}"}
        if keys := outputs_of(task, self._me):
            made |= {"ZSCHED_OUTPUT_KEYS": json.dumps(keys)}
        return made
