"""Asks a whole fleet for its status from outside of any daemon (`zsched init`): a session of a moment to each address.

A client's session hangs on one node, and peers do not forward for one another: one session would reach one node, of all
that are there.

Knows: zenoh sessions, the status key. Does not know: what the answers mean.
"""

from __future__ import annotations

import contextlib
from collections.abc import Sequence

import zenoh

from zsched.core.values import codec as wire
from zsched.core.values.errors import WireError
from zsched.core.values.model import NodeId
from zsched.core.values.snapshot import Snapshot
from zsched.host.clock import monotonic_s
from zsched.host.guard import guarded
from zsched.link.keyspace import Keyspace

ANSWER_S = 1.0
CONNECT_S = 2.0
"""How long an address is waited for that neither takes a connection nor refuses it."""


def ask_fleet(fleet: str, asker: NodeId, zenoh_configs: Sequence[str]) -> tuple[Snapshot, ...]:
    """The newest words of every node that answers, sorted by name; blocks up to `CONNECT_S` + `ANSWER_S`.

    ``zenoh_configs``: a client's, one per address; where nobody listens, nobody answers.
    """
    zenoh.init_log_from_env_or("off")
    found: dict[NodeId, Snapshot] = {}
    errands = [
        guarded(_ask, fleet, asker, config, found, name=f"zsched-poll-{number}", kind="zsched-poll", is_lasting=False)
        for number, config in enumerate(zenoh_configs)
    ]
    for errand in errands:
        errand.start()
    end = monotonic_s() + CONNECT_S + ANSWER_S
    for errand in errands:
        errand.join(max(end - monotonic_s(), 0.0))
    answers = dict(found)  # later answers may still come in
    return tuple(answers[name] for name in sorted(answers))


def _ask(fleet: str, asker: NodeId, config: str, found: dict[NodeId, Snapshot]) -> None:
    with contextlib.suppress(zenoh.ZError), zenoh.open(zenoh.Config.from_json5(config)) as session:
        replies = session.get(
            Keyspace(fleet).status("*", asker),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=ANSWER_S,
        )
        for reply in replies:
            if reply.ok is not None:
                with contextlib.suppress(WireError):
                    answer = wire.decode(reply.ok.payload.to_bytes(), Snapshot)
                    found[answer.node] = answer
