"""Damaged frames of every kind, by seed: nothing but `WireError` escapes, nothing but a counter moves, nothing lags.

The long runs: ``python -m zsched_lab.bugs.fuzz_wire --frames 5000000``.
"""

from __future__ import annotations

import sys
from dataclasses import fields
from random import Random

import msgpack
import pytest

from zsched.core.values import codec as wire
from zsched.core.values.errors import WireError
from zsched_lab.bugs.fuzz_wire import CLASSES, LAG_S, REASONS, Fuzz, damaged, main, sample

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


@pytest.mark.parametrize("opener", [b"\x91", b"\x81\xa1a"])
def test_deep_nesting_is_refused(opener: bytes) -> None:
    with pytest.raises(WireError) as caught:
        wire.decode(opener * (sys.getrecursionlimit() * 4), *CLASSES)
    assert caught.value.reason in REASONS


@pytest.mark.parametrize("header", [b"\xdd", b"\xdf", b"\xdb", b"\xc6"])
def test_a_length_that_is_not_there_costs_no_memory(header: bytes) -> None:
    with pytest.raises(WireError):
        wire.decode(b"\x93\x01\xa4beat" + header + b"\xff\xff\xff\xff", *CLASSES)


def test_same_seed_same_frames() -> None:
    frames = [msgpack.packb([1, "beat", {"node": "robot1"}])]
    one, two = Random(3), Random(3)
    assert [damaged(frames, one) for _ in range(50)] == [damaged(frames, two) for _ in range(50)]


def test_a_bug_in_the_codec_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """The fuzzer is worth something: an exception that escapes is a violation, and the command says so."""

    def careless(frame: bytes, *_: object) -> object:
        return msgpack.unpackb(frame)["node"]

    monkeypatch.setattr(wire, "decode", careless)
    fuzz = Fuzz(seed=1)
    fuzz.run(50)
    assert len(fuzz.violations) > 10
    assert main(["--frames", "50"]) == 1


def test_the_command_s_last_line_is_the_sum(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--frames", "500", "--seed", "5"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "500 frames, 0 violations"
