"""Whether a worker lacks anything."""

from __future__ import annotations

import pytest

from support.profiles import load_of
from zsched.core.gateway.shortfall import SHORT_RATIO, is_short, shows_lack
from zsched.core.values.profile import Jobs, WorkerLoad


def test_who_gets_less_than_its_threads_want_is_short() -> None:
    def load(cores: float | None, wanted: float | None) -> WorkerLoad:
        return load_of(cpu_cores=cores, wanted_cores=wanted)

    assert is_short(load(1.0, 4.0))
    assert is_short(load(0.8 * SHORT_RATIO, 0.9)), "whatever it wants"
    assert not is_short(load(3.99, 4.0))
    assert not is_short(load(1.0, None))
    assert is_short(load(None, 1.0))


@pytest.mark.parametrize(("done_hz", "expected"), [(8.9, True), (10 * SHORT_RATIO, False), (10.0, False)])
def test_who_leaves_a_tenth_of_its_jobs_undone_is_short(done_hz: float, expected: bool) -> None:
    jobs = Jobs(time_s=0.1, cpu_s=0.1, done_hz=done_hz, wanted_hz=10.0)
    assert is_short(load_of(cpu_cores=0.9, jobs=jobs)) is expected


def test_undone_jobs_alone_show_no_lack_of_cpu() -> None:
    jobs = Jobs(time_s=0.1, cpu_s=0.1, done_hz=1.0, wanted_hz=10.0)
    assert not shows_lack(load_of(jobs=jobs))
    assert shows_lack(load_of(jobs=jobs, wanted_cores=1.0))
    assert shows_lack(load_of(jobs=Jobs(time_s=0.1, cpu_s=0.1, wait_s=0.0)))
    assert not shows_lack(load_of(wanted_cores=1.0))
