"""The fleet's documents on this node's disk: one file each in the state folder, named by the document's hash.

Knows: files, how one is written so that it survives a power cut. Does not know: which documents matter
(`zsched.core.electorate.numbers`), what a text means.
"""

from __future__ import annotations

import contextlib
import errno
from collections.abc import Collection
from pathlib import Path

from zsched.core.values.codec import LARGE, decode_document, document_hash, encode
from zsched.core.values.document import Document
from zsched.core.values.electorate import check_id
from zsched.core.values.errors import AdapterError, WireError
from zsched.host.files import read_regular
from zsched.host.state_file import hand_over_folder, replace_synced

FOLDER_NAME = "documents"
NEW_NAME = "new"
COPY_NAME = "copied"
"""In the state folder: the hash of the fleet file that was written as a copy of the document."""


def copied_file(state: Path) -> str:
    """The hash of the fleet file that was written here as a copy of the document; empty: none was.

    Such a file says nothing of its own, so it is not compared with later documents until somebody changes it.
    """
    try:
        return read_regular(state / COPY_NAME, 64).decode("ascii", "replace").strip()
    except OSError:
        return ""


class DocumentStore:
    """The documents in ``folder``/documents. Reading is allowed from any thread, writing from one."""

    def __init__(self, folder: Path) -> None:
        """Name the place; touches nothing."""
        self.folder = folder / FOLDER_NAME

    def save(self, content: Document) -> str:
        """Write a document, unless it is there already; its hash. When this returns it survives a power cut.

        Raises:
            AdapterError: the disk is full, read-only or gone.
            WireError: the document is too large for a frame.
        """
        name = document_hash(content)
        if self.load(name) is not None:
            return name
        try:
            self.folder.mkdir(mode=0o700, exist_ok=True)
            self._check_own()
            hand_over_folder(self.folder)
            replace_synced(self.folder / name, self.folder / NEW_NAME, encode(content))
        except OSError as error:
            is_misplaced = error.errno in (errno.ELOOP, errno.EEXIST, errno.ENOTDIR)
            advice = "move it away" if is_misplaced else "free or remount the disk"
            raise AdapterError(
                f"cannot write the fleet's document into {self.folder}: {error.strerror}; {advice}"
            ) from error
        return name

    def _check_own(self) -> None:
        """Refuse a folder behind a link: root writes here too, and the folder above is the service's."""
        if self.folder.is_symlink():
            raise OSError(errno.ELOOP, "it is a link, not a folder", str(self.folder))

    def load(self, name: str) -> Document | None:
        """The document with this hash; ``None``: it is not stored, or its file is damaged."""
        check_id("document", name)
        if not name:
            return None
        try:
            return decode_document(read_regular(self.folder / name, LARGE), name)
        except (OSError, WireError):
            return None

    def delete_others(self, keep: Collection[str]) -> None:
        """Delete every document whose hash is not in ``keep``; a file that cannot be deleted stays.

        Nothing is deleted behind a link.
        """
        if self.folder.is_symlink():
            return
        with contextlib.suppress(OSError):
            for file in sorted(self.folder.iterdir()):
                if file.name not in keep:
                    file.unlink()
