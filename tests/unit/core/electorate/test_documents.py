"""Which documents a node asks for, and which it asks for no more."""

from __future__ import annotations

import math

from support.fleet_values import fleet_value_of
from support.fleets import fleet_of
from zsched.core.electorate.documents import FETCH_EVERY_S, MAX_WANTED, Documents
from zsched.core.values import instructions as do
from zsched.core.values.events import DocumentRefused
from zsched.core.values.problems import Problem
from zsched.core.values.struct import replace
from zsched.core.values.todo import ToDo

VALUE = fleet_value_of()


def asked(documents: Documents, *names: str) -> list[str]:
    todo = ToDo()
    for name in names:
        documents.want(replace(VALUE, document=name), ("edge1",), todo, 0.0)
    return [one.document for one in todo.send if isinstance(one, do.FetchDocument)]


def test_documents_that_are_not_valid_here_are_asked_for_once_each() -> None:
    """Two in turn: the second one's refusal must not make the first one new again."""
    documents = Documents("robot1", {})
    assert asked(documents, "a", "b") == ["a", "b"]
    documents.on_refused(DocumentRefused(document="a", reason="an unknown key"))
    documents.on_refused(DocumentRefused(document="b", reason="another one"))
    assert asked(documents, "a", "b", "a") == []
    assert list(documents.refused.values())[-1] == (Problem.DOCUMENT, "another one"), "the newest is shown"


def test_a_document_that_the_disk_has_refused_is_asked_for_again_until_it_is_stored() -> None:
    documents = Documents("robot1", {})
    assert asked(documents, "a") == ["a"]
    documents.on_refused(DocumentRefused(document="a", reason="the disk is full", is_of_disk=True))
    assert (documents.refused, documents.unwritten) == ({}, {"a": "the disk is full"})
    assert documents.next_deadline() == FETCH_EVERY_S
    todo = ToDo()
    documents.tick(todo, FETCH_EVERY_S)
    assert [one.document for one in todo.send if isinstance(one, do.FetchDocument)] == ["a"]
    documents.on_stored("a", fleet_of(of=("robot1",)), todo)
    assert (documents.unwritten, documents.next_deadline()) == ({}, math.inf)


def test_a_refused_document_that_no_peer_was_asked_for_is_no_agreed_one() -> None:
    """It is an agreed document that was written once more without the flags whose time is over."""
    documents = Documents("robot1", {})
    documents.on_refused(DocumentRefused(document="a", reason="the disk is full", is_of_disk=True))
    documents.on_refused(DocumentRefused(document="b", reason="an unknown key"))
    assert (documents.refused, documents.unwritten) == ({}, {})
    assert asked(documents, "a", "b") == ["a", "b"], "another node may agree it"


def test_documents_that_the_disk_refuses_do_not_fill_the_memory() -> None:
    documents = Documents("robot1", {})
    names = [f"d{number}" for number in range(MAX_WANTED + 2)]
    for name in names:
        asked(documents, name)
        documents.on_refused(DocumentRefused(document=name, reason="the disk is full", is_of_disk=True))
    assert list(documents.unwritten) == names[2:]


def test_refused_documents_do_not_fill_the_memory() -> None:
    documents = Documents("robot1", {})
    names = [f"d{number}" for number in range(MAX_WANTED + 2)]
    for name in names:
        asked(documents, name)
        documents.on_refused(DocumentRefused(document=name, reason="an unknown key"))
    assert list(documents.refused) == names[2:]


def test_of_more_wanted_documents_than_a_node_remembers_the_oldest_are_asked_for_no_more() -> None:
    documents = Documents("robot1", {})
    names = [f"d{number}" for number in range(MAX_WANTED + 2)]
    assert asked(documents, *names) == names
    documents.tick(todo := ToDo(), FETCH_EVERY_S)
    assert [one.document for one in todo.send if isinstance(one, do.FetchDocument)] == names[2:]
