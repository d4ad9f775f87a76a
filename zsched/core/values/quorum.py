"""What a majority is: of robots that vote, of electors that promise."""

from __future__ import annotations


def majority(count: int) -> int:
    """The least number that is more than half of ``count``.

    >>> [majority(n) for n in (1, 2, 3, 4, 5)]
    [1, 2, 2, 3, 3]
    """
    return count // 2 + 1
