"""`zsched install` and `zsched uninstall`, below a folder."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from zsched.cli import app
from zsched.config.load import check_bytes
from zsched.core.vote.generations import blank_state
from zsched.host.state_file import StateFile
from zsched.tools.install import SYSTEM_FOLDERS, left

REPO = Path(__file__).parents[3]


@pytest.fixture
def prefix(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An environment that pip has installed into."""
    folder = tmp_path / "env"
    shutil.copytree(REPO / "systemd", folder / "share/zsched")
    shutil.copytree(REPO / "man", folder / "share/man/man1")
    monkeypatch.setattr(sys, "prefix", str(folder))
    return folder


@pytest.fixture
def root(tmp_path: Path) -> Path:
    (tmp_path / "root").mkdir()
    return tmp_path / "root"


def run(verb: str, root: Path, *options: str) -> Result:
    return CliRunner().invoke(app, [verb, "--root", str(root), *options])


def files_in(root: Path) -> set[str]:
    return {str(path.relative_to(root)) for path in root.rglob("*") if not path.is_dir()}


def test_install_lays_out_what_the_system_looks_for(prefix: Path, root: Path) -> None:
    result = run("install", root)
    assert result.exit_code == 0, result.output
    assert len(result.output.splitlines()) <= 20, result.output
    unit = (root / "etc/systemd/system/zsched.service").read_text()
    assert f"ExecStart={prefix}/bin/zsched up" in unit
    assert "/opt/zsched" not in unit
    assert (root / "usr/local/bin/zsched").readlink() == prefix / "bin/zsched"
    for name in (
        "bash-completion/completions/zsched",
        "zsh/site-functions/_zsched",
        "fish/vendor_completions.d/zsched.fish",
    ):
        assert (root / "usr/local/share" / name).is_file()
    assert (root / "usr/local/share/man/man1/zsched-install.1").is_file()
    users = (root / "etc/sysusers.d/zsched.conf").read_text().splitlines()
    assert [line.split()[1] for line in users if line.startswith("u ")] == ["zsched", "zsched-worker"]
    assert f"ExecStart={prefix}/bin/python" in (root / "etc/systemd/system/zsched-worker@.service").read_text()
    for name in files_in(root):
        assert str((root / name).parent) in result.output, "every folder is said"


def test_uninstall_takes_away_all_of_it(prefix: Path, root: Path) -> None:
    assert prefix.exists()
    run("install", root)
    assert run("uninstall", root).exit_code == 0
    assert files_in(root) == set()
    folders = {path.relative_to(root).as_posix() for path in root.rglob("*")}
    assert folders - {*SYSTEM_FOLDERS, "usr", "usr/local"} == set(), "no empty folder is left either"
    assert "usr/local/share/man" in folders, "every system has it"
    assert "nothing of it was there" in run("uninstall", root).output


def test_what_is_left_names_the_authoritys_key_that_a_fleet_needs(tmp_path: Path) -> None:
    env, authority = {"XDG_DATA_HOME": str(tmp_path / "data")}, tmp_path / "data/zsched/authority/field"
    assert left([tmp_path / "none"], env) == []
    authority.mkdir(parents=True)
    (tmp_path / "etc").mkdir()
    (only,) = left([tmp_path / "etc", tmp_path / "none"], env)
    assert f"{tmp_path}/etc, and the user" in only
    (authority / "authority.json").touch()
    (said,) = left([tmp_path / "none"], env)
    assert f"{authority}, the authority of fleet field" in said
    assert "zsched-renew.timer, which renews them from here, goes with the program" in said
    assert "to /root/.local/share/zsched/authority/field on another node, and enable zsched-renew.timer there" in said


def test_uninstall_says_first_that_the_machine_is_still_a_node(prefix: Path, root: Path) -> None:
    assert prefix.exists()
    run("install", root)
    assert "still" not in run("uninstall", root, "--plan").output
    state = root / "var/lib/zsched"
    fleet = check_bytes(b"fleet: hall\nnodes: {robot2: {kind: robot}}\ntasks: {}\n").fleet
    assert fleet is not None
    with StateFile(state, fleet="hall", node="robot2") as file:
        file.create(blank_state(fleet, "robot2", 0, None, incarnation=1, hardware="", disk="01"))
    still = "still robot2 of fleet hall, which counts on it: "
    forget = "elsewhere `zsched node forget robot2`"
    for options, code, advice in ((("--plan",), 10, f"`sudo zsched leave` first, or {forget}"), ((), 0, forget)):
        result = run("uninstall", root, *options)
        assert (result.exit_code, result.output.splitlines()[0]) == (code, f"{still}{advice}"), "what can be done then"
    (state / "state").write_text("what a power cut left")
    first = run("uninstall", root).output.splitlines()[0]
    assert first.startswith("nobody knows whether this machine is still a node of a fleet: ")
    (state / "state").rename(state / "state.left")
    assert run("uninstall", root).output == "nothing of it was there\n", "it has left"


def test_uninstall_names_the_drop_ins_that_operators_have_written(prefix: Path, root: Path) -> None:
    assert prefix.exists()
    run("install", root)
    units = root / "etc/systemd/system"
    mine = [units / "zsched.service.d/override.conf", units / "zsched-renew.service.d/passphrase.conf"]
    for path in mine:
        path.parent.mkdir(exist_ok=True)
        path.write_text("[Service]\n")
    told = [f"leave {path}: a drop-in that zsched has not made" for path in mine]
    plan = run("uninstall", root, "--plan").output.splitlines()
    assert [line for line in plan if "would leave" in line] == [f"would {one}" for one in told]
    done = run("uninstall", root).output.splitlines()
    assert [line for line in done if "drop-in" in line] == [one.replace("leave", "left", 1) for one in told]
    assert files_in(root) == {path.relative_to(root).as_posix() for path in mine}


def test_uninstall_leaves_a_folder_with_somebody_elses_file(prefix: Path, root: Path) -> None:
    assert prefix.exists()
    run("install", root)
    other = root / "usr/local/share/zsh/site-functions/_other"
    other.write_text("#compdef other\n")
    assert run("uninstall", root).exit_code == 0
    assert files_in(root) == {other.relative_to(root).as_posix()}


def test_a_plan_writes_nothing_and_tells_by_its_exit_code(prefix: Path, root: Path) -> None:
    assert prefix.exists()
    result = run("install", root, "--plan")
    assert (result.exit_code, files_in(root)) == (10, set())
    assert "would make" in result.output
    run("install", root)
    before = files_in(root)
    assert run("install", root, "--plan").exit_code == 0
    assert (run("uninstall", root, "--plan").exit_code, files_in(root)) == (10, before)


def test_a_second_time_it_renews_what_is_old(prefix: Path, root: Path) -> None:
    run("install", root)
    unit = root / "etc/systemd/system/zsched.service"
    unit.write_text(unit.read_text() + "# of an older version\n")
    result = run("install", root)
    assert (result.exit_code, result.output.count(f"{root}")) == (0, 2), result.output
    assert unit.read_text() == (prefix / "share/zsched/zsched.service").read_text().replace("/opt/zsched", str(prefix))
    assert "everything is there already" in run("install", root).output


def test_a_newer_version_takes_the_pages_of_verbs_away_that_it_no_longer_has(prefix: Path, root: Path) -> None:
    pages, links = prefix / "share/man/man1", root / "usr/local/share/man/man1"
    (pages / "zsched-juggle.1").write_text(".TH ZSCHED-JUGGLE 1\n")
    run("install", root)
    (links / "other.1").write_text(".TH OTHER 1\n")
    (links / "another.1").symlink_to("/opt/other/share/man/man1/another.1")
    before = files_in(root)
    (pages / "zsched-juggle.1").unlink()  # as pip does, which installs the newer version
    planned = run("install", root, "--plan")
    assert (planned.exit_code, files_in(root)) == (10, before)
    assert f"would remove {links}/zsched-juggle.1" in planned.output
    result = run("install", root)
    assert result.exit_code == 0
    assert f"removed {links}/zsched-juggle.1: manual page of a verb that this version has not" in result.output
    assert before - files_in(root) == {"usr/local/share/man/man1/zsched-juggle.1"}
    assert "everything is there already" in run("install", root).output


def test_uninstall_takes_an_old_page_away_too(prefix: Path, root: Path) -> None:
    (prefix / "share/man/man1/zsched-juggle.1").write_text(".TH ZSCHED-JUGGLE 1\n")
    run("install", root)
    (prefix / "share/man/man1/zsched-juggle.1").unlink()
    assert run("uninstall", root).exit_code == 0
    assert files_in(root) == set()


def test_what_is_not_zscheds_is_left_alone_and_stops_install_before_it_writes(prefix: Path, root: Path) -> None:
    assert prefix.exists()
    stranger = root / "usr/local/bin/zsched"
    stranger.parent.mkdir(parents=True)
    stranger.write_text("#!/bin/sh\n")
    result = run("install", root)
    assert result.exit_code == 1
    assert f"{stranger}: is there and not zsched's" in result.output
    assert files_in(root) == {"usr/local/bin/zsched"}
    result = run("uninstall", root)
    assert (result.exit_code, files_in(root)) == (0, {"usr/local/bin/zsched"})
    assert f"left {stranger}: not zsched's" in result.output


def test_an_environment_whose_python_is_a_link_in_a_home_is_no_place_for_a_service(
    prefix: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As `uv python install` makes one, and `python3.12 -m venv` takes it."""
    (prefix / "bin").mkdir()
    (prefix / "bin/python3.12").symlink_to("/root/.local/bin/python3.12")
    (prefix / "bin/python").symlink_to("python3.12")
    monkeypatch.setattr("zsched.tools.install.HIDDEN", ("/home", "/root"))
    result = run("install", Path("/"), "--plan")
    assert result.exit_code == 1
    assert f"{prefix}: its Python is /root/.local/bin/python3.12, which the service cannot see" in result.output


def test_a_home_is_no_place_for_a_service(prefix: Path) -> None:
    assert prefix.is_relative_to("/tmp"), "pytest's folder is one that the unit hides, too"  # noqa: S108 - as it says
    result = run("install", Path("/"), "--plan")
    assert result.exit_code == 1
    assert "the service cannot see" in result.output
