"""The fleet's authority: what it issues, renews, revokes and rotates, and what its folder looks like."""

from __future__ import annotations

import base64
import contextlib
import errno
import json
import os
import stat
import subprocess
import threading
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import rsa
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from zsched.core.values.certificates import Role
from zsched.core.values.errors import AdapterError
from zsched.host.key_files import write_whole
from zsched.pki import authority as module
from zsched.pki import certificates as made
from zsched.pki.authority import RECORD, TRUSTED, Authority, create, key_name, opened

NOW = datetime(2026, 11, 23, 12, tzinfo=UTC)
FLEET = "yard"


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    return create(tmp_path / "authority", FLEET, b"", NOW)


def issue(authority: Authority, name: str = "robot1", role: Role = Role.NODE, request: bytes = b"") -> bytes:
    return authority.issue(name, role, ["192.0.2.11", "robot1.lan"], request, b"", NOW).certificate


def request_of(key: made.PrivateKey | rsa.RSAPrivateKey) -> bytes:
    builder = x509.CertificateSigningRequestBuilder().subject_name(
        x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "whoever.asks")])
    )
    if isinstance(key, rsa.RSAPrivateKey):
        from cryptography.hazmat.primitives import hashes

        return builder.sign(key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)
    return builder.sign(key, None).public_bytes(serialization.Encoding.PEM)


def test_a_certificate_names_its_holder_its_role_and_where_it_is_dialled(authority: Authority) -> None:
    certificate = x509.load_pem_x509_certificate(issue(authority))
    subject = {one.oid: one.value for one in certificate.subject}
    assert subject[NameOID.COMMON_NAME] == "robot1.yard.zsched.internal"
    assert subject[NameOID.ORGANIZATIONAL_UNIT_NAME] == "node"
    names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert names.get_values_for_type(x509.DNSName) == ["robot1.yard.zsched.internal", "localhost", "robot1.lan"]
    assert [str(one) for one in names.get_values_for_type(x509.IPAddress)] == ["127.0.0.1", "192.0.2.11"]
    usage = certificate.extensions.get_extension_for_class(x509.KeyUsage)
    assert usage.critical
    assert usage.value.digital_signature
    assert not usage.value.key_cert_sign
    purposes = certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    assert set(purposes) == {ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH}
    assert not certificate.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    assert certificate.not_valid_after_utc - NOW == timedelta(days=30)


def test_the_authority_signs_end_entities_only_and_its_signature_holds(authority: Authority) -> None:
    own = x509.load_pem_x509_certificate(authority.trusted)
    limits = own.extensions.get_extension_for_class(x509.BasicConstraints)
    assert (limits.critical, limits.value.ca, limits.value.path_length) == (True, True, 0)
    x509.load_pem_x509_certificate(issue(authority)).verify_directly_issued_by(own)


def test_the_key_is_the_owners_alone_and_no_part_of_a_file_is_left(authority: Authority) -> None:
    issue(authority)
    modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in authority.folder.iterdir()}
    assert modes == {key_name(1): 0o600, TRUSTED: 0o644, RECORD: 0o644, module.LOCK: 0o600}
    assert stat.S_IMODE(authority.folder.stat().st_mode) == 0o700


def test_a_file_that_cannot_be_written_whole_is_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "key.pem"
    write_whole(path, b"old", 0o600)

    def refuse(_descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", refuse)
    with pytest.raises(OSError, match="No space"):
        write_whole(path, b"new", 0o600)
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.root
def test_root_gives_away_the_file_that_it_has_written_and_not_what_its_name_leads_to(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The folder may be a service's: what runs as it could have any file of the machine."""
    if os.geteuid() != 0:
        pytest.skip("only root gives files away")
    folder, victim = tmp_path / "theirs", tmp_path / "shadow"
    folder.mkdir()
    victim.write_text("root's own")
    os.chown(folder, 65_533, 65_533)
    change_mode = os.fchmod

    def swap(descriptor: int, mode: int) -> None:
        change_mode(descriptor, mode)
        (part,) = folder.iterdir()
        part.unlink()
        part.symlink_to(victim)

    monkeypatch.setattr(os, "fchmod", swap)
    write_whole(folder / "key.pem", b"new", 0o600)
    assert victim.stat().st_uid == 0
    monkeypatch.undo()
    write_whole(folder / "ca.pem", b"new", 0o644)
    assert ((folder / "ca.pem").stat().st_uid, victim.read_text()) == (65_533, "root's own")


def test_a_passphrase_locks_the_key_and_a_wrong_one_is_said_to_be(tmp_path: Path) -> None:
    authority = create(tmp_path / "authority", FLEET, b"correct", NOW)
    assert authority.is_locked
    assert b"ENCRYPTED" in authority.key_path.read_bytes()
    with pytest.raises(AdapterError, match="the passphrase is wrong"):
        authority.issue("robot1", Role.NODE, [], b"", b"wrong", NOW)
    assert not authority.record.entries
    assert authority.issue("robot1", Role.NODE, [], b"", b"correct", NOW).key


def test_a_request_keeps_the_key_where_it_was_made_and_its_name_does_not_count(authority: Authority) -> None:
    key = made.new_key()
    issued = authority.issue("robot1", Role.NODE, [], request_of(key), b"", NOW)
    assert issued.key == b""
    certificate = x509.load_pem_x509_certificate(issued.certificate)
    assert certificate.public_key() == key.public_key()
    assert "whoever" not in certificate.subject.rfc4514_string()


def test_requests_that_are_none_or_of_a_weak_kind_are_refused(authority: Authority) -> None:
    weak = request_of(rsa.generate_private_key(65537, 2048))
    whole = request_of(made.new_key())
    forged = x509.load_pem_x509_csr(whole).public_bytes(serialization.Encoding.DER)
    forged = forged[:-1] + bytes([forged[-1] ^ 1])
    pem = x509.load_der_x509_csr(forged).public_bytes(serialization.Encoding.PEM)
    for request, why in (
        (b"nothing", "no certificate request"),
        (weak, "neither Ed25519 nor P-256"),
        (pem, "not by the"),
        (changed(whole, ED25519, UNKNOWN), "neither Ed25519 nor P-256"),
        (changed(whole, VERSION_1, VERSION_2), "no certificate request"),
    ):
        with pytest.raises(AdapterError, match=f"the certificate request: .*{why}"):
            issue(authority, request=request)
    assert not authority.record.entries


ED25519, UNKNOWN = bytes.fromhex("06032b6570"), bytes.fromhex("06032b656d")
"""Object identifiers: of the kind of key, and one of nothing."""
VERSION_1, VERSION_2 = bytes.fromhex("020100"), bytes.fromhex("020101")
"""Of requests there is only the first."""


def changed(pem: bytes, old: bytes, new: bytes) -> bytes:
    """A PEM file in which the first of these bytes is another."""
    lines = pem.splitlines()
    der = base64.b64decode(b"".join(lines[1:-1]))
    assert old in der
    return b"\n".join((lines[0], base64.b64encode(der.replace(old, new, 1)), lines[-1], b""))


def test_a_key_of_a_kind_that_nobody_knows_is_said_to_be_none_of_ours() -> None:
    key = changed(made.key_pem(made.new_key()), ED25519, UNKNOWN)
    for read in (lambda: made.read_key(key, b""), lambda: made.is_key_of(key, b"")):
        with pytest.raises(ValueError, match="key"):
            read()


def test_openssls_request_is_taken(authority: Authority, tmp_path: Path) -> None:
    words = ["openssl", "req", "-new", "-newkey", "ed25519", "-nodes", "-subj", "/CN=robot1"]
    done = subprocess.run(
        [*words, "-keyout", "key.pem", "-out", "robot1.csr"], cwd=tmp_path, capture_output=True, check=False, timeout=30
    )
    assert done.returncode == 0, done.stderr
    assert issue(authority, request=(tmp_path / "robot1.csr").read_bytes())


def test_two_holders_never_share_a_key(authority: Authority) -> None:
    request = request_of(made.new_key())
    issue(authority, request=request)
    with pytest.raises(AdapterError, match="that key is robot1's and in use"):
        issue(authority, "robot2", request=request)
    authority.revoke("robot1", NOW)
    with pytest.raises(AdapterError, match="that key is robot1's and revoked"):
        issue(authority, request=request)


def test_a_key_whose_place_another_took_stays_its_holders(authority: Authority) -> None:
    """A stolen key does not come back under another name, once its holder has another one and is revoked."""
    first, second = request_of(made.new_key()), request_of(made.new_key())
    issue(authority, request=first)
    authority.renew("robot1", None, second, b"", NOW)
    with pytest.raises(AdapterError, match="that key is robot1's and in use"):
        issue(authority, "robot2", request=first)
    authority.revoke("robot1", NOW)
    for name in ("robot1", "robot2"):
        refused = pytest.raises(AdapterError, match="that key is robot1's and revoked")
        with opened(authority.folder, FLEET) as again, refused:
            issue(again, name, request=first)


def test_a_renewal_keeps_key_number_and_hosts_and_a_new_key_has_the_next_number(authority: Authority) -> None:
    first = x509.load_pem_x509_certificate(issue(authority))
    with pytest.raises(AdapterError, match="`zsched pki renew robot1` keeps its key"):
        issue(authority)
    later = NOW + timedelta(days=20)
    renewed = authority.renew("robot1", None, b"", b"", later)
    second = x509.load_pem_x509_certificate(renewed.certificate)
    assert second.public_key() == first.public_key()
    assert second.not_valid_after_utc - later == timedelta(days=30)
    assert renewed.entry.hosts == ("192.0.2.11", "robot1.lan")
    authority.revoke("robot1", NOW)
    with pytest.raises(AdapterError, match="the key of robot1 is revoked"):
        authority.renew("robot1", None, b"", b"", later)
    third = x509.load_pem_x509_certificate(issue(authority))
    assert "CN=robot1.k2.yard.zsched.internal" in third.subject.rfc4514_string()
    assert third.public_key() != first.public_key()


def test_an_entry_is_due_after_two_thirds_of_its_life(authority: Authority) -> None:
    issue(authority)
    (entry,) = authority.record.entries
    begun = int(NOW.timestamp())
    assert not entry.is_due(begun + 19 * 86400, 1)
    assert entry.is_due(begun + 21 * 86400, 1)
    assert entry.is_due(begun, 2)


def test_an_entry_of_the_future_is_due(authority: Authority) -> None:
    """The clock was 40 days ahead for one run of the timer; no node takes what was made then."""
    issue(authority)
    authority.renew("robot1", None, b"", b"", NOW + timedelta(days=40))
    (entry,) = authority.record.entries
    now = int(NOW.timestamp())
    assert entry.is_due(now, 1)
    assert entry.is_due(entry.issued - 3601, 1)
    assert not entry.is_due(entry.issued - 3599, 1), "valid by the clock of every node that is no more than that behind"


def test_a_rotation_by_a_mistyped_passphrase_changes_nothing(tmp_path: Path) -> None:
    """The next key would be locked by it, and nobody knows it."""
    folder = tmp_path / "locked"
    create(folder, "yard", b"secret", NOW)
    with opened(folder, "yard") as locked:
        with pytest.raises(AdapterError, match="the passphrase is wrong"):
            locked.rotate(b"secrte", NOW)
        assert locked.record.number == 1
        locked.rotate(b"secret", NOW)
        locked.issue("robot1", Role.NODE, (), b"", b"secret", NOW)
    assert sorted(path.name for path in folder.glob("*.key")) == [key_name(1), key_name(2)]


def test_a_rotation_trusts_both_until_no_certificate_is_of_the_former(authority: Authority) -> None:
    issue(authority)
    issue(authority, "ana", Role.OPERATOR)
    issue(authority, "gone")
    authority.revoke("gone", NOW)
    authority.rotate(b"", NOW)
    with pytest.raises(AdapterError, match="not finished"):
        authority.rotate(b"", NOW)
    first, second = x509.load_pem_x509_certificates(authority.trusted)
    assert {one.label for one in authority.finish()} == {"robot1", "ana.operator"}
    for label in ("robot1", "ana.operator"):
        renewed = authority.renew(label, None, b"", b"", NOW)
        x509.load_pem_x509_certificate(renewed.certificate).verify_directly_issued_by(first)
    assert authority.finish() == ()
    assert x509.load_pem_x509_certificates(authority.trusted) == [first]
    assert first != second
    assert not (authority.folder / key_name(1)).exists()
    with pytest.raises(AdapterError, match="no rotation"):
        authority.finish()


def no_room_for(monkeypatch: pytest.MonkeyPatch, *names: str) -> None:
    """The disk is full when one of these files is to be written."""

    def write(path: Path, content: bytes, mode: int) -> None:
        if path.name in names:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
        write_whole(path, content, mode)

    monkeypatch.setattr(module, "write_whole", write)


@pytest.mark.parametrize("is_end", [False, True])
def test_a_rotation_that_a_full_disk_has_cut_is_whole_once_there_is_room(
    authority: Authority, monkeypatch: pytest.MonkeyPatch, is_end: bool
) -> None:
    """Operators bring `ca.pem` to every machine: by an old one nobody would let in who has a new certificate."""
    if is_end:
        authority.rotate(b"", NOW)
    with monkeypatch.context() as patch:
        no_room_for(patch, TRUSTED)
        told = "No space left on device; the record is changed, and ca.pem is not: bring that file nowhere"
        with pytest.raises(AdapterError, match=told):
            authority.finish() if is_end else authority.rotate(b"", NOW)
        with opened(authority.folder, FLEET) as still:
            assert (authority.folder / TRUSTED).read_bytes() != still.trusted
    with opened(authority.folder, FLEET) as again:
        assert (again.record.number, again.is_rotating) == (2, not is_end)
        assert (authority.folder / TRUSTED).read_bytes() == again.trusted
    assert (authority.folder / key_name(1)).exists() is not is_end


def test_a_certificate_is_issued_though_its_authority_s_copy_cannot_be_written(
    authority: Authority, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It says nothing new; the key would be lost, and its number with it."""
    no_room_for(monkeypatch, TRUSTED)
    assert issue(authority)


def test_what_was_done_is_there_when_it_is_opened_again(authority: Authority) -> None:
    issue(authority)
    authority.revoke("robot1", NOW)
    with opened(authority.folder, FLEET) as again:
        assert again.record == authority.record
    body = json.loads((authority.folder / RECORD).read_text())
    assert [(one["label"], one["revoked"]) for one in body["entries"]] == [("robot1", int(NOW.timestamp()))]


def test_a_folder_that_is_none_another_fleets_or_damaged_is_refused(authority: Authority, tmp_path: Path) -> None:
    with pytest.raises(AdapterError, match=r"there is no authority in .*; `zsched pki init`"), opened(tmp_path, FLEET):
        pass
    with pytest.raises(AdapterError, match="of fleet yard, not of field"), opened(authority.folder, "field"):
        pass
    with pytest.raises(AdapterError, match="holds an authority"):
        create(authority.folder, FLEET, b"", NOW)
    authority.key_path.unlink()
    with pytest.raises(AdapterError, match="is not there: is it offline"):
        issue(authority)
    (authority.folder / RECORD).write_text("{}")
    with pytest.raises(AdapterError, match="is damaged"), opened(authority.folder, FLEET):
        pass


def test_of_two_who_begin_an_authority_at_once_one_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both were told that they had one, and the key of one lay beside the record of the other."""
    both, begin = threading.Barrier(2), made.new_authority

    def slow(*arguments: Any) -> Any:
        with contextlib.suppress(threading.BrokenBarrierError):
            both.wait(0.5)
        return begin(*arguments)

    monkeypatch.setattr(made, "new_authority", slow)
    with ThreadPoolExecutor(2) as pool:
        tries = [pool.submit(create, tmp_path / "both", FLEET, b"", NOW) for _ in range(2)]
    (failure,) = [error for one in tries if (error := one.exception(10)) is not None]
    assert "holds an authority" in str(failure)
    with opened(tmp_path / "both", FLEET) as authority:
        assert issue(authority)


def test_names_that_no_certificate_holds_are_refused(authority: Authority) -> None:
    with pytest.raises(AdapterError, match="a certificate's name has at most 64; give the node"):
        issue(authority, "r" * 50)


def test_a_key_of_another_authority_is_refused(authority: Authority, tmp_path: Path) -> None:
    other = create(tmp_path / "other", FLEET, b"", NOW)
    authority.key_path.write_bytes(other.key_path.read_bytes())
    with pytest.raises(AdapterError, match="is not the key of"):
        issue(authority)


def test_the_lock_is_made_through_no_link(authority: Authority, tmp_path: Path) -> None:
    lock, elsewhere = authority.folder / module.LOCK, tmp_path / "elsewhere"
    lock.unlink(missing_ok=True)
    lock.symlink_to(elsewhere)
    with pytest.raises(AdapterError, match="cannot be read"), opened(authority.folder, FLEET):
        pass
    assert not elsewhere.exists()
    lock.unlink()
    for _ in range(2):
        with opened(authority.folder, FLEET):
            assert stat.S_IMODE(lock.stat().st_mode) == 0o600
