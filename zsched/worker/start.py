"""Reads a worker's environment and opens its session.

Knows: the variables that the daemon sets. Does not know: roles, inputs, outputs.
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Final

import zenoh

from zsched.core.values.errors import ConfigError
from zsched.core.values.struct import Struct
from zsched.worker.keys import OUTPUT_KEYS, output_keys

_ENVIRONMENT: Final = ("ZSCHED_FLEET", "ZSCHED_NODE", "ZSCHED_TASK", "ZSCHED_INCARNATION", "ZSCHED_ZENOH_CONFIG")
_ASKED_NODE: Final = "ZSCHED_NODE"
"""Alone it is no sign of a daemon: a terminal may have it, to say which node the verbs of ``zsched`` ask."""

DEADLINE: Final = "ZSCHED_DEADLINE_MS"

AGAIN_S: Final = 0.2
"""A client pauses for this long between two tries; a try takes up to `zsched.link.sessions.config.RELAY_START_S`."""

_log = logging.getLogger("zsched.worker")


class Surroundings(Struct, frozen=True, kw_only=True):
    """Who a worker is, and its session's configuration (JSON5 text)."""

    fleet: str
    node: str
    task: str
    incarnation: str
    zenoh_config: str
    is_standalone: bool = False
    deadline_s: float | None = None
    """The task's (`objective: latency`); ``None``: it has none, or the starter of the worker has not said."""
    output_keys: tuple[str, ...] = ()
    """What the task's output rules take of this node; empty: there are none, or nobody has told."""


def surroundings(env: Mapping[str, str], standalone: str) -> Surroundings:
    """What the environment says; ``standalone`` names the task of a worker started by hand.

    Raises:
        ConfigError: a variable is missing, or the zenoh configuration cannot be read.
    """
    missing = [name for name in _ENVIRONMENT if not env.get(name)]
    others = [name for name in _ENVIRONMENT if name not in missing and name != _ASKED_NODE]
    if missing and (others or not standalone):
        by_hand = "say --standalone (Worker.from_env(standalone=TASK))"
        if standalone:
            by_hand = f"with --standalone, unset {', '.join(others)}"
        raise ConfigError(
            f"this worker has no {', '.join(missing)} in its environment: a worker is started by its node's "
            f"daemon (zsched up); to run it by hand, {by_hand}"
        )
    if missing:
        return Surroundings(
            fleet="standalone", node="local", task=standalone, incarnation="1", zenoh_config="{}", is_standalone=True
        )
    fleet, node, task, incarnation, path = (env[name] for name in _ENVIRONMENT)
    return Surroundings(
        fleet=fleet,
        node=node,
        task=task,
        incarnation=incarnation,
        zenoh_config=_read(path),
        deadline_s=_deadline_s(env.get(DEADLINE, "")),
        output_keys=output_keys(env.get(OUTPUT_KEYS, "")),
    )


def open_session(zenoh_config: str) -> zenoh.Session:
    """The worker's session on the data network.

    A client cannot be without its relay, which may listen later than the worker begins (a port that is taken). That is
    no fault of this worker's: it goes on trying, for as long as its daemon lets it.

    Raises:
        ConfigError: zenoh refuses the configuration.
    """
    has_told = False
    while True:
        is_client = False
        try:
            config = zenoh.Config.from_json5(zenoh_config)
            is_client = json.loads(config.get_json("mode")) == "client"
            return zenoh.open(config)
        except (zenoh.ZError, ValueError) as error:
            if not is_client:
                raise ConfigError(f"the worker's zenoh session cannot be opened: {error}") from error
            if not has_told:
                _log.warning("the relay of this node cannot be reached yet, and is tried again: %s", error)
                has_told = True
            time.sleep(AGAIN_S)


def _deadline_s(text: str) -> float | None:
    try:
        return float(text) / 1e3 if text else None
    except ValueError as error:
        raise ConfigError(f"{DEADLINE}: {text!r} is no number of milliseconds") from error


def _read(path: str) -> str:
    try:
        return Path(path).read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"ZSCHED_ZENOH_CONFIG: {path} cannot be read: {error.strerror}") from error
