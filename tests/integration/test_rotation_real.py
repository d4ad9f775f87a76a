"""The fleet gets another authority, by the steps that `zsched pki rotate` prints; its key is locked."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from support.waiting import until
from zsched_lab.fleet.hall import Hall, block_of_ports

NODES = ("robot1", "robot2")
ANEW = "are opened anew"


@pytest.fixture
def hall(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hall]:
    monkeypatch.setenv("ZSCHED_AUTHORITY_PASSPHRASE", "secret")
    with Hall(tmp_path) as one:
        yield one


def are_together(hall: Hall) -> bool:
    return all(hall.alive(node) == set(NODES) for node in NODES)


def trust_what_the_authority_says(hall: Hall) -> None:
    """Put ``ca.pem`` on every machine, and wait until each daemon has begun anew with it."""
    before = {node: hall.log(node).count(ANEW) for node in NODES}
    for node in NODES:
        shutil.copy(hall.folder / "stick" / "ca.pem", hall.folder / node / "etc" / "pki" / "ca.pem")
    until(lambda: all(hall.log(node).count(ANEW) > before[node] for node in NODES), "all begun anew", 150.0)
    until(lambda: are_together(hall), "both, begun anew")


@pytest.mark.long
def test_a_locked_authority_is_replaced_and_the_end_waits_for_every_node(
    hall: Hall, monkeypatch: pytest.MonkeyPatch
) -> None:
    port = block_of_ports(20)
    hall.zsched("robot1", "fleet", "create", "hall", "--address", f"127.0.0.1:{port}", "--passphrase")
    hall.start("robot1")
    until(lambda: hall.alive("robot1") == {"robot1"}, "the first daemon")
    invitation = hall.folder / "robot2.invite"
    words = ("invite", "robot2", "--address", f"127.0.0.1:{port + 10}", "--yes", "-o", str(invitation))
    monkeypatch.setenv("ZSCHED_AUTHORITY_PASSPHRASE", "secrte")
    assert "the passphrase is wrong" in hall.run("robot1", *words).stderr
    assert "the passphrase is wrong" in hall.run("robot1", "pki", "rotate").stderr
    assert "robot2" not in hall.zsched("robot1", "fleet", "export")
    monkeypatch.setenv("ZSCHED_AUTHORITY_PASSPHRASE", "secret")
    hall.zsched("robot1", *words)
    hall.zsched("robot2", "join", str(invitation))
    hall.start("robot2")
    until(lambda: are_together(hall), "both")

    hall.zsched("robot1", "pki", "rotate")
    trust_what_the_authority_says(hall)
    hall.zsched("robot1", "pki", "renew")
    hall.stop("robot2")
    early = hall.run("robot1", "pki", "rotate", "--finish")
    assert early.returncode == 1
    assert "robot2: no certificate of the new authority there" in early.stderr
    assert (hall.folder / "stick" / "ca-1.key").exists()
    hall.start("robot2")
    until(lambda: are_together(hall), "robot2 is back with its former certificate")
    deliver = ("pki", "renew", "--deliver")  # again while robot1 begins anew with what the early end has sent it
    until(lambda: hall.run("robot1", *deliver).returncode == 0, "every node has its new certificate")
    finish = ("pki", "rotate", "--finish")
    until(lambda: hall.run("robot1", *finish).returncode == 0, "both, begun anew, say that they have theirs")
    assert not (hall.folder / "stick" / "ca-1.key").exists()
    trust_what_the_authority_says(hall)
    assert [hall.problems(node) for node in NODES] == [[], []]
