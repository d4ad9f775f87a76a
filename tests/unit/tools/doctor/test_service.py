"""Faults planted in a machine's systemd unit, and in certificates."""

from __future__ import annotations

import json
import shutil
import subprocess
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from support.authorities import install, make_authority
from support.certificates import make_tls
from support.clinic import FLEET, assert_finds, run, scene_of
from zsched.link.sessions.certificate import validities
from zsched.pki.authority import opened
from zsched.tools.doctor import security
from zsched.tools.doctor.model import Scene, Verdict
from zsched.tools.doctor.service import NOBODY

ROOT = Path(__file__).parents[4]
FAIL, WARN, PASS, SKIP = Verdict.FAIL, Verdict.WARN, Verdict.PASS, Verdict.SKIP


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    """A machine with the unit that comes with zsched, enabled, and what it reads."""
    root = tmp_path / "machine"
    for folder in ("run/systemd/system", "etc/systemd/system/multi-user.target.wants", "opt/zsched/bin", "etc/zsched"):
        (root / folder).mkdir(parents=True)
    unit = root / "etc/systemd/system/zsched.service"
    shutil.copy(ROOT / "systemd" / "zsched.service", unit)
    (root / "etc/systemd/system/multi-user.target.wants/zsched.service").symlink_to(unit)
    (root / "opt/zsched/bin/zsched").write_text("#!/opt/zsched/bin/python\nimport zsched\n")
    (root / "opt/zsched/bin/python").symlink_to("/usr/bin/env")
    (root / "etc/zsched/fleet.yaml").write_text(FLEET)
    (root / "etc/zsched/fleet.yaml").chmod(0o644)
    return replace(scene_of(tmp_path), root=root)


def test_a_unit_in_order_passes(scene: Scene) -> None:
    for name in ("unit.installed", "unit.enabled", "unit.paths"):
        assert run(name, scene).verdict is PASS, run(name, scene)


def test_a_unit_that_is_missing_is_found(scene: Scene) -> None:
    (scene.root / "etc/systemd/system/zsched.service").unlink()
    found = run("unit.installed", scene)
    assert_finds(found, WARN, "does not start by itself")
    assert found.fix == "sudo /opt/zsched/bin/zsched install", "it brings the user, too, whose group may ask"
    assert run("unit.paths", scene).verdict is SKIP


def test_a_machine_without_systemd_is_skipped(scene: Scene) -> None:
    (scene.root / "run/systemd/system").rmdir()
    assert run("unit.installed", scene).verdict is SKIP


def test_a_unit_that_is_not_enabled_or_masked_is_found(scene: Scene) -> None:
    (scene.root / "etc/systemd/system/multi-user.target.wants/zsched.service").unlink()
    assert_finds(run("unit.enabled", scene), WARN, "does not start at boot")
    unit = scene.root / "etc/systemd/system/zsched.service"
    unit.unlink()
    unit.symlink_to("/dev/null")
    assert_finds(run("unit.enabled", scene), FAIL, "masked")


def test_a_program_that_the_service_cannot_see_is_found(scene: Scene) -> None:
    python = scene.root / "opt/zsched/bin/python"
    python.unlink()
    python.symlink_to("/home/somebody/python/bin/python3")
    assert_finds(run("unit.paths", scene), FAIL, "leads to /home")
    drop_in = scene.root / "etc/systemd/system/zsched.service.d/home.conf"
    drop_in.parent.mkdir()
    drop_in.write_text("[Service]\nProtectHome=no\n")
    assert run("unit.paths", scene).verdict is PASS
    (scene.root / "opt/zsched/bin/zsched").unlink()
    assert_finds(run("unit.paths", scene), FAIL, "which is not there")


def test_a_fleet_file_that_the_service_cannot_read_is_found(scene: Scene) -> None:
    file = scene.root / "etc/zsched/fleet.yaml"
    file.chmod(0o600)
    assert_finds(run("unit.paths", scene), FAIL, "not readable by the service's user")
    file.unlink()
    assert_finds(run("unit.paths", scene), FAIL, "/etc/zsched/fleet.yaml, which is not there")


def test_what_a_user_with_a_name_cannot_read_is_found(scene: Scene, tmp_path: Path) -> None:
    """The unit of an installation has one (`10-user.conf`), and the daemon ended with 78 behind a PASS."""
    drop_in = scene.root / "etc/systemd/system/zsched.service.d/10-user.conf"
    drop_in.parent.mkdir()
    file = scene.root / "etc/zsched/fleet.yaml"
    for name in ("nobody", "who-is-not-here"):
        drop_in.write_text(f"[Service]\nDynamicUser=no\nUser={name}\n")
        file.chmod(0o600)
        assert_finds(run("unit.paths", scene), FAIL, "not readable by the service's user")
        file.chmod(0o644)
        assert run("unit.paths", scene).verdict is PASS
    drop_in.write_text("[Service]\nDynamicUser=no\nUser=root\n")
    file.chmod(0o600)
    assert run("unit.paths", scene).verdict is PASS
    file.chmod(0o644)
    authority = make_authority(tmp_path / "authority", "hall")
    install(authority, scene.root / "etc/zsched/certificates", "robot1")
    text = FLEET.replace("tcp/", "tls/")
    text = text.replace("fleet: hall", "fleet: hall\nsecurity: {folder: /etc/zsched/certificates}")
    secured = replace(scene_of(tmp_path, text), root=scene.root)
    assert run("unit.paths", secured).verdict is PASS
    drop_in.write_text("[Service]\nDynamicUser=no\nUser=nobody\n")
    assert_finds(run("unit.paths", secured), FAIL, "key.pem is not handed over to the service's user, which may not")


@pytest.mark.parametrize(
    ("drop_in", "user"),
    [
        ("User=root\nDynamicUser=no", {}),
        ("User=daemon\nDynamicUser=no", {"user": 1, "group": 1, "extra_groups": [], "cwd": "/"}),
        ("", {"user": NOBODY, "group": NOBODY, "extra_groups": [], "cwd": "/"}),
    ],
)
def test_an_operators_program_is_never_run_as_root(
    scene: Scene, monkeypatch: pytest.MonkeyPatch, drop_in: str, user: dict[str, object]
) -> None:
    """`sudo zsched doctor` imports what a task's command names, and operators may name anything."""
    asked: list[dict[str, object]] = []

    def run_it(_command: list[object], **words: object) -> subprocess.CompletedProcess[str]:
        asked.append({name: words[name] for name in ("user", "group", "extra_groups", "cwd") if name in words})
        return subprocess.CompletedProcess([], 0, "", "")

    monkeypatch.setattr("zsched.tools.doctor.workers.subprocess.run", run_it)
    file = scene.root / "etc/systemd/system/zsched.service.d/10-user.conf"
    file.parent.mkdir()
    file.write_text(f"[Service]\n{drop_in}\n")
    for uid, expected in ((0, user), (1000, {})):
        monkeypatch.setattr("os.geteuid", lambda uid=uid: uid)
        assert run("worker.imports", scene).verdict is PASS
        assert asked.pop() == expected
        assert not asked


def test_a_key_that_systemd_does_not_hand_over_is_found(scene: Scene, tmp_path: Path) -> None:
    authority, text = make_authority(tmp_path / "authority", "hall"), FLEET.replace("tcp/", "tls/")
    for name, node in (("pki", "edge1"), ("certificates", "robot1")):
        install(authority, scene.root / "etc/zsched" / name, node)
    usual = text.replace("fleet: hall", "fleet: hall\nsecurity: {folder: /etc/zsched/pki}")
    assert run("unit.paths", replace(scene_of(tmp_path, usual), root=scene.root)).verdict is PASS, "by the unit itself"
    text = text.replace("fleet: hall", "fleet: hall\nsecurity: {folder: /etc/zsched/certificates}")
    secured = replace(scene_of(tmp_path, text), root=scene.root)
    folder, key = scene.root / "etc/zsched/certificates", "/etc/zsched/certificates/key.pem"
    assert_finds(run("unit.paths", secured), FAIL, f"{key} is not handed over")
    drop_in = scene.root / "etc/systemd/system/zsched.service.d/key.conf"
    drop_in.parent.mkdir()
    drop_in.write_text(f"[Service]\nLoadCredential=key.pem:{key}\n")
    assert run("unit.paths", secured).verdict is PASS
    (folder / "ca.pem").unlink()
    assert_finds(run("unit.paths", secured), FAIL, "ca.pem, which is not there")


def test_a_worker_below_a_home_is_found(scene: Scene, tmp_path: Path) -> None:
    text = FLEET.replace("[python, -m, zsched.tasks.echo]", "[/home/somebody/worker]")
    homely = replace(scene_of(tmp_path, text), root=scene.root)
    assert_finds(run("unit.paths", homely), FAIL, "/home/somebody/worker")


# --- certificates ----------------------------------------------------------------------------------------------------


@pytest.fixture
def secured(tmp_path: Path) -> Scene:
    """A fleet with TLS, whose certificates are good for two days."""
    make_tls(tmp_path)
    text = FLEET.replace("fleet: hall", "fleet: hall\nzenoh: {config: zenoh.json5}").replace("tcp/", "tls/")
    return scene_of(tmp_path, text)


def test_a_certificate_that_ends_soon_has_ended_or_has_not_begun_is_found(secured: Scene) -> None:
    now = datetime.now(UTC)
    assert_finds(security.certificates_last(secured), WARN, "node.pem is valid", "days are left")
    assert_finds(security.certificates_last(secured, now + timedelta(days=9)), FAIL, "it has ended")
    assert_finds(security.certificates_last(secured, now - timedelta(days=9)), FAIL, "it has not begun")


def test_a_certificate_with_years_left_passes(secured: Scene, tmp_path: Path) -> None:
    made = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-keyout", "node.key", "-out", "node.pem"]
    subprocess.run([*made, "-days", "20000", "-subj", "/CN=x"], cwd=tmp_path, capture_output=True, check=True)
    shutil.copy(tmp_path / "node.pem", tmp_path / "ca.pem")
    assert security.certificates_last(secured).verdict is PASS
    ((begins, ends),) = validities((tmp_path / "node.pem").read_bytes())
    assert ends - begins == timedelta(days=20000)  # past 2049 the time has another form


def test_a_certificate_that_is_missing_or_none_is_found(secured: Scene, tmp_path: Path) -> None:
    (tmp_path / "node.pem").write_text("-----BEGIN CERTIFICATE-----\nMAoG\n-----END CERTIFICATE-----\n")
    assert_finds(security.certificates_last(secured), FAIL, "malformed")
    (tmp_path / "node.pem").write_text("something else")
    assert_finds(security.certificates_last(secured), FAIL, "no certificate in it")
    (tmp_path / "node.key").unlink()
    assert_finds(security.certificates_last(secured), FAIL, "node.key: No such file")


@pytest.fixture
def own(tmp_path: Path) -> Scene:
    """A fleet with an authority of its own."""
    install(make_authority(tmp_path / "authority", "hall"), tmp_path / "pki", "edge1")
    return scene_of(tmp_path, FLEET.replace("fleet: hall", "fleet: hall\nsecurity: {}").replace("tcp/", "tls/"))


def test_the_fleets_own_certificates_are_told_of_a_week_before_they_end(own: Scene, tmp_path: Path) -> None:
    now = datetime.now(UTC)
    for name in ("tls.certificates", "tls.key", "tls.open"):
        assert run(name, own).verdict is PASS, run(name, own)
    assert security.certificates_last(own, now + timedelta(days=22)).verdict is PASS
    assert_finds(
        security.certificates_last(own, now + timedelta(days=24)), WARN, "pki/certificate.pem", "5 days are left"
    )
    late = security.certificates_last(own, now + timedelta(days=40))
    assert_finds(late, FAIL, "it has ended")
    assert late.fix.startswith("is this machine's clock right (timedatectl)"), "a daemon renews its own in time"
    install(make_authority(tmp_path / "again", "hall"), tmp_path / "pki", "robot1")
    assert_finds(run("tls.certificates", own), FAIL, "is robot1's, and this node is edge1")
    (tmp_path / "pki" / "certificate.pem").unlink()
    assert_finds(run("tls.certificates", own), FAIL, "certificate.pem: No such file")


def test_a_certificate_that_ends_is_renewed_by_the_name_of_its_key(own: Scene, tmp_path: Path) -> None:
    late = datetime.now(UTC) + timedelta(days=31)
    assert "`zsched pki renew edge1` " in security.certificates_last(own, late).fix
    with opened(tmp_path / "authority", "hall") as authority:
        authority.revoke("edge1", datetime.now(UTC))
        install(authority, tmp_path / "pki", "edge1")
    fix = security.certificates_last(own, late).fix
    assert "`zsched pki renew edge1.k2` where the fleet's authority is, and bring edge1.k2/certificate.pem to" in fix
    (tmp_path / "pki" / "certificate.pem").write_text("something else")
    assert "`zsched pki renew edge1` " in security.certificates_last(own).fix, "nobody knows its key"


def test_a_certificate_that_was_sent_into_a_state_folder_of_another_place_counts(own: Scene, tmp_path: Path) -> None:
    """The doctor is told of that folder by an option, and the daemon goes by what lies there."""
    now = datetime.now(UTC)
    with opened(tmp_path / "authority", "hall") as authority:
        sent = authority.renew("edge1", None, b"", b"", now + timedelta(days=20)).certificate
    (own.state_folder / "pki").mkdir()
    (own.state_folder / "pki" / "certificate.pem").write_bytes(sent)
    result = security.certificates_last(own, now + timedelta(days=31))
    assert result.verdict is PASS
    assert str(own.state_folder / "pki" / "certificate.pem") in "\n".join(result.evidence)


def test_who_may_not_see_a_certificate_that_was_sent_is_told_of_no_end(
    own: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The state folder is the service's alone, and the one that was brought at first ends a month later."""
    late = datetime.now(UTC) + timedelta(days=31)
    assert security.certificates_last(own, late).verdict is FAIL
    monkeypatch.setattr("zsched.tools.doctor.state.os.access", lambda *_: False)
    result = security.certificates_last(own, late)
    assert result.verdict is Verdict.SKIP
    assert f"a later one may be in {own.state_folder}: run the doctor as root" in result.evidence[0]
    assert security.certificates_last(own).verdict is PASS
    (tmp_path / "pki" / "ca.pem").write_text("none")
    assert_finds(security.certificates_last(own, late), FAIL, "ca.pem")


def test_a_key_that_others_may_read_is_found(own: Scene, secured: Scene, tmp_path: Path) -> None:
    (tmp_path / "pki" / "key.pem").chmod(0o644)
    assert_finds(run("tls.key", own), FAIL, "mode 0644: every user of this machine reads the key")
    (tmp_path / "pki" / "key.pem").chmod(0o640)
    assert_finds(run("tls.key", own), WARN, "its group reads the key")
    (tmp_path / "node.key").chmod(0o604)
    assert_finds(run("tls.key", secured), FAIL, "node.key")


FIB = """\
Local:
  +-- 0.0.0.0/0 3 0 5
     +-- 127.0.0.0/8 2 0 2
        |-- 127.0.0.1
           /32 host LOCAL
     |-- {address}
        /32 host LOCAL
        |-- 10.255.255.255
           /32 link BROADCAST
"""


def test_a_session_without_certificates_at_a_public_address_is_found(tmp_path: Path) -> None:
    scene = scene_of(tmp_path, root=tmp_path)
    fib = tmp_path / "proc" / "net" / "fib_trie"
    fib.parent.mkdir(parents=True)
    for address, verdict, said in (
        ("10.0.0.7", WARN, "whoever is in its private network"),
        ("93.184.216.34", FAIL, "tcp/0.0.0.0:21257 at 93.184.216.34"),
        ("127.0.0.2", PASS, "only for this machine"),
    ):
        fib.write_text(FIB.format(address=address))
        result = run("tls.open", scene)
        assert (result.verdict, said in result.evidence[0]) == (verdict, True), result
    fib.write_text(FIB.format(address="127.0.0.2"))
    addressed = scene_of(
        tmp_path, FLEET.replace("control: tcp/0.0.0.0:21257", "control: 'tcp/[2001:4860::1]:7'"), root=tmp_path
    )
    assert_finds(run("tls.open", addressed), FAIL, "2001:4860::1")
    named = FLEET.replace("control: tcp/0.0.0.0:21257", "control: 'tcp/robot1.example.com:7'")
    assert_finds(run("tls.open", scene_of(tmp_path, named, root=tmp_path)), WARN, "tcp/robot1.example.com:7")
    own = named.replace("robot1.example.com", "localhost")
    assert run("tls.open", scene_of(tmp_path, own, root=tmp_path)).verdict is PASS


def test_a_zenoh_file_that_cannot_be_read_is_found(secured: Scene, tmp_path: Path) -> None:
    (tmp_path / "zenoh.json5").write_text(json.dumps({"nosuch": 1}))
    assert_finds(run("tls.open", secured), FAIL, "not a zenoh configuration")


def test_workers_whom_nobody_starts_as_their_user_are_found(scene: Scene, tmp_path: Path) -> None:
    unit = scene.root / "etc/systemd/system/zsched.service"
    assert run("worker.user", scene).evidence == ("merge: runs as the daemon's user",)
    unit.write_text(unit.read_text() + "\n[Service]\nEnvironment=ZSCHED_STARTERS=/run/zsched-workers\n")
    folder = scene.root / "run/zsched-workers"
    folder.mkdir()
    (folder / "zsched-worker.sock").touch()
    assert run("worker.user", scene).evidence == ("merge: runs as zsched-worker",)
    named = scene_of(tmp_path, FLEET.replace("worker: {", "worker: {user: ros, "))
    found = run("worker.user", replace(named, root=scene.root))
    assert_finds(found, FAIL, "nobody starts workers as user ros here")
    assert found.fix == "sudo systemctl enable --now zsched-worker@ros.socket"
