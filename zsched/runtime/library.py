"""The fleet's documents in a daemon: fetched from peers, checked, written to disk; a thread of its own.

Knows: where a document comes from, that it is valid here before it is stored. Does not know: which document is wanted
and why (`zsched.core.electorate.numbers`). To read a large fleet file takes longer than the decision loop may stand
still.
"""

from __future__ import annotations

import logging
import queue
from collections import deque
from collections.abc import Callable
from pathlib import Path

from zsched.config.document import TakenOutError, read_document
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.codec import decode_document, document_hash
from zsched.core.values.document import Document
from zsched.core.values.errors import AdapterError, ConfigError, WireError
from zsched.core.values.fleet import Fleet
from zsched.core.values.model import NodeId
from zsched.core.values.struct import replace
from zsched.host.document_store import DocumentStore
from zsched.host.guard import guarded

FETCH_S = 2.0
"""One peer may take this long to send a document."""
RECENT = 8
"""The last documents that are never deleted: the node may just be hearing of them."""
MAX_FAULT = 400

Fetch = Callable[[NodeId, str, float], bytes | None]
Order = do.StoreDocument | do.AmendDocument | do.FetchDocument | do.KeepDocuments
log = logging.getLogger("zsched.library")


class Library:
    """One node's documents. All methods but `close` may be called from the loop; none of them blocks."""

    def __init__(
        self, *, fleet: str, node: NodeId, config: Path, state_dir: Path, post: Callable[[ev.Event], None]
    ) -> None:
        """``config`` is the file this node was started with: paths in a document are relative to its folder."""
        self._fleet, self._node, self._config, self._post = fleet, node, config, post
        self.store = DocumentStore(state_dir)
        self.fetch: Fetch = lambda _peer, _document, _deadline_s: None
        self._orders: queue.SimpleQueue[Order | None] = queue.SimpleQueue()
        self._wanted: set[str] = set()
        """Hashes whose fetch waits or is under way: once is enough."""
        self._recent: deque[str] = deque(maxlen=RECENT)
        self._complaint = ("", "")
        """(document, why it was refused): the last one that was logged."""
        self._kept: tuple[str, ...] = ()
        """What the node's state names; at a start `keep` says it, before anything is stored."""
        self._thread = guarded(self._run, name="zsched-library")

    def keep(self, documents: tuple[str, ...]) -> None:
        """Say at the start which documents the node's state names; before `start`."""
        self._kept = documents

    def start(self) -> None:
        """Begin to take orders."""
        self._thread.start()

    def close(self) -> None:
        """Take no further order; what is under way ends with the process."""
        self._orders.put(None)

    def read(self, content: Document) -> Fleet:
        """What a document says on this node; any thread.

        Raises:
            ConfigError: it cannot be used here.
        """
        return read_document(content, self._fleet, self._node, self._config)

    def order(self, order: Order) -> None:
        """Enqueue; an event tells what became of it."""
        if isinstance(order, do.FetchDocument):
            if order.document in self._wanted:
                return
            self._wanted.add(order.document)
        self._orders.put(order)

    def _run(self) -> None:
        while (order := self._orders.get()) is not None:
            if isinstance(order, do.StoreDocument):
                self._accept(order.content, order.request)
            elif isinstance(order, do.FetchDocument):
                try:
                    self._bring(order)
                finally:  # else nobody would fetch it any more, whatever has failed
                    self._wanted.discard(order.document)
            elif isinstance(order, do.AmendDocument):
                self._amend(order)
            else:
                self._kept = order.documents
                self._tidy()

    def _amend(self, order: do.AmendDocument) -> None:
        """Write a stored document once more, with other flags."""
        content = self.store.load(order.document)
        if content is not None:
            self._accept(replace(content, flags=order.flags), None)

    def _tidy(self) -> None:
        """Delete what nobody needs; a peer can only make this node store a few documents more."""
        self.store.delete_others({*self._kept, *self._recent})

    def _bring(self, order: do.FetchDocument) -> None:
        """Fetch a document from the first peer that has it."""
        content = self.store.load(order.document)
        for peer in order.peers:
            if content is not None:
                break
            frame = self.fetch(peer, order.document, FETCH_S)
            if frame is None:
                continue
            try:
                content = decode_document(frame, order.document)
            except WireError as error:
                self._post(ev.FrameDropped(kind="document", reason=error.reason))
        if content is not None:
            self._accept(content, None)

    def _accept(self, content: Document, request: int | None) -> None:
        """Check a document, write it and say so."""
        name = ""
        try:
            name = document_hash(content)
            fleet = self.read(content)
            self.store.save(content)
        except (ConfigError, AdapterError, WireError) as error:
            reason = str(error)
            if (name, reason) != self._complaint:  # a full disk refuses it every three seconds
                log.warning("document refused document=%s why=%s", name, reason)
            self._complaint = (name, reason)
            is_of_disk, is_out = isinstance(error, AdapterError), isinstance(error, TakenOutError)
            refused = ev.DocumentRefused(document=name, reason=reason[:MAX_FAULT], request=request)
            self._post(replace(refused, is_of_disk=is_of_disk, is_taken_out=is_out))
            return
        self._complaint = ("", "")
        if name in self._recent:  # one that comes again takes no other's place
            self._recent.remove(name)
        self._recent.append(name)
        self._tidy()
        self._post(ev.DocumentStored(document=name, fleet=fleet, flags=content.flags, request=request))
