"""Signs bytes with a node's key, and checks signatures by certified keys: Ed25519 (RFC 8032), or ECDSA with P-256.

Knows: the package ``cryptography``, of which it loads as little as it can (8 MiB, and with P-256 10). Does not know:
what is signed, which holder a certificate names.
"""

from __future__ import annotations

import binascii
import re
from collections.abc import Callable
from datetime import datetime
from typing import Final

from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives.asymmetric import ed25519

from zsched.link.sessions.certificate import Parts, ders_of, parts_of

Sign = Callable[[bytes], bytes]
Check = Callable[[bytes, bytes], bool]
"""(signature, what it is over) -> whether it is right."""

_PUBLIC: Final = bytes.fromhex("302a300506032b6570032100")
"""What stands before the 32 bytes of an Ed25519 key in its SubjectPublicKeyInfo (RFC 8410, section 4)."""
_PRIVATE: Final = bytes.fromhex("302e020100300506032b657004220420")
"""The same of a private key in PKCS #8 (section 7)."""
_RAW: Final = 32
_PEM: Final = re.compile(rb"-----BEGIN PRIVATE KEY-----(.*?)-----END PRIVATE KEY-----", re.DOTALL)


def signing_with(pem: bytes) -> Sign:
    """Signs with the private key of a PEM file.

    Raises:
        ValueError: it is neither Ed25519 nor P-256, or is locked.
    """
    if (raw := _raw_key(pem)) is not None:
        return ed25519.Ed25519PrivateKey.from_private_bytes(raw).sign
    from cryptography.hazmat.primitives import hashes, serialization  # noqa: PLC0415 - for other keys only
    from cryptography.hazmat.primitives.asymmetric import ec  # noqa: PLC0415 - as above

    try:
        key = serialization.load_pem_private_key(pem, None)
    except (TypeError, ValueError) as error:
        raise ValueError(f"the private key cannot be used: {error}") from error
    if isinstance(key, ed25519.Ed25519PrivateKey):
        return key.sign
    if isinstance(key, ec.EllipticCurvePrivateKey) and isinstance(key.curve, ec.SECP256R1):
        private, algorithm = key, ec.ECDSA(hashes.SHA256())
        return lambda data: private.sign(data, algorithm)
    raise ValueError("the private key is neither Ed25519 nor P-256")


def _raw_key(pem: bytes) -> bytes | None:
    """The 32 bytes of an Ed25519 key in its plain form; ``None``: the file holds something else."""
    found = _PEM.search(pem)
    try:
        der = b"" if found is None else binascii.a2b_base64(found[1])
    except binascii.Error:
        return None
    return der[len(_PRIVATE) :] if der.startswith(_PRIVATE) and len(der) == len(_PRIVATE) + _RAW else None


def checking_by(key: bytes) -> Check:
    """Checks signatures by a public key (SubjectPublicKeyInfo, DER).

    Raises:
        ValueError: it is neither Ed25519 nor P-256.
    """
    if key.startswith(_PUBLIC) and len(key) == len(_PUBLIC) + _RAW:
        return _checking(ed25519.Ed25519PublicKey.from_public_bytes(key[len(_PUBLIC) :]).verify)
    from cryptography.hazmat.primitives import hashes, serialization  # noqa: PLC0415 - for keys of hardware only
    from cryptography.hazmat.primitives.asymmetric import ec  # noqa: PLC0415 - as above

    public = serialization.load_der_public_key(key)
    if not isinstance(public, ec.EllipticCurvePublicKey) or not isinstance(public.curve, ec.SECP256R1):
        raise ValueError("the public key is neither Ed25519 nor P-256")  # noqa: TRY004 - a certificate's content
    curve, algorithm = public, ec.ECDSA(hashes.SHA256())
    return _checking(lambda signature, data: curve.verify(signature, data, algorithm))


def _checking(verify: Callable[[bytes, bytes], None]) -> Check:
    def check(signature: bytes, data: bytes) -> bool:
        try:
            verify(signature, data)
        except InvalidSignature:
            return False
        return True

    return check


class Trust:
    """The authorities of a fleet: which certificates are theirs."""

    def __init__(self, trusted: bytes) -> None:
        """``trusted``: their own certificates, PEM; all that are in it are trusted.

        Raises:
            ValueError: there is none, or one has another kind of key.
        """
        self._checks = tuple(checking_by(parts_of(der).key) for der in ders_of(trusted))

    def certified(self, der: bytes, now: datetime) -> Parts | None:
        """A certificate, taken apart, if an authority has signed it and it is valid; ``None``: neither may be so."""
        try:
            parts = parts_of(der)
        except ValueError:
            return None
        if not parts.begins <= now <= parts.ends:
            return None
        return parts if any(check(parts.signature, parts.signed) for check in self._checks) else None


def own_certificate(pem: bytes) -> bytes:
    """The first certificate of a PEM file, DER.

    Raises:
        ValueError: there is none.
    """
    return ders_of(pem)[0]
