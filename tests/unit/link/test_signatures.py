"""Signatures by keys of the fleet's authority: right ones pass; another key, byte, time or authority does not."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec, rsa

from support.authorities import install, make_authority
from zsched.core.values.certificates import Role
from zsched.link.sessions.certificate import ders_of, own_key_id, parts_of, signing_key_id
from zsched.link.signatures import Trust, checking_by, own_certificate, signing_with
from zsched.pki import certificates as x509

NOW = datetime.now(UTC)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("keys")
    authority = make_authority(place / "authority", "yard")
    install(authority, place / "robot1", "robot1")
    install(authority, place / "ana", "ana", Role.OPERATOR)
    install(make_authority(place / "other", "yard"), place / "stranger", "robot1")
    return place


def certificate(folder: Path, name: str) -> bytes:
    return own_certificate((folder / name / "certificate.pem").read_bytes())


def trust(folder: Path) -> Trust:
    return Trust((folder / "robot1" / "ca.pem").read_bytes())


def test_a_certified_key_s_signature_passes_and_no_other_does(folder: Path) -> None:
    parts = trust(folder).certified(certificate(folder, "robot1"), NOW)
    assert parts is not None
    assert parts.common_name == "robot1.yard.zsched.internal"
    check = checking_by(parts.key)
    sign = signing_with((folder / "robot1" / "key.pem").read_bytes())
    assert check(sign(b"frame"), b"frame")
    assert not check(sign(b"frame"), b"frame2")
    assert not check(signing_with((folder / "ana" / "key.pem").read_bytes())(b"frame"), b"frame")
    assert not check(b"", b"frame")


def test_a_certificate_is_taken_apart_as_the_reference_does(folder: Path) -> None:
    for name in ("robot1", "ana"):
        reference = x509.read_certificate((folder / name / "certificate.pem").read_bytes())
        parts = parts_of(certificate(folder, name))
        assert parts.signed == reference.tbs_certificate_bytes
        assert parts.signature == reference.signature
        assert (parts.begins, parts.ends) == (reference.not_valid_before_utc, reference.not_valid_after_utc)
        public = serialization.PublicFormat.SubjectPublicKeyInfo
        assert parts.key == reference.public_key().public_bytes(serialization.Encoding.DER, public)


def test_a_certificate_names_the_key_that_has_signed_it(folder: Path) -> None:
    (authority,) = ders_of((folder / "robot1" / "ca.pem").read_bytes())
    assert own_key_id(authority)
    assert signing_key_id(certificate(folder, "ana")) == own_key_id(authority)
    assert signing_key_id(certificate(folder, "stranger")) not in (b"", own_key_id(authority))
    assert signing_key_id(authority) == b"", "its own says nothing of the kind"
    with pytest.raises(ValueError, match="malformed"):
        signing_key_id(certificate(folder, "ana").replace(bytes.fromhex("0603551d23"), bytes.fromhex("0603551d2304")))


def test_another_authority_s_certificate_is_none_of_ours(folder: Path) -> None:
    assert trust(folder).certified(certificate(folder, "stranger"), NOW) is None


def test_a_certificate_counts_only_while_it_is_valid(folder: Path) -> None:
    der = certificate(folder, "robot1")
    for when in (NOW - timedelta(days=1), NOW + timedelta(days=31)):
        assert trust(folder).certified(der, when) is None


def test_a_changed_certificate_is_refused_wherever_it_is_changed(folder: Path) -> None:
    """Every byte, with one bit the other way: nothing passes, and nothing escapes."""
    der, trusted = certificate(folder, "robot1"), trust(folder)
    assert trusted.certified(der, NOW) is not None
    for at in range(len(der)):
        for bit in (0x01, 0x80):
            changed = der[:at] + bytes((der[at] ^ bit,)) + der[at + 1 :]
            assert trusted.certified(changed, NOW) is None, at
    for end in range(len(der)):
        assert trusted.certified(der[:end], NOW) is None


def test_a_certificate_in_other_bytes_is_refused_though_its_signature_is_right(folder: Path) -> None:
    """TLS refuses each of these, so a node that kept one as its own could not listen any more."""
    der, trusted = certificate(folder, "robot1"), trust(folder)
    assert der[:2] == b"\x30\x82"
    length = len(der) - 4
    for other in (
        der + b"\0",
        b"\x30\x82" + (length + 2).to_bytes(2, "big") + der[4:] + b"\x05\x00",
        b"\x30\x83\x00" + length.to_bytes(2, "big") + der[4:],
    ):
        assert trusted.certified(other, NOW) is None


def test_an_authority_s_own_certificate_names_no_holder(folder: Path) -> None:
    own = own_certificate((folder / "robot1" / "ca.pem").read_bytes())
    parts = trust(folder).certified(own, NOW)
    assert parts is not None
    assert not parts.common_name.endswith("zsched.internal")


def pem_of(key: ec.EllipticCurvePrivateKey | rsa.RSAPrivateKey) -> bytes:
    return key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def test_p256_signs_too_and_other_keys_do_not() -> None:
    key = ec.generate_private_key(ec.SECP256R1())
    spki = serialization.PublicFormat.SubjectPublicKeyInfo
    check = checking_by(key.public_key().public_bytes(serialization.Encoding.DER, spki))
    assert check(signing_with(pem_of(key))(b"frame"), b"frame")
    assert not check(signing_with(pem_of(key))(b"frame"), b"other")
    other = ec.generate_private_key(ec.SECP384R1())
    with pytest.raises(ValueError, match="neither"):
        signing_with(pem_of(other))
    with pytest.raises(ValueError, match="neither"):
        checking_by(other.public_key().public_bytes(serialization.Encoding.DER, spki))


def test_a_locked_or_broken_key_is_refused() -> None:
    for pem in (x509.key_pem(x509.new_key(), b"secret"), b"", b"-----BEGIN PRIVATE KEY-----\n!\n"):
        with pytest.raises(ValueError, match="cannot be used"):
            signing_with(pem)
