"""Maps that no sane robot sends: every shape, value, resolution and origin that the codec lets through must merge."""

from __future__ import annotations

import json
import logging
import math
import random
from collections.abc import Callable

import numpy as np
import pytest

from zsched.tasks.map_merge.cdr import decode_grid, encode_grid
from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import Grid
from zsched.tasks.map_merge.merger import Merger, MergeResult, MergerSettings, Mode
from zsched.tasks.map_merge.service import MapMergeService, Output

View = Callable[[tuple[float, float, float, float], Pose2], Grid]
_VALUES = (
    np.array([-1, 0, 100], dtype=np.int8),
    np.array([-128, -2, 127, 101], dtype=np.int8),
    np.array([100], dtype=np.int8),
    np.array([-1], dtype=np.int8),
    np.array([50], dtype=np.int8),
)


def _hostile(generator: random.Random) -> Grid:
    height, width = generator.choice(((0, 0), (1, 1), (1, 300), (300, 1), (40, 60), (7, 0), (160, 120)))
    values = generator.choice(_VALUES)
    data = np.random.default_rng(generator.randrange(2**32)).choice(values, size=(height, width))
    reach = generator.choice((1.0, 50.0, 1e4, 1e8))
    origin = Pose2(
        x=generator.uniform(-reach, reach), y=generator.uniform(-reach, reach), yaw=generator.uniform(-math.pi, math.pi)
    )
    return Grid(
        data=data,
        resolution=generator.choice((0.005, 0.05, 0.0501, 0.1, 0.3, 5.0 if height * width < 400 else 0.2)),
        origin=origin,
    )


@pytest.mark.parametrize("mode", list(Mode))
@pytest.mark.parametrize("seed", range(6))
def test_hostile_maps_never_stop_the_merge_of_a_good_one(
    view: View, mode: Mode, seed: int, caplog: pytest.LogCaptureFixture
) -> None:
    """Replay with the seed in the test's name."""
    generator = random.Random(seed)
    sent: dict[Output, bytes] = {}

    def publish(output: Output, payload: bytes, attachment: bytes | None = None) -> bool:
        assert attachment is None or json.loads(attachment)
        sent[output] = payload
        return True

    now = [0.0]
    poses = {} if mode is Mode.ESTIMATE else {f"robot{n}": Pose2(x=n) for n in range(1, 5)}
    service = MapMergeService(
        MergerSettings(mode=mode, poses=poses), publish, clock=lambda: now[0], spawn=lambda work: work()
    )
    service.receive("robot1", encode_grid(view((0.0, 0.0, 8.0, 8.0), Pose2())))
    with caplog.at_level(logging.WARNING):
        for _ in range(4):
            for robot in ("robot2", "robot3", "robot4"):
                service.receive(robot, encode_grid(_hostile(generator)))
            now[0] += 1.0
            service.step(is_active=True)
    assert caplog.records == []
    assert json.loads(sent[Output.STATUS])["robots"]["robot1"]["state"] == "attached"
    assert np.count_nonzero(decode_grid(sent[Output.GLOBAL_MAP]).occupied) > 500


class _Tripped(Merger):
    """A merger with a bug that one robot's map sets off."""

    def merge(self) -> MergeResult:
        if self._grids.get("robot2") is not None:
            raise ZeroDivisionError
        return super().merge()


def test_map_that_trips_a_bug_is_left_out_and_the_others_go_on(view: View) -> None:
    sent: dict[Output, bytes] = {}

    def publish(output: Output, payload: bytes, attachment: bytes | None = None) -> bool:
        assert attachment is None or json.loads(attachment)
        sent[output] = payload
        return True

    settings = MergerSettings(mode=Mode.KNOWN, poses={"robot1": Pose2(), "robot2": Pose2()})
    now = [0.0]
    service = MapMergeService(settings, publish, clock=lambda: now[0])
    service._merger = _Tripped(settings, searches_itself=False)
    grid = encode_grid(view((0.0, 0.0, 8.0, 8.0), Pose2()))
    service.receive("robot1", grid)
    service.step(is_active=True)
    service.receive("robot2", grid)
    now[0] += 1.0
    service.step(is_active=True)
    now[0] += 1.0
    assert service.step(is_active=True)
    robots = json.loads(sent[Output.STATUS])["robots"]
    assert robots["robot1"]["state"] == "attached"
    assert "failed" in robots["robot2"]["last_error"]
