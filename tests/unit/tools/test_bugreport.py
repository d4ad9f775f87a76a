"""`zsched bugreport`: what is in the file, who may read it, and what it says of what is not there."""

from __future__ import annotations

import json
import stat
import tarfile
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from support.clinic import FLEET, fleet_scene
from zsched.cli import app
from zsched.host.decision_log import NAME, OLD_NAME
from zsched.tools.bugreport import gathered

SECRET = "swordfish"
TEXT = FLEET.replace("worker: {", f"worker: {{env: {{API_TOKEN: {SECRET}}}, ")


def test_a_secret_of_several_words_does_not_pass_where_lines_are_broken(tmp_path: Path) -> None:
    secret = "correct horse battery staple"
    scene = fleet_scene(tmp_path, FLEET.replace("worker: {", f"worker: {{env: {{API_TOKEN: {secret}}}, "))
    scene.status["problems"].append(f"{'so many words ' * 5}{secret}")
    members = {one.name: one.content.decode() for one in gathered(scene, lambda: "")}
    for word in secret.split():
        assert word not in members["doctor.txt"], word


def no_journal() -> str:
    raise PermissionError(13, "No journal files were opened due to insufficient permissions.")


def test_every_node_s_status_the_doctor_s_words_and_no_secret_are_in_it(tmp_path: Path) -> None:
    scene = fleet_scene(tmp_path, TEXT)
    robot = scene.statuses["robot1"]
    robot["problems"].append(f"the worker printed {SECRET}")
    told = '{"schema":"zsched.event/1","text":"the worker printed WORD"}\n'.replace("WORD", SECRET)
    scene.state_folder.mkdir(exist_ok=True)
    for name in ("decisions.1.ndjson", "decisions.ndjson"):
        (scene.state_folder / name).write_text(told)
    members = {one.name: one for one in gathered(scene, lambda: f"12:00 edge1 zsched: token {SECRET} refused\n")}
    names = {"versions.json", "fleet.yaml", "doctor.txt", "doctor.json", "journal.txt"}
    names |= {"decisions.1.ndjson", "decisions.ndjson"}
    assert json.loads(members["decisions.ndjson"].content)["text"] == "the worker printed REMOVED"
    assert set(members) == names | {f"status/{name}.json" for name in ("edge1", "robot1", "robot2", "robot3")}
    assert not [one for one in members.values() if one.missing or SECRET.encode() in one.content]
    assert json.loads(members["status/robot1.json"].content)["problems"] == ["the worker printed REMOVED"]
    assert json.loads(members["doctor.json"].content)["schema"] == "zsched.doctor/1"
    assert {"zsched", "wire", "zenoh", "python", "system"} <= set(json.loads(members["versions.json"].content))


@pytest.mark.parametrize("is_hard", [False, True])
def test_a_link_in_the_state_folder_brings_no_other_file_into_the_report(tmp_path: Path, *, is_hard: bool) -> None:
    """The folder is the service's, so a worker may write there, and root makes the report and hands it out."""
    scene = fleet_scene(tmp_path)
    scene.state_folder.mkdir(exist_ok=True)
    secret = tmp_path / "shadow"
    secret.write_text("root:$6$salt$hash:1:2:3:::")
    for name in (NAME, OLD_NAME):
        path = scene.state_folder / name
        path.unlink(missing_ok=True)
        path.hardlink_to(secret) if is_hard else path.symlink_to(secret)
    members = {one.name: one for one in gathered(scene, lambda: "")}
    for name in (NAME, OLD_NAME):
        assert members[name].content == b""
        assert "link" in members[name].missing


def test_what_cannot_be_had_is_said(tmp_path: Path) -> None:
    scene = fleet_scene(tmp_path)
    scene.file.unlink()
    scene = replace(scene, statuses={name: one for name, one in scene.statuses.items() if name != "robot2"})
    missing = {one.name: one.missing for one in gathered(scene, no_journal) if one.missing}
    assert set(missing) == {"fleet.yaml", "status/robot2.json", "decisions.ndjson", "journal.txt"}
    assert missing["journal.txt"].startswith("No journal files")


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "fleet.yaml").write_text(TEXT)
    for name, value in {"CONFIG": "fleet.yaml", "STATE_DIR": "state", "RUNTIME_DIR": "run"}.items():
        monkeypatch.setenv(f"ZSCHED_{name}", str(tmp_path / value))
    monkeypatch.setenv("ZSCHED_NODE", "robot1")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["bugreport", *arguments])


def test_the_file_is_its_user_s_only_and_is_never_overwritten(place: Path) -> None:
    result = run("report.tar.gz")
    assert (result.exit_code, result.stderr) == (0, "")
    file = place / "report.tar.gz"
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    with tarfile.open(file) as archive:
        names = set(archive.getnames())
        text = archive.extractfile("report/fleet.yaml")
        assert text is not None
        assert SECRET.encode() not in text.read()
    assert {"report/versions.json", "report/doctor.txt"} <= names
    assert "status/robot2.json           not there: robot2 does not answer" in result.stdout
    assert "read it before you hand it on" in result.stdout
    again = run("report.tar.gz")
    assert (again.exit_code, again.stdout) == (1, "")
    assert "is there already" in again.stderr
