"""What a machine keeps when it founds a fleet, joins one or leaves one: fleet file, state, document, certificate.

Knows: which files these are, what may not be mixed, in which order they are written. Does not know: how an operator
asks for it, how a daemon uses them.

The state is written last: a machine on which only a part was written has no state, and the command can be given again.
"""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import shutil
import stat
from collections.abc import Callable, Collection, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from zsched.commands.base.places import Places
from zsched.commands.members.unfinished import Creation, mark_of, unfinished
from zsched.config.load import check_bytes
from zsched.config.reader import MAX_FILE_BYTES, render_all
from zsched.config.schema import PKI_FOLDER
from zsched.core.electorate.founding import created
from zsched.core.values.certificates import Holder, Role, accepted, parse_common_name
from zsched.core.values.codec import decode_state, document_hash
from zsched.core.values.document import Document, Text
from zsched.core.values.durable import DurableState
from zsched.core.values.electorate import FleetValue
from zsched.core.values.errors import AdapterError, ConfigError, WireError, ZschedError
from zsched.core.values.fleet import Fleet, fleet_hash
from zsched.core.values.model import NodeId, RegisterState
from zsched.core.values.startup import NoState
from zsched.core.values.struct import Struct, replace
from zsched.core.vote.generations import blank_state
from zsched.host import decision_log, rehearsals
from zsched.host.clock import wall_ns, wall_tenths
from zsched.host.document_store import COPY_NAME, FOLDER_NAME, DocumentStore
from zsched.host.files import owner_like, put_whole, read_regular
from zsched.host.key_files import PRIVATE, PUBLIC, write_whole
from zsched.host.machine import core_speed
from zsched.host.state_file import (
    LIFE_NAME,
    MAX_STATE_BYTES,
    STATE_NAME,
    StateFile,
    hardware_id,
    replace_synced,
    sync_folder,
)
from zsched.link.invitation import Invitation, Papers
from zsched.link.sessions.certificate import common_names, ders_of, parts_of
from zsched.link.sessions.secured import CERTIFICATE, KEY, TRUSTED

BEFORE: Final = ".before-join"
"""Behind the name of a fleet file that another text of the same fleet has replaced."""
LEFT: Final = ".left"
"""Behind the names of files of a fleet that this machine has left."""
OUT_NAME: Final = "out"
"""In the state folder, from before the daemon ends for good until its files are put away: see `note_out`."""
LOGS: Final = decision_log.NAMES
"""They go with the fleet of which they tell: tasks and epochs of the next one may have the same names and numbers."""
PUBLIC_MODE, GROUP_MODE, PRIVATE_MODE, FOLDER_MODE = 0o644, 0o640, 0o600, 0o755
SERVICE: Final = "zsched"
"""The group that `zsched install` and the package make for the service."""
_WHAT: Final = {
    CERTIFICATE: "the certificate",
    TRUSTED: "whom it trusts",
    KEY: "the private key, for its owner only",
}


class Written(Struct, frozen=True, kw_only=True):
    """One file of a machine that was written, or that would be."""

    path: Path
    what: str


# --- to found --------------------------------------------------------------------------------------------------------


def found(
    text: str,
    me: NodeId,
    places: Places,
    *,
    is_plan: bool,
    certify: Callable[[Fleet, str], Papers] | None = None,
) -> tuple[Fleet, tuple[Written, ...]]:
    """Make this machine the first one of a new fleet; ``is_plan``: only say what would be written.

    What an earlier try has written, which a power cut broke off, is deleted first.
    ``certify`` makes the certificate of a secured fleet; it is called when nothing else is in the way, with the id of
    this creation: an authority of the same one is what the earlier try has left.

    Raises:
        AdapterError: the machine belongs to a fleet already, or a file cannot be written.
        ConfigError: the text has faults.
    """
    fleet = _read(text, places.config)
    _check_free(fleet, me, places)
    content = Document(text=Text(text))
    listed = (CERTIFICATE, TRUSTED, KEY) if certify is not None else ()
    written = _listed(fleet, me, content, places, listed=listed)
    if is_plan:
        return fleet, written
    with StateFile(places.state, fleet=fleet.name, node=me) as file:
        _check_free(fleet, me, places)  # nobody else creates one here any more
        before = unfinished(places.config) or Creation(id=secrets.token_hex(16))
        _take_back(fleet, places, before)
        creation = before.adding([text.encode()])
        try:
            _put(mark_of(places.config), creation.encoded(), PRIVATE_MODE)
            papers = None if certify is None else certify(fleet, creation.id)
            if papers is not None:
                pems = (papers.certificate, papers.key, papers.trusted)
                creation = creation.adding([one.encode() for one in pems])
                _put(mark_of(places.config), creation.encoded(), PRIVATE_MODE)
            disk = secrets.token_hex(8)
            value = created(fleet, me, disk=disk, generation_id=secrets.token_hex(16), document=document_hash(content))
            _put_all(file, fleet, me, value, content, places, disk, papers=papers)
        except ZschedError:
            with contextlib.suppress(AdapterError, OSError):  # else the next try does
                _take_back(fleet, places, creation)
                if certify is None:  # else its caller does, once there is no authority of this creation
                    mark_of(places.config).unlink(missing_ok=True)
            raise
        with contextlib.suppress(OSError):
            mark_of(places.config).unlink(missing_ok=True)
    return fleet, written


def _check_free(fleet: Fleet, me: NodeId, places: Places) -> None:
    """Refuse to found a fleet where there is one, or over what somebody else has written."""
    _check_no_state(fleet.name, me, places.state)
    before = unfinished(places.config)
    taken = [path for path in _first_files(fleet, places) if os.path.lexists(path)]
    others = [path for path in taken if before is None or not before.has_written(path)]
    if places.config in others:
        advice = "use it (`zsched init`), or give another file with --config"
        raise AdapterError(f"{places.config} exists already, and is left as it is; {advice}")
    if path := next((one for one in others if one.name in (CERTIFICATE, KEY)), None):
        raise AdapterError(f"{path} exists already, and is left as it is; move the folder {path.parent} away")


def _first_files(fleet: Fleet, places: Places) -> tuple[Path, ...]:
    """What a creation writes outside the state folder, where nothing is in the way without a state."""
    folder = None if fleet.security is None else Path(fleet.security.folder)
    return (places.config, *(() if folder is None else (folder / name for name in (CERTIFICATE, KEY, TRUSTED))))


def _take_back(fleet: Fleet, places: Places, creation: Creation) -> None:
    """Delete what a creation has written, and nobody has changed since; its mark stays.

    Raises:
        AdapterError: a file cannot be deleted.
    """
    for path in _first_files(fleet, places):
        if creation.has_written(path):
            try:
                path.unlink()
                sync_folder(path.parent)
            except OSError as error:
                raise AdapterError(f"cannot delete {path}: {error.strerror}; {_advice(error, path)}") from error


# --- to ask for a certificate ----------------------------------------------------------------------------------------


def request_here(name: NodeId, places: Places, out: Path) -> tuple[Written, ...]:
    """Make a key for this machine, or take the one of an earlier request, and write a request for its certificate.

    Raises:
        AdapterError: this machine has a certificate already, or a file cannot be read or written.
    """
    from zsched.pki import certificates  # noqa: PLC0415 - imports cryptography

    folder = places.config.parent / PKI_FOLDER
    if (folder / CERTIFICATE).exists():
        advice = "its fleet has let it in; for another fleet move the folder away"
        raise AdapterError(f"{folder / CERTIFICATE} is there already; {advice}")
    try:
        _make_folder(folder)
        if (folder / KEY).exists():
            key = certificates.read_key(read_regular(folder / KEY, MAX_FILE_BYTES), b"")
        else:
            key = certificates.new_key()
            write_whole(folder / KEY, certificates.key_pem(key), PRIVATE)
        write_whole(out, certificates.request_pem(key, name), PUBLIC)
    except ValueError as error:
        raise AdapterError(f"{folder / KEY}: {error}; move it away, then ask again") from error
    except OSError as error:
        advice = "run this as root, or give places of your own with --config"
        raise AdapterError(f"{error.filename or out}: {error.strerror}; {advice}") from error
    return (
        Written(path=folder / KEY, what=f"{_WHAT[KEY]}; it stays here"),
        Written(path=out, what="the request, which is no secret"),
    )


# --- to join ---------------------------------------------------------------------------------------------------------


def is_joined(invitation: Invitation, places: Places) -> bool:
    """Whether this machine is that node of that fleet already.

    Raises:
        AdapterError: it has a state of another node, fleet or generation.
    """
    file = StateFile(places.state, fleet=invitation.fleet, node=invitation.node)
    file.check_owner("or take this machine out of its fleet first (`zsched leave`)")
    loaded = file.load()
    if loaded.no_state is NoState.MISSING:
        return False
    state = loaded.state
    register = None if state is None else state.fleet_register
    value = None if register is None else register.learnt
    if value is not None and value.generation_id == invitation.value.generation_id:
        return True
    if state is None:
        raise AdapterError(f"{loaded.problem}; move the folder {places.state} away, then join again")
    what = "another generation of it" if value is not None else "a time before its document was agreed"
    advice = f"if that state is not needed any more, move the folder {places.state} away, then join again"
    raise AdapterError(f"{file.path} is {invitation.node}'s in fleet {invitation.fleet}, of {what}; {advice}")


def join(invitation: Invitation, places: Places, *, is_plan: bool) -> tuple[Fleet, tuple[Written, ...]]:
    """Make this machine the node that an invitation names; ``is_plan``: only say what would be written.

    Raises:
        AdapterError: the machine has files of another fleet, or a file cannot be written.
        ConfigError: the document cannot be used here.
    """
    fleet = usable(invitation, places)
    _check_file(places.config, fleet.name)
    _check_papers(fleet, invitation)
    me, content, papers = invitation.node, invitation.document, invitation.papers
    listed = () if papers is None else (CERTIFICATE, TRUSTED, *((KEY,) if papers.key else ()))
    written = _listed(fleet, me, content, places, listed=listed)
    if not is_plan:
        value, generation, disk = invitation.value, invitation.generation, secrets.token_hex(8)
        with StateFile(places.state, fleet=fleet.name, node=me) as file:
            _put_all(file, fleet, me, value, content, places, disk, generation=generation, papers=papers)
    return fleet, written


def usable(invitation: Invitation, places: Places) -> Fleet:
    """The fleet of an invitation by which a machine can join, as far as it tells by itself.

    Raises:
        ConfigError: the document, or the certificate, cannot be used here.
    """
    fleet = _read(invitation.document.text, places.config)
    if fleet.name != invitation.fleet or all(node.name != invitation.node for node in fleet.nodes):
        raise ConfigError(f"the invitation's document has no node {invitation.node!r} in fleet {invitation.fleet!r}")
    if invitation.papers is not None and fleet.security is None:
        raise ConfigError("the invitation has a certificate, and its document has no `security:` section")
    if why := papers_problem(invitation):
        raise ConfigError(f"the invitation's {why}")
    return fleet


def is_of_a_later_key(invitation: Invitation, places: Places) -> bool:
    """Whether an invitation brings this machine, which is its node already, a key of a higher number than it has.

    The others let nobody in by the key of an earlier invitation. Where the certificate is gone, the document that the
    state names tells: by a key that it does not let in yet the daemon would not start.

    Raises:
        ConfigError: the document cannot be used here.
    """
    fleet, papers = _read(invitation.document.text, places.config), invitation.papers
    if papers is None or not papers.key or fleet.security is None:
        return False
    offered = _holder(papers.certificate.encode(), fleet.name)
    if offered is None:
        return False
    held = _holder(_held(Path(fleet.security.folder)), fleet.name)
    if held is not None:
        return (held.name, held.role) == (offered.name, offered.role) and held.key < offered.key
    if os.path.lexists(Path(fleet.security.folder) / CERTIFICATE):
        return False
    return offered.key > max((one.key for one in _let_in(invitation, places)), default=offered.key)


def _held(folder: Path) -> bytes:
    """This machine's certificate; empty: there is none.

    Where putting it away was broken off, the key still lies beside the certificate's new name.
    """
    from zsched.pki.certificates import is_key_of  # noqa: PLC0415 - imports cryptography

    with contextlib.suppress(OSError):
        return read_regular(folder / CERTIFICATE, MAX_FILE_BYTES)
    with contextlib.suppress(OSError, ValueError):
        pem = read_regular(folder / f"{CERTIFICATE}{LEFT}", MAX_FILE_BYTES)
        return pem if is_key_of(read_regular(folder / KEY, MAX_FILE_BYTES), pem) else b""
    return b""


def _let_in(invitation: Invitation, places: Places) -> tuple[Holder, ...]:
    """The keys by which the document that this machine's state names lets it in; empty: it does not tell."""
    found_ = _agreed_here(invitation, places)
    fleet = None if found_ is None else check_bytes(found_[1].text.encode(), str(places.config)).fleet
    if fleet is None or fleet.security is None:
        return ()
    return accepted(invitation.node, Role.NODE, fleet.security.revoked)


def _agreed_here(invitation: Invitation, places: Places) -> tuple[int, Document] | None:
    """(revision, document) that this machine's state names; ``None``: it names none, or that is not stored here."""
    state = StateFile(places.state, fleet=invitation.fleet, node=invitation.node).load().state
    value = None if state is None or state.fleet_register is None else state.fleet_register.learnt
    content = None if value is None else DocumentStore(places.state).load(value.document)
    return None if value is None or content is None else (value.revision, content)


def mend(invitation: Invitation, places: Places, *, is_plan: bool) -> tuple[Fleet, tuple[Written, ...]]:
    """Write what this machine, which is an invitation's node by its state, lacks beside that; ``is_plan``: only say it.

    The state stays, but for the number of the installation in it: an elector that forgets a promise can split the
    fleet. So does every file that is there.

    Raises:
        AdapterError: there are files of others, the invitation does not bring what lacks, or a file cannot be written.
        ConfigError: the document, or the certificate, cannot be used here.
    """
    _check_file(places.config, invitation.fleet)
    fleet, content = _fleet_here(invitation, places)
    folder = None if fleet.security is None else Path(fleet.security.folder)
    lacking = () if folder is None else tuple(name for name in _WHAT if not os.access(folder / name, os.F_OK))
    written = () if content is None else _listed_file(places, content.text.encode())
    if folder is not None and lacking:
        usable(invitation, places)
        _check_brought(fleet, folder, lacking, invitation, places)
        written += tuple(Written(path=folder / name, what=_WHAT[name]) for name in lacking)
    if is_plan:
        return fleet, written
    # a service without privileges reads the installation's number alone
    StateFile(places.state, fleet=invitation.fleet, node=invitation.node).note_hardware()
    if folder is not None and lacking and invitation.papers is not None:
        _put_papers(folder, invitation.papers, lacking)
    if content is not None:  # the file last: by it is seen that nothing is missing
        _put(places.state / COPY_NAME, f"{fleet_hash(fleet)}\n".encode(), PRIVATE_MODE)
        _put_file(places, content.text.encode())
    if written:
        with contextlib.suppress(OSError):  # the node is wanted again
            (places.state / OUT_NAME).unlink(missing_ok=True)
    return fleet, written


def _fleet_here(invitation: Invitation, places: Places) -> tuple[Fleet, Document | None]:
    """(the fleet that the daemon starts by, the document to write as the fleet file).

    ``None``: it starts by the file that is there. Else it is the newest document that is known here.
    """
    there = None
    with contextlib.suppress(FileNotFoundError):
        there = check_bytes(read_regular(places.config, MAX_FILE_BYTES), str(places.config)).fleet
    if there is not None and _lets_in(there, invitation):
        return there, None
    content, kept = invitation.document, _agreed_here(invitation, places)
    if kept is not None and kept[0] > invitation.value.revision:
        content = kept[1]
    fleet = _read(content.text, places.config)
    if there is not None and not _lets_in(fleet, invitation):
        return there, None  # that one would be no better
    return fleet, content


def _lets_in(fleet: Fleet, invitation: Invitation) -> bool:
    """Whether a fleet names this machine's node, and lets it in by its certificate, or else by an invitation's."""
    if all(node.name != invitation.node for node in fleet.nodes):
        return False
    if fleet.security is None:
        return True
    pem = b"" if invitation.papers is None else invitation.papers.certificate.encode()
    with contextlib.suppress(OSError):
        pem = read_regular(Path(fleet.security.folder) / CERTIFICATE, MAX_FILE_BYTES)
    holder = _holder(pem, fleet.name)
    return holder is None or holder in accepted(invitation.node, Role.NODE, fleet.security.revoked)


def take_later_key(
    invitation: Invitation, places: Places, *, is_plan: bool
) -> tuple[Fleet, tuple[Written, ...], tuple[Written, ...]]:
    """Let this machine, which is an invitation's node already, have the later key that it brings; its daemon has ended.

    The former key is renamed, and the stored document of before goes, which lets nobody in by the new one: the others
    tell the newest. The state stays as it is, as in `mend`.

    Returns:
        (the fleet, what becomes of the former files, what is written).

    Raises:
        AdapterError: a daemon runs by them, or one cannot be renamed, deleted or written.
        ConfigError: the document, or the certificate, cannot be used here.
    """
    fleet = usable(invitation, places)
    _check_file(places.config, invitation.fleet)
    assert fleet.security is not None
    folder = Path(fleet.security.folder)
    former = [one for name, what in _WHAT.items() for one in _there(folder / name, what, is_purged=False)]
    moved = tuple(Written(path=one.path, what=_fate(one, is_purged=False)) for one in former)
    brought = invitation.document
    if is_plan:
        written = _listed_file(places, brought.text.encode())
        return fleet, moved, (*written, *(Written(path=folder / name, what=what) for name, what in _WHAT.items()))
    with StateFile(places.state, fleet=invitation.fleet, node=invitation.node) as file:
        file.check_owner()
        for one in former:
            _put_one_away(one.path, is_deleted=False)
        _drop_document(invitation, places)
        fleet, written = mend(invitation, places, is_plan=False)
    return fleet, moved, written


def _drop_document(invitation: Invitation, places: Places) -> None:
    """Delete the document that the state names, if it lets nobody in by the invitation's key; others have it, too."""
    papers, let_in = invitation.papers, _let_in(invitation, places)
    holder = None if papers is None else _holder(papers.certificate.encode(), invitation.fleet)
    kept = _agreed_here(invitation, places)
    if kept is None or not let_in or holder in let_in:
        return
    store = DocumentStore(places.state)
    store.delete_others({path.name for path in store.folder.iterdir()} - {document_hash(kept[1])})


def _check_brought(
    fleet: Fleet, folder: Path, lacking: tuple[str, ...], invitation: Invitation, places: Places
) -> None:
    """Refuse where an invitation does not bring what lacks here, or what it brings does not go with what is here."""
    from zsched.link.signatures import Trust  # noqa: PLC0415 - as above
    from zsched.pki.certificates import is_key_of  # noqa: PLC0415 - imports cryptography

    path, papers = folder / lacking[0], invitation.papers
    advice = f"have another invitation written where the fleet's authority is (`zsched invite {invitation.node}`)"
    if papers is None:
        by_hand = f"`zsched pki issue {invitation.node}` there, and bring its files"
        raise AdapterError(f"{path} is not there, and the invitation brings no certificate; {advice}, or {by_hand}")
    offered, let_in = _named(papers.certificate.encode()) or "", _let_in(invitation, places)
    if let_in and parse_common_name(offered, fleet.name) not in let_in:
        raise AdapterError(f"{path} is not there, and nobody lets in by the invitation's key ({offered}); {advice}")
    _check_papers(fleet, invitation)
    if CERTIFICATE in lacking:
        return
    try:
        pem = read_regular(folder / CERTIFICATE, MAX_FILE_BYTES)
        der = ders_of(pem)[0]
        is_fitting = KEY not in lacking or is_key_of(papers.key.encode(), pem)
        is_fitting &= (
            TRUSTED not in lacking or Trust(papers.trusted.encode()).certified(der, parts_of(der).begins) is not None
        )
    except (OSError, ValueError) as error:
        raise AdapterError(f"{folder / CERTIFICATE}: {error}; move it away, then join again") from error
    if not is_fitting:
        raise AdapterError(f"{path} is not there, and that of the invitation does not go with {CERTIFICATE}; {advice}")


def _check_file(path: Path, fleet: str) -> None:
    """Refuse to take the place of another fleet's file."""
    try:
        data = read_regular(path, MAX_FILE_BYTES)
    except FileNotFoundError:
        return
    except OSError as error:
        raise AdapterError(f"{path}: cannot be read: {error.strerror}; move it away, or give --config") from error
    found_ = check_bytes(data, str(path)).fleet
    if found_ is None:
        raise AdapterError(f"{path} is no usable fleet file, and is left as it is; move it away, or give --config")
    if found_.name != fleet:
        advice = "leave that fleet first (`zsched leave`), or move the file away"
        raise AdapterError(f"{path} is the file of fleet {found_.name}, and the invitation of fleet {fleet}; {advice}")


def _check_papers(fleet: Fleet, invitation: Invitation) -> None:
    """Refuse to take the place of somebody else's certificate, or of a key that was not asked for."""
    if invitation.papers is None or fleet.security is None:
        return
    if not invitation.papers.key:
        _check_own_key(Path(fleet.security.folder) / KEY, invitation)
    path = Path(fleet.security.folder) / CERTIFICATE
    try:
        theirs = _named(read_regular(path, MAX_FILE_BYTES))
    except FileNotFoundError:
        _check_no_others(path.parent, invitation.papers)
        return
    except OSError as error:
        raise AdapterError(f"{path}: cannot be read: {error.strerror}; move the folder away") from error
    if theirs != _named(invitation.papers.certificate.encode()):
        raise AdapterError(f"{path} is the certificate of {theirs!r}, and is left as it is; move the folder away")


def papers_problem(invitation: Invitation) -> str | None:
    """What is wrong with the certificate that an invitation brings; ``None``: nothing, or it brings none.

    A node that has it is let in by nobody, or cannot even listen, and says so only after it has left another cell.
    """
    from zsched.link.signatures import Trust  # noqa: PLC0415 - as above
    from zsched.pki.certificates import is_key_of  # noqa: PLC0415 - imports cryptography

    papers = invitation.papers
    if papers is None:
        return None
    pem = papers.certificate.encode()
    name = _named(pem)
    holder = None if name is None else parse_common_name(name, invitation.fleet)
    if holder is None or (holder.name, holder.role) != (invitation.node, Role.NODE):
        return f"certificate names {name!r}, and its node is {invitation.node}"
    try:
        der = ders_of(pem)[0]
        parts, trust = parts_of(der), Trust(papers.trusted.encode())
        if trust.certified(der, parts.begins) is None:
            return "certificate is of another authority than the one that it says is trusted; have another one written"
        if papers.key and not is_key_of(papers.key.encode(), pem):
            return "certificate is for another key than the one that it brings; have another one written"
    except ValueError as error:
        return f"certificate cannot be used: {error}; have another one written"
    now = datetime.fromtimestamp(wall_ns() / 1e9, UTC)
    if not parts.begins <= now <= parts.ends:
        span = f"from {parts.begins:%Y-%m-%d %H:%M} to {parts.ends:%Y-%m-%d %H:%M} UTC"
        advice = "set the clock, or have another one written"
        return f"certificate is valid {span}, and this machine's clock says {now:%Y-%m-%d %H:%M}; {advice}"
    return None


def _check_no_others(folder: Path, papers: Papers) -> None:
    """Refuse to take the place of a key, or of authorities, that are not those of an invitation broken off before."""
    for name, pem in ((KEY, papers.key), (TRUSTED, papers.trusted)):
        try:
            is_other = pem != "" and read_regular(folder / name, MAX_FILE_BYTES) != pem.encode()
        except FileNotFoundError:
            continue
        except OSError as error:
            raise AdapterError(f"{folder / name}: cannot be read: {error.strerror}; move it away") from error
        if is_other:
            raise AdapterError(f"{folder / name} is not the invitation's, and is left as it is; move it away")


def _check_own_key(path: Path, invitation: Invitation) -> None:
    """Refuse an invitation without a key where the key that was asked for is not."""
    from zsched.pki.certificates import is_key_of  # noqa: PLC0415 - imports cryptography

    advice = f"join on the machine that made the request, or make another one: zsched join --request {invitation.node}"
    papers = invitation.papers
    assert papers is not None
    try:
        is_ours = is_key_of(read_regular(path, MAX_FILE_BYTES), papers.certificate.encode())
    except FileNotFoundError:
        raise AdapterError(f"{path} is not there, and the invitation brings no key; {advice}") from None
    except OSError as error:
        raise AdapterError(f"{path}: cannot be read: {error.strerror}; run this as root") from error
    except ValueError as error:
        raise AdapterError(f"{path}: {error}; {advice}") from error
    if not is_ours:
        raise AdapterError(f"{path} is another key than the one that the certificate is for; {advice}")


def _holder(pem: bytes, fleet: str) -> Holder | None:
    """Whom of ``fleet`` a certificate names; ``None``: nobody."""
    return parse_common_name(_named(pem) or "", fleet)


def _named(pem: bytes) -> str | None:
    try:
        return next(iter(common_names(pem)), None)
    except ValueError:
        return None


# --- to leave --------------------------------------------------------------------------------------------------------


def whose(folder: Path) -> tuple[str, NodeId]:
    """(fleet, node) of a state folder.

    Raises:
        AdapterError: it has no state, or none that can be read.
    """
    state = _state_of(folder)
    return state.fleet, state.node


def _state_of(folder: Path) -> DurableState:
    path = folder / STATE_NAME
    try:
        return decode_state(read_regular(path, MAX_STATE_BYTES))
    except FileNotFoundError:
        raise AdapterError(f"{path} is not there: this machine is in no fleet, or give --state-dir") from None
    except OSError as error:
        raise AdapterError(f"{path}: cannot be read: {error.strerror}; run this as root") from error
    except WireError as error:
        raise AdapterError(f"{path} is damaged ({error}); move the folder {folder} away") from error


def belongings(places: Places, *, is_purged: bool) -> tuple[Written, ...]:
    """What `leave` does with this machine's files of its fleet; nothing is touched.

    Raises:
        AdapterError: a folder cannot be written.
    """
    there = tuple(_belongings(places, is_purged=is_purged))
    for folder in dict.fromkeys(one.path.parent for one in there):
        if not os.access(folder, os.W_OK):
            raise AdapterError(f"{folder} cannot be written; run this as root")
    return tuple(Written(path=one.path, what=_fate(one, is_purged=is_purged)) for one in there)


def check_ended(fleet: str, node: NodeId, places: Places) -> None:
    """Whether no daemon runs by this machine's files any more.

    Raises:
        AdapterError: one does.
    """
    with StateFile(places.state, fleet=fleet, node=node):
        pass


def note_out(fleet: str, node: NodeId, revision: int, state: Path) -> None:
    """Keep that the fleet is without this node from ``revision`` on: once its daemon has ended, nobody here knows it.

    Raises:
        AdapterError: it cannot be written.
    """
    _put(state / OUT_NAME, f"{fleet} {node} {revision}\n".encode(), PRIVATE_MODE)


def is_out(fleet: str, node: NodeId, state: Path) -> bool:
    """Whether `note_out` was called for this node, and its state does not tell that it was taken in again since.

    Raises:
        AdapterError: the state cannot be read.
    """
    try:
        noted, kept = read_regular(state / OUT_NAME, 256).decode("ascii", "replace").split(), _state_of(state)
    except OSError:
        return False
    if noted[:2] != [fleet, node] or not noted[-1].isdigit():
        return False
    value = None if kept.fleet_register is None else kept.fleet_register.learnt
    if value is None or value.revision < int(noted[-1]):
        return True
    content = DocumentStore(state).load(value.document)  # a node stores no document that does not name it
    return content is None


def put_away(fleet: str, node: NodeId, places: Places, *, is_purged: bool) -> tuple[Written, ...]:
    """Rename this machine's files of its fleet, or delete them; then it can found or join one. Its daemon has ended.

    Raises:
        AdapterError: a daemon runs by them, they are another node's, or one cannot be renamed or deleted.
    """
    with StateFile(places.state, fleet=fleet, node=node) as file:
        file.check_owner()
        there = tuple(_belongings(places, is_purged=is_purged))
        for one in there:
            _put_one_away(one.path, is_deleted=is_purged or one.path.name == COPY_NAME)
        with contextlib.suppress(OSError):
            (places.state / OUT_NAME).unlink(missing_ok=True)
            mark_of(places.config).unlink(missing_ok=True)  # of a creation that was finished but for this
    return tuple(Written(path=one.path, what=_fate(one, is_purged=is_purged)) for one in there)


def _belongings(places: Places, *, is_purged: bool) -> Iterator[Written]:
    """The files that make this machine a node, the state last: without it nothing is half a node.

    The fleet file says where the certificate is: it goes behind that, so that what was broken off is found again.
    """
    for folder in (_pki_folder(places.config), places.state / PKI_FOLDER):
        if _is_planted(folder, places):
            continue
        for name, what in _WHAT.items():
            yield from _there(folder / name, what, is_purged=is_purged)
    more = (rehearsals.FOLDER_NAME, core_speed.NAME, LIFE_NAME) if is_purged else ()
    for name in (*more, *LOGS, COPY_NAME, FOLDER_NAME):
        yield from _there(places.state / name, _KEPT.get(name, "the node's records"), is_purged=is_purged)
    yield from _there(places.config, "the fleet file", is_purged=is_purged)
    if is_purged:
        yield from _there(places.config.with_name(f"{places.config.name}{BEFORE}"), "the fleet file of before")
    yield from _there(places.state / STATE_NAME, _KEPT[STATE_NAME], is_purged=is_purged)


def _is_planted(folder: Path, places: Places) -> bool:
    """Whether it is a link in the state folder: that is the service's, and it would choose whose keys root renames."""
    return folder.parent == places.state and folder.is_symlink()


_KEPT: Final = {
    **dict.fromkeys(LOGS, "the decision log"),
    COPY_NAME: "which fleet file was a copy",
    FOLDER_NAME: "agreed documents",
    STATE_NAME: "the state",
}


def _pki_folder(config: Path) -> Path:
    """Where the fleet file says that this node's certificate is."""
    try:
        fleet = check_bytes(read_regular(config, MAX_FILE_BYTES), str(config)).fleet
    except OSError:
        fleet = None
    named = None if fleet is None or fleet.security is None else Path(fleet.security.folder)
    return config.parent / PKI_FOLDER if named is None else named


def _there(path: Path, what: str, *, is_purged: bool = True) -> Iterator[Written]:
    """The file, if it is there; where all goes, also what an earlier `leave` has renamed."""
    for one in (path, path.with_name(f"{path.name}{LEFT}")) if is_purged else (path,):
        if os.path.lexists(one):
            yield Written(path=one, what=what)


def _fate(one: Written, *, is_purged: bool) -> str:
    is_deleted = is_purged or one.path.name == COPY_NAME
    return f"{one.what}, {'deleted' if is_deleted else f'now {one.path.name}{LEFT}'}"


def _put_one_away(path: Path, *, is_deleted: bool) -> None:
    old = path.with_name(f"{path.name}{LEFT}")
    try:
        for gone in (path,) if is_deleted else (old,):
            if gone.is_dir() and not gone.is_symlink():
                shutil.rmtree(gone)
            else:
                gone.unlink(missing_ok=True)
        if not is_deleted:
            path.rename(old)
        sync_folder(path.parent)
    except OSError as error:
        raise AdapterError(f"cannot put {path} away: {error.strerror}; {_advice(error, path)}") from error


# --- files -----------------------------------------------------------------------------------------------------------


def _read(text: str, config: Path) -> Fleet:
    result = check_bytes(text.encode(), str(config))
    if result.fleet is None:
        raise ConfigError(render_all(str(config), result.faults))
    return result.fleet


def _check_no_state(fleet: str, node: NodeId, folder: Path) -> None:
    file = StateFile(folder, fleet=fleet, node=node)
    file.check_owner("or take this machine out of its fleet first (`zsched leave`)")
    if file.load().no_state is not NoState.MISSING:
        advice = "leave that fleet first (`zsched leave`), or give a folder with --state-dir"
        raise AdapterError(f"{file.path} exists already: this machine belongs to a fleet; {advice}")


def _listed(
    fleet: Fleet, me: NodeId, content: Document, places: Places, *, listed: tuple[str, ...]
) -> tuple[Written, ...]:
    """What is written, in this order."""
    written = list(_listed_file(places, content.text.encode()))
    folder = None if fleet.security is None else Path(fleet.security.folder)
    if folder is not None:
        written += [Written(path=folder / name, what=_WHAT[name]) for name in listed]
    written.append(Written(path=places.state / FOLDER_NAME, what="the agreed document"))
    written.append(Written(path=places.state / STATE_NAME, what=f"the state of {me}: it has never voted"))
    return tuple(written)


def _listed_file(places: Places, text: bytes) -> tuple[Written, ...]:
    """What `_put_file` writes."""
    written = (Written(path=places.config, what="the fleet file, as a copy of the agreed document"),)
    if _other_text(places.config, text) is None:
        return written
    kept = places.config.with_name(f"{places.config.name}{BEFORE}")
    return (*written, Written(path=kept, what="the fleet file that was there"))


def _put_file(places: Places, text: bytes) -> None:
    """Write the fleet file; another one that is there is kept beside it."""
    old, former = _other_text(places.config, text), _former(places.config)
    if former is None:
        with _told_of(places.config):
            _make_folder(places.config.parent)
            put_whole(places.config, text, *_for_the_service())
            sync_folder(places.config.parent)
        return
    if old is not None:
        _put(places.config.with_name(f"{places.config.name}{BEFORE}"), old, PRIVATE_MODE, former)
    _put(places.config, text, PRIVATE_MODE, former)


def _for_the_service() -> tuple[int, Callable[[int], None]]:
    """(mode, who hands it over) of a new fleet file: its owner and the service's group may read workers' secrets.

    Everybody may where root writes it and there is no such group: a user that systemd makes is in none that has a name.
    """
    import grp  # noqa: PLC0415 - only who writes the file pays for it

    try:
        group = grp.getgrnam(SERVICE).gr_gid if os.geteuid() == 0 else -1
    except KeyError:
        return PUBLIC_MODE, lambda _descriptor: None
    return GROUP_MODE, lambda descriptor: os.fchown(descriptor, -1, group)


def _put_all(
    file: StateFile,
    fleet: Fleet,
    me: NodeId,
    value: FleetValue,
    content: Document,
    places: Places,
    disk: str,
    *,
    generation: int = 0,
    papers: Papers | None,
) -> None:
    """Write all of it, the state last."""
    plain = blank_state(fleet, me, generation, None, incarnation=wall_tenths(), hardware=hardware_id(), disk=disk)
    state = replace(plain, registers=(), fleet_register=RegisterState(task=fleet.name, learnt=value))
    _put_file(places, content.text.encode())
    if papers is not None and fleet.security is not None:
        _put_papers(Path(fleet.security.folder), papers)
    DocumentStore(places.state).save(content)
    _put(places.state / COPY_NAME, f"{fleet_hash(fleet)}\n".encode(), PRIVATE_MODE)
    file.create(state)


def _other_text(path: Path, text: bytes) -> bytes | None:
    """What a fleet file holds that is about to be replaced; ``None``: there is none, or it says the same."""
    try:
        old = read_regular(path, MAX_FILE_BYTES)
    except OSError:
        return None
    return None if old == text else old


def _former(path: Path) -> os.stat_result | None:
    """Whose a file is that is about to be replaced, and who may read it; ``None``: there is none."""
    try:
        found_ = path.stat()
    except OSError:
        return None
    return found_ if stat.S_ISREG(found_.st_mode) else None


def _put(path: Path, content: bytes, mode: int, former: os.stat_result | None = None) -> None:
    """Let a file hold that; it gets the mode and the owner of ``former``, else ``mode`` and its folder's owner.

    Raises:
        AdapterError: it cannot be written.
    """
    with _told_of(path):
        _make_folder(path.parent)
        if former is None:
            replace_synced(path, path.with_name(f"{path.name}.new"), content, mode)
        else:
            put_whole(path, content, stat.S_IMODE(former.st_mode), owner_like(former))
            sync_folder(path.parent)


@contextlib.contextmanager
def _told_of(path: Path) -> Iterator[None]:
    """Raise `AdapterError` with advice where ``path`` cannot be written."""
    try:
        yield
    except OSError as error:
        raise AdapterError(f"cannot write {path}: {error.strerror}; {_advice(error, path)}") from error


def _advice(error: OSError, path: Path) -> str:
    if error.errno in (errno.EACCES, errno.EPERM):
        return "run this by sudo, or give places of your own with --config and --state-dir"
    if error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO):
        return "free or remount the disk, then give the command again"
    return f"look what is at {error.filename or path}, move it away, then give the command again"


def _make_folder(path: Path) -> None:
    """A folder that the service's user may look into, whatever the caller's umask."""
    missing = [one for one in (path, *path.parents) if not one.exists()]
    path.mkdir(parents=True, exist_ok=True)
    for one in missing:
        one.chmod(FOLDER_MODE)


def _put_papers(folder: Path, papers: Papers, names: Collection[str] = tuple(_WHAT)) -> None:
    """Whole, never readable by others in between, and each the property of the folder's owner.

    Raises:
        AdapterError: one cannot be written.
    """
    brought = ((KEY, papers.key, PRIVATE), (TRUSTED, papers.trusted, PUBLIC), (CERTIFICATE, papers.certificate, PUBLIC))
    with _told_of(folder):
        _make_folder(folder)
        for name, pem, mode in brought:  # the key first: a certificate without its key would look complete
            if pem and name in names:
                write_whole(folder / name, pem.encode(), mode)
