"""A task goes from one cell to another by `zsched task hand`, on real daemons, while its streams run."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import zenoh

from support.operators import PERIOD_S, Operator, Stream
from support.sessions import matches
from support.waiting import until
from zsched.config.handing import mark_of
from zsched.core.values.fleet import dial_endpoint
from zsched.sessions.config import client_config
from zsched_lab.fleet.hall import Hall, block_of_ports
from zsched_lab.fleet.testbed import Testbed, echo_fleet

pytestmark = [pytest.mark.long, pytest.mark.timeout(300)]
A, B = "hall-a", "hall-b"
STAYS = {A: "robot2", B: "robot3"}
TASK = """\
tasks:
  echo:  # answers
    candidates: {kind: robot}
    weights: {cpu: 0.5, memory: 0.5}
    scheduling: {score: paper, cool_down_s: 0}
    worker: {command: [python, -m, zsched.tasks.echo]}
    inputs: [{from: "{node}/in", to: "{target}/echo/{node}/in", class: reliable, on_crash: replay}]
    outputs:
      - {from: "{target}/echo/{epoch}/{node}/out", to: "{node}/out", class: reliable, handover: all}
"""


class Site:
    """Two cells of one robot each, of which the first has the task, and knows the other one."""

    def __init__(self, folder: Path, task: str = TASK, *, is_secured: bool = False) -> None:
        """``is_secured``: the other cell is, and this one's robot has an operator's certificate of it."""
        self.folder = folder
        self.port = block_of_ports(20)
        self.halls = {name: Hall(folder / name) for name in (A, B)}
        with ExitStack() as undone:
            undone.callback(self.stop)
            self._found(task, is_secured=is_secured)
            undone.pop_all()

    def _found(self, task: str, *, is_secured: bool) -> None:
        for number, (name, hall) in enumerate(self.halls.items()):
            hall.folder.mkdir()
            founder, address = STAYS[name], f"127.0.0.1:{self.port + 10 * number}"
            words = () if is_secured and name == B else ("--insecure",)
            hall.zsched(founder, "fleet", "create", name, *words, "--address", address)
            hall.start(founder)
            until(partial(self._is_alone, hall, founder), "the first daemon")
        here = self.halls[A]
        text = here.zsched(STAYS[A], "fleet", "export")
        file = here.folder / "agreed.yaml"
        gateway = f"{'tls' if is_secured else 'tcp'}/127.0.0.1:{self.port + 10}"
        named = f'gateways: ["{gateway}"]'
        if is_secured:
            named += f", file: {self._certified()}"
        file.write_text(f"{text}site: {{{B}: {{{named}}}}}\n")
        here.zsched(STAYS[A], "apply", str(file), "--yes")
        file.write_text(task)
        here.zsched(STAYS[A], "task", "add", str(file), "--yes")
        here.zsched(STAYS[A], "wait", "--for", "settled=echo", "--timeout", "60")

    @staticmethod
    def _is_alone(hall: Hall, founder: str) -> bool:
        return hall.alive(founder) == {founder}

    def _certified(self) -> str:
        """The other cell's fleet file, beside this one's."""
        there, etc = self.halls[B], self.halls[A].folder / STAYS[A] / "etc"
        text = there.zsched(STAYS[B], "fleet", "export").replace("security: {}", "security: {operators: [ana]}")
        assert "ana" in text, text
        agreed = there.folder / "agreed.yaml"
        agreed.write_text(text)
        there.zsched(STAYS[B], "pki", "issue", "ana", "--role", "operator", "--out", str(etc / "pki-b"))
        there.zsched(STAYS[B], "apply", str(agreed), "--yes")
        copy = etc / "hall-b.yaml"
        copy.write_text(text.replace("[ana]}", "[ana], folder: pki-b}"))
        return copy.name

    def text(self, cell: str) -> str:
        return self.halls[cell].zsched(STAYS[cell], "fleet", "export")

    def hand(self, *words: str) -> subprocess.CompletedProcess[str]:
        return self.halls[A].run(STAYS[A], "task", "hand", "echo", *words, "--yes")

    def begun(self, *words: str) -> subprocess.Popen[bytes]:
        """The same, which goes on beside the test; what is printed goes to a file."""
        home = self.halls[A].folder / STAYS[A]
        more = {"CONFIG": home / "etc" / "fleet.yaml", "STATE_DIR": home / "state", "RUNTIME_DIR": home / "run"}
        env = {**os.environ, **{f"ZSCHED_{name}": str(path) for name, path in more.items()}, "ZSCHED_NODE": STAYS[A]}
        with (home / "told").open("wb") as told:
            command = [sys.executable, "-m", "zsched.cli", "task", "hand", "echo", *words, "--yes"]
            return subprocess.Popen(command, env=env, cwd=home, stdout=told, stderr=told)

    def told(self) -> str:
        return (self.halls[A].folder / STAYS[A] / "told").read_text()

    def works(self, cell: str) -> bool:
        """Whether the cell has the task, on a ready owner."""
        tasks: list[Any] = self.halls[cell].status(STAYS[cell]).get("tasks", [])
        return any(task["name"] == "echo" and task["owner"] == STAYS[cell] for task in tasks)

    def tells(self) -> bool:
        """Whether the first cell's status says that the task is on its way."""
        problems: list[str] = self.halls[A].status(STAYS[A]).get("problems", [])
        return any(problem.startswith(f"echo is on its way to {B}") for problem in problems)

    def session(self, cell: str) -> zenoh.Session:
        """Of an application of the cell's robot."""
        end = f"tcp/127.0.0.1:{self.port + 10 * (cell == B) + 1}"
        return zenoh.open(zenoh.Config.from_json5(client_config(connect=(end,))))

    def stop(self) -> None:
        for hall in self.halls.values():
            hall.stop()


def test_a_task_goes_over_while_both_cells_streams_run_and_the_command_is_killed(folder: Path) -> None:
    site = Site(folder)
    try:
        with site.session(A) as ours, site.session(B) as theirs:
            here, there = Stream(ours, robot=STAYS[A]), Stream(theirs, robot=STAYS[B])
            until(lambda: matches(here.publisher), "the relay subscribes")
            here.start()
            there.start()  # nobody takes it yet
            until(lambda: len(here.back) > 50, "it flows in hall-a")
            going = site.begun(B)
            until(lambda: "with echo" in site.told() or going.poll() is not None, "hall-b has it", 60.0)
            going.kill()
            going.wait(10)
            assert mark_of(site.text(A), "echo") is not None, site.told()
            assert site.works(A), "until it is ready there"
            until(site.tells, "status tells of it")
            begun = time.monotonic()
            done = site.hand(B)
            took_s = time.monotonic() - begun
            assert done.returncode == 0, (done.stdout, done.stderr)
            reached = len(there.back)
            until(lambda: len(there.back) > reached + 50, "it flows in hall-b", 30.0)
            until(lambda: not site.works(A), "hall-a has it no more")
            until(lambda: not site.tells(), "there is nothing to tell any more")
            ended = here.sent
            here.end()
            there.end()
            until(lambda: there.sent - 1 in there.back, "the last one is answered", 20.0)
        ours_back, theirs_back = set(here.back), set(there.back)
        last, first = max(ours_back), min(theirs_back)
        lost = [number for number in range(last) if number not in ours_back]
        print(f"the second command took {took_s:.1f} s")
        print(f"of {here.sent} messages in hall-a, one every {PERIOD_S:g} s, up to {last} all but {len(lost)} answered")
        print(f"hall-b answers from {first} of {there.sent} on, {len(there.back)} in all")
        assert lost == []
        assert last <= ended
        assert theirs_back == set(range(first, there.sent)), "without a gap"
        assert first < last, "it works there before it ends here"
        assert "echo" not in site.text(A)
        assert TASK.partition("\n")[2] in site.text(B), "with its comments"
        again = site.hand(B)
        assert (again.returncode, "nothing to do" in again.stdout) == (0, True), again
    finally:
        site.stop()


def _note(times: list[float], _sample: zenoh.Sample) -> None:
    times.append(time.monotonic())


def test_an_exclusive_task_works_never_in_both(folder: Path) -> None:
    """One watcher asks both owners' workers by their answers: none comes from hall-a after the first of hall-b."""
    site = Site(folder, TASK.replace("  echo:  # answers\n", "  echo:\n    exclusive: true\n"))
    came: dict[str, list[float]] = {A: [], B: []}
    try:
        with site.session(A) as ours, site.session(B) as theirs:
            streams = {}
            for cell, session in ((A, ours), (B, theirs)):
                key = f"{STAYS[cell]}/out"
                session.declare_subscriber(key, partial(_note, came[cell]))
                streams[cell] = Stream(session, robot=STAYS[cell])
                streams[cell].start()
            until(lambda: len(came[A]) > 50, "it flows in hall-a")
            going = site.begun(B)
            until(lambda: "on its way" in site.told(), "it has begun", 60.0)
            going.kill()
            going.wait(10)
            until(lambda: not site.works(A), "it stops first")
            assert mark_of(site.text(A), "echo") is not None, site.told()
            assert not site.works(B)
            until(site.tells, "status tells of a task that nobody has")
            going = site.begun(B)
            assert going.wait(90) == 0, site.told()
            until(lambda: len(came[B]) > 50, "it flows in hall-b", 30.0)
            for stream in streams.values():
                stream.end()
        pause_s = came[B][0] - came[A][-1]
        print(f"nobody answered for {pause_s:.1f} s; hall-a answered {len(came[A])} times")
        assert pause_s > 0, "not in both"
        assert "nobody works on echo: robot2 renew no lease" in site.told()
    finally:
        site.stop()


def test_an_owner_that_hears_of_nothing_has_stopped_before_it_begins_there(tmp_path: Path) -> None:
    """Its daemon is frozen, and its worker goes on until its lease ends: a majority of the electors is enough."""
    trees = {name: {**echo_fleet(robots=1, edges=2), "fleet": name, "timing": "wifi"} for name in (A, B)}
    for name, other in ((A, B), (B, A)):
        ends = [trees[other]["nodes"][edge] for edge in ("edge1", "edge2")]
        gateways = [dial_endpoint(node["listen"]["control"], node["host"]) for node in ends]
        trees[name] |= {"electorate": sorted(trees[name]["nodes"]), "site": {other: {"gateways": gateways}}}
    trees[A]["tasks"]["echo"] |= {"exclusive": True}
    trees[B]["tasks"] = {"other": {"candidates": {"kind": "edge"}, "weights": {"cpu": 1}}}
    beds, came = {}, {A: list[float](), B: list[float]()}
    with ExitStack() as stack:
        for name, tree in trees.items():
            (tmp_path / name).mkdir()
            beds[name] = stack.enter_context(Testbed(tmp_path / name, tree))
            beds[name].init()
            beds[name].start()
        owner = beds[A].wait_whole()
        operators = {name: Operator(bed) for name, bed in beds.items()}
        for name, bed in beds.items():
            bed.wait(partial(_is_whole, bed), 30.0, "all alive")
            operators[name].done("apply", bed.file, "--yes")
            session = bed.app("robot1")
            session.declare_subscriber("robot1/out", partial(_note, came[name]))
            stack.callback(partial(Stream.end, _started(session)))
        until(lambda: len(came[A]) > 50, "it flows in hall-a")
        beds[A].send(owner, signal.SIGSTOP)
        try:
            given = time.monotonic()
            done = operators[A].zsched("task", "hand", "echo", B, "--yes")
            assert done.returncode == 0, (done.stdout, done.stderr)
            until(lambda: len(came[B]) > 50, "it flows in hall-b", 30.0)
        finally:
            beds[A].send(owner, signal.SIGCONT)
        after_s = [came[B][0] - since for since in (given, came[A][-1])]
        print(f"hall-b answers {after_s[0]:.1f} s after the command, {after_s[1]:.1f} s after hall-a")
        assert b"nobody works on echo" in done.stdout
        until(lambda: not beds[A].status(owner)["tasks"], "it hears of it")
        assert came[A][-1] < came[B][0]
        reached = len(came[A])
        operators[A].done("task", "hand", "echo", A, "--node", f"{B}/edge1", "--yes")  # as if it were typed there
        until(lambda: len(came[A]) > reached + 50, "it flows in hall-a again", 30.0)
        assert came[B][-1] < came[A][reached]


def _is_whole(bed: Testbed) -> bool:
    return all(peer["state"] == "alive" for node in bed.names for peer in bed.status(node)["nodes"])


def _started(session: zenoh.Session) -> Stream:
    stream = Stream(session)
    stream.start()
    return stream


def test_a_cell_whose_workers_cannot_start_gives_it_back(folder: Path) -> None:
    site = Site(folder)
    try:
        file = folder / "entry.yaml"
        file.write_text(TASK.replace("[python, -m, zsched.tasks.echo]", "[python, -c, 'import time; time.sleep(999)']"))
        with site.session(A) as ours:
            stream = Stream(ours, robot=STAYS[A])
            until(lambda: matches(stream.publisher), "the relay subscribes")
            stream.start()
            until(lambda: len(stream.back) > 50, "it flows")
            refused = site.hand(B, "--entry", str(file), "--deadline", "4s")
            assert refused.returncode == 1, (refused.stdout, refused.stderr)
            assert "echo is a task of hall-a as before" in refused.stderr
            stream.end()
            until(lambda: stream.sent - 1 in stream.back, "the last one is answered", 20.0)
        assert sorted(stream.back) == list(range(stream.sent)), "nothing was lost here"
        assert "echo" not in site.text(B)
        assert mark_of(site.text(A), "echo") is None
    finally:
        site.stop()


def test_a_secured_cell_takes_a_task_by_the_word_of_its_operator(folder: Path) -> None:
    site = Site(folder, is_secured=True)
    try:
        here = site.halls[A]
        until(lambda: here.run(STAYS[A], "status", "--node", f"{B}/{STAYS[B]}").returncode == 0, "ana is let in", 60.0)
        done = site.hand(B)
        assert done.returncode == 0, (done.stdout, done.stderr)
        until(lambda: site.works(B), "hall-b has it")
        assert "echo" not in site.text(A)
        assert "ana.operator" in site.halls[B].zsched(STAYS[B], "history")
    finally:
        site.stop()
