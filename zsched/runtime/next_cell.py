"""What a machine keeps while it changes cells: the next one's invitation, and how the former one is still asked.

Knows: the folder, its files, in which order they are written. Does not know: when a machine changes cells
(`zsched.commands.change_cell`), what becomes of the files of its node (`zsched.runtime.membership`).

The folder is there from before the former cell is asked to let the machine go until it is no node of it any more.
It lies in the state folder, which is the service's, and root writes and reads it. So a link in its place is never gone
by, nor a folder that somebody else has made. The service may rename the folder at any time, and put another one in its
place: what is written, or read at the start of a command, goes by the folder that was opened once.
"""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from zsched.adapters.host.state_file import MAX_STATE_BYTES, STATE_NAME, replace_synced, sync_folder
from zsched.config.load import check_bytes
from zsched.config.reader import MAX_FILE_BYTES
from zsched.config.schema import PKI_FOLDER
from zsched.core.electorate.pilot import may_go
from zsched.core.values.fleet import Fleet
from zsched.core.values.model import NodeId
from zsched.core.values.struct import Struct
from zsched.errors import AdapterError, WireError
from zsched.files import read_regular
from zsched.runtime.membership import (
    NEXT_CELL,
    Places,
    Written,
    bring_back,
    finish_back,
    is_joined,
    join,
    put_away,
    whose,
)
from zsched.runtime.secured import CERTIFICATE, KEY, TRUSTED, files_by
from zsched.wire.codec import decode_state
from zsched.wire.invitation import MAX_BYTES, Invitation, decode_invitation, encode_invitation

INVITATION: Final = "invitation"
FILE: Final = "fleet.yaml"
FORMER, NEXT = "former", "next"
PRIVATE_FOLDER: Final = 0o700


class Change(Struct, frozen=True, kw_only=True):
    """A change of cells that is under way on this machine."""

    invitation: Invitation
    former: str
    """The fleet from which the machine comes."""
    former_is_secured: bool
    former_file: Path
    """Its fleet file, beside the certificate with which it is asked."""
    next_file: Path
    """The same of the next one."""


def begin(state: Path, fleet: Fleet, text: str, invitation: Invitation) -> Change:
    """Write what a change needs; the invitation is written last, so a folder without one says nothing.

    Args:
        state: this machine's state folder.
        fleet: the fleet that the machine leaves.
        text: its document.
        invitation: into the next one.

    Raises:
        AdapterError: a file cannot be read or written, the certificates are elsewhere than beside the fleet file, or
            somebody has put something else in the place of the folder meanwhile.
    """
    folder = state / NEXT_CELL
    try:
        if folder.is_symlink():
            folder.unlink()
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True, mode=PRIVATE_FOLDER)
        with _opened(folder) as held:
            _fill(held, fleet, text, invitation, state)
            change = _change(folder, held, invitation)
            if not os.path.samestat(held.stat(), folder.lstat()):
                raise AdapterError(f"{folder} was moved away while it was written; look who did so, and begin again")
    except OSError as error:
        raise AdapterError(f"{error.filename or folder}: {error.strerror}; run this as root") from error
    return change


def refreshed(state: Path, fleet: Fleet, text: str, change: Change) -> Change:
    """The same change, by which the former cell is asked with what this machine has of it now.

    A change that is broken off may wait for weeks: the certificate is renewed, or the authority is another one.

    Raises:
        AdapterError: as of `begin`.
    """
    folder = state / NEXT_CELL
    try:
        with _opened(folder) as held:
            _fill_former(held, fleet, text, state)
            _check_folder(held / FORMER / FILE)
            return _change(folder, held, change.invitation)
    except OSError as error:
        raise AdapterError(f"{error.filename or folder}: {error.strerror}; run this as root") from error


def _fill(folder: Path, fleet: Fleet, text: str, invitation: Invitation, state: Path) -> None:
    for name in (FORMER, NEXT):
        (folder / name / PKI_FOLDER).mkdir(parents=True, mode=PRIVATE_FOLDER)
    _fill_former(folder, fleet, text, state)
    _write(folder / NEXT / FILE, invitation.document.text.encode())
    papers = invitation.papers
    if papers is not None:
        for name, pem in ((CERTIFICATE, papers.certificate), (KEY, papers.key), (TRUSTED, papers.trusted)):
            _write(folder / NEXT / PKI_FOLDER / name, pem.encode())
    for name in (FORMER, NEXT):
        _check_folder(folder / name / FILE)
    _write(folder / INVITATION, encode_invitation(invitation).encode())


def _fill_former(folder: Path, fleet: Fleet, text: str, state: Path) -> None:
    _write(folder / FORMER / FILE, text.encode())
    if fleet.security is not None:
        files = files_by(fleet.security, state)
        for name, path in ((CERTIFICATE, files.certificate), (KEY, files.key), (TRUSTED, files.trusted)):
            _write(folder / FORMER / PKI_FOLDER / name, read_regular(path, MAX_FILE_BYTES))


@contextlib.contextmanager
def _opened(folder: Path) -> Iterator[Path]:
    """The folder as it is now, by a name that leads to it whatever becomes of its own.

    Raises:
        OSError: it cannot be opened, or it is a link.
        AdapterError: this command has not made it.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        if os.geteuid() == 0 and os.fstat(descriptor).st_uid != 0:
            raise _not_ours(folder)
        held = f"/proc/self/fd/{descriptor}"
        try:
            yield Path(held)
        except OSError as error:
            if isinstance(error.filename, str):
                error.filename = error.filename.replace(held, str(folder), 1)
            raise
    finally:
        os.close(descriptor)


def _not_ours(folder: Path) -> AdapterError:
    return AdapterError(f"{folder} is none that this command has made; look what is there, and delete it")


def under_way(state: Path) -> Change | None:
    """The change that was begun on this machine and is not over; ``None``: there is none.

    Raises:
        AdapterError: its files cannot be read.
    """
    folder = state / NEXT_CELL
    try:
        with _opened(folder) as held:
            return _change(folder, held, decode_invitation(read_regular(held / INVITATION, MAX_BYTES)))
    except FileNotFoundError:
        return None
    except (OSError, WireError) as error:
        if isinstance(error, OSError) and error.errno in (errno.ENOTDIR, errno.ELOOP):
            raise _not_ours(folder) from error
        raise AdapterError(f"{folder / INVITATION}: {error}; run this as root, or delete {folder}") from error


def go_over(change: Change, places: Places) -> tuple[Written, ...]:
    """Put the files of the former cell away, and write those of the next one; the daemon has ended.

    Whatever part of it was done before is left as it is.

    Raises:
        AdapterError: a daemon runs by them, or a file cannot be renamed or written.
        ConfigError: the document cannot be used here.
    """
    if _is_the_former_here(change, places):
        put_away(change.former, change.invitation.node, places, is_purged=False, comes_back=True)
    if is_joined(change.invitation, places):
        return ()
    return join(change.invitation, places, is_plan=False)[1]


def has_seat(state: Path, fleet: str, node: NodeId) -> bool:
    """Whether this machine's state is that fleet's, and does not tell that its electors have settled without it.

    Raises:
        AdapterError: it cannot be read.
    """
    try:
        kept = decode_state(read_regular(state / STATE_NAME, MAX_STATE_BYTES))
    except FileNotFoundError:
        return False
    except (OSError, WireError) as error:
        raise AdapterError(f"{state / STATE_NAME}: {error}; run this as root") from error
    value = None if kept.fleet_register is None else kept.fleet_register.learnt
    return kept.fleet == fleet and (value is None or not may_go(value, node))


def go_back(change: Change, places: Places) -> None:
    """Undo `go_over`; the daemon has ended.

    Raises:
        AdapterError: a daemon runs by the files, or one cannot be renamed.
    """
    if _is_the_former_here(change, places):
        # what was renamed before a power cut has no other way back, and what has come back must not be deleted
        finish_back(change.former, change.invitation.node, places, is_secured=change.former_is_secured)
        return
    bring_back(change.invitation.fleet, change.invitation.node, places, is_secured=change.former_is_secured)


def _is_the_former_here(change: Change, places: Places) -> bool:
    """Whether this machine's files are the former cell's, all or some: the state goes last, and comes back last."""
    if (places.state / STATE_NAME).exists():
        return whose(places.state)[0] == change.former
    return _is_file_of(change.former, places.config)


def _is_file_of(fleet: str, path: Path) -> bool:
    """Whether the fleet file here is that fleet's: a way back was broken off."""
    try:
        held = check_bytes(read_regular(path, MAX_FILE_BYTES), str(path)).fleet
    except OSError:
        return False
    return held is not None and held.name == fleet


def end(state: Path) -> None:
    """The change is over: delete what was kept for it, the invitation first.

    Raises:
        AdapterError: it cannot be deleted.
    """
    folder = state / NEXT_CELL
    try:
        with contextlib.suppress(FileNotFoundError), _opened(folder) as held:
            (held / INVITATION).unlink(missing_ok=True)
        if folder.exists():
            shutil.rmtree(folder)
            sync_folder(state)
    except OSError as error:
        raise AdapterError(f"cannot delete {folder}: {error.strerror}; it holds private keys") from error


def _change(folder: Path, held: Path, invitation: Invitation) -> Change:
    """What the folder says, which is opened as ``held``."""
    former = folder / FORMER / FILE
    fleet = check_bytes(read_regular(held / FORMER / FILE, MAX_FILE_BYTES), str(former)).fleet
    if fleet is None:
        raise AdapterError(f"{former} has faults for this version of zsched; delete {folder}")
    return Change(
        invitation=invitation,
        former=fleet.name,
        former_is_secured=fleet.security is not None,
        former_file=former,
        next_file=folder / NEXT / FILE,
    )


def _check_folder(path: Path) -> None:
    """Refuse a document whose certificates are elsewhere than beside the fleet file: each cell has its own.

    Raises:
        AdapterError: they are.
    """
    fleet = check_bytes(read_regular(path, MAX_FILE_BYTES), str(path)).fleet
    if fleet is not None and fleet.security is not None and Path(fleet.security.folder) != path.parent / PKI_FOLDER:
        advice = "leave that out of the document, or change cells by `zsched leave` and `zsched join`"
        raise AdapterError(f"fleet {fleet.name} says `security: {{folder: {fleet.security.folder}}}`; {advice}")


def _write(path: Path, content: bytes) -> None:
    """Whole; the folder keeps others out."""
    replace_synced(path, path.with_name(f"{path.name}.new"), content)
