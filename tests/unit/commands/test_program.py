"""Verbs that other distributions bring."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import EntryPoint

import pytest
from typer.testing import CliRunner, Result

from zsched.cli import app
from zsched.commands import program
from zsched.commands.program import DRASTIC, GROUP, VERBS, installed_verbs


def run(*arguments: str) -> Result:
    return CliRunner().invoke(app, arguments)


def bring(monkeypatch: pytest.MonkeyPatch, **verbs: str) -> None:
    """These verbs are installed, and no others."""
    found = {name: EntryPoint(name=name, value=value, group=GROUP) for name, value in verbs.items()}
    monkeypatch.setattr(program, "installed_verbs", lambda: found)


def test_the_lab_brings_its_verbs() -> None:
    assert {"bench", "demo"} <= set(installed_verbs())
    told = run("--help-all").stdout
    assert "demo" in told
    assert "bench" in told
    assert run("demo", "--help").stdout.startswith("Usage: ")


@pytest.mark.parametrize("verb", [["demo", "--headless"], ["bench", "paper", "--runs", "3"]])
def test_without_the_lab_its_verbs_say_what_brings_them(monkeypatch: pytest.MonkeyPatch, verb: list[str]) -> None:
    bring(monkeypatch)
    result = run(*verb)
    assert (result.exit_code, result.stdout) == (1, "")
    assert f"zsched {verb[0]}: it comes with zsched-lab" in result.stderr
    assert "pip install . ./lab" in result.stderr


def test_a_verb_that_cannot_be_loaded_takes_no_other_along(monkeypatch: pytest.MonkeyPatch) -> None:
    bring(monkeypatch, sing="zsched_choir:app")
    assert "sing" in run("--help-all").stdout
    result = run("sing", "--loud", "twice")
    assert (result.exit_code, result.stdout) == (1, "")
    assert "zsched sing: zsched_choir:app cannot be loaded: ModuleNotFoundError" in result.stderr
    assert run("version").exit_code == 0


def test_nobody_takes_a_verb_of_the_program(monkeypatch: pytest.MonkeyPatch) -> None:
    bring(monkeypatch, version="zsched_choir:app")
    assert run("version").stdout.startswith("zsched ")
    assert run("--help-all").stdout.count("\n  version ") == 1


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("remove", "robot2"), "write zsched node remove NODE, or zsched task remove TASK"),
        (("list",), "write zsched status"),
        (("stauts", "--json"), "write zsched status"),
        (("recover", "8d3f"), "write zsched fleet recover"),
        (("fly",), "`zsched --help-all` lists them"),
        *(((near,), "") for near in ("recove", "rejion", "leav", "uninstal", "inti")),
    ],
)
def test_a_word_that_is_no_verb_leads_to_what_is_meant_to_nothing_drastic(words: tuple[str, ...], says: str) -> None:
    result = run(*words)
    assert (result.exit_code, result.stdout) == (2, "")
    assert result.stderr.startswith(f"zsched {words[0]}: there is no such verb; ")
    said = " ".join(result.stderr.split())
    assert says in said
    assert not DRASTIC & set(said.split()), said


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("status", "--help"), "--interval"),
        (("stream", "list", "--help"), "--window"),
        (("metrics", "--help"), "write"),
        (("complete", "--", "st"), "status\nstream\n"),
        (("--help",), "fleet create"),
        (("--help-all",), "uninstall"),
    ],
)
def test_the_program_that_builds_the_named_verb_alone_knows_what_it_needs(words: tuple[str, ...], says: str) -> None:
    command = [sys.executable, "-m", "zsched.cli", *words]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (done.returncode, done.stderr, says in done.stdout) == (0, "", True)


@pytest.mark.parametrize(("word", "loaded"), [("status", True), ("--version", False)])
def test_only_the_module_of_the_named_verb_is_loaded(word: str, loaded: bool) -> None:
    code = f"""
import sys, zsched.cli
sys.argv = ["zsched", {word!r}, "--help"]
try:
    zsched.cli.main()
finally:
    print(["zsched.commands." + name in sys.modules for name in ("look.status", "act.move", "act.apply")])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.splitlines()[-1] == str([loaded, False, False])


def test_the_help_fits_a_terminal_and_names_verbs_that_there_are() -> None:
    lines = run("--help").stdout.splitlines()
    assert (len(lines) < 24, max(map(len, lines)) <= 80) == (True, True)
    rows = [line for line in lines if line[7:8].isalpha() and line[20:21] == " " and line[7:14] != "zsched "]
    named = [line[7:21].split() for line in rows]
    assert len(named) == 14
    for words in named:
        assert run(*words, "--help").stdout.startswith(f"Usage: zsched {' '.join(words)} ")


def test_the_long_help_has_every_verb_under_its_noun() -> None:
    told = run("--help-all").stdout
    assert [line for line in told.splitlines() if line.endswith(":")][1:] == [
        "The fleet:",
        "A task and its streams:",
        "A node:",
        "This machine:",
        "What other packages bring:",
    ]
    assert {line.split()[0] for line in told.splitlines() if line.startswith("  ") and line[2] != " "} >= VERBS.keys()
