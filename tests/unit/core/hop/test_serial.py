"""Numbers of which only the lowest 32 bits travel."""

from __future__ import annotations

import random

import pytest

from zsched.core.hop.serial import SPAN, number_near, serial_of


@pytest.mark.parametrize("reference", [0, 1, 1000, SPAN - 1, SPAN, SPAN + 1, 3 * SPAN - 2, 2**50])
def test_a_number_near_the_reference_comes_back_whole(reference: int) -> None:
    random_ = random.Random(reference)
    for distance in (0, 1, 2047, SPAN // 2 - 1, *(random_.randrange(SPAN // 2) for _ in range(200))):
        for number in (reference + distance, reference - distance):
            if number >= 0:
                assert number_near(serial_of(number), reference) == number


def test_no_serial_is_a_number_below_0() -> None:
    assert number_near(SPAN - 1, 0) == SPAN - 1
    assert number_near(SPAN // 2, 3) == SPAN // 2
