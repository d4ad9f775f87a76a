"""The house rules of every verb that changes something: flags, before and after, consent, lists; one table for all."""

from __future__ import annotations

import copy
import json
import re
import shlex
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import typer
import typer.core
from typer.testing import CliRunner, Result

from support.doors import STATUS, answering, living
from zsched.cli import app
from zsched.host.operator_client import Json

DOCUMENT = (Path(__file__).parents[3] / "configs" / "fleet.yaml").read_text()
CLI_PAGE = (Path(__file__).parents[3] / "docs" / "guide" / "cli.md").read_text()
RULES = ("--plan", "--yes", "--revision", "--reason", "--json")
"""What every changing verb has, unless the page says why not."""
CHANGING = {
    *("move", "pin", "unpin", "pause", "resume", "tune", "restart", "drain", "undrain"),
    *(
        "apply",
        "edit",
        "task add",
        "task remove",
        "task promote",
        "node add",
        "node remove",
        "node forget",
        "invite",
        "leave",
    ),
    *("rehearse", "fleet recover", "init", "join", "fleet create"),
}
OTHERS = {
    *(
        "up",
        "dev",
        "new",
        "status",
        "top",
        "web",
        "record",
        "trace",
        "explain",
        "history",
        "events",
        "logs",
    ),
    *("doctor", "ping", "bugreport", "wait", "check", "version", "fleet show", "fleet export"),
    *("install", "uninstall"),
    *("stream list", "stream hz", "stream bw", "stream tail", "metrics print", "metrics write", "demo", "bench paper"),
}
"""What changes no fleet; `pki` makes files for an authority."""


def verbs() -> dict[str, set[str]]:
    """{words: options} of every verb of the program."""

    def walk(group: typer.core.TyperGroup, before: tuple[str, ...] = ()) -> Iterator[tuple[str, set[str]]]:
        for name, command in group.commands.items():
            if isinstance(command, typer.core.TyperGroup):
                yield from walk(command, (*before, name))
            else:
                yield " ".join((*before, name)), {option for param in command.params for option in param.opts}

    main = typer.main.get_command(app)
    assert isinstance(main, typer.core.TyperGroup)
    return dict(walk(main))


def exceptions() -> dict[tuple[str, str], str]:
    """{(verb, flag): why it has none}, as the page of the command line tells."""
    found = {}
    for line in CLI_PAGE.partition("What a verb has not")[2].partition("## status")[0].splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("| `zsched"):
            for verb in re.findall(r"`zsched ([a-z ]+)`", cells[0]):
                for flag in re.findall(r"`(-[a-z-]+)`", cells[1]):
                    found[verb, "--reason" if flag == "-m" else flag] = cells[2]
    return found


def test_every_verb_is_one_that_changes_something_or_one_that_does_not() -> None:
    there = {name for name in verbs() if not name.startswith("pki ") and name != "complete"}
    assert there - CHANGING - OTHERS == set()
    assert there >= CHANGING


@pytest.mark.parametrize("verb", sorted(CHANGING))
def test_a_changing_verb_has_every_flag_of_the_rules_or_the_page_says_why_not(verb: str) -> None:
    without = set(RULES) - verbs()[verb]
    assert without == {flag for name, flag in exceptions() if name == verb}
    assert all(exceptions().values())


# --- what they do ----------------------------------------------------------------------------------------------------


def node(name: str) -> Json:
    return living(name, name.rstrip("0123456789"), "map_merge")


@dataclass
class Daemon:
    """Answers as every node of a fleet with a document; notes each request that would change something."""

    folder: Path
    changes: list[Json] = field(default_factory=list)

    def __post_init__(self) -> None:
        task = copy.deepcopy(STATUS["tasks"][0])
        task |= {"name": "map_merge", "owner": "edge1", "owner_state": "alive", "revision": 7, "phase": "settled"}
        task |= {"candidates": ["edge1", "edge2"], "streams": [], "switched_s": 0.1}
        hold = {"by": "eve@robot2", "reason": "", "known_s": 1.0, "for_s": None, "node": "edge1", "is_hard": False}
        self.flags = [
            {"kind": kind, "subject": "robot3", "by": "eve", "reason": "", "for_s": None, "revision": 2}
            for kind in ("drain", "ineligible")
        ]
        nodes = [node(name) for name in ("edge1", "edge2", "robot1", "robot2", "robot3")]
        nodes[-1]["flags"] = [{**flag, "known_s": 1.0} for flag in self.flags]
        self.status: Json = {**STATUS, "fleet": "warehouse", "node": "robot1", "nodes": nodes, "tasks": [task]}
        self.status["fleet_revision"] = 4
        self.task, self.hold = task, hold
        tuning = {"bonus": 0.1, "score": "service", "deadline_ms": None}
        self.task["tuning"] = self.task["file_tuning"] = {
            **tuning,
            "weights": {"cpu": 0.5, "memory": 0.5, "network": 0.0},
        }
        self.task |= {"pause": None, "pin": None}

    def answer(self, request: Json) -> Json:
        if request["verb"] == "status":
            return {**copy.deepcopy(self.status), "node": request.get("node", "robot1")}
        if request["verb"] == "fleet":
            told = {"node": request.get("node", "robot1"), "fleet": "warehouse", "revision": 4, "number": 1}
            electors = [{"name": name, "disk": "d1"} for name in ("edge1", "robot1", "robot2")]
            told |= {
                "settled": True,
                "electors": electors,
                "document": "ab" * 16,
                "text": DOCUMENT,
                "flags": self.flags,
            }
            return {**told, "fleet_file": "", "disk": "", "problem": None}
        if request["verb"] == "rehearsals":
            promised: Json = {
                step: {"step": step, "gap_s": 0.3, "decide_s": 1.0, "whole": []} for step in ("move", "link")
            }
            return {"node": "robot1", "timing": "wifi", "promised": promised, "names": [], "body": ""}
        if not request.get("plan"):
            self.changes.append(request)
        return {"outcome": "ok", "detail": "as told", "revision": 8}


@pytest.fixture
def daemon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Daemon]:
    running = Daemon(tmp_path)
    monkeypatch.setattr("zsched.commands.base.change.IN_FORCE_S", 0.2)  # its document stays the one that it has
    with answering(running.answer, tmp_path, monkeypatch):
        yield running


def run(monkeypatch: pytest.MonkeyPatch, *words: str) -> Result:
    monkeypatch.setattr(sys, "argv", ["zsched", *words])
    return CliRunner().invoke(app, list(words))


ORDERS: dict[str, tuple[str, ...]] = {
    "move": ("map_merge", "edge2"),
    "pin": ("map_merge", "edge2"),
    "unpin": ("map_merge",),
    "pause": ("map_merge",),
    "resume": ("map_merge",),
    "tune": ("map_merge", "bonus=0.3"),
    "restart": ("map_merge", "edge2"),
    "drain": ("edge1",),
    "undrain": ("robot3",),
    "task remove": ("map_merge", "--accept", "remove-task"),
    "node remove": ("robot3", "--accept", "remove-node"),
    "rehearse": ("map_merge", "--steps", "move"),
}
"""An order of each verb that a daemon carries out, and that changes something here."""


def held(daemon: Daemon, verb: str) -> None:
    """The order that a verb ends is in force."""
    ends = {"unpin": "pin", "resume": "pause"}.get(verb)
    if ends is not None:
        daemon.task[ends] = daemon.hold


@pytest.mark.parametrize("verb", ORDERS)
def test_off_a_terminal_it_shows_the_change_and_prints_the_exact_command(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch, verb: str
) -> None:
    held(daemon, verb)
    words = (*verb.split(), *ORDERS[verb], "-m", "two words", "--runtime-dir", str(daemon.folder))
    result = run(monkeypatch, *words)
    assert (result.exit_code, daemon.changes) == (2, []), result.output
    told = result.stdout + result.stderr
    assert next(line for line in told.splitlines() if "NOW" in line or " -> " in line), "before and after"
    line = next(line for line in told.splitlines() if "--yes" in line)
    assert line.startswith("zsched "), "on a line of its own, to be copied"
    command = shlex.split(line)
    assert sorted(command) == sorted(["zsched", *words, "--yes"]), "every word of it"


@pytest.mark.parametrize("verb", ORDERS)
def test_a_plan_changes_nothing_and_exits_with_10(daemon: Daemon, monkeypatch: pytest.MonkeyPatch, verb: str) -> None:
    held(daemon, verb)
    for more in ((), ("--json",)):
        result = run(monkeypatch, *verb.split(), *ORDERS[verb], "--plan", *more)
        assert (result.exit_code, daemon.changes) == (10, []), result.output
    assert json.loads(result.stdout)["schema"].startswith("zsched.")


@pytest.mark.parametrize("verb", [name for name in ORDERS if name != "rehearse"])
def test_with_yes_the_order_carries_its_author_and_its_reason(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch, verb: str
) -> None:
    held(daemon, verb)
    detach = ("--detach",) if verb in ("move", "drain") else ()
    run(monkeypatch, *verb.split(), *ORDERS[verb], "--yes", "-m", "new fan", *detach)
    assert daemon.changes, "it was given"
    assert "new fan" in json.dumps(daemon.changes[0])
    assert re.search(r"\w@\w", json.dumps(daemon.changes[0]))


@pytest.mark.parametrize("verb", sorted({*ORDERS, "apply", "node add", "task add"}))
def test_a_version_of_json_that_there_is_not_ends_as_usage(
    daemon: Daemon, monkeypatch: pytest.MonkeyPatch, verb: str
) -> None:
    result = run(monkeypatch, *verb.split(), *ORDERS.get(verb, ("file",)), "--yes", "--json=9")
    assert (result.exit_code, daemon.changes) == (2, [])
    assert result.stderr.endswith(" has the major version 1\n"), result.stderr
