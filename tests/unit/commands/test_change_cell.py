"""`zsched leave --to`: its steps between two cells, broken off at each and given again; the nodes are stand-ins."""

from __future__ import annotations

import contextlib
import copy
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from support.authorities import install, make_authority
from support.fleet_values import fleet_value_of
from support.schemas import faults
from support.slices import slices
from zsched.adapters.host.operator_socket import Json, OperatorSocket
from zsched.adapters.host.state_file import StateFile, sync_folder
from zsched.cli import app
from zsched.commands import change_cell, flags, lacks, leave
from zsched.commands.ask import Door
from zsched.commands.membership import Guest, invitation_for
from zsched.config.editing import node_entry
from zsched.config.load import check_bytes, load_fleet
from zsched.core.values.document import Document, Flag, Text
from zsched.core.values.electorate import Elector, FleetValue
from zsched.core.values.fleet import Cell
from zsched.core.values.model import RegisterState
from zsched.core.values.struct import replace
from zsched.core.vote.generations import blank_state
from zsched.runtime import membership, next_cell
from zsched.runtime.membership import whose
from zsched.wire.codec import as_plain, document_hash, from_plain
from zsched.wire.invitation import Papers, decode_invitation, encode_invitation

STATUS = json.loads((Path(__file__).parent / "recorded_status" / "healthy.json").read_text())
ME = "robot3"
A = """\
fleet: hall-a
seeds: [robot1, robot2, robot3]
nodes:
  robot1: {kind: robot, host: 127.0.0.1, listen: {control: tcp/127.0.0.1:7457, data: tcp/127.0.0.1:7458}}
  robot2: {kind: robot, host: 127.0.0.1, listen: {control: tcp/127.0.0.1:7461, data: tcp/127.0.0.1:7462}}
  robot3:  # the tall one
    kind: robot
    host: 127.0.0.1
    listen: {control: "tcp/127.0.0.1:7465", data: "tcp/127.0.0.1:7466"}
    wired: true
    links: {robot1: {fixed: -50}}
tasks:
  merge: {candidates: {kind: robot}, weights: {cpu: 0.5, memory: 0.5}}
site:
  hall-b: {gateways: ["tcp/127.0.0.1:7557", "tcp/127.0.0.1:7561"]}
"""
B = """\
fleet: hall-b
nodes:
  robot1: {kind: robot, host: 127.0.0.1, listen: {control: tcp/127.0.0.1:7557, data: tcp/127.0.0.1:7558}}
  edge1: {kind: edge, host: 127.0.0.1, listen: {control: tcp/127.0.0.1:7561, data: tcp/127.0.0.1:7562}}
tasks:
  merge: {candidates: {kind: robot}, weights: {cpu: 0.5, memory: 0.5}}
"""


class Hall:
    """One cell, whose nodes agree on everything."""

    def __init__(self, text: str, generation: str) -> None:
        self.text, self.generation = text, generation
        self.name = text.split()[1]
        self.revision, self.flags = 7, list[Json]()
        self.electors = ["robot1"]
        self.alive = {"robot1", "robot2", "edge1"}
        self.owner, self.is_whole = "robot1", True
        self.candidates: list[str] | None = None
        self.conflicts = 0
        self.meanwhile: Callable[[], None] = lambda: None
        self.done: list[str] = []

    @property
    def names(self) -> list[str]:
        fleet = check_bytes(self.text.encode()).fleet
        assert fleet is not None
        return [node.name for node in fleet.nodes]

    def answer(self, request: Json, who: str) -> Json:
        if request["verb"] == "status":
            return self._status(who)
        return self._fleet(who) if request["verb"] == "fleet" else self._change(request)

    def _status(self, who: str) -> Json:
        worker = {**STATUS["nodes"][0]["workers"][0], "task": "merge", "state": "ready"}
        nodes = [
            {
                **STATUS["nodes"][0],
                "name": name,
                "kind": "robot",
                "state": "alive" if name in self.alive else "gone",
                "draining": False,
                "flags": [{**flag, "known_s": 1.0} for flag in self.flags if flag["subject"] == name],
                "workers": [worker],
            }
            for name in self.names
        ]
        task = {**copy.deepcopy(STATUS["tasks"][0]), "name": "merge", "owner": self.owner}
        task["candidates"] = self.candidates or self.names
        task |= {"phase": "settled", "streams": [], "owner_state": "alive", "pin": None, "pause": None}
        task["switched_s"] = 0.03
        quorum = {**STATUS["quorum"], "ok": self.is_whole, "names": self.electors, "generation": 0}
        body = {**STATUS, "fleet": self.name, "node": who, "nodes": nodes, "tasks": [task], "quorum": quorum}
        return {**body, "fleet_revision": self.revision}

    def _fleet(self, who: str) -> Json:
        content = Document(text=Text(self.text), flags=tuple(from_plain(flag, Flag) for flag in self.flags))
        value = fleet_value_of(
            self.revision,
            *(Elector(name=name, disk="01", joining=1) for name in self.electors),
            number=2,
            fleet=self.name,
            generation_id=self.generation * 16,
            document=document_hash(content),
        )
        body = {"node": who, "fleet": self.name, "revision": self.revision, "number": 2, "settled": True}
        electors = [{"name": name, "disk": "01"} for name in self.electors]
        told = {"electors": electors, "document": value.document, "text": self.text, "flags": self.flags}
        return {**body, **told, "value": as_plain(value)}

    def _change(self, request: Json) -> Json:
        assert request["base_revision"] == self.revision
        if self.conflicts:
            self.conflicts -= 1
            self.meanwhile()
            return {"outcome": "conflict", "detail": "another change came first", "revision": self.revision}
        if request["text"] != self.text:
            before, self.text = self.names, request["text"]
            self.done += [f"+{name}" for name in self.names if name not in before]
            self.done += [f"-{name}" for name in before if name not in self.names]
        kinds = [str(flag["kind"]) for flag in request["flags"]]
        self.done += [kind for kind in kinds if kind not in [flag["kind"] for flag in self.flags]]
        self.done += ["undrain" for flag in self.flags if flag["kind"] not in kinds and ME in self.names]
        self.flags = request["flags"]
        self.owner = "robot1"
        self.revision += 1
        return {"outcome": "ok", "detail": "as told", "revision": self.revision}


class Site:
    """The machine of robot3 between two cells, whose gateways have sockets in the place of endpoints."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.cells = {"hall-a": Hall(A, "ab"), "hall-b": Hall(B, "cd")}
        self.running: str | None = "hall-a"
        self.is_taken = self.starts = True
        self.cells["hall-a"].alive.add(ME)
        self.cells["hall-a"].owner = ME
        self.doors = contextlib.ExitStack()
        (folder / "run").mkdir()
        (folder / "gates").mkdir()
        self._open("run/robot3", self.answer)
        for name, cell in self.cells.items():
            self._open(f"gates/{name}", lambda request, cell=cell: cell.answer(request, "robot1"))

    def _open(self, name: str, answer: Any) -> None:
        door = OperatorSocket(self.folder / f"{name}.sock", answer)
        door.open()
        self.doors.callback(door.close)

    def answer(self, request: Json) -> Json:
        if self.running is None:
            return {"error": "nobody runs here"}
        cell = self.cells[self.running]
        if request["verb"] == "leave":
            cell.alive.discard(ME)
            self.running = None
            return {"outcome": "ok"}
        return cell.answer(request, request.get("node", ME))

    def start(self, _way: object) -> bool:
        """What the operator does, or systemd."""
        if not self.starts and whose(self.folder / "state")[0] == "hall-b":
            return False
        self.running = whose(self.folder / "state")[0]
        if self.running == "hall-a" or self.is_taken:
            self.cells[self.running].alive.add(ME)
        return True


def keep_state(folder: Path, *electors: str) -> None:
    """Write robot3's state in hall-a, with the electors that it knows."""
    plain = blank_state(
        load_fleet(folder.parent / "etc" / "fleet.yaml"), ME, 0, None, incarnation=1, hardware="", disk="01"
    )
    told = Hall(A, "ab")
    told.electors = list(electors)
    value = from_plain(told.answer({"verb": "fleet"}, ME)["value"], FleetValue)
    (folder / "state").unlink(missing_ok=True)
    with StateFile(folder, fleet="hall-a", node=ME) as own:
        own.create(replace(plain, fleet_register=RegisterState(task="hall-a", learnt=value)))


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Site]:
    for name, place in (("CONFIG", "etc/fleet.yaml"), ("STATE_DIR", "state"), ("RUNTIME_DIR", "run")):
        monkeypatch.setenv(f"ZSCHED_{name}", str(tmp_path / place))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.delenv("ZSCHED_NODE", raising=False)
    for module in (flags, leave, lacks):
        monkeypatch.setattr(module, "PAUSE_S", 0.001)
    for name in ("REACH_S", "TAKE_S"):
        monkeypatch.setattr(change_cell, name, 0.05)
    (tmp_path / "etc").mkdir()
    file = tmp_path / "etc" / "fleet.yaml"
    file.write_text(A)
    keep_state(tmp_path / "state", "robot1")
    (tmp_path / "state" / "documents").mkdir()
    (tmp_path / "state" / "documents" / "ab").write_text("x")
    (tmp_path / "state" / "copied").write_text("0123\n")
    (tmp_path / "state" / "decisions.ndjson").write_text("{}\n")
    one = Site(tmp_path)

    def gate(cell: Cell, _fleet: str, _here: Door | None) -> Door:
        return Door(socket=tmp_path / "gates" / f"{cell.name}.sock")

    monkeypatch.setattr(change_cell, "door_of", gate)
    monkeypatch.setattr(change_cell, "_started", one.start)
    with one.doors:
        yield one


def run(*words: str) -> Result:
    result = CliRunner().invoke(app, ["leave", *words])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def kept(folder: Path) -> list[str]:
    """What the machine keeps of its fleets."""
    found = [path for part in ("etc", "state") for path in (folder / part).rglob("*") if path.is_file()]
    return sorted(str(path.relative_to(folder)) for path in found if path.name != "lock")


def check_arrived(site: Site) -> None:
    """It is hall-b's node and nobody else's, and each cell was changed once."""
    assert (whose(site.folder / "state"), site.running) == (("hall-b", ME), "hall-b")
    assert load_fleet(site.folder / "etc" / "fleet.yaml").name == "hall-b"
    assert site.cells["hall-b"].done == [f"+{ME}"]
    assert site.cells["hall-a"].done == ["leave", f"-{ME}"]
    assert site.cells["hall-a"].flags == []
    assert not (site.folder / "state" / "next-cell").exists()


def test_the_plan_shows_both_cells_and_changes_nothing(site: Site) -> None:
    before = kept(site.folder)
    plan = run("--to", "hall-b", "--plan")
    rows = [line.split() for line in plan.stdout.splitlines()]
    assert plan.exit_code == 10
    assert [ME, "member", "hall-a", "hall-b"] in rows
    assert [ME, "invited", "by", "hall-b", "-", "yes"] in rows
    assert ["merge", "owner", ME, "one", "of", "robot1,", "robot2"] in rows
    assert "robot3 would leave hall-a, and join hall-b" in plan.stdout
    asked = run("--to", "hall-b")
    assert (asked.exit_code, "--yes" in asked.stderr) == (2, True)
    assert (kept(site.folder), site.cells["hall-a"].done, site.cells["hall-b"].done) == (before, [], [])


def test_it_leaves_one_cell_and_is_ready_in_the_other(site: Site) -> None:
    done = run("--to", "hall-b", "--yes", "-m", "new area")
    assert done.exit_code == 0, done.stderr
    check_arrived(site)
    order = ["hall-b: revision 8 is agreed, and robot3 may join", "merge: robot3 -> robot1", "robot3: empty"]
    order += ["the daemon has ended", "its daemon runs in hall-b", "hall-b counts it"]
    order += ["hall-a: revision 9 is agreed, and robot3 is no node of it", "is ready in hall-b"]
    places = [done.stdout.index(one) for one in order]
    assert places == sorted(places)
    text = site.cells["hall-b"].text
    entry = node_entry(text, ME, "tcp")
    assert "wired: true" in entry
    assert "7465" in entry
    assert "links" not in entry
    assert "seeds: [edge1, robot1, robot3]" in text or "seeds: [robot1, edge1, robot3]" in text
    again = run("--to", "hall-b", "--yes")
    assert (again.exit_code, "already: nothing to do" in again.stdout) == (0, True)


def test_what_another_change_overtakes_is_proposed_again(site: Site) -> None:
    site.cells["hall-a"].conflicts = 3
    done = run("--to", "hall-b", "--yes")
    assert done.exit_code == 0, done.stderr
    check_arrived(site)


@pytest.mark.parametrize(("times", "code"), [(1, 0), (9, 1)])
def test_what_an_operator_changes_meanwhile_is_looked_at_once(site: Site, times: int, code: int) -> None:
    """Another machine leaves at the same time; a cell that changes again and again is not asked for a minute."""
    hall = site.cells["hall-a"]
    hall.conflicts = times

    def meanwhile() -> None:
        told = {"kind": "ineligible", "subject": "robot2", "by": "somebody", "reason": "", "for_s": None}
        hall.flags = [{**told, "revision": 8 + times - hall.conflicts}]

    hall.meanwhile = meanwhile
    done = run("--to", "hall-b", "--yes")
    assert done.exit_code == code, done.stderr
    assert hall.conflicts == max(0, times - 2), "two drains, each asked for once"
    if code:
        assert "the fleet was changed meanwhile" in done.stderr
        assert not [one for one in hall.done if one.startswith("-")]
    else:
        assert whose(site.folder / "state") == ("hall-b", ME)


@pytest.mark.usefixtures("site")
def test_programs_read_events_and_then_the_end() -> None:
    plan = [json.loads(line) for line in run("--to", "hall-b", "--plan", "--json").stdout.splitlines()]
    assert [fault for one in plan for fault in faults(one)] == []
    assert [(one["schema"], one.get("outcome")) for one in plan][-1] == ("zsched.member/1", "planned")
    found = [json.loads(line) for line in run("--to", "hall-b", "--yes", "--json").stdout.splitlines()]
    assert [fault for one in found for fault in faults(one)] == []
    assert (found[-1]["schema"], found[-1]["outcome"], found[-1]["fleet"]) == ("zsched.member/1", "joined", "hall-b")


STEPS = (
    *("change", "invitation_for", "drain", "give_up_the_seat", "stop_daemon", "undrain"),
    *("_wait_for_the_next", "_started", "_not_taken", "_not_forgotten"),
)
FILES = ("begin", "go_over", "end")


@pytest.mark.parametrize("is_after", [False, True])
@pytest.mark.parametrize("step", [*STEPS, *FILES])
def test_broken_off_at_any_step_it_is_given_again(
    site: Site, monkeypatch: pytest.MonkeyPatch, step: str, is_after: bool
) -> None:
    owner = next_cell if step in FILES else change_cell
    real = getattr(owner, step)

    def broken(*given: Any, **more: Any) -> Any:
        if is_after:
            real(*given, **more)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(owner, step, broken)
        result = CliRunner().invoke(app, ["leave", "--to", "hall-b", "--yes"])
        assert (result.exit_code != 0) == (step != "undrain")
    done = run("--to", "hall-b", "--yes")
    assert done.exit_code == 0, done.stderr
    check_arrived(site)


def test_a_cell_that_does_not_take_it_gives_it_back(site: Site) -> None:
    site.is_taken = False
    before = kept(site.folder)
    refused = run("--to", "hall-b", "--yes")
    assert refused.exit_code == 1
    assert "hall-b has not taken it" in refused.stderr
    assert "robot3 works in hall-a as before" in refused.stderr
    assert (whose(site.folder / "state"), site.running) == (("hall-a", ME), "hall-a")
    assert site.cells["hall-a"].done == ["leave", "undrain"]
    assert kept(site.folder) == before
    assert (site.folder / "etc" / "fleet.yaml").read_text() == A
    log = site.folder / "state" / "decisions.ndjson"
    assert log.read_text() == "{}\n"
    site.is_taken = True
    assert run("--to", "hall-b", "--yes").exit_code == 0
    assert whose(site.folder / "state") == ("hall-b", ME)
    assert not log.exists(), "`history` and `explain --at` tell of one fleet"
    assert log.with_name("decisions.ndjson.left").read_text() == "{}\n"


def test_a_daemon_that_does_not_start_there_is_the_former_cell_s_again(site: Site) -> None:
    site.starts = False
    refused = run("--to", "hall-b", "--yes")
    assert (refused.exit_code, site.running) == (1, "hall-a")
    assert "its daemon does not start there" in refused.stderr


def test_nobody_starts_it_and_the_operator_takes_it_back(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(change_cell, "_started", lambda _way: True)
        late = run("--to", "hall-b", "--yes", "--deadline", "1s")
        assert late.exit_code == 5
        assert "its daemon does not run: zsched up --config" in late.stderr
        assert "`zsched leave --to hall-a` to go back" in late.stderr
    wrong = run("--to", "hall-c", "--yes")
    assert (wrong.exit_code, "on its way from hall-a to hall-b" in wrong.stderr) == (2, True)
    asked = run("--to", "hall-a")
    assert (asked.exit_code, "between hall-a and hall-b" in asked.stdout) == (2, True)
    back = run("--to", "hall-a", "--yes")
    assert (back.exit_code, whose(site.folder / "state"), site.running) == (1, ("hall-a", ME), "hall-a")
    assert site.cells["hall-a"].flags == []


def here(site: Site) -> set[str]:
    """This machine's files, without those that are put away."""
    return {name for name in kept(site.folder) if not name.endswith(".left")}


def always(*_given: Any, **_more: Any) -> bool:
    return True


def broken_at(monkeypatch: pytest.MonkeyPatch, call: str, number: int, counts: Callable[..., bool] = always) -> bool:
    """Begin the change to hall-b, broken off at that call of those that count; false: it takes fewer of them."""
    left, real = [number], getattr(membership, call)

    def broken(*given: Any, **more: Any) -> None:
        left[0] -= counts(*given, **more)
        if left[0] == -1:
            raise KeyboardInterrupt
        real(*given, **more)

    with monkeypatch.context() as patch:
        patch.setattr(membership, call, broken)
        CliRunner().invoke(app, ["leave", "--to", "hall-b", "--yes"])
    return left[0] < 0


@pytest.mark.parametrize("number", slices(9))
@pytest.mark.parametrize("call", ["_put_one_away", "_put"])
def test_files_that_were_changed_in_part_are_changed_to_the_end(
    site: Site, monkeypatch: pytest.MonkeyPatch, call: str, number: int
) -> None:
    if not broken_at(monkeypatch, call, number):
        return
    assert run("--to", "hall-b", "--yes").exit_code == 0
    check_arrived(site)


@pytest.mark.parametrize("number", slices(9))
def test_files_that_were_put_away_in_part_get_their_names_again_on_the_way_back(
    site: Site, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    """The state is put away last, so it told that nothing was to be done: the daemon could not start any more."""
    before = here(site)
    if not broken_at(monkeypatch, "_put_one_away", number) or whose(site.folder / "state")[0] != "hall-a":
        return
    back = run("--to", "hall-a", "--yes")
    assert "works in hall-a as before" in back.stderr
    assert before <= set(kept(site.folder))
    assert (whose(site.folder / "state"), site.running) == (("hall-a", ME), "hall-a")


def check_goes_on(site: Site, word: str, before: set[str]) -> None:
    """Whatever was broken off, the machine gets to that cell; ``before``: its files when it was hall-a's."""
    site.is_taken = True
    done = run("--to", word, "--yes")
    if word == "hall-b":
        assert done.exit_code == 0
        check_arrived(site)
    else:
        assert "works in hall-a as before" in done.stderr
        assert before <= set(kept(site.folder))
        assert (whose(site.folder / "state"), site.running) == (("hall-a", ME), "hall-a")


@pytest.mark.parametrize("word", ["hall-a", "hall-b"])
@pytest.mark.parametrize("number", slices(9))
def test_a_way_back_that_was_broken_off_goes_on_either_way(
    site: Site, monkeypatch: pytest.MonkeyPatch, number: int, word: str
) -> None:
    before = here(site)
    site.is_taken = False
    if not broken_at(monkeypatch, "_put_one_away", number, lambda _path, *, is_deleted: is_deleted):
        return
    check_goes_on(site, word, before)


@pytest.mark.parametrize("word", ["hall-a", "hall-b"])
@pytest.mark.parametrize("number", slices(12))
def test_a_way_back_that_was_broken_off_between_two_files_goes_on(
    site: Site, monkeypatch: pytest.MonkeyPatch, number: int, word: str
) -> None:
    """Towards hall-a it deleted the files that it had given their names again."""
    before = here(site)
    site.is_taken = False
    real, left, is_back = sync_folder, [number], [False]

    def broken(folder: Path) -> None:
        real(folder)
        left[0] -= is_back[0]
        if left[0] == -1:
            raise KeyboardInterrupt

    def back(*given: Any, **more: Any) -> None:
        is_back[0] = True
        membership.bring_back(*given, **more)

    with monkeypatch.context() as patch:
        patch.setattr(membership, "sync_folder", broken)
        patch.setattr(next_cell, "bring_back", back)
        CliRunner().invoke(app, ["leave", "--to", "hall-b", "--yes"])
    if left[0] >= 0:
        return  # it takes fewer steps
    check_goes_on(site, word, before)


@pytest.mark.parametrize(
    ("words", "code", "told"),
    [
        (("--to", "hall-x"), 2, "'hall-x' is no cell of the site, and no invitation"),
        (("--to", "/nowhere/robot3"), 2, "--to: there is no file /nowhere/robot3; give the invitation's path"),
        (("--to", "robot3.invite"), 2, "--to: there is no file robot3.invite"),
        (("--to", "hall-b", "--purge"), 2, "--purge does not go with --to"),
        (("--to", "hall-b", "--accept", "nothing"), 2, "there is no danger 'nothing'"),
    ],
)
def test_wrong_words_change_nothing(site: Site, words: tuple[str, ...], code: int, told: str) -> None:
    wrong = run(*words, "--yes")
    assert (wrong.exit_code, told in wrong.stderr) == (code, True), wrong.stderr
    assert (site.cells["hall-a"].done, site.cells["hall-b"].done) == ([], [])


def test_what_keeps_a_cell_from_letting_it_go_or_in_is_refused_before_anything(site: Site) -> None:
    there, here = site.cells["hall-b"], site.cells["hall-a"]
    there.is_whole = False
    assert "hall-b has no quorum" in run("--to", "hall-b", "--yes").stderr
    there.is_whole, here.is_whole = True, False
    assert "nothing was changed" in run("--to", "hall-b", "--yes").stderr
    here.is_whole = True
    there.text, there.alive = there.text.replace("edge1: {kind: edge", "robot3: {kind: edge"), {"robot1", ME}
    refused = run("--to", "hall-b", "--yes")
    assert (refused.exit_code, "another machine has that name" in refused.stderr) == (1, True)
    there.text = B.replace("{kind: robot}, weights", "[robot1], weights").replace("tcp/127.0.0.1:7561", "bad")
    assert run("--to", "hall-b", "--yes").exit_code in (1, 78)
    assert (here.done, there.done, site.running) == ([], [], "hall-a")


def test_a_secured_cell_takes_a_machine_by_an_invitation_with_its_key(site: Site) -> None:
    secured = '{gateways: ["tls/127.0.0.1:7557", "tls/127.0.0.1:7561"], file: hall-b.yaml}'
    site.cells["hall-a"].text = A.partition("  hall-b:")[0] + f"  hall-b: {secured}\n"
    refused = run("--to", "hall-b", "--yes")
    assert refused.exit_code == 1
    assert "hall-b is secured, and takes robot3 by an invitation" in refused.stderr
    assert "zsched invite robot3 > robot3.invite" in refused.stderr
    assert (site.cells["hall-a"].done, site.cells["hall-b"].done) == ([], [])


def test_an_invitation_from_elsewhere_is_as_good_as_the_name_of_its_cell(site: Site, tmp_path: Path) -> None:
    """As of a secured cell, whose authority is on another machine."""
    there = site.cells["hall-b"]
    there.text = there.text.replace("tasks:", f"  {ME}: {{kind: robot}}\ntasks:")
    invitation = membership_invitation(tmp_path)
    done = run("--to", str(invitation), "--yes")
    assert done.exit_code == 0, done.stderr
    assert whose(site.folder / "state") == ("hall-b", ME)
    assert there.done == [], "it was invited"


def test_an_invitation_with_a_certificate_that_nobody_would_take_moves_nothing(site: Site, tmp_path: Path) -> None:
    """The machine would be out of its cell, and in no other."""
    there, here = site.cells["hall-b"], site.cells["hall-a"]
    there.text = there.text.replace("tasks:", f"  {ME}: {{kind: robot}}\ntasks:")
    file = membership_invitation(tmp_path)
    brought = replace(decode_invitation(file.read_bytes()), papers=Papers(certificate="c", key="k", trusted="t"))
    file.write_text(encode_invitation(brought))
    refused = run("--to", str(file), "--yes")
    assert refused.exit_code == 1
    assert "its certificate names None, and its node is robot3" in " ".join(refused.stderr.split())
    assert (here.done, there.done, site.running) == ([], [], "hall-a")


def test_the_way_back_is_told_with_the_options_that_were_given(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lacks, "LONG_S", 0.0)
    there = site.cells["hall-b"]
    there.text = B.replace("tasks:", f"  {ME}: {{kind: robot}}\ntasks:")
    invitation = membership_invitation(tmp_path)
    there.text = B
    monkeypatch.delenv("ZSCHED_STATE_DIR")
    refused = run("--to", str(invitation), "--yes", "--state-dir", str(tmp_path / "state"))
    assert refused.exit_code == 1
    assert f"`zsched leave --to hall-a --state-dir {tmp_path / 'state'}` takes back what was begun" in refused.stderr


def test_who_takes_the_authority_of_its_cell_away_says_so_first(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    here, stick = site.cells["hall-a"], tmp_path / "stick"
    monkeypatch.setenv("ZSCHED_AUTHORITY", str(stick))
    here.text = A.partition("site:")[0].replace("tcp/", "tls/") + f"security: {{}}\nsite:{A.partition('site:')[2]}"
    (tmp_path / "etc" / "fleet.yaml").write_text(here.text)
    install(make_authority(stick, "hall-a"), tmp_path / "etc" / "pki", ME)
    plan = run("--to", "hall-b", "--plan")
    assert (plan.exit_code, f"holds-authority: {stick} holds the authority of hall-a" in plan.stderr) == (10, True)
    refused = run("--to", "hall-b", "--yes")
    assert (refused.exit_code, here.done, site.cells["hall-b"].done) == (1, [], [])
    assert f"nothing was changed; if this may be, --accept holds-authority: {stick} holds" in refused.stderr
    done = run("--to", "hall-b", "--yes", "--accept", "holds-authority")
    assert done.exit_code == 0, done.stderr
    check_arrived(site)
    assert f"next: move {stick} to /root/.local/share/zsched/authority/hall-a on another node of hall-a" in done.stdout


def membership_invitation(folder: Path) -> Path:
    """Written by `zsched invite` at the gateway of hall-b."""
    door = Door(socket=folder / "gates" / "hall-b.sock")
    path = folder / "robot3.invite"
    path.write_text(encode_invitation(invitation_for(door, Guest(name=ME), b"")))
    return path


def test_a_cell_that_does_not_name_it_any_more_takes_nothing_from_it(
    site: Site, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lacks, "LONG_S", 0.0)
    monkeypatch.setattr(change_cell, "REACH_S", 2.0)
    there, here = site.cells["hall-b"], site.cells["hall-a"]
    there.text = B.replace("tasks:", f"  {ME}: {{kind: robot}}\ntasks:")
    invitation = membership_invitation(tmp_path)
    there.text = B
    refused = run("--to", str(invitation), "--yes")
    assert refused.exit_code == 1
    assert "hall-b does not let robot3 in: robot1 of hall-b does not name robot3" in refused.stderr
    back = "robot3 works on in hall-a; `zsched leave --to hall-a` takes back what was begun"
    assert back in refused.stderr
    assert refused.stdout.count("hall-b is asked to let robot3 in, for at most ") == 1, "it does not wait in silence"
    assert (here.done, site.running, whose(site.folder / "state")) == ([], "hall-a", ("hall-a", ME))

    def ctrl_c(*_given: object, **_more: object) -> str:
        raise KeyboardInterrupt

    monkeypatch.setattr(change_cell, "wait_for", ctrl_c)
    ended = run("--to", str(invitation), "--yes")
    assert ended.exit_code
    assert "broken off while hall-b is asked to let robot3 in" in ended.stderr
    assert back in ended.stderr
    assert run("--to", "hall-a", "--yes").exit_code == 0
    assert next_cell.under_way(site.folder / "state") is None


def test_a_public_address_is_not_taken_into_a_cell_without_certificates_unasked(site: Site) -> None:
    here = site.cells["hall-a"]
    here.text = A.replace("    host: 127.0.0.1\n", "    host: 8.8.8.8\n")
    refused = run("--to", "hall-b", "--yes")
    assert (refused.exit_code, here.done, site.cells["hall-b"].done) == (1, [], [])
    assert "--accept open-network" in refused.stderr
    assert run("--to", "hall-b", "--yes", "--accept", "open-network").exit_code == 0


def test_a_task_that_nobody_else_can_have_keeps_it_before_the_next_cell_is_asked(site: Site) -> None:
    site.cells["hall-a"].owner = ME
    site.cells["hall-a"].candidates = [ME]
    refused = run("--to", "hall-b", "--yes")
    assert (refused.exit_code, "no-other-candidate" in refused.stderr) == (1, True)
    assert (site.cells["hall-a"].done, site.cells["hall-b"].done) == ([], [])


def test_one_whose_daemon_died_before_its_seat_was_given_up_is_started_again_first(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_given: Any, **_more: Any) -> int:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(change_cell, "drain", broken)  # the plan's is the first one
        CliRunner().invoke(app, ["leave", "--to", "hall-b", "--yes", "--json"])
    site.running = None
    keep_state(site.folder / "state", "robot1", ME)
    refused = run("--to", "hall-b", "--yes")
    assert refused.exit_code == 3
    assert "robot3 is an elector of hall-a still, and its daemon does not run: zsched up" in refused.stderr
    site.running = "hall-a"
    assert run("--to", "hall-b", "--yes").exit_code == 0
    check_arrived(site)


def test_a_cell_that_forgot_it_between_two_tries_is_asked_again(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_given: Any, **_more: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(change_cell, "_wait_for_the_next", broken)
        CliRunner().invoke(app, ["leave", "--to", "hall-b", "--yes"])
    there = site.cells["hall-b"]
    assert ME in there.names
    there.text, there.done = B, []
    assert run("--to", "hall-b", "--yes").exit_code == 0
    check_arrived(site)


def broken_off(site: Site, monkeypatch: pytest.MonkeyPatch, step: str, *words: str) -> Result:
    """Give the command, and break it off where a step begins."""

    def broken(*_given: Any, **_more: Any) -> Any:
        raise KeyboardInterrupt

    owner = next_cell if step in FILES else change_cell
    with monkeypatch.context() as patch:
        patch.setattr(owner, step, broken)
        result = CliRunner().invoke(app, ["leave", *words, "--yes"])
    assert result.exit_code != 0
    assert (site.folder / "state" / "next-cell").exists()
    return result


def test_who_interrupts_it_between_two_cells_hears_where_the_machine_is(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    result = broken_off(site, monkeypatch, "go_over", "--to", "hall-b")
    assert whose(site.folder / "state")[0] == "hall-a"
    assert (
        f"{ME} is between hall-a and hall-b, and may have no daemon: give `zsched leave --to hall-b`" in result.stderr
    )
    assert "or `zsched leave --to hall-a` to go back" in result.stderr


def test_another_invitation_does_not_lead_into_the_cell_that_is_under_way(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Any file would do, and the machine became a node of the cell before."""
    broken_off(site, monkeypatch, "go_over", "--to", "hall-b")
    invitation = membership_invitation(site.folder)
    given = decode_invitation(invitation.read_bytes())
    invitation.write_text(encode_invitation(replace(given, node="robot1")))
    refused = run("--to", str(invitation), "--yes")
    assert (refused.exit_code, "invites robot1 into fleet hall-b" in refused.stderr) == (2, True), refused.stderr
    assert whose(site.folder / "state")[0] == "hall-a"
    assert run("--to", "hall-b", "--yes").exit_code == 0
    check_arrived(site)


def test_a_cell_that_has_forgotten_it_is_no_way_back(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    broken_off(site, monkeypatch, "end", "--to", "hall-b")
    site.cells["hall-b"].is_whole = False
    for words in (("--to", "hall-b"), ("--to", "hall-a")):
        refused = run(*words, "--yes")
        assert (refused.exit_code, "there is no way back" in refused.stderr) == (1, True), refused.stderr
        assert (whose(site.folder / "state"), site.running) == (("hall-b", ME), "hall-b")
    site.cells["hall-b"].is_whole = True
    assert run("--to", "hall-b", "--yes").exit_code == 0
    check_arrived(site)


def test_what_has_gone_no_further_than_the_flag_is_taken_back_by_its_own_cell_s_name(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken_off(site, monkeypatch, "give_up_the_seat", "--to", "hall-b")
    back = run("--to", "hall-a", "--yes")
    assert back.exit_code == 0
    assert f"hall-b names {ME} until somebody there says: zsched node forget {ME}" in back.stderr
    assert (site.cells["hall-a"].done, site.running) == (["leave", "undrain"], "hall-a")
    assert not (site.folder / "state" / "next-cell").exists()


def test_a_secured_cell_s_invitation_is_kept_for_the_next_try(site: Site, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its file may have been deleted since; the name of the cell is enough."""
    there = site.cells["hall-b"]
    site.cells["hall-a"].text = A.partition("site:")[0]
    there.text = there.text.replace("tasks:", f"  {ME}: {{kind: robot}}\ntasks:")
    invitation = membership_invitation(site.folder)
    broken_off(site, monkeypatch, "give_up_the_seat", "--to", str(invitation))
    invitation.unlink()
    assert run("--to", "hall-b", "--yes").exit_code == 0
    assert whose(site.folder / "state") == ("hall-b", ME)


def test_what_somebody_takes_back_while_the_next_cell_is_asked_goes_no_further(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`zsched undrain` in another terminal, while this machine waits to be let in."""
    wait, here = change_cell._wait_for_the_next, site.cells["hall-a"]

    def taken_back(*given: Any) -> None:
        wait(*given)
        if here.flags:
            here.flags, here.revision = [], here.revision + 1

    monkeypatch.setattr(change_cell, "_wait_for_the_next", taken_back)
    ended = run("--to", "hall-b", "--yes")
    assert (ended.exit_code, site.running, here.done) == (1, "hall-a", ["leave"])
    assert "the leave is not in force any more: it was taken back" in ended.stderr


def test_a_change_that_has_waited_goes_by_what_the_former_cell_says_now(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nodes of the former cell may have got other addresses since, and the machine is to be forgotten by one."""
    here, kept_file = site.cells["hall-a"], site.folder / "state" / "next-cell" / "former" / "fleet.yaml"
    broken_off(site, monkeypatch, "give_up_the_seat", "--to", "hall-b")
    assert kept_file.read_text() == here.text
    here.text = here.text.replace("tcp/127.0.0.1:7457", "tcp/127.0.0.1:8457")
    broken_off(site, monkeypatch, "give_up_the_seat", "--to", "hall-b")
    assert "tcp/127.0.0.1:8457" in kept_file.read_text()
