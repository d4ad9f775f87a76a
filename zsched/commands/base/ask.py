"""Asks a daemon: finds its socket on this machine, or goes to a node's endpoint; says why when there is no answer.

Knows: which of several sockets is meant, what each refusal means as an exit code. Does not know: what is asked.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import socket
import time
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from zsched.commands.base.common import BECOME_A_NODE, CliError, Json, check_known, check_name, nearest
from zsched.core.values.endpoint import Endpoint
from zsched.core.values.errors import AdapterError, ConfigError, WireError
from zsched.core.values.exits import EXIT_CONFIG, EXIT_FAILED, EXIT_TIMED_OUT, EXIT_UNREACHABLE, EXIT_USAGE
from zsched.core.values.struct import Struct, replace
from zsched.core.values.words import NAME
from zsched.host import paths as places
from zsched.host.clock import wall_s
from zsched.host.operator_client import ask
from zsched.host.screen import printable

if TYPE_CHECKING:
    from zsched.core.values.fleet import Cell, Fleet
    from zsched.core.values.messages import Command
    from zsched.core.values.model import NodeId
    from zsched.link.bus.control_bus import Answer  # imports zenoh
    from zsched.link.bus.fleet_client import FleetClient  # imports zenoh
    from zsched.link.bus.seals import Seals

PLAIN, TLS = "tcp/", "tls/"
SECURE_PAGE = "docs/guide/secure.md"
PASSES_ON = "passes on no command from elsewhere"
"""Of a node of a secured fleet that is asked by who is no node, for another node."""
CONTROL_PORT = 7457
"""Where a node's control session listens by the guides."""
UNITS = tuple(
    Path(folder, "zsched.service")
    for folder in ("/etc/systemd/system", "/usr/lib/systemd/system", "/lib/systemd/system")
)
"""Where one of them is, systemd starts this machine's daemon."""
AGAIN_S, LOOK_S = 30.0, 0.05
"""A daemon that begins again is waited for this long from when it said so, with a look this often."""
CONNECT_S = 3.0
SAYS_WHICH = "with --node or ZSCHED_NODE"
"""By what an operator says which of several daemons on this machine is meant."""
ONLY_THERE = frozenset({"access", "leave", "log"})
"""What a daemon answers on its own machine only."""
READS = frozenset({"access", "explain", "fleet", "history", "lines", "log", "rehearsals", "status"})
"""Asked twice they change nothing."""
ASK_TIMEOUT_S = 5.0
"""Above the daemon's own limits (3 s for its loop, 3 s for another node), so that their reasons arrive."""
WHOLE = ("body", "sides", "text")
"""What in an answer is a file and no words: a kept rehearsal, zenoh's settings, the fleet's document."""
AGREED = frozenset({"change", "hold", "move", "tune"})
"""Orders whose end comes when the electors have agreed, or cannot."""
ORDER_TIMEOUT_S = 62.0
"""Above a daemon's own limit for these by any fleet's timing (60 s): one that answers nothing then is frozen."""


class Door(Struct, frozen=True, kw_only=True):
    """The daemon to ask: its socket, and the node to ask through it (``None``: the daemon itself)."""

    socket: Path
    node: str | None = None
    endpoint: str = ""
    """Where no daemon of this machine is asked: the control endpoint of some node."""
    cell: Cell | None = None
    """Another fleet of the site: one of its gateways is asked, and ``endpoint`` is the first."""
    asked_from: str = ""
    """With a cell: the fleet and the node, or the host, from which it is asked."""

    def to(self, node: str) -> Door:
        """The same way, to a node."""
        return replace(self, node=node)


def find_door(
    runtime_dir: Path | None,
    node: str | None,
    env: Mapping[str, str] = os.environ,
    *,
    connect: str | None = None,
    says_which: str = SAYS_WHICH,
) -> Door:
    """The socket that is meant: ``node``'s own, else any other that passes the question on.

    ``CELL/NODE`` is a node of another fleet of the site, which one of that fleet's gateways asks.

    With ``connect`` no socket of this machine: the node at that endpoint is asked, and passes the question on.
    Without ``node``: this node's own (``ZSCHED_NODE``, host name). Where nothing but the host name says which is this
    node, the only one there is. ``says_which``: what can say it where there are several.

    Raises:
        CliError: there is no daemon, not the one that is meant (3), or there are several and none is meant (2).
    """
    if connect is None and node is not None and "/" in node:
        return _door_of_cell(runtime_dir, node, env)
    if connect is not None:
        if node is not None:
            check_name(node, "--node")
        return Door(socket=Path(), node=node, endpoint=endpoint_of(connect))
    runtime = places.asked_folder(runtime_dir, env)
    await_beginners(runtime)
    sockets = {path.stem: path for path in places.local_sockets(runtime)}
    if not sockets:
        raise CliError(EXIT_UNREACHABLE, _no_socket(runtime, places.config_path(None, env)))
    own = places.node_name(None, env)
    if node is not None:
        if node in sockets:
            return Door(socket=sockets[node])
        nearer = sorted(sockets, key=lambda name: name != own)
        return _through([sockets[name] for name in nearer], node)
    if own in sockets:
        return Door(socket=sockets[own])
    here = ", ".join(sockets)
    is_told = bool(env.get("ZSCHED_NODE"))
    if len(sockets) == 1 and not is_told:
        return Door(socket=next(iter(sockets.values())))
    fleet, names = _their_fleet(sockets.values())
    if own in names or (is_told and not names):
        raise CliError(EXIT_UNREACHABLE, _no_daemon(own, runtime, sockets))
    if is_told:
        raise CliError(EXIT_USAGE, f"ZSCHED_NODE: fleet {fleet} has no node {own!r}{nearest(own, names)}")
    raise CliError(EXIT_USAGE, f"several daemons in {runtime}: {here}; say which one {says_which}")


def _door_of_cell(runtime_dir: Path | None, word: str, env: Mapping[str, str]) -> Door:
    """The door to ``CELL/NODE``, by the document or the fleet file that this machine goes by.

    Raises:
        CliError: it is no such word, or the site has no such cell (2).
        ConfigError: there is no document, and the fleet file cannot be used.
    """
    name, _, node = word.partition("/")
    if not (NAME.fullmatch(name) and NAME.fullmatch(node)):
        raise CliError(EXIT_USAGE, f"--node: {word!r} is neither a node's name nor CELL/NODE")
    here = door_here(runtime_dir, None, env, says_which=f"asks {name}: with ZSCHED_NODE")
    fleet = fleet_here(here, places.config_path(None, env))
    if name == fleet.name:
        return find_door(runtime_dir, node, env)
    cell = next((one for one in fleet.cells if one.name == name), None)
    if cell is None:
        known = [one.name for one in fleet.cells]
        hint = nearest(name, known) if known else f"; fleet {fleet.name} names no other under `site:`"
        raise CliError(EXIT_USAGE, f"--node: the site has no cell {name!r}{hint}")
    return door_of(cell, fleet.name, here, node)


def door_here(
    runtime_dir: Path | None, node: str | None, env: Mapping[str, str] = os.environ, *, says_which: str = SAYS_WHICH
) -> Door | None:
    """As `find_door`; ``None`` on a machine without a daemon, which goes by its fleet file.

    Raises:
        CliError: there are several daemons, and none is meant (2).
    """
    try:
        return find_door(runtime_dir, node, env, says_which=says_which)
    except CliError as error:
        if error.code != EXIT_UNREACHABLE:
            raise
        return None


def fleet_here(door: Door | None, config: Path) -> Fleet:
    """The fleet by which this machine goes: the document by the daemon here, else the stored one, else the fleet file.

    Once a document is agreed the file may be a copy of an older one.

    Args:
        door: of the daemon here; ``None``: none runs.
        config: the fleet file.

    Raises:
        ConfigError: there is no document, and the file cannot be used.
    """
    from zsched.config.load import check_bytes, load_fleet  # noqa: PLC0415 - ruamel.yaml is slow to import

    if door is not None:
        with contextlib.suppress(CliError):
            text = ask_door(door, {"verb": "fleet"}).get("text")
            known = check_bytes(text.encode(), str(config)).fleet if text else None
            return load_fleet(config) if known is None else known
    by_file = load_fleet(config)
    text = _kept_document(by_file.name)
    return (check_bytes(text.encode(), str(config)).fleet if text else None) or by_file


def _kept_document(fleet: str) -> str:
    """The text of the last document in this machine's state folder; empty: none of that fleet, or none to be read."""
    from zsched.core.values.codec import decode_state  # noqa: PLC0415 - as above
    from zsched.host.document_store import DocumentStore  # noqa: PLC0415 - only where no daemon answers
    from zsched.host.files import read_regular  # noqa: PLC0415 - as above
    from zsched.host.state_file import MAX_STATE_BYTES, STATE_NAME  # noqa: PLC0415 - as above

    folder = places.state_folder(None, os.environ)
    try:
        state = decode_state(read_regular(folder / STATE_NAME, MAX_STATE_BYTES))
    except (OSError, WireError):
        return ""
    value = None if state.fleet != fleet or state.fleet_register is None else state.fleet_register.learnt
    content = None if value is None else DocumentStore(folder).load(value.document)
    return "" if content is None else content.text


def door_of(cell: Cell, fleet: str, here: Door | None, node: str | None = None) -> Door:
    """The door to a cell: to one of its nodes, or to whichever gateway answers.

    ``fleet``: this machine's; ``here``: the daemon on it, if one runs.
    """
    place = socket.gethostname() if here is None else here.socket.stem
    return Door(socket=Path(), node=node, endpoint=cell.gateways[0], cell=cell, asked_from=f"{fleet}/{place}")


def await_beginners(runtime: Path) -> None:
    """Wait until the daemons on this machine that begin again in their processes have their sockets again."""
    while any(map(_is_fresh, places.local_marks(runtime))):
        time.sleep(LOOK_S)


def _is_fresh(mark: Path) -> bool:
    with contextlib.suppress(OSError):
        return abs(wall_s() - mark.stat().st_mtime) < AGAIN_S
    return False


def _no_socket(runtime: Path, config: Path) -> str:
    closed = next((path for path in (runtime, places.SYSTEM_RUNTIME) if places.is_closed(path)), None)
    if closed is not None:
        return (
            f"may not look into {closed} (the folder cannot be read); run this as root, or, where the service's user "
            "has a name, as a member of its group (docs/guide/install.md)"
        )
    if runtime == places.SYSTEM_RUNTIME and any(unit.exists() for unit in UNITS):
        start = "start it with `sudo systemctl start zsched` (why it does not run: `systemctl status zsched`)"
    elif places.is_there(config):
        start = "start one with `zsched up`"
    else:
        return (
            f"no daemon in {runtime} (no socket there), and no fleet file {config}; {BECOME_A_NODE}, "
            "or say where a daemon is with --runtime-dir"
        )
    return f"no daemon in {runtime} (no socket there); {start}, or say where it is with --runtime-dir"


def name_here(given: str | None, runtime_dir: Path | None, env: Mapping[str, str] = os.environ) -> str:
    """What this machine is called, for a verb that looks at the machine whether its daemon runs or not.

    As in `find_door`: ``--node``, ``ZSCHED_NODE``, the host name; where nothing but the host name says it, and that is
    no node of the daemons here, the only one there is.

    Raises:
        CliError: there are several daemons, and none is meant (2).
    """
    runtime, own = places.asked_folder(runtime_dir, env), places.node_name(given, env)
    sockets = {path.stem: path for path in places.local_sockets(runtime)}
    if given or env.get("ZSCHED_NODE") or own in sockets or not sockets:
        return own
    if own in _their_fleet(sockets.values())[1]:
        return own
    if len(sockets) == 1:
        return next(iter(sockets))
    here = ", ".join(sockets)
    raise CliError(EXIT_USAGE, f"several daemons in {runtime}: {here}; say which one {SAYS_WHICH}")


def _their_fleet(sockets: Iterable[Path]) -> tuple[str, tuple[str, ...]]:
    """The fleet's name and nodes, by the first daemon here that answers; empty when none does."""
    for path in sockets:
        try:
            status = ask_door(Door(socket=path), {"verb": "status"})
        except CliError:
            continue
        return str(status["fleet"]), tuple(str(node["name"]) for node in status["nodes"])
    return "", ()


def _through(sockets: Sequence[Path], node: str) -> Door:
    """The first daemon here that answers, to ask it for ``node``, which must be in its fleet."""
    failures = []
    for path in sockets:
        door = Door(socket=path)
        try:
            status = ask_door(door, {"verb": "status"})
        except CliError as error:
            failures.append(error)
            continue
        check_known(status, "node", node)
        return Door(socket=path, node=node)
    raise failures[0]


def ask_door(door: Door, request: Json) -> Json:
    """The daemon's answer to ``request``; the outcome ``unknown`` of an order that may or may not have been done.

    Raises:
        CliError: nobody answers (3), not in time (5), or the daemon refuses (1).
    """
    if door.endpoint:
        return _ask_elsewhere(door, request)
    if door.node is not None:
        request = {**request, "node": door.node}
    try:
        answer = heard(_asked(door, request, ORDER_TIMEOUT_S if request["verb"] in AGREED else ASK_TIMEOUT_S))
    except AdapterError as error:
        raise _unanswered(door, error, is_order=request["verb"] not in READS) from error
    if "error" not in answer:
        return answer
    text = str(answer["error"])
    if "did not answer within" not in text:
        raise CliError(EXIT_FAILED, text)
    if door.node is None:
        raise CliError(EXIT_TIMED_OUT, text)  # the daemon is up, and its loop is stuck
    runtime = door.socket.parent
    here = [path.stem for path in places.local_sockets(runtime)]
    raise CliError(EXIT_UNREACHABLE, _no_daemon(door.node, runtime, here, is_asked=True))


def heard(answer: Json) -> Json:
    """What a node has answered, with each word as one printable line: verbs hear others only by this, text and JSON."""
    return {**printable(answer), **{name: answer[name] for name in WHOLE if name in answer}}


def _asked(door: Door, request: Json, timeout_s: float) -> Json:
    """As `ask`; once more where nothing can have come of the first time: the daemon may have begun again just then.

    Whether it did is not asked of its mark: one that is quick has taken the mark away before it is looked for.
    """
    runtime = door.socket.parent
    await_beginners(runtime)
    try:
        return ask(door.socket, request, timeout_s)
    except AdapterError as error:
        is_untaken = isinstance(error.__cause__, (ConnectionRefusedError, FileNotFoundError))
        is_safe = is_untaken or (isinstance(error.__cause__, ConnectionError) and request["verb"] in READS)
        if not is_safe:
            raise
    await_beginners(runtime)
    return ask(door.socket, request, timeout_s)


def _no_daemon(node: str, runtime: Path, here: Iterable[str], *, is_asked: bool = False) -> str:
    """``is_asked``: through the network, too; then it is likely to be another machine's, and is not started here."""
    start = f"start it with `zsched up --node {node}`"
    if is_asked:
        start = f"look at zsched on the machine of {node} (`sudo systemctl restart zsched`), and at its network"
    more = " and none answers in the network" if is_asked else ""
    return f"no daemon of {node} in {runtime} (here: {', '.join(here)}){more}; {start}, or ask another one with --node"


# --- without a daemon ------------------------------------------------------------------------------------------------


def endpoint_of(text: str) -> str:
    """A zenoh endpoint out of what people write; the protocol and the port may be left out.

    >>> endpoint_of("robot1"), endpoint_of("192.0.2.11:7500"), endpoint_of("tls/robot1:7457")
    ('tcp/robot1:7457', 'tcp/192.0.2.11:7500', 'tls/robot1:7457')

    Raises:
        CliError: it is no endpoint that could be dialled.
    """
    full = text if "/" in text else f"tcp/{text}"
    if ":" not in full.rpartition("]")[2]:
        full = f"{full}:{CONTROL_PORT}"
    if not Endpoint.of(full).dialled(""):
        raise CliError(EXIT_USAGE, f"--connect: {text!r} is no endpoint; write tcp/robot1:{CONTROL_PORT}")
    return full


def _ask_elsewhere(door: Door, request: Json) -> Json:
    """The answer of a node of a fleet that has no daemon here."""
    from zsched.link.requests import answer_json, command_of, unknown  # noqa: PLC0415 - only elsewhere

    if request["verb"] in ONLY_THERE:
        raise CliError(EXIT_USAGE, f"only the machine of a node tells its {request['verb']}: run this there")
    try:
        command = None if request["verb"] == "status" else command_of(request)
    except (TypeError, ValueError, OverflowError) as error:  # a daemon would refuse it in these words
        raise CliError(EXIT_FAILED, f"{request['verb']}: {error}") from error
    visit = _visit(door.endpoint, door.cell)
    if visit.is_guest and command is not None:
        raise CliError(EXIT_FAILED, _guest_may_not(visit))
    try:
        if door.cell is not None:
            return heard(answer_json(_ask_cell(door.cell, door.node, command)))
        return heard(answer_json(_client(door.endpoint).ask(door.node, command)))
    except AdapterError as error:
        is_unsure = isinstance(error.__cause__, TimeoutError)
        is_clear = door.cell is not None or (is_unsure and door.endpoint.startswith(PLAIN))  # it has told its status
        advice = "" if is_clear else _why_silent(door, visit, is_command=command is not None)
        if is_unsure and not advice:
            return answer_json(unknown(str(error)))
        raise CliError(EXIT_UNREACHABLE, printable(f"{error}{advice}")) from error


def _why_silent(door: Door, visit: _Visit, *, is_command: bool) -> str:
    """What else a silence of another machine may mean, and what to do; behind the error."""
    if door.endpoint.startswith(PLAIN):
        return f"; a secured fleet is asked at {TLS}{door.endpoint.removeprefix(PLAIN)}"
    try:
        client = _client(door.endpoint)
    except AdapterError:
        return ""  # there is no link at all
    try:
        there = client.status().node
    except AdapterError:
        role = "guests" if visit.is_guest else "operators"
        return (
            f" A secured fleet is silent to whom it does not let in: its document must name {visit.asker} (`security: "
            f"{{{role}: [...]}}` for people), not revoke the key, and the daemons must have begun anew since"
        )
    if is_command and door.node not in (None, there):
        return f"; in a secured fleet {there} {PASSES_ON}: ask {door.node} itself (--connect)"
    return ""


def _guest_may_not(visit: _Visit) -> str:
    return (
        f"{visit.asker} is a guest of fleet {visit.fleet} and may only ask for its status and read streams; "
        "ask with an operator's certificate (`zsched pki issue NAME --role operator` where the fleet's authority is)"
    )


def _ask_cell(cell: Cell, node: str | None, command: Command | None) -> Answer:
    """The answer of a node of a cell, by the first gateway that finds it; of the gateway itself when none is named.

    A command goes to the gateway by which the node has just told its status, once: a second one might do it twice.

    Raises:
        CliError: the cell has no such node (2).
        AdapterError: no gateway finds it, or the command was not answered.
    """
    failures = []
    for gateway in sorted(cell.gateways, key=lambda one: one != _answered.get(cell.name)):
        try:
            client = _client(gateway, cell)
            status = _status_in(cell, client, node)
        except AdapterError as error:
            failures.append(f"by {gateway}: {str(error).removeprefix(gateway).strip()}")
            continue
        _answered[cell.name] = gateway
        if command is None:
            return status
        if node is not None and not gateway.startswith(PLAIN):
            client = _gateway_of(cell, node)
        return client.ask(node, command)
    whom = f"{cell.name}/{node}" if node is not None else f"cell {cell.name}"
    raise AdapterError(f"{whom} cannot be asked; {'; '.join(failures)}")


def _gateway_of(cell: Cell, node: NodeId) -> FleetClient:
    """The session to the gateway that a node of a secured cell is: no other one passes a command on.

    Raises:
        CliError: it is no gateway, or nobody answers at its endpoint.
    """
    found: dict[NodeId, FleetClient] = {}
    for gateway in cell.gateways:
        with contextlib.suppress(AdapterError):
            client = _client(gateway, cell)
            found[client.status().node] = client
        if node in found:
            return found[node]
    said = f"{node} is none of the gateways of {cell.name} that answer ({', '.join(found) or 'there is none'})"
    raise CliError(EXIT_FAILED, f"{said}, and in a secured fleet a node passes on no command from elsewhere; ask one")


def _status_in(cell: Cell, client: FleetClient, node: NodeId | None) -> Answer:
    """The status of a node of a cell; of one that is silent the gateway says whether the cell has it."""
    try:
        return client.ask(node, None)
    except AdapterError:
        names: list[NodeId] = []
        with contextlib.suppress(AdapterError):
            names = [one.name for one in client.status().nodes]
        if node is None or not names or node in names:
            raise
        raise CliError(EXIT_USAGE, f"fleet {cell.name} has no node {node!r}{nearest(node, names)}") from None


_answered: dict[str, str] = {}
"""{cell: the gateway that answered last}, which is asked first."""


@cache
def _client(endpoint: str, cell: Cell | None = None) -> FleetClient:
    """The one session to an endpoint, until the program ends."""
    from zsched.link.bus.fleet_client import FleetClient  # noqa: PLC0415 - loads zenoh
    from zsched.link.sessions.config import client_config  # noqa: PLC0415 - as above

    visit = _visit(endpoint, cell)
    config = client_config(connect=(endpoint,), operator_json5=visit.text, connect_s=CONNECT_S)
    client = FleetClient(endpoint, config, visit.asker, visit.fleet, visit.seals)
    atexit.register(client.close)
    return client


class _Visit(Struct, frozen=True, kw_only=True):
    """How a tool comes to a fleet: its session's settings, in whose name it asks, and which fleet (``*``: any)."""

    text: str
    asker: str
    fleet: str
    seals: Seals | None = None
    is_guest: bool = False
    operator: str = ""
    """What an operator's certificate calls its holder; empty: it is of another role, or there is none."""


@cache
def _visit(endpoint: str, cell: Cell | None) -> _Visit:
    """With the certificates that the fleet file of this machine or of the cell names, where the endpoint is secured.

    Raises:
        CliError: there is no such fleet file, or it is another fleet's (78).
        ConfigError: it has faults, or there is no certificate.
    """
    name = places.node_name(None, os.environ)
    asker = name if NAME.fullmatch(name) else "operator"
    any_fleet = "*" if cell is None else cell.name
    if endpoint.startswith(PLAIN):
        return _Visit(text="", asker=asker, fleet=any_fleet)
    from zsched.config.load import load_fleet  # noqa: PLC0415 - ruamel.yaml is slow to import
    from zsched.core.values.certificates import Role  # noqa: PLC0415 - as above
    from zsched.link.bus.sealing import seals_of  # noqa: PLC0415 - as above
    from zsched.link.sessions.access_rules import Side  # noqa: PLC0415 - as above
    from zsched.link.sessions.secured import identity_of  # noqa: PLC0415 - as above
    from zsched.link.sessions.tls import session_text  # noqa: PLC0415 - as above

    file = places.config_path(None, os.environ) if cell is None else Path(cell.file)
    if not file.exists():
        own = f"set ZSCHED_CONFIG to the fleet file beside it ({SECURE_PAGE} says how to get both)"
        advice = own if cell is None else f"put a copy of {cell.name}'s fleet file there (docs/guide/scale.md)"
        raise CliError(
            EXIT_CONFIG,
            f"{endpoint}: a secured fleet lets in who has its certificate, and {file}, which names it, is not there; "
            f"{advice}",
        )
    fleet = load_fleet(file)
    if cell is not None and fleet.name != cell.name:
        advice = f"put a copy of {cell.name}'s there (docs/guide/scale.md)"
        raise CliError(EXIT_CONFIG, f"{file} is the file of fleet {fleet.name}, and not of {cell.name}; {advice}")
    try:
        text = session_text(fleet, Side.VISIT)
        if fleet.security is None:
            return _Visit(text=text, asker=asker, fleet=any_fleet)
        holder = identity_of(fleet, fleet.security).holder
    except ConfigError as error:
        if cell is None:
            raise
        raise CliError(
            EXIT_CONFIG,
            f"{error}. {cell.name} lets in certificates of its own authority: write `security: {{folder: FOLDER}}` in "
            f"{file}, with your operator's certificate of that fleet in the folder (docs/guide/scale.md)",
        ) from error
    return _Visit(
        text=text,
        asker=holder.name,
        fleet=fleet.name,
        seals=seals_of(fleet),
        is_guest=holder.role is Role.GUEST,
        operator=holder.label if holder.role is Role.OPERATOR else "",
    )


def operator_at(door: Door) -> str:
    """The name by which the nodes at the door know who asks, by an operator's certificate; empty: by no such one."""
    return _visit(door.endpoint, door.cell).operator if door.endpoint else ""


def _unanswered(door: Door, error: AdapterError, *, is_order: bool) -> CliError:
    if isinstance(error.__cause__, TimeoutError):
        unsure = ". What was ordered may or may not have been done: `zsched status` shows it then" if is_order else ""
        return CliError(EXIT_TIMED_OUT, f"{error}{unsure}")
    if isinstance(error.__cause__, PermissionError):
        advice = f"run this as root{_group_of(door.socket)}"
        return CliError(EXIT_UNREACHABLE, f"may not open {door.socket} (permission denied); {advice}")
    return CliError(EXIT_UNREACHABLE, str(error))


def _group_of(path: Path) -> str:
    """Who else may open a socket, in words; root's group is nobody's to join: a daemon that root started is root's."""
    import grp  # noqa: PLC0415 - only who may not ask pays for it

    with contextlib.suppress(OSError, KeyError):
        group = path.stat().st_gid
        if not group:
            return ": root started this daemon"
        name = grp.getgrgid(group).gr_name
        return f" or as a member of the group {name} (sudo usermod -aG {name} $USER, then log in again)"
    return " or as a member of the socket's group"
