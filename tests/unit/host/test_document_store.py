"""Documents on disk: named by their content, whole or not there."""

from __future__ import annotations

from pathlib import Path

import pytest

from zsched.core.values.codec import document_hash
from zsched.core.values.document import Document, Flag, FlagKind, Text
from zsched.core.values.errors import AdapterError
from zsched.host.document_store import DocumentStore

ONE = Document(
    text=Text("fleet: lab  # Größe\n" * 1000), flags=(Flag(kind=FlagKind.DRAIN, subject="robot1", for_s=60.0),)
)
OTHER = Document(text=Text("fleet: lab\n"))


def test_what_is_saved_is_read_again_under_its_hash(tmp_path: Path) -> None:
    store = DocumentStore(tmp_path)
    name = store.save(ONE)
    assert (name, len(name)) == (document_hash(ONE), 32)
    assert store.load(name) == ONE
    assert store.save(ONE) == name
    assert [file.name for file in store.folder.iterdir()] == [name]
    assert store.load(document_hash(OTHER)) is None
    assert store.load("") is None


@pytest.mark.parametrize("at", [0, 500, -1])
def test_a_damaged_document_is_not_there(tmp_path: Path, at: int) -> None:
    store = DocumentStore(tmp_path)
    file = store.folder / store.save(ONE)
    content = bytearray(file.read_bytes())
    content[at] ^= 1
    file.write_bytes(content)
    assert store.load(document_hash(ONE)) is None
    store.save(ONE)
    assert store.load(document_hash(ONE)) == ONE


def test_a_folder_that_cannot_be_written_is_an_error_that_names_it(tmp_path: Path) -> None:
    (tmp_path / "documents").write_text("in the way")
    with pytest.raises(AdapterError, match=r"cannot write the fleet's document into .*/documents"):
        DocumentStore(tmp_path).save(ONE)


def test_nothing_is_written_or_deleted_behind_a_link(tmp_path: Path) -> None:
    elsewhere, store = tmp_path / "elsewhere", DocumentStore(tmp_path / "own")
    elsewhere.mkdir()
    (elsewhere / "theirs").write_text("")
    store.folder.parent.mkdir()
    store.folder.symlink_to(elsewhere)
    with pytest.raises(AdapterError, match="it is a link, not a folder; move it away"):
        store.save(ONE)
    store.delete_others(())
    assert [file.name for file in elsewhere.iterdir()] == ["theirs"]
    store.folder.unlink()
    name = store.save(ONE)
    (store.folder / "new").symlink_to(elsewhere / "theirs")
    store.save(OTHER)
    assert (elsewhere / "theirs").read_text() == ""
    assert store.load(name) == ONE
