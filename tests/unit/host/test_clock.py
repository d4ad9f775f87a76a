"""The one clock: monotonic, counting suspended time too, comparable with the kernel's own figure."""

from __future__ import annotations

import re
import time
from pathlib import Path

import pytest

from zsched.host import clock
from zsched.host.clock import ClockWatch, Drift, SleepWatch, monotonic_s, wall_tenths


def slept_s() -> float:
    """By the kernel, as nearly as one try can tell."""
    return time.clock_gettime(time.CLOCK_BOOTTIME) - time.clock_gettime(time.CLOCK_MONOTONIC)


def test_monotonic_s_is_the_raw_clock_suspend_included() -> None:
    before = time.clock_gettime(time.CLOCK_MONOTONIC_RAW)
    reading = monotonic_s()
    after = time.clock_gettime(time.CLOCK_MONOTONIC_RAW)
    assert before - 1e-4 <= reading - min(slept_s() for _ in range(100)) <= after + 0.1


def test_a_suspend_counts_and_a_process_put_aside_between_two_readings_does_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The kernel's three clocks, read by a process that is put aside for half a second at every fifth reading."""
    real = {"raw": 100.0, "slept": 7.0, "readings": 0}
    slewed = 1.083

    def read(clock: int) -> float:
        real["readings"] += 1
        real["raw"] += 0.5 if real["readings"] % 5 == 0 else 1e-6
        if clock == time.CLOCK_MONOTONIC_RAW:
            return real["raw"]
        return real["raw"] * slewed + (real["slept"] if clock == time.CLOCK_BOOTTIME else 0.0)

    monkeypatch.setattr(time, "clock_gettime", read)
    monkeypatch.setattr(clock._Slept, "seconds", 7.0)
    readings = [(monotonic_s(), real["raw"]) for _ in range(100)]
    assert all(told == pytest.approx(raw + 7.0, abs=1e-4) for told, raw in readings), "neither slewed nor put aside"
    real["slept"] = 67.0
    assert monotonic_s() == pytest.approx(real["raw"] + 67.0, abs=1e-4)


def test_a_sleep_is_told_once_as_soon_as_it_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    sleeps, real = SleepWatch(), clock._Slept.seconds
    monotonic_s()
    assert sleeps.look() == 0.0
    monkeypatch.setattr(clock._Slept, "seconds", real + 60.0)
    assert sleeps.look() == pytest.approx(60.0)
    assert sleeps.look() == 0.0, "once"


def watch(*readings: tuple[float, float]) -> list[Drift | None]:
    compared = ClockWatch()
    return [compared.judge(*reading) for reading in readings]


def test_a_slew_is_seen_within_two_readings_and_forgotten_after_a_window() -> None:
    slew = [(10.0 + 0.2 * n, 0.083 * 0.2 * max(min(n, 8) - 3, 0)) for n in range(16)]
    seen = watch(*slew)
    assert seen[0] is None
    rates = [drift.error_ratio for drift in seen[1:] if drift is not None]
    assert rates[:3] == pytest.approx([0.0] * 3)
    assert rates[3] == pytest.approx(0.083 / 4), "the first of four steps in the window"
    assert max(rates) == pytest.approx(0.083)
    assert rates[-3:] == pytest.approx([0.0] * 3)


def test_a_suspend_is_a_jump_as_long_as_it_took_at_once() -> None:
    seen = watch((10.0, 5.0), (10.2, 5.0), (10.4, 65.0), (10.6, 65.0))
    assert [None if drift is None else round(drift.jump_s, 6) for drift in seen] == [None, 0.0, 60.0, 0.0]
    assert [None if drift is None else round(drift.since_s, 6) for drift in seen] == [None, 0.2, 0.2, 0.2]
    assert [None if drift is None else drift.error_ratio for drift in seen] == [None, 0.0, 0.0, 0.0], "and no slew"


def test_two_readings_at_once_tell_nothing_and_a_long_gap_is_compared_all_the_same() -> None:
    assert watch((10.0, 5.0), (10.1, 5.0)) == [None, None]
    (_, drift) = watch((10.0, 5.0), (70.0, 5.6))
    assert drift is not None
    assert (drift.error_ratio, drift.since_s) == pytest.approx((0.01, 60.0))


def test_this_machine_s_clocks_can_be_compared_within_a_tenth_of_what_leases_allow_for() -> None:
    compared, until, found = ClockWatch(), time.monotonic() + 90.0, []
    while time.monotonic() < until:
        drift = compared.look()
        found += [] if drift is None else [abs(drift.jump_s)]
        if len(found) >= 3 and min(found) < 1e-4:
            return
        time.sleep(0.05)
    pytest.fail(f"{found}")


def test_a_blank_state_s_first_incarnation_is_finer_than_a_daemon_can_start() -> None:
    before = time.time() * 10
    assert before - 1 <= wall_tenths() <= time.time() * 10


READS_CLOCKS = {"tasks"}
OTHERS = {"host/clock.py", "host/machine/cgroup.py"}  # the second bounds the removal of the lab's own groups


def test_nothing_else_in_the_daemon_reads_a_clock() -> None:
    """Floors 1 to 4 take `now` as an argument or call `zsched.host.clock`; the lab may do as it likes."""
    package = Path(__file__).parents[3] / "zsched"
    reads = re.compile(r"\btime\.(time|monotonic|perf_counter|clock_gettime)(_ns)?\(|\bdatetime\.(now|utcnow)\(")
    others = {
        path.relative_to(package).as_posix(): match.group()
        for path in sorted(package.rglob("*.py"))
        if path.parts[len(package.parts)] not in READS_CLOCKS and path.relative_to(package).as_posix() not in OTHERS
        for match in [reads.search(path.read_text())]
        if match
    }
    assert others == {}
