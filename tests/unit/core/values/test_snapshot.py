"""The status of an older program is read, and what it does not tell says nothing."""

from __future__ import annotations

from typing import Any

from support.fleets import tuning_of
from zsched.core.values.codec import as_plain, from_plain
from zsched.core.values.snapshot import SCHEMA, Snapshot


def test_what_an_older_program_does_not_tell_is_read_as_nothing() -> None:
    """No revision, no number, no problem: a figure that it never told would count for one that is known."""
    quorum = {"electors": 1, "needed": 1, "alive": 1, "ok": True, "this_node": "elector"}
    node = {"name": "robot1", "kind": "robot", "state": "alive", "age_s": None}
    pin = {"by": "ada@robot1", "reason": "", "known_s": 1.0}
    task = {
        "name": "merge",
        "owner": None,
        "epoch": 0,
        "revision": 0,
        "since_s": None,
        "owner_state": "",
        "phase": "idle",
        "tuning": as_plain(tuning_of()),
        "candidates": ["robot1"],
        "pin": pin,
    }
    oldest = {
        "schema": SCHEMA,
        "version": "0.1",
        "fleet": "lab",
        "node": "robot1",
        "kind": "robot",
        "incarnation": 1,
        "up_s": 1.0,
        "loop_lag_s": 0.0,
        "quorum": quorum,
        "nodes": [node],
        "tasks": [task],
    }
    read = from_plain(oldest, Snapshot)
    parts: tuple[tuple[Any, dict[str, Any]], ...] = (
        (read, oldest),
        (read.quorum, quorum),
        (read.nodes[0], node),
        (read.tasks[0], task),
        (read.tasks[0].pin, pin),
    )
    for status, told in parts:
        later = {name: getattr(status, name) for name in status.__struct_fields__ if name not in told}
        assert later
        assert {name: value for name, value in later.items() if value} == {}
