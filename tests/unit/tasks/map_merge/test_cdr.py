"""OccupancyGrid and TFMessage bytes against the reference implementation, in both byte orders, and under mutation."""

from __future__ import annotations

import contextlib
import math
import random
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from zsched.tasks.map_merge.cdr import (
    CdrError,
    StampedTransform,
    decode_grid,
    decode_transforms,
    encode_grid,
    encode_transforms,
)
from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import Grid

_STORE = get_typestore(Stores.ROS2_JAZZY)
_GRID, _TF = "nav_msgs/msg/OccupancyGrid", "tf2_msgs/msg/TFMessage"
_frames = st.text(st.characters(codec="utf-8", exclude_characters="\x00"), max_size=20)


def _type(name: str) -> Any:
    return _STORE.types[name]


def _header(stamp_ns: int, frame_id: str) -> Any:
    stamp = _type("builtin_interfaces/msg/Time")(sec=stamp_ns // 10**9, nanosec=stamp_ns % 10**9)
    return _type("std_msgs/msg/Header")(stamp=stamp, frame_id=frame_id)


def _quaternion(yaw: float) -> Any:
    return _type("geometry_msgs/msg/Quaternion")(x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2))


def _reference_grid(grid: Grid) -> Any:
    pose = _type("geometry_msgs/msg/Pose")(
        position=_type("geometry_msgs/msg/Point")(x=grid.origin.x, y=grid.origin.y, z=0.0),
        orientation=_quaternion(grid.origin.yaw),
    )
    info = _type("nav_msgs/msg/MapMetaData")(
        map_load_time=_type("builtin_interfaces/msg/Time")(sec=0, nanosec=0),
        resolution=grid.resolution,
        width=grid.width,
        height=grid.height,
        origin=pose,
    )
    return _type(_GRID)(header=_header(grid.stamp_ns, grid.frame_id), info=info, data=grid.data.ravel())


def _reference_bytes(message: Any, kind: str, *, is_little: bool = True) -> bytes:
    return bytes(_STORE.serialize_cdr(message, kind, little_endian=is_little))


def _grid(width: int = 7, height: int = 5, frame_id: str = "robot1/map") -> Grid:
    data = np.random.default_rng(3).choice(np.array([-1, 0, 100], dtype=np.int8), size=(height, width))
    return Grid(
        data=data,
        resolution=0.05,
        origin=Pose2(x=-3.25, y=12.5, yaw=0.7),
        stamp_ns=1_700_000_000_123,
        frame_id=frame_id,
    )


@given(st.integers(0, 9), st.integers(0, 9), _frames)
def test_grid_bytes_equal_the_reference(width: int, height: int, frame_id: str) -> None:
    grid = _grid(width, height, frame_id)
    assert encode_grid(grid) == _reference_bytes(_reference_grid(grid), _GRID)


def test_reference_reads_our_grid() -> None:
    grid = _grid()
    message: Any = _STORE.deserialize_cdr(encode_grid(grid), _GRID)
    assert message.header.frame_id == "robot1/map"
    assert message.info.width == 7
    assert np.array_equal(message.data, grid.data.ravel())


@given(_frames, _frames, st.integers(0, 3))
def test_transform_bytes_equal_the_reference(parent: str, child: str, count: int) -> None:
    ours = tuple(
        StampedTransform(parent=parent, child=child, pose=Pose2(x=i, y=-i, yaw=0.1 * i), stamp_ns=i)
        for i in range(count)
    )
    theirs = _type(_TF)(
        transforms=[
            _type("geometry_msgs/msg/TransformStamped")(
                header=_header(one.stamp_ns, one.parent),
                child_frame_id=one.child,
                transform=_type("geometry_msgs/msg/Transform")(
                    translation=_type("geometry_msgs/msg/Vector3")(x=one.pose.x, y=one.pose.y, z=0.0),
                    rotation=_quaternion(one.pose.yaw),
                ),
            )
            for one in ours
        ]
    )
    assert encode_transforms(ours) == _reference_bytes(theirs, _TF)
    for is_little in (True, False):
        read = decode_transforms(_reference_bytes(theirs, _TF, is_little=is_little))
        assert [(one.parent, one.child, one.stamp_ns) for one in read] == [
            (o.parent, o.child, o.stamp_ns) for o in ours
        ]
        assert [one.pose.yaw for one in read] == pytest.approx([one.pose.yaw for one in ours])


def test_quaternion_of_any_length_is_normalised() -> None:
    message = _reference_grid(_grid())
    for name in ("z", "w"):
        setattr(message.info.origin.orientation, name, 3.0 * getattr(message.info.origin.orientation, name))
    assert decode_grid(_reference_bytes(message, _GRID)).origin.yaw == pytest.approx(0.7)


def _broken(**changes: Any) -> bytes:
    message = _reference_grid(_grid())
    for path, value in changes.items():
        *parents, name = path.split("__")
        target = message
        for parent in parents:
            target = getattr(target, parent)
        object.__setattr__(target, name, value)
    return _reference_bytes(message, _GRID)


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"", "encapsulation"),
        (b"\x00\x01\x00", "encapsulation"),
        (b"\x00\x07\x00\x00" + bytes(200), "encapsulation"),  # XCDR2
        (encode_grid(_grid())[:-1], "truncated"),
        (encode_grid(_grid()) + bytes(4), "trailing"),
        (_broken(info__width=8), "size"),
        (_broken(info__resolution=0.0), "range"),
        (_broken(info__resolution=math.nan), "range"),
        (_broken(info__origin__position__x=math.inf), "range"),
        (_broken(info__origin__position__x=1e300), "range"),
        (_broken(info__origin__orientation__z=0.0, info__origin__orientation__w=0.0), "orientation"),
        (_broken(info__origin__orientation__x=0.5), "orientation"),
        (_broken(header__stamp__nanosec=2_000_000_000), "stamp"),
    ],
)
def test_malformed_grid_is_refused_with_its_reason(payload: bytes, reason: str) -> None:
    with pytest.raises(CdrError) as caught:
        decode_grid(payload)
    assert caught.value.reason == reason


def test_huge_size_is_refused_before_anything_is_allocated() -> None:
    raw = bytearray(encode_grid(Grid(data=np.zeros((0, 0), dtype=np.int8), resolution=0.05, frame_id="")))
    at = 4 + 8 + 8 + 8 + 4  # header; stamp; frame id and its padding; load time; resolution
    raw[at : at + 8] = (20_000).to_bytes(4, "little") * 2
    raw[-4:] = (20_000**2).to_bytes(4, "little")  # the count of cells, of which none follows
    with pytest.raises(CdrError) as caught:
        decode_grid(bytes(raw))
    assert caught.value.reason == "size"


@settings(max_examples=300)
@given(st.integers(0, 2**32))
def test_mutated_bytes_never_raise_anything_else(seed: int) -> None:
    generator = random.Random(seed)
    for encoded, decode in (
        (encode_grid(_grid()), decode_grid),
        (encode_transforms((StampedTransform(parent="world", child="a/map", pose=Pose2(x=1.0)),)), decode_transforms),
    ):
        raw = bytearray(encoded)
        for _ in range(generator.randint(1, 6)):
            raw[generator.randrange(len(raw))] = generator.choice((0, 1, 0x7F, 0x80, 0xFF, generator.randrange(256)))
        cut = raw[: generator.randint(0, len(raw))] if generator.random() < 0.3 else raw
        with contextlib.suppress(CdrError):
            decode(bytes(cut))
