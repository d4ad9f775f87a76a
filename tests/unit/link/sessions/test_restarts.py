"""What a running daemon cannot take over is said in full, and nothing else."""

from __future__ import annotations

from dataclasses import replace

import pytest

from support.fleets import fleet_of, node_of
from zsched.core.values.fleet import Fleet, NodeSpec, Security, SharedMemory, Signatures
from zsched.core.values.model import NodeKind
from zsched.link.sessions.restarts import moved, opens_anew, restarts, waits_for


def addressed(name: str, host: str = "") -> NodeSpec:
    at = host or f"10.0.0.{sum(map(ord, name)) % 200}"
    return node_of(name, host=at, listen_control="tcp/0.0.0.0:7457", listen_data="tcp/0.0.0.0:7458")


NODES = tuple(map(addressed, ("edge1", "edge2", "robot1", "robot2")))
OLD = fleet_of(of=NODES, seeds=("edge1", "edge2"))


def with_node(node: NodeSpec, seeds: tuple[str, ...] = ("edge1", "edge2")) -> Fleet:
    others = [one for one in OLD.nodes if one.name != node.name]
    return replace(OLD, nodes=tuple(sorted((*others, node), key=lambda one: one.name)), seeds=seeds)


@pytest.mark.parametrize(
    ("new", "told"),
    [
        (replace(OLD, electors=("robot1",)), "need a new generation"),
        (replace(OLD, timing=replace(OLD.timing, lease_s=2.0)), "leases of exclusive tasks stay 1 s"),
        (replace(OLD, timing=replace(OLD.timing, zenoh_lease_s=3.0)), "zenoh's lease (3 s"),
        (replace(OLD, shared_memory=SharedMemory.AUTO), "`shared_memory`"),
        (replace(OLD, zenoh_config="z.json5"), "`zenoh: {config}`"),
        (with_node(replace(NODES[2], listen_control="tcp/0.0.0.0:9")), "robot1: `listen: {control}`"),
        (with_node(addressed("edge2", host="10.9.9.9")), "tcp/10.9.9.9:7457, tcp/10.9.9.9:7458 would be dialled"),
        (with_node(addressed("edge3", host="10.9.9.9")), "named under `seeds`"),
    ],
)
def test_what_holds_after_a_restart_only_is_told(new: Fleet, told: str) -> None:
    found = restarts(OLD, new, "robot1")
    assert len(found) == 1 or told == "named under `seeds`"
    assert any(told in sentence for sentence in found)


def test_a_node_that_comes_dials_those_that_are_named_as_seeds() -> None:
    come = with_node(addressed("edge0"), seeds=("edge1", "edge2", "robot1", "robot2"))
    assert [one for one in restarts(OLD, come, "robot1") if "dialled" in one] == []
    assert [one for one in restarts(OLD, come, "edge1") if "dialled" in one] == []


def test_who_is_let_in_by_other_names_begins_anew_by_itself() -> None:
    secured = replace(OLD, security=Security(folder="pki"))
    assert not opens_anew(secured, secured)
    come = replace(with_node(addressed("robot9", NodeKind.ROBOT)), security=secured.security)
    for new in (
        come,
        replace(secured, security=Security(folder="pki", revoked=("robot2",))),
        replace(secured, security=Security(folder="pki", operators=("ana",))),
    ):
        assert opens_anew(secured, new)
        assert [one for one in restarts(secured, new, "robot1") if "security" in one] == []
    for other in (OLD, replace(OLD, security=Security(folder="other"))):
        assert not opens_anew(secured, other), "who is secured otherwise does not meet the others"
        assert any("`security`" in one for one in restarts(secured, other, "robot1"))
    assert not opens_anew(OLD, with_node(addressed("robot9", NodeKind.ROBOT))), "nobody is kept out"


@pytest.mark.parametrize(
    "other",
    [Security(folder="pki", signatures=Signatures.OFFERED), Security(folder="other")],
    ids=["signatures", "folder"],
)
def test_a_revoked_key_s_sessions_end_also_where_the_rest_of_the_section_is_another(other: Security) -> None:
    """Nobody has restarted it for the rest; what is revoked since ends sessions all the same."""
    secured = replace(OLD, security=Security(folder="pki"))
    new = replace(secured, security=replace(other, revoked=("robot2",)))
    assert opens_anew(secured, new)
    assert [one for one in restarts(secured, new, "robot1") if "`security`" in one], "and it takes over the rest"


def test_a_daemon_that_begins_again_by_itself_asks_nobody_to_restart_it() -> None:
    assert waits_for((), True) is waits_for((), False) is None
    assert waits_for(("one", "two"), False) == "until this daemon is restarted: one; two"
    assert waits_for(("one",), True) == "until this daemon begins again, by itself in its turn: one"


def test_a_longer_lease_for_which_open_sessions_send_too_few_signs_of_life_needs_a_restart() -> None:
    """A frozen worker's link would end before its lease is over: 1 s after the freeze, and the lease has 1.1 s."""
    longer = replace(OLD, timing=replace(OLD.timing, lease_s=1.1))
    (told,) = restarts(OLD, longer, "robot1", is_agreed=True)
    assert told.startswith("`lease_s` of 1.1 s needs 4 signs of life in zenoh's lease")
    assert restarts(longer, OLD, "robot1", is_agreed=True) == ()


def test_who_dials_a_node_that_moves_begins_again_and_nobody_else() -> None:
    there = with_node(addressed("edge2", host="10.9.9.9"))
    assert moved(OLD, there, "robot1") == moved(OLD, there, "robot2") == ("edge2",)
    assert moved(OLD, there, "edge1") == (), "edge2 dials it"
    assert moved(OLD, there, "edge2") == (), "its own address"
    assert any("begins again by itself once it does not hear edge2" in one for one in restarts(OLD, there, "robot1"))
    data = with_node(replace(NODES[0], listen_data="tcp/0.0.0.0:9"))
    assert moved(OLD, data, "robot1") == ("edge1",)
    assert moved(OLD, with_node(addressed("edge3", host="10.9.9.9")), "robot1") == (), "a new node dials"
