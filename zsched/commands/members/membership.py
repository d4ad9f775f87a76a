"""`zsched fleet create`, `zsched invite` and `zsched join`: how a fleet begins, and how a machine comes into it.

Knows: what is asked of an operator, what is said in the end. Does not know: which files a machine keeps
(`zsched.commands.members.belongings`), how a change is agreed (`zsched.commands.act.apply`).
"""

from __future__ import annotations

import errno
import ipaddress
import os
import shlex
import stat
import sys
from collections.abc import Sequence
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Final

import typer

from zsched.commands.act.apply import apply_change
from zsched.commands.base.ask import CONTROL_PORT, Door, ask_door
from zsched.commands.base.change import DOCUMENT, HERE, InForce, document_text, fleet_of, in_force, status_of
from zsched.commands.base.common import CliError, Json, again, check_name, nearest, print_json, say, uninterrupted, warn
from zsched.commands.base.options import AcceptOption, Edits, Files, Here, JsonOption, OutputOption, PlanOption
from zsched.commands.base.places import Places
from zsched.commands.members.belongings import (
    Written,
    found,
    is_joined,
    is_of_a_later_key,
    mend,
    take_later_key,
)
from zsched.commands.members.belongings import join as join_here
from zsched.commands.members.papers import (
    FirstPapers,
    ask_for_certificate,
    check_request,
    key_to_papers,
    keys_to_revoke,
    papers_for,
    refuse_open_network,
)
from zsched.commands.members.pki import check_held
from zsched.commands.members.unfinished import unfinished
from zsched.config.editing import add_entries, add_names, is_list
from zsched.core.values.codec import from_plain
from zsched.core.values.document import Document
from zsched.core.values.electorate import FleetValue
from zsched.core.values.endpoint import Endpoint, is_loopback
from zsched.core.values.errors import WireError, ZschedError
from zsched.core.values.exits import EXIT_FAILED, EXIT_OK, EXIT_USAGE, EXIT_WOULD_CHANGE
from zsched.core.values.fleet import Fleet
from zsched.core.values.model import NodeId, NodeKind
from zsched.core.values.struct import Struct
from zsched.host import paths as places
from zsched.host.files import read_regular
from zsched.host.key_files import write_whole
from zsched.link.invitation import MAX_BYTES, Invitation, decode_invitation, encode_invitation
from zsched.link.sessions.own_addresses import addresses_at
from zsched.link.sessions.roaming import ANY_HOST, addresses_towards

SCHEMA: Final = "zsched.member/1"
PRIVATE: Final = 0o600
SECURED: Final = "tls"
REVOKED: Final = ("security", "revoked")
"""Where a document lists keys that are not let in."""
LOCAL_PORT_AFTER: Final = 3
"""The port of a host's applications comes after those of its two sessions and of `zsched web`."""
MAX_PORT: Final = 65_535


class Told(Struct, frozen=True, kw_only=True):
    """What a verb of these has done to this machine, or would do."""

    fleet: str
    node: NodeId
    outcome: str
    """created, joined, left, planned, requested, or unchanged."""
    said: str
    """One line for people."""
    files: tuple[Written, ...] = ()
    next: tuple[str, ...] = ()

    def tell(self, *, is_json: bool, is_line: bool = False) -> int:
        """Print it, and return the exit code; ``is_line``: its JSON on one line, behind others."""
        code = EXIT_WOULD_CHANGE if self.outcome == "planned" else EXIT_OK
        if is_json:
            files = [{"path": str(one.path), "what": one.what} for one in self.files]
            body: Json = {"schema": SCHEMA, "fleet": self.fleet, "node": self.node, "outcome": self.outcome}
            print_json({**body, "files": files, "next": list(self.next)}, is_line=is_line)
            return code
        lines = [self.said, *(f"  {one.path}: {one.what}" for one in self.files)]
        lines += [f"next: {one}" for one in self.next]
        for line in lines:
            say(line, indent=4)
        return code


# --- addresses -------------------------------------------------------------------------------------------------------


class Address(Struct, frozen=True, kw_only=True):
    """Where a node is dialled: its control session at ``port``, its data session at the next one."""

    host: str
    port: int = CONTROL_PORT

    @property
    def listened_host(self) -> str:
        """At which of the machine's addresses its sessions listen: at all of them, but for a loopback address."""
        return self.host if is_loopback(self.host) else "::" if ":" in self.host else "0.0.0.0"  # noqa: S104 - a robot's

    def entry(self, protocol: str) -> str:
        """The part of a node's entry in the fleet file that says so."""
        end = Endpoint(protocol=protocol, address="")
        ports = {"control": self.port, "data": self.port + 1}
        listen = ", ".join(f'{kind}: "{end.at(self.listened_host, port)}"' for kind, port in ports.items())
        return f'host: "{self.host}", listen: {{{listen}}}'


def address_of(text: str) -> Address:
    """An address out of what people write: ``HOST``, ``HOST:PORT``, ``[IPV6]:PORT``.

    >>> address_of("192.0.2.11"), address_of("[2001:db8::1]:7500").port
    (Address(host='192.0.2.11', port=7457), 7500)

    Raises:
        CliError: it is none.
    """
    host, port, is_closed = text, "", True
    if text.startswith("["):
        host, bracket, port = text[1:].partition("]")
        is_closed = bool(bracket) and (not port or port.startswith(":"))
        port = port.removeprefix(":")
    elif text.count(":") == 1:
        host, _, port = text.partition(":")
    is_port = not port or (port.isascii() and port.isdigit() and len(port) <= len(str(MAX_PORT)))
    is_good = bool(host) and is_closed and is_port and not set(host) & set(' "/{}\\')
    advice = f"write HOST or HOST:PORT, as 192.0.2.11 or robot4.local:{CONTROL_PORT}"
    if not is_good or not 0 < int(port or CONTROL_PORT) < MAX_PORT:
        raise CliError(EXIT_USAGE, f"--address: {text!r} is no address; {advice}")
    if _is_of_nobody(host):
        raise CliError(EXIT_USAGE, f"--address: {host} is no address of one machine; {advice}")
    return Address(host=host, port=int(port or CONTROL_PORT))


def _is_of_nobody(host: str) -> bool:
    """Whether a host is an address that no node can dial: of all interfaces, of a group, or of everybody."""
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return False
    return address.is_unspecified or address.is_multicast or host == "255.255.255.255"


def own_address(root: Path = Path("/")) -> str:
    """The address at which others dial this machine: the one that its default route uses, else the only one it has.

    ``root`` is "/" but in tests.

    Raises:
        CliError: it has none, or several.
    """
    if routed := addresses_towards((ANY_HOST,)):
        return routed[0]
    everywhere = "0.0.0.0"  # noqa: S104 - nothing listens
    found = [one for one in addresses_at(root, everywhere) if not one.is_loopback and not one.is_link_local]
    if not found:
        raise CliError(EXIT_FAILED, "this machine has no address in a network: connect it, or give one with --address")
    if len(found) > 1:
        here = ", ".join(map(str, found))
        raise CliError(EXIT_FAILED, f"which of its addresses do others dial? Give one with --address (here: {here})")
    return str(found[0])


def _entry_of(name: str, kind: NodeKind, address: Address | None, protocol: str) -> str:
    more = "" if address is None else f", {address.entry(protocol)}"
    if protocol == SECURED and kind is NodeKind.ROBOT:  # its applications have no certificate
        port = (CONTROL_PORT if address is None else address.port) + LOCAL_PORT_AFTER
        more += f', local: {{mode: peer, listen: ["tcp/127.0.0.1:{port}"]}}'
    return f"  {name}: {{kind: {kind.value}{more}}}\n"


class Profile(StrEnum):
    """The clocks of the protocol."""

    WIRED = "wired"
    WIFI = "wifi"
    WAN = "wan"


AddressHelp = "HOST or HOST:PORT of its control session; its data session has the next port."


# --- create ----------------------------------------------------------------------------------------------------------


SECURITY_TEXT: Final = """\
# Only holders of this fleet's certificates are let in. `operators: [NAME]` are people who command from elsewhere.
security: {}
"""


def create(
    here: Here,
    name: Annotated[str, typer.Argument(metavar="NAME", help="The new fleet's name.")],
    kind: Annotated[
        NodeKind, typer.Option("--kind", "--role", help="A robot votes and has streams; an edge only works.")
    ] = NodeKind.ROBOT,
    address: Annotated[str | None, typer.Option("--address", metavar="ADDRESS", help=f"{AddressHelp} [found]")] = None,
    timing: Annotated[Profile, typer.Option("--timing", help="The clocks of the protocol.")] = Profile.WIFI,
    insecure: Annotated[
        bool, typer.Option("--insecure", help="Without certificates: whoever reaches the network changes everything.")
    ] = False,
    authority: Annotated[
        Path | None,
        typer.Option("--authority", metavar="DIR", help="Where the fleet's authority goes. [as of zsched pki]"),
    ] = None,
    passphrase: Annotated[
        bool, typer.Option("--passphrase", help="Lock its key. [ZSCHED_AUTHORITY_PASSPHRASE, else it asks]")
    ] = False,
    accept: AcceptOption = None,
    plan: PlanOption = False,
    json_: JsonOption = False,
) -> int:
    """Make this machine the first one of a new fleet: writes its fleet file, state, authority and certificate.

    Example: sudo zsched fleet create hall

    Refused where a fleet file or a state is. A fleet of one works; `zsched invite` brings the next machine.
    """
    node, where = places.node_name(here.node, os.environ), here.places()
    check_name(name)
    check_name(node, "--node")
    own = Address(host=own_address()) if address is None else address_of(address)
    if insecure:
        refuse_open_network((own.host, own.listened_host), accept or ())
    papers = None if insecure else FirstPapers(name, node, authority, asks_passphrase=passphrase)
    certify = None if papers is None else papers.certify
    text = (
        f"fleet: {name}\n"
        f"timing: {timing}\n"
        "# Each node dials those before it in this list; `zsched invite` adds to its end.\n"
        f"seeds: [{node}]\n"
        "nodes:\n"
        f"{_entry_of(node, kind, own, 'tcp' if insecure else SECURED)}"
        "tasks: {}\n"
        f"{'' if insecure else SECURITY_TEXT}"
    )
    try:
        with uninterrupted():  # a fleet that is founded by half would be in the way of the next try
            fleet, files = found(text, node, where, is_plan=True, certify=certify)
            before = unfinished(where.config)
            if papers is not None:
                papers.check("" if before is None else before.id)
            if not plan:
                fleet, files = found(text, node, where, is_plan=False, certify=certify)
    except ZschedError:
        if papers is not None:
            papers.destroy(where.config)
        raise
    trust = "NOT SECURED: whoever reaches this network reads and changes everything" if insecure else "secured"
    said = f"{fleet.name}: a fleet of one node, {node} at {own.host}, ports {own.port} and {own.port + 1}, {trust}"
    more = "`zsched task add FILE` gives it work, `zsched invite NAME > NAME.invite` brings the next machine"
    told = Told(
        fleet=fleet.name,
        node=node,
        outcome="planned" if plan else "created",
        said=f"would be written; {said}" if plan else said,
        files=files if papers is None else (*files, *papers.files),
        next=() if plan else (*how_to_start(node, where), more, *(papers.advice if papers else ())),
    )
    return told.tell(is_json=json_)


def how_to_start(node: NodeId, where: Places) -> tuple[str, ...]:
    """How its daemon is started."""
    by_default = places.SYSTEM_CONFIG, Path("/var/lib/zsched")
    is_named = node == places.node_name(None, {})
    if (where.config, where.state) == by_default:
        lines = () if is_named else (f"write `[Service] Environment=ZSCHED_NODE={node}`: `sudo systemctl edit zsched`",)
        up = "sudo zsched up" if is_named else f"sudo zsched up --node {node}"
        return (*lines, f"sudo systemctl enable --now zsched (or in the foreground: {up})")
    words = ["zsched", "up", "--config", str(where.config), "--node", node, "--state-dir", str(where.state)]
    return (shlex.join(words),)


# --- invite ----------------------------------------------------------------------------------------------------------


class Guest(Struct, frozen=True, kw_only=True):
    """The machine that is to come."""

    name: str
    kind: NodeKind | None = None
    """``None``: nobody has said; a robot, unless the document knows the node."""
    address: str | None = None
    """``None``: it dials the others, and nobody dials it."""
    tasks: tuple[str, ...] = ()
    """Of which it becomes a candidate."""
    authority: Path | None = None
    request: Path | None = None
    """For a key that was made on the machine itself."""


def invite(
    said: Edits,
    name: Annotated[str, typer.Argument(metavar="NAME", help="The new machine's name in the fleet.")],
    kind: Annotated[
        NodeKind | None,
        typer.Option("--kind", "--role", help="A robot votes and has streams; an edge only works. [robot]"),
    ] = None,
    address: Annotated[
        str | None, typer.Option("--address", metavar="ADDRESS", help=f"{AddressHelp} [nobody dials it]")
    ] = None,
    candidate_for: Annotated[
        list[str] | None,
        typer.Option("--candidate-for", metavar="TASK", help="It may own this task; give it once for each."),
    ] = None,
    output: OutputOption = None,
    authority: Annotated[
        Path | None,
        typer.Option("--authority", metavar="DIR", help="In a secured fleet: who signs. [as of zsched pki]"),
    ] = None,
    csr: Annotated[
        Path | None,
        typer.Option("--csr", metavar="FILE", help="In a secured fleet: its request; its key stays where it was made."),
    ] = None,
) -> int:
    """Add a machine to the fleet, and write the file with which it joins (`zsched join`).

    Example: sudo zsched invite edge2 --address 192.0.2.22 > edge2.invite

    In a secured fleet the file holds the machine's certificate, and its key unless --csr is given, where this machine
    has the authority.
    For a node that was never there it is written once more, with another key: the former one is revoked.
    """
    guest = Guest(
        name=name, kind=kind, address=address, tasks=tuple(candidate_for or ()), authority=authority, request=csr
    )
    view = said.order("invite", name, is_data=True)
    check_name(guest.name)
    if output is None and sys.stdout.isatty() and not view.is_plan:
        raise CliError(EXIT_USAGE, f"the invitation is a file: {again()} > {guest.name}.invite")
    if output is not None and not os.access(output.parent, os.W_OK):
        raise CliError(EXIT_FAILED, f"{output}: that folder takes no file; nothing was done, name another one")
    if output is None and not view.is_plan:
        _close_to_others()  # before there is anything to read: who opens it now may read on when it is private
    held = in_force(view.door)
    fleet = fleet_of(document_text(held))
    check_held(fleet_of(document_text(held), str(places.config_path(None, os.environ))), guest.authority)
    check_request(fleet, guest.request, guest.authority)
    secret = b"" if view.is_plan else key_to_papers(fleet, guest.authority)
    if fleet.security is None and guest.address is not None:
        refuse_open_network((address_of(guest.address).host,), view.accepted)
    former = keys_to_revoke(fleet, guest.name, guest.authority, guest.request)
    code = EXIT_OK
    listed = next((node for node in fleet.nodes if node.name == guest.name), None)
    if listed is not None:
        _check_invited_again(view.door, guest, listed.kind)
        if fleet.security is not None and not set(former) <= set(fleet.security.revoked):
            code = apply_change(view, lambda held: _without_keys(document_text(held), former), DOCUMENT)
    else:
        own = None if guest.address is None else address_of(guest.address)
        code = apply_change(view, lambda held: _without_keys(_with_guest(held, guest, own), former), DOCUMENT)
    if code != EXIT_OK:
        return code
    if not view.is_plan:
        _write(invitation_for(view.door, guest, secret), guest, output)
    return EXIT_OK


def _check_invited_again(door: Door, guest: Guest, kind: NodeKind) -> None:
    """A node of the document, of that kind, that was never there may get its file once more."""
    state = next((str(one["state"]) for one in status_of(door)["nodes"] if one["name"] == guest.name), "")
    if state in HERE:
        raise CliError(EXIT_FAILED, f"{guest.name} is a node of the fleet, and {state}: give the machine another name")
    is_other = guest.kind not in (None, kind)
    if guest.address is not None or guest.tasks or is_other:
        advice = "without options it gets its invitation once more; `zsched edit` changes what it is"
        told = "an edge" if kind is NodeKind.EDGE else "a robot"
        raise CliError(EXIT_FAILED, f"{guest.name} is in the document already, as {told}; {advice}")


def _with_guest(held: InForce, guest: Guest, address: Address | None) -> str:
    """The document with the node, as the last one to dial, and among the candidates."""
    text = document_text(held)
    fleet = fleet_of(text)
    kind = NodeKind.ROBOT if guest.kind is None else guest.kind
    entry = _entry_of(guest.name, kind, address, protocol_of(fleet))
    text = add_entries(text, "nodes", f"nodes:\n{entry}", f"the name {guest.name}")
    if address is not None:
        known = fleet.seeds if is_list(text, ("seeds",)) else ()
        text = add_names(text, ("seeds",), [*(name for name in dial_order(fleet) if name not in known), guest.name])
    for task in dict.fromkeys(guest.tasks):
        text = _with_candidate(text, fleet, task, guest)
    return text


def _without_keys(text: str, labels: Sequence[str]) -> str:
    """The document with these keys among those that are not let in."""
    security = fleet_of(text).security if labels else None
    new = [label for label in labels if security is not None and label not in security.revoked]
    if not new:
        return text
    if is_list(text, REVOKED):
        return add_names(text, REVOKED, new)
    return add_entries(text, REVOKED[0], f"{REVOKED[0]}: {{{REVOKED[1]}: [{', '.join(new)}]}}\n")


def dial_order(fleet: Fleet) -> tuple[NodeId, ...]:
    """The nodes that can be dialled, each after those that it dials."""
    others = [node.name for node in fleet.nodes if node.name not in fleet.seeds and node.can_be_dialled]
    return (*fleet.seeds, *others)


def protocol_of(fleet: Fleet) -> str:
    """With which the others listen."""
    if fleet.security is not None:
        return SECURED
    said = [Endpoint.of(node.listen_control).protocol for node in fleet.nodes if node.listen_control]
    return said[0] if said else "tcp"


def _with_candidate(text: str, fleet: Fleet, task: str, guest: Guest) -> str:
    names = [one.name for one in fleet.tasks]
    if task not in names:
        raise CliError(EXIT_USAGE, f"--candidate-for: fleet {fleet.name} has no task {task!r}{nearest(task, names)}")
    if is_list(text, ("tasks", task, "candidates")):
        return add_names(text, ("tasks", task, "candidates"), [guest.name])
    if guest.name not in fleet_of(text).task(task).candidates:
        advice = "invite it without that, and change them with `zsched edit`"
        raise CliError(EXIT_FAILED, f"the candidates of {task} are a selection that {guest.name} is not in; {advice}")
    return text


def invitation_for(door: Door, guest: Guest, secret: bytes) -> Invitation:
    """What the node at the door goes by now, with a certificate for the new one."""
    told = ask_door(door, {"verb": "fleet"})
    try:
        value = from_plain(told["value"], FleetValue)
        parts = {"text": told["text"], "flags": told["flags"], "rollouts": told.get("rollouts", [])}
        document = from_plain(parts, Document)
    except (KeyError, WireError) as error:
        raise CliError(EXIT_FAILED, f"{told['node']} does not tell its fleet value: update zsched there") from error
    fleet = fleet_of(document.text)
    addresses = [node.control_at for node in fleet.nodes if node.name != guest.name]
    papers = papers_for(fleet, guest.name, guest.authority, guest.request, secret)
    return Invitation(
        node=guest.name,
        value=value,
        document=document,
        addresses=tuple(filter(None, addresses)),
        generation=int(status_of(door)["quorum"].get("generation", 0)),
        papers=papers,
    )


def _close_to_others() -> None:
    """Let only its owner read the file that stdout is, if it is one."""
    try:
        number = sys.stdout.fileno()
    except (AttributeError, OSError):
        return
    if stat.S_ISREG(os.fstat(number).st_mode):
        os.fchmod(number, PRIVATE)


def _write(invitation: Invitation, guest: Guest, file: Path | None) -> None:
    """To a file that only its owner may read: workers' settings may be secrets, too; or to stdout."""
    papers = invitation.papers
    text, has_key = encode_invitation(invitation), papers is not None and bool(papers.key)
    if file is None:
        sys.stdout.buffer.write(text.encode())  # a file's text, whatever the terminal's encoding is
        sys.stdout.buffer.flush()
    else:
        _write_private(file, text)
    where = "this file" if file is None else str(file)
    secret = f"; {where} holds its private key: only you may read it, bring it there by a way that nobody else reads"
    name = f"{guest.name}.invite" if file is None else file.name
    warn(
        f"{invitation.fleet}: {guest.name} may join{secret if has_key else ''}\n"
        f"next, on that machine: sudo zsched join {shlex.quote(name)}"
    )


def _write_private(file: Path, text: str) -> None:
    """In a new file of that name: one that is there may be somebody else's, or open at who has looked at it."""
    try:
        _replace(file, text)
    except OSError as error:
        advice = "the node is in the document; write its invitation elsewhere: zsched invite NAME -o FILE"
        raise CliError(EXIT_FAILED, f"{file}: {error.strerror}; {advice}") from error


def _replace(file: Path, text: str) -> None:
    if os.path.lexists(file) and not stat.S_ISREG(file.lstat().st_mode):
        raise OSError(errno.EINVAL, "it is no regular file")
    write_whole(file, text.encode(), PRIVATE, is_for_folder=False)


# --- join ------------------------------------------------------------------------------------------------------------


def join(
    here: Files,
    file: Annotated[str | None, typer.Argument(metavar="[FILE]", help="What `zsched invite` wrote; -: stdin.")] = None,
    request: Annotated[
        str | None,
        typer.Option("--request", metavar="NAME", help="Before: make a key here, and NAME.csr for `zsched invite`."),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="FILE", help="With --request: where it goes. [./NAME.csr]")
    ] = None,
    plan: PlanOption = False,
    json_: JsonOption = False,
) -> int:
    """Make this machine the node that an invitation names: writes its fleet file, state and certificate.

    Example: sudo zsched join edge2.invite

    With --request the machine makes its key by itself, and no key travels.
    Nothing of another fleet is touched: it is refused. Start the daemon then; it votes as soon as it hears the others.
    """
    if (file is None) == (request is None):
        raise CliError(EXIT_USAGE, "give the invitation's file, or --request NAME before you have one")
    where = here.places()
    if request is not None:
        if plan:
            raise CliError(EXIT_USAGE, "--plan goes with an invitation: --request writes a key and a request only")
        return _ask_in(request, where, output, is_json=json_)
    assert file is not None
    if output is not None:
        raise CliError(EXIT_USAGE, "--output goes with --request")
    invitation = read_invitation(file)
    fleet, node = invitation.fleet, invitation.node
    if is_joined(invitation, where):
        if not is_of_a_later_key(invitation, where):
            return _complete(invitation, where, is_plan=plan, is_json=json_)
        with uninterrupted():  # after a power cut the same join goes on
            read, former, files = take_later_key(invitation, where, is_plan=plan)
        if not json_ and not plan:
            warn(f"{node} had the key of an earlier invitation: its files are named *.left, and it joins once more")
        more, files = " once more, with the key of this later invitation", (*former, *files)
    else:
        with uninterrupted():
            read, files = join_here(invitation, where, is_plan=plan)
        more = f" (generation {invitation.value.generation_id[:8]})"
    would = "would become" if plan else "is"
    said = f"{fleet}: this machine {would} {node}{more}"
    return _tell_joined(invitation, where, read, said, files, is_plan=plan, is_json=json_)


def _tell_joined(
    invitation: Invitation,
    where: Places,
    fleet: Fleet,
    said: str,
    files: tuple[Written, ...],
    *,
    is_plan: bool,
    is_json: bool,
) -> int:
    """Say what was written, or would be, and what comes next; the exit code."""
    node = invitation.node
    follow = () if is_plan else (*_lacking(fleet, invitation), *how_to_start(node, where), *_look(invitation))
    outcome = "planned" if is_plan else "joined"
    told = Told(fleet=invitation.fleet, node=node, outcome=outcome, said=said, files=files, next=follow)
    return told.tell(is_json=is_json)


def _complete(invitation: Invitation, where: Places, *, is_plan: bool, is_json: bool) -> int:
    """Bring back what this machine, which has its state, lacks beside that: its system may have been installed anew."""
    fleet, node = invitation.fleet, invitation.node
    with uninterrupted():
        read, files = mend(invitation, where, is_plan=is_plan)
    if not files:
        said = f"{where.state}: this machine is {node} of fleet {fleet} already: nothing to do"
        return Told(fleet=fleet, node=node, outcome="unchanged", said=said).tell(is_json=is_json)
    would = "would be" if is_plan else "is"
    said = f"{fleet}: this machine {would} {node} again, with what was missing; its state is here, and stays"
    return _tell_joined(invitation, where, read, said, files, is_plan=is_plan, is_json=is_json)


def _ask_in(name: str, where: Places, out: Path | None, *, is_json: bool) -> int:
    """Make this machine's key and the request with which it is invited; the exit code.

    Raises:
        CliError: it is no name.
        AdapterError: this machine has a certificate already, or a file cannot be written.
    """
    files = ask_for_certificate(name, where, out)
    file = files[-1].path.name
    follow = f"bring {file} to the fleet's authority, and there: zsched invite {name} --csr {file} > {name}.invite"
    told = Told(
        fleet="", node=name, outcome="requested", said=f"{name}: a key, and a request", files=files, next=(follow,)
    )
    return told.tell(is_json=is_json)


def read_invitation(file: str) -> Invitation:
    """The invitation in a file; ``-``: stdin.

    Raises:
        CliError: it cannot be read, or is none.
    """
    try:
        data = sys.stdin.buffer.read(MAX_BYTES + 1) if file == "-" else read_regular(Path(file), MAX_BYTES)
    except OSError as error:
        raise CliError(EXIT_FAILED, f"{file}: cannot be read: {error.strerror}; give the invitation's path") from error
    try:
        return decode_invitation(data)
    except WireError as error:
        advice = "write it anew on a node of the fleet: zsched invite NAME > NAME.invite"
        raise CliError(EXIT_FAILED, f"{file}: {error}; {advice}") from error


def _lacking(fleet: Fleet, invitation: Invitation) -> Sequence[str]:
    if fleet.security is None:
        return ()
    if invitation.papers is None:
        return (f"bring this node's certificate into {fleet.security.folder} (zsched pki issue {invitation.node})",)
    if not invitation.papers.key:
        return ()
    return (f"delete the invitation: it holds the private key, which is now in {fleet.security.folder}",)


def _look(invitation: Invitation) -> Sequence[str]:
    return (f"`zsched status` then shows the fleet; it dials {', '.join(invitation.addresses)}",)
