"""Asks the kernel's nl80211 for Wi-Fi interfaces and their stations, over its own few lines of generic netlink.

Parsing is separate from the socket and takes any bytes: what is malformed becomes an `Nl80211Error`, nothing else.
It is tested on byte strings built from the kernel's uapi headers and on the kernel's own controller family, but has
not yet run on wireless hardware.

Knows: linux/netlink.h, linux/genetlink.h, linux/nl80211.h (numbers below). Does not know: links, peers, samples.
"""

from __future__ import annotations

import itertools
import os
import socket
import struct
from collections.abc import Iterator
from enum import IntEnum

from zsched.core.values.errors import AdapterError
from zsched.core.values.struct import Struct

NETLINK_GENERIC = 16
GENL_ID_CTRL = 0x10
NLMSG_ERROR, NLMSG_DONE = 2, 3
NLM_F_REQUEST, NLM_F_ACK, NLM_F_DUMP = 0x1, 0x4, 0x300
NLM_F_DUMP_INTR = 0x10
NLA_TYPE_MASK = 0x3FFF
"""Without the flags "nested" and "network byte order"."""
HEADER = struct.Struct("=IHHII")
"""struct nlmsghdr: length, type, flags, sequence, port."""
GENERIC_HEADER = struct.Struct("=BBH")
"""struct genlmsghdr: command, version, reserved."""
ATTRIBUTE = struct.Struct("=HH")
"""struct nlattr: length, type."""
RECEIVE_BYTES = 65536
MAX_DATAGRAMS = 64
"""A dump of more (about 2 MiB) is no Wi-Fi network's."""
TIMEOUT_S = 0.2


class Ctrl(IntEnum):
    """linux/genetlink.h: the controller family."""

    CMD_GETFAMILY = 3
    ATTR_FAMILY_ID = 1
    ATTR_FAMILY_NAME = 2


class Command(IntEnum):
    """linux/nl80211.h: enum nl80211_commands."""

    GET_INTERFACE = 5
    GET_STATION = 17
    GET_POWER_SAVE = 62


class Attr(IntEnum):
    """linux/nl80211.h: enum nl80211_attrs."""

    IFINDEX = 3
    IFNAME = 4
    MAC = 6
    STA_INFO = 21
    PS_STATE = 93


class StationInfo(IntEnum):
    """linux/nl80211.h: enum nl80211_sta_info."""

    SIGNAL = 7
    TX_BITRATE = 8
    TX_PACKETS = 10
    TX_RETRIES = 11
    SIGNAL_AVG = 13


class RateInfo(IntEnum):
    """linux/nl80211.h: enum nl80211_rate_info (both in 100 kbit/s)."""

    BITRATE = 1
    BITRATE32 = 5


class Nl80211Error(AdapterError):
    """The kernel refused, did not answer, or sent bytes that make no sense."""


class Message(Struct, frozen=True, kw_only=True):
    """One netlink message without its header."""

    kind: int
    flags: int
    sequence: int
    payload: bytes


class Interface(Struct, frozen=True, kw_only=True):
    """One wireless interface."""

    index: int
    name: str


class Station(Struct, frozen=True, kw_only=True):
    """One radio peer of an interface: the access point of a client, a client of an access point, a mesh neighbour."""

    mac: str
    signal_dbm: float | None = None
    tx_mbps: float | None = None
    tx_packets: int | None = None
    tx_retries: int | None = None


# --- bytes to values -------------------------------------------------------------------------------------------------


def parse_messages(data: bytes) -> tuple[Message, ...]:
    """Split one datagram into its messages. Raises `Nl80211Error` when the lengths make no sense."""
    messages = []
    offset = 0
    while offset < len(data):
        if len(data) - offset < HEADER.size:
            raise Nl80211Error(f"netlink: {len(data) - offset} bytes at {offset} are no header")
        length, kind, flags, sequence, _ = HEADER.unpack_from(data, offset)
        if not HEADER.size <= length <= len(data) - offset:
            raise Nl80211Error(f"netlink: a message of {length} bytes at {offset} of {len(data)}")
        payload = data[offset + HEADER.size : offset + length]
        messages.append(Message(kind=kind, flags=flags, sequence=sequence, payload=payload))
        offset += _aligned(length)
    return tuple(messages)


def parse_attributes(data: bytes) -> dict[int, bytes]:
    """A row of attributes as ``{type: value}``. Raises `Nl80211Error` when the lengths make no sense."""
    attributes = {}
    offset = 0
    while len(data) - offset >= ATTRIBUTE.size:
        length, kind = ATTRIBUTE.unpack_from(data, offset)
        if not ATTRIBUTE.size <= length <= len(data) - offset:
            raise Nl80211Error(f"netlink: an attribute of {length} bytes at {offset} of {len(data)}")
        attributes[kind & NLA_TYPE_MASK] = data[offset + ATTRIBUTE.size : offset + length]
        offset += _aligned(length)
    return attributes


def parse_interface(payload: bytes) -> Interface | None:
    """One NL80211_CMD_NEW_INTERFACE; ``None`` for a device without a name (P2P). Raises `Nl80211Error`."""
    attributes = parse_attributes(payload[GENERIC_HEADER.size :])
    index, name = _unsigned(attributes, Attr.IFINDEX), attributes.get(Attr.IFNAME)
    if index is None or name is None:
        return None
    return Interface(index=index, name=name.rstrip(b"\0").decode(errors="replace"))


def parse_station(payload: bytes) -> Station:
    """One NL80211_CMD_NEW_STATION. Raises `Nl80211Error`."""
    attributes = parse_attributes(payload[GENERIC_HEADER.size :])
    mac = attributes.get(Attr.MAC, b"")
    if len(mac) != 6:
        raise Nl80211Error(f"nl80211: a station with an address of {len(mac)} bytes")
    info = parse_attributes(attributes.get(Attr.STA_INFO, b""))
    signal_dbm = _signal(info, StationInfo.SIGNAL)
    return Station(
        mac=mac.hex(":"),
        signal_dbm=_signal(info, StationInfo.SIGNAL_AVG) if signal_dbm is None else signal_dbm,
        tx_mbps=_bitrate(info, StationInfo.TX_BITRATE),
        tx_packets=_unsigned(info, StationInfo.TX_PACKETS),
        tx_retries=_unsigned(info, StationInfo.TX_RETRIES),
    )


def parse_power_save(payload: bytes) -> bool | None:
    """The answer to NL80211_CMD_GET_POWER_SAVE: whether it is on; ``None``: not told. Raises `Nl80211Error`."""
    state = _unsigned(parse_attributes(payload[GENERIC_HEADER.size :]), Attr.PS_STATE)
    return None if state is None else state != 0


def request(kind: int, command: int, attributes: dict[int, bytes], *, flags: int, sequence: int) -> bytes:
    """One generic netlink request."""
    body = GENERIC_HEADER.pack(command, 1, 0)
    for attribute, value in attributes.items():
        length = ATTRIBUTE.size + len(value)
        body += ATTRIBUTE.pack(length, attribute) + value + bytes(_aligned(length) - length)
    return HEADER.pack(HEADER.size + len(body), kind, NLM_F_REQUEST | flags, sequence, 0) + body


def _aligned(length: int) -> int:
    return (length + 3) & ~3


def _unsigned(attributes: dict[int, bytes], kind: int) -> int | None:
    """An unsigned attribute of any width; ``None`` when absent. Raises `Nl80211Error` for an odd width."""
    value = attributes.get(kind)
    if value is None:
        return None
    if len(value) not in {1, 2, 4, 8}:
        raise Nl80211Error(f"nl80211: attribute {kind} is a number of {len(value)} bytes")
    return int.from_bytes(value, byteorder="little" if struct.pack("=H", 1)[0] else "big")


def _signal(info: dict[int, bytes], kind: int) -> float | None:
    """A signal: one signed byte, in dBm."""
    value = info.get(kind)
    return float(struct.unpack("=b", value)[0]) if value is not None and len(value) == 1 else None


def _bitrate(info: dict[int, bytes], kind: int) -> float | None:
    rate = parse_attributes(info.get(kind, b""))
    wide, narrow = _unsigned(rate, RateInfo.BITRATE32), _unsigned(rate, RateInfo.BITRATE)
    units = wide if wide is not None else narrow
    return None if units is None else units / 10.0


# --- the socket ------------------------------------------------------------------------------------------------------


class GenericNetlink:
    """A socket to one generic netlink family. Used by one thread."""

    def __init__(self, family: str = "nl80211") -> None:
        """Open the socket and look ``family`` up.

        Raises:
            Nl80211Error: no netlink here, or the kernel does not know the family (no wireless driver is loaded).
        """
        self._sequence = itertools.count(1)
        try:
            self._socket = socket.socket(socket.AF_NETLINK, socket.SOCK_RAW | socket.SOCK_CLOEXEC, NETLINK_GENERIC)
        except OSError as error:
            raise Nl80211Error(f"netlink: cannot open a socket: {error.strerror}") from error
        try:
            self._socket.settimeout(TIMEOUT_S)
            self._socket.bind((0, 0))
            self.family_id = self._look_up(family)
        except (OSError, Nl80211Error) as error:
            self._socket.close()
            raise Nl80211Error(f"{family}: {error}") from error

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()

    def interfaces(self) -> tuple[Interface, ...]:
        """All wireless interfaces. Raises `Nl80211Error`."""
        found = (parse_interface(message.payload) for message in self._dump(Command.GET_INTERFACE, {}))
        return tuple(interface for interface in found if interface is not None)

    def stations(self, index: int) -> tuple[Station, ...]:
        """The stations of the interface ``index``. Raises `Nl80211Error`."""
        attributes = {int(Attr.IFINDEX): struct.pack("=I", index)}
        return tuple(parse_station(message.payload) for message in self._dump(Command.GET_STATION, attributes))

    def power_save(self, index: int) -> bool | None:
        """Whether the interface ``index`` may sleep between beacons; ``None``: not told. Raises `Nl80211Error`."""
        attributes = {int(Attr.IFINDEX): struct.pack("=I", index)}
        answers = self._ask(self.family_id, Command.GET_POWER_SAVE, attributes, NLM_F_ACK)
        told = [parse_power_save(message.payload) for message in answers]
        return next((state for state in told if state is not None), None)

    def _look_up(self, family: str) -> int:
        name = {int(Ctrl.ATTR_FAMILY_NAME): family.encode("ascii") + b"\0"}
        for message in self._ask(GENL_ID_CTRL, Ctrl.CMD_GETFAMILY, name, NLM_F_ACK):
            attributes = parse_attributes(message.payload[GENERIC_HEADER.size :])
            if (family_id := _unsigned(attributes, Ctrl.ATTR_FAMILY_ID)) is not None:
                return family_id
        raise Nl80211Error("the kernel did not name the family's number")

    def _dump(self, command: int, attributes: dict[int, bytes]) -> Iterator[Message]:
        return self._ask(self.family_id, command, attributes, NLM_F_DUMP)

    def _ask(self, kind: int, command: int, attributes: dict[int, bytes], flags: int) -> Iterator[Message]:
        sequence = next(self._sequence)
        try:
            self._socket.send(request(kind, command, attributes, flags=flags, sequence=sequence))
            for _ in range(MAX_DATAGRAMS):
                for message in parse_messages(self._socket.recv(RECEIVE_BYTES)):
                    if message.sequence != sequence:
                        continue  # an answer to a request that we gave up
                    if message.kind in {NLMSG_ERROR, NLMSG_DONE}:
                        _check_end(message)
                        return
                    if message.flags & NLM_F_DUMP_INTR:
                        raise Nl80211Error("netlink: the dump changed while it was read")
                    yield message
        except OSError as error:
            raise Nl80211Error(f"netlink: {error}") from error
        raise Nl80211Error(f"netlink: no end after {MAX_DATAGRAMS} datagrams")


def _check_end(message: Message) -> None:
    """Raise the error that an NLMSG_ERROR carries (NLMSG_DONE may carry one, too); 0 is the acknowledgement."""
    if len(message.payload) < 4:
        if message.kind == NLMSG_ERROR:
            raise Nl80211Error("netlink: an error message without its number")
        return
    code = struct.unpack_from("=i", message.payload)[0]
    if code != 0:
        raise Nl80211Error(f"the kernel answers {os.strerror(abs(code))!r} (no such driver, or not permitted)")
