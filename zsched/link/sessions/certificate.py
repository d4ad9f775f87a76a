"""Reads of an X.509 certificate (RFC 5280, section 4.1) when it is valid, its holder, its keys and its signature.

Knows: PEM, as much DER as leads to these. Does not know: whether a signature is right, what trusts what. Daemons read
certificates with this, for a library that reads all of one takes 16 MiB.
"""

from __future__ import annotations

import binascii
import re
from collections.abc import Callable
from datetime import UTC, datetime
from typing import Final, TypeVar

from zsched.core.values.struct import Struct

T = TypeVar("T")

PEM: Final = re.compile(rb"-----BEGIN CERTIFICATE-----(.*?)-----END CERTIFICATE-----", re.DOTALL)
PEM_COLUMNS: Final = 64
COMMON_NAME: Final = bytes((0x06, 0x03, 0x55, 0x04, 0x03))
"""The object identifier 2.5.4.3, as DER."""
SEQUENCE, VERSION, UTC_TIME, GENERALIZED_TIME = 0x30, 0xA0, 0x17, 0x18
BOOLEAN, BIT_STRING, OCTET_STRING, EXTENSIONS, KEY_ID = 0x01, 0x03, 0x04, 0xA3, 0x80
OWN_KEY, SIGNING_KEY = bytes((0x06, 0x03, 0x55, 0x1D, 0x0E)), bytes((0x06, 0x03, 0x55, 0x1D, 0x23))
"""2.5.29.14 and 2.5.29.35: the identifiers of a certificate's own key, and of the key that has signed it."""


class Parts(Struct, frozen=True, kw_only=True):
    """A certificate taken apart. What ``signed`` holds may be believed once the authority's signature over it is right.

    ``key`` is the SubjectPublicKeyInfo (DER).
    """

    signed: bytes
    signature: bytes
    common_name: str
    begins: datetime
    ends: datetime
    key: bytes


def parts_of(der: bytes) -> Parts:
    """A certificate (DER), taken apart.

    What the signature is not over must be as TLS takes it: no byte more, and the algorithm that is signed, too.

    Raises:
        ValueError: it is malformed.
    """
    try:
        begins, ends = _validity(der)
        return Parts(
            signed=_first(_inside(der, SEQUENCE)[0]),
            signature=_signature(der),
            common_name=_common_name(der),
            begins=begins,
            ends=ends,
            key=_first(_after(_after(_from_validity(der)))),
        )
    except IndexError as error:
        raise ValueError(f"the certificate is malformed: {error}") from error


def _signature(der: bytes) -> bytes:
    body, behind = _inside(der, SEQUENCE)
    algorithm = _first(_after(body))
    bits, rest = _inside(_after(_after(body)), BIT_STRING)
    if behind or rest or algorithm != _first(_algorithm_on(der)) or bits[0]:  # the last: bits that are not used
        raise IndexError("what its signature is not over is not as it was made")
    return bits[1:]


def ders_of(pem: bytes) -> tuple[bytes, ...]:
    """Every certificate of a PEM file as DER, in its order.

    Raises:
        ValueError: there is none, or one is no base64.
    """
    return _each(pem, bytes)


def pem_of(der: bytes) -> bytes:
    """A certificate as PEM (RFC 7468)."""
    text = binascii.b2a_base64(der, newline=False)
    lines = (text[at : at + PEM_COLUMNS] for at in range(0, len(text), PEM_COLUMNS))
    return b"\n".join((b"-----BEGIN CERTIFICATE-----", *lines, b"-----END CERTIFICATE-----", b""))


def validities(pem: bytes) -> tuple[tuple[datetime, datetime], ...]:
    """(from, until) of every certificate of a PEM file, in its order.

    Raises:
        ValueError: there is none, or one is malformed.
    """
    return _each(pem, _validity)


def common_names(pem: bytes) -> tuple[str, ...]:
    """The subject's common name in every certificate of a PEM file, in its order; empty where it has none.

    Raises:
        ValueError: there is no certificate, or one is malformed.
    """
    return _each(pem, _common_name)


def own_key_id(der: bytes) -> bytes:
    """The identifier of a certificate's own key (RFC 5280, section 4.2.1.2); empty where it has none.

    Raises:
        ValueError: it is malformed.
    """
    try:
        found = _extension(der, OWN_KEY)
        return _inside(found, OCTET_STRING)[0] if found else b""
    except IndexError as error:
        raise ValueError(f"the certificate is malformed: {error}") from error


def signing_key_id(der: bytes) -> bytes:
    """The same of the key that has signed it, as the certificate says (section 4.2.1.1).

    Raises:
        ValueError: it is malformed.
    """
    try:
        found = _extension(der, SIGNING_KEY)
        names = _inside(found, SEQUENCE)[0] if found else b""
        tag, content, _ = _element(names) if names else (KEY_ID, b"", b"")
    except IndexError as error:
        raise ValueError(f"the certificate is malformed: {error}") from error
    return content if tag == KEY_ID else b""


def _each(pem: bytes, read: Callable[[bytes], T]) -> tuple[T, ...]:
    found = PEM.findall(pem)
    if not found:
        raise ValueError("there is no certificate in it")
    try:
        return tuple(read(binascii.a2b_base64(body)) for body in found)
    except (IndexError, binascii.Error) as error:
        raise ValueError(f"a certificate in it is malformed: {error}") from error


def _algorithm_on(der: bytes) -> bytes:
    """Of Certificate: its first part, from the algorithm on, behind the version and the serial number."""
    body = _inside(_inside(der, SEQUENCE)[0], SEQUENCE)[0]
    return _after(_after(body) if body[0] == VERSION else body)


def _from_validity(der: bytes) -> bytes:
    """The same from the validity on, behind the issuer."""
    return _after(_after(_algorithm_on(der)))


def _validity(der: bytes) -> tuple[datetime, datetime]:
    times = _inside(_from_validity(der), SEQUENCE)[0]
    return _time(times), _time(_after(times))


def _common_name(der: bytes) -> str:
    """Of Name: a sequence of sets of (object identifier, value)."""
    left = _inside(_after(_from_validity(der)), SEQUENCE)[0]
    while left:
        _, members, left = _element(left)
        while members:
            pair, members = _inside(members, SEQUENCE)
            if pair.startswith(COMMON_NAME):
                return _element(pair[len(COMMON_NAME) :])[1].decode("utf-8", errors="replace")
    return ""


def _extension(der: bytes, wanted: bytes) -> bytes:
    """The value of an extension; empty where there is none. Between the key and them there may be two identifiers."""
    left = _after(_after(_after(_from_validity(der))))
    while left:
        tag, content, left = _element(left)
        extensions = _inside(content, SEQUENCE)[0] if tag == EXTENSIONS else b""
        while extensions:
            one, extensions = _inside(extensions, SEQUENCE)
            if one.startswith(wanted):
                value = one[len(wanted) :]
                return _inside(_after(value) if value[0] == BOOLEAN else value, OCTET_STRING)[0]
    return b""


def _element(data: bytes) -> tuple[int, bytes, bytes]:
    """(tag, content, what follows) of the first element."""
    tag, length, at = data[0], data[1], 2
    if length & 0x80:
        count = length & 0x7F
        length, at = int.from_bytes(data[2 : 2 + count], "big"), 2 + count
        if data[2] == 0 or length < 0x80:
            raise IndexError("a length in more bytes than it takes")  # DER has one way to write it
    if at + length > len(data):
        raise IndexError(f"an element of {length} bytes where {len(data) - at} are left")
    return tag, data[at : at + length], data[at + length :]


def _inside(data: bytes, wanted: int) -> tuple[bytes, bytes]:
    tag, content, rest = _element(data)
    if tag != wanted:
        raise IndexError(f"an element of kind {tag:#x} where {wanted:#x} belongs")
    return content, rest


def _first(data: bytes) -> bytes:
    return data[: len(data) - len(_after(data))]


def _after(data: bytes) -> bytes:
    return _element(data)[2]


def _time(data: bytes) -> datetime:
    tag, content, _ = _element(data)
    if tag not in (UTC_TIME, GENERALIZED_TIME):
        raise IndexError(f"an element of kind {tag:#x} where a time belongs")
    text = content.decode("ascii", errors="replace")
    if tag == UTC_TIME:  # two digits of the year: 50 and above are of the last century (RFC 5280, 4.1.2.5.1)
        text = ("19" if text[:2] >= "50" else "20") + text
    return datetime.strptime(text, "%Y%m%d%H%M%SZ").replace(tzinfo=UTC)
