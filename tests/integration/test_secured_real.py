"""A real secured fleet: every process has its certificate and its access rules, and the streams run and move."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import zenoh

from support.authorities import install, secured
from zsched.commands.base.ask import Door, _client, _visit, ask_door
from zsched.commands.base.change import user_name
from zsched.config.load import load_fleet
from zsched.core.values import codec as wire
from zsched.core.values.certificates import Role
from zsched.core.values.messages import Accept, Prepare, Promise
from zsched.core.values.model import Ballot
from zsched.host.operator_client import ask
from zsched.link.keyspace import Keyspace
from zsched.link.sessions.access_rules import Side
from zsched.link.sessions.config import client_config
from zsched.link.sessions.tls import session_text
from zsched.pki.authority import opened
from zsched_lab.fleet.secured import without_rules
from zsched_lab.fleet.testbed import TASK, Json, Testbed, echo_fleet


def with_people(folder: Path) -> Json:
    """Two robots, and two edges of which one gives no address; an operator and a guest have a folder of their own."""
    tree = echo_fleet(robots=2, edges=2, stream_class="reliable")
    secured(tree, folder, security={"operators": ["ana"], "guests": ["screen"], "orders": ["robot1", "robot2"]})
    del tree["nodes"]["edge2"]["host"], tree["nodes"]["edge2"]["listen"]
    with opened(folder / "authority", tree["fleet"]) as authority:
        for name, role in (("ana", Role.OPERATOR), ("screen", Role.GUEST)):
            install(authority, folder / name / "pki", name, role)
            (folder / name / "fleet.yaml").write_text(json.dumps(tree))
    return tree


@pytest.fixture(scope="module")
def bed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Testbed]:
    folder = tmp_path_factory.mktemp("secured")
    with Testbed(folder, with_people(folder)) as testbed:
        testbed.init()
        testbed.start()
        testbed.wait_settled(90)
        yield testbed


def zsched(bed: Testbed, node: str, *words: str) -> subprocess.CompletedProcess[str]:
    """A verb on the machine of a node, or (a folder of its own) of a person."""
    home = bed.folder / node
    given = {"CREDENTIALS_DIRECTORY": str(bed.folder / "pki" / node), "ZSCHED_CONFIG": str(bed.file)}
    if (home / "fleet.yaml").exists():
        given = {"ZSCHED_CONFIG": str(home / "fleet.yaml")}
    env = {**os.environ, **given, "ZSCHED_NODE": node, "ZSCHED_RUNTIME_DIR": str(bed.folder)}
    command = [sys.executable, "-m", "zsched.cli", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False, env=env)


def test_an_operator_commands_from_elsewhere_and_a_guest_only_looks(bed: Testbed) -> None:
    endpoint = bed.fleet.node("robot1").listen_control
    for name, more, node in (("ana", [], "robot1"), ("screen", ["--node", "edge2"], "edge2")):
        seen = zsched(bed, name, "status", "--connect", endpoint, "--json", *more)
        assert seen.returncode == 0, seen.stderr
        assert json.loads(seen.stdout)["node"] == node
    assert bed.status("robot1")["security"] == "secured"
    before = bed.task("robot1")["tuning"]

    change = ["tune", TASK, "cpu=0.25", "memory=0.75", "--yes", "--connect", endpoint]
    refused = zsched(bed, "screen", *change)
    assert refused.returncode == 1
    assert "screen is a guest of fleet testbed and may only ask for its status and read streams" in refused.stderr
    assert "did not answer" not in refused.stderr
    assert bed.task("robot1")["tuning"] == before
    done = zsched(bed, "ana", *change)
    assert done.returncode == 0, done.stderr
    assert "command=TuneTask from=ana" in bed.log("robot1")
    assert "from=screen" not in bed.log("robot1")
    bed.wait(
        lambda: bed.task("robot2")["tuning"]["weights"]["memory"] == 0.75, 60, "the new weights at the other robot"
    )
    bed.wait(
        lambda: "TuneTask came, signed by ana.operator" in zsched(bed, "robot1", "events").stdout,
        60,
        "the command in the decision log, with the operator's name",
    )


def flags_at(bed: Testbed, node: str) -> dict[tuple[str, str], str]:
    """{(node, kind): in whose name} of the flags that a node knows."""
    nodes = bed.status(node)["nodes"]
    return {(one["name"], flag["kind"]): flag["by"] for one in nodes for flag in one.get("flags", ())}


def test_a_node_that_may_give_no_orders_asks_and_orders_nothing(bed: Testbed) -> None:
    assert zsched(bed, "edge1", "status").returncode == 0
    said = zsched(bed, "edge1", "pin", TASK, "edge2", "--yes")
    assert said.returncode == 1
    assert "edge1 gives no orders in this fleet, robot1 and robot2 may" in " ".join(said.stderr.split())
    assert bed.task("robot1").get("pin") is None


@pytest.mark.long
def test_the_document_and_its_flags_are_changed_in_the_name_of_the_certificate(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Testbed(tmp_path, with_people(tmp_path)) as bed:
        bed.init()
        bed.start()
        bed.wait_settled(90)
        endpoint = bed.fleet.node("robot1").listen_control
        elsewhere = ["--yes", "--connect", endpoint]
        for words in (
            ["apply", str(tmp_path / "ana" / "fleet.yaml"), "-m", "the first"],
            ["drain", "edge1", "--detach", "-m", "new fan"],
            ["pause", TASK],
        ):
            done = zsched(bed, "ana", *words, *elsewhere)
            assert done.returncode == 0, (words, done.stderr)
            if words[0] == "drain":  # the task moves away; an order in the middle of that is a conflict
                bed.wait(lambda: bed.task("robot1")["owner"] == "edge2", 60, "the drained node has handed over")
        assert zsched(bed, "robot1", "drain", "robot2", "--only", "new", "--yes").returncode == 0
        user = f"{user_name()}@robot1"
        drained, closed = ("edge1", "drain"), ("robot2", "ineligible")
        bed.wait(
            lambda: flags_at(bed, "robot2") == {drained: "ana.operator", closed: user},
            60,
            "both flags at the other robot, each in the name of who gave it",
        )

        # a program of hers that says another name, and gives another's flag her reason
        monkeypatch.setenv("ZSCHED_CONFIG", str(tmp_path / "ana" / "fleet.yaml"))
        door = Door(socket=Path(), endpoint=endpoint)
        told = ask_door(door, {"verb": "fleet"})
        flags = [{**flag, "by": "bob@robot1", "reason": "a lie"} for flag in told["flags"]]
        request = {"verb": "change", "text": told["text"], "flags": flags, "reason": "nothing, by bob@robot1"}
        answer = ask_door(door, {**request, "by": "bob@robot1", "base_revision": told["revision"]})
        _client(endpoint).close()
        _client.cache_clear()
        _visit.cache_clear()
        assert answer["outcome"] == "ok", answer
        wanted = {drained: "ana.operator", closed: "ana.operator"}
        bed.wait(lambda: flags_at(bed, "robot2") == wanted, 60, "no flag in another's name")
        listed = zsched(bed, "robot2", "status").stdout
        assert listed.count("ana.operator") == 3, listed
        assert "bob@robot1" not in listed

        def told_by() -> list[tuple[str, str]]:
            said = json.loads(zsched(bed, "robot1", "history", "--json").stdout)["changes"]
            return [(one["by"], one["text"].partition(", on revision")[0]) for one in said if one["task"] is None]

        bed.wait(
            lambda: (
                told_by()
                == [
                    ("ana.operator", f"ana.operator (the first): apply {tmp_path / 'ana' / 'fleet.yaml'}"),
                    ("ana.operator", "ana.operator (new fan): drain edge1"),
                    (user, f"{user}: ineligible robot2"),
                    ("ana.operator", "ana.operator: nothing, by bob@robot1"),
                ]
            ),
            60,
            f"every change with its name: {told_by()}",
        )
        history = zsched(bed, "robot2", "history", TASK).stdout
        assert "paused by ana.operator" in history, "each node tells who gave an order about a task"

        # a program on robot2 that says her name at the socket there
        order = {"verb": "hold", "task": TASK, "hold": "resume", "by": "ana.operator", "node": "robot1"}
        assert ask(bed.folder / "robot2.sock", order, 10.0)["outcome"] == "ok"
        bed.wait(
            lambda: "resumed by ana.operator@robot2" in zsched(bed, "robot1", "history", TASK).stdout,
            60,
            "the order with the machine from which it came",
        )


def refusals(bed: Testbed, node: str) -> dict[str, int]:
    """{counter: how many} of frames that were dropped for their seals."""
    words = ("unsigned", "signature", "signer", "certificate", "replay", "stale")
    found: dict[str, int] = bed.status(node)["counters"]
    return {name: count for name, count in found.items() if name.startswith("dropped_") and name.endswith(words)}


def test_who_has_a_member_s_link_and_not_its_key_says_nothing_where_it_counts(bed: Testbed) -> None:
    """A router or a client in between: TLS lets it in as robot2, and it repeats and changes what robot2 has said."""
    assert all(refusals(bed, node) == {} for node in ("robot1", "robot2", "edge1")), "members refuse each other"
    config = without_rules(bed, "robot2", Side.CONTROL, to=("robot1", "robot2"))
    keys, before = Keyspace(bed.fleet.name), bed.task("robot1")
    said: list[zenoh.Sample] = []
    with zenoh.open(zenoh.Config.from_json5(config)) as session:
        # what it repeats itself has no seal, and is not to be repeated
        session.declare_subscriber(keys.allocation("robot2"), said.append, allowed_origin=zenoh.Locality.REMOTE)
        session.declare_queryable(
            keys.register("robot2", "*"),
            lambda query: query.reply(str(query.key_expr).replace("*", "robot2"), promise_for(query)),
        )

        def repeats() -> bool:
            for node, cpu in (("robot1", 0.5), ("robot2", 0.25)):  # each of them asks the electors, and tells
                assert zsched(bed, node, "tune", TASK, f"cpu={cpu}", f"memory={1 - cpu}", "--yes").returncode == 0
            for sample in tuple(said):
                frame, seal = sample.payload.to_bytes(), sample.attachment
                assert seal is not None, "members sign what they have learnt"
                session.put(keys.allocation("robot2"), frame, attachment=seal.to_bytes())
                session.put(keys.allocation("robot2"), frame)
                session.put(keys.proposal("robot2"), frame, attachment=seal.to_bytes())
                asked, seal_bytes = wire.encode(PREPARE), seal.to_bytes()
                session.get(keys.register("*", "robot2"), lambda _: None, payload=asked, attachment=seal_bytes)
            wanted = {"allocation_replay", "allocation_unsigned", "proposal_signature", "register_signature"}
            return {f"dropped_{word}" for word in (*wanted, "register_unsigned")} <= set(refusals(bed, "robot1"))

        bed.wait(repeats, 60, f"every kind of refusal: {refusals(bed, 'robot1')}")
    assert (bed.task("robot1")["owner"], bed.task("robot1")["epoch"]) == (before["owner"], before["epoch"])
    assert bed.log("robot1").count("refused kind=") <= 2, "one line a minute"


PREPARE = Prepare(task=TASK, ballot=Ballot(counter=10**6, node="robot2", incarnation=1), electorate="e")


def promise_for(query: zenoh.Query) -> bytes:
    assert query.payload is not None
    asked: Any = wire.decode(query.payload.to_bytes(), Prepare, Accept)
    ballot = asked.ballot if isinstance(asked, Prepare) else asked.acceptance.ballot
    return wire.encode(Promise(elector="robot2", task=TASK, ballot=ballot))


def test_streams_run_and_move_and_tools_find_their_certificates(bed: Testbed) -> None:
    first = bed.wait_whole()
    got: list[str] = []
    session = bed.app("robot1")
    session.declare_subscriber("robot1/out", lambda sample: got.append(sample.payload.to_string()))
    publisher = session.declare_publisher("robot1/in")

    def echoed(text: str) -> bool:
        publisher.put(text)
        return any(one.endswith(text) for one in got)

    bed.wait(lambda: echoed("before"), 60, "the owner's answer")
    bed.stop(first)
    second = bed.wait_settled()
    bed.wait(lambda: echoed("after"), 60, "the next owner's answer")
    assert second != first
    pinged = zsched(bed, "robot1", "ping", "robot2", "--count", "1")
    assert pinged.returncode == 0, pinged.stdout + pinged.stderr
    bed.wait(lambda: "robot2" in bed.status("robot1")["quorum"]["voted"], 60, "robot1 to remember robot2's vote")
    bed.kill("robot2")
    shutil.rmtree(bed.folder / "robot2")
    refused = zsched(bed, "robot2", "init", "--state-dir", str(bed.folder / "robot2"))
    assert "knows robot2 as an elector that has voted" in refused.stderr, refused.stderr


def test_a_link_that_belongs_to_nobody_is_counted_and_named(bed: Testbed) -> None:
    with opened(bed.folder / "authority", bed.fleet.name) as authority:
        install(authority, bed.folder / "mallory" / "pki", "mallory", Role.GUEST)
    fleet = load_fleet(bed.folder / "screen" / "fleet.yaml")
    assert fleet.security is not None
    stranger = replace(fleet, security=replace(fleet.security, folder=str(bed.folder / "mallory" / "pki")))
    endpoint = bed.fleet.node("robot1").listen_control
    config = client_config(connect=(endpoint,), operator_json5=session_text(stranger, Side.VISIT), connect_s=5.0)
    with zenoh.open(zenoh.Config.from_json5(config)):
        bed.wait(
            lambda: bed.status("robot1")["counters"].get("dropped_link_stranger"), 60, "the stranger to be counted"
        )
    assert "certificate='mallory.guest.testbed.zsched.internal'" in bed.log("robot1")
