"""Whatever a node answers, no verb shows more of it than printable words within their own line; JSON stays JSON."""

from __future__ import annotations

import copy
import json
import os
import pty
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from support.clinic import fleet_scene
from support.doors import STATUS, answering
from zsched.cli import app
from zsched.host.decision_log import NAME
from zsched.host.screen import harmless
from zsched.tools.bugreport import gathered

Json = dict[str, Any]
EVIL = "\x1b[2J\x9b31m\r\nFORGED line\u202e"
SHOWN = "?[2J?31m??FORGED line?"
FREE = ("detail", "from_expr", "hash", "phase_detail", "reason", "stream", "text", "to_expr", "why")
DOCUMENT = f"fleet: demo # {EVIL}\n"


def poisoned(value: Any, key: str = "") -> Any:
    """With `EVIL` in every word that no reader of frames has checked: sentences, streams, what counters count."""
    if isinstance(value, str):
        return f"{value}{EVIL}" if key in FREE or " " in value else value
    if isinstance(value, list):
        return [poisoned(item, key) for item in value]
    if isinstance(value, dict):
        return {
            (f"{name}{EVIL}" if key in ("counters", "drops") else name): poisoned(value[name], name) for name in value
        }
    return value


def status() -> Json:
    found: Json = poisoned(copy.deepcopy(STATUS))
    held = {"by": EVIL, "reason": EVIL, "known_s": 3.0, "for_s": None}
    found["tasks"][0] |= {"pin": {**held, "node": "edge1", "is_hard": False}}
    found["tasks"][0]["tuning"]["score"] = "service"
    found["nodes"][1]["flags"] = [{**held, "kind": "drain"}]
    return {**found, "fleet_revision": 3, "problems": [EVIL], "counters": {EVIL: 1}}


def answer(request: Json) -> Json:
    entry = {"at": 99.0, "node": "robot1", "life": 1, "stage": "vote", "task": "echo", "text": EVIL, "epoch": 2}
    move = {"epoch": 2, "revision": 2, "left": "edge1", "owner": "edge2", "reason": EVIL}
    kept = {"id": "r1", "task": "echo", "at": "now", "by": EVIL, "timing": "wifi", "is_kept": True, "rows": []}
    body = json.dumps({**kept, "way_back": EVIL}) if request.get("name") else ""
    fleet: Json = {"revision": 3, "number": 3, "settled": True, "document": "d1", "text": DOCUMENT, "flags": []}
    fleet |= {"fleet_file": EVIL, "electors": [{"name": EVIL, "disk": "", "joining": False}]}
    lines = {"newest": 1, "is_here": True, "lines": [{"number": 1, "age_s": 0.5, "text": EVIL}]}
    answers: Json = {
        "status": status(),
        "explain": {"detail": EVIL},
        "log": {"node": "robot1", "now": 100.0, "entries": [{**entry, "move": move}], "cursor": "1", "more": False},
        "fleet": {"node": "robot1", "fleet": "demo", **fleet},
        "lines": {"node": "edge1", "task": "echo", **lines},
        "rehearsals": {"node": "robot1", "timing": EVIL, "promised": {}, "names": [EVIL, "r1"], "body": body},
        "retry": {"error": EVIL},
        "restart": {"outcome": "ok", "detail": EVIL, "revision": 4},
    }
    found: Json = answers.get(request["verb"], {"outcome": "invalid", "detail": EVIL, "revision": 4})
    return found


@pytest.fixture(autouse=True)
def _evil_daemon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with answering(answer, tmp_path, monkeypatch):
        yield


def run(words: str, *more: str) -> Result:
    return CliRunner().invoke(app, [*words.split(), *more], catch_exceptions=False)


@pytest.mark.parametrize(
    "words",
    [
        *("status", "status --verbose", "top --once", "explain echo", "events", "history", "stream list --window 0.1"),
        *("logs echo", "metrics print", "fleet show", "rehearse --list", "rehearse --show r1", "fleet export"),
        *("move echo edge2 --yes", "drain edge1 --yes", "drain", "pin echo edge1 --yes", "pin", "pause echo --yes"),
        "tune echo bonus=0.2 --yes",
        "restart echo edge1 --yes",
    ],
)
def test_no_verb_lets_the_words_of_others_out_of_their_line(words: str) -> None:
    result = run(words)
    if words == "fleet export":
        assert result.stdout_bytes.decode() == DOCUMENT, "what is no terminal has the document itself"
        return
    assert "FORGED" in result.output
    for text in (result.stdout, result.stderr):
        assert harmless(text) == text
        assert re.search(r"^\s*FORGED", text, re.MULTILINE) is None


@pytest.mark.parametrize("words", ["status", "fleet show", "logs echo", "events", "rehearse --list"])
def test_json_stays_json(words: str) -> None:
    result = run(words, "--json")
    for text in result.stdout.splitlines() if words in ("logs echo", "events") else [result.stdout]:
        assert SHOWN in json.dumps(json.loads(text), ensure_ascii=False)
        assert harmless(text) == text


def test_a_document_on_a_terminal_steers_nothing(tmp_path: Path) -> None:
    ours, theirs = pty.openpty()
    words = [sys.executable, "-m", "zsched.cli", "fleet", "export", "--runtime-dir", str(tmp_path)]
    subprocess.run(words, stdout=theirs, stderr=theirs, timeout=60, check=True)
    os.close(theirs)
    said = os.read(ours, 65536).decode().replace("\r\n", "\n")
    os.close(ours)
    assert said == harmless(DOCUMENT)


def test_a_bug_report_s_files_steer_no_terminal_and_its_json_says_the_same(tmp_path: Path) -> None:
    scene = fleet_scene(tmp_path)
    scene.statuses["robot1"]["problems"].append(EVIL)
    scene = replace(scene, text=f"{scene.text}# {EVIL}")
    scene.state_folder.mkdir(exist_ok=True)
    (scene.state_folder / NAME).write_text(json.dumps({"text": EVIL}, ensure_ascii=False))
    files = {member.name: member.content.decode() for member in gathered(scene, lambda: EVIL)}
    for name, text in files.items():
        assert harmless(text) == text, name
    assert json.loads(files["status/robot1.json"])["problems"] == [EVIL]
    assert json.loads(files[NAME]) == {"text": EVIL}
