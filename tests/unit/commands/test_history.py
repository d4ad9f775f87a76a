"""`zsched history`, `zsched events` and `explain --replay`: pages put together, times, filters, what differs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner

from support.decisions import figures_of
from support.fleets import task_of, tuning_of
from support.schemas import faults
from zsched.cli import app
from zsched.commands.base.ask import Door
from zsched.commands.base.common import CliError
from zsched.commands.look import history as verb
from zsched.commands.look import history as verbs
from zsched.core.scheduler.decision import decide_again, verdict_of
from zsched.core.values.decision import Decision, Move
from zsched.core.values.exits import EXIT_UNREACHABLE, EXIT_USAGE
from zsched.core.values.fleet import Cell, WorkerSpec
from zsched.core.values.instructions import RecordStory
from zsched.core.values.model import Utility, UtilityVector
from zsched.host.decision_log import NAME, DecisionLog

NOW = 1_790_000_000.0
HERE = Door(socket=Path("s"))
STATUS = {
    "fleet": "hall",
    "tasks": [{"name": "merge"}, {"name": "nothing"}, {"name": "other"}],
    "nodes": [{"name": "edge1"}, {"name": "edge3"}, {"name": "robot1"}],
}
MOVE = {
    "epoch": 2,
    "revision": 3,
    "left": "edge1",
    "owner": "edge2",
    "reason": "edge1 is gone",
    "votes": [["robot1", "edge2"], ["robot2", "edge2"], ["robot3", "edge1"]],
}


def entry(text: str, age_s: float, task: str = "merge", **more: object) -> dict[str, Any]:
    return {
        "at": NOW - age_s,
        "node": "robot1",
        "life": 7,
        "stage": "vote",
        "text": text,
        "task": task,
        "epoch": 2,
    } | more


class Pages:
    """Stands for the daemon: its log, two entries a page."""

    def __init__(self, *entries: dict[str, Any]) -> None:
        self.entries = list(entries)
        self.asked: list[dict[str, Any]] = []
        self.nodes: list[str | None] = []
        self.is_away = False

    def ask(self, door: Door, request: dict[str, Any], timeout_s: float = 5.0) -> dict[str, Any]:
        assert timeout_s > 0
        if request["verb"] == "status":
            return STATUS
        self.asked.append(request)
        self.nodes.append(door.node)
        if self.is_away:
            raise CliError(EXIT_UNREACHABLE, "no daemon")
        first = int(request["cursor"] or 0)
        page = self.entries[first : first + 2]
        wanted = [
            one for one in page if not request["moves"] or {"move", "took_s", "gap_s", "is_rollout", "by"} & {*one}
        ]
        at = first + len(page)
        return {
            "node": door.node or "robot1",
            "now": NOW,
            "entries": wanted,
            "cursor": str(at),
            "more": at < len(self.entries),
        }


@pytest.fixture
def pages(monkeypatch: pytest.MonkeyPatch) -> Pages:
    made = Pages(
        entry("a peer came", 100.0, task=""),
        entry("learnt", 90.0, move=MOVE),
        entry("judged", 80.0),
        entry("flipped", 70.0, took_s=0.086),
        entry("answered", 69.0, gap_s=0.12),
        entry("answered", 68.0, gap_s=0.3),
        entry("learnt \x1b[2J", 60.0, task="other", move={**MOVE, "left": None, "votes": []}),
    )
    monkeypatch.setattr(verb, "ask_door", made.ask)
    monkeypatch.setattr("zsched.commands.look.history.time.sleep", lambda _s: None)
    return made


def history(
    door: Door, task: str | None, *, is_json: bool, about: str | None = None, since_s: float | None = None
) -> int:
    said: Any = SimpleNamespace(door=lambda: door, json_=is_json)
    of_node = None if about is None else f"node/{about}"
    return verbs.history(said, task, of_node, None if since_s is None else f"{since_s}s")


def events(
    door: Door,
    *,
    task: str | None = None,
    node: str | None = None,
    types: tuple[str, ...] = (),
    since_s: float | None = None,
    is_following: bool = False,
    is_json: bool = False,
) -> int:
    said: Any = SimpleNamespace(door=lambda: door)
    about = f"task/{task}" if task else f"node/{node}" if node else None
    since = None if since_s is None else f"{since_s}s"
    return verbs.events(said, is_following, since, about, ",".join(types) or None, is_json)


@pytest.mark.usefixtures("pages")
def test_moves_are_told_with_age_wall_time_votes_and_how_long_the_streams_took(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert history(HERE, None, is_json=False) == 0
    assert capsys.readouterr().out.splitlines() == [
        (
            " 1m30s ago  2026-09-21T14:11:50.000Z  merge epoch 2  edge1 -> edge2: edge1 is gone "
            "(robot1, robot2 for edge2; robot3 for edge1), streams switched in 86 ms, answers 300 ms apart"
        ),
        " 1m00s ago  2026-09-21T14:12:20.000Z  other epoch 2  nobody -> edge2: edge1 is gone",
    ]


def test_what_is_known_from_before_a_restart_is_no_move(pages: Pages, capsys: pytest.CaptureFixture[str]) -> None:
    older = {**MOVE, "left": None, "votes": [], "reason": "known from before the restart", "is_known": True}
    known = {**older, "reason": "as it was", "is_known": True}
    pages.entries = [
        entry("learnt", 50.0, move=older),
        entry("learnt", 40.0, move=known),
    ]
    assert history(HERE, None, is_json=False) == 0
    assert capsys.readouterr().out.splitlines() == [
        "   50s ago  2026-09-21T14:12:30.000Z  merge epoch 2  edge2: known from before the restart",
        "   40s ago  2026-09-21T14:12:40.000Z  merge epoch 2  edge2: as it was",
    ]
    assert events(HERE, types=("move",)) == 0
    assert capsys.readouterr().out == ""
    assert history(HERE, None, is_json=True) == 0
    body = json.loads(capsys.readouterr().out)
    assert (faults(body), [one["is_known"] for one in body["moves"]]) == ([], [True, True])


def test_what_operators_have_changed_is_part_of_the_history_with_their_names(
    pages: Pages, capsys: pytest.CaptureFixture[str]
) -> None:
    drain = "ana.operator (new fan): drain edge1, on revision 4: committed"
    pages.entries = [
        entry(drain, 50.0, task="", by="ana.operator"),
        entry("learnt revision 3: paused by ada@robot1", 40.0, by="ada@robot1"),
        entry("learnt revision 4", 30.0, move=MOVE, by="ada@robot1"),
        entry("rehearsed", 20.0, rehearsal="one", by="ada@robot1"),
    ]
    assert history(HERE, None, is_json=False) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"   50s ago  2026-09-21T14:12:30.000Z  {drain}"
    assert lines[1].endswith("  merge learnt revision 3: paused by ada@robot1")
    assert len(lines) == 4, "each line once"
    assert history(HERE, None, is_json=True) == 0
    body = json.loads(capsys.readouterr().out)
    assert faults(body) == []
    assert [(one["task"], one["by"]) for one in body["changes"]] == [(None, "ana.operator"), ("merge", "ada@robot1")]
    assert [one["by"] for one in body["moves"]] == ["ada@robot1"]
    for given, told in (({"task": "merge"}, ["merge"]), ({"task": None, "about": "edge1"}, [None])):
        assert history(HERE, is_json=True, **given) == 0
        assert [one["task"] for one in json.loads(capsys.readouterr().out)["changes"]] == told


@pytest.mark.usefixtures("pages")
def test_moves_of_one_task_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert history(HERE, "merge", is_json=True) == 0
    body = json.loads(capsys.readouterr().out)
    assert faults(body) == []
    assert body == {
        "schema": "zsched.history/1",
        "node": "robot1",
        "moves": [
            {
                "at": "2026-09-21T14:11:50.000Z",
                "age_s": 90.0,
                "task": "merge",
                "epoch": 2,
                "revision": 3,
                "from": "edge1",
                "to": "edge2",
                "is_known": False,
                "reason": "edge1 is gone",
                "votes": {"robot1": "edge2", "robot2": "edge2", "robot3": "edge1"},
                "switched_s": 0.086,
                "gap_s": 0.3,
                "by": None,
            }
        ],
        "rehearsals": [],
        "rollouts": [],
        "changes": [],
    }
    assert history(HERE, "nothing", is_json=False) == 0
    assert capsys.readouterr().out == "no move and no order of nothing in the log of robot1\n"


@pytest.mark.usefixtures("pages")
def test_events_of_one_task_and_of_the_last_time(capsys: pytest.CaptureFixture[str]) -> None:
    assert events(HERE, task="merge", since_s=85.0) == 0
    assert capsys.readouterr().out.splitlines() == [
        "2026-09-21T14:12:00.000Z vote       task=merge epoch=2 judged",
        "2026-09-21T14:12:10.000Z vote       task=merge epoch=2 flipped",
        "2026-09-21T14:12:11.000Z vote       task=merge epoch=2 answered",
        "2026-09-21T14:12:12.000Z vote       task=merge epoch=2 answered",
    ]
    assert events(HERE, is_json=True) == 0
    found = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [faults({"schema": "zsched.event/1", **one}) for one in found] == [[]] * len(found)
    told = ["a peer came", "learnt", "judged", "flipped", "answered", "answered", "learnt \x1b[2J"]
    assert [one["text"] for one in found] == told
    assert events(HERE) == 0
    assert "\x1b" not in capsys.readouterr().out


def test_who_follows_goes_on_where_it_was_and_outlasts_a_restart(
    pages: Pages, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    steps = iter(["quiet", "away", "away", "back", "end"])

    def sleep(_s: float) -> None:
        step = next(steps)
        pages.is_away = step == "away"
        if step == "back":
            pages.entries.append(entry("newer", 1.0))
        if step == "end":
            raise KeyboardInterrupt

    monkeypatch.setattr("zsched.commands.look.history.time.sleep", sleep)
    assert events(HERE, is_following=True) == 0
    captured = capsys.readouterr()
    assert captured.out.count("learnt") == 2
    assert captured.out.splitlines()[-1].endswith("newer")
    assert captured.err.count("asking again") == 1


def test_another_machine_tells_its_moves_and_refuses_its_events(
    pages: Pages, capsys: pytest.CaptureFixture[str]
) -> None:
    there = Door(socket=Path("s"), node="robot2")
    with pytest.raises(CliError, match="lies on its machine: ask there; --about node/robot2") as refused:
        events(there)
    assert (refused.value.code, pages.asked) == (EXIT_USAGE, [])
    assert history(there, "merge", is_json=True) == 0
    assert {request["verb"] for request in pages.asked} == {"history"}
    assert [move["epoch"] for move in json.loads(capsys.readouterr().out)["moves"]] == [2]
    assert history(HERE, "merge", is_json=True) == 0
    assert pages.asked[-1]["verb"] == "log"


def test_all_pages_of_a_cell_s_history_are_told_by_the_node_that_told_the_first(pages: Pages) -> None:
    """A cursor is a place in one node's log; another gateway would begin again with its own."""
    cell = Cell(name="hall-b", gateways=("tcp/192.0.2.31:7457", "tcp/192.0.2.32:7457"))
    there = Door(socket=Path(), endpoint=cell.gateways[0], cell=cell)
    assert history(there, None, is_json=False) == 0
    assert pages.nodes == [None, *["robot1"] * (len(pages.asked) - 1)]
    assert len(pages.asked) > 2


def test_a_node_that_cannot_read_its_log_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    refused = {"outcome": "invalid", "detail": "its decision log cannot be read", "revision": None}
    monkeypatch.setattr(verb, "ask_door", lambda *_given: refused)
    with pytest.raises(CliError, match="its decision log cannot be read"):
        history(Door(socket=Path("s"), node="robot2"), None, is_json=False)


@pytest.mark.usefixtures("pages")
def test_a_name_that_neither_the_log_nor_the_fleet_has_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(CliError, match=r"^fleet hall has no task 'merg'; did you mean merge") as refused:
        history(HERE, "merg", is_json=False)
    assert refused.value.code == EXIT_USAGE
    with pytest.raises(CliError, match=r"^fleet hall has no node 'nosuch'; there are edge1,") as refused:
        history(HERE, None, about="nosuch", is_json=True)
    assert (refused.value.code, capsys.readouterr().out) == (EXIT_USAGE, "")
    assert history(HERE, None, about="edge2", is_json=False) == 0, "a node that is gone has a past"


def test_events_of_one_node_name_it_as_a_whole_word(pages: Pages, capsys: pytest.CaptureFixture[str]) -> None:
    pages.entries = [
        entry("edge1 is gone", 9.0, task=""),
        entry("edge11 is gone", 8.0, task=""),
        entry("learnt", 7.0, move=MOVE),
        entry("propose edge2: nothing [edge1=0.479 edge2=0.5]", 6.0),
        entry("hedge1 and edge1-b", 5.0),
    ]
    assert events(HERE, node="edge1", is_json=True) == 0
    told = [json.loads(line)["text"] for line in capsys.readouterr().out.splitlines()]
    assert told == ["edge1 is gone", "learnt", "propose edge2: nothing [edge1=0.479 edge2=0.5]"]


# --- replay ----------------------------------------------------------------------------------------------------------


def decision(value: float) -> Decision:
    column = tuple(Utility(candidate=name, value=one, cpu=one) for name, one in (("edge1", 0.1), ("edge2", value)))
    spec = task_of(
        tuning=tuning_of(cpu=1.0, memory=0.0),
        price_s=0.15,
        worker=WorkerSpec(command=("merge",)),
    )
    vector = UtilityVector(voter="robot1", task="merge", revision=4, utilities=column)
    figures = figures_of(spec, "robot1", now=12.345678901234567, vectors=(vector,))
    return Decision(figures=figures, verdict=verdict_of(decide_again(figures).judgement))


def log_of(folder: Path, *decisions: Decision) -> Path:
    log = DecisionLog(folder, "robot1", 7, lambda _problem: None)
    log.start()
    log.put(RecordStory(stage="vote", text="learnt", move=Move(epoch=1, revision=1, left=None, owner="a", reason="")))
    for one in decisions:
        log.put(RecordStory(stage="scheduler", text="judged", task="merge", decision=one))
    log.close()
    return folder / NAME


def run(*arguments: object) -> Any:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_a_log_is_judged_again_and_all_is_equal(tmp_path: Path) -> None:
    file = log_of(tmp_path, decision(0.1), decision(1 / 3), decision(0.9))
    done = run("explain", "--replay", file)
    assert (done.exit_code, done.stdout) == (0, "3 judgements made again, all equal\n")
    body = json.loads(run("explain", "--replay", file, "--json").stdout)
    assert faults(body) == []
    assert (body["schema"], body["judged"], body["equal"]) == ("zsched.replay/1", 3, True)


def test_the_first_judgement_that_differs_is_named(tmp_path: Path) -> None:
    """One bit of one number is enough."""
    one = decision(1 / 3)
    aggregates = tuple((name, value * (1 + 2**-52)) for name, value in one.verdict.aggregates)
    other = replace(one, verdict=replace(one.verdict, aggregates=aggregates))
    file = log_of(tmp_path, one, other, other)
    done = run("explain", "--replay", file)
    assert done.exit_code == 1
    assert [line.split(" ")[0] for line in done.stdout.splitlines()] == [f"{file}:3:", f"{file}:3:"]
    body = json.loads(run("explain", "--replay", file, "--json").stdout)
    assert faults(body) == []
    assert (body["judged"], body["equal"], body["line"]) == (1, False, 3)


@pytest.mark.parametrize("cut", [1, 12, 60, 400])
@pytest.mark.parametrize("filled", [b"", bytes(64)])
def test_a_line_that_a_power_cut_has_torn_is_left_out_and_told(tmp_path: Path, cut: int, filled: bytes) -> None:
    """The daemon goes on below it, and what came before and after is judged."""
    file = log_of(tmp_path, decision(0.1), decision(0.5))
    whole = file.read_bytes()
    file.write_bytes(whole[: whole[:-1].rindex(b"\n") + 1 + cut] + filled)
    done = run("explain", "--replay", file)
    assert (done.exit_code, done.stdout.splitlines()[0]) == (0, "1 judgement made again, all equal")
    assert done.stdout.splitlines()[1].endswith("has torn it: line 3")
    log_of(tmp_path, decision(0.9))
    body = json.loads(run("explain", "--replay", file, "--json").stdout)
    assert faults(body) == []
    assert (body["judged"], body["equal"], body["torn"]) == (2, True, [3])
