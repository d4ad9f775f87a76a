"""What a worker that somebody else starts lacks of today's session, from one daemon of its node to the next."""

from __future__ import annotations

from pathlib import Path

import pytest

from zsched.host.workers.comparison import OTHER_SETTINGS, lacking
from zsched.link.sessions.config import worker_config
from zsched.runtime.sessions import SessionsRead

ONE, TWO = "tcp/10.0.0.1:7458", "tcp/10.0.0.2:7458"


def session(*connect: str, operator_json5: str = "") -> str:
    return worker_config(connect=connect, operator_json5=operator_json5)


class Machine:
    """A state folder and a boot."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.boot = folder, folder / "boot_id"
        self.boot.write_text("1\n")

    def daemon(self, text: str) -> SessionsRead:
        found = SessionsRead(self.folder, self.boot)
        found.begin("merge", text)
        found.save()
        return found


@pytest.fixture
def machine(tmp_path: Path) -> Machine:
    return Machine(tmp_path)


@pytest.mark.parametrize(
    ("read", "now", "lack"),
    [
        (session(ONE), session(ONE), ""),
        (session(ONE), session(ONE, TWO), TWO),
        (session(ONE, TWO), session(ONE), ""),
        (session(ONE, TWO), session(TWO, ONE), ""),
        (session(ONE), session(ONE, operator_json5="{transport: {link: {tls: {enable_mtls: true}}}}"), OTHER_SETTINGS),
        ("", session(ONE), OTHER_SETTINGS),
        ("[]", session(ONE), OTHER_SETTINGS),
        ('{"connect": {"endpoints": {"peer": []}}}', session(ONE), OTHER_SETTINGS),
    ],
)
def test_what_is_lacking_is_told_and_what_is_too_much_is_not(read: str, now: str, lack: str) -> None:
    assert lacking(read, now) == lack


def test_a_worker_that_goes_on_lacks_what_has_been_added_until_it_starts_again(machine: Machine) -> None:
    assert machine.daemon(session(ONE)).seen("merge", 0, is_new=False) == ""
    for _ in range(2):
        assert machine.daemon(session(ONE, TWO)).seen("merge", 0, is_new=False) == TWO
    assert machine.daemon(session(ONE)).seen("merge", 0, is_new=False) == "", "the file of before is back"
    assert machine.daemon(session(ONE, TWO)).seen("merge", 0, is_new=True) == ""
    assert machine.daemon(session(ONE, TWO)).seen("merge", 0, is_new=False) == ""


def test_a_worker_that_started_behind_a_removal_lacks_what_comes_back(machine: Machine) -> None:
    machine.daemon(session(ONE, TWO))
    assert machine.daemon(session(ONE)).seen("merge", 0, is_new=True) == ""
    assert machine.daemon(session(ONE, TWO)).seen("merge", 0, is_new=False) == TWO


def test_the_number_of_its_life_is_kept(machine: Machine) -> None:
    first = machine.daemon(session(ONE))
    assert first.life("merge") == 0
    first.seen("merge", 7, is_new=True)
    assert machine.daemon(session(ONE, TWO)).life("merge") == 7


def test_another_boot_has_other_workers(machine: Machine) -> None:
    machine.daemon(session(ONE))
    machine.boot.write_text("2\n")
    assert machine.daemon(session(ONE, TWO)).seen("merge", 0, is_new=False) == ""
    machine.boot.unlink()
    assert machine.daemon(session(ONE)).seen("merge", 0, is_new=False) == "", "no boot is told apart"
    assert machine.daemon(session(ONE, TWO)).seen("merge", 0, is_new=False) == ""
