"""An invitation is whole, or it is refused with a word that says why."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from support.fleet_values import fleet_value_of
from zsched.core.values.codec import document_hash
from zsched.core.values.document import Document, Flag, FlagKind, Text
from zsched.core.values.electorate import Creation
from zsched.core.values.errors import WireError
from zsched.link.invitation import Invitation, Papers, decode_invitation, encode_invitation

DOCUMENT = Document(text=Text("fleet: hall  # ä\n"), flags=(Flag(kind=FlagKind.DRAIN, subject="edge1", for_s=1.5),))
VALUE = fleet_value_of(
    7,
    number=3,
    creations=4,
    tasks=(Creation(task="merge", number=4, exclusive=True),),
    document=document_hash(DOCUMENT),
)
INVITATION = Invitation(
    node="robot4",
    value=VALUE,
    document=DOCUMENT,
    addresses=("tcp/192.0.2.11:7457",),
    papers=Papers(certificate="c", key="k", trusted="t"),
)


def changed(**fields: object) -> bytes:
    """The file with other fields, and with the digest of those."""
    from zsched.link import invitation

    body = {**json.loads(encode_invitation(INVITATION)), **fields}
    del body["digest"]
    body = {name: held for name, held in body.items() if held is not None}
    return json.dumps({**body, "digest": invitation._digest(body)}).encode()


@pytest.mark.parametrize("papers", [INVITATION.papers, None])
def test_an_invitation_comes_back_as_it_was_written(papers: Papers | None) -> None:
    given = replace(INVITATION, papers=papers)
    assert decode_invitation(encode_invitation(given).encode()) == given
    assert ("key" in json.loads(encode_invitation(given))) is (papers is not None)


def test_a_file_that_was_changed_or_cut_off_is_refused() -> None:
    text = encode_invitation(INVITATION)
    for spoilt in (text.replace("robot4", "robot5"), text.replace('"k"', '"K"'), text[:-3], "", "[]", "{}", '"x"'):
        with pytest.raises(WireError):
            decode_invitation(spoilt.encode())
    with pytest.raises(WireError, match="changed or cut off"):
        decode_invitation(text.replace("192.0.2.11", "192.0.2.12").encode())


@pytest.mark.parametrize(
    ("fields", "why"),
    [
        ({"schema": "zsched.invite/2"}, "reads zsched.invite/1"),
        ({"schema": None}, "no invitation"),
        ({"node": "Robot 4"}, "names no node"),
        ({"addresses": "tcp/x"}, "no list"),
        ({"trusted": None}, "lacks one of certificate, trusted"),
        ({"key": "k" * 70_000}, "one of certificate, key, trusted is no certificate or key"),
        ({"key": 7}, "is no certificate or key"),
        ({"certificate": "\ud800"}, "is no certificate or key"),
        ({"document": {"text": "fleet: other\n"}}, "not the one of its fleet value"),
        ({"value": {"fleet": "hall"}}, "missing"),
        ({"value": 7}, "type"),
    ],
)
def test_parts_that_do_not_fit_are_refused(fields: dict[str, object], why: str) -> None:
    with pytest.raises(WireError, match=why):
        decode_invitation(changed(**fields))


def test_a_generation_that_was_counted_is_told_and_an_older_file_has_none() -> None:
    given = replace(INVITATION, generation=3)
    assert decode_invitation(encode_invitation(given).encode()) == given
    assert "generation" not in json.loads(encode_invitation(INVITATION))
