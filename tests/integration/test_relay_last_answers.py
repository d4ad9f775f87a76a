"""Acknowledgements overtake answers: what an owner has acknowledged has its answer all the same when the owner dies.

The worker's session lets no large answer out: it has put them, they wait, and its acknowledgements pass.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from support.relay_rig import Application, Rig, relay_rig, slot
from support.waiting import until
from zsched.core.values.plan import OnCrash, RoutePhase, StreamClass, WorkerRole

LARGE = 1000
NO_LARGE_ANSWERS = f"""{{low_pass_filter: [{{
    flows: ["egress"], messages: ["put"], size_limit: {LARGE},
    key_exprs: ["edge1/echo/*/*/out", "edge1/echo/*/*/out/@zsched/again/*"],
}}]}}"""
PATIENCE_S = 0.7
"""An acknowledgement that goes before the answers comes within a tenth of this."""


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with relay_rig(tmp_path) as made:
        yield made


@pytest.mark.long
@pytest.mark.parametrize("on_crash", [OnCrash.REPLAY, OnCrash.REPORT])
@pytest.mark.parametrize("is_first", [False, True])
def test_no_answer_is_missing_of_what_a_dead_owner_had_acknowledged(
    rig: Rig, on_crash: OnCrash, is_first: bool
) -> None:
    """Also at the very beginning, when the owner has not heard yet who gets its answers."""
    worker = rig.start_worker("edge1", operator_json5=NO_LARGE_ANSWERS)
    rig.start_worker("edge2")
    app = Application(rig.app)
    first = slot(1, "edge1", StreamClass.RELIABLE, 1, on_crash=on_crash)
    second = slot(2, "edge2", StreamClass.RELIABLE, 1, on_crash=on_crash)
    rig.move(first)
    until(app.connected, "the application sees the relay's subscription")
    for _ in range(0 if is_first else 20):
        app.put()
    until(lambda: len(app.back) == app.sent, "answers that pass")
    app.padding = bytes(2 * LARGE)
    for _ in range(30):
        app.put()
    until(lambda: rig.told("echo/in/0").messages == app.sent, "every input")
    end = time.monotonic() + PATIENCE_S
    while rig.told("echo/in/0").in_flight and time.monotonic() < end:
        time.sleep(0.01)
    worker.kill()
    worker.wait(60)
    rig.plan(RoutePhase.PREPARE, second)
    rig.role("edge2", WorkerRole.ACTIVE, 2)
    rig.move(second)
    for _ in range(5):
        app.put()
    until(lambda: app.sent - 1 in app.back, "the stream through edge2")
    until(lambda: rig.told("echo/in/0").in_flight == 0, "every acknowledgement")
    missing = app.sent - len(set(app.back))
    told = rig.told("echo/in/0")
    if on_crash is OnCrash.REPLAY:
        assert (missing, told.lost, told.at_most_lost, told.drops) == (0, 0, 0, ())
        assert app.back == sorted(app.back)
    else:
        assert missing == 30
        assert told.at_most_lost == 30
