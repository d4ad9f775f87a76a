"""By which words a relay of another version is gone on with."""

from __future__ import annotations

from dataclasses import dataclass

import pytest

from zsched.core.values.plan import WorkerRole
from zsched.ipc import words

TODAY = "fc96379498019052"
"""Another digest means: relays of the version before say other words. Where they were only added, with a default, those
relays go on until somebody uses what is new (`zsched.ipc.vocabulary`); where the daemon waits for a new report, raise
`PROTOCOL`. All else replaces every relay at an upgrade, and its robot's applications are cut off for a second: say so
in the CHANGELOG. Then write the new digest here."""


def test_the_words_are_those_of_the_versions_before() -> None:
    assert words.words_digest() == TODAY, "\n".join(words.words())


def test_every_class_and_all_that_it_is_made_of_is_told() -> None:
    told = {line.partition(":")[0] for line in words.words()}
    assert {"RoutePlan", "Slot", "Route", "StreamSettings", "StreamClass", "StreamCount", "RelayHello"} <= told


def digest_with(monkeypatch: pytest.MonkeyPatch, *classes: type) -> str:
    """The digest of a pipe that these commands pass."""
    monkeypatch.setattr(words, "COMMANDS", classes)
    words.words_digest.cache_clear()
    try:
        return words.words_digest()
    finally:
        words.words_digest.cache_clear()


def test_a_field_a_default_and_a_type_are_words(monkeypatch: pytest.MonkeyPatch) -> None:
    @dataclass(frozen=True, kw_only=True)
    class Order:
        task: str

    first = digest_with(monkeypatch, Order)

    @dataclass(frozen=True, kw_only=True)
    class Order:  # type: ignore[no-redef]
        task: str
        role: WorkerRole | None = None

    second = digest_with(monkeypatch, Order)

    @dataclass(frozen=True, kw_only=True)
    class Order:  # type: ignore[no-redef]
        task: str
        role: WorkerRole | None = WorkerRole.IDLE

    third = digest_with(monkeypatch, Order)

    @dataclass(frozen=True, kw_only=True)
    class Order:  # type: ignore[no-redef]
        task: int

    assert len({first, second, third, digest_with(monkeypatch, Order)}) == 4
