"""nl80211 messages built here from the uapi numbers, hostile bytes, and the kernel's own controller family for real."""

from __future__ import annotations

import random
import re
import struct
from pathlib import Path

import pytest

from zsched.host.radio import nl80211
from zsched.host.radio.nl80211 import GenericNetlink, Nl80211Error, Station

HEADERS = (Path("/usr/include/linux/nl80211.h"), Path("/usr/include/linux/genetlink.h"))


def attribute(kind: int, value: bytes) -> bytes:
    return struct.pack("=HH", 4 + len(value), kind) + value + bytes(-len(value) % 4)


def message(kind: int, payload: bytes, *, flags: int = 2, sequence: int = 1) -> bytes:
    return struct.pack("=IHHII", 16 + len(payload), kind, flags, sequence, 0) + payload + bytes(-len(payload) % 4)


def station_payload(*, signal: int = -57, packets: int = 1000, retries: int = 40) -> bytes:
    rate = attribute(1, struct.pack("=H", 1300)) + attribute(5, struct.pack("=I", 8667)) + attribute(2, b"\x09")
    info = (
        attribute(7, struct.pack("=b", signal))
        + attribute(13, struct.pack("=b", -60))
        + attribute(8 | 0x8000, rate)
        + attribute(14 | 0x8000, attribute(1, struct.pack("=H", 540)))
        + attribute(10, struct.pack("=I", packets))
        + attribute(11, struct.pack("=I", retries))
        + attribute(12, struct.pack("=I", 3))
        + attribute(2, struct.pack("=I", 5))
    )
    generic = struct.pack("=BBH", 19, 1, 0)
    return (
        generic
        + attribute(3, struct.pack("=I", 4))
        + attribute(6, bytes.fromhex("0a1b2c3d4e5f"))
        + attribute(21 | 0x8000, info)
    )


def test_station_is_read_with_the_wide_bitrate() -> None:
    assert nl80211.parse_station(station_payload()) == Station(
        mac="0a:1b:2c:3d:4e:5f",
        signal_dbm=-57.0,
        tx_mbps=866.7,
        tx_packets=1000,
        tx_retries=40,
    )


def test_pyroute2_reads_the_same_of_a_station() -> None:
    reference = pytest.importorskip("pyroute2.netlink.nl80211", reason="a development dependency: make test brings it")
    theirs = reference.nl80211cmd(message(30, station_payload()))
    theirs.decode()
    info = theirs.get_attr("NL80211_ATTR_STA_INFO")
    rates = [info.get_attr(f"NL80211_STA_INFO_{way}_BITRATE") for way in ("TX", "RX")]
    assert nl80211.parse_station(station_payload()) == Station(
        mac=theirs.get_attr("NL80211_ATTR_MAC"),
        signal_dbm=info.get_attr("NL80211_STA_INFO_SIGNAL"),
        tx_mbps=rates[0].get_attr("NL80211_RATE_INFO_BITRATE32") / 10,
        tx_packets=info.get_attr("NL80211_STA_INFO_TX_PACKETS"),
        tx_retries=info.get_attr("NL80211_STA_INFO_TX_RETRIES"),
    )


@pytest.mark.parametrize(("state", "is_on"), [(0, False), (1, True), (None, None)])
def test_power_save_is_read(state: int | None, is_on: bool | None) -> None:
    told = b"" if state is None else attribute(93, struct.pack("=I", state))
    assert nl80211.parse_power_save(struct.pack("=BBH", 62, 1, 0) + told) is is_on


def test_pyroute2_asks_for_stations_in_the_same_bytes() -> None:
    reference = pytest.importorskip("pyroute2.netlink.nl80211", reason="a development dependency: make test brings it")
    theirs = reference.nl80211cmd()
    theirs["cmd"], theirs["version"] = reference.NL80211_NAMES["NL80211_CMD_GET_STATION"], 1
    theirs["attrs"] = [("NL80211_ATTR_IFINDEX", 4)]
    theirs["header"]["type"], theirs["header"]["sequence_number"] = 30, 7
    theirs["header"]["flags"] = nl80211.NLM_F_REQUEST | nl80211.NLM_F_DUMP
    theirs.encode()
    ours = {int(nl80211.Attr.IFINDEX): struct.pack("=I", 4)}
    asked = nl80211.request(30, nl80211.Command.GET_STATION, ours, flags=nl80211.NLM_F_DUMP, sequence=7)
    assert asked == bytes(theirs.data)


def test_interface_is_read_and_one_without_a_name_left_out() -> None:
    generic = struct.pack("=BBH", 7, 1, 0)
    named = generic + attribute(3, struct.pack("=I", 4)) + attribute(4, b"wlan0\0") + attribute(5, struct.pack("=I", 2))
    assert nl80211.parse_interface(named) == nl80211.Interface(index=4, name="wlan0")
    assert nl80211.parse_interface(generic + attribute(5, struct.pack("=I", 10))) is None


def test_datagram_is_split_into_its_messages() -> None:
    data = message(30, station_payload()) + message(3, struct.pack("=i", 0))
    first, done = nl80211.parse_messages(data)
    assert (first.kind, done.kind, done.sequence) == (30, 3, 1)
    assert nl80211.parse_station(first.payload).signal_dbm == -57.0
    assert nl80211.parse_messages(b"") == ()


@pytest.mark.parametrize(
    "data",
    [b"\1", message(1, b"")[:15], struct.pack("=IHHII", 15, 1, 0, 0, 0), struct.pack("=IHHII", 2**31, 1, 0, 0, 0)],
)
def test_malformed_datagram_is_a_typed_error(data: bytes) -> None:
    with pytest.raises(Nl80211Error):
        nl80211.parse_messages(data)


def test_hostile_bytes_are_parsed_or_refused_and_never_more() -> None:
    rng = random.Random(80211)
    whole = message(30, station_payload()) + message(3, struct.pack("=i", 0))
    refused = 0
    for _ in range(20_000):
        data = bytearray(whole if rng.random() < 0.9 else rng.randbytes(rng.randrange(200)))
        for _ in range(rng.randrange(1, 8)):
            if data:
                data[rng.randrange(len(data))] = rng.randrange(256)
        data = data[: rng.randrange(len(data) + 1)] if rng.random() < 0.3 else data
        try:
            for found in nl80211.parse_messages(bytes(data)):
                nl80211.parse_station(found.payload)
                nl80211.parse_interface(found.payload)
        except Nl80211Error:
            refused += 1
    assert 1000 < refused < 20_000


def test_error_message_names_the_kernels_reason() -> None:
    refusal = nl80211.parse_messages(message(2, struct.pack("=i", -1) + bytes(16)))[0]
    with pytest.raises(Nl80211Error, match="not permitted"):
        nl80211._check_end(refusal)
    nl80211._check_end(nl80211.parse_messages(message(2, struct.pack("=i", 0) + bytes(16)))[0])
    with pytest.raises(Nl80211Error):
        nl80211._check_end(nl80211.parse_messages(message(2, b""))[0])


def test_numbers_are_those_of_the_installed_headers() -> None:
    if not all(path.exists() for path in HEADERS):
        pytest.skip("the kernel's headers (linux-libc-dev) are not installed")
    text = re.sub(r"/\*.*?\*/", "", HEADERS[0].read_text(), flags=re.DOTALL)
    for prefix, members in (
        ("NL80211_CMD_", nl80211.Command),
        ("NL80211_ATTR_", nl80211.Attr),
        ("NL80211_STA_INFO_", nl80211.StationInfo),
        ("NL80211_RATE_INFO_", nl80211.RateInfo),
    ):
        for member in members:
            assert _enum_value(text, f"{prefix}{member.name}") == member.value, member


def _enum_value(text: str, name: str) -> int:
    for body in re.findall(r"enum \w+ \{(.*?)\}", text, flags=re.DOTALL):
        value = -1
        for entry in body.split(","):
            key, _, explicit = (part.strip() for part in entry.partition("="))
            value = value + 1 if not explicit.isdecimal() else int(explicit)
            if explicit and not explicit.isdecimal():
                value -= 1  # an alias such as NEW_X = another name
            if key == name:
                return value
    raise AssertionError(name)


def test_socket_speaks_to_the_kernels_controller() -> None:
    try:
        netlink = GenericNetlink("nlctrl")
    except Nl80211Error as error:
        pytest.skip(f"no generic netlink here: {error}")
    assert netlink.family_id == nl80211.GENL_ID_CTRL
    netlink.close()
