"""The bytes of a seal: what is packed comes back, what is cut is refused, and no part can pass for another."""

from __future__ import annotations

import itertools
from typing import Any

import pytest

from zsched.core.values.errors import WireError
from zsched.link import seal
from zsched.link.seal import MAX_SEAL, Act, Seal, pack, signed_bytes, unpack

TOO_LARGE = seal._HEAD.pack(seal.VERSION, 7, 1, 64, MAX_SEAL) + b"s" * 64 + b"c" * MAX_SEAL
"""As it should be, but for its size."""
SEAL = Seal(life=7, sequence=2**63, signature=b"s" * 64, certificate=b"c" * 474)


def test_a_seal_comes_back_as_it_was_packed() -> None:
    assert unpack(pack(SEAL)) == SEAL


@pytest.mark.parametrize("length", [0, 1, 19, 20, 60, len(pack(SEAL)) - 1])
def test_a_cut_seal_is_refused(length: int) -> None:
    with pytest.raises(WireError) as caught:
        unpack(pack(SEAL)[:length])
    assert caught.value.reason == "seal"


def test_every_part_counts_and_none_passes_for_another() -> None:
    """Two messages that differ anywhere are signed differently, also where their parts run together."""
    base: dict[str, Any] = {"act": Act.PUT, "key": "ab", "frame": b"cd", "life": 1, "sequence": 2, "question": b"ef"}
    changes: list[dict[str, Any]] = [
        {},
        {"act": Act.ANSWER},
        {"key": "abc", "frame": b"d"},
        {"frame": b"cde", "question": b"f"},
        {"frame": b"ef", "question": b"cd"},
        {"life": 2, "sequence": 1},
        {"sequence": 3},
        {"question": b""},
    ]
    found = [signed_bytes(**{**base, **change}) for change in changes]
    assert all(one != other for one, other in itertools.combinations(found, 2))
