"""`zsched fleet recover`, also with --rejoin: what is shown, asked and refused; states on disk are real."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from zsched.commands.base.ask import Door
from zsched.commands.base.change import OrderView
from zsched.commands.base.common import CliError, Json
from zsched.commands.look.history import changes_of
from zsched.commands.members import recovery
from zsched.commands.members.blank import Heard, init_state
from zsched.commands.members.init import Place
from zsched.commands.members.recover import begin_generation as recover
from zsched.commands.members.recover import rejoin_side as rejoin
from zsched.config.load import load_fleet
from zsched.core.values.durable import DurableState
from zsched.core.values.errors import AdapterError
from zsched.core.values.exits import EXIT_FAILED, EXIT_OK, EXIT_USAGE, EXIT_WOULD_CHANGE
from zsched.core.values.snapshot import SCHEMA, QuorumStatus, Snapshot
from zsched.host import decision_log
from zsched.host.state_file import StateFile

TEXT = """\
fleet: hall
nodes:
  robot1: {kind: robot}
  robot2: {kind: robot, host: 127.0.0.1, listen: {control: tcp/127.0.0.1:1, data: tcp/127.0.0.1:2}}
  robot3: {kind: robot}
tasks:
  merge: {candidates: {kind: robot}, weights: {cpu: 1}}
"""
NAMED = TEXT.replace("tasks:", "electorate: [robot1, robot2, robot3]\ntasks:")
ROBOTS = ("robot1", "robot2", "robot3")


def manner(**given: Any) -> OrderView:
    return OrderView(door=Door(socket=Path()), **given)


BOTH = ("old-electors-are-off", "newest-may-be-lost")


class Hall:
    """Three machines whose daemons are stopped, and what the others say when they are asked."""

    def __init__(self, folder: Path, text: str = TEXT) -> None:
        self.file, self.answers = folder / "fleet.yaml", list[Snapshot]()
        self.file.write_text(text)
        for name in ROBOTS:
            init_state(load_fleet(self.file), name, folder / name, 0)

    def place(self, node: str) -> Place:
        return Place(fleet=load_fleet(self.file), node=node, config=self.file, folder=self.file.parent / node)

    def state(self, node: str) -> DurableState:
        state = StateFile(self.file.parent / node, fleet="hall", node=node).load().state
        assert state is not None
        return state

    def file_of(self, node: str) -> Path:
        return self.file.parent / node / "state"

    def says(self, node: str, generation_id: str = "", recovered_by: str = "") -> None:
        """Another node answers: it counts by this generation."""
        quorum = QuorumStatus(
            electors=3,
            needed=2,
            alive=1,
            ok=False,
            this_node="elector",
            names=ROBOTS,
            generation_id=generation_id,
            recovered_by=recovered_by,
        )
        self.answers.append(
            Snapshot(
                schema=SCHEMA,
                version="1",
                fleet="hall",
                node=node,
                kind="robot",
                incarnation=1,
                up_s=1.0,
                loop_lag_s=0.0,
                quorum=quorum,
                nodes=(),
                tasks=(),
            )
        )


@pytest.fixture
def hall(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Hall:
    one = Hall(tmp_path)
    heard = lambda _fleet, _node: Heard(asked=len(one.answers), answers=tuple(one.answers))  # noqa: E731
    monkeypatch.setattr(recovery, "ask_others", heard)
    monkeypatch.setattr(sys, "argv", ["zsched", "the", "words"])
    return one


def refusal(do: Callable[[], int]) -> tuple[int, str]:
    with pytest.raises(CliError) as caught:
        do()
    return caught.value.code, str(caught.value)


def log_of(place: Place) -> list[Json]:
    lines, _, _ = decision_log.read_page(place.folder, "")
    return [json.loads(line) for line in lines]


def at_a_terminal(monkeypatch: pytest.MonkeyPatch, answer: str) -> None:
    class Keyboard:
        def isatty(self) -> bool:
            return True

        def readline(self) -> str:
            return f"{answer}\n"

    monkeypatch.setattr("sys.stdin", Keyboard())


def test_a_plan_shows_before_and_after_and_writes_nothing(hall: Hall, capsys: pytest.CaptureFixture[str]) -> None:
    before = hall.file_of("robot1").read_bytes()
    assert recover(hall.place("robot1"), manner(is_plan=True), ()) == EXIT_WOULD_CHANGE
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "hall:"
    told = {line.split("  ")[1].strip(): line for line in lines[1:]}
    assert told["generation"].endswith("-> a new one, recovered by robot1")
    assert told["electors"].endswith("robot1, robot2, robot3 -> robot1")
    assert "each node by its own file -> this machine's file, " in told["document"]
    assert "no value -> nobody" in told["task merge"]
    assert hall.file_of("robot1").read_bytes() == before


def test_dangers_are_accepted_by_name_and_the_command_to_give_is_printed(hall: Hall) -> None:
    before = hall.file_of("robot1").read_bytes()
    code, text = refusal(lambda: recover(hall.place("robot1"), manner(is_yes=True), ()))
    assert code == EXIT_FAILED
    assert "old-electors-are-off: robot2, robot3 decide no more" in text
    assert "newest-may-be-lost: what was agreed without robot1 is lost: no states of robot2, robot3" in text
    again = "zsched the words --accept newest-may-be-lost"
    assert text.splitlines()[-1] == again.replace(" --accept", " --accept old-electors-are-off --accept")
    one = manner(is_yes=True, accepted=BOTH[:1])
    _, text = refusal(lambda: recover(hall.place("robot1"), one, ()))
    assert "newest-may-be-lost" in text
    assert "old-electors-are-off:" not in text
    assert text.splitlines()[-1] == again
    code, text = refusal(lambda: recover(hall.place("robot1"), manner(accepted=("old-electors-are-of",)), ()))
    assert (code, "did you mean old-electors-are-off?" in text) == (EXIT_USAGE, True)
    assert hall.file_of("robot1").read_bytes() == before


def test_states_of_dead_machines_take_the_danger_away(hall: Hall, capsys: pytest.CaptureFixture[str]) -> None:
    brought = (hall.file_of("robot2"),)
    assert recover(hall.place("robot1"), manner(is_yes=True, accepted=BOTH[:1]), brought) == EXIT_OK
    assert "robot1 is the only elector of generation" in capsys.readouterr().out


def test_off_a_terminal_it_takes_yes_and_at_one_the_answer_counts(
    hall: Hall, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    before = hall.file_of("robot1").read_bytes()
    accepted = manner(accepted=BOTH)
    code, text = refusal(lambda: recover(hall.place("robot1"), accepted, ()))
    assert code == EXIT_USAGE
    again = "zsched the words --yes"
    assert text == f"nothing was done, for nobody can be asked here; to do it:\n{again}"
    at_a_terminal(monkeypatch, "n")
    assert refusal(lambda: recover(hall.place("robot1"), accepted, ())) == (EXIT_FAILED, "nothing was done")
    assert hall.file_of("robot1").read_bytes() == before
    at_a_terminal(monkeypatch, "y")
    assert recover(hall.place("robot1"), accepted, ()) == EXIT_OK
    captured = capsys.readouterr()
    assert "Make robot1 the only elector of a new generation of hall? [y/N] " in captured.out
    value = hall.state("robot1").fleet_register
    assert value is not None
    assert value.learnt is not None
    assert (value.learnt.electorate.names, value.learnt.recovered_by) == (("robot1",), "robot1")
    named = value.learnt.generation_id[:8]
    assert captured.out.rpartition("[y/N] ")[2].splitlines()[-5:] == [
        f"robot1 is the only elector of generation {named}",
        "next: start this daemon",
        f"then on each of robot2, robot3: stop zsched, `zsched fleet recover --rejoin {named}`, start it",
        "for each of them that is lost for good: `zsched node forget NODE` here",
        "electors are added by themselves once those nodes are back (`zsched fleet show`)",
    ]


def test_electors_that_the_file_names_are_added_by_word(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    hall = Hall(tmp_path, NAMED)
    monkeypatch.setattr(recovery, "ask_others", lambda _fleet, _node: Heard(asked=0, answers=()))
    recover(hall.place("robot1"), manner(is_yes=True, accepted=BOTH), ())
    assert capsys.readouterr().out.splitlines()[-1].startswith("its document names the electors: when they are back")


def test_a_fleet_that_can_agree_and_a_daemon_that_runs_are_left_alone(hall: Hall) -> None:
    hall.says("robot2")
    code, text = refusal(lambda: recover(hall.place("robot1"), manner(is_yes=True, accepted=BOTH), ()))
    assert code == EXIT_FAILED
    assert text.startswith("nothing was changed: robot1, robot2 can agree, 2 of 3 electors are needed")
    running = StateFile(hall.file.parent / "robot1", fleet="hall", node="robot1")
    with running, pytest.raises(AdapterError, match="stop that daemon first"):
        recover(hall.place("robot1"), manner(is_plan=True), ())


def test_another_half_is_a_danger_of_its_own(hall: Hall) -> None:
    hall.says("robot3", "5be01c77" * 4, "robot3")
    accepted = manner(is_yes=True, accepted=BOTH)
    _, text = refusal(lambda: recover(hall.place("robot1"), accepted, ()))
    assert "another-half: robot3 (5be01c77) count by another generation already" in text
    assert "`zsched fleet recover --rejoin 5be01c77` brings this node over" in text


def test_a_node_changes_sides_by_word(hall: Hall, capsys: pytest.CaptureFixture[str]) -> None:
    before = hall.state("robot1")
    code, text = refusal(lambda: rejoin(hall.place("robot1"), manner(is_yes=True), ""))
    assert (code, text.startswith("nothing was changed: no other node answers")) == (EXIT_FAILED, True)
    hall.says("robot3", "5be01c77" * 4, "robot3")
    assert rejoin(hall.place("robot1"), manner(is_plan=True), "") == EXIT_WOULD_CHANGE
    told = "robot1: follows generation 5be01c77, recovered by robot3 (robot3 count by it), and starts blank there"
    assert told in capsys.readouterr().out
    code, text = refusal(lambda: rejoin(hall.place("robot1"), manner(), "5be0"))
    assert (code, "zsched the words --yes" in text) == (EXIT_USAGE, True)
    assert hall.state("robot1") == before
    assert rejoin(hall.place("robot1"), manner(is_yes=True), "5be0") == EXIT_OK
    after = hall.state("robot1")
    assert (after.joins, after.fleet_register, after.registers) == ("5be01c77" * 4, None, ())
    assert capsys.readouterr().out.splitlines()[-1].startswith("next: start this daemon; it fetches the rest")


def test_the_history_of_a_node_tells_of_its_recovery_and_of_changing_sides(
    hall: Hall, capsys: pytest.CaptureFixture[str]
) -> None:
    """Who asks later why the fleet counts anew finds who did it, and when."""
    assert recover(hall.place("robot1"), manner(is_yes=True, accepted=BOTH), ()) == EXIT_OK
    named = capsys.readouterr().out.partition("only elector of generation ")[2][:8]
    (told,) = changes_of(log_of(hall.place("robot1")), 0.0, None)
    assert told["by"].endswith("@robot1")
    assert told["text"].startswith(f"{told['by']}: recovered hall: generation ")
    assert told["text"].endswith(f" -> {named}, electors robot1, robot2, robot3 -> robot1")
    hall.says("robot1", "5be01c77" * 4, "robot1")
    assert rejoin(hall.place("robot2"), manner(is_yes=True), "") == EXIT_OK
    (told,) = changes_of(log_of(hall.place("robot2")), 0.0, None)
    assert told["text"] == f"{told['by']}: rejoined generation 5be01c77, recovered by robot1"


def test_a_full_disk_of_the_log_keeps_no_recovery_back(
    hall: Hall, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(decision_log, "note", refuse)
    assert recover(hall.place("robot1"), manner(is_yes=True, accepted=BOTH), ()) == EXIT_OK
    assert "does not tell of it: No space left on device" in capsys.readouterr().err
