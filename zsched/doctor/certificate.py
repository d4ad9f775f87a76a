"""Reads when an X.509 certificate begins and ends to be valid (RFC 5280, section 4.1), and nothing else of it.

Knows: PEM, as much DER as leads to the two times. Does not know: names, keys, signatures, what trusts what.
"""

from __future__ import annotations

import binascii
import re
from datetime import UTC, datetime
from typing import Final

PEM: Final = re.compile(rb"-----BEGIN CERTIFICATE-----(.*?)-----END CERTIFICATE-----", re.DOTALL)
SEQUENCE, VERSION, UTC_TIME, GENERALIZED_TIME = 0x30, 0xA0, 0x17, 0x18


def validities(pem: bytes) -> tuple[tuple[datetime, datetime], ...]:
    """(from, until) of every certificate of a PEM file, in its order.

    Raises:
        ValueError: there is none, or one is malformed.
    """
    found = PEM.findall(pem)
    if not found:
        raise ValueError("there is no certificate in it")
    try:
        return tuple(_validity(binascii.a2b_base64(body)) for body in found)
    except (IndexError, binascii.Error) as error:
        raise ValueError(f"a certificate in it is malformed: {error}") from error


def _validity(der: bytes) -> tuple[datetime, datetime]:
    """Of Certificate: its first part, and of that the serial number, the algorithm and the issuer are passed over."""
    body = _inside(_inside(der, SEQUENCE)[0], SEQUENCE)[0]
    if body[0] == VERSION:
        body = _after(body)
    for _ in range(3):
        body = _after(body)
    times = _inside(body, SEQUENCE)[0]
    return _time(times), _time(_after(times))


def _element(data: bytes) -> tuple[int, bytes, bytes]:
    """(tag, content, what follows) of the first element."""
    tag, length, at = data[0], data[1], 2
    if length & 0x80:
        count = length & 0x7F
        length, at = int.from_bytes(data[2 : 2 + count], "big"), 2 + count
    if at + length > len(data):
        raise IndexError(f"an element of {length} bytes where {len(data) - at} are left")
    return tag, data[at : at + length], data[at + length :]


def _inside(data: bytes, wanted: int) -> tuple[bytes, bytes]:
    tag, content, rest = _element(data)
    if tag != wanted:
        raise IndexError(f"an element of kind {tag:#x} where {wanted:#x} belongs")
    return content, rest


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
