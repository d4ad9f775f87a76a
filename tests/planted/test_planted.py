"""The planted bugs: all can be planted, a few are hunted here. All of them: ``python -m zsched_lab.bugs.planted``."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

from zsched_lab.bugs.core_bugs import REGISTER, Bug
from zsched_lab.bugs.planted import BUGS, PlantError, Verdict, changed, for_children, judge, plant, table
from zsched_lab.bugs.stream_bugs import STREAM_BUGS

ROOT = Path(__file__).parents[2]
QUICK = ("quorum off by one", "promise not persisted", "node without state is an elector", "silence rule left out")
HARMLESS = Bug(name="harmless", module=REGISTER, changes=(("Synod on a register", "Synod on the register"),))


def source_of(bug: Bug) -> str:
    spec = importlib.util.find_spec(bug.module)
    assert spec is not None
    assert spec.origin is not None
    return Path(spec.origin).read_text(encoding="utf-8")


@pytest.mark.parametrize("bug", BUGS, ids=lambda bug: bug.name)
def test_every_bug_can_be_planted_in_today_s_source(bug: Bug) -> None:
    for one in bug.parts:
        source = source_of(one)
        planted = changed(one, source)
        assert planted != source
        compile(planted, one.module, "exec")


def test_there_are_enough_bugs_each_with_a_name_of_its_own_and_tests_that_exist() -> None:
    assert len(BUGS) >= 25
    assert len({bug.name for bug in BUGS}) == len(BUGS)
    assert [test for bug in BUGS for test in bug.tests if not (ROOT / test.partition("::")[0]).exists()] == []
    assert [bug.name for bug in BUGS if not bug.tests] == [], "a schedule that is found by chance is no directed test"


def test_the_page_of_membership_rules_names_bugs_that_are_planted() -> None:
    rows = (ROOT / "tests/planted/membership-rules.md").read_text(encoding="utf-8").splitlines()
    cells = [row.split("|")[3] for row in rows if row.startswith("| ") and not row.startswith(("| rule", "| ---"))]
    named = [name.strip() for cell in cells for name in cell.split(";")]
    assert len(named) > 30
    assert set(named) <= {bug.name for bug in BUGS}


@pytest.mark.parametrize("name", QUICK)
def test_a_planted_bug_is_found(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    (bug,) = [bug for bug in BUGS if bug.name == name]
    assert judge(bug, budget_s=20.0).found_by.startswith("seed ")


def test_a_stream_bug_is_found_by_its_tests(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    (bug,) = [bug for bug in STREAM_BUGS if bug.name == "a sample that was shed counts as acknowledged"]
    found = judge(bug).found_by
    assert "test_what_gives_way_for_want_of_room_is_lost" in found


def test_processes_that_a_test_starts_have_the_bug_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    monkeypatch.setenv("PYTHONPATH", "")
    (bug,) = [bug for bug in STREAM_BUGS if bug.name == "numbers are compared without their wrap"]
    code = "from zsched.core.hop.serial import number_near; print(number_near(2, 2**32 - 1))"
    command = [sys.executable, "-c", code]
    sound = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=110, check=True).stdout
    for_children(bug, tmp_path)
    planted = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=110, check=True).stdout
    assert (int(sound), int(planted)) == (2**32 + 2, 2)


def test_a_change_without_effect_is_not_called_found() -> None:
    """The hunt does not cry wolf: in a process of its own, schedules of a harmless change end without a finding."""
    code = (
        "import sys; from zsched_lab.bugs.planted import hunt; from zsched_lab.bugs.core_bugs import Bug\n"
        f"sys.exit(hunt({HARMLESS!r}, 0.2))"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, timeout=110, check=False).returncode == 0


def test_a_bug_whose_text_is_gone_says_so() -> None:
    bug = Bug(name="old", module=REGISTER, changes=(("no such words in it", ""),))
    with pytest.raises(PlantError, match="0 times"):
        changed(bug, source_of(bug))


def test_a_module_that_is_already_there_cannot_be_planted() -> None:
    from zsched.core.register.register import Register

    assert Register.__module__ == HARMLESS.module
    with pytest.raises(PlantError, match="imported already"):
        plant(HARMLESS)


def test_table_names_survivors() -> None:
    failed = "FAILED tests/sim/test_register_rules.py::test_a_rule[0] - AssertionError"
    rows = table(
        [
            Verdict(bug=BUGS[0], found_by="seed 1: x", seconds=1.0),
            Verdict(bug=BUGS[1], found_by="", seconds=2.0),
            Verdict(bug=BUGS[2], found_by=failed, seconds=3.0),
        ]
    ).splitlines()[1:]
    assert rows[0] == "quorum off by one,core/values/quorum.py,seed 1,1.0"
    assert rows[1].endswith(",survived,2.0")
    assert rows[2].endswith(",test_a_rule,3.0")
