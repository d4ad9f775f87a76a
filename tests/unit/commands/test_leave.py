"""`zsched leave`: in which order things are agreed, what is refused, and which files are left; nodes are stand-ins."""

from __future__ import annotations

import copy
import io
import itertools
import json
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from support.authorities import make_authority
from support.fleet_values import fleet_value_of
from support.schemas import faults
from zsched.cli import app
from zsched.commands.members import leave
from zsched.config.load import load_fleet
from zsched.core.values.codec import as_plain
from zsched.core.values.electorate import Elector
from zsched.core.vote.generations import blank_state
from zsched.host.operator_socket import Json, OperatorSocket
from zsched.host.state_file import StateFile

STATUS = json.loads((Path(__file__).parent / "recorded_status" / "healthy.json").read_text())
TEXT = """\
fleet: hall
nodes:
  robot1: {kind: robot, host: 127.0.0.1, listen: {control: tcp/127.0.0.1:7457, data: tcp/127.0.0.1:7458}}
  robot2: {kind: robot, host: 127.0.0.1, listen: {control: tcp/127.0.0.1:7461, data: tcp/127.0.0.1:7462}}
  robot3: {kind: robot}
tasks:
  merge: {candidates: {kind: robot}, weights: {cpu: 0.5, memory: 0.5}}
"""
SECURED = f"{TEXT.replace('tcp/', 'tls/')}security: {{}}\n"
ALONE = "fleet: hall\nnodes:\n  robot3: {kind: robot}\ntasks: {}\n"


class Hall:
    """Three nodes behind the socket of robot3, which agree on everything; each look at robot3's value is a step."""

    def __init__(self, folder: Path, text: str = TEXT) -> None:
        self.folder, self.text = folder, text
        self.revision, self.flags = 7, list[Json]()
        self.electors = ["robot1", "robot2", "robot3"]
        self.owner, self.quorum_ok, self.is_told_gone, self.has_document = "robot3", True, False, True
        self.seat_goes_after: float = 2
        self.looks_of_robot2, self.fetches_after = 0, 0
        self.asked: list[str] = []
        self.problems: list[str] = []
        self.problem_kinds: list[str] = []
        self.unknowing = 0
        """Looks at robot3, once it is flagged, at which its daemon has just begun."""
        self.loses_an_answer = False
        """The next document is agreed, and its answer is lost."""
        self.door = OperatorSocket(folder / "run" / "robot3.sock", self.answer)

    def answer(self, request: Json) -> Json:
        who, verb = request.get("node", "robot3"), request["verb"]
        if verb == "status":
            return self._status(who)
        if verb == "fleet":
            return self._fleet(who)
        if verb == "leave":
            self.asked.append("leave")
            return {"outcome": "ok"}
        return self._change(who, request)

    def _status(self, who: str) -> Json:
        nodes = [
            {
                **STATUS["nodes"][0],
                "name": name,
                "kind": "robot",
                "state": "alive",
                "draining": False,
                "flags": [{**flag, "known_s": 1.0} for flag in self.flags if flag["subject"] == name],
                "workers": [{**STATUS["nodes"][0]["workers"][0], "task": "merge", "state": "ready"}],
            }
            for name in ("robot1", "robot2", "robot3")
            if f"  {name}:" in (ALONE if self.text == ALONE else TEXT)
        ]
        names = [str(node["name"]) for node in nodes]
        task = {**copy.deepcopy(STATUS["tasks"][0]), "name": "merge", "owner": self.owner, "candidates": names}
        task |= {
            "phase": "settled",
            "streams": [],
            "owner_state": "alive",
            "pin": None,
            "pause": None,
            "switched_s": 0.03,
        }
        quorum = {**STATUS["quorum"], "ok": self.quorum_ok, "names": self.electors, "pilot": "it waits for a spare"}
        body = {**STATUS, "fleet": "hall", "node": who, "nodes": nodes, "tasks": [task], "quorum": quorum}
        return {**body, "fleet_revision": self.revision, "problems": self.problems, "problem_kinds": self.problem_kinds}

    def _fleet(self, who: str) -> Json:
        if who == "robot3" and any(flag["kind"] == "leave" for flag in self.flags):
            if self.unknowing:
                self.unknowing -= 1
                return {"node": who, "fleet_file": "cd" * 16, "disk": "01", "revision": None}
            self.seat_goes_after -= 1
            if self.seat_goes_after <= 0 and "electorate:" not in self.text:
                self._remove_elector()
        names = [{"name": name, "disk": "01"} for name in self.electors]
        value = fleet_value_of(
            self.revision,
            *(Elector(name=name, disk="01", joining=1) for name in self.electors),
            number=2,
            document="cd" * 16,
        )
        text = "" if (who == "robot3" and self.is_told_gone) or not self._knows(who) else self.text
        body = {"node": who, "fleet": "hall", "revision": self.revision, "number": 2, "settled": True}
        told = {"electors": names, "document": "cd" * 16, "text": text, "flags": self.flags, "value": as_plain(value)}
        return {**body, **told, **({} if self.has_document else {"document": "", "text": ""})}

    def _remove_elector(self) -> None:
        self.electors = [name for name in self.electors if name != "robot3"]

    def _knows(self, who: str) -> bool:
        """Whether a node has the newest document; robot2 needs some looks to fetch it."""
        self.looks_of_robot2 += who == "robot2" and "robot3" not in self.text
        return who != "robot2" or "robot3" in self.text or self.looks_of_robot2 > self.fetches_after

    def _change(self, who: str, request: Json) -> Json:
        if request.get("remove_elector"):
            self.asked.append(f"{who} removes {request['remove_elector']}")
            self._remove_elector()
        elif request["text"] == self.text:
            self.flags = request["flags"]
            self.asked.append(f"{who} flags {', '.join(str(flag['kind']) for flag in self.flags)}")
            self.owner = "robot1"
        else:
            self.asked.append(f"{who} writes")
            self.text, self.flags = request["text"], request["flags"]
        self.revision += 1
        if self.loses_an_answer and "robot3" not in self.text:
            self.loses_an_answer = False
            return {"error": f"{who} did not answer within 3 s; is it up and reachable?"}
        return {"outcome": "ok", "detail": "as told", "revision": self.revision}


@pytest.fixture
def hall(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Hall]:
    for name, folder in (("CONFIG", "fleet.yaml"), ("STATE_DIR", "state"), ("RUNTIME_DIR", "run")):
        monkeypatch.setenv(f"ZSCHED_{name}", str(tmp_path / folder))
    monkeypatch.delenv("ZSCHED_NODE", raising=False)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.delenv("ZSCHED_AUTHORITY", raising=False)
    monkeypatch.setattr("zsched.commands.base.change.PAUSE_S", 0.001)
    (tmp_path / "fleet.yaml").write_text(TEXT)
    fleet = load_fleet(tmp_path / "fleet.yaml")
    state = blank_state(fleet, "robot3", 0, None, incarnation=1, hardware="", disk="01")
    with StateFile(tmp_path / "state", fleet="hall", node="robot3") as file:
        file.create(state)
    (tmp_path / "state" / "documents").mkdir()
    (tmp_path / "state" / "documents" / "cd").write_text("x")
    (tmp_path / "state" / "decisions.ndjson").write_text("{}\n")
    (tmp_path / "run").mkdir()
    one = Hall(tmp_path)
    one.door.open()
    yield one
    one.door.close()


def run(*words: str) -> Result:
    result = CliRunner().invoke(app, ["leave", *words])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result


def left(folder: Path) -> list[str]:
    """The names of files that a machine keeps."""
    kept = [path for part in (folder, folder / "state") for path in part.iterdir()]
    return sorted(path.name for path in kept if path.name not in ("run", "state", "lock", "data") or path.is_file())


RENAMED = ["decisions.ndjson.left", "documents.left", "fleet.yaml.left", "lock", "state.left"]
UNTOUCHED = ["decisions.ndjson", "documents", "fleet.yaml", "lock", "state"]


def test_it_hands_over_gives_its_seat_up_goes_out_of_the_document_and_ends(hall: Hall) -> None:
    plan = run("--plan")
    assert (plan.exit_code, hall.asked, left(hall.folder)) == (10, [], UNTOUCHED)
    rows = [line.split() for line in plan.stdout.splitlines()]
    assert ["merge", "owner", "robot3", "one", "of", "robot1,", "robot2"] in rows
    assert ["robot3", "member", "hall", "-"] in rows
    assert ["robot3", "elector", "robot1,", "robot2,", "robot3", "robot1,", "robot2"] in rows
    assert "robot3 would leave hall" in plan.stdout
    assert "fleet.yaml: the fleet file, now fleet.yaml.left" in plan.stdout
    assert run().exit_code == 2, "off a terminal it takes --yes"
    assert (hall.asked, left(hall.folder)) == ([], UNTOUCHED)

    done = run("--yes", "-m", "sold")
    assert (done.exit_code, done.stderr) == (0, "")
    assert hall.asked == ["robot3 flags leave", "robot1 writes", "leave"]
    assert "robot3" not in hall.text
    assert hall.flags == []
    assert left(hall.folder) == RENAMED
    said = done.stdout
    assert "the same command goes on, and `zsched undrain robot3` takes it back" in " ".join(said.split())
    order = ["merge: robot3 -> robot1", "robot3: empty, and gets nothing new\n", "still: it waits for a spare"]
    order += ["electors: robot1, robot2", "revision 9 is agreed, and robot3 is no node of it", "the daemon has ended"]
    places = [said.index(one) for one in (*order, "robot3 has left hall", "it comes back by `zsched invite robot3`")]
    assert places == sorted(places)


def test_it_stays_until_the_others_have_the_new_document(hall: Hall) -> None:
    hall.fetches_after = 3
    done = run("--yes")
    assert (done.exit_code, done.stderr, hall.looks_of_robot2) == (0, "", 4)


def test_it_waits_for_a_daemon_that_begins_anew_meanwhile(hall: Hall) -> None:
    hall.unknowing = 1
    done = run("--yes")
    assert (done.exit_code, done.stderr, hall.unknowing) == (0, "", 0)
    assert "robot3 is an elector still: it does not know the fleet's generation yet" in done.stdout


def test_it_goes_on_where_the_change_is_agreed_and_its_answer_was_lost(hall: Hall) -> None:
    hall.loses_an_answer = True
    done = run("--yes")
    assert (done.exit_code, done.stderr, left(hall.folder)) == (0, "", RENAMED)
    assert hall.asked == ["robot3 flags leave", "robot1 writes", "leave"]
    assert "revision 9 is agreed, and robot3 is no node of it" in done.stdout


@pytest.mark.usefixtures("hall")
def test_programs_read_events_and_then_what_was_left() -> None:
    for words in (("--plan", "--json"), ("--yes", "--json")):
        found = [json.loads(line) for line in run(*words).stdout.splitlines()]
        assert [fault for one in found for fault in faults(one)] == []
        assert [one["schema"] for one in found] == ["zsched.drain/1"] * (len(found) - 1) + ["zsched.member/1"]
        assert found[-1]["outcome"] == ("left" if "--yes" in words else "planned")
    assert [one["event"] for one in found[:-1]] == ["agreed", "moved", "empty"]


def test_an_elector_that_the_operator_has_named_is_removed_by_the_command(hall: Hall) -> None:
    hall.text = f"{TEXT}electorate: [robot1, robot2, robot3]\n"
    assert run("--yes").exit_code == 0
    assert hall.asked == ["robot3 flags leave", "robot3 removes robot3", "robot1 writes", "leave"]
    assert "electorate: [robot1, robot2]\n" in hall.text


def test_at_the_deadline_the_leave_stays_in_force_and_says_what_it_waits_for(hall: Hall) -> None:
    hall.seat_goes_after = 1e9
    late = run("--yes", "--deadline", "1s")
    assert (late.exit_code, hall.asked, left(hall.folder)) == (5, ["robot3 flags leave"], UNTOUCHED)
    assert "it is an elector still: it waits for a spare; give `zsched leave --yes --deadline 1s` again" in late.stderr
    assert "zsched undrain robot3" in late.stderr
    hall.seat_goes_after = 0
    assert run("--yes").exit_code == 0, "the same command goes on"
    assert hall.asked == ["robot3 flags leave", "robot1 writes", "leave"]


def test_the_command_to_give_again_has_the_options_that_were_given(hall: Hall, monkeypatch: pytest.MonkeyPatch) -> None:
    hall.seat_goes_after = 1e9
    options = ["--purge", "--accept", "last-node", "--accept", "not-told", "-m", "it was sold"]
    for option, name, place in (
        ("--config", "CONFIG", "fleet.yaml"),
        ("--state-dir", "STATE_DIR", "state"),
        ("--runtime-dir", "RUNTIME_DIR", "run"),
    ):
        monkeypatch.delenv(f"ZSCHED_{name}")
        options += [option, str(hall.folder / place)]
    options += ["--yes", "--deadline", "1s"]
    late = run(*options)
    assert late.exit_code == 5
    assert f"give `{shlex.join(['zsched', 'leave', *options])}` again to go on" in late.stderr


def test_a_machine_that_was_taken_out_only_stops(hall: Hall) -> None:
    hall.is_told_gone, hall.text = True, TEXT.replace("  robot3: {kind: robot}\n", "")
    done = run("--yes")
    assert (done.exit_code, hall.asked, left(hall.folder)) == (0, ["leave"], RENAMED)
    assert "robot3 is no node of hall since revision 7" in done.stdout


def test_a_machine_that_was_taken_out_and_is_not_answered_any_more_only_stops_too(hall: Hall) -> None:
    """It has the last document that names it, and no quorum: there is nobody left to tell."""
    hall.quorum_ok = False
    hall.problems, hall.problem_kinds = (
        ["fleet/document: the document names no node 'robot3': this machine was taken out, and goes on"],
        ["taken_out"],
    )
    done = run("--yes")
    assert done.exit_code == 0, done.output
    assert (hall.asked, left(hall.folder)) == (["leave"], RENAMED)
    assert "robot3 is no node of hall any more: it was taken out" in done.stdout


@pytest.mark.parametrize(
    ("danger", "means"),
    [
        ("last-node", "robot3 is the only node of hall, which ends with it"),
        ("not-told", "electors can answer"),
        ("not-told", "hall goes by the file on each machine: take robot3 out of it there, or agree a document first"),
    ],
)
def test_what_cannot_be_agreed_takes_a_danger_by_name(hall: Hall, danger: str, means: str) -> None:
    if danger == "last-node":
        hall.text = ALONE
    elif "file" in means:
        hall.has_document = False
    else:
        hall.quorum_ok = False
    refused = run("--yes")
    assert (refused.exit_code, hall.asked, left(hall.folder)) == (1, [], UNTOUCHED)
    assert f"if this may be:\n  {danger}: " in refused.stderr
    assert means in refused.stderr
    assert run("--plan").exit_code == 10
    done = run("--yes", "--accept", danger)
    assert done.exit_code == 0
    assert ("on another node" in done.stdout) is (danger != "last-node"), "there is none"
    assert (hall.asked, left(hall.folder)) == (["leave"], RENAMED), "nobody was asked to agree"
    assert "there is no danger 'last-nod'; did you mean last-node?" in run("--accept", "last-nod").stderr


def test_where_no_daemon_runs_the_files_go_and_the_others_are_not_told(hall: Hall) -> None:
    hall.door.close()
    refused = run("--yes")
    assert (refused.exit_code, left(hall.folder)) == (1, UNTOUCHED)
    assert "`zsched node forget robot3` tells them" in refused.stderr
    assert run("--yes", "--accept", "not-told").exit_code == 0
    assert left(hall.folder) == RENAMED
    gone = run("--yes", "--accept", "not-told")
    assert gone.exit_code == 1
    assert "is not there: this machine is in no fleet" in gone.stderr


class Terminal(io.StringIO):
    """Somebody types there."""

    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("why", ["taken out", "told so", "last-node", "not-told", "no daemon", "it ended"])
def test_whatever_the_others_agree_it_asks_before_it_puts_files_away(
    hall: Hall, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], why: str
) -> None:
    words, rest = ["--purge"], UNTOUCHED
    hall.is_told_gone = why in ("taken out", "it ended")
    if why in ("taken out", "it ended"):
        hall.text = TEXT.replace("  robot3: {kind: robot}\n", "")
    elif why == "told so":
        hall.problems, hall.problem_kinds = (
            ["fleet/document: the document names no node 'robot3': this machine was taken out, and goes on"],
            ["taken_out"],
        )
    else:
        words += ["--accept", why if why == "last-node" else "not-told"]
        hall.text, hall.quorum_ok = ALONE if why == "last-node" else TEXT, why != "not-told"
    if why == "it ended":
        with StateFile(hall.folder / "state", fleet="hall", node="robot3"), monkeypatch.context() as patch:
            patch.setattr(leave, "STOP_S", 0.0)
            assert run(*words, "--yes").exit_code == 5
        rest = sorted([*UNTOUCHED, "out"])
    if why in ("it ended", "no daemon"):
        hall.door.close()
    before = list(hall.asked)

    for more in ((), ("--json",)):
        refused = run(*words, *more)
        assert (refused.exit_code, hall.asked, left(hall.folder)) == (2, before, rest)
        assert "nothing was done, for nobody can be asked here; to do it:\nzsched " in refused.stderr
        assert refused.stderr.endswith(" --yes\n")
    assert refused.stdout == "", "programs read no table"
    plan = run(*words, "--plan")
    assert (plan.exit_code, hall.asked, left(hall.folder)) == (10, before, rest)
    rows = [line.split() for line in plan.stdout.splitlines()]
    assert (["robot3", "member", "hall", "-"] in rows) is ("--accept" in words)
    assert (["robot3", "daemon", "runs", "ended"] in rows) is (why not in ("it ended", "no daemon"))

    for answer, code in (("n\n", 1), ("y\n", 0)):
        assert (hall.asked, left(hall.folder)) == (before, rest)
        monkeypatch.setattr("sys.stdin", Terminal(answer))
        with pytest.raises(SystemExit) as ended:
            app(["leave", *words])
        assert ended.value.code == code
        told = capsys.readouterr()
        table = told.out.partition("Do it? [y/N] ")[0]
        assert [hall.folder.name in line for line in table.splitlines() if "the fleet file" in line] == [True]
        assert ["the", "fleet", "file", "deleted"] in [line.split()[2:] for line in table.splitlines()]
        assert ("nothing was done" in told.err) is (code == 1)
    assert left(hall.folder) == ["lock"]


def test_a_document_that_needs_the_node_is_changed_first(hall: Hall) -> None:
    hall.text = TEXT.replace("{kind: robot}, weights", "[robot3], weights")
    refused = run("--yes")
    assert (refused.exit_code, hall.asked) == (78, [])
    assert "candidates" in refused.stderr
    assert "change it first: zsched edit" in refused.stderr


def test_purged_nothing_is_left(hall: Hall) -> None:
    (hall.folder / "fleet.yaml.left").write_text("an older fleet\n")
    (hall.folder / "pki").mkdir()
    (hall.folder / "pki" / "key.pem").write_text("secret")
    (hall.folder / "pki" / "operator.pem").write_text("ours")
    plan = run("--purge", "--plan")
    assert "key.pem: the private key, for its owner only, deleted" in plan.stdout
    assert run("--purge", "--yes").exit_code == 0
    assert left(hall.folder) == ["lock", "pki"]
    assert [path.name for path in (hall.folder / "pki").iterdir()] == ["operator.pem"], "it is nobody's here to delete"


def test_a_daemon_that_does_not_end_keeps_its_files(hall: Hall, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(leave, "STOP_S", 0.0)
    with StateFile(hall.folder / "state", fleet="hall", node="robot3"):
        late = run("--yes")
    assert (late.exit_code, left(hall.folder)) == (5, sorted([*UNTOUCHED, "out"]))
    assert "robot3 has left hall, and its daemon does not end" in late.stderr
    hall.door.close()
    again = run("--yes")
    assert (again.exit_code, again.stderr, left(hall.folder)) == (0, "", RENAMED), "it was stopped, and all were told"
    assert "robot3 is no node of hall any more, and its daemon has ended" in again.stdout


@pytest.mark.parametrize("way", ["taken out", "told so"])
def test_broken_off_behind_the_daemon_it_goes_on_also_where_another_node_took_it_out(
    hall: Hall, monkeypatch: pytest.MonkeyPatch, way: str
) -> None:
    if way == "told so":
        hall.problems, hall.problem_kinds = (
            ["fleet/document: the document names no node 'robot3': this machine was taken out, and goes on"],
            ["taken_out"],
        )
    else:
        hall.is_told_gone, hall.text = True, TEXT.replace("  robot3: {kind: robot}\n", "")

    def broken_off(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(leave, "check_ended", broken_off)
        assert run("--yes").exit_code != 0
    assert (hall.asked, left(hall.folder)) == (["leave"], sorted([*UNTOUCHED, "out"]))
    hall.door.close()
    assert (run("--plan").exit_code, run("--yes").exit_code, left(hall.folder)) == (10, 0, RENAMED)


def test_another_machine_s_daemon_is_left_alone(hall: Hall) -> None:
    with StateFile(hall.folder / "other", fleet="hall", node="robot1") as file:
        fleet = load_fleet(hall.folder / "fleet.yaml")
        file.create(blank_state(fleet, "robot1", 0, None, incarnation=1, hardware="", disk="02"))
    wrong = run("--yes", "--state-dir", str(hall.folder / "other"))
    assert (wrong.exit_code, hall.asked) == (1, [])
    assert "no daemon of robot1 runs on this machine" in wrong.stderr


@pytest.mark.parametrize("is_empty", [False, True])
def test_a_leave_that_somebody_takes_back_meanwhile_ends_and_the_node_stays(hall: Hall, is_empty: bool) -> None:
    """`zsched undrain` in another terminal: the task may move on later, by itself, and the node is no node to go."""
    looks = itertools.count()

    def answer(request: Json) -> Json:
        told = hall.answer(request)
        if hall.flags or hall.asked:
            look = next(looks)
            hall.owner = "robot1" if is_empty or look > 12 else "robot3"
            if look == (18 if is_empty else 8):  # while it gives its seat up, or before its task has moved
                hall.flags, hall.revision = [], hall.revision + 1
        return told

    hall.electors = hall.electors if is_empty else ["robot1", "robot2"]
    hall.seat_goes_after = 1000
    hall.door.close()
    hall.door = OperatorSocket(hall.folder / "run" / "robot3.sock", answer)
    hall.door.open()
    done = run("--yes", "--deadline", "3s")
    assert (done.exit_code, hall.asked) == (1, ["robot3 flags leave"])
    assert "robot3: the leave is not in force any more: it was taken back" in done.stderr
    assert "  robot3:" in hall.text
    assert left(hall.folder) == UNTOUCHED


@pytest.mark.parametrize("electorate", ["", "electorate: [robot1, robot2, robot3]\n"])
@pytest.mark.parametrize("looks", range(1, 9))
def test_nothing_of_a_leave_is_agreed_after_it_was_taken_back(hall: Hall, electorate: str, looks: int) -> None:
    """At whichever look at what is in force that is: the next step goes by the revision that the look told."""
    hall.text = f"{TEXT}{electorate}"
    left_to_take_back = looks

    def answer(request: Json) -> Json:
        nonlocal left_to_take_back
        if request["verb"] == "change" and request["base_revision"] != hall.revision:
            return {"outcome": "conflict", "detail": "another change came first", "revision": hall.revision}
        told = copy.deepcopy(hall.answer(request))
        if request["verb"] == "fleet" and hall.flags:
            left_to_take_back -= 1
            if left_to_take_back == 0:
                hall.flags, hall.revision = [], hall.revision + 1
                hall.asked.append("taken back")
        return told

    hall.door.close()
    hall.door = OperatorSocket(hall.folder / "run" / "robot3.sock", answer)
    hall.door.open()
    done = run("--yes", "--deadline", "3s")
    if "taken back" in hall.asked:
        assert hall.asked[-1] == "taken back"
        assert done.exit_code == 1
        assert "the leave is not in force any more: it was taken back" in done.stderr
        assert left(hall.folder) == UNTOUCHED


# --- the fleet's authority -------------------------------------------------------------------------------------------


def hold_authority(hall: Hall, fleet: str = "hall") -> Path:
    """Where `zsched fleet create` makes it."""
    hall.text = SECURED
    (hall.folder / "fleet.yaml").write_text(SECURED)
    folder = hall.folder / "data" / "zsched" / "authority" / fleet
    make_authority(folder, fleet)
    return folder


@pytest.mark.parametrize("way", ["agreed", "not-told", "no daemon"])
def test_a_machine_that_holds_the_authority_says_so_before_it_leaves(hall: Hall, way: str) -> None:
    folder, others = hold_authority(hall), () if way == "agreed" else ("--accept", "not-told")
    hall.quorum_ok = way != "not-told"
    if way == "no daemon":
        hall.door.close()
    refused = run("--yes", *others)
    assert (refused.exit_code, hall.asked, left(hall.folder)) == (1, [], UNTOUCHED)
    assert f"  holds-authority: {folder} holds the authority of hall" in refused.stderr
    assert "end within 30 days" in refused.stderr
    if others:
        both = run("--yes")
        assert ("\n  not-told: " in both.stderr, "\n  holds-authority: " in both.stderr) == (True, True)
    plan = run("--plan")
    assert (plan.exit_code, f"holds-authority: {folder}" in plan.stderr) == (10, True)
    done = run("--yes", *others, "--accept", "holds-authority")
    assert (done.exit_code, left(hall.folder)) == (0, RENAMED), done.stderr
    (said,) = [line for line in done.stdout.splitlines() if str(folder) in line]
    assert said.startswith(f"next: move {folder} to /root/.local/share/zsched/authority/hall on another node of hall")
    assert "there `sudo systemctl enable --now zsched-renew.timer`" in said
    assert "here `sudo systemctl disable --now zsched-renew.timer`" in said
    assert (folder / "ca-1.key").exists()


def test_one_that_is_out_already_is_told_of_the_authority_and_leaves(hall: Hall) -> None:
    folder = hold_authority(hall)
    hall.problems, hall.problem_kinds = (
        ["fleet/document: the document names no node 'robot3': this machine was taken out, and goes on"],
        ["taken_out"],
    )
    done = run("--yes")
    assert (done.exit_code, left(hall.folder)) == (0, RENAMED), done.stderr
    assert f"holds-authority: {folder}" in done.stderr
    assert f"next: move {folder} to " in done.stdout


@pytest.mark.parametrize("why", ["in plain text", "another fleet's", "of the last node", "moved away"])
def test_an_authority_that_nobody_needs_here_is_no_danger(
    hall: Hall, monkeypatch: pytest.MonkeyPatch, why: str
) -> None:
    words = ["--yes"]
    folder = hold_authority(hall, "yard" if why == "another fleet's" else "hall")
    if why == "in plain text":
        hall.text = TEXT
        (hall.folder / "fleet.yaml").write_text(TEXT)
    elif why == "another fleet's":
        monkeypatch.setenv("ZSCHED_AUTHORITY", str(folder))
    elif why == "of the last node":
        hall.text = ALONE
        words += ["--accept", "last-node"]
    else:
        folder.rename(hall.folder / "data" / "moved")
    done = run(*words)
    assert done.exit_code == 0, done.stderr
    assert "authority" not in done.stderr
    assert "zsched-renew" not in done.stdout
