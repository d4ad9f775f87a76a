"""Electors that change: nothing is chosen twice or forgotten, and the play finds what would break that."""

from __future__ import annotations

import pytest

from zsched.core.electorate import settling
from zsched.core.values.electorate import Elector
from zsched_lab.sim.electorate import Swarm, main, play


@pytest.mark.parametrize("block", range(5))
def test_nothing_is_chosen_twice_forgotten_or_stuck(block: int) -> None:
    assert [played.violation for seed in range(40 * block, 40 * block + 40) if (played := play(seed)).violation] == []


@pytest.mark.long
def test_the_runs_have_every_kind_of_change_and_fault() -> None:
    counts = sum((play(seed).counts for seed in range(1, 200)), start=play(0).counts)
    kinds = {"AddElector", "RemoveElector", "SetDocument", "SetLease", "Settle", "MoveOwner"}
    faults = {"clones", "deaths", "lost disks", "recoveries", "live", "beyond"}
    assert kinds | faults <= set(counts)


def test_same_seed_same_play() -> None:
    def pool(seed: int) -> list[str]:
        swarm = Swarm(seed)
        swarm.run()
        return [str(message) for message in swarm.world.pool]

    assert pool(7) == pool(7)


@pytest.mark.long
@pytest.mark.parametrize(
    ("owner", "name", "instead"),
    [
        (settling, "_missing", lambda *_: []),
        (Elector, "is_held_by", lambda self, name, _: self.name == name),
    ],
)
def test_what_would_break_it_is_found(
    owner: object, name: str, instead: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(owner, name, instead)
    assert any(play(seed).violation for seed in range(600))


def test_the_command_counts_and_says_which_seed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--runs", "3"]) == 0
    assert "3 schedules" in capsys.readouterr().out
