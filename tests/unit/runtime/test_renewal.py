"""A certificate that was sent to a node: which one it takes, and which files its sessions go by from then on."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from support.authorities import install, make_authority
from zsched.config.load import check_bytes
from zsched.core.values.fleet import Fleet
from zsched.core.values.messages import CommandOutcome
from zsched.link.sessions.secured import digest_of, files_of, renewed_in, require_own
from zsched.pki.authority import Authority
from zsched.runtime.renewal import problem, take

OK, UNCHANGED, INVALID = CommandOutcome.OK, CommandOutcome.UNCHANGED, CommandOutcome.INVALID
NOW = datetime.now(UTC)


@pytest.fixture
def authority(tmp_path: Path) -> Authority:
    return make_authority(tmp_path / "authority", "yard")


@pytest.fixture
def fleet(tmp_path: Path, authority: Authority, monkeypatch: pytest.MonkeyPatch) -> Fleet:
    """Of which this machine is robot1; its certificate was made ten days ago."""
    install(authority, tmp_path / "pki", "robot1", ago=timedelta(days=10))
    monkeypatch.setenv("ZSCHED_STATE_DIR", str(tmp_path / "state"))
    text = f"fleet: yard\nsecurity: {{folder: {tmp_path / 'pki'}}}\nnodes:\n  robot1: {{kind: robot}}\ntasks: {{}}\n"
    found = check_bytes(text.encode()).fleet
    assert found is not None
    return found


def renewed(authority: Authority, ago: timedelta = timedelta()) -> str:
    return authority.renew("robot1", None, b"", b"", NOW - ago).certificate.decode()


def test_a_newer_certificate_for_the_same_key_is_gone_by(fleet: Fleet, authority: Authority, tmp_path: Path) -> None:
    assert fleet.security is not None
    before, pem = digest_of(fleet.security), renewed(authority)
    result = take(fleet, tmp_path / "state", pem)
    assert result.outcome is OK, result
    files = files_of(fleet.security)
    assert files.certificate == renewed_in(tmp_path / "state")
    assert files.certificate.read_text() == pem
    assert files.key == tmp_path / "pki" / "key.pem"
    require_own(fleet, fleet.security, "robot1")
    assert digest_of(fleet.security) != before, "open sessions have another one"
    assert take(fleet, tmp_path / "state", pem).outcome is UNCHANGED
    older = renewed(authority, timedelta(days=5))
    assert take(fleet, tmp_path / "state", older).outcome is UNCHANGED
    assert files.certificate.read_text() == pem


def test_a_newer_authority_s_certificate_is_gone_by_though_it_ends_earlier(
    fleet: Fleet, authority: Authority, tmp_path: Path
) -> None:
    """The clock of the authority's machine was set back before it rotated; without the node's it would be cut off."""
    assert fleet.security is not None
    state, own = tmp_path / "state", renewed(authority)
    assert take(fleet, state, own).outcome is OK
    authority.rotate(b"", NOW - timedelta(days=1))
    (tmp_path / "pki" / "ca.pem").write_bytes(authority.trusted)
    pem = renewed(authority, timedelta(days=1))
    result = take(fleet, state, pem)
    assert result.outcome is OK, result
    assert files_of(fleet.security).certificate.read_text() == pem
    assert take(fleet, state, pem).outcome is UNCHANGED
    again = take(fleet, state, own)
    assert again.outcome is INVALID, "somebody sends the former one once more"
    assert "stands behind that of this node's certificate" in again.detail
    assert files_of(fleet.security).certificate.read_text() == pem


def test_a_newer_authority_s_file_that_was_brought_is_gone_by_though_one_that_was_sent_ends_later(
    fleet: Fleet, authority: Authority, tmp_path: Path
) -> None:
    assert fleet.security is not None
    assert take(fleet, tmp_path / "state", renewed(authority)).outcome is OK
    authority.rotate(b"", NOW - timedelta(days=1))
    brought = tmp_path / "pki" / "certificate.pem"
    brought.write_text(renewed(authority, timedelta(days=1)))
    (tmp_path / "pki" / "ca.pem").write_bytes(authority.trusted)
    assert files_of(fleet.security).certificate == brought
    authority.finish()
    (tmp_path / "pki" / "ca.pem").write_bytes(authority.trusted)
    assert files_of(fleet.security).certificate == brought


def test_of_what_is_sent_only_the_certificate_is_kept(fleet: Fleet, authority: Authority, tmp_path: Path) -> None:
    """zenoh reads the file in its own way: it could find another first, or one that it cannot load, and not listen."""
    assert fleet.security is not None
    pem, other = renewed(authority), make_authority(tmp_path / "other", "yard")
    install(other, tmp_path / "mallory", "robot1")
    forged = (tmp_path / "mallory" / "certificate.pem").read_text()
    sent = f"# {pem.replace(chr(10), ' ')}\n{forged}-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n"
    result = take(fleet, tmp_path / "state", sent)
    assert result.outcome is OK, result
    assert files_of(fleet.security).certificate.read_text() == pem


def test_what_systemd_hands_over_is_renewed_too(
    fleet: Fleet, authority: Authority, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert fleet.security is not None
    (tmp_path / "pki").rename(tmp_path / "handed")
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(tmp_path / "handed"))
    assert take(fleet, tmp_path / "state", renewed(authority)).outcome is OK
    assert files_of(fleet.security).certificate == renewed_in(tmp_path / "state")


def test_nothing_else_is_taken(fleet: Fleet, authority: Authority, tmp_path: Path) -> None:
    assert fleet.security is not None
    state, other = tmp_path / "state", make_authority(tmp_path / "other", "yard")
    install(other, tmp_path / "mallory", "robot1")
    install(authority, tmp_path / "robot2", "robot2")
    forged = (tmp_path / "mallory" / "certificate.pem").read_text()
    theirs = (tmp_path / "robot2" / "certificate.pem").read_text()
    ended = authority.renew("robot1", None, b"", b"", NOW - timedelta(days=31)).certificate.decode()
    to_come = authority.renew("robot1", None, b"", b"", NOW + timedelta(days=2)).certificate.decode()
    authority.revoke("robot1", NOW)
    next_key = authority.issue("robot1", authority.record.entries[0].holder.role, [], b"", b"", NOW)
    for pem, why in (
        (forged, "of no authority that this node trusts"),
        (theirs, "is robot2.yard.zsched.internal's"),
        (ended, "not valid by its clock"),
        (to_come, "not valid by its clock"),
        (next_key.certificate.decode(), "robot1.k2.yard"),
        ("", "no certificate in it"),
        ("-----BEGIN CERTIFICATE-----\nMAoG\n-----END CERTIFICATE-----", ""),
    ):
        result = take(fleet, state, pem)
        assert result.outcome is INVALID
        assert why in result.detail
    assert not renewed_in(state).exists()
    assert files_of(fleet.security).certificate == tmp_path / "pki" / "certificate.pem"
    assert take(replace(fleet, security=None), state, forged).outcome is INVALID


def test_a_file_of_another_key_in_the_state_folder_counts_for_nothing(fleet: Fleet, tmp_path: Path) -> None:
    assert fleet.security is not None
    install(make_authority(tmp_path / "again", "yard"), renewed_in(tmp_path / "state").parent, "robot1")
    assert files_of(fleet.security).certificate == tmp_path / "pki" / "certificate.pem"


def test_a_state_folder_that_cannot_be_written_is_told(fleet: Fleet, authority: Authority, tmp_path: Path) -> None:
    (tmp_path / "state").write_text("")
    result = take(fleet, tmp_path / "state", renewed(authority))
    assert result.outcome is INVALID
    assert "cannot be written" in result.detail


def test_a_certificate_that_nobody_renews_is_told_of_a_week_before_its_end(fleet: Fleet) -> None:
    assert problem(fleet, NOW) is None
    assert problem(fleet, NOW + timedelta(days=12)) is None
    soon = problem(fleet, NOW + timedelta(days=14)) or ""
    assert "certificate ends on" in soon
    assert "`zsched pki renew --deliver`" in soon
    assert problem(replace(fleet, security=None), NOW + timedelta(days=99)) is None


def test_a_certificate_that_has_ended_is_told_to_be_brought_for_nothing_can_be_sent(fleet: Fleet) -> None:
    told = problem(fleet, NOW + timedelta(days=21)) or ""
    assert "has ended on" in told
    assert "--deliver" not in told
    assert fleet.security is not None
    assert "`zsched pki renew robot1`" in told
    assert f"bring robot1/certificate.pem to {fleet.security.folder} here" in told


def test_a_later_key_is_renewed_by_its_own_name(fleet: Fleet, authority: Authority, tmp_path: Path) -> None:
    """The name of the node is that of its first key, which is revoked."""
    authority.revoke("robot1", NOW)
    install(authority, tmp_path / "pki", "robot1")
    told = problem(fleet, NOW + timedelta(days=31)) or ""
    assert "`zsched pki renew robot1.k2`" in told
    assert "bring robot1.k2/certificate.pem to " in told


def test_a_certificate_that_has_not_begun_is_the_clocks_fault(fleet: Fleet) -> None:
    """The robot's clock began in 1970: its status blamed the key, and the cure for that revoked a good one."""
    told = problem(fleet, NOW - timedelta(days=400)) or ""
    assert "so nobody lets it in: set this machine's clock (`timedatectl`)" in told
    assert "renew" not in told
