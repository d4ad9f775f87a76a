"""Rehearsals on disk: kept by name, bounded in number."""

from __future__ import annotations

from pathlib import Path

from zsched.host.rehearsals import MAX_KEPT, RehearsalStore


def test_the_newest_are_kept_and_read_again(tmp_path: Path) -> None:
    store = RehearsalStore(tmp_path)
    assert (store.names(), store.load("20260101-000000")) == ((), "")
    for number in range(MAX_KEPT + 3):
        store.save(f"20260101-0000{number:02d}", f'{{"n": {number}}}')
    assert len(store.names()) == MAX_KEPT
    assert store.names()[0] == "20260101-000003", "the oldest go"
    assert store.load(store.names()[-1]) == f'{{"n": {MAX_KEPT + 2}}}'
