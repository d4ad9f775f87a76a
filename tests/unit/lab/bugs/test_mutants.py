"""Mutants: what is changed, what is left alone, and that the command tells a killed one from a survivor."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from zsched_lab.bugs.mutant_tests import KILLED, SURVIVED, TIMEOUT, UNJUDGED
from zsched_lab.bugs.mutants import Mutant, mutants_of, mutated
from zsched_lab.bugs.mutate import CORE, Fork, Results, Verdict, score, table

ROOT = Path(__file__).parents[4]


def changes(source: str) -> set[tuple[str, str]]:
    return {(one.before, one.after) for one in mutants_of("m", source)}


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        ("a < b", {("a < b", "a <= b"), ("a < b", "a >= b")}),
        ("a is not b", {("a is not b", "a is b")}),
        ("a and b", {("a and b", "a or b"), ("a and b", "b"), ("a and b", "a")}),
        ("a + 2.0", {("a + 2.0", "a - 2.0"), ("2.0", "4.0"), ("2.0", "1.0")}),
        ("a -= b", {("a -= b", "a += b"), ("a -= b", "pass")}),
        ("x = True", {("True", "False")}),
        ("x = max(a, b)", {("max(a, b)", "min(a, b)")}),
        ("x = a if b else c", {("a if b else c", "a if not b else c")}),
        ("def f():\n return a", {("return a", "return None")}),
        ("self.x = a", {("self.x = a", "pass")}),
        ("a.b(c)", {("a.b(c)", "pass")}),
        ("x = [a for a in b if c]", {("for a if c", "for a")}),
    ],
)
def test_every_operator_makes_its_small_faults(source: str, expected: set[tuple[str, str]]) -> None:
    assert changes(source) == expected


@pytest.mark.parametrize(
    "source",
    [
        '"""Words, 1 < 2."""',
        "import a",
        "x: int | None = a",
        "def f(a: int | None) -> str | None:\n pass",
        "@d(a=True)\nclass C:\n pass",
        "raise ValueError(a + b)",
        "assert a is not b",
        "x = f'{a + b}'",
        "RecordStory(text=a + b)",
        "T = A | B",
        "x = cast(A, b)",
        "a, b = c",
        "a = b",
    ],
)
def test_what_only_people_or_types_read_is_left_alone(source: str) -> None:
    assert changes(source) == set()


def test_a_mutant_knows_where_it_runs() -> None:
    source = "N = 1\nclass C:\n  M = 2.0\n  def f(self, a=3.0):\n    g = lambda: self.x < 4.0\n    return g\n"
    places = {one.before: one.function for one in mutants_of("m", source)}
    assert places["1"] == ""
    assert places["2.0"] == places["3.0"] == "C."
    assert places["4.0"] == places["return g"] == "=C.f"


def test_a_mutated_module_differs_in_one_thing_and_the_same_code_is_none() -> None:
    source = "def f(a, b):\n    return a < b\n"
    (first, *_) = [one for one in mutants_of("m", source) if one.after == "a <= b"]
    code = mutated(first, source, "m.py")
    assert code is not None
    names: dict[str, object] = {}
    exec(code, names)  # noqa: S102 - two lines of this test
    assert names["f"](1, 1) is True  # type: ignore[operator]
    with pytest.raises(ValueError, match="not in the source any more"):
        mutated(first, source.replace("<", ">"), "m.py")
    (unused,) = mutants_of("m", "1\n")
    assert mutated(unused, "1\n", "m.py") is None


def verdict(number: int, kind: str) -> Verdict:
    return Verdict(
        key=str(number), path="core/a.py", text=f"core/a.py:{number}", verdict=kind, found_by="", seconds=1.0
    )


def test_the_table_counts_and_names_survivors_and_what_never_ends_is_found(tmp_path: Path) -> None:
    verdicts = [verdict(1, KILLED), verdict(2, SURVIVED), verdict(3, TIMEOUT), verdict(4, KILLED)]
    rows = table(verdicts).splitlines()
    assert "| `core/a.py` | 4 | 2 | 1 | 1 |" in rows
    assert rows[-1] == "survived: core/a.py:2"
    assert score(verdicts) == 75.0
    results = Results.load(tmp_path / "kept.json")
    for one in verdicts:
        results.take(one)
    assert Results.load(tmp_path / "kept.json").verdicts == {one.key: one for one in verdicts}


def test_survivors_are_tried_again_and_the_others_keep_their_verdicts(tmp_path: Path) -> None:
    results = Results.load(tmp_path / "kept.json")
    for one in (verdict(1, KILLED), verdict(2, SURVIVED), verdict(3, TIMEOUT)):
        results.take(one)
    results.forget_survivors()
    assert sorted(results.verdicts) == ["1", "3"]


@pytest.mark.parametrize(
    ("said", "number", "expected"),
    [
        ("", signal.SIGPROF, TIMEOUT),
        ("", signal.SIGKILL, UNJUDGED),
        ("", signal.SIGTERM, UNJUDGED),
        ("", signal.SIGSEGV, KILLED),
        ("", 0, UNJUDGED),
        ("-", 0, SURVIVED),
        ("tests/a.py::test_b", 0, KILLED),
    ],
)
def test_only_cpu_time_finds_a_mutant_that_does_not_end(said: str, number: int, expected: str) -> None:
    """A busy machine, or somebody who ends a process, has not found anything."""
    reading, writing = os.pipe()
    os.write(writing, said.encode())
    os.close(writing)
    assert Fork(1, reading, 0.0).result(number)[0] == expected


def test_a_change_of_one_function_leaves_the_keys_of_all_others_alone() -> None:
    before = "def f(a):\n    return a < 1\ndef g(a):\n    return a < 1 or a < 1\n"
    after = before.replace("return a < 1\ndef", "a += 3\n    return a < 1\ndef")
    keys = {one.key for one in mutants_of("m", before)}
    assert len(keys) == len(mutants_of("m", before))
    assert keys < {one.key for one in mutants_of("m", after)}


def run(tmp_path: Path, tests: Path, *given: Mutant | str) -> str:
    """The command on the lines of mutants, our own tests, and more options; what lives is frozen, as in the suite."""
    (tmp_path / "conftest.py").write_text("import gc\ndef pytest_collection_finish():\n    gc.freeze()\n")
    mutants = [one for one in given if isinstance(one, Mutant)]
    lines = sorted({f"{one.path}:{one.line}" for one in mutants})
    words = [word for line in lines for word in ("--module", line)]
    command = [sys.executable, "-m", "zsched_lab.bugs.mutate", *words, "--mutants", "50", "--tests", str(tests)]
    command += [one for one in given if isinstance(one, str)]
    done = subprocess.run(
        command,
        cwd=ROOT,
        env={"PATH": "/usr/bin:/bin", "XDG_CACHE_HOME": str(tmp_path / "cache"), "HOME": str(tmp_path)},
        capture_output=True,
        text=True,
        timeout=110,
        check=False,
    )
    assert "mutants found" in done.stdout, done.stdout + done.stderr
    return done.stdout


def test_the_command_plants_into_functions_and_into_what_the_import_runs(tmp_path: Path) -> None:
    """Both ways: `majority` is called, `WINDOW_S` is made at the import."""
    quorum, fuse = (
        mutants_of(f"zsched.core.{name}".replace("/", "."), (CORE / f"{name}.py").read_text(encoding="utf-8"))
        for name in ("values/quorum", "scheduler/fuse")
    )
    found = [one for one in quorum if one.function == "=majority"]
    made = [one for one in fuse if one.before == "60.0"]
    assert found
    assert made
    good = tmp_path / "test_good.py"
    good.write_text(
        "from zsched.core.scheduler.fuse import WINDOW_S\n"
        "from zsched.core.values.quorum import majority\n"
        "def test_majority():\n    assert [majority(n) for n in range(1, 6)] == [1, 2, 2, 3, 3]\n"
        "def test_made():\n    assert WINDOW_S == 60.0\n",
        encoding="utf-8",
    )
    text = run(tmp_path, good, found[0], made[0])
    assert "survived (" not in text
    assert " 100.0 %" in text


def test_a_test_that_looks_away_finds_nothing(tmp_path: Path) -> None:
    source = (CORE / "values/quorum.py").read_text(encoding="utf-8")
    one = next(one for one in mutants_of("zsched.core.values.quorum", source) if one.function == "=majority")
    weak = tmp_path / "test_weak.py"
    weak.write_text("from zsched.core.values.quorum import majority\ndef test_majority():\n    majority(3)\n")
    text = run(tmp_path, weak, one, "--schedules", "0")
    assert "survived (" in text
    assert " 100.0 %" not in text
