"""Writes keys, certificates and records so that each is whole, or as it was before.

Knows: modes, owners, rename. Does not know: what is in the files.

A file belongs to the owner of its folder: root, who writes into somebody's folder, leaves no file there that its owner
cannot read.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

from zsched.host.files import put_whole

PUBLIC: Final = 0o644
PRIVATE: Final = 0o600
"""Of keys."""
PRIVATE_FOLDER: Final = 0o700


def make_folder(path: Path) -> None:
    """A folder that only its owner may look into; one that is there stays as it is.

    Raises:
        OSError: it cannot be made.
    """
    missing = [one for one in (path, *path.parents) if not one.exists()]
    path.mkdir(mode=PRIVATE_FOLDER, parents=True, exist_ok=True)
    for one in reversed(missing):
        if os.geteuid() == 0:
            owner = one.parent.stat()
            os.chown(one, owner.st_uid, owner.st_gid, follow_symlinks=False)


def write_whole(path: Path, content: bytes, mode: int, *, is_for_folder: bool = True) -> None:
    """Replace a file by one with ``content`` and ``mode``; nobody ever sees a part of it, or the key with another mode.

    ``is_for_folder``: what root writes is handed over to the folder's owner.

    Raises:
        OSError: it cannot be written; the file is as it was.
    """
    put_whole(path, content, mode, lambda descriptor: _give(descriptor, path.parent) if is_for_folder else None)
    _sync(path.parent)


def open_lock(path: Path) -> int:
    """A descriptor of a file that is only locked; one that is not there is made, for the folder's owner.

    Raises:
        OSError: it cannot be opened or made, or it is a link.
    """
    flags = os.O_RDWR | os.O_CLOEXEC | os.O_NOFOLLOW
    try:
        descriptor = os.open(path, flags | os.O_CREAT | os.O_EXCL, PRIVATE)
    except FileExistsError:
        return os.open(path, flags)
    _give(descriptor, path.parent)
    return descriptor


def _give(descriptor: int, folder: Path) -> None:
    """Hand an open file over to its folder's owner (root only): its name there may lead elsewhere by now."""
    if os.geteuid() == 0:
        owner = folder.stat()
        os.fchown(descriptor, owner.st_uid, owner.st_gid)


def _sync(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
