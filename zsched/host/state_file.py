"""Keeps a node's durable state in one file that is always a whole old or a whole new one.

A save writes a temporary file in the same folder, fsyncs it, renames it over the old one and fsyncs the folder; only
then has the node promised anything. Two daemons cannot share a folder: its lock file is held with flock(2).

A file that is missing, damaged, another node's, or written on other hardware (a cloned card) is *lost state*: `load`
says so as a value, and the node works without being an elector (docs/design/failures.md).

Knows: folders, locks, fsync, what identifies this machine. Does not know: the bytes (`zsched.core.values.codec`),
ballots, epochs.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import hashlib
import os
from pathlib import Path
from types import TracebackType
from typing import Self

from zsched.core.values.codec import decode_state, encode_state
from zsched.core.values.durable import DurableState
from zsched.core.values.errors import AdapterError, WireError
from zsched.core.values.model import MAX_COUNTER, NodeId
from zsched.core.values.startup import NoState
from zsched.core.values.struct import Struct, replace
from zsched.core.vote.generations import way_out
from zsched.host.files import read_regular

STATE_NAME, LOCK_NAME, NEW_NAME = "state", "lock", "state.new"
LIFE_NAME, NEW_LIFE_NAME = "life", "life.new"
"""The incarnation of the last start, which every node has, also one without a state."""
MAX_STATE_BYTES = 4 * 1024 * 1024
MAX_LIFE_BYTES = 32
HARDWARE_SOURCES = (
    ("machine", "etc/machine-id"),
    ("dmi", "sys/class/dmi/id/product_uuid"),
    ("serial", "proc/device-tree/serial-number"),
)
"""machine-id(5), the BIOS's UUID (readable by root only), a board's serial number."""
HARDWARE_ITSELF = frozenset({"dmi", "serial"})
"""Of them, those that a new installation of the system does not change."""


class LoadResult(Struct, frozen=True, kw_only=True):
    """The state, or why there is none: one line for `status` and the log."""

    state: DurableState | None = None
    problem: str | None = None
    no_state: NoState | None = None
    """`NoState.ANOTHER_NODE`: `zsched init` refuses it."""


class StateFile:
    """The durable state of ``node`` in ``folder``. `acquire` (or ``with``) before anything else."""

    def __init__(self, folder: Path, *, fleet: str, node: NodeId, hardware: str | None = None) -> None:
        """Name the place; touches nothing. ``hardware`` is `hardware_id` but in tests."""
        self.folder, self.path = folder, folder / STATE_NAME
        self._fleet, self._node = fleet, node
        self._hardware = hardware_id() if hardware is None else hardware
        self._lock_fd: int | None = None

    def acquire(self) -> None:
        """Make the folder (mode 0700) if need be and take its lock.

        Raises:
            AdapterError: another process holds it, or the folder cannot be made or written.
        """
        if self._lock_fd is not None:
            return
        try:
            self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            fd = _open_own(self.folder / LOCK_NAME)
        except OSError as error:
            advice = "run this by sudo, or give --state-dir"
            if error.errno in (errno.EEXIST, errno.ENOTDIR):
                advice = "a file is where a folder should be: see --state-dir"
            if error.errno in (errno.ENOENT, errno.EROFS):
                advice = "name a folder that can be made with --state-dir"
            if error.errno in (errno.ELOOP, errno.EMLINK):
                advice = f"delete {self.folder / LOCK_NAME}: it leads to another file, and zsched makes none such"
            raise AdapterError(f"cannot use the state folder {self.folder}: {error.strerror}; {advice}") from error
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            holder = os.pread(fd, 32, 0).decode(errors="replace").strip()
            os.close(fd)
            raise AdapterError(
                f"the state folder {self.folder} is in use by process {holder or 'unknown'}; stop that daemon first"
            ) from error
        with contextlib.suppress(OSError):  # on a full disk the number is missing, the lock holds all the same
            os.ftruncate(fd, 0)
            os.pwrite(fd, f"{os.getpid()}\n".encode("ascii"), 0)
        hand_over(fd, self.folder)
        self._lock_fd = fd

    def release(self) -> None:
        """Give the lock back; the files stay."""
        if self._lock_fd is not None:
            os.close(self._lock_fd)
            self._lock_fd = None

    def __enter__(self) -> Self:
        self.acquire()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.release()

    def check_owner(self, instead: str = "") -> None:
        """Look whose folder it is; it is left as it is.

        Args:
            instead: what else to do, where no option of the command names another node or fleet file.

        Raises:
            AdapterError: another node's or fleet's.
        """
        state = self._read().state
        if state is None or (state.fleet, state.node) == (self._fleet, self._node):
            return
        whose = instead or f"or say with --node {state.node} that this machine is {state.node}"
        if not instead and state.fleet != self._fleet:
            whose = "or name that fleet's file with --config"
        raise AdapterError(
            f"{self.path} {self._foreign(state)}, and is left as it is; "
            f"give {self._node} a folder of its own with --state-dir, {whose}"
        )

    def create(self, state: DurableState) -> None:
        """Write a node's blank state (`zsched init`): "this name has never voted in this generation".

        A start counter that can still be read from an older file is kept: incarnations never fall.

        Raises:
            AdapterError: the folder is another node's or fleet's, or there is a state file already and
                ``state.generation`` is not above its own (a damaged one counts as generation 0), or it cannot be
                written.
        """
        self.check_owner()
        found = self._read()
        standing = 0 if found.state is None else found.state.generation
        if self.path.exists() and state.generation <= standing:
            what = f"of generation {standing}" if found.state is not None else f"({found.problem})"
            raise AdapterError(
                f"{self.path} exists already {what}: this name may have voted. Without this state the node works all "
                f"the same and votes no more. To make it an elector again, {way_out(standing + 1)}"
            )
        if found.state is not None:
            state = replace(state, incarnation=max(state.incarnation, found.state.incarnation))
        self.save(state)

    def note_hardware(self) -> None:
        """Write this machine's present `hardware_id` into the state, where another installation's stands in it.

        Raises:
            AdapterError: a daemon holds the state, or it cannot be written.
        """
        state = self.load().state
        if state is None or state.hardware == self._hardware:
            return
        if _parts(state.hardware).keys() <= _parts(self._hardware).keys():  # else it was told more by who may read more
            with self:
                self.save(replace(state, hardware=self._hardware))

    def load(self) -> LoadResult:
        """Read and check the state: whole, this fleet's, this node's, written on this machine."""
        found = self._read()
        if found.state is None:
            return found
        problem = self._foreign(found.state)
        if problem is None:
            return found
        state = found.state
        if state.fleet == self._fleet and state.node == self._node:
            return LoadResult(problem=f"{self.path} {problem}")
        own = f"the fleet file of {state.fleet}" if state.fleet != self._fleet else f"--node {state.node}"
        advice = f"start this daemon with {own}, or take this machine out of that fleet first (`zsched leave`)"
        return LoadResult(problem=f"{self.path} {problem}: {advice}", no_state=NoState.ANOTHER_NODE)

    def save(self, state: DurableState) -> None:
        """Replace the state; when this returns it survives a power cut.

        Raises:
            AdapterError: the disk is full, read-only or gone, or the lock is not held; the old state is whole.
        """
        if self._lock_fd is None:
            raise AdapterError(f"the lock of {self.folder} is not held: acquire it before saving")
        try:
            replace_synced(self.path, self.folder / NEW_NAME, encode_state(state))
        except OSError as error:
            advice = "free or remount the disk (the old state is whole)"
            if isinstance(error, FileNotFoundError) and not self.folder.exists():
                advice = (
                    "the folder is gone, and the state with it: before this daemon is started again, bring what "
                    "`zsched fleet export` writes on another node as its fleet file, and run `zsched init`"
                )
            raise AdapterError(f"cannot write {self.path}: {error.strerror}; {advice}") from error

    def last_life(self) -> int:
        """The highest incarnation that was noted in this folder; 0: none."""
        try:
            text = read_regular(self.folder / LIFE_NAME, MAX_LIFE_BYTES, is_own=True).decode(errors="replace").strip()
        except OSError:
            return 0
        is_whole = text.isascii() and text.isdigit() and int(text) < MAX_COUNTER
        return int(text) if is_whole else 0

    def note_life(self, incarnation: int) -> None:
        """Note the incarnation of a start; when this returns it survives a power cut.

        Raises:
            AdapterError: the disk is full, read-only or gone, or the lock is not held.
        """
        path = self.folder / LIFE_NAME
        if self._lock_fd is None:
            raise AdapterError(f"the lock of {self.folder} is not held: acquire it before saving")
        try:
            replace_synced(path, self.folder / NEW_LIFE_NAME, f"{incarnation}\n".encode("ascii"))
        except OSError as error:
            raise AdapterError(f"cannot write {path}: {error.strerror}; free or remount the disk") from error

    def _read(self) -> LoadResult:
        try:
            content = read_regular(self.path, MAX_STATE_BYTES)
        except FileNotFoundError:
            advice = "if this name has never voted, stop the daemon, run `zsched init`, and start it again"
            return LoadResult(problem=f"{self.path} does not exist: {advice}", no_state=NoState.MISSING)
        except OSError as error:
            return LoadResult(problem=f"{self.path} cannot be read: {error.strerror}")
        try:
            return LoadResult(state=decode_state(content))
        except WireError as error:
            return LoadResult(problem=f"{self.path} is damaged: {error}")

    def _foreign(self, state: DurableState) -> str | None:
        if state.fleet != self._fleet:
            return f"belongs to the fleet {state.fleet!r}, not {self._fleet!r}"
        if state.node != self._node:
            return f"belongs to the node {state.node!r}, not {self._node!r}"
        if not is_same_hardware(state.hardware, self._hardware):
            return "was written on another machine: was its disk or card copied?"
        return None


def hardware_id(root: Path = Path("/")) -> str:
    """What identifies this machine: ``name:hash`` of every source that can be read, "" when none can.

    Each source stands alone because some are readable by root only: `zsched init` as root and a service without
    privileges must still recognise each other (`is_same_hardware`).
    """
    parts = []
    for name, path in HARDWARE_SOURCES:
        try:
            content = (root / path).read_bytes().strip(b"\0\n ")
        except OSError:
            continue
        if content:
            parts.append(f"{name}:{hashlib.blake2s(content, digest_size=8, person=b'zsched').hexdigest()}")
    return ",".join(parts)


def is_same_hardware(stored: str, current: str) -> bool:
    """Whether two `hardware_id` do not contradict each other, by the sources that both could read.

    Where one of them is the machine's own (`HARDWARE_ITSELF`), the installation's is not asked: a new one has another.

    >>> is_same_hardware("machine:aa,serial:cc", "machine:bb,serial:cc"), is_same_hardware("machine:aa", "machine:bb")
    (True, False)
    """
    theirs, ours = _parts(stored), _parts(current)
    common = theirs.keys() & ours.keys()
    return all(theirs[name] == ours[name] for name in common & HARDWARE_ITSELF or common)


def _parts(hardware: str) -> dict[str, str]:
    return dict(part.partition(":")[::2] for part in hardware.split(",") if part)


def replace_synced(path: Path, new: Path, content: bytes, mode: int = 0o600) -> None:
    """Let the file at ``path`` hold ``content``; when this returns it survives a power cut.

    Args:
        path: the file.
        new: where it is written first, in the same folder.
        content: all of it.
        mode: its permissions, whatever the umask.

    Raises:
        OSError: the disk is full, read-only or gone; what was at ``path`` is whole.
    """
    try:
        _write_synced(new, content, mode)
        new.replace(path)
        sync_folder(path.parent)
    except OSError:
        with contextlib.suppress(OSError):
            new.unlink()
        raise


def _open_own(path: Path) -> int:
    """Open a file of the state folder for writing, and make it if need be; never one that a link leads to.

    The folder is the service's and root writes there too (`zsched init`): a link in it would choose what root writes.

    Raises:
        OSError: it cannot be opened, or it is a link.
    """
    fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o600)
    if os.fstat(fd).st_nlink > 1:
        os.close(fd)
        raise OSError(errno.EMLINK, os.strerror(errno.EMLINK), str(path))
    return fd


def _write_synced(path: Path, content: bytes, mode: int) -> None:
    path.unlink(missing_ok=True)  # of a save that was cut off, or what leads elsewhere: the file is always a new one
    fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    try:
        os.fchmod(fd, mode)  # not by its name, which may lead elsewhere once it is there
        written = 0
        while written < len(content):
            written += os.write(fd, content[written:])
        hand_over(fd, path.parent)
        os.fsync(fd)
    finally:
        os.close(fd)


def hand_over(fd: int, folder: Path) -> None:
    """Give a file that root writes (`zsched init`) to the folder's owner: the service must be able to read it."""
    if os.geteuid() == 0:
        with contextlib.suppress(OSError):  # a file system without owners
            owner = folder.stat()
            os.fchown(fd, owner.st_uid, owner.st_gid)


def hand_over_folder(path: Path) -> None:
    """Give a folder that root has made to the owner of the folder above: the service must be able to use it."""
    if os.geteuid() == 0:
        with contextlib.suppress(OSError):  # a file system without owners
            owner = path.parent.stat()
            os.chown(path, owner.st_uid, owner.st_gid, follow_symlinks=False)


def sync_folder(folder: Path) -> None:
    """Let renames and deletions in a folder survive a power cut.

    Raises:
        OSError: the disk refused.
    """
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
