"""The taker: puts what another cell gives as an output of its own task, under ``<cell>/<name>``.

Knows: `zsched.worker`. Does not know: who gives, by which gateway it comes.
"""

from __future__ import annotations

import threading
from typing import Final

from zsched.core.route.keyexpr import is_wild
from zsched.core.values.plan import WorkerRole
from zsched.errors import AdapterError
from zsched.tasks.crossing.parcels import LASTING, NOT_OWNER, TAKEN, Had, given_key, parts_of
from zsched.worker import Output, Request, Worker

LOOK_S: Final = 0.05
"""How often a taker looks whether it is to end its epoch."""
DEPTH: Final = 64
"""Requests that wait; each giver has one under way."""
MAX_KEYS: Final = 4096
NO_LEASE: Final = "a task that takes streams must say `exclusive: true` (docs/guide/scale.md); nothing is taken"


class Taker:
    """One output per key, declared when its first sample comes."""

    def __init__(self, worker: Worker, *, is_latest: bool) -> None:
        self._worker, self._is_latest = worker, is_latest
        self._lock = threading.Lock()
        self._outputs: dict[str, Output] = {}
        self._had = Had()

    def run(self, cells: tuple[str, ...]) -> None:
        """Take what these cells give until the worker is told to stop."""
        for cell in cells:
            self._worker.serve(given_key("{prefix}", cell, "**"), self.on_request, depth=DEPTH)
        self._worker.ready()
        while self._worker.wait(LOOK_S):
            self.end_epoch()

    def end_epoch(self) -> None:
        """Nothing more comes in an epoch that drains: what is given from now on is the next owner's."""
        with self._lock:
            if self._worker.role.role is WorkerRole.DRAINING:
                self._worker.drained()

    def on_request(self, request: Request) -> bytes:
        """Put one sample; a question for any key asks only whether we are here.

        Only on a lease: an owner that was left and does not know it yet would put what the robots do not admit.

        Raises:
            AdapterError: the task has no lease; or for good (`LASTING`): there are too many keys, or the key is none.
        """
        key = parts_of(request.key)[1]
        with self._lock:
            role = self._worker.role
            if role.role is not WorkerRole.ACTIVE:
                return NOT_OWNER.encode()
            if role.lease_until_s is None:
                raise AdapterError(NO_LEASE)
            if is_wild(key) or self._had.has(request.parameters):
                return TAKEN.encode()
            output = self._outputs.get(key) or self._declare(key)
            payload = request.payload or b""
            if not output.put(payload, attachment=request.attachment, encoding=request.encoding or None):
                return NOT_OWNER.encode()
            self._had.note(request.parameters)
            return TAKEN.encode()

    def _declare(self, key: str) -> Output:
        if len(self._outputs) >= MAX_KEYS:
            raise AdapterError(f"{LASTING}{key}: {MAX_KEYS} keys have come already")
        try:
            output = self._worker.publisher(
                f"{{prefix}}/{{epoch}}/{key}", latest=self._is_latest, reliable=not self._is_latest
            )
        except ValueError as error:  # a brace in a key is none of the library's placeholders
            raise AdapterError(f"{LASTING}{key}: {error}") from error
        self._outputs[key] = output
        return output
