"""Every source of a link's figure, from files of the real formats; nothing may raise."""

from __future__ import annotations

import gzip
from pathlib import Path

import pytest

from zsched.core.values.fleet import LinkSpec, NodeSpec
from zsched.core.values.model import NodeKind
from zsched.core.values.profile import LinkSample, LinkSource
from zsched.host.radio import network_profiler
from zsched.host.radio.network_profiler import (
    MAX_TRACE_BYTES,
    LinkReader,
    choose_station,
    parse_trace,
    parse_wireless,
    readers_for,
    retry_ratio,
)
from zsched.host.radio.nl80211 import GenericNetlink, Interface, Nl80211Error, Station

WIRELESS = """Inter-| sta-|   Quality        |   Discarded packets               | Missed | WE
 face | tus | link level noise |  nwid  crypt   frag  retry   misc | beacon | 22
 wlan0: 0000   54.  -56.  -256        0      0      0      0     16        0
 wlan1: 0000   54.  200.  0        0      0      0      0     16        0
 wlan2: 0000   54.  60.  0        0      0      0      0     16        0
"""
HEADER = "time_step, time_stamp ,robot_pos_x,c_rssi,  s_rssi ,\n"
START_NS = 1617812348714050000


def row(seconds: float, c_rssi: str, s_rssi: str = "-50") -> str:
    return f"814, {START_NS + round(seconds * 1e9)}   ,-0.05,  {c_rssi}  ,{s_rssi},\n"


DRIVE = HEADER + row(0, "-2") + row(0.5, "-60") + row(1.0, "") + row(1.5, "-256") + row(2.0, "-61.5") + row(9.0, "-70")


class Clock:
    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


def node(*links: LinkSpec) -> NodeSpec:
    return NodeSpec(name="robot1", kind=NodeKind.ROBOT, links=links)


def test_wired_and_fixed_links_are_constant() -> None:
    links = (
        LinkSpec(source=LinkSource.WIRED),
        LinkSpec(source=LinkSource.FIXED, peer="edge1", value="-47.5"),
        LinkSpec(source=LinkSource.FIXED, value="strong"),
    )
    wired, fixed, wrong = readers_for(node(*links))
    assert wired.read() == LinkSample(source=LinkSource.WIRED)
    assert fixed.read() == LinkSample(source=LinkSource.FIXED, peer="edge1", rssi_dbm=-47.5)
    assert wrong.read().rssi_dbm is None
    assert wrong.problem is not None
    assert "strong" in wrong.problem


def problem_of(reader: LinkReader) -> str | None:
    return reader.problem


def test_wireless_file_is_read_by_interface(tmp_path: Path) -> None:
    (reader,) = readers_for(node(LinkSpec(source=LinkSource.WIRELESS, value="wlan0")), root=tmp_path)
    assert reader.read().rssi_dbm is None
    assert problem_of(reader) is not None
    (tmp_path / "proc/net").mkdir(parents=True)
    (tmp_path / "proc/net/wireless").write_text(WIRELESS)
    assert reader.read() == LinkSample(source=LinkSource.WIRELESS, rssi_dbm=-56.0)
    assert problem_of(reader) is None
    assert parse_wireless(WIRELESS, "wlan9") is None
    assert parse_wireless("", "wlan0") is None


def test_wifi_falls_back_to_the_wireless_file_and_says_so(tmp_path: Path) -> None:
    try:
        GenericNetlink().close()
        pytest.skip("this machine has a wireless driver: the fallback does not come into play")
    except Nl80211Error:
        pass
    (tmp_path / "proc/net").mkdir(parents=True)
    (tmp_path / "proc/net/wireless").write_text(WIRELESS)
    (reader,) = readers_for(node(LinkSpec(source=LinkSource.NL80211, value="wlan0", peer="edge1")), root=tmp_path)
    assert reader.read() == LinkSample(source=LinkSource.WIRELESS, peer="edge1", rssi_dbm=-56.0)
    assert reader.problem is not None
    assert "nl80211" in reader.problem
    reader.close()


def test_a_kernel_without_nl80211_is_asked_for_it_seldom(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It starts a process to look for the module, each time; a radio is read five times a second."""
    asked, now = [], [1000.0]

    def refused() -> None:
        asked.append(now[0])
        raise Nl80211Error("nl80211: netlink: No such file or directory")

    monkeypatch.setattr(network_profiler, "GenericNetlink", refused)
    monkeypatch.setattr(network_profiler, "awake_s", lambda: now[0])
    (reader,) = readers_for(node(LinkSpec(source=LinkSource.NL80211, value="wlan0")), root=tmp_path)
    for _ in range(200):
        reader.read()
        assert "nl80211: netlink" in str(reader.problem)
        now[0] += 0.2
    assert asked == pytest.approx([1000.0, 1030.0], abs=0.3)


@pytest.mark.parametrize("signal_dbm", [None, -61.0])
def test_a_driver_that_tells_no_signal_is_a_problem(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, signal_dbm: float | None
) -> None:
    """Without a signal the link counts as not measured, and the status must say why."""

    class Netlink:
        def interfaces(self) -> list[Interface]:
            return [Interface(index=3, name="wlan0")]

        def stations(self, _index: int) -> list[Station]:
            return [Station(mac="0a:00:00:00:00:01", signal_dbm=signal_dbm)]

        def close(self) -> None:
            pass

    monkeypatch.setattr(network_profiler, "GenericNetlink", Netlink)
    (reader,) = readers_for(node(LinkSpec(source=LinkSource.NL80211, value="wlan0")), root=tmp_path)
    assert reader.read().rssi_dbm == signal_dbm
    told = "wlan0: its driver tells no signal of 0a:00:00:00:00:01"
    assert reader.problem == (told if signal_dbm is None else None)


def test_station_is_chosen_by_address_or_the_weakest() -> None:
    near = Station(mac="0a:00:00:00:00:01", signal_dbm=-40.0)
    far = Station(mac="0a:00:00:00:00:02", signal_dbm=-70.0)
    silent = Station(mac="0a:00:00:00:00:03")
    assert choose_station([near, far, silent], "0A:00:00:00:00:01") is near
    assert choose_station([near, far, silent], "") is far
    with pytest.raises(Nl80211Error, match="not connected"):
        choose_station([near], far.mac)
    with pytest.raises(Nl80211Error):
        choose_station([], "")


def test_retry_ratio_is_a_difference_of_one_station() -> None:
    before = Station(mac="a", tx_packets=100, tx_retries=10)
    assert retry_ratio(before, Station(mac="a", tx_packets=190, tx_retries=20)) == 0.1
    assert retry_ratio(None, before) is None
    assert retry_ratio(before, before) is None
    assert retry_ratio(before, Station(mac="b", tx_packets=190, tx_retries=20)) is None
    assert retry_ratio(before, Station(mac="a", tx_packets=5, tx_retries=20)) is None
    assert retry_ratio(before, Station(mac="a")) is None


@pytest.mark.parametrize("suffix", [".csv", ".csv.gz"])
def test_trace_is_replayed_by_elapsed_time_and_loops(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"drive{suffix}"
    path.write_bytes(gzip.compress(DRIVE.encode()) if suffix.endswith("gz") else DRIVE.encode())
    clock = Clock()
    spec = LinkSpec(source=LinkSource.TRACE, value=str(path), peer="edge1")
    (reader,) = readers_for(node(spec), clock=clock)
    assert reader.read() == LinkSample(source=LinkSource.TRACE, peer="edge1")
    values = {}
    for elapsed_s in (0.4, 0.5, 1.2, 1.9, 2.0, 3.9, 4.1, 8.9, 9.0, 10.7, 10.9, 11.4):
        clock.now = 1000.0 + elapsed_s
        values[elapsed_s] = reader.read().rssi_dbm
    assert values == {
        0.4: None,  # only "no sample yet" so far
        0.5: -60.0,
        1.2: -60.0,  # empty and absent fields are skipped
        1.9: -60.0,
        2.0: -61.5,
        3.9: -61.5,
        4.1: None,  # held for two seconds, no longer
        8.9: None,
        9.0: -70.0,
        10.7: -70.0,
        10.9: None,  # the second loop (9 s and one mean step of 1.8 s)
        11.4: -60.0,
    }


def test_trace_starts_at_its_offset_and_by_its_column(tmp_path: Path) -> None:
    path = tmp_path / "drive.csv"
    path.write_text(HEADER + row(0, "-60", "-41") + row(1, "-61", "-42") + row(2, "-62", "-43"))
    spec = LinkSpec(source=LinkSource.TRACE, value=str(path), column="s_rssi", offset_s=1.0)
    (reader,) = readers_for(node(spec), clock=Clock())
    assert reader.read().rssi_dbm == -42.0


def test_trace_rows_out_of_order_or_broken_do_no_harm() -> None:
    text = HEADER + row(2, "-62") + row(0, "-60") + "\n" + "1,x,2,-50,\n" + "814\n" + row(1, "nan") + row(1, "-61")
    trace = parse_trace(text, "c_rssi")
    assert trace.rssi_dbm == (-60.0, -61.0, -62.0)
    assert [trace.at(t) for t in (0.0, 1.0, 2.0)] == [-60.0, -61.0, -62.0]


@pytest.mark.parametrize(
    ("content", "word"),
    [
        (b"", "time_stamp"),
        (HEADER.encode(), "no row"),
        (b"time_stamp,other\n1,2\n", "c_rssi"),
        (b"\x1f\x8b\x08\x00 damaged", ""),
        (gzip.compress(DRIVE.encode())[:-20], "no whole gzip file"),
        (gzip.compress(bytes(MAX_TRACE_BYTES + 1)), "unpacked it holds more than 32 MiB"),
    ],
    ids=["empty", "no row", "no column", "damaged", "cut", "bomb"],
)
def test_unusable_trace_is_a_reader_with_a_problem(tmp_path: Path, content: bytes, word: str) -> None:
    path = tmp_path / ("drive.csv.gz" if content.startswith(b"\x1f\x8b") else "drive.csv")
    path.write_bytes(content)
    (reader,) = readers_for(node(LinkSpec(source=LinkSource.TRACE, value=str(path))))
    assert reader.read() == LinkSample(source=LinkSource.TRACE)
    assert reader.problem is not None
    assert word in reader.problem
    assert str(path) in reader.problem
