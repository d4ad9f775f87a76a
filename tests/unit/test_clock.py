"""The one clock: monotonic, counting suspended time too, comparable with the kernel's own figure."""

from __future__ import annotations

import re
import time
from datetime import UTC, datetime
from pathlib import Path

from zsched.clock import monotonic_s, wall_tenths, wall_time


def test_monotonic_s_never_goes_back() -> None:
    readings = [monotonic_s() for _ in range(1000)]
    assert readings == sorted(readings)


def test_monotonic_s_is_boot_time_suspend_included() -> None:
    before = time.clock_gettime(time.CLOCK_BOOTTIME)
    reading = monotonic_s()
    assert before <= reading <= time.clock_gettime(time.CLOCK_BOOTTIME)


def test_a_blank_state_s_first_incarnation_is_finer_than_a_daemon_can_start() -> None:
    before = time.time() * 10
    assert before - 1 <= wall_tenths() <= time.time() * 10


def test_wall_time_is_rfc_3339_in_utc_with_milliseconds() -> None:
    text = wall_time()
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z", text)
    assert abs((datetime.now(UTC) - datetime.fromisoformat(text)).total_seconds()) < 60


READS_CLOCKS = {"lab", "tasks", "clock.py"}
LAB_HELPERS = {"adapters/cgroup.py"}  # its clock bounds the removal of the lab's own groups


def test_nothing_else_in_the_daemon_reads_a_clock() -> None:
    """Floors 1 to 4 take `now` as an argument or call `zsched.clock`; the lab may do as it likes."""
    package = Path(__file__).parents[2] / "zsched"
    reads = re.compile(r"\btime\.(time|monotonic|perf_counter|clock_gettime)(_ns)?\(|\bdatetime\.(now|utcnow)\(")
    others = {
        path.relative_to(package).as_posix(): match.group()
        for path in sorted(package.rglob("*.py"))
        if path.parts[len(package.parts)] not in READS_CLOCKS
        and path.relative_to(package).as_posix() not in LAB_HELPERS
        for match in [reads.search(path.read_text())]
        if match
    }
    assert others == {}
