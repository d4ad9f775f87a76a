"""A numbered hop on a bad way: nothing twice, nothing lost silently; and the play finds what would break that."""

from __future__ import annotations

import pytest

from zsched.core.hop.receiver import Source
from zsched.core.hop.sender import Sender, Sums
from zsched_lab.sim.hop import Hop, main, play


@pytest.mark.parametrize("block", range(5))
def test_nothing_is_processed_twice_and_nothing_is_lost_silently(block: int) -> None:
    assert [fault for seed in range(20 * block, 20 * block + 20) if (fault := play(seed))] == []


def test_the_runs_have_every_kind_of_end() -> None:
    hops = [Hop(seed) for seed in range(20)]
    for hop in hops:
        hop.run()
    sums = [hop.tally.plus([hop.sender]) for hop in hops]
    assert sum(hop.lives for hop in hops) > 30
    assert sum(one.at_most_lost for one in sums) > 100
    assert sum(one.doubled for one in sums) > 100
    assert sum(one.at_most_lost == 0 for one in sums) > 3, "cuts and freezes alone cost nothing"


@pytest.mark.parametrize(
    ("owner", "name", "instead"),
    [
        (Sender, "sums", lambda _: Sums(0, 0, 0, 0)),
        (Sender, "ask_again", lambda *_: None),
        (Sender, "part", lambda *_: None),
        (Source, "_is_given_up", lambda *_: True),
        (Source, "done", lambda *_: False),
    ],
)
def test_what_would_break_it_is_found(owner: type, name: str, instead: object, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(owner, name, instead)
    assert any(play(seed) for seed in range(20))


def test_the_command_says_what_it_found(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--seed", "3", "--runs", "2"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "2 runs, 0 violations"
