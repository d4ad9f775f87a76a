"""The seal of a frame: its signer, for which key of the network, in which order, in answer to what.

Knows: the bytes of a seal and the bytes that its signature is over. Does not know: keys, certificates, who may say what
(`zsched.link.bus.seals`).

A seal travels as the attachment of a frame, so a node of an older version reads the frame as ever. A signature covers
the kind of message, the key expression (it names the fleet, the kind, the owner and the asker), the seal's numbers, the
attachment of the question that is answered, and the frame.
"""

from __future__ import annotations

import hashlib
import struct
from enum import StrEnum
from typing import Final

from zsched.core.values.errors import WireError
from zsched.core.values.struct import Struct

VERSION: Final = 1
DOMAIN: Final = b"zsched-seal-1"
MAX_SEAL: Final = 2048
"""Bytes: a certificate of ours has 550 to 700, and a signature at most 72."""
MAX_SIGNATURE: Final = 80
_HEAD: Final = struct.Struct(">BQQBH")


class Act(StrEnum):
    """The kind of message that is sealed: a signature for one is none for another."""

    PUT = "put"
    QUESTION = "question"
    ANSWER = "answer"


class Seal(Struct, frozen=True, kw_only=True):
    """One frame's seal."""

    life: int
    """Of a put and an answer the sender's incarnation; of a command the receiver's, of another question 0."""
    sequence: int
    """Rises with every seal of one signer: nanoseconds of its wall clock, or one more than the seal before."""
    signature: bytes
    certificate: bytes
    """The signer's, DER."""


def pack(seal: Seal) -> bytes:
    """The bytes of a seal.

    Raises:
        WireError: it would be larger than `MAX_SEAL` (reason "size").
    """
    head = _HEAD.pack(VERSION, seal.life, seal.sequence, len(seal.signature), len(seal.certificate))
    packed = head + seal.signature + seal.certificate
    if len(packed) > MAX_SEAL:
        raise WireError("size", f"a seal of {len(packed)} bytes, at most {MAX_SEAL}")
    return packed


def unpack(data: bytes) -> Seal:
    """The seal again.

    Raises:
        WireError: it is none ("seal").
    """
    if not _HEAD.size < len(data) <= MAX_SEAL:
        raise WireError("seal", f"{len(data)} bytes")
    version, life, sequence, signature, certificate = _HEAD.unpack_from(data)
    if version != VERSION:
        raise WireError("seal", f"version {version}, this is {VERSION}")
    at = _HEAD.size
    if signature > MAX_SIGNATURE or at + signature + certificate != len(data):
        raise WireError("seal", "its lengths do not fit")
    return Seal(
        life=life,
        sequence=sequence,
        signature=data[at : at + signature],
        certificate=data[at + signature :],
    )


def signed_bytes(act: Act, key: str, frame: bytes, *, life: int, sequence: int, question: bytes = b"") -> bytes:
    """What a signature is over: 32 bytes for each part, so that no two messages have the same.

    ``question``: the attachment of the question that is answered.
    """
    numbers = struct.pack(">QQ", life, sequence)
    parts = (DOMAIN, act.value.encode(), key.encode(), numbers, question, frame)
    return b"".join(hashlib.blake2s(part).digest() for part in parts)
