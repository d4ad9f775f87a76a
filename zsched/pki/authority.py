"""The fleet's authority in one folder: its key, its certificate, and the record of what it has issued and revoked.

Knows: the folder's files. Does not know: sessions, which names are let in (`zsched.link.sessions.access_rules`, by the
fleet file).

``ca-<number>.key`` is the one secret; with a passphrase it is encrypted. ``authority.json`` is the record, plain text:
the certificates that nodes trust (two between `rotate` and `finish`), and every key that was certified, with its newest
certificate, so that a renewal needs no file of the node. Every change is one new record. ``ca.pem`` is a copy.

No daemon loads this module: to make certificates ``cryptography`` takes 16 MiB of memory.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

from zsched.core.values.certificates import MAX_KEY, Holder, Role, parse_label
from zsched.core.values.errors import AdapterError
from zsched.core.values.struct import Struct, replace
from zsched.host.files import read_regular
from zsched.host.key_files import PRIVATE, PUBLIC, make_folder, open_lock, write_whole
from zsched.link.sessions.certificate import validities
from zsched.pki import certificates as x509

TRUSTED, RECORD, LOCK = "ca.pem", "authority.json", ".lock"
FORMAT: Final = 1
MAX_BYTES: Final = 4 << 20
RENEW_SHARE: Final = 2 / 3
"""A certificate is due once this share of its life is over."""
AHEAD_S: Final = int(x509.EARLY.total_seconds())
"""So far a node's clock may be behind the one that a certificate was made by."""


class Entry(Struct, frozen=True, kw_only=True):
    """One key that was certified; times are seconds since 1970 (UTC)."""

    label: str
    fingerprint: str
    """SHA-256 of the public key."""
    issued: int
    """When its newest certificate was made."""
    until: int
    """When that ends."""
    certificate: str
    """The newest one, PEM."""
    hosts: tuple[str, ...] = ()
    authority: int = 1
    """The number of the authority that signed it."""
    revoked: int | None = None
    """When the key was revoked; ``None``: it was not."""
    former: tuple[str, ...] = ()
    """The same of keys whose place this one took (`Authority.renew` with a request): they are its holder's, too."""

    @property
    def holder(self) -> Holder:
        """Whose key it is."""
        holder = parse_label(self.label)
        if holder is None:
            raise AdapterError(f"{RECORD}: {self.label!r} is no certificate's name; bring the file back from a backup")
        return holder

    def is_due(self, now: int, authority: int) -> bool:
        """Whether it should be renewed: two thirds of its life are over, or another authority signs now.

        One that was issued in the future is due, too: a clock was wrong then, and nodes would refuse it until that day.
        """
        if self.authority != authority or self.issued > now + AHEAD_S:
            return True
        return now >= self.issued + (self.until - self.issued) * RENEW_SHARE


class Record(Struct, frozen=True, kw_only=True):
    """What an authority remembers."""

    fleet: str
    number: int
    """Of the authority that signs; a rotation counts on."""
    trusted: tuple[str, ...]
    """The authorities' own certificates, PEM, the newest first: two while a rotation is not finished."""
    entries: tuple[Entry, ...] = ()
    lives: tuple[tuple[str, int], ...] = ()
    """(node, its incarnation when the rotation began), of those that lived; empty: nobody has looked."""
    creation: str = ""
    """Of the fleet for which it was made (`zsched.commands.members.unfinished`); empty: it was made by itself."""

    def entry(self, label: str) -> Entry | None:
        """The entry of a label; ``None``: no key of that label was certified."""
        return next((one for one in self.entries if one.label == label), None)

    def newest(self, name: str, role: Role) -> Entry | None:
        """The entry of the newest key of a holder; ``None``: it never had one."""
        own = [one for one in self.entries if (one.holder.name, one.holder.role) == (name, role)]
        return max(own, key=lambda one: one.holder.key, default=None)


class Issued(Struct, frozen=True, kw_only=True):
    """What a holder gets. ``key`` is empty where the key was made elsewhere."""

    entry: Entry
    certificate: bytes
    trusted: bytes
    key: bytes = b""


class Authority:
    """One fleet's authority, held by its lock until it is closed."""

    def __init__(self, folder: Path, record: Record) -> None:
        self._folder, self.record = folder, record

    @property
    def folder(self) -> Path:
        """Where it lies."""
        return self._folder

    @property
    def key_path(self) -> Path:
        """Where its key lies."""
        return self._folder / key_name(self.record.number)

    @property
    def is_locked(self) -> bool:
        """Whether its key needs a passphrase."""
        return x509.is_locked(self._key_file())

    @property
    def is_rotating(self) -> bool:
        """Whether the former authority is still trusted."""
        return len(self.record.trusted) > 1

    @property
    def since(self) -> datetime:
        """When the authority that signs now was made."""
        return validities(self.record.trusted[0].encode())[0][0] + x509.EARLY

    @property
    def trusted(self) -> bytes:
        """The certificates that nodes trust, PEM."""
        return "".join(self.record.trusted).encode()

    # --- what it does ------------------------------------------------------------------------------------------------

    def check(self, passphrase: bytes) -> None:
        """See that the key can sign, before anything is changed.

        Raises:
            AdapterError: it is not there, the passphrase is wrong, or it is another one's.
        """
        self._signer(passphrase)

    def issue(
        self, name: str, role: Role, hosts: Sequence[str], request: bytes, passphrase: bytes, now: datetime
    ) -> Issued:
        """A first certificate for a key: a new key, or that of ``request`` (a certificate request, PEM).

        A request for the key that the holder has already is answered again.

        Raises:
            AdapterError: the holder has another key that is not revoked, the request is not usable, or a file is not.
        """
        holder = self.next_holder(name, role, request, now)
        key = None if request else x509.new_key()
        public = self._requested(request) if key is None else key.public_key()
        issued = self._certify(holder, public, tuple(hosts), passphrase, now)
        return issued if key is None else replace(issued, key=x509.key_pem(key))

    def next_holder(self, name: str, role: Role, request: bytes, now: datetime) -> Holder:
        """Whose the key is that `issue` would certify.

        Raises:
            AdapterError: the holder has another key that is not revoked, or the request is not usable.
        """
        before = self.record.newest(name, role)
        if before is not None and self.asks_for(before, request):
            return before.holder
        if before is not None and before.revoked is None and before.until > _seconds(now):
            raise AdapterError(
                f"{before.label} has a certificate until {day(before.until)}; `zsched pki renew {before.label}` keeps "
                f"its key; if the key is lost or stolen, `zsched pki revoke {before.label}` first"
            )
        number = 1 if before is None else before.holder.key + (before.revoked is not None)
        if number > MAX_KEY:
            raise AdapterError(f"{name} has had {MAX_KEY} keys; give it another name")
        return Holder(name=name, role=role, key=number)

    def renew(
        self, label: str, hosts: Sequence[str] | None, request: bytes, passphrase: bytes, now: datetime
    ) -> Issued:
        """A new certificate for the key that a label has, or for that of ``request``, which takes the number over.

        ``hosts``: ``None`` keeps those that it had.

        Raises:
            AdapterError: there is no such key, it is revoked, or a file is not usable.
        """
        entry = self.record.entry(label)
        if entry is None:
            raise AdapterError(f"no certificate {label!r}{self._meant(label)}; `zsched pki show` lists them")
        if entry.revoked is not None:
            raise AdapterError(f"the key of {label} is revoked; `zsched pki issue {entry.holder.name}` makes another")
        public = self._requested(request) if request else self._key_in(entry.certificate)
        return self._certify(entry.holder, public, entry.hosts if hosts is None else tuple(hosts), passphrase, now)

    def asks_for(self, entry: Entry, request: bytes) -> bool:
        """Whether a request is for a key that has a certificate already, and is not revoked.

        Raises:
            AdapterError: the request is not usable.
        """
        return (
            bool(request) and entry.revoked is None and x509.fingerprint(self._requested(request)) == entry.fingerprint
        )

    def revoke(self, label: str, now: datetime) -> Entry:
        """Mark a key as revoked: it is never certified again. The fleet file says which names are let in.

        Raises:
            AdapterError: there is no such key.
        """
        entry = self.record.entry(label)
        if entry is None:
            raise AdapterError(f"no certificate {label!r}{self._meant(label)}; `zsched pki show` lists them")
        if entry.revoked is None:
            entry = replace(entry, revoked=_seconds(now))
            self._keep(entry)
        return entry

    def _meant(self, name: str) -> str:
        """The newest keys of a holder that is named without its role."""
        newest = [self.record.newest(name, role) for role in Role]
        labels = [one.label for one in newest if one is not None]
        return f", did you mean {' or '.join(labels)}?" if labels else ""

    def rotate(self, passphrase: bytes, now: datetime, lives: Mapping[str, int] | None = None) -> None:
        """Begin with a new authority, whose key gets the same passphrase; the former one stays trusted until `finish`.

        ``lives``: {node: its incarnation}; who is in the same life later does not know the new authority.

        Raises:
            AdapterError: the rotation before it is not finished, the passphrase is wrong, or a file cannot be written.
        """
        if self.is_rotating:
            raise AdapterError("the rotation before this one is not finished: `zsched pki rotate --finish` first")
        self.check(passphrase)  # nobody could open a key that a slip of the hand has locked
        self._found(passphrase, now, lives or {})

    def left(self) -> tuple[Entry, ...]:
        """The entries, not revoked, whose certificates are of the former authority.

        Raises:
            AdapterError: there is no rotation to finish.
        """
        if not self.is_rotating:
            raise AdapterError("there is no rotation to finish")
        return tuple(one for one in self.record.entries if one.revoked is None and one.authority != self.record.number)

    def finish(self) -> tuple[Entry, ...]:
        """End a rotation: only the new authority is trusted.

        Returns:
            What is `left`; with any of them nothing is done.

        Raises:
            AdapterError: there is no rotation to finish, or a file cannot be written.
        """
        left = self.left()
        if not left:
            self._save(replace(self.record, trusted=self.record.trusted[:1], lives=()))
            self._drop_former()
        return left

    def _drop_former(self) -> None:
        """Delete the key of the authority before, unless that is trusted still."""
        if not self.is_rotating:
            with contextlib.suppress(OSError):
                (self._folder / key_name(self.record.number - 1)).unlink(missing_ok=True)

    def mend(self) -> None:
        """Bring what hangs on the record to what it says, as far as that can be written: a full disk came between."""
        with contextlib.suppress(AdapterError):
            self._copy()
            self._drop_former()

    def destroy(self) -> None:
        """Delete all of it: of an authority whose certificates nobody has got.

        Raises:
            OSError: a file cannot be deleted.
        """
        for name in (key_name(self.record.number), RECORD, TRUSTED, LOCK):
            (self._folder / name).unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # somebody's own file is in it
            self._folder.rmdir()

    # --- parts -------------------------------------------------------------------------------------------------------

    def _requested(self, request: bytes) -> x509.PublicKey:
        try:
            return x509.requested_key(request)
        except ValueError as error:
            raise AdapterError(f"the certificate request: {error}") from error

    def _certify(
        self, holder: Holder, public: x509.PublicKey, hosts: tuple[str, ...], passphrase: bytes, now: datetime
    ) -> Issued:
        mark = x509.fingerprint(public)
        others = (one for one in self.record.entries if one.label != holder.label)
        other = next((one for one in others if mark in (one.fingerprint, *one.former)), None)
        if other is not None:
            state = "revoked" if other.revoked is not None else "in use"
            raise AdapterError(f"that key is {other.label}'s and {state}: every holder has a key of its own, make one")
        certificate = x509.sign(self._signer(passphrase), holder, self.record.fleet, public, hosts, now)
        before = self.record.entry(holder.label)
        had = () if before is None else (*before.former, before.fingerprint)
        entry = Entry(
            label=holder.label,
            fingerprint=mark,
            issued=_seconds(now),
            until=_seconds(certificate.not_valid_after_utc),
            certificate=x509.certificate_pem(certificate).decode(),
            hosts=hosts,
            authority=self.record.number,
            former=tuple(one for one in had if one != mark),
        )
        self._keep(entry)
        return Issued(entry=entry, certificate=entry.certificate.encode(), trusted=self.trusted)

    def _key_in(self, pem: str) -> x509.PublicKey:
        try:
            return x509.certified_key(x509.read_certificate(pem.encode()))
        except ValueError as error:
            raise AdapterError(f"{self._folder / RECORD}: a certificate in it is damaged: {error}") from error

    def _signer(self, passphrase: bytes) -> x509.Signer:
        pem = self._key_file()
        try:
            key = x509.read_key(pem, passphrase)
            certificate = x509.read_certificate(self.trusted)
        except ValueError as error:
            why = "the passphrase is wrong" if x509.is_locked(pem) else str(error)
            raise AdapterError(f"{self.key_path}: {why}") from error
        if x509.fingerprint(self._key_in(self.record.trusted[0])) != x509.fingerprint(key.public_key()):
            raise AdapterError(f"{self.key_path} is not the key of {RECORD}; bring both back from one backup")
        return x509.Signer(key=key, certificate=certificate)

    def _found(self, passphrase: bytes, now: datetime, lives: Mapping[str, int]) -> None:
        """Begin with the next number. The key is there before the record names it: a crash leaves what was."""
        number = self.record.number + 1
        signer = x509.new_authority(self.record.fleet, number, now)
        self._write(key_name(number), x509.key_pem(signer.key, passphrase), PRIVATE)
        own = x509.certificate_pem(signer.certificate).decode()
        told = tuple(sorted(lives.items()))
        self._save(replace(self.record, number=number, trusted=(own, *self.record.trusted), lives=told))

    def _key_file(self) -> bytes:
        try:
            return read_regular(self.key_path, MAX_BYTES)
        except FileNotFoundError as error:
            raise AdapterError(
                f"{self.key_path} is not there: is it offline? Bring it back, or say --authority DIR"
            ) from error
        except OSError as error:
            raise AdapterError(f"{self.key_path}: cannot be read: {error.strerror}") from error

    def _keep(self, entry: Entry) -> None:
        others = tuple(one for one in self.record.entries if one.label != entry.label)
        self._save(replace(self.record, entries=(*others, entry)))

    def _save(self, record: Record) -> None:
        body = {"format": FORMAT, **asdict(replace(record, entries=tuple(sorted(record.entries, key=_by_label))))}
        self._write(RECORD, (json.dumps(body, indent=1) + "\n").encode(), PUBLIC)
        self.record = record
        try:
            self._copy()
        except AdapterError as error:
            told = f"the record is changed, and {TRUSTED} is not: bring that file nowhere"
            raise AdapterError(f"{error}; {told}; make room, and give `zsched pki show`: it writes it") from error

    def _copy(self) -> None:
        """Let ``ca.pem`` hold what the record trusts; where it does nothing is written, which could fail."""
        with contextlib.suppress(OSError):
            if read_regular(self._folder / TRUSTED, MAX_BYTES) == self.trusted:
                return
        self._write(TRUSTED, self.trusted, PUBLIC)

    def _write(self, name: str, content: bytes, mode: int) -> None:
        path = self._folder / name
        try:
            make_folder(path.parent)
            write_whole(path, content, mode)
        except OSError as error:
            raise AdapterError(f"{path}: cannot be written: {error.strerror}") from error


def create(folder: Path, fleet: str, passphrase: bytes, now: datetime, creation: str = "") -> Authority:
    """A new authority in ``folder``; ``creation``: that of the fleet, of which it is a part.

    Raises:
        AdapterError: there is one already, or the folder cannot be written.
    """
    try:
        make_folder(folder)
    except OSError as error:
        raise AdapterError(f"{folder}: cannot be written: {error.strerror}") from error
    with _locked(folder):  # two that begin at once would keep the key of one and the record of the other
        if (folder / RECORD).exists():
            raise AdapterError(
                f"{folder} holds an authority; `zsched pki show` tells of it; another folder: --authority DIR"
            )
        authority = Authority(folder, Record(fleet=fleet, number=0, trusted=(), creation=creation))
        authority._found(passphrase, now, {})  # noqa: SLF001 - of this module
    return authority


@contextlib.contextmanager
def opened(folder: Path, fleet: str) -> Iterator[Authority]:
    """The authority of ``fleet`` in ``folder``; nobody else changes it meanwhile.

    Raises:
        AdapterError: there is none, it is another fleet's, or its record is damaged.
    """
    held = _read(folder).fleet
    if held != fleet:
        raise AdapterError(f"{folder} holds the authority of fleet {held}, not of {fleet}; say --authority DIR")
    with _locked(folder):
        authority = Authority(folder, _read(folder))  # with what the one before us has changed
        authority.mend()
        yield authority


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    try:
        descriptor = open_lock(folder / LOCK)
    except OSError as error:
        raise AdapterError(f"{folder}: its lock cannot be read: {error.strerror}") from error
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def _read(folder: Path) -> Record:
    try:
        return _record(json.loads(read_regular(folder / RECORD, MAX_BYTES)))
    except FileNotFoundError as error:
        raise AdapterError(
            f"there is no authority in {folder}; `zsched pki init` makes one, --authority DIR says where it lies"
        ) from error
    except OSError as error:
        raise AdapterError(f"{folder}: cannot be read: {error.strerror}") from error
    except (ValueError, KeyError, TypeError) as error:
        raise AdapterError(f"{folder / RECORD} is damaged ({error!r}); bring it back from a backup") from error


def _record(body: dict[str, Any]) -> Record:
    if body["format"] != FORMAT:
        raise ValueError(f"format {body['format']}")
    entries = tuple(
        Entry(**{**one, "hosts": tuple(one["hosts"]), "former": tuple(one.get("former", ()))})
        for one in body["entries"]
    )
    trusted = tuple(str(one) for one in body["trusted"])
    lives = tuple((str(name), int(life)) for name, life in body.get("lives", ()))
    return Record(
        fleet=str(body["fleet"]),
        number=int(body["number"]),
        trusted=trusted,
        entries=entries,
        lives=lives,
        creation=str(body.get("creation", "")),
    )


def key_name(number: int) -> str:
    """The file of an authority's key.

    >>> key_name(1)
    'ca-1.key'
    """
    return f"ca-{number}.key"


def _by_label(entry: Entry) -> str:
    return entry.label


def day(seconds: int) -> str:
    """A time as a date, UTC.

    >>> day(0)
    '1970-01-01'
    """
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%d}"


def _seconds(now: datetime) -> int:
    return int(now.timestamp())
