"""Runs a whole fleet on this machine: real daemons with their own state, sockets, ports and shares of the CPU.

Knows: the fleet file, the command line, which nodes are up. Does not know: robots' applications, schedules, pictures.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from zsched.core.values.errors import ConfigError
from zsched.core.values.model import NodeId, TaskId
from zsched_lab.fleet.children import Child, ChildError, Children
from zsched_lab.fleet.limits import NodeLimits
from zsched_lab.fleet.loopback import free_endpoints, own_address
from zsched_lab.fleet.schedule import Injection

CLI = (sys.executable, "-m", "zsched.cli")
INIT_S = 20.0
UP_S = 90.0
POLL_S = 0.05

Tree = dict[str, Any]
"""A fleet file as plain YAML data."""
Ask = Callable[[Path, Tree, float], Tree]
"""`zsched.host.operator_client.ask`: (socket, request, seconds) -> answer."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LabFleet:
    """The effective fleet file of one run and what the lab must know of it."""

    path: Path
    task: TaskId
    """The one that is watched."""
    kinds: Mapping[NodeId, str]
    data_endpoints: Mapping[NodeId, str]
    others: tuple[TaskId, ...] = ()
    """What runs beside it."""

    @property
    def robots(self) -> tuple[NodeId, ...]:
        """Sorted."""
        return tuple(sorted(name for name, kind in self.kinds.items() if kind == "robot"))

    @property
    def edges(self) -> tuple[NodeId, ...]:
        """Sorted."""
        return tuple(sorted(name for name, kind in self.kinds.items() if kind == "edge"))


def read_tree(path: Path) -> Tree:
    """A YAML file as plain data.

    Raises:
        ConfigError: it cannot be read, or holds no mapping.
    """
    try:
        tree = YAML(typ="safe").load(path)
    except Exception as error:
        raise ConfigError(f"{path}: not readable as a fleet file: {error}") from error
    if not isinstance(tree, dict) or not isinstance(tree.get("nodes"), dict) or not isinstance(tree.get("tasks"), dict):
        raise ConfigError(f"{path}: no nodes or tasks in it; run `zsched check {path}`")
    return tree


def write_fleet(
    template: Path,
    path: Path,
    replaced: Mapping[str, tuple[str, ...]],
    others: Mapping[str, tuple[str, ...]] | None = None,
) -> LabFleet:
    """Write the effective fleet file: the template on loopback endpoints of our own, its worker with other options.

    ``replaced`` is {option: values}: every ``option value`` in the worker's command gives way to these. The first task
    is the one that is watched; with ``others``, which is the same for the rest of them, there may be more.

    Raises:
        ConfigError: the template is no fleet file, or has not exactly one task.
    """
    tree = read_tree(template)
    nodes: Tree = tree["nodes"]
    endpoints = {}
    for name, node in sorted(nodes.items()):
        control, data = free_endpoints(2)
        node["host"] = own_address()
        node["listen"] = {"control": control, "data": data}
        endpoints[name] = data
    task, *rest = tree["tasks"] or ("",)
    if not task or (rest and others is None):
        raise ConfigError(f"{template}: the lab runs one task, there are {len(tree['tasks'])}")
    for name, spec in tree["tasks"].items():
        given = replaced if name == task else others or {}
        spec["worker"]["command"] = with_options(spec["worker"]["command"], given)
    with path.open("w", encoding="utf-8") as file:
        file.write(f"# Effective fleet file of one run, made from {template.name}.\n")
        YAML().dump(tree, file)
    kinds = {name: str(node["kind"]) for name, node in nodes.items()}
    return LabFleet(path=path, task=task, kinds=kinds, data_endpoints=endpoints, others=tuple(rest))


def with_options(command: list[str], replaced: Mapping[str, tuple[str, ...]]) -> list[str]:
    """The command without the ``--option value`` pairs of ``replaced``, and with its values behind."""
    kept, words = [], iter(command)
    for word in words:
        if word in replaced:
            next(words, None)
        else:
            kept.append(word)
    return kept + [word for option, values in replaced.items() for value in values for word in (option, value)]


class FleetRunner:
    """The daemons of one run; their end is the business of `Children`."""

    def __init__(
        self, fleet: LabFleet, children: Children, runtime: Path, limits: NodeLimits, cli: tuple[str, ...] = CLI
    ) -> None:
        """Keep state and sockets below ``runtime`` (short: a socket's path has 107 characters)."""
        self._fleet = fleet
        self._children = children
        self._runtime = runtime
        self._limits = limits
        self._cli = cli
        self._loads = 0

    def socket(self, node: NodeId) -> Path:
        """The operator socket of a node's daemon."""
        return self._runtime / "run" / f"{node}.sock"

    def sockets(self) -> dict[NodeId, Path]:
        """All of them."""
        return {node: self.socket(node) for node in self._fleet.kinds}

    def init(self) -> None:
        """Give each node its blank durable state, all at once.

        Raises:
            ChildError: one of them failed or took too long.
        """
        (self._runtime / "run").mkdir(parents=True, exist_ok=True)
        started = [self._start_init(node) for node in self._fleet.kinds]
        end = time.monotonic() + INIT_S
        for child in started:
            while child.is_running and time.monotonic() < end:
                time.sleep(POLL_S)
            if child.process.returncode != 0:
                raise ChildError(
                    f"{child.name} failed ({child.process.returncode}); see {child.log}\n{child.log_tail()}"
                )
        self._children.stop(*started)

    def _start_init(self, node: NodeId) -> Child:
        command = [*self._cli, "init", "--config", str(self._fleet.path), "--node", node]
        return self._children.start(f"init-{node}", [*command, "--state-dir", str(self._state(node))])

    def up(self) -> None:
        """Start every daemon, the edges' inside their shares; `wait_up` tells when they answer."""
        for node in self._fleet.kinds:
            command = [*self._cli, "up", "--config", str(self._fleet.path), "--node", node]
            folders = ["--state-dir", str(self._state(node)), "--runtime-dir", str(self._runtime / "run")]
            child = self._children.start(f"daemon-{node}", [*command, *folders])
            self._limits.put(node, child.process.pid)

    def _state(self, node: NodeId) -> Path:
        return self._runtime / "state" / node

    def wait_up(self, answering: Callable[[], Collection[NodeId]], between: Callable[[], None]) -> None:
        """Wait until all daemons are among ``answering()``, calling ``between`` meanwhile.

        Raises:
            ChildError: one ended, or some do not answer within `UP_S`.
        """
        end = time.monotonic() + UP_S
        while missing := sorted(set(self._fleet.kinds) - set(answering())):
            self._children.check()
            if time.monotonic() > end:
                first = self._children.running(f"daemon-{missing[0]}")[0]
                raise ChildError(
                    f"no answer within {UP_S:.0f} s from {', '.join(missing)}; see {first.log}\n{first.log_tail()}"
                )
            between()

    def inject(self, node: NodeId, injection: Injection, output: Path) -> Child:
        """Start neural load inside the node's share; its frames per second go to ``output``."""
        self._loads += 1
        command = [sys.executable, "-m", "zsched_lab.fleet.neural_load", "--threads", str(injection.threads)]
        child = self._children.start(f"load-{self._loads}-{node}", command, output=output)
        self._limits.put(node, child.process.pid)
        return child
