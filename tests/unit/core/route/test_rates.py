"""Rates of streams out of the relay's totals."""

from __future__ import annotations

from zsched.core.route.rates import StreamRates
from zsched.core.values.plan import StreamCount


def fed(*totals: tuple[float, int]) -> StreamRates:
    rates = StreamRates()
    for at, messages in totals:
        rates.absorb([StreamCount(stream="echo/in/0", messages=messages, bytes=10 * messages)], at)
    return rates


def test_a_rate_is_the_mean_over_the_last_seconds() -> None:
    rates = fed(*((100.0 + second, 50 * second) for second in range(4)), *((104.0 + s, 150) for s in range(3)))
    assert rates.of("echo/in/0", 106.0) == (100 / 5, 1000 / 5), "since 101.0, five seconds before the newest"


def test_nothing_is_known_of_one_total_of_no_stream_and_after_silence() -> None:
    assert fed((100.0, 5)).of("echo/in/0", 100.0) is None
    rates = fed((100.0, 5), (101.0, 6))
    assert rates.of("echo/out/0", 101.0) is None
    assert rates.of("echo/in/0", 105.9) == (1.0, 10.0)
    assert rates.of("echo/in/0", 106.1) is None


def test_another_relay_counts_from_zero() -> None:
    rates = fed((100.0, 500), (101.0, 550), (102.0, 7))
    assert rates.of("echo/in/0", 102.0) is None
    rates.absorb([StreamCount(stream="echo/in/0", messages=17, bytes=170)], 103.0)
    assert rates.of("echo/in/0", 103.0) == (10.0, 100.0)
