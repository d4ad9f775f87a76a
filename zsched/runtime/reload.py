"""Reads the fleet file again when an operator asks for it (SIGHUP, `systemctl reload zsched`).

Knows: where the file is. Does not know: what a changed file leads to (`zsched.core.node.fleet`).
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from pathlib import Path

from zsched.config.load import load_fleet, require_node
from zsched.core.values import events as ev
from zsched.core.values.errors import ConfigError
from zsched.core.values.model import NodeId
from zsched.host.guard import guarded

SOURCE = "reload"
"""Of the problem that the file is wrong."""

_log = logging.getLogger("zsched.daemon")


class Reload:
    """Reads one node's fleet file again, in a thread of its own: the loop goes on meanwhile."""

    def __init__(self, path: Path, node: NodeId, post: Callable[[ev.Event], None]) -> None:
        self._path, self._node, self._post = path, node, post
        self._reading = threading.Lock()

    def ask(self) -> None:
        """Begin, and return at once; from any thread, also out of a signal's handler."""
        guarded(self._read, name="reload", is_lasting=False).start()

    def _read(self) -> None:
        with self._reading:  # a later reader posts later
            try:
                fleet = load_fleet(self._path)
                require_node(fleet, self._node, self._path)
            except ConfigError as error:
                _log.warning("reload node=%s refused: %s", self._node, error)
                problem = f"the changed fleet file is not in force: {error}"
                self._post(ev.ProblemReported(source=SOURCE, problem=problem))
                return
            self._post(ev.ProblemReported(source=SOURCE, problem=None))
            self._post(ev.FleetChanged(fleet=fleet))
