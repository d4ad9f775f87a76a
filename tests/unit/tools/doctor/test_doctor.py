"""`zsched doctor` as an operator runs it, without a daemon: exit codes, text, JSON."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from support.clinic import FLEET
from support.schemas import faults
from zsched.cli import app


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
