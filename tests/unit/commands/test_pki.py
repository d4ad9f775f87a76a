"""`zsched pki`: what each verb writes, prints and refuses."""

from __future__ import annotations

import json
import stat
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from support.schemas import faults
from zsched.cli import app
from zsched.host.operator_socket import OperatorSocket
from zsched.link.sessions.certificate import common_names

Json = dict[str, Any]
FLEET = """\
fleet: yard
nodes:
  robot1: {kind: robot, host: 192.0.2.1, listen: {control: tls/0.0.0.0:7457, data: tls/0.0.0.0:7458}}
  robot2: {kind: robot}
security: {operators: [ana]}
"""


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    (tmp_path / "fleet.yaml").write_text(FLEET)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("ZSCHED_CONFIG", str(tmp_path / "fleet.yaml"))
    monkeypatch.setenv("ZSCHED_AUTHORITY", str(tmp_path / "authority"))
    monkeypatch.setenv("ZSCHED_RUNTIME_DIR", str(tmp_path / "run"))  # no daemon of this machine is asked
    monkeypatch.delenv("ZSCHED_AUTHORITY_PASSPHRASE", raising=False)
    return tmp_path


def pki(*words: str, code: int = 0, told: str | None = None) -> Result:
    result = CliRunner().invoke(app, ["pki", *words], input=told)
    assert result.exit_code == code, result.output
    return result


def test_init_says_where_the_key_lies_and_how_to_take_it_offline(here: Path) -> None:
    said = pki("init").stdout
    assert f"its key is {here}/authority/ca-1.key (not locked: --passphrase does that)" in said
    assert "To take it offline, move the whole folder" in said
    assert "next: `zsched pki issue robot1`" in said
    assert "holds an authority" in pki("init", code=1).stderr


def of_another_authority(here: Path) -> None:
    """This machine trusts the fleet's authority, which lies elsewhere."""
    pki("init", "--authority", str(here / "stick"))
    (here / "pki").mkdir()
    (here / "pki" / "ca.pem").write_bytes((here / "stick" / "ca.pem").read_bytes())


def test_where_the_fleet_s_authority_is_elsewhere_no_second_one_is_made_without_its_danger(here: Path) -> None:
    of_another_authority(here)
    for words in (("show",), ("issue", "robot1"), ("renew",)):
        told = " ".join(pki(*words, code=1).stderr.split())
        assert f"there is no authority in {here}/authority; fleet yard has an authority already" in told
        assert f"({here}/pki/ca.pem names it), on another machine or a stick" in told
        assert "name it with --authority DIR" in told
        assert "pki init" not in told
    refused = " ".join(pki("init", code=1).stderr.split())
    assert "fleet yard has an authority already" in refused
    assert "--accept second-authority" in refused
    assert not (here / "authority").exists()
    assert (
        "there is no danger 'second'; did you mean second-authority?"
        in pki("init", "--accept", "second", code=2).stderr
    )
    pki("init", "--accept", "second-authority")
    assert (here / "authority" / "ca-1.key").exists()


def test_an_authority_that_this_machine_does_not_trust_issues_nothing(here: Path) -> None:
    of_another_authority(here)
    pki("init", "--accept", "second-authority")
    refused = " ".join(pki("issue", "robot1", code=1).stderr.split())
    assert f"{here}/authority holds an authority that {here}/pki/ca.pem does not know" in refused
    assert "name the fleet's own with --authority DIR" in refused
    assert not (here / "robot1").exists()
    assert json.loads(pki("show", "--json").stdout)["certificates"] == [], "nothing was issued"
    pki("rotate", "--authority", str(here / "stick"))
    pki("issue", "robot1", "--authority", str(here / "stick"))
    (here / "pki" / "ca.pem").write_text("torn")
    assert "pki/ca.pem" in pki("issue", "robot2", "--authority", str(here / "stick"), code=1).stderr
    (here / "pki" / "ca.pem").write_bytes((here / "authority" / "ca.pem").read_bytes())
    pki("issue", "robot2", "--out", "second")


def test_issue_writes_three_files_of_which_only_the_key_is_secret(here: Path) -> None:
    pki("init")
    said = pki("issue", "robot1").stdout
    assert "sudo install -m 600 robot1/key.pem /etc/zsched/pki/" in said
    modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in (here / "robot1").iterdir()}
    assert modes == {"key.pem": 0o600, "certificate.pem": 0o644, "ca.pem": 0o644}
    assert common_names((here / "robot1" / "certificate.pem").read_bytes()) == ("robot1.yard.zsched.internal",)
    pki("issue", "ana", "--role", "operator", "--out", "laptop")
    assert common_names((here / "laptop" / "certificate.pem").read_bytes()) == ("ana.operator.yard.zsched.internal",)


def test_somebody_else_s_files_are_not_written_over(here: Path) -> None:
    """On a robot the folder `pki` beside the fleet file is the robot's own, and of its key there is no other copy."""
    pki("init")
    pki("issue", "robot1", "--out", "pki")
    before = {path.name: path.read_bytes() for path in (here / "pki").iterdir()}
    refused = " ".join(pki("issue", "ana", "--role", "operator", "--out", "pki", code=1).stderr.split())
    assert "pki/certificate.pem (robot1.yard.zsched.internal) is there, and is left as it is" in refused
    pki("issue", "ana", "--role", "operator", "--out", "ana")
    assert "(robot1.yard" in pki("renew", "ana.operator", "--out", "pki", code=1).stderr
    (here / "pki" / "certificate.pem").unlink()
    assert "pki/key.pem is there" in " ".join(pki("issue", "robot2", "--out", "pki", code=1).stderr.split())
    del before["certificate.pem"]
    assert {path.name: path.read_bytes() for path in (here / "pki").iterdir()} == before
    names = [one["name"] for one in json.loads(pki("show", "--json").stdout)["certificates"]]
    assert names == ["ana.operator", "robot1"], "nothing was issued"
    pki("renew", "robot1", "--out", "pki")
    pki("renew", "robot1", "--out", "pki")
    pki("revoke", "robot1")
    (here / "pki" / "key.pem").unlink()
    pki("issue", "robot1", "--out", "pki")
    assert common_names((here / "pki" / "certificate.pem").read_bytes()) == ("robot1.k2.yard.zsched.internal",)


def test_a_second_fleet_s_machine_of_the_same_name_keeps_the_first_one_s_key(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pki("init")
    pki("issue", "robot1")
    before = {path.name: path.read_bytes() for path in (here / "robot1").iterdir()}
    assert "robot1 has a certificate until" in " ".join(pki("issue", "robot1", code=1).stderr.split())
    (here / "fleet.yaml").write_text(FLEET.replace("yard", "hall"))
    monkeypatch.setenv("ZSCHED_AUTHORITY", str(here / "hall-s"))
    pki("init")
    refused = " ".join(pki("issue", "robot1", code=1).stderr.split())
    assert "robot1/certificate.pem (robot1.yard.zsched.internal) is there, and is left as it is" in refused
    assert json.loads(pki("show", "--json").stdout)["certificates"] == [], "nothing was issued"
    pki("issue", "robot1", "--out", "elsewhere")
    assert "(robot1.yard" in pki("renew", "robot1", code=1).stderr
    (here / "robot1" / "certificate.pem").unlink()
    del before["certificate.pem"]
    pki("revoke", "robot1")
    (here / "robot1.k2").mkdir()
    (here / "robot1.k2" / "key.pem").write_bytes(before["key.pem"])
    assert "robot1.k2/key.pem is there" in " ".join(pki("issue", "robot1", code=1).stderr.split())
    assert (here / "robot1.k2" / "key.pem").read_bytes() == before["key.pem"]
    assert {path.name: path.read_bytes() for path in (here / "robot1").iterdir()} == before


def test_names_that_the_fleet_file_does_not_fit_are_refused_or_told(here: Path) -> None:
    pki("init")
    assert "did you mean robot1?; for people: --role operator" in pki("issue", "robt1", code=2).stderr
    assert "'robot1' is a node" in pki("issue", "robot1", "--role", "guest", code=2).stderr
    assert "is not a name" in pki("issue", "Ana", "--role", "guest", code=2).stderr
    assert "write bob under `security: {guests: [...]}`" in pki("issue", "bob", "--role", "guest").stdout
    assert "there is no authority" in pki("show", "--authority", str(here / "none"), code=1).stderr


def test_a_locked_key_asks_for_its_passphrase(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pki("init", "--passphrase", told="open sesame\nopen sesame\n")
    assert "the passphrase is wrong" in pki("issue", "robot1", code=1, told="open\n").stderr
    nobody = pki("issue", "robot1", code=1, told="").stderr  # as a timer, without a terminal
    assert "run this on a terminal, or set ZSCHED_AUTHORITY_PASSPHRASE" in nobody
    monkeypatch.setenv("CREDENTIALS_DIRECTORY", str(here))
    (here / "passphrase").write_text("open sesame\n")
    pki("issue", "robot2")
    monkeypatch.setenv("ZSCHED_AUTHORITY_PASSPHRASE", "open sesame")
    pki("issue", "robot1")
    assert (here / "robot1" / "key.pem").exists()


def test_show_tells_every_key_and_its_json_is_of_the_schema(here: Path) -> None:
    pki("init")
    pki("issue", "robot1")
    pki("issue", "ana", "--role", "operator")
    pki("revoke", "robot1")
    said = pki("show").stdout
    assert f"authority 1 of fleet yard in {here}/authority\n" in said
    assert [line.split()[::4] for line in said.splitlines()[1:]] == [["ana.operator", "valid"], ["robot1", "revoked"]]
    body = json.loads(pki("show", "--json").stdout)
    assert not list(faults(body))
    assert [(one["name"], one["role"], one["key"], one["state"]) for one in body["certificates"]] == [
        ("ana.operator", "operator", 1, "valid"),
        ("robot1", "node", 1, "revoked"),
    ]


def test_revoke_says_which_line_keeps_the_key_out_and_the_next_key_has_a_number(here: Path) -> None:
    pki("init")
    pki("issue", "robot1")
    assert "`security: {revoked: [robot1]}`" in pki("revoke", "robot1").stdout
    assert "robot1.k2" in pki("issue", "robot1").stdout
    assert (here / "robot1.k2" / "key.pem").exists()
    assert "no certificate 'robot3'; `zsched pki show`" in pki("revoke", "robot3", code=1).stderr
    pki("issue", "ana", "--role", "operator")
    assert "no certificate 'ana', did you mean ana.operator?" in pki("revoke", "ana", code=1).stderr


def test_renew_takes_what_is_due_or_one_by_name_and_makes_no_key(here: Path) -> None:
    pki("init")
    pki("issue", "robot1", "--out", "first")
    assert pki("renew").stdout == "no certificate is due\n"
    assert "--csr and --out go with a NAME" in pki("renew", "--out", "x", code=2).stderr
    pki("renew", "robot1")
    assert sorted(path.name for path in (here / "robot1").iterdir()) == ["ca.pem", "certificate.pem"]


def test_a_certificate_that_cannot_be_written_is_written_by_its_name(here: Path) -> None:
    """The authority has recorded it, and takes it for renewed."""
    pki("init")
    pki("issue", "robot1", "--out", "first")
    pki("rotate")
    (here / "robot1").write_text("no folder")
    failed = " ".join(pki("renew", code=1).stderr.split())
    assert "robot1: cannot be written: " in failed
    assert "so it is not due any more: `zsched pki renew robot1` writes it again" in failed
    assert pki("renew").stdout == "no certificate is due\n"
    (here / "robot1").unlink()
    assert "robot1: certificate.pem" in pki("renew", "robot1").stdout


def test_what_is_due_is_sent_to_the_nodes_and_so_is_what_a_node_has_missed(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Json] = []
    outcomes, members = {"robot1": "ok", "robot2": "invalid"}, ["robot1", "robot2"]

    def answer(request: Json) -> Json:
        if request["verb"] == "status":
            return {"fleet": "yard", "nodes": [{"name": name} for name in members]}
        asked.append(request)
        return {"outcome": outcomes[request["node"]], "detail": "as it is", "revision": None}

    pki("init")
    for name in ("robot1", "robot2"):
        pki("issue", name)
    pki("issue", "ana", "--role", "operator")
    with closing(OperatorSocket(here / "robot1.sock", answer)) as door:
        door.open()
        monkeypatch.setenv("ZSCHED_NODE", "robot1")
        words = ("renew", "--deliver", "--runtime-dir", str(here))
        said = pki(*words, code=1)
        assert said.stdout == "robot1: as it is\nrobot2: as it is\n"
        first = (here / "robot1" / "certificate.pem").read_text()
        assert [(one["node"], one["certificate"] == first) for one in asked] == [("robot1", True), ("robot2", False)]
        outcomes["robot2"] = "unchanged"
        asked.clear()
        pki(*words, "robot1")
        assert [(one["node"], one["certificate"] == first) for one in asked] == [("robot1", False)], "a newer one"
        pki("revoke", "robot1")
        asked.clear()
        pki(*words)
        assert [one["node"] for one in asked] == ["robot2"], "nobody renews a revoked key"
        assert "no node's key 'ana.operator'" in pki(*words, "ana.operator", code=2).stderr
        members.remove("robot2")
        asked.clear()
        ended = json.loads(pki("show", "--json").stdout)
        refused = " ".join(pki(*words, "robot2", code=1).stderr.split())
        assert "robot2: the fleet has no node robot2; nothing was renewed or sent" in refused
        assert (asked, json.loads(pki("show", "--json").stdout)) == ([], ended)
        pki(*words)
        pki("rotate")
        ended = json.loads(pki("show", "--json").stdout)
        assert pki(*words).stdout == (
            "robot2: due, and not renewed: the fleet has no node robot2; `zsched pki revoke robot2` ends it\n"
        )
        assert (asked, json.loads(pki("show", "--json").stdout)) == ([], ended)
        assert "go without --deliver" in pki(*words, "robot2", "--out", "x", code=2).stderr


def test_nothing_is_sent_by_the_nodes_of_another_fleet_nor_is_a_key_called_a_stray(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The keys of all nodes would be due and of no node, with the advice to revoke them."""
    asked = list[str]()

    def answer(request: Json) -> Json:
        asked.append(request["verb"])
        return {"fleet": "hall", "nodes": [{"name": "crane1"}]}

    pki("init")
    pki("issue", "robot1")
    pki("rotate")
    before = json.loads(pki("show", "--json").stdout)
    (here / "fleet.yaml").write_text(f"{FLEET}site: {{hall: {{gateways: [tls/192.0.2.9:7457], file: hall.yaml}}}}\n")
    with closing(OperatorSocket(here / "crane1.sock", answer)) as door:
        door.open()
        monkeypatch.setenv("ZSCHED_NODE", "crane1")
        words = ("renew", "--deliver", "--runtime-dir", str(here))
        for more in ((), ("robot1",)):
            refused = pki(*words, *more, code=2)
            assert "is the authority of fleet yard, and who answers is of hall" in " ".join(refused.stderr.split())
            assert "revoke" not in refused.output
        assert set(asked) == {"status"}
        monkeypatch.setenv("ZSCHED_RUNTIME_DIR", str(here))
        refused = pki(*words, "--node", "hall/crane1", code=2)
        assert "--node: hall is another fleet of the site" in " ".join(refused.stderr.split())
    assert json.loads(pki("show", "--json").stdout) == before


def test_no_certificate_of_a_new_authority_is_sent_while_a_node_would_not_know_it(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The nodes that go by theirs would be cut off from it, and a majority with them."""
    ups, asked = {"robot1": 0.0, "robot2": 3600.0}, list[str]()

    def answer(request: Json) -> Json:
        if request["verb"] == "status":
            nodes = [{"name": "robot1"}, {"name": "robot2"}]
            return {"fleet": "yard", "nodes": nodes, "up_s": ups[request.get("node", "robot1")]}
        asked.append(request["node"])
        return {"outcome": "ok", "detail": "as it is", "revision": None}

    pki("init")
    for name in ("robot1", "robot2"):
        pki("issue", name)
    assert "wait until each daemon has begun anew" in pki("rotate").stdout
    monkeypatch.setenv("ZSCHED_RUNTIME_DIR", str(here))
    with closing(OperatorSocket(here / "robot1.sock", answer)) as door:
        door.open()
        monkeypatch.setenv("ZSCHED_NODE", "robot1")
        words = ("renew", "--deliver", "--runtime-dir", str(here))
        refused = pki(*words, code=1)
        assert "nothing was sent: robot2: not begun anew since the new authority was made" in refused.stderr
        assert not asked
        pki("renew")
        assert "nothing was sent: robot2" in pki("rotate", "--finish", code=1).stderr
        assert not asked
        ups["robot2"] = 0.0
        pki(*words)
        assert asked == ["robot1", "robot2"]


def test_a_node_in_the_life_that_it_had_at_the_rotation_is_old_by_any_clock(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The clock of the authority's machine was set forward since: nobody has been up for so long."""
    lives = {"robot1": 7, "robot2": 8}

    def answer(request: Json) -> Json:
        if request["verb"] == "status":
            nodes = [{"name": name, "incarnation": life} for name, life in lives.items()]
            own = lives[request.get("node", "robot1")]
            return {"fleet": "yard", "nodes": nodes, "incarnation": own, "up_s": 0.0}
        return {"outcome": "unchanged", "detail": "as it is", "revision": None}

    pki("init")
    for name in ("robot1", "robot2"):
        pki("issue", name)
    monkeypatch.setenv("ZSCHED_RUNTIME_DIR", str(here))
    with closing(OperatorSocket(here / "robot1.sock", answer)) as door:
        door.open()
        monkeypatch.setenv("ZSCHED_NODE", "robot1")
        pki("rotate")
        pki("renew")
        lives["robot1"] = 9
        assert "nothing was sent: robot2: not begun anew" in pki("rotate", "--finish", code=1).stderr
        lives["robot2"] = 6  # a robot without a clock of its own
        pki("rotate", "--finish")
        assert json.loads((here / "authority" / "authority.json").read_text())["lives"] == []


def test_names_are_those_of_the_document_where_a_daemon_tells_one(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The fleet file may be a copy from before the newest node came."""
    told: Json = {
        "node": "robot1", "fleet": "yard", "revision": 2, "number": 1, "settled": True, "electors": [],
        "document": "a" * 64, "text": FLEET.replace("robot2:", "robot9:"), "flags": [],
    }  # fmt: skip
    pki("init")
    monkeypatch.setenv("ZSCHED_RUNTIME_DIR", str(here))
    with closing(OperatorSocket(here / "robot1.sock", lambda _request: told)) as door:
        door.open()
        pki("issue", "robot9")
        assert "no node 'robot2'" in pki("issue", "robot2", code=2).stderr
        told["text"] = told["text"].replace("yard", "hall")  # another fleet's daemon
        pki("issue", "robot2")
    assert "no node 'robot8'" in pki("issue", "robot8", code=2).stderr, "no daemon: the file holds"


def test_a_rotation_ends_once_everything_is_renewed(here: Path) -> None:
    pki("init")
    pki("issue", "robot1")
    assert "zsched pki rotate --finish" in pki("rotate").stdout
    assert "signed the certificates of robot1" in pki("rotate", "--finish", code=1).stderr
    assert "robot1: certificate.pem" in pki("renew").stdout
    assert (here / "robot1" / "ca.pem").read_text().count("BEGIN CERTIFICATE") == 2
    pki("rotate", "--finish")
    assert (here / "authority" / "ca.pem").read_text().count("BEGIN CERTIFICATE") == 1


def test_a_rotation_does_not_end_while_a_node_has_no_certificate_of_the_new_authority(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The others would trust the former one no more, and cut it off."""
    told: Json = {"fleet": "yard", "nodes": [{"name": "robot1"}, {"name": "robot2"}]}
    outcomes = {"robot1": "unchanged", "robot2": "invalid"}

    def answer(request: Json) -> Json:
        if request["verb"] == "status":
            return told
        return {"outcome": outcomes[request["node"]], "detail": "as it is", "revision": None}

    pki("init")
    for name in ("robot1", "robot2"):
        pki("issue", name)
    pki("rotate")
    pki("renew")
    monkeypatch.setenv("ZSCHED_RUNTIME_DIR", str(here))
    with closing(OperatorSocket(here / "robot1.sock", answer)) as door:
        door.open()
        refused = pki("rotate", "--finish", code=1)
        assert "robot2: no certificate of the new authority there" in refused.stderr
        assert (here / "authority" / "ca.pem").read_text().count("BEGIN CERTIFICATE") == 2
        assert (here / "authority" / "ca-1.key").exists()
        outcomes["robot2"] = "ok"
        assert "robot2: sent just now; again once" in pki("rotate", "--finish", code=1).stderr
        outcomes["robot2"] = "invalid"
        told["nodes"] = told["nodes"][:1]  # robot2 has left the fleet
        pki("rotate", "--finish")
    assert (here / "authority" / "ca.pem").read_text().count("BEGIN CERTIFICATE") == 1


def test_a_daemon_of_another_fleet_is_not_asked_at_the_end_of_a_rotation(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def answer(request: Json) -> Json:
        return {"status": {"fleet": "hall", "nodes": []}}[request["verb"]]

    pki("init")
    pki("rotate")
    monkeypatch.setenv("ZSCHED_RUNTIME_DIR", str(here))
    with closing(OperatorSocket(here / "robot1.sock", answer)) as door:
        door.open()
        assert "no daemon of the fleet answers here" in pki("rotate", "--finish").stdout


def test_a_daemon_that_does_not_answer_is_not_taken_for_none_in_a_rotation(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its fleet's nodes may lack their new certificates: the former key would be gone, and they would be cut off."""

    def refuse(_request: Json) -> Json:
        return {"error": "the document is not read yet"}

    pki("init")
    monkeypatch.setenv("ZSCHED_RUNTIME_DIR", str(here))
    with closing(OperatorSocket(here / "robot1.sock", refuse)) as door:
        door.open()
        assert "not read yet" in pki("rotate", code=1).stderr
        assert not (here / "authority" / "ca-2.key").exists(), "nobody has seen who has to begin anew"
    pki("rotate")
    with closing(OperatorSocket(here / "robot1.sock", refuse)) as door:
        door.open()
        assert "not read yet" in pki("rotate", "--finish", code=1).stderr
        monkeypatch.setenv("ZSCHED_NODE", "robot9")
        assert "robot9" in pki("rotate", "--finish", code=3).stderr
    assert (here / "authority" / "ca-1.key").exists()
    assert (here / "authority" / "ca.pem").read_text().count("BEGIN CERTIFICATE") == 2
