"""The checker of histories: what is impossible is named, what is possible is not."""

from __future__ import annotations

from dataclasses import replace
from math import inf
from pathlib import Path

import pytest

from zsched_lab.sim.history import Admitted, History, Learnt, Record, Routed, Started, Stored, Worked


def learnt(at: float, node: str, revision: int, epoch: int, owner: str | None = "e1", detail: str = "") -> Learnt:
    return Learnt(at=at, node=node, task="merge", revision=revision, epoch=epoch, owner=owner, detail=detail)


def worked(at: float, node: str, until: float) -> Worked:
    return Worked(at=at, node=node, task="merge", epoch=1, until=until)


GOOD: list[list[Record]] = [
    [learnt(1, "r1", 1, 1), learnt(2, "r2", 1, 1), learnt(3, "r1", 2, 1), learnt(4, "r1", 3, 2, "e2")],
    [learnt(1, "r1", 0, 0, None), learnt(2, "r1", 1, 1), learnt(2, "r1", 1, 1)],
    [learnt(1, "r1", 5, 2), Started(at=2, node="r1", has_state=False), learnt(3, "r1", 4, 2)],
    [learnt(1, "r1", 1, 1, detail="cpu=1"), learnt(2, "r2", 1, 1)],
    [learnt(1, "r1", 4, 2), learnt(2, "r1", 2**32, 2**32, None), learnt(3, "r1", 2**32 + 1, 2**32 + 1)],
    [worked(1, "e1", 2.0), worked(1.5, "e1", 3.0), worked(3.0, "e2", 4.0)],
    [worked(1, "e1", 5.0), replace(worked(2, "e1", inf), life=1, is_leased=False, is_shared=True)],
    [
        Routed(at=1, node="r1", task="merge", epoch=1, owner="e1"),
        Routed(at=2, node="r1", task="m2", epoch=0, owner="x"),
    ],
]
BAD: list[tuple[str, list[Record]]] = [
    ("two values", [learnt(1, "r1", 1, 1), learnt(2, "r2", 1, 1, "e2")]),
    ("two values", [learnt(1, "r1", 1, 1, detail="cpu=1"), learnt(2, "r2", 1, 1, detail="cpu=0.5")]),
    ("two owners", [learnt(1, "r1", 1, 1), learnt(2, "r1", 2, 1, "e2")]),
    ("owner of the epoch before", [learnt(1, "r1", 1, 1), learnt(2, "r1", 2, 2)]),
    ("owner of the epoch before", [learnt(1, "r2", 7, 3), learnt(2, "r1", 4, 2)]),
    ("unlearnt", [learnt(1, "r1", 2, 1), learnt(2, "r1", 1, 1)]),
    ("unlearnt", [learnt(1, "r1", 2, 2, "e2"), Started(at=2, node="r1"), learnt(3, "r1", 1, 1)]),
    ("both work", [worked(1, "e1", 2.0), worked(1.9, "e2", 3.0)]),
    ("both work", [worked(1, "e1", 5.0), replace(worked(2, "e1", inf), life=1, is_leased=False)]),
    ("both work", [worked(1, "e1", 5.0), replace(worked(2, "e2", inf), is_leased=False, is_shared=True)]),
    ("older epoch moves", [Routed(at=t, node="r1", task="merge", epoch=e, owner="e1") for t, e in ((1, 2), (2, 1))]),
    ("admits an older", [Admitted(at=t, node="r1", task="merge", epoch=e, owner="e1") for t, e in ((1, 2), (2, 1))]),
]


@pytest.mark.parametrize("records", GOOD)
def test_possible_histories_have_no_violations(records: list[Record]) -> None:
    assert History(records=records).violations() == []


@pytest.mark.parametrize(("what", "records"), BAD)
def test_impossible_histories_are_named_whatever_the_order_of_recording(what: str, records: list[Record]) -> None:
    for order in (records, records[::-1]):
        found = History(records=list(order)).violations()
        assert len(found) == 1
        assert what in found[0]


def test_first_learnt_needs_a_majority_of_one_ballot_on_disk() -> None:
    def stored(node: str, ballot: str) -> Stored:
        return Stored(at=1, node=node, task="merge", revision=1, ballot=ballot)

    electors = ("r1", "r2", "r3")
    one = History(electors=electors, records=[stored("r1", "1"), stored("r2", "1"), learnt(2, "r3", 1, 1)])
    assert one.violations() == []
    two = History(electors=electors, records=[stored("r1", "1"), stored("r2", "2"), learnt(2, "r3", 1, 1)])
    assert "on disk" in two.violations()[0]
    stranger = History(electors=electors, records=[stored("r1", "1"), stored("e1", "1"), learnt(2, "r3", 1, 1)])
    assert "on disk" in stranger.violations()[0]


def test_moves_are_counted_in_any_minute() -> None:
    records: list[Record] = [learnt(at, "r1", i, i, f"e{i}") for i, at in enumerate((1, 20, 50, 70), start=1)]
    assert History(moves_per_minute={"merge": 3}, records=records).violations() == []
    assert "moved 3 times" in History(moves_per_minute={"merge": 2}, records=records).violations()[0]


def test_history_survives_its_file(tmp_path: Path) -> None:
    records = [record for some in GOOD for record in some]
    History(records=records).save(tmp_path / "h.jsonl")
    again = History()
    again.load(tmp_path / "h.jsonl")
    assert again.records == sorted(records, key=lambda one: one.at)
    (tmp_path / "bad.jsonl").write_text('{"kind": "nonsense"}\n')
    with pytest.raises(ValueError, match="not a record"):
        again.load(tmp_path / "bad.jsonl")
