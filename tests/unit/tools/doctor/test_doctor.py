"""`zsched doctor` as an operator runs it, without a daemon: exit codes, text, JSON."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from support.clinic import FLEET
from support.schemas import faults
from zsched.cli import app
from zsched.tools.doctor import model
from zsched.tools.doctor import verb as doctor
from zsched.tools.doctor.model import Check


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    for name in ("STATE_DIRECTORY", "RUNTIME_DIRECTORY", "COLUMNS"):
        monkeypatch.delenv(name, raising=False)
    (tmp_path / "fleet.yaml").write_text(FLEET)
    for name, value in {"CONFIG": "fleet.yaml", "STATE_DIR": "state", "RUNTIME_DIR": "run"}.items():
        monkeypatch.setenv(f"ZSCHED_{name}", str(tmp_path / value))
    monkeypatch.setenv("ZSCHED_NODE", "robot1")
    return tmp_path


def run(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["doctor", *arguments])


def test_a_machine_whose_daemon_is_down_fails_and_says_what_to_do(place: Path) -> None:
    result = run()
    assert (result.exit_code, result.stderr) == (1, "")
    assert "FAIL daemon.answers" in result.stdout
    assert "FAIL state.valid" in result.stdout
    assert "fix: sudo zsched init --config" in result.stdout
    assert "fleet.pairs" not in result.stdout
    assert not (place / "state").exists()


@pytest.mark.usefixtures("place")
def test_json_has_every_check_with_its_verdict() -> None:
    body = json.loads(run("--json", "--fleet").stdout)
    assert (body["schema"], body["fleet"], body["node"], body["verdict"]) == (
        "zsched.doctor/1",
        "hall",
        "robot1",
        "FAIL",
    )
    assert faults(body) == []
    assert len(body["checks"]) == sum(body["counts"].values()) >= 20
    assert {"PASS", "SKIP", "FAIL"} <= {check["verdict"] for check in body["checks"]}
    assert all(check["fix"] for check in body["checks"] if check["verdict"] in ("WARN", "FAIL"))
    assert [check["evidence"] for check in body["checks"] if check["id"] == "fleet.pairs"] == [["no node answers"]]


def test_a_faulty_fleet_file_is_a_failed_check_like_others(place: Path) -> None:
    (place / "fleet.yaml").write_text("fleet: hall\n")
    result = run()
    assert result.exit_code == 1
    assert "FAIL file.valid" in result.stdout


@pytest.mark.usefixtures("place")
@pytest.mark.parametrize(
    ("found", "plain", "strict"),
    [
        (model.passed("fine"), 0, 0),
        (model.skipped("not here"), 0, 0),
        (model.warned("odd", fix="mend"), 0, 1),
        (model.failed("broken", fix="mend"), 1, 1),
    ],
)
def test_exit_codes(monkeypatch: pytest.MonkeyPatch, found: model.Result, plain: int, strict: int) -> None:
    check = Check(name="arm.moves", asks="Does it move?", run=lambda _scene: found)
    monkeypatch.setattr(doctor, "run_all", lambda _scene: [(check, found)])
    assert (run().exit_code, run("--strict").exit_code) == (plain, strict)
