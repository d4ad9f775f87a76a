"""Reads files that an operator names, and never more of them than they may hold; writes those that others will read.

Knows: what kinds of files there are, sizes, gzip. Does not know: what is in them.

A pipe would be waited for, a device never ends, and a small packed file may unpack to all the memory there is: each is
an `OSError` with a sentence, like a file that is not there.
"""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import stat
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Final

_KINDS: Final = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISSOCK, "a socket"),
)
_GZIP: Final = 31
"""zlib's number for a gzip header."""


def read_regular(path: Path, most_bytes: int, *, is_own: bool = False) -> bytes:
    """What a regular file holds.

    ``is_own``: it has no other name and is no link. In a folder of somebody else that could lead root to any file.

    Raises:
        OSError: it cannot be read, is no regular file, or holds more than ``most_bytes``; ``strerror`` says which.
    """
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | (os.O_NOFOLLOW if is_own else 0))
    found = os.fstat(descriptor)
    mode = found.st_mode
    if is_own and found.st_nlink > 1:
        os.close(descriptor)
        raise OSError(errno.EMLINK, os.strerror(errno.EMLINK), str(path))
    if not stat.S_ISREG(mode):
        os.close(descriptor)
        raise OSError(errno.EINVAL, f"it is {_kind(mode)}, not a regular file", str(path))
    with os.fdopen(descriptor, "rb") as file:
        data = file.read(most_bytes + 1)
    if len(data) > most_bytes:
        raise OSError(errno.EFBIG, f"it holds more than {_shown(most_bytes)}", str(path))
    return data


def write_regular(path: Path, content: bytes) -> None:
    """Replace what a regular file holds; nothing stays of one that could not be written whole.

    Raises:
        OSError: it cannot be written, or there is something that is no regular file; ``strerror`` says which.
    """
    flags = os.O_WRONLY | os.O_CREAT | os.O_NONBLOCK | os.O_CLOEXEC
    try:
        descriptor = os.open(path, flags, 0o666)
    except OSError as error:
        if error.errno == errno.ENXIO:  # nobody reads the pipe
            raise OSError(errno.EINVAL, "it is a pipe, not a regular file", str(path)) from error
        raise
    with os.fdopen(descriptor, "wb", buffering=0) as file:
        mode = os.fstat(descriptor).st_mode
        if not stat.S_ISREG(mode):
            raise OSError(errno.EINVAL, f"it is {_kind(mode)}, not a regular file", str(path))
        try:
            file.truncate(0)
            written = 0
            while written < len(content):
                written += file.write(content[written:])
        except OSError:
            with contextlib.suppress(OSError):  # a folder that cannot be written must not hide the cause
                path.unlink(missing_ok=True)
            raise


def replace_regular(path: Path, content: bytes) -> None:
    """As `write_regular`, but what a file held before stays where it cannot be written whole, or the power goes.

    The new one has its mode and owner. Where only the file may be written, and not its folder, it is as
    `write_regular`.

    Raises:
        OSError: as `write_regular`.
    """
    try:
        whole = path.resolve(strict=True)  # a link stays one
        found = whole.stat()
    except OSError:
        return write_regular(path, content)
    is_ours = os.geteuid() in (0, found.st_uid) and os.access(whole, os.W_OK) and os.access(whole.parent, os.W_OK)
    if not stat.S_ISREG(found.st_mode) or not is_ours:
        return write_regular(path, content)

    return put_whole(whole, content, stat.S_IMODE(found.st_mode), owner_like(found))


def owner_like(found: os.stat_result) -> Callable[[int], None]:
    """For `put_whole`: hands an open file over to the owner of the one that it replaces, where this user may."""

    def give(descriptor: int) -> None:
        if (found.st_uid, found.st_gid) != (os.geteuid(), os.getegid()):
            with contextlib.suppress(PermissionError):  # of a group that this user is not in
                os.fchown(descriptor, found.st_uid, found.st_gid)

    return give


def put_whole(path: Path, content: bytes, mode: int, give: Callable[[int], None]) -> None:
    """Put a file with ``content`` and ``mode`` in place; nobody ever sees a part of it, or it with another mode.

    ``give`` hands the open file over to its owner, by its descriptor: the name may lead elsewhere by then.

    Raises:
        OSError: it cannot be written; what was there is as it was.
    """
    part = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC | os.O_NOFOLLOW, 0o600)
    try:
        with os.fdopen(descriptor, "wb") as file:
            os.fchmod(file.fileno(), mode)  # first: root without CAP_FOWNER may not, once it is somebody else's
            give(file.fileno())
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)
        raise


def read_packed(path: Path, most_bytes: int) -> bytes:
    """The same, unpacked when its name ends in ``.gz``; packed or not, at most ``most_bytes`` of content.

    Raises:
        OSError: as `read_regular`; also: it is no whole gzip file.
    """
    data = read_regular(path, most_bytes)
    if path.suffix != ".gz":
        return data
    parts: list[bytes] = []
    room = most_bytes
    if not data:
        raise OSError(errno.EINVAL, "it is no whole gzip file", str(path))
    try:
        while data:
            unpacker = zlib.decompressobj(_GZIP)
            parts.append(unpacker.decompress(data, room + 1))
            room -= len(parts[-1])
            if room < 0:
                raise OSError(errno.EFBIG, f"unpacked it holds more than {_shown(most_bytes)}", str(path))
            if not unpacker.eof:
                raise OSError(errno.EINVAL, "it is no whole gzip file", str(path))
            data = unpacker.unused_data.lstrip(b"\0")
    except zlib.error as error:
        raise OSError(errno.EINVAL, f"it is no gzip file ({error})", str(path)) from error
    return b"".join(parts)


def owner_of(path: Path) -> str:
    """Whose a file is and who may read it, as far as that can be seen; for a hint."""
    try:
        found = path.stat()
    except OSError:
        return f"user {os.geteuid()} may not look into its folder"
    return f"it belongs to user {found.st_uid} (mode {stat.S_IMODE(found.st_mode):04o}), this is user {os.geteuid()}"


def _kind(mode: int) -> str:
    return next((name for is_kind, name in _KINDS if is_kind(mode)), "something else")


def _shown(count: int) -> str:
    return f"{count >> 20} MiB" if count >= 1 << 20 else f"{count >> 10} KiB"
