"""Status: a node's state as a snapshot, the words for a quorum, the line for a service manager, the JSON's keys."""

from __future__ import annotations

from dataclasses import replace
from random import Random
from typing import Any
from unittest.mock import patch

import pytest

from support.allocations import allocation_of
from support.beats import beat_of
from support.fleets import fleet_of, task_of, tuning_of
from support.profiles import load_of, profile_of
from support.states import state_of
from zsched.commands.base.report import degradations, render_status
from zsched.core.membership.solitude import TAKEN
from zsched.core.node import status
from zsched.core.node.node import Node
from zsched.core.node.status import build_snapshot, status_line
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.document import Flag, FlagKind
from zsched.core.values.fleet import (
    Demand,
    Fleet,
    OnIsolation,
    Security,
    Standby,
    WorkerSpec,
    electorate_hash,
)
from zsched.core.values.instructions import RecordStory
from zsched.core.values.messages import Learnt
from zsched.core.values.model import PeerState
from zsched.core.values.plan import ReadyWhen, StreamCount
from zsched.core.values.problems import Problem
from zsched.core.values.profile import DeviceSample, Jobs, LinkSample, LinkSource, WorkerState
from zsched.core.values.report import snapshot_json
from zsched.core.values.snapshot import SCHEMA, Snapshot
from zsched.core.values.startup import NoState, Startup
from zsched.core.values.todo import ToDo
from zsched.core.values.words import Trouble, told_of_worker
from zsched.core.vote.agreement import Agreement
from zsched_lab.sim.simulator import Simulator

ROBOTS, EDGES = ("robot1", "robot2", "robot3"), ("edge1", "edge2")
TUNING = tuning_of()
FLEET = fleet_of(
    *(task_of(name, EDGES, worker=WorkerSpec(command=("work",))) for name in ("merge", "merge2")),
    of=sorted((*ROBOTS, *EDGES)),
    electors=ROBOTS,
)


def make(me: str = "robot1", *, has_state: bool = True, alive: tuple[str, ...] = ROBOTS, fleet: Fleet = FLEET) -> Node:
    """A node at 100 s that has heard the beats of ``alive``."""
    hashed = electorate_hash(fleet)
    state = state_of(me, electorate=hashed)
    node = Node(
        fleet=fleet,
        me=me,
        durable=state if has_state else None,
        incarnation=7,
        electorate=hashed,
        rng=Random(1),
        now=100.0,
        startup=Startup(version="1.2.3"),
    )
    for name in alive:
        if name != me:
            beat = beat_of(name, incarnation=3)
            node.handle(ev.BeatReceived(beat=beat), 100.0)
    return node


def learn(node: Node, revision: int, owner: str | None, now: float = 100.0, *, epoch: int | None = None) -> None:
    value = allocation_of(revision, owner, epoch)
    node.handle(ev.LearntReceived(learnt=Learnt(node="robot2", values=(value,)), is_answer=True), now)


# --- the quorum ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("me", "has_state", "alive", "expected"),
    [
        ("robot1", True, ROBOTS, (3, True, "elector")),
        ("robot1", True, ("robot2",), (2, True, "elector")),
        ("robot1", True, (), (1, False, "elector")),
        ("robot1", False, ROBOTS, (2, True, "lost_state")),
        ("robot1", False, ("robot2",), (1, False, "lost_state")),
        ("edge1", True, ROBOTS, (3, True, "no_elector")),
        ("edge1", True, ("robot2", "edge2"), (1, False, "no_elector")),
    ],
)
def test_quorum_counts_the_living_electors_and_says_what_this_node_is(
    me: str, has_state: bool, alive: tuple[str, ...], expected: tuple[int, bool, str]
) -> None:
    node = make(me, has_state=has_state, alive=alive)
    quorum = build_snapshot(node, 100.0).quorum
    assert (quorum.electors, quorum.needed) == (3, 2)
    assert (quorum.alive, quorum.ok, quorum.this_node) == expected
    assert status_line(node).endswith("NO QUORUM") is not expected[1]


LATE = 161.0


def hear_again(node: Node) -> None:
    """A minute later those who have no state say so still."""
    for name in sorted(node.stateless):
        node.handle(ev.BeatReceived(beat=beat_of(name, 900, incarnation=3, has_lost_state=True)), LATE)


@pytest.mark.parametrize("is_heard", [True, False])
def test_nothing_drastic_is_advised_before_a_majority_of_the_electors_is_there_to_be_asked(*, is_heard: bool) -> None:
    """A machine that joins again by an old file heard of nobody, and said to begin the whole fleet anew."""
    node = make(has_state=False, alive=("robot2",) if is_heard else ())
    for name in ("robot2", "robot3") if is_heard else ():
        node.handle(ev.BeatReceived(beat=beat_of(name, 2, incarnation=3, has_lost_state=True)), 100.0)
    node.agreement.voted.add("robot2")
    hear_again(node)
    told = "\n".join(build_snapshot(node, LATE).problems)
    assert ("--force" in told) is is_heard


def test_a_full_disk_is_said_as_a_full_disk_and_gives_nobody_s_state_up() -> None:
    node = make()
    full = "cannot write /var/lib/zsched/state: No space left on device"
    for name in ("robot2", "robot3"):
        lost = beat_of(name, 2, incarnation=3, has_lost_state=True, disk_refusal=full)
        node.handle(ev.BeatReceived(beat=lost), 100.0)
    with patch.object(Agreement, "document_hash", "0d"):
        told = "\n".join(build_snapshot(node, LATE).problems)
    assert f"the disk of robot2 refuses what must be saved: {full}" in told
    assert "recover" not in told


def test_electors_that_have_lost_their_state_are_named_and_count_for_nothing() -> None:
    node = make()
    for sequence, name in enumerate(("robot2", "robot3"), 2):
        beat = beat_of(name, sequence, incarnation=3, has_lost_state=True)
        node.handle(ev.BeatReceived(beat=beat), 100.0)
    quorum = build_snapshot(node, 100.0).quorum
    assert (quorum.alive, quorum.ok, quorum.stateless) == (1, False, ("robot2", "robot3"))
    assert build_snapshot(node, 100.0).problems == (
        "electors without their state, 2 of 3: robot2, robot3",
        "no quorum: 1 of 3 electors can answer, 2 needed",
        "nothing can be agreed: too many electors without their states (each says why)",
    )
    hear_again(node)
    assert build_snapshot(node, LATE).problems[-1] == (
        "nothing can be agreed: too many electors without their states (each says why); "
        "if these are lost, stop every daemon, run `zsched fleet recover --generation 1 --force` on every node, "
        "and start them when all have it"
    )
    again = beat_of("robot2", incarnation=4)
    node.handle(ev.BeatReceived(beat=again), LATE + 2.0)
    quorum = build_snapshot(node, LATE + 2.0).quorum
    assert (quorum.alive, quorum.ok, quorum.stateless) == (2, True, ("robot3",))


def test_where_a_document_is_agreed_a_lost_majority_is_recovered_on_one_node() -> None:
    node = make()
    for sequence, name in enumerate(("robot2", "robot3"), 2):
        node.handle(ev.BeatReceived(beat=beat_of(name, sequence, incarnation=3, has_lost_state=True)), 100.0)
    hear_again(node)
    with patch.object(Agreement, "document_hash", "0d"):
        problems = build_snapshot(node, LATE).problems
    assert problems[1].startswith("no quorum: 1 of 3 electors can answer, 2 needed")
    assert problems[2].startswith("nothing can be agreed: too many electors without their states (each says why); ")
    assert problems[2].endswith("run `zsched fleet recover` there, and start it")
    assert not any("--generation" in one for one in problems)


def test_electors_are_waited_for_before_a_recovery_is_named() -> None:
    """Daemons that begin anew are back in seconds; a recovery beside them would make two fleets."""
    node = make(alive=ROBOTS)
    for now in (100.5, 101.0):
        node.handle(ev.DeadlineReached(), now)
    waiting = "no quorum: 1 of 3 electors can answer, 2 needed; waiting for robot2, robot3"
    with patch.object(Agreement, "document_hash", "0d"):
        for now in (110.0, 130.0, 160.0):
            node.handle(ev.DeadlineReached(), now)
            assert waiting in build_snapshot(node, now).problems
            assert not any("recover" in one for one in build_snapshot(node, now).problems)
        node.handle(ev.DeadlineReached(), 162.0)
        (told,) = (one for one in build_snapshot(node, 162.0).problems if one.startswith("no quorum"))
    assert told.startswith(f"{waiting}. Only for nodes that will never come back: stop zsched on one ")
    assert told.endswith("run `zsched fleet recover` there, and start it")


def test_each_counter_of_what_was_refused_tells_when_it_rose_last() -> None:
    node = make(alive=())
    node.handle(ev.FrameDropped(kind="link", reason="stranger"), 100.0)
    node.handle(ev.FrameDropped(kind="beat", reason="rate"), 150.0)
    told = snapshot_json(build_snapshot(node, 160.0))["dropped_ages"]
    assert told == {"dropped_link_stranger": 60.0, "dropped_beat_rate": 10.0}


def test_a_node_with_another_fleets_state_is_not_told_to_begin_anew() -> None:
    """`zsched init` refuses there; the state's own problem says what to do."""
    node = make(has_state=False)
    for sequence, name in enumerate(("robot2", "robot3"), 2):
        node.handle(ev.BeatReceived(beat=beat_of(name, sequence, incarnation=3, has_lost_state=True)), 100.0)
    node.problems["state", ""] = "/x/state belongs to the fleet 'yard', not 'hall': ... (`zsched leave`)"
    assert any("zsched init" in one for one in build_snapshot(node, 100.0).problems)
    node.startup = Startup(no_state=NoState.ANOTHER_NODE)
    told = build_snapshot(node, 100.0).problems
    assert any("`zsched leave`" in one for one in told)
    assert not any("zsched init" in one for one in told)


@pytest.mark.parametrize("subject", [Problem.GENERATION, Problem.TAKEN_OUT, "alone"])
def test_a_node_of_a_fleet_that_lives_on_elsewhere_is_told_nothing_of_a_recovery(subject: str) -> None:
    """Its electors are there, and do not hear this node: a recovery would make a second fleet."""
    node = make("edge1", alive=())
    if subject == Problem.GENERATION:
        node.problems[subject, "robot3"] = "robot3 counts by another generation of this fleet"
    if subject == Problem.TAKEN_OUT:
        node.problems[subject, ""] = "the document names no node 'edge1'"
        node.problems["fleet", "robot1"] = "robot1 goes by another fleet file"
    with patch.object(Agreement, "document_hash", "0d"):
        problems = build_snapshot(node, 200.0).problems
    assert "no quorum: 0 of 3 electors can answer, 2 needed" in problems
    assert not any("recover`" in one for one in problems)
    is_lonely = any("heard nobody" in one for one in problems)
    assert is_lonely is (subject != Problem.GENERATION), "who has heard of another generation has heard somebody"
    assert not any("fleet/robot1" in one for one in problems), "the others go by another document, as they should"


def test_a_machine_that_was_taken_out_is_not_told_to_start_the_others() -> None:
    node = make("edge1", alive=ROBOTS)
    for tick in range(20):
        node.handle(ev.DeadlineReached(), 100.5 + tick / 2)
    assert any(one.startswith("elector robot1 is gone: start") for one in build_snapshot(node, 110.0).problems)
    node.problems[Problem.TAKEN_OUT, ""] = "the document names no node 'edge1'"
    problems = build_snapshot(node, 110.0).problems
    assert "fleet/document: the document names no node 'edge1'" in problems
    assert not any(one.startswith("elector ") for one in problems), "they run, and let it in no more"


def forgotten(me: str = "robot1", *, lacks_file: bool = True, stateless: tuple[str, ...] = ROBOTS) -> Node:
    """A node of a fleet whose electors say that they have no state."""
    node = make(me, has_state=me not in stateless)
    node.startup = Startup(no_state=NoState.MISSING if lacks_file else None)
    node.problems["state", ""] = "/x/state does not exist"
    for name in stateless:
        if name != me:
            beat = beat_of(name, 2, incarnation=3, has_lost_state=True)
            node.handle(ev.BeatReceived(beat=beat), 100.0)
    return node


@pytest.mark.parametrize("me", ["robot1", "edge1"])
def test_a_fleet_that_was_never_initialised_is_told_one_order_and_told_it_first(me: str) -> None:
    snapshot = build_snapshot(forgotten(me), 100.0)
    (told,) = snapshot.problems
    assert told.startswith("never initialised: ")
    assert "Stop every daemon, run `zsched init` on every node, and start them again" in told
    assert "--generation" not in told
    shown = " ".join(render_status(snapshot_json(snapshot), 160, color=False).split())
    assert "PROBLEMS never initialised: " in shown, "before all that follows from it"
    assert "lost state" not in shown


def test_a_node_that_seems_never_initialised_may_have_lost_its_state_and_hears_how_it_comes_back_first() -> None:
    """A founder's fleet file of the first day names nobody else: `zsched init` would make it a fleet of one."""
    (told,) = build_snapshot(forgotten(), 100.0).problems
    first, _, then = told.partition("If the fleet is new: ")
    assert "what `zsched fleet export` writes on a living node, then `zsched init` here alone" in first
    assert then.startswith("Stop every daemon")


def test_a_fleet_of_which_somebody_remembers_a_state_was_initialised() -> None:
    """A blank state in place of a lost one may vote twice: only a new generation helps."""
    learnt = forgotten()
    learn(learnt, 1, "edge1")
    voted = forgotten()
    voted.agreement.voted.add("robot2")
    newer = forgotten()
    newer.agreement.newest_generation = 1
    for node in (learnt, voted, newer, forgotten(lacks_file=False)):
        problems = build_snapshot(node, 100.0).problems
        assert not any(one.startswith("never initialised") for one in problems), problems
        assert any(one.startswith("nothing can be agreed") for one in problems), problems
        shown = " ".join(render_status(snapshot_json(build_snapshot(node, 100.0)), 160, color=False).split())
        assert "PROBLEMS nothing can be agreed" in shown


def test_where_init_was_only_forgotten_it_comes_before_a_new_generation() -> None:
    node = make("robot1")
    for name in ("robot2", "robot3"):
        beat = beat_of(name, 2, incarnation=3, has_lost_state=True, lacks_state_file=True)
        node.handle(ev.BeatReceived(beat=beat), 100.0)
    assert "Only where it refuses" not in build_snapshot(node, 100.0).problems[-1]
    for name in ("robot2", "robot3"):
        beat = beat_of(name, 900, incarnation=3, has_lost_state=True, lacks_state_file=True)
        node.handle(ev.BeatReceived(beat=beat), LATE)
    told = build_snapshot(node, LATE).problems[-1]
    assert told.startswith(
        "nothing can be agreed: too many electors without their states. No state file on robot2, robot3: "
        "stop zsched there, run `zsched init`"
    )
    assert told.index("zsched init`") < told.index("Only where it refuses") < told.index("--generation 1 --force")


@pytest.mark.parametrize("remembered", ["vote", "generation", "a damaged file"])
def test_where_init_would_be_refused_it_is_not_advised(remembered: str) -> None:
    node = make("robot1")
    for name in ("robot2", "robot3"):
        beat = beat_of(name, 2, incarnation=3, has_lost_state=True, lacks_state_file=remembered != "a damaged file")
        node.handle(ev.BeatReceived(beat=beat), 100.0)
    if remembered == "vote":
        node.agreement.voted.update(("robot2", "robot3"))
    if remembered == "generation":
        node.agreement.newest_generation = 1
    hear_again(node)
    told = build_snapshot(node, LATE).problems[-1]
    assert "(each says why); if these are lost, stop every daemon, run `zsched fleet recover --generation" in told
    assert "No state file" not in told


def test_one_elector_on_which_init_was_forgotten_is_told_with_the_command() -> None:
    node = make("robot1")
    beat = beat_of("robot2", 2, incarnation=3, has_lost_state=True, lacks_state_file=True)
    node.handle(ev.BeatReceived(beat=beat), 100.0)
    assert any(
        one.startswith("no state file on robot2: stop zsched there, run `zsched init`")
        for one in build_snapshot(node, 100.0).problems
    )
    mine = forgotten(stateless=("robot1",))
    assert any(one.startswith("no state file on robot1: ") for one in build_snapshot(mine, 100.0).problems)
    (sent,) = (one.beat for one in mine.handle(ev.DeadlineReached(), 101.0) if isinstance(one, do.PublishBeat))
    assert (sent.has_lost_state, sent.lacks_state_file) == (True, True)
    for well in (make("robot1"), forgotten("edge1", stateless=())):
        (sent,) = (one.beat for one in well.handle(ev.DeadlineReached(), 101.0) if isinstance(one, do.PublishBeat))
        assert (sent.has_lost_state, sent.lacks_state_file) == (False, False), "a node that is no elector needs none"
    node.handle(ev.BeatReceived(beat=beat_of("robot2", 3, incarnation=3)), 100.4)
    assert build_snapshot(node, 100.4).problems == ()


@pytest.mark.parametrize(
    "strange",
    [{"generation": 2}, {"electorate": "0" * 16}, {"generation": 2, "electorate": f"{electorate_hash(FLEET)}/2"}],
    ids=["generation of a peer that tells no electorate", "electorate", "both"],
)
def test_electors_of_another_generation_or_electorate_count_for_nothing(strange: dict[str, Any]) -> None:
    node = make()
    mine = electorate_hash(FLEET)
    apart = replace(beat_of("robot2", 2, incarnation=3), **strange)
    node.handle(ev.BeatReceived(beat=apart), 100.0)
    snapshot = build_snapshot(node, 100.0)
    assert (snapshot.quorum.alive, snapshot.quorum.ok, snapshot.quorum.apart) == (2, True, ("robot2",))
    said = "electors of another generation, or with other electors in their fleet file, 1 of 3: robot2; "
    assert any(one.startswith(said) for one in snapshot.problems), snapshot.problems
    assert any("no elector to spare: 2 of 3 can answer, 2 needed. " in one for one in snapshot.problems)
    assert any(one.endswith("robot2 and this node refuse each other") for one in snapshot.problems)
    node.handle(ev.BeatReceived(beat=replace(apart, node="robot3")), 100.0)
    assert not build_snapshot(node, 100.0).quorum.ok
    for name in ("robot2", "robot3"):
        again = beat_of(name, 3, incarnation=3, electorate=mine)
        node.handle(ev.BeatReceived(beat=again), 100.2)
    assert build_snapshot(node, 100.2).problems == ()


def test_an_elector_that_is_none_by_its_own_file_counts_for_nothing() -> None:
    """Its beat names no electorate at all, and no lost state: it answers every proposer that it is no elector."""
    node = make()
    others = replace(FLEET, electors=("robot1", "robot3"))
    told = Node(
        fleet=others,
        me="robot2",
        durable=None,
        incarnation=3,
        electorate=electorate_hash(others),
        rng=Random(1),
        now=100.0,
    )
    (sent,) = (one.beat for one in told.handle(ev.DeadlineReached(), 101.0) if isinstance(one, do.PublishBeat))
    assert (sent.electorate, sent.has_lost_state) == ("", False)
    node.handle(ev.BeatReceived(beat=replace(sent, sequence=2)), 100.0)
    snapshot = build_snapshot(node, 100.0)
    assert (snapshot.quorum.alive, snapshot.quorum.ok, snapshot.quorum.apart) == (2, True, ("robot2",))
    assert any("1 of 3: robot2; they and this node refuse each other" in one for one in snapshot.problems)
    assert any("no elector to spare: 2 of 3 can answer, 2 needed. " in one for one in snapshot.problems)
    assert any(one.endswith("robot2 and this node refuse each other") for one in snapshot.problems)
    alone = make(alive=())
    alone.handle(ev.BeatReceived(beat=sent), 100.0)
    assert not build_snapshot(alone, 100.0).quorum.ok
    assert any("no quorum: 1 of 3" in one for one in degradations(snapshot_json(build_snapshot(alone, 100.0))))


def test_a_node_of_another_generation_is_told_with_the_command_that_mends_it() -> None:
    node = make()
    node.handle(ev.BeatReceived(beat=beat_of("robot2", 2, incarnation=3, generation=2)), 100.0)
    said = build_snapshot(node, 100.0).problems
    assert any("robot2 is of generation 2, this node of 0" in one for one in said)
    assert not any("init" in one for one in said), "it may be about to be stopped"
    ahead = "stop this daemon, `zsched fleet recover --generation 2` here, start it"
    assert any(one.startswith(ahead) for one in build_snapshot(node, LATE).problems)


@pytest.mark.parametrize("me", ["robot1", "edge1"])
def test_a_tuned_price_is_told_by_nodes_that_judge_nothing_too(me: str) -> None:
    node = make(me)
    value = allocation_of(5, "edge1")
    tuned = replace(value, tuning=replace(value.tuning, price_s=0.9))
    node.handle(ev.LearntReceived(learnt=Learnt(node="robot2", values=(tuned,)), is_answer=True), 100.0)
    assert {one.name: one.tuning.price_s for one in build_snapshot(node, 100.0).tasks}[value.task] == 0.9
    changed = replace(FLEET, tasks=tuple(replace(task, memory_s=30.0) for task in FLEET.tasks))
    node.handle(ev.FleetChanged(fleet=changed), 100.1)
    assert {one.name: one.tuning.price_s for one in build_snapshot(node, 100.1).tasks}[value.task] == 0.9


def test_a_task_tells_whether_its_worker_could_tell_of_jobs() -> None:
    node = make()
    assert {task.tells_no_jobs for task in build_snapshot(node, 100.0).tasks} == {False}
    foreign = replace(FLEET.tasks[0], worker=replace(FLEET.tasks[0].worker, ready_when=ReadyWhen.MATCHING))
    node.handle(ev.FleetChanged(fleet=replace(FLEET, tasks=(foreign, *FLEET.tasks[1:]))), 100.1)
    (first, *others) = snapshot_json(build_snapshot(node, 100.2))["tasks"]
    assert (first["tells_no_jobs"], {task["tells_no_jobs"] for task in others}) == (True, {False})


def test_problems_say_what_is_missing_in_words() -> None:
    node = make(has_state=False, alive=())
    node.handle(ev.ProblemReported(source="profile", problem="no /proc"), 100.0)
    assert build_snapshot(node, 100.0).problems == (
        "profile: no /proc",
        "electors without their state, 1 of 3: robot1",
        "no quorum: 0 of 3 electors can answer, 2 needed; waiting for robot2, robot3",
        "no valid state file: this node is no elector (see `zsched init --help`)",
    )
    assert build_snapshot(make(), 100.0).problems == ()


def test_a_quorum_without_a_margin_is_a_problem_that_names_who_is_missing() -> None:
    (problem,) = build_snapshot(make(alive=("robot2",)), 100.0).problems
    assert problem == (
        "no elector to spare: 2 of 3 can answer, 2 needed. With one more away nothing is decided. "
        "robot3 is not heard yet"
    )
    (_, problem) = build_snapshot(make(has_state=False), 100.0).problems[:2]
    assert problem.endswith("robot1 has no state"), "an elector without its state is none"


def test_an_elector_that_is_missing_is_named_with_what_to_do() -> None:
    never = "robot3 was never heard: start zsched on it, and check its host, port and firewall"
    assert build_snapshot(make(alive=("robot2",)), 110.0).problems[0].endswith(never)
    node = make()
    for tick in range(1, 35):  # a loop that sleeps longer would doubt itself first
        node.handle(ev.DeadlineReached(), 100.0 + tick * 0.04)
    silent = build_snapshot(node, 101.36).problems
    assert "elector robot2 is silent: it is gone soon, or is heard again" in silent
    node.handle(ev.DeadlineReached(), 104.0)
    lost = build_snapshot(node, 104.0).problems
    for name in ("robot2", "robot3"):
        assert f"elector {name} is gone: start zsched on it, or look at its network" in lost


def test_a_node_that_reaches_nobody_says_whom_it_dials_and_what_becomes_of_it() -> None:
    node = make(alive=())
    node.solitude.dialled = ("tcp/nowhere.invalid:47457", "tcp/127.0.0.1:47477")
    assert not any("heard nobody" in one for one in build_snapshot(node, 102.9).problems), "it may still connect"
    asked = [one for one in node.handle(ev.DeadlineReached(), 103.1) if isinstance(one, do.TryAddresses)]
    assert asked == [do.TryAddresses(addresses=node.solitude.dialled)]
    later = (one for now in (104.0, 120.0, 132.0) for one in node.handle(ev.DeadlineReached(), now))
    assert not any(isinstance(one, do.TryAddresses) for one in later), "at most one trial in 30 s"
    both = "tcp/nowhere.invalid:47457, tcp/127.0.0.1:47477"
    check = "Check host, port, firewall, and that every node has the same `fleet:`"
    assert build_snapshot(node, 103.1).problems[0] == f"heard nobody since the start: dialled {both}. {check}"
    many = tuple(f"tcp/192.0.2.{number}:7457" for number in range(10))
    assert "tcp/192.0.2.7:7457, 2 more. Check" in replace(node.solitude, dialled=many).problem()
    found = (("tcp/nowhere.invalid:47457", "name unknown"), ("tcp/127.0.0.1:47477", "refused"))
    node.handle(ev.AddressesTried(found=found), 104.0)
    told = build_snapshot(node, 104.0).problems
    assert told[0] == (
        "heard nobody since the start: dialled tcp/nowhere.invalid:47457 (name unknown), "
        "tcp/127.0.0.1:47477 (refused). " + check
    )
    assert not any(one.startswith("elector") for one in told), "one cause, one line"
    node.handle(ev.BeatReceived(beat=beat_of("edge1", incarnation=3)), 140.0)
    assert not any("heard nobody" in one for one in build_snapshot(node, 140.0).problems)
    after = (one for now in (170.0, 201.0) for one in node.handle(ev.DeadlineReached(), now))
    assert not any(isinstance(one, do.TryAddresses) for one in after), "it has heard somebody once"


def test_a_node_that_others_do_not_let_in_is_told_that_its_certificate_may_be_old() -> None:
    """An earlier invitation's key is refused in silence: the address takes connections, and nobody is heard."""
    node = make(alive=())
    node.solitude.dialled = ("tls/192.0.2.1:7457", "tls/192.0.2.2:7457")
    node.handle(ev.AddressesTried(found=((node.solitude.dialled[0], TAKEN),)), 110.0)
    invite = "On a node of the fleet `zsched invite robot1`, then stop this daemon and `zsched join` here"
    assert not any(invite in one for one in build_snapshot(node, 110.0).problems), "nobody needs a certificate"
    node.in_force.take(replace(node.fleet, security=Security(folder="/pki")))
    assert invite in build_snapshot(node, 110.0).problems[0]
    node.set_problem(Problem.CERTIFICATE, "it has not begun: set the clock")
    told = build_snapshot(node, 110.0).problems
    assert "certificate: it has not begun: set the clock" in told
    assert not any(invite in one for one in told), "that would revoke a good key"
    node.set_problem(Problem.CERTIFICATE, None)
    node.handle(ev.AddressesTried(found=((node.solitude.dialled[0], "refused"),)), 110.0)
    assert not any(invite in one for one in build_snapshot(node, 110.0).problems), "nobody is there at all"


@pytest.mark.parametrize(
    ("dialled_at", "way"),
    [
        (
            "tcp/192.0.2.1:7447",
            "no other node has come since the start: they dial this one at tcp/192.0.2.1:7447 once ",
        ),
        ("", "heard nobody since the start: this node dials nobody, nobody has an address to dial. "),
    ],
)
def test_a_node_that_dials_nobody_says_where_it_is_dialled(dialled_at: str, way: str) -> None:
    node = make(alive=())
    node.solitude.dialled_at = dialled_at
    (told, *_) = build_snapshot(node, 110.0).problems
    assert told.startswith(way)
    assert not any(isinstance(one, do.TryAddresses) for one in node.handle(ev.DeadlineReached(), 110.0))


def test_robots_that_cannot_make_a_majority_are_a_problem_while_electors_can() -> None:
    """The electors agree on an escape then, but no ordinary vote is won."""
    node = make(alive=())
    node.in_force.take(replace(node.fleet, electors=("robot1",)))
    (problem,) = build_snapshot(node, 100.0).problems
    assert problem == (
        "no planned moves: 1 of 3 robots can vote, 2 needed; not robot2 (not heard yet), robot3 (not heard "
        "yet). An owner that is gone, stops or fails is still replaced"
    )
    with patch.object(Agreement, "document_hash", "0d"):
        (problem,) = build_snapshot(node, 100.0).problems
    assert problem.endswith("is still replaced; one that was never heard, once they are away for 60 s")
    node.handle(ev.BeatReceived(beat=beat_of("robot2", incarnation=3)), 100.0)
    assert build_snapshot(node, 100.0).problems == ()


def test_a_fleet_without_robots_says_that_nobody_votes() -> None:
    edges = fleet_of(*FLEET.tasks, of=EDGES, electors=EDGES[:1])
    hashed = electorate_hash(edges)
    node = Node(
        fleet=edges,
        me="edge1",
        durable=state_of("edge1", electorate=hashed),
        incarnation=7,
        electorate=hashed,
        rng=Random(1),
        now=100.0,
        startup=Startup(version="1.2.3"),
    )
    assert build_snapshot(node, 100.0).problems == (
        "nobody votes: the fleet has no robot, so no task gets an owner; `zsched invite` brings one",
    )


def test_a_worker_that_failed_or_is_missed_is_told_with_its_reason() -> None:
    node = make()
    for name in EDGES:
        node.handle(ev.BeatReceived(beat=beat_of(name, incarnation=3)), 100.0)
    learn(node, 1, "edge1")
    for name, state, reason in (
        ("edge1", WorkerState.STOPPED, "nobody subscribes to a/key"),
        ("edge2", WorkerState.FAILED, "exited with status 1: no such map"),
    ):
        profile = profile_of(name, incarnation=3, memory_used_mb=100.0, workers=(load_of(state=state, reason=reason),))
        node.handle(ev.ProfileReceived(profile=profile), 100.0)
    assert build_snapshot(node, 100.0).tasks[0].problems == (
        "the worker on edge1 is stopped: nobody subscribes to a/key",
        "the worker on edge2 failed: exited with status 1: no such map; mend it, then `zsched restart merge edge2`",
    )


def test_a_task_without_an_owner_says_which_workers_somebody_else_has_to_start() -> None:
    node = make()
    node.handle(ev.BeatReceived(beat=beat_of("edge1", incarnation=3)), 100.0)
    told_by(node, "edge1", 1, WorkerState.STOPPED, "no token")
    assert build_snapshot(node, 100.0).tasks[0].problems == (), "our own standby, which a move starts"
    node.in_force.take(replace(FLEET, tasks=tuple(replace(task, worker=WorkerSpec()) for task in FLEET.tasks)))
    assert build_snapshot(node, 100.0).tasks[0].problems == ("the worker on edge1 is stopped: no token",)


def served(edges: tuple[str, ...] = EDGES, worker: WorkerSpec = FLEET.tasks[0].worker) -> Node:
    """A fleet whose task edge1 serves, and in which these edges live; the other workers are to be told."""
    task = task_of(candidates=edges, worker=worker)
    fleet = fleet_of(task, of=sorted((*ROBOTS, *edges)), electors=ROBOTS)
    node = make(alive=(*ROBOTS, *edges), fleet=fleet)
    learn(node, 1, "edge1")
    told_by(node, "edge1", 1, WorkerState.READY)
    return node


def problems_of(node: Node) -> tuple[str, ...]:
    return build_snapshot(node, 100.0).tasks[0].problems


@pytest.mark.parametrize(
    ("command", "state", "reason", "trouble"),
    [
        ((), WorkerState.STOPPED, "no token", Trouble.NONE),
        ((), WorkerState.STOPPED, "was ready until 12:00:00 UTC: it has ended, hangs or is frozen", Trouble.LOST),
        (("work",), WorkerState.STARTING, "was ready until 12:00:00 UTC, its token went: it may hang", Trouble.LOST),
        (("work",), WorkerState.STARTING, "restarting (failure 1 of 3): killed by signal 9", Trouble.AGAIN),
        (("work",), WorkerState.STOPPED, "restarting (failure 1 of 3): killed by signal 9", Trouble.AGAIN),
    ],
    ids=["missed", "missed again", "hangs", "restarts", "waits for its restart"],
)
def test_a_standby_that_is_away_is_told_of_although_the_task_is_served(
    command: tuple[str, ...], state: WorkerState, reason: str, trouble: Trouble
) -> None:
    node = served((*EDGES, "edge3"), WorkerSpec(command=command))
    told_by(node, "edge3", 1, WorkerState.READY)
    told_by(node, "edge2", 1, WorkerState.READY)
    assert problems_of(node) == ()
    told_by(node, "edge2", 2, state, reason, trouble)
    away = f"the worker on edge2 {told_of_worker(state, trouble, reason)}"
    assert problems_of(node) == (away,), "edge3 could take it"
    told_by(node, "edge3", 2, state, reason, trouble)
    assert problems_of(node) == (away, away.replace("edge2", "edge3"), "no other candidate can take it")
    assert not degradations(snapshot_json(build_snapshot(node, 100.0))), "it is served"


def test_a_task_that_no_other_candidate_could_take_now_says_why() -> None:
    node = served((*EDGES, "edge3"))
    assert problems_of(node) == (), "nothing is known of the others yet"
    told_by(node, "edge2", 1, WorkerState.STARTING, "pid 7")
    assert problems_of(node) == ("no other candidate can take it: the worker on edge2 is starting: pid 7",)
    told_by(node, "edge3", 1, WorkerState.FAILED, "no map")
    failed = "the worker on edge3 failed: no map; mend it, then `zsched restart merge edge3`"
    assert problems_of(node) == (failed, "no other candidate can take it: the worker on edge2 is starting: pid 7")
    told_by(node, "edge2", 2, WorkerState.READY)
    assert problems_of(node) == (failed,)
    node.handle(ev.ProfileReceived(profile=profile_of("edge2", incarnation=3, sequence=3)), 100.0)
    assert problems_of(node) == (failed, "no other candidate can take it: edge2 runs no worker for it")
    told_by(node, "edge1", 2, WorkerState.STARTING)
    assert problems_of(node) == ("the worker on edge1 is starting", failed), "it is not served: that is said first"


def test_which_problem_it_is_is_told_beside_the_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(status, "NO_SPARE", "nobody else is left")
    node = served((*EDGES, "edge3"))
    node.set_problem("measuring", "nothing is measured")
    told_by(node, "edge2", 1, WorkerState.STARTING)
    told_by(node, "edge3", 1, WorkerState.FAILED, "no map")
    snapshot = build_snapshot(node, 100.0)
    (task,) = snapshot.tasks
    assert task.problem_kinds == (Problem.WORKER_FAILED, Problem.NO_SPARE)
    assert task.problems[1].startswith("nobody else is left: ")
    assert [
        text for text, kind in zip(snapshot.problems, snapshot.problem_kinds, strict=True) if kind == "measuring"
    ] == ["measuring: nothing is measured"]


def holding(node: Node, name: str, at: float, *, used_mb: float, own_mb: float = 0.0, battery: float = 1.0) -> None:
    """A node of 4000 MiB whose worker is ready."""
    worker = load_of(memory_mb=own_mb, cpu_cores=0.1)
    profile = profile_of(
        name,
        incarnation=3,
        sequence=round(at),
        memory_used_mb=used_mb,
        workers=(worker,),
        gauges=(("battery", battery),),
    )
    node.handle(ev.ProfileReceived(profile=profile), at)


def lacking(now: float = 100.0, **machines: dict[str, float]) -> tuple[str, ...]:
    """Problems of a task that needs 500 MiB and a battery above 20 %, and that edge1 serves or has served."""
    task = task_of(candidates=EDGES, demand=Demand(memory_mb=500.0), gauge_limits=(("battery", 0.2),))
    node = make(alive=(*ROBOTS, *EDGES), fleet=fleet_of(task, of=sorted((*ROBOTS, *EDGES)), electors=ROBOTS))
    learn(node, 1, "edge1")
    holding(node, "edge1", 100.0, used_mb=3500.0, own_mb=2500.0)
    for at in (100.0 + s for s in range(round(now) - 99)):
        for name in ("edge2", "robot2", "robot3"):
            node.handle(ev.BeatReceived(beat=beat_of(name, round(at), incarnation=3)), at)
        for name, figures in machines.items():
            holding(node, name, at, **figures)
        node.handle(ev.DeadlineReached(), at)
    return tuple(one for one in build_snapshot(node, now).tasks[0].problems if "no other candidate" in one)


def test_a_task_that_no_other_machine_has_room_for_says_what_it_lacks() -> None:
    assert lacking(edge2={"used_mb": 3400.0}) == (), "what the worker has come to use counts only while it has an owner"
    needs = "no other candidate can take it: edge2 needs 500 MiB, has 400 free"
    assert lacking(edge2={"used_mb": 3600.0}) == (needs,)
    assert lacking(103.0, edge2={"used_mb": 3600.0}) == (needs,), "its owner is silent: then it says why nobody has it"
    low = "no other candidate can take it: on edge2 battery is at 18 %, limit 20 %"
    assert lacking(edge2={"used_mb": 500.0, "battery": 0.18}) == (low,)
    assert lacking(edge2={"used_mb": 500.0, "battery": 0.21}) == (), "the margin is for whoever could stay"


def test_a_task_that_misses_its_deadline_most_of_the_time_is_a_problem() -> None:
    for late_ratio, count in ((None, 0), (0.49, 0), (0.5, 1)):
        node = served()
        told_by(node, "edge2", 1, WorkerState.READY, jobs=Jobs(time_s=0.3, cpu_s=0.1, late_ratio=1.0))
        told_by(node, "edge1", 2, WorkerState.READY, jobs=Jobs(time_s=0.3, cpu_s=0.1, late_ratio=late_ratio))
        assert len(problems_of(node)) == count
    said = "the worker on edge1 ends 50 % of its jobs later than the deadline; `zsched explain merge` tells what each "
    assert problems_of(node) == (f"{said}machine is worth",)


def test_a_standby_that_a_move_starts_is_ready_enough() -> None:
    node = served(worker=WorkerSpec(command=("work",), standby=Standby.COLD))
    for sequence, reason in enumerate(("", "stopped by SIGINT"), 1):
        told_by(node, "edge2", sequence, WorkerState.STOPPED, reason)
        assert problems_of(node) == (), "as after every move away from there"


def test_candidates_that_are_away_or_closed_on_purpose_are_no_trouble() -> None:
    lone = served(("edge1",))
    assert problems_of(lone) == (), "that nobody else can have it says the fleet file"
    gone = served()
    told_by(gone, "edge2", 1, WorkerState.STARTING)
    assert problems_of(gone)
    for now in (101.0, 103.0):
        gone.handle(ev.BeatReceived(beat=beat_of("edge1", 2, incarnation=3)), now)
        gone.handle(ev.DeadlineReached(), now)
    assert gone.membership.states()["edge2"] is not PeerState.ALIVE
    assert not any("edge2" in one or "no other" in one for one in build_snapshot(gone, 103.0).tasks[0].problems)
    for kind in FlagKind:
        closed = served(worker=WorkerSpec())
        told_by(closed, "edge2", 1, WorkerState.STOPPED, "no token")
        assert len(problems_of(closed)) == 2
        closed.flags.take((Flag(kind=kind, subject="edge2", by="ada@robot1"),), 100.0)
        assert problems_of(closed) == (), kind
    stopping = served(worker=WorkerSpec())
    load = load_of(state=WorkerState.STOPPED, reason="no token")
    profile = profile_of("edge2", incarnation=3, workers=(load,), draining=True)
    stopping.handle(ev.ProfileReceived(profile=profile), 100.0)
    assert problems_of(stopping) == ()


def test_an_owner_s_worker_that_was_ready_is_not_said_to_be_starting() -> None:
    node = make()
    node.handle(ev.BeatReceived(beat=beat_of("edge1", incarnation=3)), 100.0)
    learn(node, 1, "edge1")
    reason = "was ready until 12:00:00 UTC, its token went: it may hang"
    told_by(node, "edge1", 1, WorkerState.STARTING, reason, Trouble.LOST)
    said = f"the worker on edge1 {reason}"
    snapshot = build_snapshot(node, 100.0)
    assert said in snapshot.tasks[0].problems
    assert any(said in reason for reason in degradations(snapshot_json(snapshot)))


def test_a_slot_that_somebody_else_s_worker_does_not_take_is_told_with_what_mends_it() -> None:
    """It was started on a session that did not know this robot yet."""
    node = make()
    node.in_force.take(replace(FLEET, tasks=tuple(replace(task, worker=WorkerSpec()) for task in FLEET.tasks)))
    learn(node, 1, "edge1")
    (waits,) = build_snapshot(node, 103.0).tasks[0].problems
    assert "must start it again" in waits
    assert "the session edge1-merge.zenoh.json5" in waits


def told_by(
    node: Node,
    name: str,
    sequence: int,
    state: WorkerState,
    reason: str = "",
    trouble: Trouble = Trouble.NONE,
    jobs: Jobs | None = None,
    unended_s: float | None = None,
) -> None:
    """A node's profile says how its worker is."""
    load = load_of(state=state, trouble=trouble, reason=reason, jobs=jobs, unended_s=unended_s)
    profile = profile_of(name, incarnation=3, sequence=sequence, memory_used_mb=100.0, workers=(load,))
    node.handle(ev.ProfileReceived(profile=profile), 100.0)


@pytest.mark.parametrize(
    ("used_cores", "done_hz", "is_told"), [(4.0, 5.0, True), (4.0, 10.0, False), (2.0, 5.0, False), (None, 5.0, False)]
)
def test_a_machine_without_free_cpu_whose_task_gets_too_little_is_a_problem(
    used_cores: float | None, done_hz: float, *, is_told: bool
) -> None:
    node = served()
    load = load_of(state=WorkerState.READY, jobs=Jobs(time_s=0.1, cpu_s=0.1, wanted_hz=10.0, done_hz=done_hz))
    profile = profile_of("edge1", incarnation=3, sequence=2, cpu_cores=4.0, cpu_used_cores=used_cores, workers=(load,))
    node.handle(ev.ProfileReceived(profile=profile), 100.0)
    said = "edge1 is overloaded: 4 of 4 cores are in use, too little is left for merge"
    assert (said in build_snapshot(node, 100.0).problems) is is_told


@pytest.mark.parametrize(
    ("unended_s", "jobs", "told"),
    [
        (12.0, Jobs(time_s=0.01, cpu_s=0.01, backlog=86), "12 s and finished no job, and 86 wait: it may hang"),
        (12.0, Jobs(time_s=0.01, cpu_s=0.01), "12 s and finished no job: it may hang"),
        (None, Jobs(time_s=0.01, cpu_s=0.01, backlog=86), None),  # behind, and at work
        (33.0, Jobs(time_s=2.0, cpu_s=0.01, backlog=86), "33 s and finished no job, and 86 wait"),
        (31.0, Jobs(time_s=2.0, cpu_s=0.01, backlog=86), None),  # not many times as long as a job takes
        (29.0, None, None),  # its first job
        (31.0, None, "31 s and finished no job: it may hang"),
    ],
)
def test_an_owner_that_has_work_and_ends_no_job_is_a_problem(
    unended_s: float | None, jobs: Jobs | None, told: str | None
) -> None:
    """Its token is there and samples flow in: without this line all would look well."""
    node = make()
    node.handle(ev.BeatReceived(beat=beat_of("edge1", incarnation=3)), 100.0)
    learn(node, 1, "edge1")
    told_by(node, "edge1", 1, WorkerState.READY, jobs=jobs, unended_s=unended_s)
    problems = [one for one in build_snapshot(node, 101.0).tasks[0].problems if "finished no job" in one]
    assert len(problems) == (told is not None)
    assert all(f"has had work for {told}" in one for one in problems)
    assert all(one.endswith("`zsched restart merge` starts it anew") for one in problems)
    node.in_force.take(replace(FLEET, tasks=tuple(replace(task, worker=WorkerSpec()) for task in FLEET.tasks)))
    problems = [one for one in build_snapshot(node, 101.0).tasks[0].problems if "finished no job" in one]
    assert len(problems) == (told is not None)
    assert all(one.endswith("in a callback; start it again there") for one in problems), "it is somebody else's"


def test_a_hang_is_told_beside_another_complaint_of_the_worker() -> None:
    """Such a complaint stays for the worker's life, and hid it."""
    node = make()
    node.handle(ev.BeatReceived(beat=beat_of("edge1", incarnation=3)), 100.0)
    learn(node, 1, "edge1")
    told_by(node, "edge1", 1, WorkerState.READY, reason="puts on debug, which no output rule takes", unended_s=31.0)
    told = "\n".join(build_snapshot(node, 101.0).tasks[0].problems)
    assert "the worker on edge1: puts on debug, which no output rule takes" in told
    assert "has had work for 31 s and finished no job" in told


def test_a_slot_that_is_not_taken_is_told_of_only_once_the_owner_s_own_worker_is_ready() -> None:
    """Else the worker is what is told of; another node's worker excuses nothing."""
    node = make()
    for name in EDGES:
        node.handle(ev.BeatReceived(beat=beat_of(name, incarnation=3)), 100.0)
    learn(node, 1, "edge1")
    told_by(node, "edge1", 1, WorkerState.READY)
    told_by(node, "edge2", 1, WorkerState.STARTING)
    (no_spare, waits) = build_snapshot(node, 103.0).tasks[0].problems
    assert no_spare == "no other candidate can take it: the worker on edge2 is starting"
    assert waits.startswith("this robot's streams have waited for edge1 for 3 s")
    told_by(node, "edge1", 2, WorkerState.STARTING)
    told_by(node, "edge2", 2, WorkerState.READY)
    assert build_snapshot(node, 103.0).tasks[0].problems == ("the worker on edge1 is starting",)


LOOK = ": `zsched ping edge1` tells whether its data session answers here"
"""A closed port of its data session is the usual reason: its daemon is heard, and calls its worker ready."""


def test_a_slot_whose_worker_is_not_seen_is_a_problem_until_it_is() -> None:
    node = make()
    learn(node, 1, "edge1")
    assert build_snapshot(node, 101.0).tasks[0].problems == ()
    waits = f"our relay does not see its worker's token, or its subscriptions{LOOK}"
    assert len(build_snapshot(node, 102.0).tasks[0].problems) == 1
    assert build_snapshot(node, 103.0).tasks[0].problems == (
        f"this robot's streams have waited for edge1 for 3 s: {waits}",
    )
    node.handle(ev.SlotReady(task="merge", epoch=1), 103.0)
    node.handle(ev.SlotFlipped(task="merge", epoch=1), 103.0)
    assert build_snapshot(node, 110.0).tasks[0].problems == ()
    node.handle(ev.SlotReady(task="merge", epoch=1, is_ready=False), 110.0)
    assert build_snapshot(node, 114.0).tasks[0].problems == (
        f"this robot's streams have waited for edge1 for 4 s: {waits}",
    )
    node.handle(ev.SlotReady(task="merge", epoch=1), 114.0)
    assert build_snapshot(node, 120.0).tasks[0].problems == ()


def test_who_works_alone_waits_for_its_own_worker_and_only_since_then() -> None:
    node = make()
    learn(node, 1, "edge1")
    executor = node.executors["merge"]
    executor.spec = replace(executor.spec, on_isolation=OnIsolation.LOCAL)
    executor.on_ready(1, ToDo())
    executor.on_flipped(1, 0, ToDo(), 100.5)
    executor.isolate(ToDo(), 86400.0)
    alone = "cut off from edge1: this robot works alone, degraded"
    assert build_snapshot(node, 86401.0).tasks[0].problems == (alone,)
    waits = f"our relay does not see its worker's token, or its subscriptions{LOOK.replace('edge1', 'robot1')}"
    assert build_snapshot(node, 86403.0).tasks[0].problems == (
        alone,
        f"this robot's streams have waited for robot1 for 3 s: {waits}",
    )
    own = profile_of("robot1", sequence=1, workers=(load_of(state=WorkerState.STARTING),))
    node.gateway.absorb(own, 86403.0)
    assert build_snapshot(node, 86403.0).tasks[0].problems == (alone, "the worker on robot1 is starting")


def test_a_ready_worker_that_our_relay_does_not_see_is_told_although_it_owns_nothing() -> None:
    """edge2's data port is shut: beats and profiles come, and no token."""
    node = make()
    learn(node, 1, "edge1")
    node.handle(ev.SlotReady(task="merge", epoch=1), 100.0)
    node.handle(ev.SlotFlipped(task="merge", epoch=1), 100.0)
    node.handle(ev.WorkerShown(node="edge1", task="merge", incarnation="1"), 100.0)
    told = (
        "the worker on edge2 is ready, and our relay does not see its token: edge2 gets nothing for this robot; "
        "`zsched ping edge2` tells whether its data session answers here"
    )

    def problems(since: int, until: int) -> tuple[str, ...]:
        for now in range(since, until):
            for name in EDGES:
                node.handle(ev.BeatReceived(beat=beat_of(name, incarnation=3, sequence=now)), float(now))
                workers = (load_of(state=WorkerState.READY),)
                profile = profile_of(name, incarnation=3, sequence=now, memory_used_mb=100.0, workers=workers)
                node.handle(ev.ProfileReceived(profile=profile), float(now))
        return build_snapshot(node, float(until)).tasks[0].problems

    assert problems(101, 109) == ()
    assert problems(109, 115) == (told,)
    node.handle(ev.WorkerShown(node="edge2", task="merge", incarnation="1"), 115.0)
    assert problems(115, 118) == ()
    node.handle(ev.WorkerShown(node="edge1", task="merge", incarnation="1", is_present=False), 118.0)
    node.handle(ev.SlotReady(task="merge", epoch=1, is_ready=False, has_token=False), 118.0)
    (of_owner,) = problems(118, 128)
    assert of_owner == (
        f"this robot's streams have waited for edge1 for 10 s: our relay does not see its worker's token{LOOK}"
    ), "the owner's is told once, by the wait"


def test_a_worker_that_shows_itself_before_we_have_its_document_is_seen_once_we_have() -> None:
    """edge1 has adopted the document with a new task before this robot."""
    node = make()
    node.handle(ev.WorkerShown(node="edge1", task="new", incarnation="1"), 100.0)
    node.handle(ev.WorkerShown(node="edge9", task="merge", incarnation="1"), 100.0)
    node.in_force.take(node.fleet)
    assert node.probation.sees("edge1", "new")
    assert node.probation.sees("edge9", "merge")
    node.handle(ev.WorkerShown(node="edge1", task="new", incarnation="1", is_present=False), 101.0)
    assert not node.probation.sees("edge1", "new")


def lack_of(node: Node, lack: ev.SlotReady) -> str:
    """The words that follow "have waited for edge1 for 3 s"."""
    node.handle(lack, 101.0)
    (told,) = build_snapshot(node, 103.0).tasks[0].problems
    start = "this robot's streams have waited for edge1 for 3 s: "
    assert told.startswith(start)
    return told.removeprefix(start)


def test_a_key_that_nobody_subscribes_to_is_named_with_what_to_do() -> None:
    node = make()
    learn(node, 1, "edge1")
    keys = ("edge1/wrongkey/robot1/question", "edge1/t/robot1/map")
    told = lack_of(node, ev.SlotReady(task="merge", epoch=1, is_ready=False, has_token=True, untaken=keys))
    assert "nobody subscribes to edge1/wrongkey/robot1/question, edge1/t/robot1/map" in told
    assert "`Worker.subscribe`" in told
    assert "token" not in told, "it is there"
    told = lack_of(node, ev.SlotReady(task="merge", epoch=1, is_ready=False, has_token=False, untaken=keys))
    assert told == f"our relay does not see its worker's token{LOOK}"
    told = lack_of(node, ev.SlotReady(task="merge", epoch=0, is_ready=False, has_token=True, untaken=keys))
    assert told == f"our relay does not see its worker's token, or its subscriptions{LOOK}", "that was another slot"
    told = lack_of(node, ev.SlotReady(task="merge", epoch=1, is_ready=False, has_token=True))
    assert told == "our relay has just seen its worker's subscriptions"
    node.handle(ev.SlotReady(task="merge", epoch=1), 104.0)
    assert build_snapshot(node, 110.0).tasks[0].problems == ()


def test_a_stream_grows_older_while_the_relay_tells_nothing() -> None:
    """It stood at a tenth of a second for good: the one fault for which somebody looks at it."""
    node = make()
    told = StreamCount(stream="merge/out/0", messages=7, last_seen_s=0.1, answer_s=0.2, paired_hz=5.0)
    node.handle(ev.StreamsCounted(counts=(told, StreamCount(stream="merge/in/0"))), 100.0)

    def seen(now: float) -> tuple[float | None, float | None, float | None]:
        count, never = build_snapshot(node, now).tasks[0].streams
        assert never.last_seen_s is None
        last_s = None if count.last_seen_s is None else round(count.last_seen_s, 6)
        return last_s, count.answer_s, count.paired_hz

    assert seen(101.0) == (1.1, 0.2, 5.0)
    assert seen(160.0) == (60.1, None, None)


def test_a_node_tells_how_long_it_waits_for_the_end_of_an_order() -> None:
    node = make()
    assert build_snapshot(node, 100.0).order_s == node.fleet.timing.order_s > 0.0


def test_drops_have_an_age_and_an_input_its_way_in() -> None:
    node = make()
    node.startup = Startup(joins_at=("tcp/127.0.0.1:7458",))
    for now, dropped in ((100.0, 3), (110.0, 3), (120.0, 4), (190.0, 4)):
        count = StreamCount(stream="merge/in/0", drops=(("overflow", dropped),))
        once = StreamCount(stream="merge/in/2", drops=(("no_route", 1),))
        node.handle(ev.StreamsCounted(counts=(count, StreamCount(stream="merge/in/1"), once)), now)
    snapshot = build_snapshot(node, 190.0)
    assert [count.dropped_s for count in snapshot.tasks[0].streams] == [70.0, None, None], (
        "what it began with is older than this daemon"
    )
    text = render_status(snapshot_json(snapshot), 100, color=False)
    assert "dropped 4 overflow (none in the last minute, last 1m" in text
    assert "dropped 1 no_route (none since the daemon's start)" in text
    assert "applications here join at tcp/127.0.0.1:7458 (mode client)" in text
    node.handle(ev.StreamsCounted(counts=(StreamCount(stream="merge/in/0", drops=(("overflow", 5),)),)), 191.0)
    assert "(none in" not in render_status(snapshot_json(build_snapshot(node, 191.0)), 100, color=False)
    node.handle(ev.StreamsCounted(counts=(StreamCount(stream="merge/in/0"),)), 192.0)
    (count,) = build_snapshot(node, 193.0).tasks[0].streams
    assert count.dropped_s is None, "another relay counts, and has dropped nothing"


# --- tasks -----------------------------------------------------------------------------------------------------------


def test_task_shows_its_owner_how_it_is_seen_since_when_and_the_handover() -> None:
    node = make()
    learn(node, 3, "edge2", 100.0)
    task = build_snapshot(node, 101.5).tasks[0]
    assert (task.owner, task.owner_state, task.since_s, task.phase) == ("edge2", "unknown", 1.5, "preparing")
    assert [(past.revision, past.owner, past.age_s, past.reason) for past in task.history] == [
        (3, "edge2", 1.5, "known from a peer, the first news here")
    ]


def test_history_is_bounded() -> None:
    node = make()
    for revision in range(1, 101):
        learn(node, revision, "edge1")
    history = build_snapshot(node, 100.0).tasks[0].history
    assert len(history) <= 32
    assert history[-1].revision == 100


# --- nodes -----------------------------------------------------------------------------------------------------------


def test_a_command_is_told_with_the_name_of_its_certificate() -> None:
    node = make()
    for task in ("merge", ""):
        batch = node.handle(ev.Commanded(by="ana.operator", what="TuneTask", task=task), 100.0)
        stories = [one for one in batch if isinstance(one, RecordStory)]
        assert [(one.text, one.task) for one in stories] == [("TuneTask came, signed by ana.operator", task)]


# --- the JSON --------------------------------------------------------------------------------------------------------


def full() -> Snapshot:
    """A robot in a running fleet, with every part of the status there."""
    sim = Simulator(fleet=FLEET, seed=1)
    sim.start()
    assert sim.run_until(lambda: all(sim.agreed(task.name) for task in FLEET.tasks), 10)
    sim.run(2.0)
    node = sim.node("robot1")
    count = StreamCount(stream="merge/in/0", messages=1, bytes=2, drops=(("loop", 1),), last_seen_s=0.1)
    node.handle(ev.StreamsCounted(counts=(count,)), sim.now)
    load = load_of(cpu_cores=0.1, memory_mb=10.0)
    device = DeviceSample(cpu_cores=4, cpu_used_cores=1, memory_mb=4000, memory_used_mb=100, workers=(load,))
    link = LinkSample(source=LinkSource.WIRELESS, rssi_dbm=-50.0)
    node.handle(ev.ProfileSampled(device=device, links=(link,)), sim.now + 2)
    return build_snapshot(node, sim.now + 2)


def keys(value: Any, path: str = "") -> set[str]:
    """The paths of all keys; what a node, a task or a counter is called counts as ``*``."""
    if isinstance(value, list):
        return {found for item in value for found in keys(item, f"{path}[]")}
    if not isinstance(value, dict):
        return set()
    found = set()
    for name, item in value.items():
        is_name = path in {"counters", "tasks[].streams[].drops"} or name in (*ROBOTS, *EDGES)
        here = f"{path}.{'*' if is_name else name}".lstrip(".")
        found |= {here} | keys(item, here)
    return found


GOLDEN = {
    "": "schema version fleet node kind incarnation up_s loop_lag_s quorum nodes tasks counters problems",
    "counters": "*",
    "quorum": "electors needed alive ok this_node",
    "nodes[]": "name kind state age_s incarnation cpu_cores cpu_used_cores cpu_ratio memory_mb memory_used_mb "
    "memory_ratio links workers draining",
    "nodes[].links[]": "source peer rssi_dbm bitrate_mbps retry_ratio",
    "nodes[].workers[]": "task state cpu_cores memory_mb",
    "tasks[]": "name owner epoch revision since_s owner_state phase tuning candidates decision vote streams history "
    "problems",
    "tasks[].tuning": "weights bonus",
    "tasks[].tuning.weights": "cpu memory network",
    "tasks[].decision": "outcome winner reason age_s aggregates utilities vetoed silent",
    "tasks[].decision.aggregates": "*",
    "tasks[].decision.utilities": "*",
    "tasks[].decision.utilities.*": "*",
    "tasks[].decision.utilities.*.*": "value cpu memory network reachable",
    "tasks[].vote": "base_revision votes outcome winner age_s",
    "tasks[].vote.votes": "*",
    "tasks[].streams[]": "stream messages bytes drops last_seen_s",
    "tasks[].streams[].drops": "*",
    "tasks[].history[]": "epoch revision owner age_s reason",
}


def test_keys_of_the_json_only_grow_within_a_version() -> None:
    """Who reads version 1 finds every key that has ever been released; new ones are welcome."""
    assert SCHEMA == "zsched.status/1"
    body = snapshot_json(full())
    body["counters"]["profile_stale"] = 1
    expected = {f"{path}.{name}".lstrip(".") for path, names in GOLDEN.items() for name in names.split()}
    assert expected - keys(body) == set()
