"""`zsched fleet create`, `invite`, `join`, against a node whose answers are written down here, and real files."""

from __future__ import annotations

import contextlib
import io
import json
import re
import shlex
import shutil
import signal
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner, Result

from support.fleet_values import fleet_value_of
from support.schemas import faults
from zsched.cli import app
from zsched.commands.base.common import CliError
from zsched.commands.base.places import Places
from zsched.commands.members import belongings as membership_files
from zsched.commands.members import membership, papers
from zsched.commands.members.membership import Address, address_of, how_to_start, own_address
from zsched.config.load import check_bytes, load_fleet
from zsched.core.values.certificates import Role
from zsched.core.values.codec import as_plain, document_hash, from_plain
from zsched.core.values.document import Document, Rollout, Text
from zsched.core.values.errors import ConfigError
from zsched.core.values.exits import EXIT_WOULD_CHANGE
from zsched.core.values.fleet import fleet_hash
from zsched.core.values.struct import replace
from zsched.host import state_file
from zsched.host.document_store import copied_file
from zsched.host.operator_socket import OperatorSocket
from zsched.host.state_file import StateFile
from zsched.link.invitation import decode_invitation, encode_invitation
from zsched.link.sessions.certificate import common_names
from zsched.link.sessions.secured import require_own
from zsched.pki.authority import create, opened
from zsched.pki.certificates import is_key_of
from zsched.runtime.library import Library
from zsched.runtime.restoring import read_stored

Json = dict[str, Any]
TEXT = """\
fleet: hall   # the large one
nodes:
  robot1: {kind: robot, host: 127.0.0.1, listen: {control: tcp/127.0.0.1:7457, data: tcp/127.0.0.1:7458}}
  edge1: {kind: edge, host: 127.0.0.1, listen: {control: tcp/127.0.0.1:7461, data: tcp/127.0.0.1:7462}}
  robot3: {kind: robot}
tasks:
  merge: {candidates: [robot1, robot3], weights: {cpu: 0.5, memory: 0.5}}
  count: {candidates: {kind: edge}, weights: {cpu: 1}}
"""


class Node:
    """A node that agrees on every change of its document."""

    def __init__(self, text: str = TEXT) -> None:
        self.text, self.revision, self.flags = text, 7, [{"kind": "drain", "subject": "edge1"}]
        self.states = {"robot1": "alive", "edge1": "alive", "robot3": "gone"}
        self.changes: list[Json] = []
        self.is_old = False
        self.fleet_file = ""
        self.rollouts: list[Json] = []
        self.look: Callable[[], object] = object
        """Called at each question."""

    def answer(self, request: Json) -> Json:
        self.look()
        if request["verb"] == "status":
            nodes = [{"name": name, "state": state} for name, state in self.states.items()]
            tasks = [{"name": "merge", "owner": "robot1"}]
            told = {
                "fleet": "hall",
                "nodes": nodes,
                "tasks": tasks,
                "fleet_file": self.fleet_file,
                "schema": "zsched.status/1",
            }
            return {**told, "quorum": {"generation": 0}}
        if request["verb"] == "change":
            self.changes.append(request)
            self.revision += 1
            self.text = request["text"]
            return {"outcome": "ok", "detail": "agreed", "revision": self.revision}
        waiting = tuple(from_plain(one, Rollout) for one in self.rollouts)
        content = Document(text=Text(self.text), rollouts=waiting)
        value = fleet_value_of(self.revision, number=2, document=document_hash(content))
        body = {
            "node": "robot1",
            "fleet": "hall",
            "revision": self.revision,
            "number": 2,
            "settled": True,
            "disk": "01",
        }
        told = {"electors": [{"name": "robot1", "disk": "01"}], "document": value.document, "text": self.text}
        return {
            **body,
            **told,
            "flags": [],
            "rollouts": self.rollouts,
            **({} if self.is_old else {"value": as_plain(value)}),
        }


@pytest.fixture
def node(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Node]:
    monkeypatch.setenv("ZSCHED_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("ZSCHED_NODE", "robot1")
    one = Node()
    door = OperatorSocket(tmp_path / "robot1.sock", one.answer)
    door.open()
    yield one
    door.close()


@pytest.fixture(autouse=True)
def authority(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the authority lies, instead of the user's own folder."""
    folder = tmp_path / "authority"
    monkeypatch.setenv("ZSCHED_AUTHORITY", str(folder))
    return folder


def run(*words: object, stdin: str = "") -> Result:
    return CliRunner().invoke(app, [str(word) for word in words], input=stdin)


def here(folder: Path) -> tuple[object, ...]:
    return ("--config", folder / "fleet.yaml", "--state-dir", folder / "state")


# --- addresses -------------------------------------------------------------------------------------------------------


def test_addresses_as_people_write_them() -> None:
    assert address_of("robot4.local") == Address(host="robot4.local", port=7457)
    assert address_of("2001:db8::1").entry("tls") == (
        'host: "2001:db8::1", listen: {control: "tls/[::]:7457", data: "tls/[::]:7458"}'
    )
    assert address_of("[::1]:7500").entry("tcp") == (
        'host: "::1", listen: {control: "tcp/[::1]:7500", data: "tcp/[::1]:7501"}'
    )
    wrong = ("", "a b", "tcp/robot4:7457", "robot4:x", "robot4:0", "robot4:65535", 'a"b', "{a}")
    for text in (*wrong, "robot4:\u00b2", "robot4:\u0663", f"robot4:{'1' * 5000}", "[::1", "[::1]7500"):
        with pytest.raises(CliError, match="is no address"):
            address_of(text)


@pytest.mark.parametrize("text", ["0.0.0.0:7457", "[::]:7500", "224.0.0.1", "ff02::1", "255.255.255.255"])
def test_an_address_that_nobody_can_dial_is_refused(text: str) -> None:
    with pytest.raises(CliError, match="is no address of one machine"):
        address_of(text)


# --- create ----------------------------------------------------------------------------------------------------------


def test_a_fleet_of_one_is_created_with_this_machines_address(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(membership, "addresses_towards", lambda _: ("192.0.2.9",))
    result = run("fleet", "create", "hall", "--node", "robot1", *here(tmp_path))
    assert result.exit_code == 0, result.stderr
    fleet = load_fleet(tmp_path / "fleet.yaml")
    assert (fleet.name, [node.name for node in fleet.nodes], fleet.tasks, fleet.seeds) == (
        "hall",
        ["robot1"],
        (),
        ("robot1",),
    )
    assert fleet.node("robot1").host == "192.0.2.9"
    assert fleet.security is not None, "secured, unless somebody says otherwise"
    assert "next: zsched up --config" in result.stdout


@pytest.mark.parametrize(
    ("addresses", "said"),
    [
        (("127.0.0.1", "10.42.0.7", "169.254.3.4"), "10.42.0.7"),
        (("127.0.0.1",), "has no address in a network"),
        (("127.0.0.1", "10.42.0.7", "192.168.7.2"), r"with --address \(here: 10\.42\.0\.7, 192\.168\.7\.2\)"),
    ],
)
def test_without_a_default_route_the_only_address_is_taken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, addresses: tuple[str, ...], said: str
) -> None:
    """A hall whose Wi-Fi leads nowhere else."""
    monkeypatch.setattr(membership, "addresses_towards", lambda _: ())
    table = tmp_path / "proc" / "net" / "fib_trie"
    table.parent.mkdir(parents=True)
    table.write_text("Main:\n" + "".join(f"  |-- {one}\n     /32 host LOCAL\n" for one in addresses))
    if said in addresses:
        assert own_address(tmp_path) == said
    else:
        with pytest.raises(CliError, match=said):
            own_address(tmp_path)


def test_create_says_what_it_would_write_and_what_it_wrote(tmp_path: Path) -> None:
    given = ("fleet", "create", "hall", "--node", "edge1", "--kind", "edge", "--address", "127.0.0.1:7500")
    words = (*given, "--timing", "wired", *map(str, here(tmp_path)))
    planned = run(*words, "--plan", "--json")
    assert planned.exit_code == 10
    assert not (tmp_path / "fleet.yaml").exists()
    done = run(*words, "--json")
    assert done.exit_code == 0
    bodies = [json.loads(one.stdout) for one in (planned, done)]
    assert [faults(body) for body in bodies] == [[], []]
    assert [body["outcome"] for body in bodies] == ["planned", "created"]
    assert bodies[0]["files"] == bodies[1]["files"]
    assert load_fleet(tmp_path / "fleet.yaml").electors == ("edge1",), "without a robot all nodes are electors"
    again = run(*words)
    assert again.exit_code == 1
    assert "exists already" in again.stderr


def test_a_created_fleet_has_an_authority_and_its_first_node_a_certificate(tmp_path: Path, authority: Path) -> None:
    result = run("fleet", "create", "hall", "--node", "robot1", "--address", "127.0.0.1", *here(tmp_path / "one"))
    assert result.exit_code == 0, result.stderr
    assert f"{authority}/ca-1.key: the key of the fleet's authority" in result.stdout
    assert f"move the folder {authority} to a stick" in result.stdout
    assert "not locked" in result.stdout
    fleet = load_fleet(tmp_path / "one" / "fleet.yaml")
    assert fleet.security is not None
    require_own(fleet, fleet.security, "robot1")
    assert fleet.node("robot1").listen_control == "tls/127.0.0.1:7457"
    local = fleet.node("robot1").local
    assert local is not None
    assert local.listen == ("tcp/127.0.0.1:7460",), "applications of its host have no certificate"
    modes = {one.name: stat.S_IMODE(one.stat().st_mode) for one in (tmp_path / "one" / "pki").iterdir()}
    assert modes == {"certificate.pem": 0o644, "ca.pem": 0o644, "key.pem": 0o600}
    again = run("fleet", "create", "hall", "--node", "robot1", "--address", "127.0.0.1", *here(tmp_path / "two"))
    assert again.exit_code == 1
    assert "holds an authority, and is left as it is" in again.stderr
    assert not (tmp_path / "two").exists()


def test_a_locked_authority_takes_its_passphrase(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ("fleet", "create", "hall", "--node", "edge1", "--kind", "edge", "--address", "127.0.0.1", *here(tmp_path))
    result = run(*words, "--passphrase", stdin="secret\nsecret\n")
    assert result.exit_code == 0, result.stderr
    assert "not locked" not in result.stdout
    assert load_fleet(tmp_path / "fleet.yaml").node("edge1").local is None, "an edge has no applications"
    monkeypatch.setenv("ZSCHED_AUTHORITY_PASSPHRASE", "another")
    issued = run("pki", "renew", "edge1", "--config", tmp_path / "fleet.yaml")
    assert "the passphrase is wrong" in issued.stderr


def test_what_the_timer_needs_to_renew_by_an_authority_is_said_when_it_is_made(
    tmp_path: Path, authority: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The pytest folder is in /tmp, which the timer's unit does not see."""
    words = ("fleet", "create", "hall", "--node", "edge1", "--kind", "edge", "--address", "127.0.0.1")
    for count, (folder, more) in enumerate(((authority, ()), (tmp_path / "a stick", ("--authority",)))):
        given = [*more, folder] if more else []
        result = run(*words, *given, *here(tmp_path / str(count)))
        (said,) = [line for line in result.stdout.splitlines() if "certificates last 30 days: " in line]
        assert f"move {folder} to /root/.local/share/zsched/authority/hall, for zsched-renew.service does not" in said
        assert said.endswith(
            f"else `{shlex.join(('zsched', 'pki', 'renew', '--deliver', '--authority', str(folder)))}` there"
        )
        assert "LoadCredential" not in said
    monkeypatch.setattr("zsched.commands.base.renewing.UNSEEN", ("/home",))
    result = run(*words, "--authority", tmp_path / "100%", "--passphrase", *here(tmp_path / "3"), stdin="s\ns\n")
    (said,) = [line for line in result.stdout.splitlines() if "certificates last 30 days: " in line]
    text = "\n".join(re.findall(r"`([^`]*)`", said.partition("with the lines ")[2].partition(";")[0])) + "\n"
    assert text == (
        f"[Unit]\nConditionPathExistsGlob=\nConditionPathExists={tmp_path}/100%%/authority.json\n"
        f"[Service]\nEnvironment=ZSCHED_AUTHORITY={tmp_path}/100%%\nReadWritePaths={tmp_path}/100%%\n"
        "LoadCredential=passphrase:/root/FILE\n"
    )
    assert "write the passphrase to /root/FILE, which only root may read, then `sudo systemctl edit" in said


def test_a_fleet_that_cannot_be_written_leaves_no_authority(tmp_path: Path, authority: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("")
    words = ("fleet", "create", "hall", "--node", "robot1", "--address", "127.0.0.1")
    result = run(*words, "--config", blocked / "fleet.yaml", "--state-dir", tmp_path / "state")
    assert result.exit_code == 1
    assert not authority.exists()
    (tmp_path / "pki").mkdir()
    (tmp_path / "pki" / "key.pem").write_text("somebody's")
    result = run(*words, *here(tmp_path))
    assert "key.pem exists already, and is left as it is" in result.stderr
    assert (tmp_path / "pki" / "key.pem").read_text() == "somebody's"
    assert not authority.exists()


def test_a_creation_that_a_power_cut_broke_off_leaves_no_authority_in_the_way(
    tmp_path: Path, authority: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class PowerCut(BaseException):
        pass

    def cut(*_: Any) -> None:
        raise PowerCut

    words = ("fleet", "create", "hall", "--node", "robot1", "--address", "127.0.0.1", *here(tmp_path))
    for place in ("zsched.pki.authority.Authority.issue", "zsched.commands.members.belongings._put_papers"):
        with monkeypatch.context() as patch:
            patch.setattr(place, cut)
            with pytest.raises(PowerCut):
                run(*words)
        assert (authority / "ca-1.key").exists()
    key = (authority / "ca-1.key").read_bytes()
    assert run(*words, "--plan").exit_code == EXIT_WOULD_CHANGE
    assert (authority / "ca-1.key").read_bytes() == key
    elsewhere = run(*words[:-4], *here(tmp_path / "elsewhere"))
    assert "holds an authority, and is left as it is" in elsewhere.stderr, "another creation"
    result = run(*words)
    assert result.exit_code == 0, result.stderr
    assert (authority / "ca-1.key").read_bytes() != key
    fleet = load_fleet(tmp_path / "fleet.yaml")
    assert fleet.security is not None
    require_own(fleet, fleet.security, "robot1")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["authority", "fleet.yaml", "pki", "state"]
    (tmp_path / "state" / "state").unlink()
    (tmp_path / "fleet.yaml.creating").write_text(
        json.dumps({"creation": json.loads((authority / "authority.json").read_text())["creation"], "written": []})
    )
    (tmp_path / "fleet.yaml").unlink()
    shutil.rmtree(tmp_path / "pki")
    with opened(authority, "hall") as held:
        held.issue("robot2", Role.NODE, (), b"", b"", datetime.now(UTC))
    assert "holds an authority, and is left as it is" in run(*words).stderr, "somebody has got a certificate of it"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP, signal.SIGTERM])
def test_a_signal_while_a_fleet_is_founded_leaves_no_half_of_it(
    tmp_path: Path,
    authority: Path,
    monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
    number: signal.Signals,
) -> None:
    """An authority, or a fleet file, without a state would be in the way of the next try."""

    def interrupted(*words: Any, **more: Any) -> Any:
        made = create(*words, **more)
        signal.raise_signal(number)
        return made

    def ended(*_: Any) -> None:
        pytest.fail("the signal ends the verb")

    monkeypatch.setattr("zsched.pki.authority.create", interrupted)
    before = signal.signal(number, ended)
    request.addfinalizer(lambda: signal.signal(number, before))
    result = run("fleet", "create", "hall", "--node", "robot1", "--address", "127.0.0.1", *here(tmp_path))
    assert result.exit_code == 0, result.stderr
    assert (tmp_path / "fleet.yaml").exists()
    assert StateFile(tmp_path / "state", fleet="hall", node="robot1").load().state is not None
    assert authority.exists()
    assert signal.getsignal(number) is ended


def test_ctrl_c_at_the_question_for_the_passphrase_founds_nothing(
    tmp_path: Path, authority: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def asked(*_: Any, **__: Any) -> str:
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise typer.Abort from None
        return "typed"

    monkeypatch.setattr("zsched.commands.members.pki.typer.prompt", asked)
    words = ("--address", "127.0.0.1", "--passphrase")
    result = run("fleet", "create", "hall", "--node", "robot1", *words, *here(tmp_path))
    assert result.exit_code == 1
    assert "nobody has typed it" in result.stderr
    assert not (tmp_path / "fleet.yaml").exists()
    assert not authority.exists()


@pytest.mark.parametrize("is_by_hand", [False, True], ids=["fleet create", "its authority knows another node"])
def test_a_founder_that_lost_its_state_is_not_made_a_fleet_of_one(
    tmp_path: Path, authority: Path, *, is_by_hand: bool
) -> None:
    """Its fleet file is of the first day, so there is nobody to ask; the fleet lives on without it."""
    words = ("--node", "robot1", *here(tmp_path))
    assert run("fleet", "create", "hall", "--address", "127.0.0.1", *words).exit_code == 0
    shutil.rmtree(tmp_path / "state")
    if is_by_hand:
        shutil.rmtree(authority)
        held = create(authority, "hall", b"", datetime.now(UTC))
        assert run("init", *words).exit_code == 0, "a fleet of one that is secured by hand"
        shutil.rmtree(tmp_path / "state")
        held.issue("robot2", Role.NODE, (), b"", b"", datetime.now(UTC))
    for verb in (("init",), ("fleet", "recover", "--generation", "1")):
        refused = run(*verb, *words)
        assert (refused.exit_code, refused.stdout) == (1, "")
        told = " ".join(refused.stderr.split())
        assert f"nothing was written: {tmp_path}/fleet.yaml names nobody but robot1" in told
        assert f"bring what `zsched fleet export` writes on a living node as {tmp_path}/fleet.yaml" in told
        assert ("has certified robot2" in told) == is_by_hand
    assert not (tmp_path / "state").exists()
    assert "did you mean lost-state?" in run("init", *words, "--accept", "lost-stat").stderr
    if is_by_hand:
        assert run("init", *words, "--accept", "lost-state").exit_code == 0
        return
    text = (tmp_path / "fleet.yaml").read_text()
    (tmp_path / "fleet.yaml").write_text(text.replace("nodes:\n", "nodes:\n  robot2: {kind: robot}\n"))
    assert run("init", *words).exit_code == 0, "the exported document"


def test_without_certificates_a_fleet_says_so_and_stays_where_strangers_are_not(
    tmp_path: Path, authority: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("fleet", "create", "hall", "--node", "robot1", "--insecure", *here(tmp_path))
    for host, said in (
        ("93.184.216.34", "anybody who reaches 93.184.216.34 reads and changes everything"),
        ("[2001:4860::1]:7457", "anybody who reaches 2001:4860::1"),
        ("no.such.name.invalid", "nobody knows whether no.such.name.invalid is a private address"),
    ):
        refused = run(*words, "--address", host)
        assert refused.exit_code == 1
        assert said in refused.stderr
        assert "--accept open-network" in refused.stderr
    monkeypatch.setattr(papers, "addresses_at", lambda _root, _host: iter([ip_address("93.184.216.34")]))
    elsewhere = run(*words, "--address", "10.0.0.7")
    assert "anybody who reaches 93.184.216.34 (this machine)" in elsewhere.stderr, "it listens there, too"
    assert run(*words, "--address", "10.0.0.7", "--accept", "open-net").exit_code == 2
    assert not (tmp_path / "fleet.yaml").exists()
    done = run(*words, "--address", "10.0.0.7", "--accept", "open-network")
    assert done.exit_code == 0, done.stderr
    assert "NOT SECURED" in done.stdout
    fleet = load_fleet(tmp_path / "fleet.yaml")
    assert fleet.security is None
    assert fleet.node("robot1").listen_data == "tcp/0.0.0.0:7458"
    assert not authority.exists()


# --- invite ----------------------------------------------------------------------------------------------------------


def test_an_invitation_on_stdout_is_whole_whatever_the_terminal_s_encoding_is(node: Node) -> None:
    """In a Latin-1 locale a comment's umlaut went out as one byte, and `join` refused the invitation."""
    node.text = f"# Tür 3\n{node.text}"
    result = CliRunner(charset="latin-1").invoke(app, ["invite", "robot2", "--address", "192.0.2.12", "--yes"])
    assert result.exit_code == 0, result.stderr
    assert decode_invitation(result.stdout_bytes).node == "robot2"


def test_an_invited_node_is_agreed_last_in_who_dials_whom_and_its_file_says_all(node: Node) -> None:
    result = run("invite", "robot2", "--address", "192.0.2.12", "--candidate-for", "merge", "--yes", "-m", "more hands")
    assert result.exit_code == 0, result.stderr
    invitation = decode_invitation(result.stdout.encode())
    assert (invitation.node, invitation.value.revision, invitation.papers) == ("robot2", 8, None)
    assert invitation.addresses == ("tcp/127.0.0.1:7461", "tcp/127.0.0.1:7457")
    fleet = check_bytes(node.text.encode()).fleet
    assert fleet is not None
    assert fleet.seeds == ("robot1", "edge1", "robot2")
    assert fleet.task("merge").candidates == ("robot1", "robot2", "robot3")
    assert fleet.node("robot2").listen_data == "tcp/0.0.0.0:7458"
    assert node.text.startswith(TEXT.partition("tasks:")[0]), "every other character stays"
    assert node.changes[0]["reason"] == "invite robot2"
    assert node.changes[0]["why"] == "more hands"
    assert "nodes.robot2" in result.stderr
    assert "next, on that machine: sudo zsched join robot2.invite" in result.stderr
    more = run("invite", "robot4", "--address", "192.0.2.14", "--kind", "edge", "--candidate-for", "count", "--yes")
    assert more.exit_code == 0, more.stderr
    fleet = check_bytes(node.text.encode()).fleet
    assert fleet is not None
    assert fleet.seeds == ("robot1", "edge1", "robot2", "robot4")
    assert fleet.task("count").candidates == ("edge1", "robot4")


def test_a_node_without_an_address_dials_the_others(node: Node) -> None:
    result = run("invite", "robot2", "--yes", "--plan")
    assert (result.exit_code, result.stdout, node.changes) == (10, "", [])
    assert run("invite", "robot2", "--yes").exit_code == 0
    assert "seeds" not in node.text


def test_a_node_is_not_added_when_its_invitation_has_nowhere_to_go(node: Node, tmp_path: Path) -> None:
    """It would stay in the document, and everybody would miss a machine that nobody can bring."""
    result = run("invite", "robot2", "--address", "192.0.2.12", "--yes", "-o", tmp_path / "none" / "file")
    assert result.exit_code == 1
    assert "that folder takes no file; nothing was done" in result.stderr
    assert node.changes == []


def test_a_node_that_was_never_there_gets_its_file_once_more(node: Node, tmp_path: Path) -> None:
    file = tmp_path / "robot3.invite"
    result = run("invite", "robot3", "-o", file)
    assert (result.exit_code, result.stdout, node.changes) == (0, "", [])
    assert decode_invitation(file.read_bytes()).node == "robot3"
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    failed = run("invite", "robot3", "-o", tmp_path)
    assert failed.exit_code == 1
    assert "write its invitation elsewhere" in failed.stderr


def test_a_machine_that_joins_knows_which_changed_worker_waits_for_a_look(node: Node, tmp_path: Path) -> None:
    node.rollouts = [{"task": "merge", "first": ["robot1"], "command": ["/opt/merge"]}]
    file = tmp_path / "robot3.invite"
    assert run("invite", "robot3", "-o", file).exit_code == 0
    invitation = decode_invitation(file.read_bytes())
    assert [one.first for one in invitation.document.rollouts] == [("robot1",)]
    assert document_hash(invitation.document) == invitation.value.document, "else it could not be stored there"


# --- join ------------------------------------------------------------------------------------------------------------


def test_the_machine_of_an_invitation_has_all_files_and_a_second_time_nothing_to_do(node: Node, tmp_path: Path) -> None:
    file, folder = tmp_path / "robot2.invite", tmp_path / "robot2"
    file.write_text(run("invite", "robot2", "--address", "192.0.2.12", "--yes").stdout)
    planned = run("join", file, "--dry-run", "--json", *here(folder))
    assert planned.exit_code == 10
    assert not folder.exists()
    done = run("join", file, "--json", *here(folder))
    assert done.exit_code == 0, done.stderr
    bodies = [json.loads(one.stdout) for one in (planned, done)]
    assert [faults(body) for body in bodies] == [[], []]
    assert bodies[0]["files"] == bodies[1]["files"]
    assert (folder / "fleet.yaml").read_text() == node.text
    state = StateFile(folder / "state", fleet="hall", node="robot2").load().state
    assert state is not None
    again = run("join", file, *here(folder))
    assert again.exit_code == 0
    assert "already: nothing to do" in again.stdout
    after = StateFile(folder / "state", fleet="hall", node="robot2").load().state
    assert after == state
    assert run("join", "-", *here(tmp_path / "other"), stdin=file.read_text()).exit_code == 0


def test_what_is_no_invitation_is_refused(tmp_path: Path) -> None:
    (tmp_path / "text").write_text("hello")
    (tmp_path / "empty").touch()
    for file, why in (
        (tmp_path / "text", "no whole JSON"),
        (tmp_path / "empty", "it is empty: the command that was to write it was refused"),
        (tmp_path / "none", "No such file"),
        (tmp_path, "a folder"),
    ):
        result = run("join", file, *here(tmp_path / "x"))
        assert result.exit_code == 1
        assert why in result.stderr
    assert not (tmp_path / "x").exists()


# --- certificates ----------------------------------------------------------------------------------------------------


def secured(tmp_path: Path, node: Node) -> Path:
    """The fleet's text with TLS, and an authority on this machine."""
    node.text = TEXT.replace("tcp/", "tls/") + "security: {}\n"
    file = tmp_path / "secured.yaml"
    file.write_text(node.text)
    authority = tmp_path / "authority"
    assert run("pki", "init", "--config", file, "--authority", authority).exit_code == 0
    return authority


def test_in_a_secured_fleet_the_certificate_and_its_key_come_along(node: Node, tmp_path: Path) -> None:
    secured(tmp_path, node)
    file, folder = tmp_path / "robot2.invite", tmp_path / "robot2"
    result = run("invite", "robot2", "--address", "192.0.2.12", "--yes", "-o", file)
    assert result.exit_code == 0, result.stderr
    assert "holds its private key: only you may read it" in result.stderr
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    done = run("join", file, *here(folder))
    assert done.exit_code == 0, done.stderr
    assert "delete the invitation" in done.stdout
    modes = {one.name: stat.S_IMODE(one.stat().st_mode) for one in (folder / "pki").iterdir()}
    assert modes == {"certificate.pem": 0o644, "ca.pem": 0o644, "key.pem": 0o600}
    fleet = load_fleet(folder / "fleet.yaml")
    assert fleet.security is not None
    require_own(fleet, fleet.security, "robot2")
    node.states["robot2"] = "alive"
    again = run("invite", "robot2")
    assert again.exit_code == 1
    assert "is a node of the fleet" in again.stderr


def test_the_command_to_give_again_has_every_option_that_was_given(
    node: Node, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, authority: Path
) -> None:
    secured(tmp_path, node)
    monkeypatch.delenv("ZSCHED_AUTHORITY")
    given = ["--kind", "robot", "--address", "192.0.2.12", "--candidate-for", "merge", "--output", str(tmp_path / "i")]
    given += ["-m", "more hands", "--revision", "7", "--authority", str(authority), "--runtime-dir", str(tmp_path)]
    refused = run("invite", "robot2", *given)
    assert refused.exit_code == 2
    command = refused.stderr.splitlines()[-1]
    assert command == shlex.join(["zsched", "invite", "robot2", *given, "--yes"])
    assert run(*shlex.split(command)[1:]).exit_code == 0
    assert "certificate" in (tmp_path / "i").read_text(), "the authority was found by it"
    assert "--authority" not in node.changes[-1]["reason"], "where it lies is nobody else's"


class Screen(io.StringIO):
    """Somebody looks at it."""

    def isatty(self) -> bool:
        return True


@pytest.mark.usefixtures("node")
def test_who_would_print_an_invitation_is_told_the_same_command_into_a_file(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["invite", "robot2", "--address", "192.0.2.12", "--authority", "stick"]
    monkeypatch.setattr(sys, "argv", ["zsched", *words])
    with contextlib.redirect_stdout(Screen()), pytest.raises(SystemExit) as ended:
        app(words)
    assert ended.value.code == 2
    assert f"the invitation is a file: {shlex.join(['zsched', *words])} > robot2.invite\n" in capsys.readouterr().err


def test_an_authority_that_this_machine_does_not_trust_invites_nobody(
    node: Node, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Beside the file by which the daemon runs lies the certificate of the fleet's own, which is elsewhere."""
    secured(tmp_path, node)
    (tmp_path / "etc" / "pki").mkdir(parents=True)
    monkeypatch.setenv("ZSCHED_CONFIG", str(tmp_path / "etc" / "fleet.yaml"))
    monkeypatch.chdir(tmp_path / "etc" / "pki")  # where the command is given says nothing
    stick = create(tmp_path / "stick", "hall", b"", datetime.now(UTC))
    (tmp_path / "etc" / "pki" / "ca.pem").write_bytes(stick.trusted)
    for more in ((), ("--plan",)):
        refused = run("invite", "robot2", "--yes", *more)
        assert refused.exit_code == 1
        assert f"{tmp_path}/authority holds an authority that {tmp_path}/etc/pki/ca.pem does not know" in refused.stderr
        assert (refused.stdout, node.changes) == ("", [])
    monkeypatch.setenv("ZSCHED_AUTHORITY", str(tmp_path / "stick"))
    assert run("invite", "robot2", "--yes").exit_code == 0


def test_who_had_the_invitations_file_open_before_reads_no_key(node: Node, tmp_path: Path) -> None:
    """In a folder that others write to, it may even be theirs."""
    secured(tmp_path, node)
    file = tmp_path / "robot2.invite"
    file.write_text("")
    with file.open() as theirs:
        result = run("invite", "robot2", "--address", "192.0.2.12", "--yes", "-o", file)
        assert result.exit_code == 0, result.stderr
        assert theirs.read() == ""
    assert "PRIVATE KEY" in file.read_text()
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    link = tmp_path / "link.invite"
    link.symlink_to(file)
    refused = run("invite", "robot2", "--yes", "-o", link)
    assert refused.exit_code == 1
    assert "it is no regular file" in refused.stderr
    assert sorted(one.name for one in tmp_path.glob("*.invite")) == ["link.invite", "robot2.invite"]


@pytest.mark.parametrize("has_left", [False, True], ids=["the invitation was lost", "the machine has left"])
def test_a_machine_that_is_invited_again_gets_another_key_and_the_former_one_is_worth_nothing(
    node: Node, tmp_path: Path, *, has_left: bool
) -> None:
    secured(tmp_path, node)
    alone, words = node.text, ("invite", "robot2", "--yes", "-o")
    assert run(*words, tmp_path / "1.invite", "--address", "192.0.2.12").exit_code == 0
    for number in (2, 3):
        file, folder = tmp_path / f"{number}.invite", tmp_path / f"robot2-{number}"
        node.text = alone if has_left else node.text
        where = ("--address", "192.0.2.12") if has_left else ()
        plan = run("invite", "robot2", "--plan", *where)
        assert (plan.exit_code, "security.revoked" in plan.stderr) == (10, True), plan.stderr
        assert run(*words, file, *where).exit_code == 0
        assert run("join", file, *here(folder)).exit_code == 0
        fleet = load_fleet(folder / "fleet.yaml")
        assert fleet.security is not None
        assert fleet.security.revoked == ("robot2", "robot2.k2")[: number - 1]
        require_own(fleet, fleet.security, "robot2")
        lost = tmp_path / f"stranger-{number}"
        assert run("join", tmp_path / f"{number - 1}.invite", *here(lost)).exit_code == 0
        for name in ("certificate.pem", "key.pem"):
            (folder / "pki" / name).write_bytes((lost / "pki" / name).read_bytes())
        with pytest.raises(ConfigError, match="does not let in"):
            require_own(fleet, fleet.security, "robot2")


def invited_twice(tmp_path: Path, node: Node) -> tuple[Path, Path, Path]:
    """robot2's two invitations, and its folder, where it has joined by the first one."""
    secured(tmp_path, node)
    first, second, folder = tmp_path / "1.invite", tmp_path / "2.invite", tmp_path / "robot2"
    words = ("invite", "robot2", "--yes", "-o")
    assert run(*words, first, "--address", "192.0.2.12").exit_code == 0
    assert run(*words, second).exit_code == 0
    assert run("join", first, *here(folder)).exit_code == 0
    return first, second, folder


def test_a_machine_that_joined_by_an_earlier_invitation_takes_the_key_of_a_later_one(
    node: Node, tmp_path: Path
) -> None:
    """Nobody lets it in by the earlier key, and it cannot leave: the others do not hear it."""
    first, second, folder = invited_twice(tmp_path, node)
    earlier = (folder / "pki" / "key.pem").read_bytes()
    planned = run("join", second, "--plan", *here(folder))
    assert (planned.exit_code, (folder / "pki" / "key.pem").read_bytes()) == (10, earlier), planned.stderr
    with StateFile(folder / "state", fleet="hall", node="robot2"):
        refused = run("join", second, *here(folder))
        assert (refused.exit_code, "stop that daemon first" in refused.stderr) == (1, True)
    taken = run("join", second, *here(folder))
    assert taken.exit_code == 0, taken.stderr
    assert "it joins once more" in taken.stderr
    fleet = load_fleet(folder / "fleet.yaml")
    assert fleet.security is not None
    assert fleet.security.revoked == ("robot2",), "the document of before lets nobody in by the new key"
    require_own(fleet, fleet.security, "robot2")
    assert (folder / "pki" / "key.pem.left").read_bytes() == earlier
    for file in (second, first):
        again = run("join", file, *here(folder))
        assert "nothing to do" in again.stdout, "an earlier key never takes the place of a later one"
    require_own(fleet, fleet.security, "robot2")


def test_a_later_invitation_that_cannot_be_used_leaves_the_machine_the_node_that_it_is(
    node: Node, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A robot's clock may be wrong at its start: its files would be put away, and it would be no node any more."""
    _, second, folder = invited_twice(tmp_path, node)
    before = sorted(str(path) for path in folder.rglob("*"))
    moment = int((datetime.now(UTC) - timedelta(days=400)).timestamp() * 1e9)
    monkeypatch.setattr("zsched.commands.members.belongings.wall_ns", lambda: moment)
    for more in (("--plan",), ()):
        refused = run("join", second, *more, *here(folder))
        assert (refused.exit_code, "and this machine's clock says" in refused.stderr) == (78, True)
        assert sorted(str(path) for path in folder.rglob("*")) == before


def lets_in(folder: Path) -> None:
    """The daemon of robot2 would start by the fleet file, and then by the agreed document, if that is here."""
    fleet = load_fleet(folder / "fleet.yaml")
    assert fleet.security is not None
    require_own(fleet, fleet.security, "robot2")
    state = StateFile(folder / "state", fleet="hall", node="robot2").load().state
    assert state is not None
    library = Library(
        fleet="hall", node="robot2", config=folder / "fleet.yaml", state_dir=folder / "state", post=lambda _event: None
    )
    agreed = read_stored(library, state).fleet
    if agreed is not None:
        assert agreed.security is not None
        require_own(agreed, agreed.security, "robot2")


def test_a_machine_whose_fleet_file_is_gone_gets_it_back_and_keeps_its_state(node: Node, tmp_path: Path) -> None:
    file, folder = tmp_path / "robot2.invite", tmp_path / "robot2"
    file.write_text(run("invite", "robot2", "--address", "192.0.2.12", "--yes").stdout)
    assert run("join", file, *here(folder)).exit_code == 0
    state = (folder / "state" / "state").read_bytes()
    (folder / "fleet.yaml").unlink()
    planned = run("join", file, "--plan", "--json", *here(folder))
    assert (planned.exit_code, (folder / "fleet.yaml").exists()) == (10, False)
    done = run("join", file, "--json", *here(folder))
    assert (done.exit_code, json.loads(done.stdout)["outcome"]) == (0, "joined"), done.stderr
    assert [faults(json.loads(one.stdout)) for one in (planned, done)] == [[], []]
    assert json.loads(planned.stdout)["files"] == json.loads(done.stdout)["files"]
    assert (folder / "fleet.yaml").read_text() == node.text
    assert (folder / "state" / "state").read_bytes() == state
    assert "nothing to do" in run("join", file, *here(folder)).stdout
    (folder / "fleet.yaml").write_text(node.text.replace("fleet: hall", "fleet: yard"))
    refused = run("join", file, *here(folder))
    assert (refused.exit_code, "is the file of fleet yard" in refused.stderr) == (1, True)


@pytest.mark.parametrize("gone", [("fleet.yaml", "pki"), ("pki",), ("pki/key.pem",), ("pki/ca.pem", "fleet.yaml")])
def test_a_machine_whose_system_was_installed_anew_gets_its_certificate_back_and_keeps_its_state(
    node: Node, tmp_path: Path, gone: tuple[str, ...]
) -> None:
    """Its daemon tells it to join. Of an elector's state nothing may be forgotten."""
    secured(tmp_path, node)
    file, folder = tmp_path / "robot2.invite", tmp_path / "robot2"
    assert run("invite", "robot2", "--address", "192.0.2.12", "--yes", "-o", file).exit_code == 0
    assert run("join", file, *here(folder)).exit_code == 0
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    for name in gone:
        path = folder / name
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    done = run("join", file, *here(folder))
    assert done.exit_code == 0, done.stderr
    assert "its state is here, and stays" in done.stdout
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
    assert stat.S_IMODE((folder / "pki" / "key.pem").stat().st_mode) == 0o600
    assert "nothing to do" in run("join", file, *here(folder)).stdout


@pytest.mark.parametrize("is_same", [True, False])
def test_a_new_installation_has_another_machine_id_and_the_state_is_kept_all_the_same(
    node: Node, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, is_same: bool
) -> None:
    """The board's own number tells that it is the same machine; the advice was to move an elector's state away."""
    secured(tmp_path, node)
    file, folder = tmp_path / "robot2.invite", tmp_path / "robot2"
    assert run("invite", "robot2", "--address", "192.0.2.12", "--yes", "-o", file).exit_code == 0
    for module in (state_file, membership_files):
        monkeypatch.setattr(module, "hardware_id", lambda: "machine:aa,serial:cc")
    assert run("join", file, *here(folder)).exit_code == 0
    fleet, before = decode_invitation(file.read_bytes()).fleet, (folder / "state" / "state").read_bytes()
    (folder / "fleet.yaml").unlink()
    anew = f"machine:bb,serial:{'cc' if is_same else 'dd'}"
    for module in (state_file, membership_files):
        monkeypatch.setattr(module, "hardware_id", lambda: anew)
    done = run("join", file, *here(folder))
    assert (done.exit_code == 0) is is_same, done.stderr
    if not is_same:
        assert "was written on another machine" in " ".join(done.stderr.split())
        assert (folder / "state" / "state").read_bytes() == before
        return
    kept = StateFile(folder / "state", fleet=fleet, node="robot2", hardware="machine:bb").load().state
    assert kept is not None, "a service without privileges reads the installation's number alone"
    assert kept.hardware == anew


def test_what_an_invitation_does_not_bring_is_named(node: Node, tmp_path: Path) -> None:
    first, second, folder = invited_twice(tmp_path, node)
    bare = decode_invitation(first.read_bytes())
    (tmp_path / "bare.invite").write_text(encode_invitation(replace(bare, papers=None)))
    assert run("join", second, *here(folder)).exit_code == 0
    state, key = (folder / "state" / "state").read_bytes(), (folder / "pki" / "key.pem")
    for file, why in (
        (tmp_path / "bare.invite", "the invitation brings no certificate; have another invitation written"),
        (first, "is the certificate of 'robot2.k2.hall.zsched.internal', and is left as it is"),
    ):
        key.unlink(missing_ok=True)
        refused = run("join", file, *here(folder))
        assert (refused.exit_code, why in " ".join(refused.stderr.split())) == (1, True), refused.stderr
        assert not key.exists()
    assert run("join", second, *here(folder)).exit_code == 0
    assert (key.exists(), (folder / "state" / "state").read_bytes()) == (True, state)


def test_an_invitation_whose_key_the_agreed_document_has_revoked_is_refused(node: Node, tmp_path: Path) -> None:
    first, second, folder = invited_twice(tmp_path, node)
    other = tmp_path / "other"
    assert run("join", second, *here(other)).exit_code == 0
    shutil.rmtree(other / "pki")
    (other / "fleet.yaml").unlink()
    refused = run("join", first, *here(other))
    assert refused.exit_code == 1
    assert "nobody lets in by the invitation's key (robot2.hall.zsched.internal)" in refused.stderr
    assert "zsched invite robot2" in refused.stderr
    assert not (other / "pki").exists()
    assert "nothing to do" in run("join", first, *here(folder)).stdout


@pytest.mark.parametrize("is_new", [False, True], ids=["it has the earlier key", "its system was installed anew"])
@pytest.mark.parametrize("step", range(10))
def test_a_later_key_is_taken_though_the_power_goes_at_any_step_and_the_state_stays(
    node: Node, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: int, *, is_new: bool
) -> None:
    class PowerCut(BaseException):
        pass

    _, second, folder = invited_twice(tmp_path, node)
    state = (folder / "state" / "state").read_bytes()
    if is_new:
        shutil.rmtree(folder / "pki")
        (folder / "fleet.yaml").unlink()
    left = step

    def cut_after(name: str) -> Callable[..., Any]:
        call = getattr(membership_files, name)

        def done(*words: Any, **more: Any) -> Any:
            nonlocal left
            result = call(*words, **more)
            if (left := left - 1) < 0:
                raise PowerCut
            return result

        return done

    with monkeypatch.context() as patch:
        for name in ("_put_one_away", "_drop_document", "write_whole", "_put"):
            patch.setattr(membership_files, name, cut_after(name))
        with suppress(PowerCut):
            run("join", second, *here(folder))
    done = run("join", second, *here(folder))
    assert done.exit_code == 0, done.stderr
    certificate = (folder / "pki" / "certificate.pem").read_bytes()
    assert common_names(certificate) == ("robot2.k2.hall.zsched.internal",)
    assert is_key_of((folder / "pki" / "key.pem").read_bytes(), certificate)
    lets_in(folder)
    assert copied_file(folder / "state") == fleet_hash(load_fleet(folder / "fleet.yaml"))
    assert (folder / "state" / "state").read_bytes() == state
    assert "nothing to do" in run("join", second, *here(folder)).stdout


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP, signal.SIGTERM])
def test_a_signal_while_a_later_key_is_taken_leaves_no_half_of_it(
    node: Node,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
    number: signal.Signals,
) -> None:
    def ended(*_: Any) -> None:
        pytest.fail("the signal ends the verb")

    _, second, folder = invited_twice(tmp_path, node)
    put = membership_files._put_one_away

    def interrupted(*words: Any, **more: Any) -> None:
        put(*words, **more)
        signal.raise_signal(number)

    monkeypatch.setattr(membership_files, "_put_one_away", interrupted)
    before = signal.signal(number, ended)
    request.addfinalizer(lambda: signal.signal(number, before))
    assert run("join", second, *here(folder)).exit_code == 0
    lets_in(folder)


def test_a_request_for_the_same_key_is_answered_again(node: Node, tmp_path: Path) -> None:
    secured(tmp_path, node)
    folder, csr, file = tmp_path / "robot2", tmp_path / "robot2.csr", tmp_path / "robot2.invite"
    assert run("join", "--request", "robot2", "-o", csr, *here(folder)).exit_code == 0
    assert run("invite", "robot2", "--address", "192.0.2.12", "--csr", csr, "--yes", "-o", file).exit_code == 0
    assert run("invite", "robot2", "--csr", csr, "-o", file).exit_code == 0, "the document stays as it is"
    assert run("join", file, *here(folder)).exit_code == 0
    fleet = load_fleet(folder / "fleet.yaml")
    assert fleet.security is not None
    assert fleet.security.revoked == ()
    require_own(fleet, fleet.security, "robot2")


def test_a_key_that_the_machine_made_stays_there(node: Node, tmp_path: Path) -> None:
    secured(tmp_path, node)
    folder, csr, file = tmp_path / "robot2", tmp_path / "robot2.csr", tmp_path / "robot2.invite"
    asked = run("join", "--request", "robot2", "-o", csr, "--json", *here(folder))
    assert asked.exit_code == 0, asked.stderr
    assert faults(json.loads(asked.stdout)) == []
    assert "zsched invite robot2 --csr robot2.csr" in json.loads(asked.stdout)["next"][0]
    key = (folder / "pki" / "key.pem").read_bytes()
    assert stat.S_IMODE((folder / "pki" / "key.pem").stat().st_mode) == 0o600
    assert stat.S_IMODE((folder / "pki").stat().st_mode) == 0o755
    assert run("join", "--request", "robot2", "-o", csr, *here(folder)).exit_code == 0
    assert (folder / "pki" / "key.pem").read_bytes() == key, "a second request is for the same key"

    result = run("invite", "robot2", "--address", "192.0.2.12", "--csr", csr, "--yes", "-o", file)
    assert result.exit_code == 0, result.stderr
    assert "private key" not in result.stderr
    given = decode_invitation(file.read_bytes()).papers
    assert given is not None
    assert given.key == ""
    assert "PRIVATE" not in file.read_text()

    elsewhere = run("join", file, *here(tmp_path / "other"))
    assert elsewhere.exit_code == 1
    assert "key.pem is not there, and the invitation brings no key" in elsewhere.stderr
    run("join", "--request", "robot2", "-o", tmp_path / "other.csr", *here(tmp_path / "third"))
    another = run("join", file, *here(tmp_path / "third"))
    assert "is another key than the one that the certificate is for" in another.stderr
    done = run("join", file, *here(folder))
    assert done.exit_code == 0, done.stderr
    assert "delete the invitation" not in done.stdout
    assert (folder / "pki" / "key.pem").read_bytes() == key
    fleet = load_fleet(folder / "fleet.yaml")
    assert fleet.security is not None
    require_own(fleet, fleet.security, "robot2")
    assert "certificate.pem is there already" in run("join", "--request", "robot2", *here(folder)).stderr


def test_a_request_that_cannot_be_answered_changes_nothing(node: Node, tmp_path: Path) -> None:
    node.text = TEXT.replace("tcp/", "tls/") + "security: {}\n"
    (tmp_path / "some.csr").write_text("hello")
    words = ("invite", "robot2", "--yes", "--csr", tmp_path / "some.csr")
    assert "the authority of fleet hall is not on this machine" in run(*words).stderr
    secured(tmp_path, node)
    assert "it is no certificate request in PEM" in run(*words).stderr
    assert "cannot be read" in run("invite", "robot2", "--yes", "--csr", tmp_path / "none").stderr
    assert node.changes == []
    for more in ((), ("file", "--request", "robot2"), ("--request", "robot2", "--plan"), ("file", "-o", "x")):
        assert run("join", *more, *here(tmp_path / "x")).exit_code == 2
    assert run("join", "--request", "Robot 2", *here(tmp_path / "x")).exit_code == 2
    assert not (tmp_path / "x").exists()


def test_a_wrong_passphrase_invites_nobody(node: Node, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ZSCHED_AUTHORITY_PASSPHRASE", "secret")
    secured(tmp_path, node)
    words = ("invite", "robot2", "--address", "192.0.2.12", "--yes", "-o", tmp_path / "robot2.invite")
    monkeypatch.setenv("ZSCHED_AUTHORITY_PASSPHRASE", "secrte")
    refused = run(*words)
    assert refused.exit_code == 1
    assert "the passphrase is wrong" in refused.stderr
    assert node.changes == []
    monkeypatch.setenv("ZSCHED_AUTHORITY_PASSPHRASE", "secret")
    done = run(*words)
    assert done.exit_code == 0, done.stderr
    assert len(node.changes) == 1


def test_another_machines_certificate_is_left_as_it_is(node: Node, tmp_path: Path) -> None:
    secured(tmp_path, node)
    node.states["robot2"] = node.states["robot4"] = "gone"
    for name in ("robot2", "robot4"):
        assert run("invite", name, "--address", f"192.0.2.1{name[-1]}", "--yes", "-o", tmp_path / name).exit_code == 0
    folder = tmp_path / "machine"
    assert run("join", tmp_path / "robot2", *here(folder)).exit_code == 0
    before = (folder / "pki" / "key.pem").read_bytes()
    other = run("join", tmp_path / "robot4", "--config", folder / "fleet.yaml", "--state-dir", folder / "state2")
    assert other.exit_code == 1
    assert "is the certificate of 'robot2.hall.zsched.internal'" in other.stderr
    assert (folder / "pki" / "key.pem").read_bytes() == before


def test_an_invitation_whose_parts_do_not_go_together_changes_nothing(
    node: Node, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else the machine has the files, and a daemon that nobody lets in."""
    secured(tmp_path, node)
    file, folder = tmp_path / "robot2.invite", tmp_path / "robot2"
    assert run("invite", "robot2", "--address", "192.0.2.12", "--yes", "-o", file).exit_code == 0
    whole = decode_invitation(file.read_bytes())
    assert whole.papers is not None
    other = create(tmp_path / "other", "hall", b"", datetime.now(UTC))
    theirs = other.issue("robot2", Role.NODE, (), b"", b"", datetime.now(UTC))
    stranger = other.issue("robot1", Role.NODE, (), b"", b"", datetime.now(UTC))
    for brought, why in (
        (replace(whole.papers, key=theirs.key.decode()), "is for another key than the one that it brings"),
        (replace(whole.papers, key="junk"), "cannot be used: "),
        (replace(whole.papers, trusted=theirs.trusted.decode()), "is of another authority than the one"),
        (replace(whole.papers, trusted="junk"), "cannot be used: there is no certificate in it"),
        (replace(whole.papers, certificate="junk"), "names None, and its node is robot2"),
        (replace(whole.papers, certificate=stranger.certificate.decode()), "names 'robot1.hall.zsched.internal'"),
    ):
        file.write_text(encode_invitation(replace(whole, papers=brought)))
        done = run("join", file, *here(folder))
        assert done.exit_code == 78, done.stderr
        assert f"the invitation's certificate {why}" in done.stderr
        assert not folder.exists()
    file.write_text(encode_invitation(whole))
    for later, then in ((timedelta(days=31), "31 days later"), (timedelta(days=-2), "before it was made")):
        moment = int((datetime.now(UTC) + later).timestamp() * 1e9)
        monkeypatch.setattr("zsched.commands.members.belongings.wall_ns", lambda moment=moment: moment)
        done = run("join", file, *here(folder))
        assert done.exit_code == 78, then
        assert "and this machine's clock says" in done.stderr
        assert not folder.exists()


@pytest.mark.parametrize("name", ["key.pem", "ca.pem"])
def test_a_key_and_authorities_that_lie_where_an_invitation_s_go_are_left_as_they_are(
    node: Node, tmp_path: Path, name: str
) -> None:
    """The document says where: `folder:` may name any place, and `join` runs as root."""
    secured(tmp_path, node)
    file, folder = tmp_path / "robot2.invite", tmp_path / "robot2"
    assert run("invite", "robot2", "--address", "192.0.2.12", "--yes", "-o", file).exit_code == 0
    place = folder / "pki" / name
    place.parent.mkdir(parents=True)
    place.write_text("somebody's own")
    refused = run("join", file, *here(folder))
    assert refused.exit_code == 1
    assert f"{place} is not the invitation's, and is left as it is; move it away" in " ".join(refused.stderr.split())
    assert [one.name for one in place.parent.iterdir()] == [name]
    assert place.read_text() == "somebody's own"
    brought = decode_invitation(file.read_bytes()).papers
    assert brought is not None
    place.write_text(brought.key if name == "key.pem" else brought.trusted)  # of a try that was broken off
    done = run("join", file, *here(folder))
    assert done.exit_code == 0, done.stderr


def test_a_file_that_stdout_is_is_private_before_anything_is_asked(node: Node, tmp_path: Path) -> None:
    """Who has opened it while others could read it reads what comes later, too."""
    secured(tmp_path, node)
    file, modes = tmp_path / "robot3.invite", set[int]()
    file.touch(0o644)
    node.look = lambda: modes.add(stat.S_IMODE(file.stat().st_mode))
    with file.open("w") as stdout:
        command = [sys.executable, "-m", "zsched.cli", "invite", "robot3", "--yes"]
        subprocess.run(command, stdout=stdout, stderr=subprocess.PIPE, timeout=60, check=True)
    assert modes == {0o600}
    assert decode_invitation(file.read_bytes()).papers is not None


def test_how_to_start_names_a_node_that_its_host_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also where this shell has ZSCHED_NODE: `sudo` and systemd do not pass it on."""
    monkeypatch.setattr("socket.gethostname", lambda: "Robot1.local")
    monkeypatch.setenv("ZSCHED_NODE", "foo")
    where = Places(config=Path("/etc/zsched/fleet.yaml"), state=Path("/var/lib/zsched"))
    unit = "sudo systemctl enable --now zsched (or in the foreground: sudo zsched up{})"
    assert how_to_start("robot1", where) == (unit.format(""),)
    told = how_to_start("foo", where)
    assert "Environment=ZSCHED_NODE=foo" in told[0]
    assert told[1:] == (unit.format(" --node foo"),)
