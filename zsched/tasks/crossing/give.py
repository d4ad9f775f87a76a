"""The giver: has every input sample taken by another cell before it counts as processed.

Knows: `zsched.worker`, the order of things. Does not know: zenoh, how a gateway is reached.
"""

from __future__ import annotations

import secrets
import time
from typing import Final

from zsched.clock import monotonic_s
from zsched.core.values.plan import WorkerRole
from zsched.errors import AdapterError
from zsched.tasks.crossing.parcels import Parcel, has_been_in
from zsched.tasks.crossing.ways import Ways
from zsched.worker import Received, Worker

REACH_S: Final = 12.0
"""A giver that has reached nobody for so long ends and says why, before it is ended for not being ready (20 s)."""
LOOK_S: Final = 1.0


class Giver:
    """Gives one sample after another; a sample that nobody takes for ``patience_s`` is dropped, and told."""

    def __init__(self, worker: Worker, cell: str, ways: Ways, patience_s: float) -> None:
        """``cell``: the other one."""
        self._worker, self._cell, self._ways, self._patience_s = worker, cell, ways, patience_s
        self._life, self._number = secrets.token_hex(8), 0
        self._gate = worker.publisher("{prefix}/{epoch}/@given")
        """What is put here goes to nobody: no wildcard matches the chunk, ours neither. It says whether this worker is
        the owner, and where it is not, the sample in hand is given once it is."""

    def run(self) -> str:
        """Give until the worker is told to stop; empty, or why no taker has answered: before that it is not ready."""
        end = monotonic_s() + REACH_S
        while why := self._ways.reach():
            if not self._worker.wait(LOOK_S):
                return ""
            if monotonic_s() >= end:
                return f"{self._cell} cannot be reached: {why}"
        self._worker.subscribe("{prefix}/**", self.on_sample)
        self._worker.ready()
        while self._worker.wait(1.0):
            pass
        return ""

    def on_sample(self, received: Received) -> None:
        """Give one sample, in the dispatch thread: the next one waits.

        Raises:
            AdapterError: it is dropped; `zsched status` tells the newest reason and how many were.
        """
        if not self._gate.put(b""):
            return
        name = received.key.removeprefix(f"{self._worker.prefix}/")
        if has_been_in(name, self._cell):
            raise AdapterError(f"{name} does not cross to {self._cell}: it has come from there")
        if received.deleted:
            raise AdapterError(f"{name} was deleted: that does not cross to {self._cell}")
        self._number += 1
        parcel = Parcel(
            name=name,
            life=self._life,
            number=self._number,
            payload=received.payload,
            attachment=received.attachment,
            encoding=received.encoding,
        )
        why = self._ways.give(parcel, self._patience_s, self._goes_on)
        if why and self._gate.put(b""):
            raise AdapterError(f"{name} was dropped: {self._cell} did not take it: {why}")

    def _goes_on(self, pause_s: float) -> bool:
        """Not behind the end of our slot: what nobody has taken by then is the next owner's."""
        time.sleep(pause_s)
        return self._worker.role.role is not WorkerRole.IDLE
