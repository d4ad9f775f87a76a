"""The library: a document is fetched, checked and stored before the node hears of it."""

from __future__ import annotations

import queue
from collections.abc import Iterator
from pathlib import Path

import pytest

from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.codec import document_hash, encode
from zsched.core.values.document import Document, Flag, FlagKind, Text
from zsched.core.values.errors import ConfigError
from zsched.core.values.model import NodeId
from zsched.host.document_store import DocumentStore
from zsched.runtime.library import RECENT, Library

FILE = """
fleet: lab
nodes:
  robot1: {kind: robot, host: 192.0.2.1, listen: {control: tcp/0.0.0.0:7457, data: tcp/0.0.0.0:7458}, wired: true}
  edge1: {kind: edge, host: 192.0.2.2, listen: {control: tcp/0.0.0.0:7457, data: tcp/0.0.0.0:7458}, wired: true}
zenoh: {config: keys/zenoh.json5}
tasks:
  echo:
    candidates: [edge1]
    weights: {cpu: 0.5, memory: 0.5, network: 0.0}
    worker: {command: [python, -m, zsched.tasks.echo]}
"""


def document(more: str = "", text: str = FILE) -> Document:
    return Document(text=Text(text + more))


class Desk:
    """A library, what it has posted, and peers that have documents."""

    def __init__(self, folder: Path) -> None:
        self.events: queue.SimpleQueue[ev.Event] = queue.SimpleQueue()
        self.held: dict[NodeId, bytes] = {}
        self.asked: list[NodeId] = []
        self.library = Library(
            fleet="lab", node="edge1", config=folder / "config" / "fleet.yaml", state_dir=folder, post=self.events.put
        )
        self.library.fetch = self._fetch
        self.library.start()
        self.store = DocumentStore(folder)

    def _fetch(self, peer: NodeId, _document: str, _deadline_s: float) -> bytes | None:
        self.asked.append(peer)
        return self.held.get(peer)

    def next(self) -> ev.Event:
        return self.events.get(timeout=30)


@pytest.fixture
def desk(tmp_path: Path) -> Iterator[Desk]:
    made = Desk(tmp_path)
    yield made
    made.library.close()


def test_an_operator_s_document_is_on_disk_before_the_node_hears_of_it(desk: Desk, tmp_path: Path) -> None:
    desk.library.order(do.StoreDocument(request=7, content=document()))
    event = desk.next()
    assert isinstance(event, ev.DocumentStored)
    assert (event.document, event.request) == (document_hash(document()), 7)
    assert desk.store.load(event.document) == document()
    assert event.fleet.zenoh_config == str(tmp_path / "config" / "keys" / "zenoh.json5")


def test_a_document_comes_from_the_first_peer_that_has_it(desk: Desk) -> None:
    wanted = document_hash(document())
    desk.held = {"robot2": encode(document("# another\n")), "robot3": encode(document()), "robot4": b""}
    desk.library.order(do.FetchDocument(document=wanted, peers=("robot1", "robot2", "robot3", "robot4")))
    assert desk.next() == ev.FrameDropped(kind="document", reason="checksum")
    event = desk.next()
    assert isinstance(event, ev.DocumentStored)
    assert (event.document, event.request) == (wanted, None)
    assert desk.asked == ["robot1", "robot2", "robot3"]


def test_what_nobody_has_is_asked_for_again(desk: Desk) -> None:
    wanted = document_hash(document())
    desk.library.order(do.FetchDocument(document=wanted, peers=("robot1",)))
    desk.library.order(do.StoreDocument(request=1, content=document("# another\n")))
    desk.next()  # the fetch before it has ended
    desk.held = {"robot1": encode(document())}
    desk.library.order(do.FetchDocument(document=wanted, peers=("robot1",)))
    event = desk.next()
    assert isinstance(event, ev.DocumentStored)
    assert event.document == wanted


def test_a_document_whose_fetch_has_failed_is_fetched_again(desk: Desk) -> None:
    """By a bug, or for want of memory: the thread goes on, and so must the document come."""
    failures = iter([MemoryError()])

    def fetch(_peer: NodeId, _document: str, _deadline_s: float) -> bytes | None:
        for failure in failures:
            raise failure
        return encode(document())

    desk.library.fetch = fetch
    order = do.FetchDocument(document=document_hash(document()), peers=("robot1",))
    desk.library.order(order)
    desk.library.order(do.StoreDocument(request=1, content=document("# another\n")))
    desk.next()  # the fetch before it has ended
    desk.library.order(order)
    event = desk.next()
    assert isinstance(event, ev.DocumentStored)
    assert event.document == order.document


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (FILE.replace("candidates", "candidate"), "candidate"),
        (FILE.replace("fleet: lab", "fleet: hall"), "of the fleet 'hall', this node of 'lab'"),
        (FILE.replace("edge1", "edge2"), "names no node 'edge1'"),
    ],
)
def test_a_document_that_is_not_valid_here_is_refused_and_not_stored(desk: Desk, text: str, why: str) -> None:
    desk.library.order(do.StoreDocument(request=3, content=document(text=text)))
    event = desk.next()
    assert isinstance(event, ev.DocumentRefused)
    assert (event.request, event.is_of_disk, event.is_taken_out) == (3, False, "names no node" in why)
    assert why in event.reason
    assert desk.store.load(event.document) is None


SECURED = FILE.replace("tcp/", "tls/") + "security: {}\n"


def test_where_the_fleet_file_secures_the_node_a_document_must_do_so_too(desk: Desk, tmp_path: Path) -> None:
    """It would be started by in place of the file, in plain text."""
    file = tmp_path / "config" / "fleet.yaml"
    file.parent.mkdir()
    file.write_text(SECURED)
    plain = document(text=SECURED.replace("security: {}", ""))
    with pytest.raises(ConfigError, match="no section `security:`"):
        desk.library.read(plain)  # by which a daemon starts
    desk.library.order(do.StoreDocument(request=3, content=plain))
    event = desk.next()
    assert isinstance(event, ev.DocumentRefused)
    assert "first delete it from the fleet file of every machine" in event.reason
    assert desk.store.load(event.document) is None
    desk.library.order(do.StoreDocument(request=4, content=document(text=f"{SECURED}# another\n")))
    assert isinstance(desk.next(), ev.DocumentStored)
    file.write_text(FILE)  # its operator ends it
    desk.library.order(do.StoreDocument(request=5, content=document()))
    assert isinstance(desk.next(), ev.DocumentStored)


@pytest.mark.parametrize("text", [FILE, "fleet: [", SECURED.replace("fleet: lab", "fleet: hall")])
def test_a_fleet_file_that_does_not_secure_this_fleet_keeps_no_document_out(
    desk: Desk, tmp_path: Path, text: str
) -> None:
    file = tmp_path / "config" / "fleet.yaml"
    file.parent.mkdir()
    file.write_text(text)
    desk.library.order(do.StoreDocument(request=3, content=document()))
    assert isinstance(desk.next(), ev.DocumentStored)


def test_a_full_disk_refuses_a_document_and_is_logged_once(
    desk: Desk, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """It is asked for again every three seconds."""
    (tmp_path / "documents").write_text("in the way")
    for number in range(3):
        desk.library.order(do.StoreDocument(request=number, content=document()))
        event = desk.next()
        assert isinstance(event, ev.DocumentRefused)
        assert event.is_of_disk
        assert "cannot write" in event.reason
    assert caplog.text.count("document refused") == 1
    (tmp_path / "documents").unlink()
    desk.library.order(do.StoreDocument(request=4, content=document()))
    assert isinstance(desk.next(), ev.DocumentStored)
    desk.library.order(do.StoreDocument(request=5, content=document(text="fleet: [")))
    assert isinstance(desk.next(), ev.DocumentRefused)
    assert caplog.text.count("document refused") == 2


def test_what_the_state_names_is_kept_and_peers_fill_no_disk(desk: Desk) -> None:
    desk.library.order(do.StoreDocument(request=0, content=document()))
    first = desk.next()
    assert isinstance(first, ev.DocumentStored)
    desk.library.order(do.KeepDocuments(documents=(first.document,)))
    for number in range(2 * RECENT):
        desk.library.order(do.StoreDocument(request=number, content=document(f"# {number}\n")))
        desk.next()
    assert desk.store.load(first.document) == document()
    assert len(list(desk.store.folder.iterdir())) == RECENT + 1


def test_a_stored_document_is_written_once_more_with_other_flags(desk: Desk) -> None:
    desk.library.order(do.StoreDocument(request=7, content=document()))
    desk.next()
    flags = (Flag(kind=FlagKind.DRAIN, subject="edge1"),)
    desk.library.order(do.AmendDocument(document="0a" * 16, flags=flags))  # nobody has it: nothing comes back
    desk.library.order(do.AmendDocument(document=document_hash(document()), flags=flags))
    event = desk.next()
    assert isinstance(event, ev.DocumentStored)
    assert (event.flags, event.request) == (flags, None)
    amended = Document(text=document().text, flags=flags)
    assert (event.document, desk.store.load(event.document)) == (document_hash(amended), amended)
