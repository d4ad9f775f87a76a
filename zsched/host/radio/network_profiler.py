"""Reads what a node's links are worth right now: Wi-Fi signal, a wire, a fixed figure, or a recorded drive.

Every source has one interface, `LinkReader`. A read never raises: what could not be read is a sample without a signal,
and `LinkReader.problem` says why. Values are raw; only codes that mean "no sample" are left out. Impossible values and
outliers are the core's to drop.

Knows: nl80211, /proc/net/wireless, the traces' CSV. Does not know: smoothing, limits (Eq. 3), who uses the link.
"""

from __future__ import annotations

import bisect
import csv
import io
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

from zsched.core.values.fleet import LinkSpec, NodeSpec
from zsched.core.values.profile import LinkSample, LinkSource
from zsched.core.values.struct import Struct
from zsched.host.clock import awake_s, monotonic_s
from zsched.host.files import read_packed
from zsched.host.radio.nl80211 import GenericNetlink, Nl80211Error, Station

NO_SAMPLE = frozenset({-2.0, -256.0})
"""In recorded drives: no sample yet, interface absent."""
MAX_TRACE_BYTES = 32 << 20
"""A recorded drive, unpacked: a day at 5 Hz takes 20 MB."""
ASK_AGAIN_S = 30.0
"""A kernel without nl80211 is asked again after this time: an adapter may be plugged in later."""
TRACE_HOLD_S = 2.0
"""A recorded value stands for this long when the rows behind it have none; then nothing is measured."""


class LinkReader(Protocol):
    """One link, however it is measured. Used by one thread."""

    @property
    def problem(self) -> str | None:
        """Why the last read has no signal (or came from the fallback); ``None``: all is well."""

    def read(self) -> LinkSample:
        """Measure now; never raises."""

    def close(self) -> None:
        """Give files and sockets back."""


def readers_for(
    node: NodeSpec, *, root: Path = Path("/"), clock: Callable[[], float] = monotonic_s
) -> tuple[LinkReader, ...]:
    """One reader per link of ``node``, in the fleet file's order. ``root`` and ``clock`` are for tests."""
    return tuple(_reader(spec, root, clock) for spec in node.links)


def _reader(spec: LinkSpec, root: Path, clock: Callable[[], float]) -> LinkReader:
    match spec.source:
        case LinkSource.NL80211:
            return WifiReader(spec, root)
        case LinkSource.WIRELESS:
            return WirelessReader(spec, root)
        case LinkSource.TRACE:
            return TraceReader(spec, clock)
        case LinkSource.FIXED | LinkSource.WIRED:
            return ConstantReader(spec)


class ConstantReader:
    """A wire (no signal, counts 1), or a fixed figure in dBm."""

    def __init__(self, spec: LinkSpec) -> None:
        self.problem: str | None = None
        rssi_dbm = None
        if spec.source is LinkSource.FIXED:
            try:
                rssi_dbm = float(spec.value)
            except ValueError:
                self.problem = f"fixed: {spec.value!r} is no number of dBm"
        self._sample = LinkSample(source=spec.source, peer=spec.peer, rssi_dbm=rssi_dbm)

    def read(self) -> LinkSample:
        """The same sample, always."""
        return self._sample

    def close(self) -> None:
        """Nothing to give back."""


# --- Wi-Fi -----------------------------------------------------------------------------------------------------------


class WirelessReader:
    """The signal that /proc/net/wireless shows for an interface (wireless extensions; many kernels lack them)."""

    def __init__(self, spec: LinkSpec, root: Path = Path("/")) -> None:
        self.problem: str | None = None
        self._spec, self._path = spec, root / "proc/net/wireless"

    def read(self) -> LinkSample:
        """The level in dBm as the driver states it."""
        self.problem, rssi_dbm = None, None
        try:
            level = parse_wireless(self._path.read_text(encoding="ascii", errors="replace"), self._spec.value)
        except OSError as error:
            self.problem = f"{self._path}: {error.strerror}"
        else:
            rssi_dbm = None if level is None else wireless_dbm(level)
            if rssi_dbm is None:
                why = "does not list it" if level is None else f"shows {level:g}, which is no dBm"
                self.problem = f"{self._spec.value}: {self._path} {why}"
        return LinkSample(source=LinkSource.WIRELESS, peer=self._spec.peer, rssi_dbm=rssi_dbm)

    def close(self) -> None:
        """Nothing to give back."""


def parse_wireless(text: str, interface: str) -> float | None:
    """The level of ``interface`` in a /proc/net/wireless (third column after its name); ``None``: not listed."""
    for line in text.splitlines()[2:]:
        name, separator, rest = line.partition(":")
        fields = rest.split()
        if not separator or name.strip() != interface or len(fields) < 3:
            continue
        try:
            return float(fields[2].rstrip("."))
        except ValueError:
            return None
    return None


def wireless_dbm(level: float) -> float | None:
    """The level in dBm; some drivers state it modulo 256. ``None`` for one in units of the driver's own."""
    if level <= 0.0:
        return level
    return level - 256.0 if level >= 128.0 else None


class WifiReader:
    """The signal, bitrate and retries that nl80211 shows for a station; /proc/net/wireless where there is no nl80211.

    The station is the one with the spec's address, or else the only one (a client's access point); of several, the
    weakest: the link's figure stands for the way to everybody.
    """

    def __init__(self, spec: LinkSpec, root: Path = Path("/")) -> None:
        self.problem: str | None = None
        self._spec = spec
        self._fallback = WirelessReader(spec, root)
        self._netlink: GenericNetlink | None = None
        self._refused: Nl80211Error | None = None
        self._ask_at = -math.inf
        self._before: Station | None = None

    def read(self) -> LinkSample:
        """Ask the kernel; on failure ask the fallback."""
        try:
            station = self._station()
        except Nl80211Error as error:
            self.close()
            sample = self._fallback.read()
            other = self._fallback.problem
            self.problem = f"{self._spec.value}: {error}" + (f"; {other}" if other else " (read /proc/net/wireless)")
            return sample
        self.problem = None
        if station.signal_dbm is None:
            self.problem = f"{self._spec.value}: its driver tells no signal of {station.mac}"
        before, self._before = self._before, station
        return LinkSample(
            source=LinkSource.NL80211,
            peer=self._spec.peer,
            rssi_dbm=station.signal_dbm,
            bitrate_mbps=station.tx_mbps,
            retry_ratio=retry_ratio(before, station),
        )

    def close(self) -> None:
        """Close the netlink socket; the next read opens a fresh one."""
        if self._netlink is not None:
            self._netlink.close()
            self._netlink = None

    def _station(self) -> Station:
        self._netlink = self._netlink or self._opened()
        index = next((found.index for found in self._netlink.interfaces() if found.name == self._spec.value), None)
        if index is None:
            raise Nl80211Error("there is no such wireless interface")
        return choose_station(self._netlink.stations(index), self._spec.mac)

    def _opened(self) -> GenericNetlink:
        """A socket that knows nl80211; a kernel without it looks for a module each time, by a process of its own."""
        now = awake_s()
        if self._refused is not None and now < self._ask_at:
            raise self._refused
        try:
            return GenericNetlink()
        except Nl80211Error as error:
            self._refused, self._ask_at = error, now + ASK_AGAIN_S
            raise


def choose_station(stations: Sequence[Station], mac: str) -> Station:
    """The station with the address ``mac``, or of all the one with the weakest known signal.

    Raises:
        Nl80211Error: there is none.
    """
    wanted = [station for station in stations if not mac or station.mac == mac.lower()]
    if not wanted:
        raise Nl80211Error(f"the station {mac} is not connected" if mac else "no station is connected")
    return min(wanted, key=lambda station: 0.0 if station.signal_dbm is None else station.signal_dbm)


def retry_ratio(before: Station | None, after: Station) -> float | None:
    """Retries per attempt between two readings of one station, [0, 1]; ``None`` when nothing was sent or counted."""
    if before is None or before.mac != after.mac:
        return None
    packets, retries = _increase(before.tx_packets, after.tx_packets), _increase(before.tx_retries, after.tx_retries)
    if packets is None or retries is None or packets + retries == 0:
        return None
    return retries / (packets + retries)


def _increase(before: int | None, after: int | None) -> int | None:
    """How far a counter went on; ``None`` when it is missing or started again (the radio joined again)."""
    return None if before is None or after is None or after < before else after - before


# --- recorded drives -------------------------------------------------------------------------------------------------


class Trace(Struct, frozen=True, kw_only=True):
    """A recorded drive: seconds since its first row (rising) and dBm, one per valid row; ``duration_s`` of one loop."""

    times_s: tuple[float, ...]
    rssi_dbm: tuple[float, ...]
    duration_s: float

    def at(self, elapsed_s: float) -> float | None:
        """The newest value at ``elapsed_s`` into the drive, which loops; ``None`` where nothing was measured."""
        position_s = elapsed_s % self.duration_s
        index = bisect.bisect_right(self.times_s, position_s) - 1
        if index < 0 or position_s - self.times_s[index] > TRACE_HOLD_S:
            return None
        return self.rssi_dbm[index]


def parse_trace(text: str, column: str) -> Trace:
    """Read a drive's CSV: a header, ``time_stamp`` in nanoseconds, ``column`` in dBm.

    Fields may be padded with blanks or empty, lines may end in a comma; rows without a valid value only tell the time.

    Raises:
        ValueError: a column is missing, or no row is valid.
    """
    rows = csv.reader(io.StringIO(text))
    header = [name.strip() for name in next(rows, [])]
    for name in ("time_stamp", column):
        if name not in header:
            raise ValueError(f"there is no column {name!r}; there are {', '.join(filter(None, header))[:200]}")
    time_column, value_column = header.index("time_stamp"), header.index(column)
    stamps_ns: list[float] = []
    valid: list[tuple[float, float]] = []
    for row in rows:
        stamp_ns, rssi_dbm = _field(row, time_column), _field(row, value_column)
        if stamp_ns is None or stamp_ns <= 0.0:
            continue
        stamps_ns.append(stamp_ns)
        if rssi_dbm is not None and rssi_dbm not in NO_SAMPLE:
            valid.append((stamp_ns, rssi_dbm))
    if not valid:
        raise ValueError(f"no row has a value in {column!r}")
    first_ns, valid = min(stamps_ns), sorted(valid)
    span_s = (max(stamps_ns) - first_ns) / 1e9
    step_s = span_s / max(1, len(stamps_ns) - 1)
    return Trace(
        times_s=tuple((stamp_ns - first_ns) / 1e9 for stamp_ns, _ in valid),
        rssi_dbm=tuple(rssi_dbm for _, rssi_dbm in valid),
        duration_s=span_s + (step_s or 1.0),
    )


def _field(row: Sequence[str], column: int) -> float | None:
    """One field as a finite number; ``None`` when it is short, empty or none."""
    try:
        value = float(row[column])
    except (ValueError, IndexError):
        return None
    return value if math.isfinite(value) else None


class TraceReader:
    """Replays a recorded drive (CSV or CSV.gz) by the time since the first read."""

    def __init__(self, spec: LinkSpec, clock: Callable[[], float] = monotonic_s) -> None:
        self.problem: str | None = None
        self._spec, self._clock = spec, clock
        self._begin_s: float | None = None
        self._trace: Trace | None = None
        try:
            self._trace = parse_trace(read_text(Path(spec.value)), spec.column)
        except (OSError, ValueError, csv.Error) as error:
            reason = (error.strerror if isinstance(error, OSError) else None) or error
            self.problem = f"trace {spec.value}: {reason}"

    def read(self) -> LinkSample:
        """The recorded signal at this point of the drive."""
        now = self._clock()
        self._begin_s = now if self._begin_s is None else self._begin_s
        rssi_dbm = None if self._trace is None else self._trace.at(now - self._begin_s + self._spec.offset_s)
        return LinkSample(source=LinkSource.TRACE, peer=self._spec.peer, rssi_dbm=rssi_dbm)

    def close(self) -> None:
        """Nothing to give back."""


def read_text(path: Path) -> str:
    """A drive's CSV, unpacked if its name ends in ``.gz``. Raises `OSError`, also over `MAX_TRACE_BYTES`."""
    return read_packed(path, MAX_TRACE_BYTES).decode("utf-8", errors="replace")
