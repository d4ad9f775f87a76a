"""Slices of one sweep: the first of them in every run, the others where long tests run, too."""

from __future__ import annotations

from typing import Any

import pytest


def slices(count: int) -> list[Any]:
    """Parameters 0 to ``count`` - 1: each part of a sweep tells of another place what the first tells of one."""
    return [0, *(pytest.param(number, marks=pytest.mark.long) for number in range(1, count))]
