"""Opens the session of the host's own side, and goes on trying until its router is there.

Knows: one zenoh configuration, how to wait. Does not know: what flows over the session.

A client's `zenoh.open` fails at once when nobody listens; the host's router may come up later than the relay, or after
it, and the node's workers must be served meanwhile. Once open, zenoh itself reconnects.
"""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Callable
from typing import Final

import zenoh

from zsched.core.values.events import ProblemReported
from zsched.core.values.relay_protocol import RelayReport
from zsched.host.guard import guarded
from zsched.link.sessions.problems import why_not_open

RETRY_S: Final = 0.5
SOURCE: Final = "relay/local"

_log = logging.getLogger("zsched.relay")


class LocalSide:
    """The session of the host's side, opened in a thread of its own."""

    def __init__(
        self, config: str, report: Callable[[RelayReport], None], on_open: Callable[[zenoh.Session], None]
    ) -> None:
        """``config`` is JSON text; ``on_open`` is called once, from that thread."""
        self._config = config
        self._report = report
        self._on_open = on_open
        self._session: zenoh.Session | None = None
        self._stop = threading.Event()
        self._thread = guarded(self._run, name="local side")
        self._thread.start()

    def close(self) -> None:
        """Stop trying, or close the session (may take as long as a stopped peer holds it)."""
        self._stop.set()
        if self._session is not None:
            with contextlib.suppress(zenoh.ZError):
                self._session.close()

    def _run(self) -> None:
        told = ""
        while not self._stop.is_set():
            try:
                session = self._session or zenoh.open(zenoh.Config.from_json5(self._config))
            except (zenoh.ZError, ValueError) as error:
                problem = f"the host's own side {why_not_open(self._config, error)}"
                if not told:
                    self._report(ProblemReported(source=SOURCE, problem=problem))
                told = problem
                self._stop.wait(RETRY_S)
                continue
            self._session = session
            if told:
                self._report(ProblemReported(source=SOURCE, problem=None))
            _log.info("the host's own side is joined")
            self._on_open(session)
            return
