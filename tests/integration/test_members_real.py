"""A fleet from one machine to three and back to none, by `create`, `invite`, `join` and `leave`, as a stream runs."""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path

import pytest
import zenoh

from support.operators import Stream
from support.sessions import matches
from support.waiting import until
from zsched.core.values.codec import decode_state
from zsched.core.values.exits import EXIT_LEFT
from zsched.link.sessions.config import client_config
from zsched_lab.fleet.hall import Hall, block_of_ports

pytestmark = pytest.mark.long

TASK = """\
tasks:
  echo:
    candidates: {kind: robot}
    weights: {cpu: 0.5, memory: 0.5}
    scheduling: {score: paper}
    worker: {command: [python, -m, zsched.tasks.echo]}
    inputs: [{from: "{robot}/in", to: "{target}/echo/{robot}/in", class: reliable, on_crash: replay}]
    outputs:
      - {from: "{target}/echo/{epoch}/{robot}/out", to: "{robot}/out", class: reliable, handover: all}
"""
LEFT = ["etc/fleet.yaml.left", "state/decisions.ndjson.left", "state/state.left"]
QUICK = "replace_s: 2\n"
"""So that electors follow within seconds."""


def bring(hall: Hall, name: str, port: int) -> None:
    """Have robot1 invite a machine, let it join, and wait until robot1 hears it."""
    invitation = hall.folder / f"{name}.invite"
    invitation.write_text(hall.zsched("robot1", "invite", name, "--address", f"127.0.0.1:{port}", "--yes"))
    hall.zsched(name, "join", str(invitation))
    hall.start(name)
    until(lambda: name in hall.alive("robot1"), f"{name} joins")


def elects(hall: Hall, *names: str) -> bool:
    """Whether robot1 counts with these electors."""
    return tuple(hall.status("robot1")["quorum"]["names"]) == names


def files(hall: Hall, name: str) -> list[str]:
    """What a machine keeps, without what only a running daemon needs."""
    home = hall.folder / name
    found = [str(path.relative_to(home)) for path in home.rglob("*") if path.is_file()]
    return sorted(one for one in found if one not in ("log", "state/lock"))


def test_a_fleet_grows_from_one_machine_and_shrinks_to_none_while_a_stream_runs(tmp_path: Path) -> None:
    port = block_of_ports(40)
    with Hall(tmp_path) as hall:
        hall.zsched("robot1", "fleet", "create", "hall", "--insecure", "--address", f"127.0.0.1:{port}")
        hall.start("robot1")
        until(lambda: hall.alive("robot1") == {"robot1"}, "the first daemon")
        agreed = tmp_path / "agreed.yaml"
        agreed.write_text(hall.zsched("robot1", "fleet", "export") + QUICK)
        hall.zsched("robot1", "apply", str(agreed), "--yes")
        (tmp_path / "task.yaml").write_text(TASK)
        hall.zsched("robot1", "task", "add", str(tmp_path / "task.yaml"), "--yes")
        with zenoh.open(zenoh.Config.from_json5(client_config(connect=(f"tcp/127.0.0.1:{port + 1}",)))) as session:
            stream = Stream(session)
            until(lambda: matches(stream.publisher), "the relay subscribes")
            hall.zsched("robot1", "wait", "--until", "healthy", "--timeout", "60")  # what comes before has no way yet
            stream.start()
            until(lambda: len(stream.back) > 20, "a fleet of one does its task")

            for count, name in enumerate(("robot2", "robot3"), 1):
                bring(hall, name, port + 10 * count)
            until(lambda: elects(hall, "robot1", "robot2", "robot3"), "one elector has become three")
            hall.zsched("robot1", "wait", "--until", "healthy", "--timeout", "60")
            # robot1's fleet file is the copy of a document with robot1 alone
            assert "robot3" in hall.zsched("robot1", "ping", "robot3", "--count", "1", "--timeout", "20")
            assert "FAIL net.ports" not in hall.run("robot1", "doctor").stdout
            hall.zsched("robot1", "move", "echo", "robot3", "--yes")

            # it owns the task and is an elector: both go, then its name, then its daemon, then its files
            said = hall.zsched("robot3", "leave", "--yes", "-m", "sold")
            assert "echo: robot3 -> robot" in said
            assert hall.ended("robot3", 20) == EXIT_LEFT
            assert "robot3" not in hall.zsched("robot2", "fleet", "export")
            assert elects(hall, "robot1", "robot2")
            assert hall.status("robot1")["tasks"][0]["owner"] in ("robot1", "robot2")
            kept = files(hall, "robot3")
            assert [one for one in kept if one.endswith(".left")] == LEFT, kept
            assert not {"etc/fleet.yaml", "state/state"} & set(kept)

            # the same machine comes back under its name, and is another member
            bring(hall, "robot3", port + 30)
            until(lambda: elects(hall, "robot1", "robot2", "robot3"), "it is an elector again")
            for name in ("robot3", "robot2"):
                hall.zsched(name, "leave", "--yes", "--purge")
                assert hall.ended(name, 20) == EXIT_LEFT
                assert files(hall, name) == []
            assert elects(hall, "robot1")
            reached = len(stream.back)
            until(lambda: len(stream.back) > reached + 20, "the last machine does the task alone")
            stream.end()
            with contextlib.suppress(AssertionError):
                until(lambda: len(set(stream.back)) >= stream.sent, "every sample is answered", 20.0)
            missing = sorted(set(range(stream.sent)) - set(stream.back))
            assert not missing, f"{missing} of {stream.sent}: {hall.status('robot1')['tasks'][0]}"
            # a worker that starts again may answer once more what it has answered in its last 0.1 s
            again = len(stream.back) - stream.sent
            assert 0 <= again <= 80, hall.status("robot1")["tasks"][0]

        refused = hall.run("robot1", "leave", "--yes")
        assert (refused.returncode, "--accept last-node" in refused.stderr) == (1, True), refused
        hall.zsched("robot1", "leave", "--yes", "--accept", "last-node")
        assert hall.ended("robot1", 20) == EXIT_LEFT
        hall.zsched("robot1", "fleet", "create", "other", "--insecure", "--address", f"127.0.0.1:{port}")


def test_the_machine_that_founded_a_fleet_leaves_it_to_the_other_one(tmp_path: Path) -> None:
    port = block_of_ports(20)
    with Hall(tmp_path) as hall:
        hall.zsched("robot1", "fleet", "create", "hall", "--insecure", "--address", f"127.0.0.1:{port}")
        hall.start("robot1")
        until(lambda: hall.alive("robot1") == {"robot1"}, "the first daemon")
        agreed = tmp_path / "agreed.yaml"
        agreed.write_text(hall.zsched("robot1", "fleet", "export") + QUICK)
        hall.zsched("robot1", "apply", str(agreed), "--yes")
        bring(hall, "robot2", port + 10)
        said = hall.zsched("robot1", "leave", "--yes")  # the single elector; it waits until robot2 is fit
        assert "robot1: no elector any more; electors: robot2" in said
        assert hall.ended("robot1", 20) == EXIT_LEFT
        quorum = hall.status("robot2")["quorum"]
        assert (quorum["names"], quorum["ok"]) == (["robot2"], True)
        hall.zsched("robot2", "fleet", "show")


def test_an_elector_whose_system_was_installed_anew_goes_on_with_its_promises_and_another_key(tmp_path: Path) -> None:
    """/etc is new, /var is kept: its fleet file, its certificate and its key are gone, and its state is not."""
    port = block_of_ports(30)
    with Hall(tmp_path) as hall:
        hall.zsched("robot1", "fleet", "create", "hall", "--address", f"127.0.0.1:{port}")
        hall.start("robot1")
        until(lambda: hall.alive("robot1") == {"robot1"}, "the first daemon")
        for count, name in enumerate(("robot2", "robot3"), 1):
            bring(hall, name, port + 10 * count)
        until(lambda: elects(hall, "robot1", "robot2", "robot3"), "one elector has become three")
        hall.stop("robot2")
        disk = decode_state((tmp_path / "robot2" / "state" / "state").read_bytes()).disk
        shutil.rmtree(tmp_path / "robot2" / "etc")
        until(lambda: "robot2" not in hall.alive("robot1"), "robot2 is missed")
        invitation = tmp_path / "again.invite"
        invitation.write_text(hall.zsched("robot1", "invite", "robot2", "--yes"))
        hall.zsched("robot2", "join", str(invitation))
        hall.start("robot2")
        for name in ("robot3", "robot1"):  # by themselves they would wait for 2 min, for an elector is away
            hall.stop(name)
            hall.start(name)
        until(lambda: "robot2" in hall.alive("robot1"), "robot2 is let in by its other key")
        until(lambda: elects(hall, "robot1", "robot2", "robot3"), "it is an elector")
        until(lambda: hall.status("robot2")["quorum"]["alive"] == len(("robot1", "robot2", "robot3")), "it answers")
        assert decode_state((tmp_path / "robot2" / "state" / "state").read_bytes()).disk == disk
        exported = {name: hall.zsched(name, "fleet", "export") for name in ("robot1", "robot2")}
        assert exported["robot1"] == exported["robot2"]
