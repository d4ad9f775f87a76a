"""What a machine keeps when it founds a fleet or joins one, and what is never mixed."""

from __future__ import annotations

import grp
import os
import shutil
import stat
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from zsched.commands.base.places import Places
from zsched.commands.members import belongings as membership
from zsched.commands.members import unfinished
from zsched.commands.members.belongings import (
    BEFORE,
    found,
    is_joined,
    is_out,
    join,
    note_out,
    put_away,
)
from zsched.commands.members.blank import init_state
from zsched.config.load import load_fleet
from zsched.core.values.codec import document_hash
from zsched.core.values.document import Document
from zsched.core.values.electorate import FleetValue
from zsched.core.values.errors import AdapterError, ConfigError
from zsched.core.values.fleet import Fleet, fleet_hash
from zsched.host import state_file
from zsched.host.document_store import DocumentStore, copied_file
from zsched.host.state_file import StateFile
from zsched.link.invitation import Invitation, Papers

TEXT = """\
fleet: hall
seeds: [robot1]
nodes:
  robot1: {kind: robot, host: 127.0.0.1, listen: {control: tcp/127.0.0.1:7457, data: tcp/127.0.0.1:7458}}
  robot2: {kind: robot}
tasks:
  merge: {candidates: {kind: robot}, weights: {cpu: 1}}
  guard: {candidates: {kind: robot}, weights: {cpu: 1}}
"""


SECURED = f"{TEXT.replace('tcp/', 'tls/')}security: {{}}\n"


class PowerCut(BaseException):
    """Nothing runs after it."""


def found_by_half(text: str, places: Places, write: str, certify: Callable[[Fleet, str], Papers]) -> None:
    """The power goes at the write that is named."""

    def cut(*_: object) -> None:
        raise PowerCut

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(membership, write, cut)
        with pytest.raises(PowerCut):
            found(text, "robot1", places, is_plan=False, certify=certify)


@pytest.fixture
def first(tmp_path: Path) -> Places:
    return Places(config=tmp_path / "one" / "etc" / "fleet.yaml", state=tmp_path / "one" / "state")


@pytest.fixture
def second(tmp_path: Path) -> Places:
    return Places(config=tmp_path / "two" / "etc" / "fleet.yaml", state=tmp_path / "two" / "state")


def value_at(places: Places, node: str) -> tuple[FleetValue, Document]:
    state = StateFile(places.state, fleet="hall", node=node).load().state
    assert state is not None
    assert state.fleet_register is not None
    value = state.fleet_register.learnt
    assert value is not None
    content = DocumentStore(places.state).load(value.document)
    assert content is not None
    return value, content


@pytest.fixture
def invitation(first: Places) -> Invitation:
    found(TEXT, "robot1", first, is_plan=False)
    value, content = value_at(first, "robot1")
    return Invitation(node="robot2", value=value, document=content)


def test_a_note_that_a_machine_is_out_ends_when_it_is_taken_in_again(first: Places) -> None:
    """Else a later leave would tell nobody."""
    assert not is_out("hall", "robot1", first.state)
    found(TEXT, "robot1", first, is_plan=False)
    assert not is_out("hall", "robot1", first.state), "there is no note"
    value, _ = value_at(first, "robot1")
    note_out("hall", "robot1", value.revision + 1, first.state)
    assert is_out("hall", "robot1", first.state), "its daemon ended before it learnt that"
    assert not is_out("hall", "robot2", first.state)
    note_out("hall", "robot1", value.revision, first.state)
    assert not is_out("hall", "robot1", first.state), "it has the document of that revision, so that names it"
    (first.state / "documents" / value.document).unlink()
    assert is_out("hall", "robot1", first.state), "a document that does not name it is not stored"
    (first.state / "out").write_text("hall robot1\n")
    assert not is_out("hall", "robot1", first.state)
    put_away("hall", "robot1", first, is_purged=False)
    assert not (first.state / "out").exists()


def test_the_first_machine_is_the_only_elector_and_each_task_has_a_creation(first: Places) -> None:
    fleet, files = found(TEXT, "robot1", first, is_plan=False)
    value, content = value_at(first, "robot1")
    assert (content.text, first.config.read_text()) == (TEXT, TEXT)
    assert [one.name for one in value.electors] == ["robot1"]
    assert (value.revision, value.number, value.settled, value.is_founding) == (1, 1, True, False)
    assert [(one.task, one.number) for one in value.tasks] == [("guard", 1), ("merge", 2)]
    assert len(value.generation_id) == 32
    assert copied_file(first.state) == fleet_hash(fleet)
    assert [one.path for one in files] == [first.config, first.state / "documents", first.state / "state"]
    assert all(one.path.exists() for one in files)


def test_two_fleets_of_one_name_have_different_generations(first: Places, second: Places) -> None:
    for places in (first, second):
        found(TEXT, "robot1", places, is_plan=False)
    assert value_at(first, "robot1")[0].generation_id != value_at(second, "robot1")[0].generation_id


def test_a_plan_writes_nothing(first: Places, second: Places, invitation: Invitation) -> None:
    _, planned = join(invitation, second, is_plan=True)
    assert not second.state.parent.exists()
    _, written = join(invitation, second, is_plan=False)
    assert planned == written
    shutil.rmtree(first.config.parents[1])
    found(TEXT, "robot1", first, is_plan=True)
    assert not first.config.parents[1].exists()


def test_no_fleet_is_founded_where_one_is(first: Places, second: Places) -> None:
    found(TEXT, "robot1", first, is_plan=False)
    for places in (first, replace(first, config=second.config)):
        with pytest.raises(AdapterError, match=r"belongs to a fleet; leave that fleet first \(`zsched leave`\)"):
            found(TEXT, "robot1", places, is_plan=False)
    with pytest.raises(AdapterError, match=r"or take this machine out of its fleet first \(`zsched leave`\)"):
        found(TEXT.replace("fleet: hall", "fleet: yard"), "robot1", first, is_plan=False)
    with pytest.raises(AdapterError, match=r"exists already, and is left as it is; use it \(`zsched init`\)"):
        found(TEXT, "robot1", replace(first, state=second.state), is_plan=False)
    assert not second.config.exists()


@pytest.mark.parametrize("write", ["_put_papers", "DocumentStore", "fleet_hash"])
def test_a_creation_that_a_power_cut_broke_off_can_be_given_again(first: Places, write: str) -> None:
    """Else its fleet file would be taken for one that is there, and a fleet be made of it that has no document."""
    text, creations = SECURED, list[str]()

    def certify(_: object, creation: str) -> Papers:
        creations.append(creation)
        return Papers(certificate=f"certificate {len(creations)}", key="key", trusted="trusted")

    found_by_half(text, first, write, certify)
    assert first.config.exists()
    found(text, "robot1", first, is_plan=True, certify=certify)
    again = text.replace("127.0.0.1", "127.0.0.2")
    found(again, "robot1", first, is_plan=False, certify=certify)
    assert first.config.read_text() == again
    assert (first.config.parent / "pki" / "certificate.pem").read_text() == "certificate 2"
    assert creations[0] == creations[1], "by it the authority of the first try is known"
    assert value_at(first, "robot1")[1].text == again
    assert not unfinished.mark_of(first.config).exists()
    with pytest.raises(AdapterError, match="belongs to a fleet"):
        found(text, "robot1", first, is_plan=False, certify=certify)


@pytest.mark.parametrize("name", ["fleet.yaml", "pki/certificate.pem", "pki/key.pem"])
def test_what_somebody_has_written_since_a_creation_was_broken_off_stays(first: Places, name: str) -> None:
    def certify(*_: object) -> Papers:
        return Papers(certificate="certificate", key="key", trusted="trusted")

    found_by_half(SECURED, first, "fleet_hash", certify)
    path = first.config.parent / name
    path.write_text("somebody's own")
    for is_plan in (True, False):
        with pytest.raises(AdapterError, match=f"{path} exists already, and is left as it is"):
            found(SECURED, "robot1", first, is_plan=is_plan, certify=certify)
    assert path.read_text() == "somebody's own"
    path.unlink()
    found(SECURED, "robot1", first, is_plan=False, certify=certify)


def test_a_creation_that_fails_leaves_nothing_in_the_way(first: Places, monkeypatch: pytest.MonkeyPatch) -> None:
    def failed(*_: object) -> None:
        raise AdapterError("the disk is full")

    with monkeypatch.context() as patch:
        patch.setattr(membership, "fleet_hash", failed)
        with pytest.raises(AdapterError, match="the disk is full"):
            found(TEXT, "robot1", first, is_plan=False)
    assert list(first.config.parent.iterdir()) == []
    mark = unfinished.mark_of(first.config)
    for text in ("", "{}", "[]", '{"creation": 1}'):
        mark.write_text(text)
        assert unfinished.unfinished(first.config) is None
    found(TEXT, "robot1", first, is_plan=False)
    mark.write_text('{"creation": "a", "written": []}')  # the power went before it was deleted
    put_away("hall", "robot1", first, is_purged=False)
    assert not mark.exists()


def test_a_machine_that_joins_knows_the_value_the_document_and_has_a_disk_of_its_own(
    first: Places, second: Places, invitation: Invitation
) -> None:
    assert not is_joined(invitation, second)
    join(invitation, second, is_plan=False)
    assert is_joined(invitation, second)
    assert value_at(second, "robot2") == value_at(first, "robot1")
    assert load_fleet(second.config).name == "hall"
    states = [
        StateFile(one.state, fleet="hall", node=name).load().state
        for one, name in ((first, "robot1"), (second, "robot2"))
    ]
    assert len({state.disk for state in states if state is not None}) == 2


def test_another_fleets_file_is_left_as_it_is(second: Places, invitation: Invitation) -> None:
    second.config.parent.mkdir(parents=True)
    for text, why in ((TEXT.replace("hall", "yard"), "the file of fleet yard"), ("fleet: [", "no usable fleet file")):
        second.config.write_text(text)
        with pytest.raises(AdapterError, match=why):
            join(invitation, second, is_plan=False)
        assert second.config.read_text() == text
        assert not second.state.exists()


def test_another_text_of_the_same_fleet_is_kept_beside(second: Places, invitation: Invitation) -> None:
    second.config.parent.mkdir(parents=True)
    old = TEXT.replace("robot2", "robot3")
    second.config.write_text(old)
    join(invitation, second, is_plan=False)
    assert second.config.read_text() == TEXT
    assert second.config.with_name(f"fleet.yaml{BEFORE}").read_text() == old


def test_a_file_that_only_some_may_read_stays_so_and_so_does_the_copy_of_the_former(
    second: Places, invitation: Invitation
) -> None:
    """The environment of its workers may hold secrets."""
    second.config.parent.mkdir(parents=True)
    second.config.write_text(TEXT.replace("robot2", "robot3"))
    second.config.chmod(0o640)
    owner = (12, 34) if os.geteuid() == 0 else (os.geteuid(), os.getegid())
    os.chown(second.config, *owner)
    join(invitation, second, is_plan=False)
    for path in (second.config, second.config.with_name(f"fleet.yaml{BEFORE}")):
        found_ = path.stat()
        assert (stat.S_IMODE(found_.st_mode), found_.st_uid, found_.st_gid) == (0o640, *owner)


@pytest.mark.parametrize(("service", "mode"), [("daemon", 0o640), ("no-such-group", 0o644)])
def test_a_new_file_is_for_its_owner_and_the_service_s_group(
    service: str, mode: int, second: Places, invitation: Invitation, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The service's user must read it, and has no name where the unit came alone."""
    monkeypatch.setattr(membership, "SERVICE", service)
    join(invitation, second, is_plan=False)
    found_, is_root = second.config.stat(), os.geteuid() == 0
    assert stat.S_IMODE(found_.st_mode) == (mode if is_root else 0o640)
    assert grp.getgrgid(found_.st_gid).gr_name == service or mode == 0o644 or not is_root


def test_a_state_of_another_node_fleet_or_generation_is_left_as_it_is(
    first: Places, second: Places, invitation: Invitation
) -> None:
    instead = r"own with --state-dir, or take this machine out of its fleet first \(`zsched leave`\)$"
    with pytest.raises(AdapterError, match=f"belongs to the node 'robot1'.*{instead}"):
        is_joined(invitation, first)
    other = replace(invitation, value=replace(invitation.value, generation_id="cd" * 16))
    join(other, second, is_plan=False)
    with pytest.raises(AdapterError, match="of another generation"):
        is_joined(invitation, second)
    with pytest.raises(AdapterError, match=f"belongs to the fleet.*{instead}"):
        is_joined(replace(invitation, value=replace(invitation.value, fleet="yard")), second)


def test_a_state_of_before_the_document_is_no_membership(first: Places, second: Places, invitation: Invitation) -> None:
    init_state(load_fleet(first.config), "robot2", second.state, 0)
    with pytest.raises(AdapterError, match="before its document was agreed"):
        is_joined(invitation, second)


def test_a_damaged_state_is_said_so(second: Places, invitation: Invitation) -> None:
    join(invitation, second, is_plan=False)
    (second.state / "state").write_bytes(b"torn")
    with pytest.raises(AdapterError, match="is damaged"):
        is_joined(invitation, second)


def test_what_was_written_in_part_is_written_again(second: Places, invitation: Invitation) -> None:
    join(invitation, second, is_plan=False)
    (second.state / "state").unlink()
    assert not is_joined(invitation, second)
    join(invitation, second, is_plan=False)
    assert is_joined(invitation, second)


def test_the_mode_is_that_of_the_file_that_was_written_and_not_of_what_its_name_leads_to(
    second: Places, invitation: Invitation, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The state folder is the service's, and `join` runs as root."""
    victim = tmp_path / "passwd"
    victim.write_text("root's own")
    victim.chmod(0o644)
    sync = state_file.sync_folder

    def swap(folder: Path) -> None:
        sync(folder)
        copied = second.state / "copied"
        if copied.exists() and not copied.is_symlink():
            copied.unlink()
            copied.symlink_to(victim)

    monkeypatch.setattr(state_file, "sync_folder", swap)
    join(invitation, second, is_plan=False)
    assert (second.state / "copied").is_symlink()
    assert stat.S_IMODE(victim.stat().st_mode) == 0o644
    assert stat.S_IMODE(second.config.stat().st_mode) == 0o644


def test_the_number_of_the_last_start_outlives_a_node_unless_all_goes(second: Places, invitation: Invitation) -> None:
    join(invitation, second, is_plan=False)
    (second.state / "life").write_text("7\n")
    put_away("hall", "robot2", second, is_purged=False)
    assert (second.state / "life").read_text() == "7\n"
    join(invitation, second, is_plan=False)
    put_away("hall", "robot2", second, is_purged=True)
    assert not (second.state / "life").exists()


@pytest.mark.parametrize("is_purged", [True, False])
def test_a_key_elsewhere_is_found_again_when_the_power_has_gone_while_files_were_put_away(
    first: Places, monkeypatch: pytest.MonkeyPatch, is_purged: bool
) -> None:
    """Only the fleet file says where it is: `leave --purge` says that it has deleted the key."""
    text = SECURED.replace("security: {}", "security: {folder: ../keys}")
    papers = Papers(certificate="cert", key="key", trusted="ca")
    found(text, "robot1", first, is_plan=False, certify=lambda *_: papers)
    key = first.config.parent.parent / "keys" / "key.pem"
    assert key.read_text() == "key"
    put_one = membership._put_one_away

    def one_and_no_more(path: Path, *, is_deleted: bool) -> None:
        put_one(path, is_deleted=is_deleted)
        raise PowerCut

    with monkeypatch.context() as patch:
        patch.setattr(membership, "_put_one_away", one_and_no_more)
        with pytest.raises(PowerCut):
            put_away("hall", "robot1", first, is_purged=is_purged)
    put_away("hall", "robot1", first, is_purged=is_purged)
    left = [] if is_purged else ["ca.pem.left", "certificate.pem.left", "key.pem.left"]
    assert sorted(one.name for one in key.parent.iterdir()) == left


def test_a_link_in_the_state_folder_never_chooses_whose_keys_are_put_away(
    second: Places, invitation: Invitation, tmp_path: Path
) -> None:
    """The folder is the service's, and `leave` runs as root."""
    join(invitation, second, is_plan=False)
    theirs = tmp_path / "elsewhere"
    theirs.mkdir()
    (theirs / "key.pem").write_text("somebody's own")
    (second.state / "pki").symlink_to(theirs)
    put_away("hall", "robot2", second, is_purged=True)
    assert [one.name for one in theirs.iterdir()] == ["key.pem"]
    assert not (second.state / "state").exists()


def test_a_state_folder_in_use_is_refused_before_anything_is_written(second: Places, invitation: Invitation) -> None:
    with StateFile(second.state, fleet="hall", node="robot2"), pytest.raises(AdapterError, match="is in use by"):
        join(invitation, second, is_plan=False)
    assert not second.config.exists()


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path, invitation: Invitation) -> None:
    (tmp_path / "file").write_text("")
    places = Places(config=tmp_path / "file" / "fleet.yaml", state=tmp_path / "state")
    with pytest.raises(AdapterError, match="Not a directory"):
        join(invitation, places, is_plan=False)


def test_a_fleet_that_was_founded_in_part_is_founded_again(first: Places) -> None:
    first.state.mkdir(parents=True)
    (first.state / "documents").write_text("in the way")
    with pytest.raises(AdapterError, match="cannot write the fleet's document"):
        found(TEXT, "robot1", first, is_plan=False)
    assert not first.config.exists()
    (first.state / "documents").unlink()
    found(TEXT, "robot1", first, is_plan=False)
    assert value_at(first, "robot1")[1].text == TEXT


def test_what_is_in_the_way_of_a_file_is_named(second: Places, invitation: Invitation) -> None:
    file = second.state / "copied"
    (file.parent / f"{file.name}.new").mkdir(parents=True)
    with pytest.raises(AdapterError, match=rf"cannot write .*/{file.name}: Is a directory; look what is at"):
        join(invitation, second, is_plan=False)


@pytest.mark.root
def test_a_full_disk_is_told_as_that_and_the_command_can_be_given_again(
    tmp_path: Path, second: Places, invitation: Invitation
) -> None:
    disk = tmp_path / "small"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=28k", "tmpfs", str(disk)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    if mounted.returncode != 0:
        pytest.skip(f"cannot mount a small disk: {mounted.stderr.strip()}")
    try:
        where = Places(config=second.config, state=disk / "state")
        told = set()
        for pages in (7, 6, 5, 4):  # what is left is enough for one file more each time
            (disk / "filler").write_bytes(b"x" * 4096 * pages)
            with pytest.raises(AdapterError, match=r"No space left on device; free or remount the disk") as caught:
                join(invitation, where, is_plan=False)
            told.add(str(caught.value).partition(":")[0].rpartition("/")[2])
        assert {"documents", "copied", "state"} <= told
        (disk / "filler").unlink()
        join(invitation, where, is_plan=False)
        assert is_joined(invitation, where)
    finally:
        subprocess.run(["umount", str(disk)], check=True, timeout=60)


def test_a_document_that_cannot_be_used_here_is_refused(second: Places, invitation: Invitation) -> None:
    for text, why in (("fleet: hall\nnodes: {}\n", "no nodes"), (TEXT.replace("robot2", "robot3"), "no node 'robot2'")):
        content = replace(invitation.document, text=text)  # type: ignore[arg-type]
        value = replace(invitation.value, document=document_hash(content))
        with pytest.raises(ConfigError, match=why):
            join(replace(invitation, document=content, value=value), second, is_plan=False)
    papers = Papers(certificate="c", key="k", trusted="t")
    with pytest.raises(ConfigError, match="has a certificate"):
        join(replace(invitation, papers=papers), second, is_plan=False)


def test_a_certificate_of_somebody_else_is_refused(second: Places, invitation: Invitation) -> None:
    text = TEXT.replace("tcp/", "tls/") + "security: {}\n"
    content = replace(invitation.document, text=text)  # type: ignore[arg-type]
    value = replace(invitation.value, document=document_hash(content))
    papers = Papers(certificate="c", key="k", trusted="t")
    with pytest.raises(ConfigError, match="certificate names None, and its node is robot2"):
        join(replace(invitation, document=content, value=value, papers=papers), second, is_plan=False)


def test_who_joins_counts_by_the_generation_that_operators_have_counted(second: Places, invitation: Invitation) -> None:
    join(replace(invitation, generation=2), second, is_plan=False)
    state = StateFile(second.state, fleet="hall", node="robot2").load().state
    assert state is not None
    assert (state.generation, state.registers) == (2, ())
