"""A status, as a node tells it, of which a test needs no more than that it came."""

from __future__ import annotations

from zsched.core.values.snapshot import SCHEMA, QuorumStatus, Snapshot

SNAPSHOT = Snapshot(
    schema=SCHEMA,
    version="1",
    fleet="f",
    node="b",
    kind="robot",
    incarnation=1,
    up_s=1.0,
    loop_lag_s=0.0,
    quorum=QuorumStatus(electors=3, needed=2, alive=3, ok=True, this_node="elector"),
    nodes=(),
    tasks=(),
)
