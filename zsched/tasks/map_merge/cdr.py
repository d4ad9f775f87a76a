"""ROS 2 messages as bytes: nav_msgs/msg/OccupancyGrid and tf2_msgs/msg/TFMessage in CDR.

Knows: plain CDR (XCDR1: 4-byte encapsulation header, alignment from behind it, at most 8), both byte orders read,
little endian written. Does not know: transports, merging.

Everything that comes from a robot is checked before it is used; bytes that are no such message raise `CdrError` and
nothing else. Source: OMG DDS-XTypes 1.3, 7.4; message definitions of ROS 2 common_interfaces and geometry2.
"""

from __future__ import annotations

import math
import struct

import numpy as np

from zsched.core.values.errors import WireError
from zsched.core.values.struct import Struct
from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import MAX_CELLS, MAX_SIDE_CELLS, Grid

_LITTLE, _BIG = b"\x00\x01", b"\x00\x00"
_HEADER = b"\x00\x01\x00\x00"
_NS = 1_000_000_000
MAX_STAMP_NS = (1 << 31) * _NS - 1
MAX_STRING = 4096
MAX_TRANSFORMS = 4096
MAX_TILT_RAD = 0.02
"""A grid whose plane is tilted more than this is no floor plan."""


class CdrError(WireError):
    """Bytes that are no valid message; ``reason`` is one short word for a counter."""


class StampedTransform(Struct, frozen=True, kw_only=True):
    """The pose of frame ``child`` in frame ``parent`` at ``stamp_ns`` (planar part of TransformStamped)."""

    parent: str
    child: str
    pose: Pose2
    stamp_ns: int = 0


def encode_grid(grid: Grid) -> bytes:
    """The grid as OccupancyGrid bytes; ``map_load_time`` is left at zero."""
    writer = _Writer()
    writer.header(grid.stamp_ns, grid.frame_id)
    writer.pack("iI", 0, 0)
    writer.pack("fII", grid.resolution, grid.width, grid.height)
    writer.pose(grid.origin)
    writer.pack("I", grid.data.size)
    writer.parts.append(np.ascontiguousarray(grid.data).tobytes())
    return b"".join(writer.parts)


def decode_grid(payload: bytes) -> Grid:
    """Read OccupancyGrid bytes; the cells are not copied.

    Raises:
        CdrError: not a valid message, or a grid that no map has (size, resolution, origin, tilt).
    """
    reader = _Reader(payload)
    stamp_ns, frame_id = reader.header()
    reader.unpack("iI")
    (resolution,) = reader.unpack("f")
    width, height = reader.count(), reader.count()
    origin = reader.pose()
    count = reader.count()
    if count != width * height:
        raise CdrError("size", f"{count} cells in a grid of {width} x {height}")
    if count > MAX_CELLS or max(width, height) > MAX_SIDE_CELLS:
        raise CdrError("size", f"{width} x {height} cells are too many")
    cells = np.frombuffer(reader.take(count), dtype=np.int8).reshape(height, width)
    reader.end()
    try:
        return Grid(
            data=cells,
            resolution=_shortest(resolution),
            origin=origin,
            stamp_ns=stamp_ns,
            frame_id=frame_id,
        )
    except ValueError as error:
        raise CdrError("range", str(error)) from error


def encode_transforms(transforms: tuple[StampedTransform, ...]) -> bytes:
    """The transforms as TFMessage bytes."""
    writer = _Writer()
    writer.pack("I", len(transforms))
    for transform in transforms:
        writer.header(transform.stamp_ns, transform.parent)
        writer.string(transform.child)
        writer.pose(transform.pose)
    return b"".join(writer.parts)


def decode_transforms(payload: bytes) -> tuple[StampedTransform, ...]:
    """Read TFMessage bytes (planar transforms only).

    Raises:
        CdrError: not a valid message, or a transform out of the plane.
    """
    reader = _Reader(payload)
    count = reader.count()
    if count > MAX_TRANSFORMS:
        raise CdrError("size", f"{count} transforms are more than {MAX_TRANSFORMS}")
    transforms = []
    for _ in range(count):
        stamp_ns, parent = reader.header()
        child = reader.string()
        transforms.append(StampedTransform(parent=parent, child=child, pose=reader.pose(), stamp_ns=stamp_ns))
    reader.end()
    return tuple(transforms)


def _shortest(value: float) -> float:
    """The shortest decimal that is the same float32: 0.05, not 0.05000000074505806."""
    return float(str(np.float32(value)))


class _Writer:
    """Appends little-endian CDR; ``parts`` joined are the message."""

    def __init__(self) -> None:
        self.parts: list[bytes] = [_HEADER]
        self._length = 0

    def _append(self, part: bytes) -> None:
        self.parts.append(part)
        self._length += len(part)

    def pack(self, codes: str, *values: float) -> None:
        """Append each value aligned to its own size."""
        for code, value in zip(codes, values, strict=True):
            size = struct.calcsize(code)
            self._append(bytes(-self._length % size) + struct.pack("<" + code, value))

    def string(self, text: str) -> None:
        raw = text.encode() + b"\x00"
        self.pack("I", len(raw))
        self._append(raw)

    def header(self, stamp_ns: int, frame_id: str) -> None:
        self.pack("iI", stamp_ns // _NS, stamp_ns % _NS)
        self.string(frame_id)

    def pose(self, pose: Pose2) -> None:
        self.pack("ddd", pose.x, pose.y, 0.0)
        self.pack("dddd", 0.0, 0.0, math.sin(pose.yaw / 2), math.cos(pose.yaw / 2))


class _Reader:
    """Takes CDR apart; every step checks its bounds."""

    def __init__(self, payload: bytes) -> None:
        kind = payload[:2]
        if len(payload) < 4 or kind not in (_LITTLE, _BIG):
            raise CdrError("encapsulation", f"header {payload[:4].hex() or 'missing'} is not plain CDR")
        self._order = "<" if kind == _LITTLE else ">"
        self._body = memoryview(payload)[4:]
        self._at = 0

    def take(self, count: int) -> memoryview:
        end = self._at + count
        if end > len(self._body):
            raise CdrError("truncated", f"{count} bytes at {self._at} of {len(self._body)}")
        part = self._body[self._at : end]
        self._at = end
        return part

    def unpack(self, codes: str) -> tuple[float, ...]:
        """Read each value aligned to its own size."""
        values: list[float] = []
        for code in codes:
            size = struct.calcsize(code)
            self.take(-self._at % size)
            values.extend(struct.unpack(self._order + code, self.take(size)))
        return tuple(values)

    def count(self) -> int:
        """Read a length or number (uint32)."""
        return int(self.unpack("I")[0])

    def string(self) -> str:
        length = self.count()
        if not 0 < length <= MAX_STRING:
            raise CdrError("string", f"length {length} is not in [1, {MAX_STRING}]")
        raw = bytes(self.take(length))
        if raw[-1] != 0 or 0 in raw[:-1]:
            raise CdrError("string", "not ended by its only zero byte")
        try:
            return raw[:-1].decode()
        except UnicodeDecodeError as error:
            raise CdrError("string", "not UTF-8") from error

    def header(self) -> tuple[int, str]:
        seconds, nanoseconds = (int(value) for value in self.unpack("iI"))
        if nanoseconds >= _NS:
            raise CdrError("stamp", f"{nanoseconds} ns in a stamp")
        return seconds * _NS + nanoseconds, self.string()

    def pose(self) -> Pose2:
        """A pose, or the translation and rotation of a transform: laid out alike."""
        x, y, _z = self.unpack("ddd")
        return Pose2(x=_finite(x), y=_finite(y), yaw=_yaw(*self.unpack("dddd")))

    def end(self) -> None:
        """Trailing bytes: up to 3 of padding are legal, more is another message."""
        if len(self._body) - self._at > 3:
            raise CdrError("trailing", f"{len(self._body) - self._at} bytes behind the message")


def _finite(value: float) -> float:
    if not math.isfinite(value):
        raise CdrError("range", "a pose that is not finite")
    return value


def _yaw(x: float, y: float, z: float, w: float) -> float:
    """The yaw of a quaternion; any length but zero is taken and normalised."""
    norm = math.hypot(x, y, z, w)
    if not math.isfinite(norm) or norm < 1e-6:
        raise CdrError("orientation", "the quaternion has no length")
    x, y, z, w = x / norm, y / norm, z / norm, w / norm
    if 2 * math.hypot(x, y) > MAX_TILT_RAD:
        raise CdrError("orientation", "the map is tilted out of the plane")
    return math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
