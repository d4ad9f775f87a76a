"""Files that an operator names are read whole, or refused with a sentence: no pipe hangs, no bomb bursts."""

from __future__ import annotations

import contextlib
import errno
import gzip
import os
import resource
import signal
import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import pytest

from zsched.host.files import put_whole, read_packed, read_regular, write_regular

TEXT = b"time_stamp,c_rssi\n" * 100


@contextlib.contextmanager
def full_disk() -> Iterator[None]:
    """As a disk that is full in the middle of a file."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)


def test_a_regular_file_is_read_up_to_its_bound(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(TEXT)
    assert read_regular(path, len(TEXT)) == TEXT
    with pytest.raises(OSError, match="it holds more than 1 KiB") as caught:
        read_regular(path, 1024)
    assert caught.value.errno == errno.EFBIG


def test_what_is_no_regular_file_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path, kind in ((tmp_path / "pipe", "a pipe"), (Path("/dev/zero"), "a device"), (tmp_path, "a folder")):
        with pytest.raises(OSError, match=f"it is {kind}, not a regular file"):
            read_regular(path, 1024)
    with pytest.raises(FileNotFoundError):
        read_regular(tmp_path / "nothing", 1024)


def test_what_is_written_is_whole_or_not_there(tmp_path: Path) -> None:
    path = tmp_path / "file"
    for content in (TEXT, b"short"):
        write_regular(path, content)
        assert path.read_bytes() == content
    with full_disk(), pytest.raises(OSError, match="File too large"):
        write_regular(path, TEXT)
    assert not path.exists()
    os.mkfifo(path)
    with pytest.raises(OSError, match="it is a pipe, not a regular file"):
        write_regular(path, TEXT)
    with pytest.raises(IsADirectoryError):
        write_regular(tmp_path, TEXT)


def test_why_a_file_is_not_whole_is_told_although_what_is_left_cannot_be_deleted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The folder may be another user's: "permission denied" says nothing of a full disk."""

    def refuse(_path: Path, *, missing_ok: bool = False) -> None:
        raise PermissionError(errno.EACCES, f"no right, {missing_ok}")

    monkeypatch.setattr(Path, "unlink", refuse)
    with full_disk(), pytest.raises(OSError, match="File too large"):
        write_regular(tmp_path / "file", TEXT)
    with full_disk(), pytest.raises(OSError, match="File too large"):
        put_whole(tmp_path / "other", TEXT, 0o600, lambda _descriptor: None)


def test_a_file_has_its_mode_before_it_is_handed_over(tmp_path: Path) -> None:
    """Root with a few capabilities only, as in the renewal's unit, may not change the mode of what is another's."""
    modes = []
    put_whole(tmp_path / "key", TEXT, 0o640, lambda descriptor: modes.append(os.fstat(descriptor).st_mode & 0o777))
    assert modes == [0o640]


def test_a_bomb_is_refused_before_it_bursts(tmp_path: Path) -> None:
    path = tmp_path / "bomb.gz"
    path.write_bytes(gzip.compress(bytes(64 << 20)))
    tracemalloc.start()
    try:
        with pytest.raises(OSError, match="unpacked it holds more than 1 MiB"):
            read_packed(path, 1 << 20)
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()
