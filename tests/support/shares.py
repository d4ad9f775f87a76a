"""Shares of the long tests: CI runs one of a few for each commit, `make test-all` runs all.

Whole files go together: they share fleets. They are dealt out in the order of their names, so shares differ little.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

SHARE = re.compile(r"(?P<own>\d+)/(?P<count>[1-9]\d*)")


def left_out(files: Iterable[str], share: str) -> set[str]:
    """Those of ``files`` that are not in ``share`` (``OWN/COUNT``, OWN from 0); with ``""`` none.

    Raises:
        ValueError: that is no share.
    """
    if not share:
        return set()
    said = SHARE.fullmatch(share)
    if said is None or int(said["own"]) >= int(said["count"]):
        raise ValueError(f"{share!r} is no share of the long tests; say 0/3, 1/3 or 2/3, for example")
    own, count = int(said["own"]), int(said["count"])
    return {file for number, file in enumerate(sorted(set(files))) if number % count != own}
