"""Makes keys and certificates: Ed25519, X.509 version 3 (RFC 5280, RFC 8410).

Knows: the package ``cryptography``, what stands in a certificate of the fleet. Does not know: files, what was issued.
"""

from __future__ import annotations

import hashlib
import ipaddress
from collections.abc import Sequence
from datetime import datetime, timedelta
from typing import Final

from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec, ed25519
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from zsched.core.values.certificates import MAX_COMMON_NAME, Holder
from zsched.core.values.errors import AdapterError
from zsched.core.values.struct import Struct

AUTHORITY_LIFE: Final = timedelta(days=3650)
LIFE: Final = timedelta(days=30)
"""Of all certificates but the authority's own."""
EARLY: Final = timedelta(hours=1)
"""A certificate is valid that long before it is made: clocks of robots may be behind."""
OTHER_KIND: Final = "its key is neither Ed25519 nor P-256"
LOCAL: Final = ("localhost", "127.0.0.1")
"""Workers and tools dial the relay of their own machine there."""

PrivateKey = ed25519.Ed25519PrivateKey
PublicKey = ed25519.Ed25519PublicKey | ec.EllipticCurvePublicKey


class Signer(Struct, frozen=True, kw_only=True):
    """The authority's key and its own certificate."""

    key: PrivateKey
    certificate: x509.Certificate


def new_key() -> PrivateKey:
    """A key of its own."""
    return ed25519.Ed25519PrivateKey.generate()


def new_authority(fleet: str, number: int, now: datetime) -> Signer:
    """The ``number``-th authority of a fleet: its key, and its own certificate, which allows no other authority."""
    key = new_key()
    name = _named(f"zsched authority {number} of {fleet}"[:MAX_COMMON_NAME])
    certificate = (
        _begun(name, name, key.public_key(), now, AUTHORITY_LIFE)
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage(is_authority=True), critical=True)
        .sign(key, None)
    )
    return Signer(key=key, certificate=certificate)


def sign(
    signer: Signer, holder: Holder, fleet: str, public: PublicKey, hosts: Sequence[str], now: datetime
) -> x509.Certificate:
    """A certificate for ``public``, valid for `LIFE`, by which its holder may dial and be dialled at ``hosts``.

    Raises:
        AdapterError: the names are too long for a certificate.
    """
    name = holder.common_name(fleet)
    if len(name) > MAX_COMMON_NAME:
        raise AdapterError(
            f"{name} has {len(name)} characters, and a certificate's name has at most {MAX_COMMON_NAME}; "
            "give the node or the fleet a shorter name"
        )
    names = [_alternative(one) for one in dict.fromkeys((name, *LOCAL, *hosts))]
    issuer = signer.certificate
    authority = x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.key.public_key())
    purposes = x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH])
    return (
        _begun(_named(name, str(holder.role)), issuer.subject, public, now, LIFE)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(is_authority=False), critical=True)
        .add_extension(purposes, critical=False)
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
        .add_extension(authority, critical=False)
        .sign(signer.key, None)
    )


def requested_key(pem: bytes) -> PublicKey:
    """The public key of a certificate request; nothing else of it counts.

    Raises:
        ValueError: it is no request, its signature is not by that key, or the key is of another kind.
    """
    try:
        request = x509.load_pem_x509_csr(pem)
    except (ValueError, x509.InvalidVersion) as error:
        raise ValueError("it is no certificate request in PEM") from error
    try:
        is_signed, public = request.is_signature_valid, request.public_key()
    except (ValueError, UnsupportedAlgorithm) as error:  # of a kind that is not even known
        raise ValueError(OTHER_KIND) from error
    if not is_signed:
        raise ValueError("its signature is not by the key in it")
    return _fit(public)


def certified_key(certificate: x509.Certificate) -> PublicKey:
    """The key that a certificate is for.

    Raises:
        ValueError: it is of a kind that we never certify.
    """
    return _fit(certificate.public_key())


def fingerprint(public: PublicKey) -> str:
    """SHA-256 of a public key (its SubjectPublicKeyInfo), hex: the same in every certificate for it."""
    encoded = public.public_bytes(serialization.Encoding.DER, serialization.PublicFormat.SubjectPublicKeyInfo)
    return hashlib.sha256(encoded).hexdigest()


def key_pem(key: PrivateKey, passphrase: bytes = b"") -> bytes:
    """A private key as PKCS #8, encrypted when there is a passphrase."""
    lock = serialization.BestAvailableEncryption(passphrase) if passphrase else serialization.NoEncryption()
    return key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, lock)


def read_key(pem: bytes, passphrase: bytes) -> PrivateKey:
    """A private key out of a file.

    Raises:
        ValueError: it is none of ours, or the passphrase is wrong; `is_locked` tells whether one is needed.
    """
    try:
        key = serialization.load_pem_private_key(pem, passphrase or None)
    except (TypeError, UnsupportedAlgorithm) as error:  # a passphrase is missing, or none is needed
        raise ValueError(str(error)) from error
    if not isinstance(key, ed25519.Ed25519PrivateKey):
        raise ValueError("it is no Ed25519 key")  # noqa: TRY004 - a file's content, not a caller's type
    return key


def is_locked(pem: bytes) -> bool:
    """Whether a private key is encrypted."""
    return b"ENCRYPTED PRIVATE KEY" in pem


def is_key_of(pem: bytes, certificate: bytes) -> bool:
    """Whether a private key (PEM, not locked) is the one that a certificate (PEM) is for.

    Raises:
        ValueError: one of the two cannot be read.
    """
    try:
        key = serialization.load_pem_private_key(pem, None)
    except (TypeError, UnsupportedAlgorithm) as error:  # it is locked, or of a kind that is not known
        raise ValueError(str(error)) from error
    return fingerprint(_fit(key.public_key())) == fingerprint(certified_key(read_certificate(certificate)))


def request_pem(key: PrivateKey, name: str) -> bytes:
    """A certificate request for a key; ``name`` is for people, only the key counts."""
    asked = x509.CertificateSigningRequestBuilder().subject_name(_named(name)).sign(key, None)
    return asked.public_bytes(serialization.Encoding.PEM)


def certificate_pem(certificate: x509.Certificate) -> bytes:
    """A certificate as PEM."""
    return certificate.public_bytes(serialization.Encoding.PEM)


def read_certificate(pem: bytes) -> x509.Certificate:
    """The first certificate of a PEM file.

    Raises:
        ValueError: there is none.
    """
    return x509.load_pem_x509_certificate(pem)


def _begun(
    subject: x509.Name, issuer: x509.Name, public: PublicKey, now: datetime, life: timedelta
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(public)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - EARLY)
        .not_valid_after(now + life)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(public), critical=False)
    )


def _usage(*, is_authority: bool) -> x509.KeyUsage:
    """What its key may do: sign certificates and nothing else, or prove who dials."""
    return x509.KeyUsage(
        digital_signature=not is_authority,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=is_authority,
        crl_sign=False,
        encipher_only=False,
        decipher_only=False,
    )


def _named(common_name: str, role: str = "") -> x509.Name:
    unit = [x509.NameAttribute(NameOID.ORGANIZATIONAL_UNIT_NAME, role)] if role else []
    return x509.Name([*unit, x509.NameAttribute(NameOID.COMMON_NAME, common_name)])


def _alternative(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _fit(public: object) -> PublicKey:
    if isinstance(public, ed25519.Ed25519PublicKey):
        return public
    if isinstance(public, ec.EllipticCurvePublicKey) and isinstance(public.curve, ec.SECP256R1):
        return public
    raise ValueError(OTHER_KIND)
