"""`zsched explain`: what is printed adds up, whom an edge sends the question on to, exit codes."""

from __future__ import annotations

import json
import math
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from support.allocations import allocation_of
from support.decisions import figures_of
from support.equations import total_utility
from support.fleets import task_of, tuning_of
from support.schemas import faults
from zsched.commands.base.ask import Door
from zsched.commands.base.common import CliError
from zsched.commands.look import explain as verb
from zsched.commands.look.explain import SCHEMA, explain, formula_of
from zsched.core.scheduler.decision import decide_again, verdict_of
from zsched.core.values.decision import Decision, Explanation, JudgeMemory, KeptMemory, Move, Need
from zsched.core.values.exits import EXIT_FAILED, EXIT_UNREACHABLE, EXIT_USAGE, EXIT_WOULD_CHANGE
from zsched.core.values.fleet import WorkerSpec
from zsched.core.values.instructions import RecordStory
from zsched.core.values.model import ScoreForm, Utility, UtilityVector, Weights
from zsched.core.values.snapshot import VoteStatus
from zsched.host.decision_log import NAME, DecisionLog
from zsched.link.requests import answer_json

ROBOTS = ("robot1", "robot2", "robot3")
TUNING = tuning_of(cpu=0.5, memory=0.3, network=0.2, bonus=0.05)
VALUE = allocation_of(4, epoch=3, tuning=TUNING)
TERMS = {"edge1": (0.75, 0.5, 0.5), "edge2": (0.5, 0.5, 0.25)}


def decision() -> Decision:
    column = tuple(
        Utility(candidate=name, value=0.5 * cpu + 0.3 * memory + 0.2 * net, cpu=cpu, memory=memory, network=net)
        for name, (cpu, memory, net) in TERMS.items()
    )
    refused = (("edge3", "worker failed: no model"),)
    vectors = tuple(
        UtilityVector(voter=robot, task="merge", revision=4, utilities=column, refused=refused) for robot in ROBOTS[:2]
    )
    spec = task_of(
        candidates=("edge1", "edge2", "edge3"), price_s=0.15, tuning=TUNING, worker=WorkerSpec(command=("merge",))
    )
    kept = KeptMemory(owner="edge1", seen=(("edge2", 0.45, 0.42, 1000.0),))
    figures = figures_of(spec, *ROBOTS, vectors=vectors, judge=JudgeMemory(kept=kept))
    needs = (Need(candidate="edge1", cpu_cores=0.4, memory_mb=250.0),)
    return Decision(figures=figures, verdict=verdict_of(decide_again(figures).judgement), needs=needs)


class Fleet:
    """Stands for the daemons: what each node answers."""

    def __init__(self) -> None:
        vote = VoteStatus(base_revision=3, votes=(("robot1", "edge1"),), outcome="won", winner="edge1", age_s=9.0)
        robot = Explanation(
            node="robot1",
            kind="robot",
            task="merge",
            allocation=VALUE,
            robots=ROBOTS,
            decision=decision(),
            age_s=0.25,
            vote=vote,
        )
        edge = Explanation(node="edge1", kind="edge", task="merge", allocation=VALUE, robots=ROBOTS)
        self.answers: dict[str | None, Any] = {"robot1": robot, None: robot, "edge1": edge}
        self.asked: list[str | None] = []
        self.silent: set[str] = set()
        self.log: DecisionLog | None = None

    def ask(self, door: Door, request: dict[str, Any], timeout_s: float = 5.0) -> dict[str, Any]:
        assert timeout_s > 0
        self.asked.append(door.node)
        if request["verb"] == "log":
            assert self.log is not None
            return dict(json.loads(json.dumps(self.log.answer(request))))
        if door.node in self.silent:
            raise CliError(EXIT_UNREACHABLE, f"no daemon of {door.node}")
        if request["task"] != "merge":
            return {"outcome": "invalid", "detail": "no task 'merg'; there are merge"}
        answer = json.loads(json.dumps(answer_json(self.answers[door.node])))
        return dict(answer)


@pytest.fixture
def fleet(monkeypatch: pytest.MonkeyPatch) -> Fleet:
    made = Fleet()
    monkeypatch.setattr(verb, "ask_door", made.ask)
    return made


def asked(node: str | None = None, task: str = "merge", *, is_json: bool = False, **more: Any) -> int:
    said: Any = SimpleNamespace(door=lambda: Door(socket=Path("s"), node=node), json_=is_json)
    return explain(said, task, **more)


def test_verbs_that_only_show_load_no_values_and_no_scheduler() -> None:
    """The values alone take a quarter of the verb's time, the scheduler as long as the whole of it."""
    look = "zsched.commands.look"
    verbs = f"{look}.status, zsched.commands.base.report, {look}.history, {look}.explain"
    code = f"import sys, zsched.cli, {verbs}; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    heavy = ("zsched.core.values.model", "zsched.core.scheduler", "zsched.wire", "msgpack", "zenoh")
    assert "zsched.commands.look.explain" in loaded
    assert [one for one in loaded if one.startswith(heavy)] == []


def by_formula(text: str, **terms: float) -> float:
    """What a reader gets who puts a row's terms into the line WORTH."""
    found = re.search(r"^WORTH +(.*)$", text, re.MULTILINE)
    assert found is not None
    if " x " in found[1] or "^" in found[1]:
        parts = [one.partition("^") for one in found[1].split(" x ")]
        return float(math.prod(terms[name] ** float(power or 1) for name, _, power in parts))
    return sum(float(weight) * terms[name] for weight, name in (one.split() for one in found[1].split(" + ")))


@pytest.mark.parametrize(
    ("score", "said"),
    [("paper", "0.4 cpu + 0.4 mem + 0.2 gpu"), ("service", "cpu x mem x gpu^0.5")],
)
def test_the_line_of_the_utility_is_what_the_core_reckons(score: str, said: str) -> None:
    """Nobody measured the network, so its weight is shared out by the paper's score, and left out by service."""
    weights = Weights.of({"cpu": 0.3, "memory": 0.3, "network": 0.25, "gpu": 0.15})
    view = {"cpu": 0.5, "memory": 0.8, "network": None, "gauges": {"gpu": 0.9}}
    tuning = {"score": score, "weights": {"cpu": 0.3, "memory": 0.3, "network": 0.25, "gauges": {"gpu": 0.15}}}
    told = formula_of({"tuning": tuning, "candidates": [{"robots": [view]}, {"robots": []}]})
    assert told == said
    measured = frozenset({"cpu", "memory", "gpu"})
    form = ScoreForm(score)
    utility = total_utility(
        weights, cpu=0.5, memory=0.8, network=None, measured=measured, form=form, gauges={"gpu": 0.9}
    )
    assert by_formula(f"WORTH      {told}", cpu=0.5, mem=0.8, gpu=0.9) == pytest.approx(utility)
    assert formula_of({"tuning": tuning, "candidates": []}) == ""


@pytest.mark.usefixtures("fleet")
def test_what_is_printed_adds_up(capsys: pytest.CaptureFixture[str]) -> None:
    assert asked() == 0
    text = capsys.readouterr().out
    rows = re.findall(r"^(\w*) +(robot\d) +([\d.]+) +([\d.]+) +([\d.]+) +([\d.]+)$", text, re.MULTILINE)
    sums = re.findall(r"mean ([\d.]+)(?: - not kept ([\d.]+))?(?: \+ bonus ([\d.]+))? = ([\d.]+)", text)
    utilities: dict[str, list[float]] = {}
    name = ""
    for candidate, _, *numbers in rows:
        name = candidate or name
        cpu, memory, network, utility = map(float, numbers)
        assert utility == pytest.approx(0.5 * cpu + 0.3 * memory + 0.2 * network, abs=1e-4)
        assert utility == pytest.approx(by_formula(text, cpu=cpu, mem=memory, net=network), abs=2e-4)
        utilities.setdefault(name, []).append(utility)
    assert list(utilities) == ["edge1", "edge2"]
    for column, (joint, unkept, bonus, total) in zip(utilities.values(), sums, strict=True):
        assert float(joint) == pytest.approx(sum(column) / len(column), abs=1e-4)
        assert float(total) == pytest.approx(float(joint) + float(bonus or 0) - float(unkept or 0), abs=2e-4)
    assert [sum_[1:3] for sum_ in sums] == [("", "0.05"), ("0.0300", "")]
    assert "silent: robot3" in text
    assert "needs 0.40 cores 250M" in text
    assert "won edge1 · robot1 for edge1" in text
    assert max(map(len, text.splitlines())) <= 160


@pytest.mark.usefixtures("fleet")
def test_json_names_its_schema_and_holds_the_same_sums(capsys: pytest.CaptureFixture[str]) -> None:
    assert asked(is_json=True) == 0
    body = json.loads(capsys.readouterr().out)
    assert faults(body) == []
    assert (body["schema"], body["node"], body["task"], body["outcome"]) == (SCHEMA, "robot1", "merge", "stay")
    assert body["silent"] == ["robot3"]
    for one in body["candidates"]:
        if one["total"] is not None:
            assert one["total"] == one["joint"] - one["unkept"] + one["bonus"]
    assert [one["node"] for one in body["candidates"]] == ["edge1", "edge2", "edge3"]
    assert body["plan"] is None
    assert body["vote"]["votes"] == {"robot1": "edge1"}


@pytest.mark.usefixtures("fleet")
def test_a_plan_says_where_the_task_would_go(capsys: pytest.CaptureFixture[str]) -> None:
    assert asked(plan="edge1=down") == EXIT_WOULD_CHANGE
    text = capsys.readouterr().out
    assert "WITHOUT edge1" in text
    assert "propose edge2 · edge1 is gone" in text
    assert asked(plan="edge2=down", is_json=True) == 0
    body = json.loads(capsys.readouterr().out)
    assert faults(body) == []
    assert (body["plan"]["without"], body["plan"]["would_move"], body["plan"]["outcome"]) == (
        "edge2",
        False,
        "none",
    ) or (body["plan"]["outcome"] == "stay")


@pytest.mark.usefixtures("fleet")
def test_a_plan_for_a_node_that_is_not_there_names_the_nearest() -> None:
    with pytest.raises(CliError, match="did you mean edge") as refused:
        asked(plan="edg1=down")
    assert refused.value.code == EXIT_USAGE


def test_an_edge_sends_the_question_on_and_says_so_when_it_was_meant(
    fleet: Fleet, capsys: pytest.CaptureFixture[str]
) -> None:
    fleet.answers[None] = fleet.answers["edge1"]
    assert asked() == 0
    assert "as robot1 judged it" in capsys.readouterr().out
    assert fleet.asked == [None, "robot1"]
    with pytest.raises(CliError, match="ask a robot: --node robot1"):
        asked("edge1")


# --- what one robot sees ---------------------------------------------------------------------------------------------


def test_a_robot_s_view_is_its_own_judgement_with_its_terms_and_whom_it_hears(
    fleet: Fleet, capsys: pytest.CaptureFixture[str]
) -> None:
    fleet.answers["robot2"] = replace(fleet.answers["robot1"], node="robot2")
    assert asked(robot="robot2") == 0
    text = capsys.readouterr().out
    assert fleet.asked == [None, "robot2"]
    assert "as robot2 judged it" in text
    assert "HEARS      robots robot1, robot2, robot3 · electors robot1, robot2, robot3" in text
    assert re.search(r"^edge1 +0.7500 +0.5000 +0.5000 +0.6250  ?highest", text, re.MULTILINE), text
    assert re.search(r"^edge3 .*worker failed", text, re.MULTILINE), text
    assert "ITS CHOICE" in text
    assert "TO MOVE" not in text
    assert asked(robot="robot2", is_json=True) == 0
    body = json.loads(capsys.readouterr().out)
    assert faults(body) == []
    assert (body["robot"]["robot"], body["robot"]["best"], body["robot"]["is_own"]) == ("robot2", "edge1", True)


def test_of_a_robot_that_does_not_answer_another_tells_what_it_heard(
    fleet: Fleet, capsys: pytest.CaptureFixture[str]
) -> None:
    fleet.silent = {"robot2", "robot3"}
    assert asked(robot="robot2") == 0
    captured = capsys.readouterr()
    assert "what robot1 has heard of robot2" in captured.err
    assert "HEARS" not in captured.out, "nobody knows whom it hears"
    assert "0.6250" in captured.out
    assert asked(robot="robot3") == 0
    assert "robot1 has no worth from robot3" in capsys.readouterr().out


# --- a judgement of the past -----------------------------------------------------------------------------------------


@pytest.fixture
def past(fleet: Fleet, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Fleet:
    """A log of two moves: at 1000 s and at 2000 s of the wall clock, each 1 s after its judgement."""
    moments = iter([999.0, 999.5, 1000.0, 1500.0, 1999.0, 2000.0, 2050.0, 2060.0])
    monkeypatch.setattr("zsched.host.decision_log.wall_s", lambda: next(moments, 2100.0))
    fleet.log = DecisionLog(tmp_path, "robot1", 7, lambda _problem: None)
    fleet.log.start()

    def judged(epoch: int, owner: str, cpu: float, task: str = "merge") -> None:
        assert fleet.log is not None
        made = decision()
        value = replace(VALUE, epoch=epoch, owner=owner, task=task)
        vectors = tuple(
            replace(
                one,
                utilities=tuple(
                    replace(utility, cpu=cpu, value=0.5 * cpu + 0.15 + 0.1) if utility.candidate == owner else utility
                    for utility in one.utilities
                ),
            )
            for one in made.figures.vectors
        )
        figures = replace(made.figures, allocation=value, vectors=vectors)
        again = replace(made, figures=figures, verdict=verdict_of(decide_again(figures).judgement))
        fleet.log.put(RecordStory(stage="scheduler", text="judged", task=task, epoch=epoch, decision=again))

    def moved(epoch: int, left: str, owner: str) -> None:
        assert fleet.log is not None
        move = Move(
            epoch=epoch, revision=epoch + 1, left=left, owner=owner, reason="nearer", votes=(("robot1", owner),)
        )
        fleet.log.put(RecordStory(stage="vote", text="learnt", task="merge", epoch=epoch, move=move))

    judged(3, "edge1", 0.11)
    judged(3, "edge1", 0.99, task="other")
    moved(4, "edge1", "edge2")
    judged(4, "edge2", 0.22)
    judged(4, "edge2", 0.33)
    moved(5, "edge2", "edge1")
    judged(5, "edge1", 0.44)
    again = Move(epoch=5, revision=6, left=None, owner="edge1", reason="known from before the restart", is_known=True)
    fleet.log.put(RecordStory(stage="vote", text="learnt", task="merge", epoch=5, move=again))
    fleet.log.close()
    return fleet


def cpu_of_owner(body: dict[str, Any]) -> float:
    return float(next(one for one in body["candidates"] if one["is_owner"])["robots"][0]["cpu"])


@pytest.mark.usefixtures("past")
def test_the_judgement_that_made_an_epoch_is_told_whole_with_its_move(capsys: pytest.CaptureFixture[str]) -> None:
    for word, owner, cpu, made in (("4", "edge1", 0.11, 4), ("5", "edge2", 0.33, 5)):
        assert asked(at=word, is_json=True) == 0
        body = json.loads(capsys.readouterr().out)
        assert faults(body) == []
        assert (body["owner"], cpu_of_owner(body), body["made"]["epoch"]) == (owner, cpu, made)
        for one in body["candidates"]:
            if one["total"] is not None:
                assert one["total"] == one["joint"] - one["unkept"] + one["bonus"]
    assert asked(at="5") == 0
    text = capsys.readouterr().out
    assert "judged it 1m41s ago (1970-01-01T00:33:19.000Z)" in text
    assert "THEN       edge2 -> edge1, epoch 5 · nearer · robot1 for edge1" in text
    assert "VOTE" not in text
    assert asked(at="4", robot="robot2") == 0
    assert "0.1100" in capsys.readouterr().out


def test_a_past_that_is_not_there_is_said_with_what_there_is(past: Fleet, tmp_path: Path) -> None:
    refusals = {
        "9": (EXIT_FAILED, "no move of merge to epoch 9; it knows epochs 4 to 5"),
        "3": (EXIT_FAILED, "no move of merge to epoch 3"),
        "5h": (EXIT_FAILED, "no judgement of merge of 5h ago or before"),
        "1970-01-01T00:00:00Z": (EXIT_FAILED, "no judgement of merge until"),
        "yesterday": (EXIT_USAGE, "an epoch .12., an age"),
        "9" * 5000: (EXIT_USAGE, "an epoch .12., an age"),
    }
    for word, (code, text) in refusals.items():
        with pytest.raises(CliError, match=text) as refused:
            asked(at=word)
        assert refused.value.code == code
    with pytest.raises(CliError, match="lies on each robot") as elsewhere:
        asked("robot1", at="4")
    assert elsewhere.value.code == EXIT_USAGE
    (tmp_path / NAME).unlink()
    past.answers[None] = past.answers["edge1"]
    with pytest.raises(CliError, match="no move of merge to epoch 4; it knows no move of it"):
        asked(at="4")
    with pytest.raises(CliError, match="is an edge and decides nothing: ask on a robot"):
        asked(at="1h")
