"""`zsched task hand`: its steps between two cells, broken off at each and given again; the nodes are stand-ins."""

from __future__ import annotations

import contextlib
import copy
import itertools
import json
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from support.doors import STATUS, living
from support.fleet_values import fleet_value_of
from support.schemas import faults
from zsched.adapters.host.operator_socket import Json, OperatorSocket
from zsched.cli import app
from zsched.clock import monotonic_s
from zsched.commands import hand, hand_steps, lacks
from zsched.commands.ask import Door, ask_door
from zsched.config.editing import task_entry
from zsched.config.handing import Mark, mark_of, marked
from zsched.config.load import check_bytes
from zsched.core.values.document import MAX_DOCUMENT_BYTES, Document, Text
from zsched.core.values.electorate import Creation, Elector
from zsched.core.values.fleet import Cell, Fleet
from zsched.wire.codec import as_plain, document_hash

ENTRY = """\
  echo:  # answers
    candidates: {kind: robot}
    weights: {cpu: 0.5, memory: 0.5}
    worker: {command: [python, -m, zsched.tasks.echo]}
    inputs: [{from: "{robot}/in", to: "{target}/echo/{robot}/in"}]
    outputs: [{from: "{target}/echo/{epoch}/{robot}/out", to: "{robot}/out"}]
"""
A = f"""\
fleet: hall-a
nodes:
  robot1: {{kind: robot}}
  robot2: {{kind: robot, host: 127.0.0.1, listen: {{control: tcp/127.0.0.1:7461, data: tcp/127.0.0.1:7462}}}}
tasks:
{ENTRY}  other: {{candidates: {{kind: robot}}, weights: {{cpu: 1}}}}
site:
  hall-b: {{gateways: ["tcp/127.0.0.1:7557", "tcp/127.0.0.1:7561"]}}
"""
B = """\
fleet: hall-b
nodes:
  robot3: {kind: robot, host: 127.0.0.1, listen: {control: tcp/127.0.0.1:7557, data: tcp/127.0.0.1:7558}}
  robot4: {kind: robot}
# what hall-b does
tasks:
  sweep: {candidates: {kind: robot}, weights: {cpu: 1}}
"""
LABELLED = A.replace("{kind: robot}\n    w", "{labels: {arm: a}}\n    w").replace(
    "t}\n  robot2", "t, labels: {arm: a}}\n  robot2"
)
"""Only nodes with a label may have the task, and hall-b has none."""
AGREED = "change"
"""The call by which a step is agreed."""
LEASE_S = 0.05


@cache
def fleet_of(text: str) -> Fleet:
    fleet = check_bytes(text.encode()).fleet
    assert fleet is not None
    return fleet


class Hall:
    """One cell, whose nodes agree on everything; of its electors some may be behind."""

    def __init__(self, site: Site, text: str) -> None:
        self.site, self.text = site, text
        self.name = text.split()[1]
        self.before = text
        self.revision = 7
        self.behind: set[str] = set()
        """Nodes that have not learnt the newest document."""
        self.is_whole = self.is_ready = self.answers = True
        self.outcomes: list[str] = []
        """Of the next changes, instead of being made."""
        self.doubt: tuple[int, str] | None = None
        """The base and the text of a change that ended with "unknown": one elector has accepted it, and is away."""
        self.asked: list[str] = []
        self.rollouts: list[Json] = []

    @property
    def has(self) -> bool:
        return any(task.name == "echo" for task in fleet_of(self.text).tasks)

    @property
    def names(self) -> list[str]:
        return [node.name for node in fleet_of(self.text).nodes]

    def answer(self, request: Json, who: str) -> Json:
        if not self.answers:
            return {"error": f"{self.name} is cut off"}
        who = str(request.get("node", who))
        if request["verb"] == "status":
            return self._status(who)
        return self._fleet(who) if request["verb"] == "fleet" else self._change(request)

    def _status(self, who: str) -> Json:
        text = self.before if who in self.behind else self.text
        fleet = fleet_of(text)
        nodes = [living(name, "robot", *(task.name for task in fleet.tasks)) for name in self.names]
        for worker in [one for node in nodes for one in node["workers"] if one["task"] == "echo"]:
            worker["state"] = "ready" if self.is_ready else "starting"
        tasks = []
        for spec in fleet.tasks:
            task = {**copy.deepcopy(STATUS["tasks"][0]), "name": spec.name, "owner": self.names[0], "streams": []}
            task |= {"candidates": list(spec.candidates), "phase": "settled", "owner_state": "alive", "problems": []}
            tasks.append(task | {"pin": None, "pause": None})
        quorum = {**STATUS["quorum"], "ok": self.is_whole}
        revision = self.revision - (who in self.behind)
        body = {**STATUS, "fleet": self.name, "node": who, "nodes": nodes, "tasks": tasks, "quorum": quorum}
        return {**body, "fleet_revision": revision}

    def _fleet(self, who: str) -> Json:
        fleet = fleet_of(self.text)
        electors = [Elector(name=name, disk="01", joining=1) for name in self.names]
        value = fleet_value_of(
            self.revision,
            *electors,
            number=2,
            fleet=self.name,
            creations=9,
            tasks=tuple(Creation(task=task.name, number=3) for task in fleet.tasks),
            lease_s=LEASE_S,
            guard_lease_s=LEASE_S,
            document=document_hash(Document(text=Text(self.text))),
        )
        body = {"node": who, "fleet": self.name, "revision": self.revision, "number": 2, "settled": True}
        told = {"electors": [{"name": name, "disk": "01"} for name in self.names], "document": value.document}
        return {**body, **told, "text": self.text, "flags": [], "rollouts": self.rollouts, "value": as_plain(value)}

    def _change(self, request: Json) -> Json:
        if request["base_revision"] != self.revision:
            return {"outcome": "conflict", "detail": "as told", "revision": self.revision}
        if self.outcomes:
            if self.outcomes[0] == "unknown":
                self.doubt = self.revision, request["text"]
            return {"outcome": self.outcomes.pop(0), "detail": "as told", "revision": self.revision}
        if not self.is_whole:
            return {"outcome": "no_quorum", "detail": "as told", "revision": self.revision}
        assert request["rollouts"] == self.rollouts
        self._take(request["text"])
        if self.has:
            self.behind.clear()  # the cut has healed
        self.asked.append(f"{request['by']} {request['why']}")
        self.site.look()
        return {"outcome": "ok", "detail": "as told", "revision": self.revision}

    def _take(self, text: str) -> None:
        self.before, self.text = self.text, text
        self.revision += 1

    def heal(self) -> None:
        """The elector is back: what it has accepted comes about, unless something else was agreed since."""
        doubt, self.doubt = self.doubt, None
        if doubt is not None and doubt[0] == self.revision:
            self._take(doubt[1])
            self.site.look()


class Site:
    """Two cells; what each change made of them."""

    def __init__(self, folder: Path) -> None:
        self.here, self.there = Hall(self, A), Hall(self, B)
        self.seen = [(True, False, monotonic_s())]
        self.doors = contextlib.ExitStack()
        (folder / "run").mkdir()
        (folder / "gates").mkdir()
        self._open(folder / "run" / "robot1.sock", lambda request: self.here.answer(request, "robot1"))
        self._open(folder / "gates" / "hall-b.sock", lambda request: self.there.answer(request, "robot3"))

    def _open(self, path: Path, answer: Any) -> None:
        door = OperatorSocket(path, answer)
        door.open()
        self.doors.callback(door.close)

    def look(self) -> None:
        self.seen.append((self.here.has, self.there.has, monotonic_s()))

    @property
    def has(self) -> tuple[bool, bool]:
        return self.here.has, self.there.has

    def make_exclusive(self) -> None:
        self.here.text = A.replace("  echo:  # answers\n", "  echo:  # answers\n    exclusive: true\n")

    def check(self, *, is_exclusive: bool) -> None:
        """The task was never in neither cell; or, an exclusive one, never in both, nor in the next within a lease."""
        pairs = itertools.pairwise(self.seen)
        changed = [self.seen[0], *(then for one, then in pairs if then[:2] != one[:2])]
        for (here, there, at), (then_here, then_there, then) in itertools.pairwise(changed):
            if is_exclusive:
                assert not (then_here and then_there)
                is_begun = (then_here, then_there) != (here, there) and (then_here or then_there)
                assert not is_begun or then - at >= LEASE_S
            else:
                assert then_here or then_there


def breaking(step: str, number: int = 0, *, is_after: bool = False) -> Callable[..., Any]:
    """The step, broken off when it is called for the ``number``-th time (from 0), before or behind its work."""
    real, left = getattr(hand_steps, step), [number]

    def broken(*given: Any, **more: Any) -> Any:
        left[0] -= 1
        if left[0] >= 0:
            return real(*given, **more)
        if is_after:
            real(*given, **more)
        raise KeyboardInterrupt

    return broken


def leave_under_way(site: Site, monkeypatch: pytest.MonkeyPatch, step: str = "_lack", *words: str) -> None:
    """Give the command, and break it off at the first call of a step."""
    with monkeypatch.context() as patch:
        patch.setattr(hand_steps, step, breaking(step))
        CliRunner().invoke(app, ["task", "hand", "echo", "hall-b", "-y", *words])
    assert mark_of(site.here.text, "echo") is not None


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    monkeypatch.setenv("ZSCHED_RUNTIME_DIR", str(tmp_path / "run"))
    monkeypatch.delenv("ZSCHED_NODE", raising=False)
    for module in (hand_steps, lacks):
        monkeypatch.setattr(module, "PAUSE_S", 0.001)
    monkeypatch.setattr(hand_steps, "BACK_S", 0.3)
    one = Site(tmp_path)

    def gate(cell: Cell, _fleet: str, _here: Door | None) -> Door:
        return Door(socket=tmp_path / "gates" / f"{cell.name}.sock")

    monkeypatch.setattr(hand, "door_of", gate)
    with one.doors:
        yield one


def run(*words: str) -> Result:
    result = CliRunner().invoke(app, ["task", "hand", "echo", *words])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def sorted_tasks(text: str) -> list[Any]:
    return sorted(fleet_of(text).tasks, key=lambda task: task.name)


def check_arrived(site: Site) -> None:
    assert site.has == (False, True)
    assert "echo" not in site.here.text
    assert site.here.text == A.replace(ENTRY, "")


def test_the_plan_shows_both_cells_and_changes_nothing(site: Site) -> None:
    plan = run("hall-b", "--plan")
    words = [line.split() for line in plan.stdout.splitlines()]
    assert plan.exit_code == 10
    assert ["echo", "cell", "hall-a", "hall-b"] in words
    assert ["echo", "owner", "robot1", "one", "of", "robot3,", "robot4"] in words
    assert ["echo", "works", "for", "robot1,", "robot2", "robot3,", "robot4"] in words
    assert ["echo", "in", "hall-a", "works", "works", "until", "hall-b", "is", "ready"] in words
    asked = run("hall-b")
    assert (asked.exit_code, "--yes" in asked.stderr) == (2, True)
    assert (site.here.text, site.there.text) == (A, B)
    assert faults(json.loads(run("hall-b", "--dry-run", "--json").stdout)) == []


def test_it_goes_over_and_works_here_until_it_is_ready_there(site: Site) -> None:
    done = run("hall-b", "-y", "-m", "new area")
    assert done.exit_code == 0, done.stderr
    check_arrived(site)
    assert site.there.text == B + ENTRY, "its lines, comments and all"
    site.check(is_exclusive=False)
    order = ["hall-a: revision 8 is agreed: echo is on its way to hall-b", "hall-b: revision 8 is agreed, with echo"]
    order += ["hall-b: echo is ready on robot3", "hall-a: revision 9 is agreed, without echo"]
    order += ["echo has gone from hall-a to hall-b"]
    places = [done.stdout.index(one) for one in order]
    assert places == sorted(places)
    assert all(asked.endswith(" new area") for asked in (*site.here.asked, *site.there.asked))
    again = run("hall-b", "-y")
    assert (again.exit_code, "none of hall-a: nothing to do" in again.stdout) == (0, True)
    assert faults(json.loads(run("hall-b", "-y", "--json").stdout)) == []


def test_an_exclusive_task_stops_here_before_it_begins_there(site: Site) -> None:
    site.make_exclusive()
    shown = run("hall-b", "--plan")
    assert "stops first" in shown.stdout
    done = run("hall-b", "-y")
    assert done.exit_code == 0, done.stderr
    check_arrived(site)
    site.check(is_exclusive=True)
    assert (True, True) not in [one[:2] for one in site.seen]
    assert done.stdout.index("hall-a: nobody works on echo: robot1, robot2 renew no lease") < done.stdout.index(
        "hall-b: revision 8 is agreed, with echo"
    )


def test_a_node_that_begins_anew_meanwhile_and_knows_no_value_yet_is_waited_for(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    site.make_exclusive()
    begun: list[Json] = [{"node": "robot1", "revision": None}]
    monkeypatch.setattr(hand_steps, "ask_door", lambda *given: begun.pop() if begun else ask_door(*given))
    done = run("hall-b", "-y")
    assert (done.exit_code, begun) == (0, []), done.stderr
    check_arrived(site)


def test_an_exclusive_task_of_which_a_lease_may_go_on_is_not_begun_there(site: Site) -> None:
    site.make_exclusive()
    site.here.behind = {"robot2"}  # one of two electors: no majority knows
    refused = run("hall-b", "-y", "--deadline", "0.3s")
    assert refused.exit_code == 1
    assert "1 of the electors robot1, robot2 of hall-a know that it ends, 2 needed" in refused.stderr
    assert (site.has, site.there.text) == ((True, False), B)
    assert mark_of(site.here.text, "echo") is None
    site.check(is_exclusive=True)


def test_a_task_that_has_just_become_exclusive_stays_until_all_go_by_it(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    site.make_exclusive()
    real = site.here._status

    def told(who: str) -> Json:
        status = real(who)
        text = "exclusive by this node's fleet file, not yet for the fleet: robot2 waits, or works without a lease"
        status["tasks"][0]["problems"] = [text]
        return status

    monkeypatch.setattr(site.here, "_status", told)
    refused = run("hall-b", "-y")
    assert (refused.exit_code, "not yet for the fleet" in refused.stderr) == (1, True)
    assert len(site.seen) == 1


@pytest.mark.parametrize("is_exclusive", [False, True])
@pytest.mark.parametrize("is_after", [False, True])
@pytest.mark.parametrize(("step", "number"), [("change", 0), ("change", 1), ("change", 2), ("_lack", 0)])
@pytest.mark.parametrize("way", ["on", "back"])
def test_broken_off_anywhere_it_goes_on_or_is_taken_back(
    site: Site, monkeypatch: pytest.MonkeyPatch, step: str, number: int, is_after: bool, is_exclusive: bool, way: str
) -> None:
    if is_exclusive:
        site.make_exclusive()
    first = site.here.text
    with monkeypatch.context() as patch:
        patch.setattr(hand_steps, step, breaking(step, number, is_after=is_after))
        ended = CliRunner().invoke(app, ["task", "hand", "echo", "hall-b", "-y"])
        assert ended.exit_code != 0
        assert "broken off" in ended.stderr
    if way == "on":
        done = run("hall-b", "-y")
        assert done.exit_code == 0, done.stderr
        check_arrived(site)
    elif mark_of(site.here.text, "echo") is not None or site.here.has:
        done = run("hall-a", "-y")
        assert done.exit_code == 0, done.stderr
        assert site.has == (True, False)
        assert site.there.text == B
        assert mark_of(site.here.text, "echo") is None
        assert sorted_tasks(site.here.text) == sorted_tasks(first)
    site.check(is_exclusive=is_exclusive)


@pytest.mark.parametrize("number", range(3))
@pytest.mark.parametrize("is_exclusive", [False, True])
@pytest.mark.parametrize("is_after", [False, True])
def test_a_way_back_that_was_broken_off_goes_on_either_way(
    site: Site, monkeypatch: pytest.MonkeyPatch, number: int, is_exclusive: bool, is_after: bool
) -> None:
    if is_exclusive:
        site.make_exclusive()
    site.there.is_ready = False
    with monkeypatch.context() as patch:
        patch.setattr(hand_steps, AGREED, breaking(AGREED, 2 + number, is_after=is_after))
        assert CliRunner().invoke(app, ["task", "hand", "echo", "hall-b", "-y", "--deadline", "0.1s"]).exit_code != 0
    site.there.is_ready = True
    done = run("hall-b", "-y")
    assert done.exit_code == 0, done.stderr
    assert site.has == (False, True)
    site.check(is_exclusive=is_exclusive)


@pytest.mark.parametrize("is_exclusive", [False, True])
def test_a_cell_that_does_not_get_it_ready_gives_it_back(site: Site, is_exclusive: bool) -> None:
    if is_exclusive:
        site.make_exclusive()
    site.there.is_ready = False
    refused = run("hall-b", "-y", "--deadline", "0.2s")
    assert refused.exit_code == 1
    assert "hall-b has not taken it: the worker on robot3 is starting; it is taken back" in refused.stderr
    assert "echo is a task of hall-a as before" in refused.stderr
    assert (site.has, site.there.text) == ((True, False), B)
    assert mark_of(site.here.text, "echo") is None
    site.check(is_exclusive=is_exclusive)
    site.there.is_ready = True
    assert run("hall-b", "-y").exit_code == 0
    check_arrived(site)


def test_what_is_missing_is_told_while_it_waits(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lacks, "LONG_S", 0.0)
    site.there.is_ready = False
    refused = run("hall-b", "-y", "--deadline", "1s")
    assert refused.stdout.count("echo: waits, for at most ") == 1
    assert refused.stdout.count(": the worker on robot3 is starting") == 1


@pytest.mark.parametrize("is_exclusive", [False, True])
def test_a_cell_that_is_cut_off_meanwhile_keeps_nothing_from_being_said(
    site: Site, monkeypatch: pytest.MonkeyPatch, is_exclusive: bool
) -> None:
    if is_exclusive:
        site.make_exclusive()

    def cut(*_given: object) -> str:
        site.there.answers = False
        return "it is silent"

    with monkeypatch.context() as patch:
        patch.setattr(hand_steps, "_lack", cut)
        refused = run("hall-b", "-y", "--deadline", "0.1s")
    assert refused.exit_code == 5
    told = " ".join(refused.stderr.split())
    works = "nobody does it in hall-a: it may work" if is_exclusive else "it works on in hall-a, and may work"
    assert works in told
    assert "echo is not taken back: hall-b is cut off" in told
    assert "`zsched task hand echo hall-b` goes on, `zsched task hand echo hall-a` takes it back" in told
    assert site.has == (not is_exclusive, True)
    site.there.answers = True
    assert run("hall-a", "-y").exit_code == 0
    assert site.has == (True, False)
    site.check(is_exclusive=is_exclusive)


def test_what_the_other_cell_refuses_is_taken_back_at_once(site: Site) -> None:
    site.there.outcomes = ["invalid"]
    refused = run("hall-b", "-y", "--deadline", "1h")
    assert (refused.exit_code, site.has) == (1, (True, False))
    assert "hall-b has not taken it: invalid: as told" in refused.stderr


def test_an_answer_that_is_lost_or_no_quorum_is_waited_for(site: Site) -> None:
    site.there.outcomes = ["no_quorum", "unknown"]
    assert run("hall-b", "-y").exit_code == 0
    check_arrived(site)


def test_what_another_change_overtakes_is_proposed_again(site: Site) -> None:
    site.here.outcomes, site.there.outcomes = ["conflict"], ["conflict", "conflict"]
    assert run("hall-b", "-y").exit_code == 0
    check_arrived(site)


def test_a_task_that_somebody_has_taken_back_meanwhile_is_not_begun_again(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    site.make_exclusive()
    real = hand_steps._given

    def overtaken(way: Any, text: str) -> str:
        site.here.text = A
        return real(way, text)

    monkeypatch.setattr(hand_steps, "_given", overtaken)
    refused = run("hall-b", "-y")
    assert refused.exit_code == 1
    assert "somebody else has taken that over, or brought it to its end" in refused.stderr
    assert (site.here.text, site.there.text) == (A, B)


def test_its_own_cell_s_name_has_nothing_to_do_for_a_task_that_is_not_on_its_way(site: Site) -> None:
    done = run("hall-a", "-y")
    assert (done.exit_code, "echo is a task of hall-a: nothing to do" in done.stdout) == (0, True)
    assert len(site.seen) == 1


def test_a_task_on_its_way_goes_nowhere_else(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    site.here.text = A + "  hall-c: {gateways: [tcp/127.0.0.1:1, tcp/127.0.0.1:2]}\n"
    leave_under_way(site, monkeypatch)
    wrong = run("hall-c", "-y")
    assert (wrong.exit_code, "echo is on its way from hall-a to hall-b" in wrong.stderr) == (2, True)
    assert "between hall-a and hall-b" in run("hall-a", "--plan").stdout
    assert "between hall-a and hall-b" in run("hall-b", "--plan").stdout


@pytest.mark.parametrize(
    ("make", "words", "code", "told"),
    [
        (lambda _site: None, ("hall-x",), 2, "the site has no cell 'hall-x'"),
        (lambda site: setattr(site.there, "text", B + ENTRY), ("hall-b",), 1, "hall-b has a task echo of its own"),
        (lambda site: setattr(site.there, "is_whole", False), ("hall-b",), 1, "hall-b has no quorum now"),
        (lambda site: setattr(site.here, "is_whole", False), ("hall-b",), 1, "hall-a has no quorum now"),
        (lambda site: setattr(site.there, "answers", False), ("hall-b",), 1, "hall-b is cut off"),
        (lambda site: setattr(site.here, "rollouts", [{"task": "echo"}]), ("hall-b",), 1, "waits for a look"),
        (
            lambda site: setattr(site.here, "text", A.replace("{kind: robot}\n    w", "[robot1, robot2]\n    w")),
            ("hall-b",),
            1,
            "the entry of echo names robot1, robot2, no nodes of hall-b",
        ),
        (
            lambda site: setattr(site.here, "text", A.replace('"{robot}/in"', '"robot2/{robot}/in"')),
            ("hall-b",),
            1,
            "zsched task hand echo hall-b --entry FILE",
        ),
        (
            lambda site: setattr(site.here, "text", LABELLED),
            ("hall-b",),
            78,
            "the document of hall-b with echo",
        ),
    ],
)  # fmt: skip
def test_what_speaks_against_it_is_said_before_anything(
    site: Site, make: Any, words: tuple[str, ...], code: int, told: str
) -> None:
    make(site)
    before = site.here.text, site.there.text
    refused = run(*words, "-y")
    assert refused.exit_code == code, refused.stderr
    assert told in " ".join(refused.stderr.split())
    assert (site.here.text, site.there.text) == before


@pytest.mark.parametrize("is_exclusive", [False, True])
def test_a_document_that_could_not_lose_it_and_get_it_again_is_left_alone(site: Site, is_exclusive: bool) -> None:
    """Another task says the same by an anchor in this one's entry."""
    if is_exclusive:
        site.make_exclusive()
    text = site.here.text.replace("candidates: {kind: robot}\n", "candidates: &all {kind: robot}\n")
    site.here.text = text.replace("other: {candidates: {kind: robot}", "other: {candidates: *all")
    before = site.here.text
    refused = run("hall-b", "-y")
    assert (refused.exit_code, "nothing was changed: tasks.echo cannot be removed" in refused.stderr) == (78, True)
    assert (site.here.text, site.there.text) == (before, B)


def test_an_entry_for_the_other_cell_comes_from_a_file(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    site.here.text = A.replace("{kind: robot}\n    w", "[robot1, robot2]\n    w")
    file = tmp_path / "echo.yaml"
    file.write_text("tasks:\n  other: {candidates: [robot3], weights: {cpu: 1}}\n")
    wrong = run("hall-b", "-y", "--entry", str(file))
    assert (wrong.exit_code, "it holds other, and echo alone is handed over" in wrong.stderr) == (2, True)
    file.write_text("tasks:\n  echo: {candidates: [robot3], weights: {cpu: 1}}\n")
    leave_under_way(site, monkeypatch, "_lack", "--entry", str(file))
    other = tmp_path / "other.yaml"
    other.write_text("tasks:\n  echo: {candidates: [robot4], weights: {cpu: 1}}\n")
    refused = run("hall-b", "-y", "--entry", str(other))
    assert (refused.exit_code, "by another entry than" in refused.stderr) == (1, True)
    assert run("hall-b", "-y", "--entry", str(file)).exit_code == 0
    assert site.has == (False, True)
    assert "candidates: [robot3]" in site.there.text


def test_an_exclusive_task_in_both_documents_is_nobody_s_to_hand(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    site.make_exclusive()
    leave_under_way(site, monkeypatch)
    site.here.text = site.here.text.replace("tasks:\n", "tasks:\n" + ENTRY, 1)  # an operator applied the old file
    refused = run("hall-b", "-y")
    assert (refused.exit_code, "stands in the documents of both cells" in refused.stderr) == (1, True)


@pytest.mark.parametrize("is_exclusive", [False, True])
def test_a_document_that_forgets_what_is_on_its_way_is_a_danger(
    site: Site, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, is_exclusive: bool
) -> None:
    if is_exclusive:
        site.make_exclusive()
    file = tmp_path / "old.yaml"
    file.write_text(site.here.text)
    leave_under_way(site, monkeypatch)
    on_its_way = site.here.text
    refused = CliRunner().invoke(app, ["apply", str(file), "--yes"])
    told = " ".join(refused.stderr.split())
    assert (refused.exit_code, "--accept between-cells" in told) == (1, True)
    then = "it begins here, too" if is_exclusive else "nothing tells any more how it goes on"
    assert f"between-cells: echo is on its way to hall-b, and may work there: {then}" in told
    file.write_text(on_its_way.replace("site:", "timing: wifi\nsite:"))
    assert CliRunner().invoke(app, ["apply", str(file), "--yes"]).exit_code == 0, "the mark stays"
    file.write_text(A)
    assert CliRunner().invoke(app, ["apply", str(file), "--yes", "--accept", "between-cells"]).exit_code == 0


def test_an_unknown_task_is_named_beside_the_known_ones(site: Site) -> None:
    result = CliRunner().invoke(app, ["task", "hand", "ech", "hall-b", "-y"])
    assert (result.exit_code, "fleet hall-a has no task 'ech'; did you mean echo?" in result.stderr) == (2, True)
    assert len(site.seen) == 1


def test_an_elector_that_has_not_heard_of_the_task_yet_may_still_grant_it_a_lease() -> None:
    """It learns of its creation before it learns of its end."""
    told = {"fleet_revision": 3, "tasks": []}
    assert [hand_steps._is_rid(told, revision, "echo") for revision in (3, 4)] == [True, False]
    assert not hand_steps._is_rid({**told, "tasks": [{"name": "echo"}]}, 3, "echo")


# --- two commands, and a change that may or may not have been agreed --------------------------------------------------


@pytest.mark.parametrize("is_exclusive", [False, True])
def test_a_command_that_slept_before_its_change_there_finds_that_it_was_taken_back(
    site: Site, monkeypatch: pytest.MonkeyPatch, is_exclusive: bool
) -> None:
    """It has seen the mark; meanwhile another operator takes the task back, and then it goes on."""
    if is_exclusive:
        site.make_exclusive()
    first = site.here.text
    real, done = hand_steps._given, list[Result]()

    def slept(way: Any, text: str) -> str:
        longer = real(way, text)
        if not done:
            done.append(CliRunner().invoke(app, ["task", "hand", "echo", "hall-a", "-y"]))
        return longer

    monkeypatch.setattr(hand_steps, "_given", slept)
    refused = run("hall-b", "-y")
    assert done[0].exit_code == 0, done[0].output
    site.check(is_exclusive=is_exclusive)
    assert refused.exit_code == 1
    assert "somebody else has taken that over, or brought it to its end" in refused.stderr
    assert "goes on" not in refused.stderr
    assert "it is taken back" not in refused.stderr
    assert (site.has, site.there.text) == ((True, False), B)
    assert sorted_tasks(site.here.text) == sorted_tasks(first)


@pytest.mark.parametrize("is_exclusive", [False, True])
def test_what_another_command_has_taken_over_is_not_ended_by_the_first(
    site: Site, monkeypatch: pytest.MonkeyPatch, is_exclusive: bool
) -> None:
    """It was taken back meanwhile, and given anew: the other cell is without it again."""
    if is_exclusive:
        site.make_exclusive()
    real, again = hand_steps._lack, list[str]()

    def slept(*given: Any) -> str:
        lack = real(*given)
        if not again:
            again.append("")
            assert CliRunner().invoke(app, ["task", "hand", "echo", "hall-a", "-y"]).exit_code == 0
            leave_under_way(site, monkeypatch, "_taken")
            again.append(site.here.text)
        return lack

    monkeypatch.setattr(hand_steps, "_lack", slept)
    refused = run("hall-b", "-y")
    assert (refused.exit_code, "somebody else has taken that over" in refused.stderr) == (1, True)
    assert "goes on" not in refused.stderr
    assert (site.here.text, site.there.text) == (again[1], B)
    assert run("hall-b", "-y").exit_code == 0
    check_arrived(site)


def test_an_addition_there_that_may_come_about_later_cannot_once_it_is_taken_back(site: Site) -> None:
    site.make_exclusive()
    site.there.outcomes = ["unknown"] + ["no_quorum"] * 10_000
    refused = run("hall-b", "-y", "--deadline", "0.1s")
    assert (refused.exit_code, site.has) == (5, (False, False)), "nobody can tell that hall-b does not get it"
    site.there.outcomes = []
    assert run("hall-a", "-y").exit_code == 0
    site.there.heal()
    assert (site.has, site.there.text) == ((True, False), B)
    site.check(is_exclusive=True)


def test_a_return_that_may_come_about_later_cannot_once_it_goes_on(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    site.make_exclusive()
    leave_under_way(site, monkeypatch, "_taken")
    restored = hand_steps._restored

    def then_lost(*given: Any) -> str:
        site.here.outcomes = ["unknown"]
        return restored(*given)

    with monkeypatch.context() as patch:
        patch.setattr(hand_steps, "_restored", then_lost)
        assert run("hall-a", "-y").exit_code == 5
    assert (site.has, site.here.doubt is None) == ((False, False), False)
    real = hand_steps._lack

    def healed(*given: Any) -> str:
        site.here.heal()
        return real(*given)

    monkeypatch.setattr(hand_steps, "_lack", healed)
    assert run("hall-b", "-y").exit_code == 0
    check_arrived(site)
    site.check(is_exclusive=True)


@pytest.mark.parametrize("is_exclusive", [False, True])
def test_an_end_here_that_may_come_about_later_cannot_once_it_is_taken_back(
    site: Site, monkeypatch: pytest.MonkeyPatch, is_exclusive: bool
) -> None:
    if is_exclusive:
        site.make_exclusive()
    real = hand_steps._lack

    def then_lost(*given: Any) -> str:
        site.here.outcomes = ["unknown"]
        return real(*given)

    with monkeypatch.context() as patch:
        patch.setattr(hand_steps, "_lack", then_lost)
        assert run("hall-b", "-y").exit_code == 5
    agree = hand_steps._agree

    def healed(way: Any, side: Any, make: Any) -> int | None:
        revision = agree(way, side, make)
        if side.name == "hall-b":
            site.here.heal()
        return revision

    monkeypatch.setattr(hand_steps, "_agree", healed)
    assert run("hall-a", "-y").exit_code == 0
    assert (site.has, site.there.text) == ((True, False), B)
    assert mark_of(site.here.text, "echo") is None


def test_a_task_that_is_ending_here_is_not_taken_out_there(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who takes it back waits for the other cell; meanwhile somebody brings the task to its end."""
    leave_under_way(site, monkeypatch)
    real = hand_steps._check_restored

    def overtaken(way: Any, text: str) -> None:
        real(way, text)
        assert CliRunner().invoke(app, ["task", "hand", "echo", "hall-b", "-y"]).exit_code == 0

    monkeypatch.setattr(hand_steps, "_check_restored", overtaken)
    refused = run("hall-a", "-y")
    assert (refused.exit_code, "brought it to its end" in refused.stderr) == (1, True)
    check_arrived(site)


@pytest.mark.parametrize("is_exclusive", [False, True])
def test_a_task_that_this_cell_has_again_and_that_may_not_be_in_both_is_not_given_away(
    site: Site, monkeypatch: pytest.MonkeyPatch, is_exclusive: bool
) -> None:
    """A document was applied that keeps the mark."""
    if is_exclusive:
        site.make_exclusive()
    real = hand_steps._given

    def applied(way: Any, text: str) -> str:
        tasks = ENTRY if is_exclusive else ""
        more = "" if is_exclusive else "    exclusive: true\n"
        site.here.text = site.here.text.replace("tasks:\n", f"tasks:\n{tasks}", 1)
        site.here.text = site.here.text.replace("  echo:  # answers\n", f"  echo:  # answers\n{more}", 1)
        return real(way, text)

    monkeypatch.setattr(hand_steps, "_given", applied)
    refused = run("hall-b", "-y")
    assert (refused.exit_code, "it is exclusive, and hall-a has it again" in refused.stderr) == (1, True)
    assert (site.has[0], mark_of(site.here.text, "echo")) == (True, None)
    assert "echo" not in site.there.text


def test_a_task_that_this_cell_has_again_is_not_waited_out(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    site.make_exclusive()
    real = hand_steps._not_over

    def applied(*given: Any) -> str:
        site.here.text = site.here.text.replace("tasks:\n", f"tasks:\n{ENTRY}", 1)
        return real(*given)

    monkeypatch.setattr(hand_steps, "_not_over", applied)
    refused = run("hall-b", "-y", "--deadline", "20s")
    assert (refused.exit_code, "hall-a has a task echo again" in refused.stderr) == (1, True)
    assert site.there.text == B


def test_changed_workers_that_wait_for_a_look_go_on_waiting(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hand_steps, "kept_rollouts", lambda held, _fleet: held)
    site.here.rollouts, site.there.rollouts = [{"task": "other"}], [{"task": "sweep"}]
    assert run("hall-b", "-y").exit_code == 0  # the stand-ins look for them in each change
    check_arrived(site)


def test_a_node_that_is_cut_off_from_its_cell_does_not_give_an_exclusive_task_away(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It still tells the mark, and the task may have been taken back by the others."""
    site.make_exclusive()
    real = hand_steps._given

    def cut(way: Any, text: str) -> str:
        site.here.behind = {"robot1", "robot2"}
        return real(way, text)

    monkeypatch.setattr(hand_steps, "_given", cut)
    refused = run("hall-b", "-y", "--deadline", "0.2s")
    assert "0 of the electors robot1, robot2 of hall-a know that it ends, 2 needed" in refused.stderr
    assert site.there.text == B


# --- what changes while the question stands, and what could not be taken back -----------------------------------------


@pytest.mark.parametrize("what", ["exclusive", "another entry", "its own", "another cell"])
def test_what_was_changed_while_the_question_stood_is_looked_at_again(
    site: Site, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    def agreed(*_given: object, **_more: object) -> None:
        if what == "exclusive":
            site.make_exclusive()
        elif what == "another entry":
            site.here.text = A.replace("{cpu: 0.5, memory: 0.5}", "{cpu: 1}")
        elif what == "another cell":
            site.here.text = marked(A, Mark(task="echo", cell="hall-c", entry=task_entry(A, "echo"), by="0123abcd"))
        else:
            site.there.text = B + ENTRY

    monkeypatch.setattr(hand, "begin", agreed)
    refused = run("hall-b", "-y")
    assert (refused.exit_code, "meanwhile: look at it again with --plan" in refused.stderr) == (1, True)
    assert len(site.seen) == 1


@pytest.mark.parametrize("is_under_way", [False, True])
@pytest.mark.parametrize("is_exclusive", [False, True])
def test_a_task_is_exclusive_in_both_cells_or_in_none(
    site: Site, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, is_exclusive: bool, is_under_way: bool
) -> None:
    """No lease's end tells of one that is not: its worker may work on wherever it is cut off."""
    if is_exclusive:
        site.make_exclusive()
    if is_under_way:
        leave_under_way(site, monkeypatch, "_not_over" if is_exclusive else "_taken")
    before = site.here.text, site.there.text, len(site.seen)
    file = tmp_path / "echo.yaml"
    file.write_text(
        f"tasks:\n  echo: {{exclusive: {str(not is_exclusive).lower()}, candidates: [robot3], weights: {{cpu: 1}}}}\n"
    )
    refused = run("hall-b", "-y", "--entry", str(file))
    assert (refused.exit_code, "echo is exclusive in one of the two cells" in refused.stderr) == (1, True)
    assert (site.here.text, site.there.text, len(site.seen)) == before


def test_an_entry_that_was_changed_while_it_was_on_its_way_goes_as_it_is_now(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    leave_under_way(site, monkeypatch, "_taken")
    exclusive = "  echo:  # answers\n    exclusive: true\n"
    site.here.text = site.here.text.replace("  echo:  # answers\n", exclusive, 1)
    assert run("hall-b", "-y").exit_code == 0
    check_arrived(site)
    assert site.there.text == B + ENTRY.replace("  echo:  # answers\n", exclusive)
    site.check(is_exclusive=True)


def test_what_this_cell_cannot_have_again_is_not_taken_away_there(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    """A node that its entry names has left meanwhile."""
    site.make_exclusive()
    leave_under_way(site, monkeypatch)
    site.here.text = site.here.text.replace("#     candidates: {kind: robot}", "#     candidates: [robot9]")
    refused = run("hall-a", "-y")
    assert refused.exit_code in (1, 78)
    told = " ".join(refused.stderr.split())
    assert "`zsched task hand echo hall-b` goes on, `zsched task hand echo hall-a` takes it back" in told
    assert "echo is not taken back" in told
    assert "change the task's entry in the comment at the end of the document of hall-a: zsched edit" in told
    assert site.has == (False, True)
    assert run("hall-b", "-y").exit_code == 0
    check_arrived(site)


@pytest.mark.parametrize("is_exclusive", [False, True])
@pytest.mark.parametrize("name", ["hall-a", "hall-b"])
def test_a_document_that_would_be_too_large_is_left_alone(site: Site, name: str, is_exclusive: bool) -> None:
    if is_exclusive:
        site.make_exclusive()
    hall = site.here if name == "hall-a" else site.there
    room = MAX_DOCUMENT_BYTES - len(hall.text.encode())
    hall.text += "# " + "x" * (room - 3) + "\n"
    before = site.here.text, site.there.text
    refused = run("hall-b", "-y")
    assert (refused.exit_code, "takes it back" in refused.stderr) == (78, False)
    assert "at most 196608 can be" in refused.stderr
    assert (site.here.text, site.there.text, len(site.seen)) == (*before, 1)


def test_nobody_is_told_that_it_has_stopped_before_it_has(site: Site) -> None:
    site.make_exclusive()
    site.here.outcomes = ["no_quorum"]
    refused = run("hall-b", "-y")
    assert (refused.exit_code, "nothing was changed" in refused.stderr) == (4, True)
    assert "nobody does it" not in refused.stderr
    assert "`zsched task hand echo hall-b` goes on" in refused.stderr


def test_the_command_that_goes_on_names_the_daemon_that_was_asked(site: Site) -> None:
    """From a machine of the other cell: there, without that word, there would be nothing to do."""
    site.here.outcomes = ["no_quorum"]
    refused = run("hall-b", "-y", "--node", "robot1")
    assert "`zsched task hand echo hall-b --node robot1` goes on" in refused.stderr
    assert "`zsched task hand echo hall-a --node robot1` takes it back" in refused.stderr


@pytest.mark.parametrize("cell", ["hall-a", "hall-b"])
def test_a_cell_that_the_site_names_no_more_is_to_be_named_again(
    site: Site, monkeypatch: pytest.MonkeyPatch, cell: str
) -> None:
    leave_under_way(site, monkeypatch)
    site.here.text = site.here.text.replace("site:\n  hall-b:", "site:\n  hall-c:")
    refused = run(cell, "-y")
    told = " ".join(refused.stderr.split())
    assert refused.exit_code == 2
    assert "no cell 'hall-b', and echo is on its way there; name it under `site:` again: zsched edit" in told


def test_a_mark_that_keeps_another_task_too_gives_nothing_away(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    site.make_exclusive()
    leave_under_way(site, monkeypatch, "_taken")
    other = "#   more: {candidates: {kind: robot}, weights: {cpu: 1}}\n# zsched: end of task echo\n"
    site.here.text = site.here.text.replace("# zsched: end of task echo\n", other)
    refused = run("hall-b", "-y")
    assert (refused.exit_code, "it holds echo, more, and echo alone is handed over" in refused.stderr) == (2, True)
    assert site.there.text == B
