"""Hostile keys, tokens, numbers, markers and acknowledgements, by seed, through the real parsers and books.

The long runs: ``python -m zsched_lab.bugs.fuzz_keys --rounds 200000``.
"""

from __future__ import annotations

import pytest

from zsched.core.hop import receiver, sender
from zsched.core.values import sequence
from zsched.link import keyspace
from zsched.relay import tokens
from zsched.relay.streams import slots
from zsched_lab.bugs.fuzz_keys import KeyFuzz


@pytest.mark.parametrize("seed", range(2))
def test_no_hostile_key_token_number_or_marker_raises_or_ends_anything(seed: int) -> None:
    fuzz = KeyFuzz(seed)
    fuzz.run(500)
    assert fuzz.violations == []


def found(rounds: int = 120) -> str:
    """What a run finds."""
    fuzz = KeyFuzz(1)
    fuzz.run(rounds)
    return " ".join(fuzz.violations)


def test_what_was_broken_from_outside_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """The fuzzer is worth something: each fault that an attack has found is one that it finds."""
    with monkeypatch.context() as patch:  # a role token with an epoch of 25 digits ended the relay
        patch.setattr(tokens, "counter", lambda text: int(text) if text.isdigit() else None)
        assert "_token" in found()
    with monkeypatch.context() as patch:
        patch.setattr(keyspace, "MAX_DIGITS", 99)
        patch.setattr(keyspace, "MAX_COUNTER", 10**99)
        assert "_key" in found()
    with monkeypatch.context() as patch:  # one skip marker or number ended a stream
        patch.setattr(receiver, "RETURN", 10**9)
        assert "_hop" in found()
        assert "_start" in found()  # one start marker made a queue of a `latest` input for good
    with monkeypatch.context() as patch:  # one end marker, long before, ended a slot in the move
        patch.setattr(slots.KeyState, "is_past_end", lambda *_: False)
        assert "_end" in found()
    with monkeypatch.context() as patch:  # one beat made its node's real ones old
        patch.setattr(sequence, "RUN", 10**9)
        assert "_track" in found()
    with monkeypatch.context() as patch:  # an acknowledgement of what was never sent
        patch.setattr(sender.Sender, "arrived", property(lambda lane: 0 if lane.ack is None else lane.ack.arrived))
        assert "_lane" in found()
