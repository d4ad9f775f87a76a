"""A robot goes from one cell to another by `zsched leave --to`, on real daemons, while its stream runs."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
import zenoh

from support.operators import PERIOD_S, Stream
from support.sessions import matches
from support.waiting import until
from zsched.exits import EXIT_LEFT
from zsched.runtime.membership import whose
from zsched.sessions.config import client_config
from zsched_lab.fleet.hall import Hall, block_of_ports

pytestmark = [pytest.mark.long, pytest.mark.timeout(300)]
A, B, ME = "hall-a", "hall-b", "robot1"
"""The robot that goes has the name of the tests' application."""
TASK = """\
tasks:
  echo:
    candidates: {kind: robot}
    weights: {cpu: 0.5, memory: 0.5}
    scheduling: {score: paper, cool_down_s: 0}
    worker: {command: [python, -m, zsched.tasks.echo]}
    inputs: [{from: "{robot}/in", to: "{target}/echo/{robot}/in", class: reliable, on_crash: replay}]
    outputs:
      - {from: "{target}/echo/{epoch}/{robot}/out", to: "{robot}/out", class: reliable, handover: all}
"""
PROGRAM = "from zsched.commands import change_cell; change_cell.TAKE_S = 8.0; from zsched.cli import main; main()"
"""`zsched` with less patience."""


class Site:
    """Two cells, each with a robot that stays; robot1 begins in hall-a."""

    def __init__(self, folder: Path, *words: str) -> None:
        self.port = block_of_ports(40)
        self.stays = {A: "robot2", B: "robot3"}
        self.halls = {name: Hall(folder / name) for name in (A, B)}
        for number, (name, hall) in enumerate(self.halls.items()):
            hall.folder.mkdir()
            founder = self.stays[name]
            hall.zsched(founder, "fleet", "create", name, *words, "--address", f"127.0.0.1:{self.port + 10 * number}")
            hall.start(founder)
            until(partial(self._is_alone, hall, founder), "the first daemon")

    @staticmethod
    def _is_alone(hall: Hall, founder: str) -> bool:
        return hall.alive(founder) == {founder}

    def bring(self) -> None:
        """Robot1 joins hall-a, and both cells have the task."""
        here = self.halls[A]
        file = here.folder / f"{ME}.invite"
        address = f"127.0.0.1:{self.port + 20}"
        file.write_text(here.zsched("robot2", "invite", ME, "--address", address, "--yes"))
        here.zsched(ME, "join", str(file))
        here.start(ME)
        until(lambda: ME in here.alive("robot2"), "robot1 is in hall-a")
        for name, hall in self.halls.items():
            (hall.folder / "task.yaml").write_text(TASK)
            hall.zsched(self.stays[name], "task", "add", str(hall.folder / "task.yaml"), "--yes")
            hall.zsched(self.stays[name], "wait", "--for", "settled=echo", "--timeout", "60")
        here.zsched(ME, "wait", "--for", "quorum", "--timeout", "60")

    def name_the_other(self) -> None:
        """Hall-a's document names hall-b."""
        text = self.halls[A].zsched("robot2", "fleet", "export")
        gateway = f"tcp/127.0.0.1:{self.port + 10}"
        file = self.halls[A].folder / "agreed.yaml"
        file.write_text(f'{text}replace_s: 2\nsite: {{{B}: {{gateways: ["{gateway}"]}}}}\n')
        self.halls[A].zsched("robot2", "apply", str(file), "--yes")

    def order(self, *words: str) -> subprocess.Popen[bytes]:
        """Robot1's operator leaves; what is printed goes to a file."""
        home = self.halls[A].folder / ME
        more = {"CONFIG": home / "etc" / "fleet.yaml", "STATE_DIR": home / "state", "RUNTIME_DIR": home / "run"}
        env = {**os.environ, **{f"ZSCHED_{name}": str(path) for name, path in more.items()}, "ZSCHED_NODE": ME}
        with (home / "told").open("ab") as told:
            command = [sys.executable, "-c", PROGRAM, "leave", *words, "--yes"]
            return subprocess.Popen(command, env=env, cwd=home, stdout=told, stderr=told)

    def insist(self, *words: str) -> subprocess.Popen[bytes]:
        """The same, again where it was refused: daemons of a secured fleet still begin again to let robot1 in."""
        given = [self.order(*words)]

        def has_ended() -> bool:
            if given[-1].poll() is not None and "daemon has ended" not in self.told():
                given.append(self.order(*words))
            return "daemon has ended" in self.told()

        until(has_ended, f"robot1's daemon ends: {self.told()}", 90.0)
        return given[-1]

    def told(self) -> str:
        return (self.halls[A].folder / ME / "told").read_text()

    def fleet(self) -> str:
        """Whose files robot1's machine has."""
        try:
            return whose(self.halls[A].folder / ME / "state")[0]
        except Exception:  # noqa: BLE001 - between two
            return ""

    def supervise(self, fleet: str) -> None:
        """Start robot1's daemon, as an operator who waits for the files."""
        until(lambda: self.fleet() == fleet, f"robot1 has the files of {fleet}: {self.told()}", 60.0)
        self.halls[A].start(ME)

    def stop(self) -> None:
        for hall in self.halls.values():
            hall.stop()


@pytest.fixture
def site(folder: Path) -> Iterator[Site]:
    one = Site(folder, "--insecure")
    try:
        one.bring()
        one.name_the_other()
        yield one
    finally:
        one.stop()


def test_a_robot_changes_cells_and_its_stream_flows_on_there(site: Site) -> None:
    here, there = site.halls[A], site.halls[B]
    session = zenoh.open(zenoh.Config.from_json5(client_config(connect=(f"tcp/127.0.0.1:{site.port + 21}",))))
    with session:
        stream = Stream(session)
        until(lambda: matches(stream.publisher), "the relay subscribes")
        here.zsched(ME, "wait", "--for", "settled=echo", "--timeout", "60")
        stream.start()
        until(lambda: len(stream.back) > 50, "it flows in hall-a")
        begun, sent = time.monotonic(), stream.sent
        going = site.order("--to", B)
        assert here.ended(ME, 60) == EXIT_LEFT
        ended = time.monotonic()
        going.kill()  # broken off where no daemon runs
        going.wait(10)
        assert site.fleet() in (A, "", B)
        going = site.order("--to", B)
        site.supervise(B)
        assert going.wait(90) == 0, site.told()
        took_s, off_s = time.monotonic() - begun, time.monotonic() - ended
        reached = len(stream.back)
        until(lambda: len(stream.back) > reached + 50, "it flows in hall-b", 30.0)
        stream.end()
        until(lambda: stream.sent - 1 in stream.back, "the last one is answered", 20.0)
    missing = sorted(set(range(stream.sent)) - set(stream.back))
    print(f"a change of cells: {took_s:.1f} s, of which {off_s:.1f} s from the daemon's end to ready there")
    print(
        f"{len(missing)} of {stream.sent} messages, one every {PERIOD_S:g} s, have no answer, the first {missing[:1]}"
    )
    assert all(number >= sent for number in missing), "before the order nothing is lost"
    assert missing == list(range(missing[0], missing[-1] + 1)), "one gap, while no daemon runs"
    status = here.status(ME)
    assert (status["fleet"], status["quorum"]["ok"]) == (B, True)
    assert there.alive("robot3") == {"robot3", ME}
    assert ME not in here.zsched("robot2", "fleet", "export")
    assert here.status("robot2")["quorum"]["ok"]
    again = here.run(ME, "leave", "--to", B, "--yes")
    assert (again.returncode, "nothing to do" in again.stdout) == (0, True), again


def test_a_robot_that_the_next_cell_loses_works_on_in_its_own(site: Site) -> None:
    here, there = site.halls[A], site.halls[B]
    going = site.order("--to", B)
    assert here.ended(ME, 60) == EXIT_LEFT
    there.stop("robot3")  # after the last question and before it is taken
    site.supervise(B)
    until(lambda: "it goes back to hall-a" in site.told(), "it gives up", 60.0)
    assert here.ended(ME, 60) == EXIT_LEFT
    site.supervise(A)
    assert going.wait(60) == 1, site.told()
    assert "robot1 works in hall-a as before" in site.told()
    until(lambda: ME in here.alive("robot2"), "robot1 is in hall-a")
    (flags,) = [node["flags"] for node in here.status("robot2")["nodes"] if node["name"] == ME]
    assert flags == []
    here.zsched(ME, "wait", "--for", "settled=echo", "--timeout", "30")


def test_a_secured_cell_takes_a_robot_of_a_secured_one_by_its_invitation(folder: Path) -> None:
    site = Site(folder)
    try:
        site.bring()
        here, there = site.halls[A], site.halls[B]
        file = there.folder / f"{ME}.invite"
        address = f"127.0.0.1:{site.port + 20}"
        file.write_text(there.zsched("robot3", "invite", ME, "--address", address, "--yes"))
        going = site.insist("--to", str(file))
        assert here.ended(ME, 10) == EXIT_LEFT, site.told()
        site.supervise(B)
        assert going.wait(120) == 0, site.told()
        assert here.status(ME)["fleet"] == B
        assert there.alive("robot3") == {"robot3", ME}
        assert ME not in here.zsched("robot2", "fleet", "export")
        assert not (here.folder / ME / "state" / "next-cell").exists()
    finally:
        site.stop()
