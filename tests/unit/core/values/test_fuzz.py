"""Damaged frames of every kind, by seed: nothing but `WireError` escapes, nothing but a counter moves, nothing lags.

The long runs: ``python -m zsched_lab.bugs.fuzz_wire --frames 5000000``.
"""

from __future__ import annotations

from dataclasses import fields
from random import Random

import msgpack
import pytest

from zsched.core.values import codec as wire
from zsched_lab.bugs.fuzz_wire import LAG_S, Fuzz, main, sample

FRAMES, PARTS = 75_000, 3


@pytest.mark.parametrize("part", range(PARTS))
def test_no_damaged_frame_raises_changes_or_delays_anything(part: int) -> None:
    fuzz = Fuzz(seed=part)
    fuzz.run(FRAMES // PARTS)
    assert fuzz.violations == []
    assert fuzz.slowest_s < LAG_S
    assert set(fuzz.reasons) >= {"garbage", "frame", "version", "kind", "type", "missing", "range", "valid"}


@pytest.mark.parametrize("kind", sorted(wire.KINDS))
def test_the_fuzzer_makes_valid_frames_of_every_kind(kind: str) -> None:
    cls, rng = wire.KINDS[kind][0], Random(kind)
    frames = [wire.encode(sample(cls, rng)) for _ in range(50)]
    assert len(set(frames)) > 1 or not fields(cls)
    for frame in frames:
        assert wire.decode(wire.encode(wire.decode(frame, cls)), cls) == wire.decode(frame, cls)


def test_a_bug_in_the_codec_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """The fuzzer is worth something: an exception that escapes is a violation, and the command says so."""

    def careless(frame: bytes, *_: object) -> object:
        return msgpack.unpackb(frame)["node"]

    monkeypatch.setattr(wire, "decode", careless)
    fuzz = Fuzz(seed=1)
    fuzz.run(50)
    assert len(fuzz.violations) > 10
    assert main(["--frames", "50"]) == 1
