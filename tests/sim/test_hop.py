"""Numbered hops on a bad way: nothing twice, nothing lost silently; and the plays find what would break that."""

from __future__ import annotations

import pytest

from zsched.core.hop.held import HeldInputs
from zsched.core.hop.kept import NOTHING, Kept
from zsched.core.hop.receiver import Source
from zsched.core.hop.sender import Sender, Sums
from zsched.core.hop.shared import SharedSender
from zsched_lab.sim.hop.__main__ import PLAYS, main, play
from zsched_lab.sim.hop.answers import AnswerHop
from zsched_lab.sim.hop.inputs import InputHop


@pytest.mark.parametrize("name", PLAYS)
@pytest.mark.parametrize("block", range(3))
def test_what_must_hold_does(name: str, block: int) -> None:
    assert [fault for seed in range(20 * block, 20 * block + 20) if (fault := play(name, seed))] == []


@pytest.mark.parametrize("is_whole", [True, False])
def test_the_runs_have_every_kind_of_end(*, is_whole: bool) -> None:
    hops = [InputHop(seed, is_whole=is_whole) for seed in range(20)]
    for hop in hops:
        hop.run()
    sums = [hop.tally.plus([hop.sender]) for hop in hops]
    assert sum(hop.lives for hop in hops) > 30
    assert sum(one.at_most_lost for one in sums) > 100
    assert not is_whole or sum(one.doubled for one in sums) > 20
    assert sum(one.at_most_lost == 0 for one in sums) > 3, "cuts and freezes alone cost nothing"
    assert is_whole or sum(hop.overflow for hop in hops) > 100


def test_relays_die_lose_answers_and_get_them_again() -> None:
    hops = [AnswerHop(seed, is_whole=True) for seed in range(40)]
    for hop in hops:
        hop.run()
    relays = [relay for hop in hops for relay in hop.relays]
    assert sum(hop.lives for hop in hops) > 70
    assert sum(relay.counter.lost > 0 for relay in relays) > 2
    assert sum(relay.counter.lost == 0 for relay in relays) > 20


@pytest.mark.parametrize(
    ("name", "owner", "method", "instead"),
    [
        ("reliable", Sender, "sums", lambda _: Sums(0, 0, 0, 0)),
        ("reliable", Sender, "ask_again", lambda *_: None),
        ("reliable", Sender, "part", lambda *_: None),
        ("reliable", Sender, "take_owed", lambda _: NOTHING),
        ("reliable", Source, "_is_given_up", lambda *_: True),
        ("reliable", Source, "done", lambda *_: False),
        ("latest", Sender, "look_after", lambda *_: False),
        ("latest", Source, "done", lambda *_: False),
        ("reliable-answers", SharedSender, "look_after", lambda *_: None),
        ("reliable-answers", SharedSender, "settled", lambda books, *_: books.count),
        ("reliable-answers", HeldInputs, "settle", lambda *_: []),
        ("reliable-answers", Kept, "let_go", lambda *_: []),
        ("latest-answers", SharedSender, "look_after", lambda *_: None),
    ],
)
def test_what_would_break_it_is_found(
    name: str, owner: type, method: str, instead: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(owner, method, instead)
    assert any(play(name, seed) for seed in range(30))


def test_the_command_says_what_it_found(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--seed", "3", "--runs", "2"]) == 0
    assert capsys.readouterr().out.splitlines() == [f"{name}: 2 runs, 0 violations" for name in PLAYS]
