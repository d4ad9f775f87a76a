"""Spikes of readings: what counts as one, and that the study's are those that were measured."""

from __future__ import annotations

import doctest
import json
import re
from pathlib import Path

import numpy as np
import pytest

from zsched_lab.decisions import spikes
from zsched_lab.decisions.loads import SPIKES, Spikes
from zsched_lab.decisions.world import DT_S

RECORDED = Path(__file__).parents[4] / "docs" / "evaluation" / "spikes.json"


def test_spikes_are_short_and_high_and_a_step_of_load_is_none() -> None:
    assert doctest.testmod(spikes).failed == 0
    calm = np.full(200, 0.1)
    loaded = calm.copy()
    loaded[80:130] = 0.9
    assert spikes.spikes(calm) == spikes.spikes(loaded) == []
    calm[100:103] += [0.3, 0.5, 0.4]
    (spike,) = spikes.spikes(calm)
    assert (spike.begin, spike.count) == (100, 3)
    assert spike.height == pytest.approx(0.4)
    told = spikes.describe({"edge1": calm.tolist()})
    assert "1 spikes, one in 15.0 s; height 0.40" in told.splitlines()[0], "40 s less what is skipped"


def test_the_study_s_spikes_are_those_that_the_demo_s_edges_had() -> None:
    told = spikes.describe(json.loads(RECORDED.read_text(encoding="utf-8"))).splitlines()
    for line, one in zip(told, SPIKES, strict=False):
        every_s, *others = (float(number) for number in re.findall(r"[0-9.]+", line.partition("one in ")[2]))
        assert (every_s, tuple(others)) == (one.every_s, (*one.height, *one.length_s))
    assert [level[1] for level in spikes.LEVELS][: len(SPIKES)] == [one.below for one in SPIKES]
    assert "0 spikes" in told[len(SPIKES)]


def test_drawn_spikes_come_as_often_and_as_high_as_they_are_said_to() -> None:
    drawn = Spikes(below=1.0, every_s=2.0, height=(0.3, 0.5), length_s=(0.2, 0.4)).drawn(
        50_000, DT_S, np.random.default_rng(1)
    )
    assert 0.3 <= drawn[drawn > 0.0].min() < 0.32
    assert 0.48 < drawn.max() <= 0.5
    begins = np.count_nonzero((drawn[1:] > 0.0) & (drawn[:-1] == 0.0))
    assert 0.4 < begins / (50_000 * DT_S) < 0.5, "every 2 s, some in one"
