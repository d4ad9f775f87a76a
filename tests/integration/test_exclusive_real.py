"""Exclusive tasks on real daemons: the lease lives in the worker, and a frozen owner stops by itself."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from zsched_lab.fleet.testbed import Testbed, echo_fleet


@pytest.fixture
def bed(tmp_path: Path) -> Iterator[Testbed]:
    with Testbed(tmp_path, echo_fleet(task={"exclusive": True})) as testbed:
        testbed.init()
        testbed.start()
        yield testbed


class Witness:
    """Robot applications' traffic, and a recorder that sees what every owner puts out, whoever admits it."""

    def __init__(self, bed: Testbed) -> None:
        self.session = bed.app("robot1")
        self.raw: list[tuple[str, float]] = []
        self.admitted: list[float] = []
        self._pub = self.session.declare_publisher("robot1/in")
        self._subs = [
            self.session.declare_subscriber("*/echo/*/robot1/out", self._on_raw),
            self.session.declare_subscriber("robot1/out", lambda _sample: self.admitted.append(time.monotonic())),
        ]
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _on_raw(self, sample: zenoh.Sample) -> None:
        self.raw.append((str(sample.key_expr).split("/")[0], time.monotonic()))

    def _run(self) -> None:
        number = 0
        while not self._stop.wait(0.01):
            self._pub.put(f"{number:010d}".encode())
            number += 1

    def stop(self) -> None:
        self._stop.set()
        self._thread.join(60)

    def newest(self, node: str) -> float | None:
        return max((at for name, at in self.raw if name == node), default=None)

    def first(self, node: str) -> float | None:
        return min((at for name, at in self.raw if name == node), default=None)


def test_frozen_owner_stops_working_before_the_next_one_starts(bed: Testbed) -> None:
    """SIGSTOP of the owner's daemon only: its worker runs on, but its lease ends; no two workers' outputs overlap."""
    owner = bed.wait_settled()
    witness = Witness(bed)
    bed.wait(lambda: len(witness.admitted) > 50, 60, "echoes")
    bed.send(owner, signal.SIGSTOP)
    others = [node for node in bed.names if node != owner]
    moved = bed.wait(lambda: _next_owner(bed, owner, others), 60, "another owner") or ""
    bed.wait(lambda: witness.newest(moved), 60, f"outputs of {moved}")
    bed.send(owner, signal.SIGCONT)
    at = time.monotonic()
    bed.wait(lambda: time.monotonic() > at + 2, 60, "two more seconds")
    witness.stop()
    last, first = witness.newest(owner), witness.first(moved)
    assert last is not None
    assert first is not None
    assert last < first, f"{owner} worked {last - first:.3f} s into {moved}'s time"
    assert max(witness.admitted) > at, "the stream goes on"


def _next_owner(bed: Testbed, owner: str, others: list[str]) -> str | None:
    now = bed.owner(*others)
    return now if now not in (None, owner) else None


def test_planned_move_of_an_exclusive_task_hands_over_without_overlap(bed: Testbed) -> None:
    """SIGTERM drains the owner: it releases its lease, so the move does not wait for the lease to end."""
    owner = bed.wait_settled()
    witness = Witness(bed)
    bed.wait(lambda: len(witness.admitted) > 50, 60, "echoes")
    bed.stop(owner)
    others = [node for node in bed.names if node != owner]
    moved = bed.wait(lambda: _next_owner(bed, owner, others), 60, "another owner") or ""
    bed.wait(lambda: witness.newest(moved), 60, f"outputs of {moved}")
    witness.stop()
    last, first = witness.newest(owner), witness.first(moved)
    assert last is not None
    assert first is not None
    assert last < first
