"""`zsched pki`: makes the fleet's authority and its certificates, and says where each file goes.

Knows: folders, what an operator does next. Does not know: how certificates are made (`zsched.pki`), which names are
let in.
"""

from __future__ import annotations

import contextlib
import getpass
import os
import warnings
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from zsched.commands.base.ask import Door, ask_door, find_door, fleet_here
from zsched.commands.base.common import (
    CliError,
    Json,
    check_dangers,
    check_name,
    interruptible,
    nearest,
    print_json,
    say,
    warn,
)
from zsched.commands.base.options import AskedOption, ConfigOption, JsonOption, Options, RuntimeOption, new_group
from zsched.commands.base.renewing import holds_authority, renew_advice
from zsched.config.load import load_fleet
from zsched.core.values.certificates import Holder, Role, parse_common_name, parse_label
from zsched.core.values.errors import AdapterError
from zsched.core.values.exits import EXIT_FAILED, EXIT_OK, EXIT_USAGE
from zsched.core.values.fleet import Fleet
from zsched.core.values.struct import Struct
from zsched.host import paths as places
from zsched.host.clock import wall_ns
from zsched.host.files import read_regular
from zsched.link.sessions.certificate import common_names, ders_of
from zsched.link.sessions.secured import CERTIFICATE, CREDENTIALS, KEY, TRUSTED

if TYPE_CHECKING:
    from zsched.pki.authority import Authority, Entry, Issued  # imports cryptography

SCHEMA: Final = "zsched.pki.show/1"
PASSPHRASE: Final = "ZSCHED_AUTHORITY_PASSPHRASE"
HANDED: Final = "passphrase"
"""Of systemd (``LoadCredential=``, systemd.exec(5)): a unit's environment is told to everybody on the machine."""
MAX_BYTES: Final = 1 << 20
SENT, HAD = "ok", "unchanged"
"""How a node answers to its certificate."""
SECOND: Final = "second-authority"
"""The danger: nobody lets in by the certificates of an authority that the nodes do not know."""
DANGERS: Final = (SECOND,)
DUE, REVOKED, ENDED, VALID = "due", "revoked", "ended", "valid"


AuthorityOption = Annotated[
    Path | None,
    typer.Option("--authority", metavar="DIR", help="Its folder. [ZSCHED_AUTHORITY, else below ~/.local/share/zsched]"),
]


RequestOption = Annotated[
    Path | None,
    typer.Option("--csr", metavar="FILE", help="A certificate request: the key stays where it was made."),
]


OutOption = Annotated[Path | None, typer.Option("--out", "-o", metavar="DIR", help="Where the files go. [./NAME]")]


LabelArgument = Annotated[str, typer.Argument(metavar="NAME", help="As `zsched pki show` names it: robot1, robot1.k2.")]


class Where(Options):
    """Which authority is meant, and of which fleet."""

    config: ConfigOption = None
    authority: AuthorityOption = None


class _Office(Struct, frozen=True, kw_only=True):
    """Which fleet's authority, and where it is."""

    fleet: Fleet
    folder: Path


def init(
    where: Where,
    passphrase: Annotated[
        bool, typer.Option("--passphrase", help="Lock its key. [ZSCHED_AUTHORITY_PASSPHRASE, else it asks]")
    ] = False,
    accept: Annotated[
        list[str] | None,
        typer.Option("--accept", metavar="DANGER", help="second-authority: the fleet's own is lost for good."),
    ] = None,
) -> int:
    """Make the fleet's authority: a key that signs certificates, on this machine only.

    Example: sudo zsched pki init

    Refused where this machine trusts an authority already: that one is on another machine, and signs for the fleet.
    """
    from zsched.pki.authority import create  # noqa: PLC0415 - imports cryptography

    check_dangers(accept or (), DANGERS)
    office = _office(where)
    is_taken = SECOND in (accept or ())
    if (trusted := _trusted_here(office.fleet)) and not is_taken and not places.has_authority(office.folder):
        advice = f"if that is lost for good (docs/guide/secure.md): --accept {SECOND}"
        said = f"a second authority makes certificates by which nobody is let in; {advice}"
        raise CliError(EXIT_FAILED, f"{_elsewhere(office.fleet, trusted)}; {said}")
    secret = new_secret(is_wanted=passphrase)
    authority = create(office.folder, office.fleet.name, secret, now_here())
    lock = "locked with the passphrase" if secret else "not locked: --passphrase does that"
    first = office.fleet.nodes[0].name
    _say(
        f"{office.folder}: authority of fleet {office.fleet.name}\n"
        f"its key is {authority.key_path} ({lock}); no node needs it. To take it offline, move the whole folder to a "
        "stick, and name it with --authority DIR when you issue, renew or revoke",
        ""
        if office.fleet.security is not None
        else "next: write `security: {}` and tls/ in place of tcp/ into the fleet file",
        f"next: `zsched pki issue {first}`, and so for every node",
        renew_advice(office.folder, office.fleet.name, is_locked=bool(secret)),
    )
    return EXIT_OK


def issue(
    where: Where,
    name: Annotated[str, typer.Argument(metavar="NAME", help="A node of the fleet file, or a person or tool.")],
    role: Annotated[Role, typer.Option("--role", help="What NAME is.")] = Role.NODE,
    csr: RequestOption = None,
    out: OutOption = None,
) -> int:
    """Make the key and the first certificate of a node, an operator or a guest; it lasts 30 days.

    Example: sudo zsched pki issue robot2

    Nodes may do what zsched does. An operator may also give commands from a machine that is no node. A guest reads
    status and streams.
    """
    with _opened(where) as (office, authority):
        check_trusted(office.fleet, authority)
        hosts = hosts_of(office.fleet, name, role)
        asked, now = read_request(csr), now_here()
        holder = authority.next_holder(name, role, asked, now)
        folder = out or Path(holder.label)
        _check_free(folder, office.fleet.name, holder, makes_key=csr is None)
        issued = authority.issue(name, role, hosts, asked, passphrase_of(authority), now)
        _write(folder, issued)
    files = f"{CERTIFICATE}, {TRUSTED}" + (f", {KEY}" if issued.key else "")
    _say(f"{folder}: {files} of {issued.entry.label}, until {_day(issued.entry)}")
    _say(_how_to_install(folder, role, has_key=bool(issued.key)), _lacking(office.fleet, name, role))
    return EXIT_OK


class Known(Struct, frozen=True, kw_only=True):
    """What the authority on this machine tells of its fleet."""

    folder: Path
    others: tuple[str, ...]
    """Nodes that have a certificate, and are not in the fleet file here."""


@contextlib.contextmanager
def held_here(fleet: str, given: Path | None) -> Iterator[Authority | None]:
    """The authority of a fleet on this machine; ``None``: there is none.

    Raises:
        AdapterError: it cannot be used.
    """
    folder = holds_authority(fleet, given)
    if folder is None:
        yield None
        return
    from zsched.pki.authority import opened  # noqa: PLC0415 - imports cryptography

    with opened(folder, fleet) as authority:
        yield authority


def known_here(fleet: Fleet) -> Known | None:
    """What the authority here tells of a fleet that had a state; ``None``: there is none, or it tells of none.

    `zsched fleet create` makes it together with a state, and by hand it is made before any state.
    """
    with contextlib.suppress(AdapterError, OSError), held_here(fleet.name, None) as authority:
        if authority is not None and fleet.security is not None:
            record, named = authority.record, {node.name for node in fleet.nodes}
            live = {one.holder.name for one in record.entries if one.revoked is None and one.holder.role is Role.NODE}
            others = tuple(sorted(live - named))
            return Known(folder=authority.folder, others=others) if record.creation or others else None
    return None


def renew(
    where: Where,
    name: Annotated[str | None, typer.Argument(metavar="[NAME]", help="Only this one. [all that are due]")] = None,
    csr: RequestOption = None,
    out: OutOption = None,
    deliver: Annotated[
        bool, typer.Option("--deliver", help="Send each node its newest one, through the daemon here; no files.")
    ] = False,
    node: AskedOption = None,
    runtime_dir: RuntimeOption = None,
) -> int:
    """Make new certificates for keys that have one. A certificate is due after two thirds of its life.

    Example: sudo zsched pki renew --deliver

    With --deliver the nodes take them by themselves; the timer zsched-renew does that every day.
    """
    if deliver:
        if csr is not None or out is not None:
            raise CliError(EXIT_USAGE, "--csr and --out go without --deliver")
        return _deliver(where, find_door(runtime_dir, node), name)
    if name is None and (csr is not None or out is not None):
        raise CliError(EXIT_USAGE, "--csr and --out go with a NAME")
    with _opened(where) as (office, authority):
        secret = passphrase_of(authority)
        now = int(now_here().timestamp())
        live = [one for one in authority.record.entries if one.revoked is None]
        labels = [one.label for one in live if one.is_due(now, authority.record.number)] if name is None else [name]
        hosts = {node.name: (node.host,) if node.host else () for node in office.fleet.nodes}
        for one in labels:
            holder, folder = parse_label(one), out or Path(one)
            if holder is not None:
                _check_free(folder, office.fleet.name, holder, makes_key=False)
            named = hosts.get(holder.name) if holder is not None and holder.role is Role.NODE else None
            issued = authority.renew(one, named, read_request(csr), secret, now_here())
            _write(folder, issued)
            _say(f"{folder}: {CERTIFICATE}, {TRUSTED} of {one}, until {_day(issued.entry)}")
    if labels:
        _say("next: put both files beside its key; within a minute its daemon begins anew with them, in its turn")
    else:
        _say("no certificate is due")
    return EXIT_OK


def _deliver(where: Where, door: Door, label: str | None) -> int:
    """Renew what is due, or one label, and send every node its newest certificate; the exit code.

    A node that was away gets it the next time. What the fleet has no node for is named, and not renewed.

    Raises:
        CliError: there is no such node's key, the fleet has no such node (any more), nobody answers here, or who does
            is of another fleet.
        AdapterError: a file is not usable.
    """
    if door.cell is not None:
        advice = f"give the command where the authority of {door.cell.name} is, on a machine with a daemon of it"
        raise CliError(EXIT_USAGE, f"--node: {door.cell.name} is another fleet of the site; {advice}")
    status = ask_door(door, {"verb": "status"})
    members = {str(one["name"]) for one in status["nodes"]}
    with _opened(where) as (_, authority):
        _check_fleet(status, authority)
        _see_anew(door, authority, members)
        now, number = int(now_here().timestamp()), authority.record.number
        live = [one for one in authority.record.entries if one.revoked is None and one.holder.role is Role.NODE]
        named = [one for one in live if label in (None, one.label)]
        if not named and label is not None:
            hint = nearest(label, [one.label for one in live])
            raise CliError(EXIT_USAGE, f"no node's key {label!r} that is not revoked{hint}")
        if label is not None and named[0].holder.name not in members:
            advice = f"`zsched pki renew {label}` writes it to a file, `zsched pki revoke {label}` ends it"
            said = f"{label}: the fleet has no node {named[0].holder.name}; nothing was renewed or sent"
            raise CliError(EXIT_FAILED, f"{said}: {advice}")
        wanted = [one for one in named if one.label == label or one.is_due(now, number)]
        for stray in [one for one in wanted if one.holder.name not in members]:
            told = f"{stray.label}: due, and not renewed: the fleet has no node {stray.holder.name}"
            _say(f"{told}; `zsched pki revoke {stray.label}` ends it")
        due = [one.label for one in wanted if one.holder.name in members]
        secret = passphrase_of(authority) if due else b""
        for one in due:
            authority.renew(one, None, b"", secret, now_here())
        newest = [entry for one in named if (entry := authority.record.entry(one.label)) is not None]
    results = [_send(door, entry) for entry in newest if entry.holder.name in members]
    return EXIT_OK if all(one in (SENT, HAD) for one in results) else EXIT_FAILED


def _check_fleet(status: Json, authority: Authority) -> None:
    """Refuse to go by the nodes of another fleet: this one's keys would look as if nobody had them.

    Raises:
        CliError: the daemon that answers is of another fleet.
    """
    told, own = str(status.get("fleet", "")), authority.record.fleet
    if told != own:
        advice = "say with --node or ZSCHED_NODE which daemon is meant, or which fleet by --config"
        raise CliError(
            EXIT_USAGE, f"{authority.folder} is the authority of fleet {own}, and who answers is of {told}; {advice}"
        )


def _see_anew(door: Door, authority: Authority, members: set[str]) -> None:
    """Refuse to send certificates of a new authority while a node's sessions are older than it.

    Such a node lets nobody in by them, so those that go by theirs would be cut off from it.

    Raises:
        CliError: some nodes have not begun anew since the rotation began.
    """
    if not authority.is_rotating:
        return
    age_s, before, old = (now_here() - authority.since).total_seconds(), dict(authority.record.lives), []
    for name in sorted(members):
        with contextlib.suppress(CliError):  # it is away
            status = ask_door(Door(socket=door.socket, node=name), {"verb": "status"})
            if name in before:
                is_old = status.get("incarnation") == before[name]
            else:  # the wall clock may have been set since: it is asked only where nobody has seen the life before
                is_old = float(status.get("up_s", 0.0)) > age_s
            old += [name] if is_old else []
    if old:
        told = f"{', '.join(old)}: not begun anew since the new authority was made, and would cut off who goes by it"
        advice = f"put {TRUSTED} there, and wait until `up` in its `zsched status` begins again"
        raise CliError(EXIT_FAILED, f"nothing was sent: {told}; {advice}")


def _send(door: Door, entry: Entry) -> str:
    """Send a node its certificate: `SENT`, `HAD` (it had it before), or why not."""
    there = Door(socket=door.socket, node=entry.holder.name)
    try:
        answer = ask_door(there, {"verb": "certificate", "certificate": entry.certificate})
    except CliError as error:
        warn(f"{entry.label}: {error}")
        return "silent"
    _say(f"{entry.label}: {answer['detail']}")
    return str(answer["outcome"])


def show(
    where: Where,
    json_: JsonOption = False,
) -> int:
    """List every key that was certified: until when, and whether it is due, revoked or ended.

    Example: sudo zsched pki show
    """
    with _opened(where) as (office, authority):
        body = _as_json(office, authority)
    if json_:
        print_json(body)
        return EXIT_OK
    lines = [
        f"authority {body['authority']} of fleet {body['fleet']} in {body['folder']}"
        + (", key locked" if body["locked"] else "")
        + (" (a rotation is not finished: the former one is trusted, too)" if body["rotating"] else "")
    ]
    width = max((len(one["name"]) for one in body["certificates"]), default=0)
    lines += [
        f"{one['name']:<{width}}  {one['role']:<8}  until {one['until'][:10]}  {one['state']}"
        for one in body["certificates"]
    ]
    _say(*lines)
    return EXIT_OK


def revoke(where: Where, name: LabelArgument) -> int:
    """Never certify a key again, and say which line of the fleet file keeps it out.

    Example: sudo zsched pki revoke robot2
    """
    with _opened(where) as (office, authority):
        entry = authority.revoke(name, now_here())
        security = office.fleet.security
        revoked = sorted({*(security.revoked if security else ()), name})
    name, role = entry.holder.name, entry.holder.role
    _say(
        f"{name} is revoked: its key is never certified again",
        f"it is let in until every node goes by a fleet file with `security: {{revoked: [{', '.join(revoked)}]}}`, "
        "or without the name: zsched edit (or the file everywhere, and systemctl reload); daemons begin anew in turn",
        f"`zsched pki issue {name}{'' if role is Role.NODE else f' --role {role}'}` makes a new key for the name",
    )
    return EXIT_OK


def rotate(
    where: Where,
    finish: Annotated[bool, typer.Option("--finish", help="Stop trusting the former authority.")] = False,
) -> int:
    """Begin with a new authority. Both are trusted until --finish, which waits for every certificate to be renewed.

    Example: sudo zsched pki rotate
    """
    with _opened(where) as (_, authority):
        if not finish:
            authority.rotate(passphrase_of(authority), now_here(), _lives(authority.record.fleet))
            _say(
                f"authority {authority.record.number} signs from now on; the former one is trusted until the end",
                f"1. put {authority.folder / TRUSTED} on every machine as {TRUSTED}, and wait until each daemon has "
                "begun anew, in its turn: its `up` in `zsched status` begins again",
                "2. `zsched pki renew`: put every new certificate in its place, and wait likewise "
                "(with --deliver the nodes get theirs by themselves)",
                f"3. `zsched pki rotate --finish`; put {TRUSTED} on every machine once more",
            )
            return EXIT_OK
        left = authority.left()
        if left:
            names = ", ".join(one.label for one in left)
            raise CliError(
                EXIT_FAILED, f"the former authority has signed the certificates of {names}: `zsched pki renew` first"
            )
        _see_delivered(authority)
        authority.finish()
        _say(
            "the former authority is not trusted any more, and its key is deleted",
            f"next: put {authority.folder / TRUSTED} on every machine as {TRUSTED}: daemons begin anew in turn",
        )
    return EXIT_OK


def _lives(fleet: str) -> dict[str, int]:
    """{node: its incarnation}, of those that the fleet's daemon here hears; empty: there is none.

    Raises:
        CliError: as `_told_here`.
    """
    here = _told_here(fleet)
    nodes = here[1]["nodes"] if here is not None else ()
    return {str(one["name"]): one["incarnation"] for one in nodes if one.get("incarnation") is not None}


def _told_here(fleet: str) -> tuple[Door, Json] | None:
    """The door of the fleet's daemon here and its status; ``None``: none runs here, or only one of another fleet.

    One that runs and does not answer is not "none": a rotation that goes on without it would cut nodes off unseen.

    Raises:
        CliError: it does not answer, refuses, is not the one that is meant, or there are several and none is meant.
    """
    if not places.local_sockets(places.asked_folder(None, os.environ)):
        return None
    door = find_door(None, None)
    told = ask_door(door, {"verb": "status"})
    return (door, told) if told.get("fleet") == fleet else None


def _see_delivered(authority: Authority) -> None:
    """Refuse to go on while a node of the fleet has no certificate of the new authority: the others would not know it.

    Raises:
        CliError: some have not, or do not answer.
    """
    here = _told_here(authority.record.fleet)
    if here is None:
        _say("no daemon of the fleet answers here: nobody has seen whether every node has its new certificate")
        return
    door, told = here
    members = {str(one["name"]) for one in told["nodes"]}
    _see_anew(door, authority, members)
    live = [one for one in authority.record.entries if one.revoked is None and one.holder.role is Role.NODE]
    results = {one.label: _send(door, one) for one in live if one.holder.name in members}
    if lacking := [label for label, result in results.items() if result not in (SENT, HAD)]:
        advice = "bring them, then again; of a machine that never comes back: `zsched pki revoke`"
        raise CliError(
            EXIT_FAILED, f"{', '.join(lacking)}: no certificate of the new authority there, so it stays; {advice}"
        )
    if sent := [label for label, result in results.items() if result == SENT]:
        raise CliError(EXIT_FAILED, f"{', '.join(sent)}: sent just now; again once the daemon there has begun anew")


# --- parts -----------------------------------------------------------------------------------------------------------


def _office(where: Where) -> _Office:
    """The authority of the fleet in the fleet file; its names are those of the document, if a daemon here tells one.

    Raises:
        ConfigError: the fleet file cannot be used.
    """
    path = places.config_path(where.config, os.environ)
    fleet = load_fleet(path)
    with contextlib.suppress(CliError):  # none runs here, or nothing says which one is meant
        held = fleet_here(find_door(None, None), path)
        fleet = held if held.name == fleet.name else fleet
    return _Office(fleet=fleet, folder=places.authority_folder(where.authority, os.environ, fleet.name))


@contextlib.contextmanager
def _opened(where: Where) -> Iterator[tuple[_Office, Authority]]:
    from zsched.pki.authority import opened  # noqa: PLC0415 - imports cryptography

    office = _office(where)
    if (trusted := _trusted_here(office.fleet)) and not places.has_authority(office.folder):
        raise AdapterError(f"there is no authority in {office.folder}; {_elsewhere(office.fleet, trusted)}")
    with opened(office.folder, office.fleet.name) as authority:
        yield office, authority


def _trusted_here(fleet: Fleet) -> Path | None:
    """The file of authorities that this machine trusts; ``None``: it trusts none, or the fleet has no certificates."""
    path = None if fleet.security is None else Path(fleet.security.folder) / TRUSTED
    return path if path is not None and path.exists() else None


def _elsewhere(fleet: Fleet, trusted: Path) -> str:
    """That a fleet has an authority, which is not here, and how to get at it."""
    how = "give the command there, bring its folder here, or name it with --authority DIR"
    return f"fleet {fleet.name} has an authority already ({trusted} names it), on another machine or a stick: {how}"


def check_trusted(fleet: Fleet, authority: Authority) -> None:
    """Refuse an authority that this machine does not trust: nobody would let in by its certificates.

    Raises:
        CliError: no certificate of it is among those that are trusted here.
        AdapterError: those cannot be read.
    """
    path = _trusted_here(fleet)
    if path is None:
        return
    try:
        known = set(ders_of(read_regular(path, MAX_BYTES)))
    except (OSError, ValueError) as error:
        raise AdapterError(f"{path}: {error}; bring it back from another node") from error
    if known.isdisjoint(ders_of(authority.trusted)):
        how = "name the fleet's own with --authority DIR"
        after = f"if this one is new (a rotation, or the former one is lost), put {authority.folder / TRUSTED} there"
        told = f"{authority.folder} holds an authority that {path} does not know"
        raise CliError(EXIT_FAILED, f"{told}, so nobody lets in by its certificates: {how}; {after}")


def check_held(fleet: Fleet, given: Path | None) -> None:
    """As `check_trusted`, of the authority on this machine, if there is one.

    Raises:
        CliError: it is not trusted here.
        AdapterError: it cannot be used.
    """
    with held_here(fleet.name, given) as authority:
        if authority is not None and fleet.security is not None:
            check_trusted(fleet, authority)


def hosts_of(fleet: Fleet, name: str, role: Role) -> tuple[str, ...]:
    """At which addresses the holder is dialled, by the fleet file."""
    check_name(name)
    nodes = {node.name: node for node in fleet.nodes}
    if role is Role.NODE and name not in nodes:
        hint = nearest(name, sorted(nodes))
        raise CliError(EXIT_USAGE, f"fleet {fleet.name} has no node {name!r}{hint}; for people: --role operator")
    if role is not Role.NODE and name in nodes:
        raise CliError(EXIT_USAGE, f"{name!r} is a node; give people and tools names of their own")
    return (nodes[name].host,) if role is Role.NODE and nodes[name].host else ()


def _lacking(fleet: Fleet, name: str, role: Role) -> str:
    """What the fleet file lacks for this holder to be let in; empty: nothing."""
    security = fleet.security
    if security is None:
        return "next: write a `security:` section into the fleet file; without it no certificate is asked for"
    named = {Role.NODE: [name], Role.OPERATOR: security.operators, Role.GUEST: security.guests}[role]
    if name in named:
        return ""
    return (
        f"next: write {name} under `security: {{{role}s: [...]}}` with `zsched edit` (or in every fleet file); "
        "who it is gets in once the daemons have begun anew"
    )


def _how_to_install(folder: Path, role: Role, *, has_key: bool) -> str:
    if role is not Role.NODE:
        return (
            "next: bring that folder to the machine as `pki`, beside a fleet file (`zsched fleet export`), and there: "
            "ZSCHED_CONFIG=fleet.yaml zsched status --connect tls/NODE"
        )
    if not has_key:
        return f"next, on the node: sudo install -m 644 {folder}/*.pem /etc/zsched/pki/ (its key lies there already)"
    return (
        "next: bring that folder to the node, and there:\n"
        "  sudo install -d -m 755 /etc/zsched/pki\n"
        f"  sudo install -m 644 {folder}/{CERTIFICATE} {folder}/{TRUSTED} /etc/zsched/pki/\n"
        f"  sudo install -m 600 {folder}/{KEY} /etc/zsched/pki/ && rm -r {folder}\n"
        "then delete the folder here, too"
    )


def _check_free(folder: Path, fleet: str, holder: Holder, *, makes_key: bool) -> None:
    """Refuse to write over somebody else's certificate, or over a key, of which there may be no other copy.

    Raises:
        CliError: such a file is in the folder.
    """
    try:
        names = common_names(read_regular(folder / CERTIFICATE, MAX_BYTES))
    except (OSError, ValueError):
        names = ()
    found = parse_common_name(names[0], fleet) if names else None
    is_other = bool(names) and (found is None or (found.name, found.role) != (holder.name, holder.role))
    taken = CERTIFICATE if is_other else KEY if makes_key and (folder / KEY).exists() else ""
    if taken:
        whose = f" ({names[0]})" if names else ""
        raise CliError(
            EXIT_FAILED,
            f"{folder / taken}{whose} is there, and is left as it is; give another folder with --out, or move it away",
        )


def _write(folder: Path, issued: Issued) -> None:
    from zsched.host.key_files import PRIVATE, PUBLIC, make_folder, write_whole  # noqa: PLC0415 - as above

    try:
        make_folder(folder)
        if issued.key:  # first: a certificate without its key would look complete
            write_whole(folder / KEY, issued.key, PRIVATE)
        write_whole(folder / TRUSTED, issued.trusted, PUBLIC)
        write_whole(folder / CERTIFICATE, issued.certificate, PUBLIC)
    except OSError as error:
        label = issued.entry.label
        again = (
            f"the authority has recorded {label}: `zsched pki revoke {label}`, then again"
            if issued.key
            else f"the authority has recorded the certificate, so it is not due any more: `zsched pki renew {label}` "
            "writes it again"
        )
        raise AdapterError(f"{folder}: cannot be written: {error.strerror}; {again}") from error


def read_request(path: Path | None) -> bytes:
    """A certificate request in a file; empty: none is named.

    Raises:
        AdapterError: it cannot be read.
    """
    if path is None:
        return b""
    try:
        return read_regular(path, MAX_BYTES) or b"-"
    except OSError as error:
        raise AdapterError(f"{path}: cannot be read: {error.strerror}") from error


def passphrase_of(authority: Authority) -> bytes:
    """What opens its key. Raises `CliError`: nobody types it."""
    if not authority.is_locked:
        return b""
    if PASSPHRASE in os.environ:
        return os.environ[PASSPHRASE].encode()
    if (given := os.environ.get(CREDENTIALS)) and (path := Path(given) / HANDED).exists():
        return read_regular(path, MAX_BYTES).removesuffix(b"\n")
    return _asked(f"Passphrase of {authority.key_path}")


def new_secret(*, is_wanted: bool) -> bytes:
    """What locks a new key; empty: nothing."""
    given = os.environ.get(PASSPHRASE, "").encode()
    return given or (_asked("Passphrase of the new key", is_new=True) if is_wanted else b"")


def _asked(what: str, *, is_new: bool = False) -> bytes:
    try:
        with interruptible(), warnings.catch_warnings(action="ignore", category=getpass.GetPassWarning):  # no terminal
            text: str = typer.prompt(what, hide_input=True, confirmation_prompt=is_new, err=True)
    except typer.Abort:
        text = f"nobody has typed it ({what}): run this on a terminal, or set {PASSPHRASE}"
        raise CliError(EXIT_FAILED, text) from None
    return text.encode()


def _as_json(office: _Office, authority: Authority) -> Json:
    now, record = now_here(), authority.record
    return {
        "schema": SCHEMA,
        "fleet": record.fleet,
        "folder": str(office.folder),
        "authority": record.number,
        "rotating": authority.is_rotating,
        "locked": authority.key_path.exists() and authority.is_locked,
        "certificates": [
            {
                "name": one.label,
                "role": str(one.holder.role),
                "key": one.holder.key,
                "fingerprint": one.fingerprint,
                "issued": _iso(one.issued),
                "until": _iso(one.until),
                "revoked": None if one.revoked is None else _iso(one.revoked),
                "state": _state(one, int(now.timestamp()), record.number),
            }
            for one in record.entries
        ],
    }


def _state(entry: Entry, now: int, number: int) -> str:
    if entry.revoked is not None:
        return REVOKED
    if now > entry.until:
        return ENDED
    return DUE if entry.is_due(now, number) else VALID


def _iso(seconds: int) -> str:
    return datetime.fromtimestamp(seconds, UTC).isoformat().replace("+00:00", "Z")


def _day(entry: Entry) -> str:
    return _iso(entry.until)[:10]


def now_here() -> datetime:
    """By this machine's clock."""
    return datetime.fromtimestamp(wall_ns() / 1e9, UTC)


def _say(*lines: str) -> None:
    if shown := [line for line in lines if line]:
        say("\n".join(shown))


pki = new_group(
    "pki",
    "The fleet's authority and its certificates.",
    {"init": init, "issue": issue, "show": show, "renew": renew, "revoke": revoke, "rotate": rotate},
)
