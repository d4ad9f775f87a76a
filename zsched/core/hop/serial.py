"""Decides what a sample's number is, of which only the lowest 32 bits travel.

Knows: serial number arithmetic (RFC 1982) with zenoh's width. Does not know: streams, samples.

zenoh's source number is 32 bits wide: at 1 kHz it is used up after 49.7 days. Both ends of a hop count on without a
bound; what travels are the lowest bits, and the receiver takes the number nearest to the one it waits for. That is
right while the two ends are less than 2^31 samples apart; what is kept to be sent again is a few thousand.
"""

from __future__ import annotations

from typing import Final

BITS: Final = 32
"""Width of zenoh's source numbers."""
SPAN: Final = 1 << BITS
"""Source numbers start again after this many."""
_MASK: Final = SPAN - 1
_HALF: Final = SPAN >> 1


def serial_of(number: int) -> int:
    """The part of a number that travels.

    >>> serial_of(SPAN + 5)
    5
    """
    return number & _MASK


def number_near(serial: int, reference: int) -> int:
    """The number (0 or above) with the low bits of ``serial`` that is nearest to ``reference``.

    >>> number_near(2, SPAN - 1) - SPAN
    2
    >>> number_near(SPAN - 1, SPAN + 2) - SPAN
    -1
    >>> number_near(SPAN - 1, 0) == SPAN - 1
    True
    """
    ahead = (serial - reference) & _MASK
    number = reference + (ahead if ahead < _HALF else ahead - SPAN)
    return number if number >= 0 else number + SPAN
