"""The file that brings a machine into a fleet: all that its node must know before it has heard anybody.

Knows: the fields of an invitation, that it is whole, that its parts fit each other. Does not know: its writer
(`zsched.commands.members.membership`), what becomes of it on the new machine (`zsched.commands.members.belongings`).

It is JSON, so that an operator can read it. A node that is new must be told the generation that it joins: of two fleets
of one name it could not know which is meant.
"""

from __future__ import annotations

import hashlib
import json
from typing import Any, Final

from zsched.core.values.codec import as_plain, document_hash, from_plain
from zsched.core.values.document import Document
from zsched.core.values.electorate import FleetValue
from zsched.core.values.errors import WireError
from zsched.core.values.model import NodeId
from zsched.core.values.struct import Struct
from zsched.core.values.words import NAME
from zsched.core.vote.belief import MAX_GENERATION

SCHEMA: Final = "zsched.invite/1"
MAX_BYTES: Final = 1 << 20
MAX_PEM: Final = 64 * 1024
PEMS: Final = ("certificate", "key", "trusted")
"""The key is missing where it was made on the machine that joins."""


class Papers(Struct, frozen=True, kw_only=True):
    """What a node of a secured fleet shows to the others, as PEM."""

    certificate: str
    trusted: str
    key: str = ""
    """Empty: the machine that joins has made it."""


class Invitation(Struct, frozen=True, kw_only=True):
    """One machine may join one fleet."""

    node: NodeId
    """The name that the machine has in the document."""
    value: FleetValue
    """What the fleet register held when the invitation was written; the node learns newer ones from its peers."""
    document: Document
    """The document of that value."""
    addresses: tuple[str, ...] = ()
    """Where nodes of the fleet can be dialled."""
    generation: int = 0
    """As operators have counted it with the fleet's files: nodes of another one count for each other as apart."""
    papers: Papers | None = None
    """``None``: the fleet is not secured, or its certificate comes by another way."""

    @property
    def fleet(self) -> str:
        """The fleet's name."""
        return self.value.fleet


def encode_invitation(invitation: Invitation) -> str:
    """The file's text."""
    body: dict[str, Any] = {
        "schema": SCHEMA,
        "fleet": invitation.fleet,
        "node": invitation.node,
        "generation_id": invitation.value.generation_id,
        "addresses": list(invitation.addresses),
        "value": as_plain(invitation.value),
        "document": as_plain(invitation.document),
    }
    if invitation.generation:
        body["generation"] = invitation.generation
    if invitation.papers is not None:
        body |= {name: pem for name in PEMS if (pem := getattr(invitation.papers, name))}
    return json.dumps({**body, "digest": _digest(body)}, ensure_ascii=False, indent=2) + "\n"


def decode_invitation(data: bytes) -> Invitation:
    """The invitation in a file.

    Raises:
        WireError: it is none, it was changed or cut off, or its parts do not fit each other.
    """
    if len(data) > MAX_BYTES:
        raise WireError("size", f"{len(data)} bytes, at most {MAX_BYTES}")
    if not data.strip():
        raise WireError("size", "it is empty: the command that was to write it was refused")
    try:
        body = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise WireError("garbage", "it is no whole JSON object") from error
    if not isinstance(body, dict) or "schema" not in body:
        raise WireError("garbage", "it is no invitation")
    if body["schema"] != SCHEMA:
        raise WireError("version", f"it is {str(body['schema'])[:40]!r}, this version of zsched reads {SCHEMA}")
    if body.pop("digest", None) != _digest(body):
        raise WireError("checksum", "it was changed or cut off on its way")
    value = from_plain(body.get("value"), FleetValue)
    document = from_plain(body.get("document"), Document)
    if document_hash(document) != value.document:
        raise WireError("checksum", "its document is not the one of its fleet value")
    node, addresses = body.get("node"), body.get("addresses")
    if not isinstance(node, str) or NAME.fullmatch(node) is None:
        raise WireError("type", "it names no node")
    if not isinstance(addresses, list) or not all(isinstance(one, str) for one in addresses):
        raise WireError("type", "its addresses are no list")
    generation = body.get("generation", 0)
    if type(generation) is not int or not 0 <= generation <= MAX_GENERATION:
        raise WireError("type", f"its generation is no number from 0 to {MAX_GENERATION}")
    return Invitation(
        node=node,
        value=value,
        document=document,
        addresses=tuple(addresses),
        generation=generation,
        papers=_papers(body),
    )


def _papers(body: dict[str, Any]) -> Papers | None:
    given = {name: body[name] for name in PEMS if name in body}
    if not given:
        return None
    if not {"certificate", "trusted"} <= given.keys():
        raise WireError("type", "it lacks one of certificate, trusted")
    if not all(isinstance(one, str) and one.isascii() and len(one) <= MAX_PEM for one in given.values()):
        raise WireError("type", f"one of {', '.join(PEMS)} is no certificate or key")
    return Papers(**given)


def _digest(body: dict[str, Any]) -> str:
    """Of all that stands beside it: a file that was edited or cut off is seen to differ from a whole one."""
    plain = json.dumps(body, ensure_ascii=True, sort_keys=True, separators=(",", ":"))
    return hashlib.blake2s(plain.encode(), digest_size=16, person=b"zsched1", salt=b"invite").hexdigest()
