"""Two fleet files become a list of changes in the file's words, each with what follows from it."""

from __future__ import annotations

from dataclasses import fields, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

import pytest

from zsched.config.difference import Change, Danger, Effect, difference, wanted_electors, warnings_in_force
from zsched.config.editing import add_entries
from zsched.config.load import check_bytes
from zsched.core.values.fleet import Cell, Fleet, LinkSpec, LocalSide, NodeSpec, TaskSpec
from zsched.core.values.model import NodeKind, Weights
from zsched.core.values.profile import LinkSource
from zsched.host.workers.comparison import lacking
from zsched.link.sessions.config import worker_config
from zsched.link.sessions.restarts import opens_anew, restarts

TEXT = (Path(__file__).parents[3] / "configs" / "fleet.yaml").read_text()
RULES = "tasks.map_merge.scheduling"
EXCLUSIVE = """\
  pick:
    candidates: [edge1, edge2]
    weights: {cpu: 1}
    worker: {command: [python, pick.py]}
    exclusive: true
"""


def fleet_of(text: str) -> Fleet:
    result = check_bytes(text.encode())
    assert result.fleet is not None, result.report()
    return result.fleet


def told(new: str, old: str = TEXT, **owners: str) -> list[tuple[str, str | None, str | None, str]]:
    return [(one.path, one.before, one.after, one.consequence) for one in changes(new, old, **owners)]


def changes(new: str, old: str = TEXT, **owners: str) -> tuple[Change, ...]:
    return difference(fleet_of(old), fleet_of(new), (old, new), owners)


def with_(old: str, new: str, text: str = TEXT) -> str:
    assert old in text
    return text.replace(old, new, 1)


def test_what_follows_from_another_place_is_a_change_of_its_own() -> None:
    """A third edge is a candidate of a task that takes every edge; no line of the task says so."""
    text = with_("  robot3:", "  edge3: {kind: edge}\n  robot3:")
    assert ("tasks.map_merge.candidates", "edge1, edge2", "edge1, edge2, edge3", "takes effect at once") in told(text)


def test_an_owner_to_which_the_task_is_pinned_hard_keeps_it() -> None:
    """`apply` said that its streams move, and nothing did."""
    text = with_("candidates: {kind: edge}", "candidates: [edge2]")
    texts = (TEXT, text)
    (found,) = difference(fleet_of(TEXT), fleet_of(text), texts, {"map_merge": "edge1"}, bound={"map_merge"})
    stays = "map_merge stays on edge1, where it is pinned hard, until `zsched unpin map_merge`"
    assert found.consequence == stays
    (found,) = difference(fleet_of(TEXT), fleet_of(text), texts, {"map_merge": "edge2"}, bound={"map_merge"})
    assert found.consequence == "takes effect at once"


def test_a_rule_that_comes_goes_or_differs_names_its_streams() -> None:
    line = '      - {from: "{target}/map_merge/{epoch}/tf", to: "{robot}/map_merge/tf", class: latest}\n'
    gone = with_(line, "")
    workers = "workers of map_merge restart one after another"
    ends = f"{workers}; the streams map_merge/out/2 end; the streams map_merge/out/1 move"
    assert [(one.path, one.after, one.consequence) for one in changes(gone)] == [
        ("tasks.map_merge.outputs[1]", None, ends)
    ]
    begins = f"{workers}; the streams map_merge/out/2 begin; the streams map_merge/out/1 move"
    assert [one.consequence for one in changes(TEXT, gone)] == [begins]


def test_workers_take_a_new_process_for_all_that_a_process_keeps() -> None:
    """A robot with an address is one more whom they dial; a deadline is told in their environment."""
    listen = "listen: {control: tcp/0.0.0.0:7457, data: tcp/0.0.0.0:7458}"
    robot = with_("  robot3:", f"  robot4: {{kind: robot, host: 192.0.2.24, {listen}}}\n  robot3:")
    text = "robot4 may join: start its daemon; workers of map_merge restart one after another, to dial robot4"
    assert ("nodes.robot4", text) in [(one.path, one.consequence) for one in changes(robot)]
    relayed = [with_("worker:\n", "worker:\n      link: client\n", text) for text in (robot, TEXT)]
    assert ("nodes.robot4", "robot4 may join: start its daemon") in [
        (one.path, one.consequence) for one in changes(*relayed)
    ], "who hangs on the relay dials nobody else"
    late = with_("price_s: 0.3}", "price_s: 0.3, objective: latency, deadline_ms: 80}")
    (told,) = (one for one in changes(late) if one.path.endswith("deadline_ms"))
    assert (told.effect, told.after) == (Effect.WORKERS, "80")
    assert not [one.path for one in changes(late) if one.effect is Effect.NOTHING]
    by_hand = with_("      command: [python, -m, zsched.tasks.map_merge, --mode, estimate]\n", "      link: peer\n")
    other = with_("link: peer", "link: client", by_hand)
    assert [one.consequence for one in changes(other, by_hand)] == [
        "restart the workers of map_merge, which somebody else starts"
    ]


def test_workers_take_a_new_process_to_find_the_first_robot_without_an_address_and_when_the_last_one_goes() -> None:
    """Where each robot has an address their sessions look for nobody, and a session keeps what it was opened with."""
    listen = "listen: {control: tcp/0.0.0.0:7457, data: tcp/0.0.0.0:7458}"
    old = TEXT
    for number in (1, 2, 3):
        old = with_(
            f"robot{number}: {{kind: robot,", f"robot{number}: {{kind: robot, host: 192.0.2.2{number}, {listen},", old
        )
    new = with_("  robot3:", "  robot4: {kind: robot}\n  robot3:", old)
    restart = "workers of map_merge restart one after another"
    come, *_ = (one for one in changes(new, old) if one.path == "nodes.robot4")
    assert come.consequence == f"robot4 may join: start its daemon; {restart}, to find robot4"
    go, *_ = (one for one in changes(old, new) if one.path == "nodes.robot4")
    assert go.consequence == f"node robot4 is removed: the others forget it; {restart}"
    second = with_("  robot3:", "  robot5: {kind: robot}\n  robot3:", new)
    assert not any(restart in one.consequence for one in changes(second, new)), "they look for others already"
    relayed = with_("worker:\n", "worker:\n      link: client\n", old)
    assert (
        "restart"
        not in changes(with_("  robot3:", "  robot4: {kind: robot}\n  robot3:", relayed), relayed)[0].consequence
    )
    alone = with_("candidates: {kind: edge}", "candidates: [edge2]", old)
    found = changes(with_("  robot3:", "  robot4: {kind: robot}\n  robot3:", alone), alone)
    assert [one.danger for one in found if one.danger] == [Danger.PAUSE_TASK]


@pytest.mark.parametrize(
    ("timing", "is_told"),
    [
        ("{lease_s: 1.1}", True),  # four signs of life in a lease, no longer three
        ("{zenoh_lease_s: 2}", True),
        ("wan", True),
        ("{lease_s: 0.9}", False),
        ("{beat_s: 0.1}", False),
    ],
)
def test_workers_take_a_new_process_for_clocks_that_are_in_their_sessions(timing: str, is_told: bool) -> None:
    new = with_("timing: wifi", f"timing: {timing}")
    sessions = [worker_config(connect=(), timing=fleet_of(text).timing) for text in (TEXT, new)]
    assert bool(lacking(*sessions)) is is_told
    said = [one.consequence for one in changes(new) if one.path == "timing"]
    assert any("workers of map_merge restart one after another" in text for text in said) is is_told
    alone = with_("candidates: {kind: edge}", "candidates: [edge2]")
    found = changes(with_("timing: wifi", f"timing: {timing}", alone), alone)
    assert [one.danger for one in found if one.danger] == [Danger.PAUSE_TASK] * is_told


def test_dangers_have_names_and_say_what_is_accepted() -> None:
    extended = add_entries(TEXT, "tasks", f"tasks:\n{EXCLUSIVE}")
    shared = with_("exclusive: true", "exclusive: false", extended)
    electors = TEXT + "electorate: [robot1, robot2, edge1]\n"
    robot = with_("  robot3: {kind: robot, wifi: wlan0}\n", "")
    alone = with_("candidates: {kind: edge}", "candidates: [edge2]")
    cases: list[tuple[str, str, set[Danger]]] = [
        (TEXT, extended, set()),
        (extended, TEXT, {Danger.REMOVE_TASK}),
        (shared, extended, {Danger.MAKE_EXCLUSIVE}),
        (extended, shared, {Danger.END_EXCLUSIVE}),
        (TEXT, electors, {Danger.CHANGE_ELECTORS}),
        (TEXT, robot, {Danger.REMOVE_NODE, Danger.CHANGE_ELECTORS}),
        (robot, TEXT, set()),
        (alone, with_("--mode, estimate", "--mode, known", alone), {Danger.PAUSE_TASK}),
        (SECURED, SECURED.replace("security: {}\n", ""), {Danger.END_SECURITY}),
        (SECURED.replace("security: {}\n", ""), SECURED, set()),
    ]
    for old, new, expected in cases:
        found = changes(new, old)
        assert {one.danger for one in found if one.danger is not None} == expected
        assert all(bool(one.warning()) == (one.danger is not None) for one in found)
    assert next(one.warning() for one in changes(TEXT, extended)).startswith("pick: its worker stops")


def test_changes_of_sessions_need_a_restart_of_the_daemons_that_have_them() -> None:
    assert changes(with_("timing: wifi", "timing: {lease_s: 1.1}"))[0].effect is Effect.RESTART
    assert changes(with_("timing: wifi", "timing: {lease_s: 0.9}"))[0].effect is Effect.AT_ONCE
    moved = with_("tcp/0.0.0.0:7457", "tcp/0.0.0.0:7557")
    assert [one.consequence for one in changes(moved)] == ["the daemon of edge1 must be restarted"]
    assert [one.consequence for one in changes(TEXT + "shared_memory: auto\n")] == ["every daemon must be restarted"]


def test_electors_change_only_where_the_file_names_them_or_has_them_no_more() -> None:
    """The fleet may have changed them by itself since: a file that names none does not mean to take that back."""
    agreed = ("edge1", "robot1", "robot2")
    new = with_("price_s: 0.3}", "price_s: 3}")
    assert [one.path for one in difference(fleet_of(TEXT), fleet_of(new), (TEXT, new), {}, agreed)] == [
        f"{RULES}.price_s"
    ]
    named = f"{new}electorate: [edge2, robot1, robot2]\n"
    found = difference(fleet_of(TEXT), fleet_of(named), (TEXT, named), {}, agreed)
    told = "electors change: edge2 becomes one, edge1 is none any more; electors are replaced no more"
    assert [(one.path, one.consequence) for one in found][1:] == [("electorate", told)]
    assert wanted_electors(agreed, fleet_of(named), named) == ("edge2", "robot1", "robot2")
    assert wanted_electors(("gone", "robot1"), fleet_of(TEXT), TEXT) == ("robot1",)


def another(value: Any) -> Any:
    """Another value of the same type, for a field that no rule of the file is held against here."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, StrEnum):
        return next(one for one in type(value) if one is not value)
    if isinstance(value, int | float):
        return value * 2 + 1
    return f"{value}x" if isinstance(value, str) else (*value, "x")


def differing(value: Any, *left_out: str) -> list[Any]:
    """``value`` with each of its fields changed in turn, records field by field."""
    found: list[Any] = []
    for one in fields(value):
        held = getattr(value, one.name)
        if one.name in left_out:
            continue
        if isinstance(held, Weights):
            found.append(replace(value, weights=Weights(cpu=1.0, memory=0.0, network=0.0)))
        elif one.name == "gauge_limits":
            found.append(replace(value, gauge_limits=(("battery", 0.2),)))
        elif one.name == "cells":
            found.append(replace(value, cells=(Cell(name="other", gateways=("tcp/192.0.2.31:7457",)),)))
        elif hasattr(held, "__dataclass_fields__"):
            found += [replace(value, **{one.name: inner}) for inner in differing(held)]
        elif held is not None:
            try:
                found.append(replace(value, **{one.name: another(held)}))
            except ValueError:  # out of its range: half of it is in
                found.append(replace(value, **{one.name: held / 2}))
    return found


def test_no_field_of_a_fleet_changes_unnoticed() -> None:
    """A field that comes later must have its consequence, or this fails."""
    old = fleet_of(TEXT)
    fleets = differing(old, "name", "nodes", "tasks", "electors")
    task, rest = old.tasks[0], old.tasks[1:]
    tasks: list[TaskSpec] = differing(task, "name", "rules", "max_moves_per_minute")
    fleets += [replace(old, tasks=(one, *rest)) for one in tasks]
    node = old.nodes[0]
    nodes: list[NodeSpec] = differing(replace(node, links=(), labels=()), "name", "kind", "links", "labels")
    nodes += [replace(node, kind=NodeKind.ROBOT), replace(node, labels=()), replace(node, local=LocalSide())]
    nodes += [replace(node, links=(LinkSpec(source=LinkSource.FIXED, value="-50"),))]
    fleets += [replace(old, nodes=(one, *old.nodes[1:])) for one in nodes]
    assert len(fleets) > 50
    for new in fleets:
        if new == old or new.timing.name != old.timing.name:
            continue  # the profile's name is only what its clocks began with
        found = difference(old, new, (TEXT, TEXT))
        assert found, [one.name for one in fields(old) if getattr(old, one.name) != getattr(new, one.name)]
        assert all(one.effect is not Effect.NOTHING for one in found)
        agreed = replace(new, electors=old.electors, timing=replace(new.timing, lease_s=old.timing.lease_s))
        waits = any(restarts(old, agreed, one.name) for one in new.nodes if one.kind is old.node(one.name).kind)
        is_told = any(one.effect in (Effect.RESTART, Effect.NODE) for one in found)
        assert is_told or not waits, "what a daemon cannot take over while it runs is told as that"


def test_what_a_secured_fleet_lets_in_follows_when_its_daemons_begin_anew() -> None:
    plain = TEXT.replace("tcp/", "tls/")
    secured = f"{plain}\nsecurity: {{}}\n"
    anew = "daemons begin again in turns: a robot's streams stop for that moment"
    assert told(secured, plain)[0][3] == "every daemon must be restarted"
    folder = secured.replace("{}", "{folder: /etc/other}")
    assert told(folder, secured)[0][3] == "every daemon must be restarted"
    assert told(f"{plain}\nsecurity: {{revoked: [robot1]}}\n", secured) == [
        ("security.revoked", None, "[robot1]", anew)
    ]
    node = with_(
        "  robot1: {kind: robot, wifi: wlan0}", "  robot1: {kind: robot, wifi: wlan0}\n  robot9: {kind: robot}", secured
    )
    assert any(anew in one[3] for one in told(node, secured) if one[0] == "nodes.robot9")
    without = node.replace("\nsecurity: {}\n", "\n")
    assert not any("begin again" in one[3] for one in told(without, plain))


SECURED = f"{TEXT.replace('tcp/', 'tls/')}\nsecurity: {{}}\n"
SPEAKING = EXCLUSIVE + '    inputs: [{from: "{robot}/box", to: "{target}/pick/{robot}/box"}]\n'
ROBOT1 = "  robot1: {kind: robot, wifi: wlan0}"
LISTENS = 'local: {mode: peer, listen: ["tcp/127.0.0.1:7460"]}'


@pytest.mark.parametrize(
    ("other", "path", "is_anew"),
    [
        (SECURED.replace("tasks:\n", f"tasks:\n{SPEAKING}", 1), "tasks.pick", True),
        (SECURED.replace("tasks:\n", f"tasks:\n{EXCLUSIVE}", 1), "tasks.pick", False),
        (with_(ROBOT1, f"{ROBOT1}\n  robot9: {{kind: robot}}", SECURED), "nodes.robot9", True),
        (with_(ROBOT1, f"{ROBOT1[:-1]}, {LISTENS}}}", SECURED), "nodes.robot1.local", True),
        (with_(ROBOT1, f"{ROBOT1[:-1]}, labels: {{arm: left}}}}", SECURED), "nodes.robot1.labels", False),
    ],
    ids=["a task with streams", "one without", "a node", "a local side", "a label"],
)
def test_daemons_are_said_to_begin_again_where_they_do_when_it_comes_and_when_it_goes(
    other: str, path: str, is_anew: bool
) -> None:
    """A change that only takes rights away is told, too: open sessions let in more than the file says."""
    for new, old in ((other, SECURED), (SECURED, other)):
        assert opens_anew(fleet_of(old), fleet_of(new)) is is_anew
        there = [one[3] for one in told(new, old) if one[0] == path]
        assert there
        assert any("begin again in turns" in text for text in there) is is_anew


def test_it_is_said_that_daemons_begin_again_where_they_do_and_nowhere_else() -> None:
    """Where it is said for nothing, what needs a restart is told as done by itself, and nobody does it."""
    old = fleet_of(SECURED)
    (task, *rest), nodes = old.tasks, old.nodes
    variants: list[Fleet] = differing(old, "name", "nodes", "tasks", "electors")
    variants += [replace(old, tasks=(one, *rest)) for one in differing(task, "name", "rules", "max_moves_per_minute")]
    for at, rule in enumerate(task.rules):
        rules = [(*task.rules[:at], one, *task.rules[at + 1 :]) for one in differing(rule)]
        variants += [replace(old, tasks=(replace(task, rules=one), *rest)) for one in rules]
    for at, node in enumerate(nodes):
        others = (replace(node, local=LocalSide()), *differing(replace(node, links=(), labels=()), "kind", "links"))
        variants += [
            replace(old, nodes=(*nodes[:at], one, *nodes[at + 1 :])) for one in others if one.name == node.name
        ]
    assert old.security is not None
    variants += [
        replace(old, security=replace(old.security, revoked=(one,))) for one in ("robot9", "robot1", "edge1.k2")
    ]
    seen = set()
    for new in variants:
        for before, after in ((old, new), (new, old)):
            found = difference(before, after, (SECURED, SECURED))
            is_said = any("daemons begin again in turns" in one.consequence for one in found)
            assert is_said is opens_anew(before, after), [(one.path, one.before, one.after) for one in found]
            seen.add(is_said)
    assert seen == {True, False}


def test_the_former_key_of_a_node_that_has_left_is_said_to_let_nobody_in() -> None:
    """It said that nothing notices, of a line that names the node which is just being invited."""
    assert told(with_("security: {}", "security: {revoked: [robot9]}", SECURED), SECURED) == [
        ("security.revoked", None, "[robot9]", "a key that was made out for robot9 before lets nobody in")
    ]


def test_nobody_has_to_restart_a_daemon_that_begins_again_by_itself() -> None:
    """One of another kind does not: the file names another node than it is."""
    before = with_(ROBOT1, f"{ROBOT1}\n  robot9: {{kind: robot}}", SECURED)
    after = with_("  robot9: {kind: robot}", "  robot8: {kind: robot}", f"shared_memory: auto\n{before}")
    after = with_(ROBOT1, f"{ROBOT1[:-1]}, {LISTENS}}}", after)
    said = {one[0]: one[3] for one in told(after, before)}
    assert said["shared_memory"] == "daemons begin again in turns: a robot's streams stop for that moment"
    assert said["nodes.robot1.local"].startswith("the daemon of robot1 begins again, by itself in its turn")
    assert not any("must be restarted" in text for text in said.values()), said
    edge = with_("  robot9: {kind: robot}", "  robot9: {kind: edge, host: 192.0.2.9}", before)
    assert any("the daemon of robot9 must be restarted" in one[3] for one in told(edge, before))


def test_nobody_has_to_restart_a_daemon_for_signatures_where_a_key_is_revoked_with_them() -> None:
    offered = with_("security: {}", "security: {signatures: offered}", SECURED)
    assert {one[3] for one in told(offered, SECURED)} == {"every daemon must be restarted"}
    revoked = with_("security: {}", "security: {signatures: offered, revoked: [robot1]}", SECURED)
    anew = "daemons begin again in turns: a robot's streams stop for that moment"
    assert {one[3] for one in told(revoked, SECURED)} == {anew}
    assert opens_anew(fleet_of(SECURED), fleet_of(revoked))


def test_whose_orders_count_changes_at_once() -> None:
    named = with_("security: {}", "security: {orders: [robot1]}", SECURED)
    assert [one[0::3] for one in told(named, SECURED)] == [("security.orders", "takes effect at once")]
    assert not opens_anew(fleet_of(SECURED), fleet_of(named))


def test_what_comes_later_is_not_told_together_with_at_once() -> None:
    """A new candidate counts at once, and is let in only once the daemons have begun anew: the later one is told."""
    secured = f"{TEXT.replace('tcp/', 'tls/')}\nsecurity: {{}}\n"
    old = with_("candidates: {kind: edge}", "candidates: [edge1]", secured)
    new = with_("candidates: [edge1]", "candidates: [edge1, edge2]", old)
    anew = "daemons begin again in turns: a robot's streams stop for that moment"
    assert [one[3] for one in told(new, old)] == [anew]


# --- who dials whom --------------------------------------------------------------------------------------------------


def test_a_node_that_comes_at_the_end_of_the_seeds_dials_and_nobody_else_does_anew() -> None:
    node = "{{kind: robot, host: 192.0.2.{0}, listen: {{control: tcp/0.0.0.0:7457, data: tcp/0.0.0.0:7458}}}}"
    nodes = "".join(f"  r{n}: {node.format(n)}\n" for n in (1, 2, 4))
    old = f"fleet: f\nnodes:\n{nodes}tasks: {{}}\n"

    def told(seeds: str) -> str:
        text = old.replace("tasks:", f"  r3: {node.format(3)}\ntasks:") + f"seeds: [{seeds}]\n"
        before, after = (check_bytes(one.encode()).fleet for one in (old, text))
        assert before is not None
        assert after is not None
        return next(one.consequence for one in difference(before, after, (old, text)) if one.path == "seeds")

    assert told("r1, r2, r4, r3") == "r3 dials the others"
    for seeds in ("r1, r2, r3, r4", "r3, r1, r2, r4", "r2, r1, r4, r3"):
        assert told(seeds) == "every daemon dials them from its next start on"


def test_which_warnings_are_moot_hangs_on_no_word() -> None:
    """Where a document names no electors, those of its default number are; others may speak of electors as well."""
    text = "fleet: hall\nnodes:\n  r1: {kind: robot}\ntasks: {}\n"
    (few,) = (one for one in check_bytes(text.encode(), "f").warnings if one.is_of_electors)
    reworded, other = replace(few, message="this fleet is small"), replace(few, is_of_electors=False)
    assert warnings_in_force(text, (reworded, other)) == (other,)
    assert warnings_in_force(f"{text}electorate: [r1]\n", (reworded, other)) == (reworded, other)
