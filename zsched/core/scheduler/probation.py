"""SCHEDULER, after a heal: a node that was gone and is back gets no task before its streams are proven again.

Knows: who was gone and came back, and which workers' tokens this node's relay sees. Does not know: who is better, what
a stream carries.

Beats and streams travel on different links. After a cut both may be dead for TCP, and each comes back by its own
retransmission timer, so a node may beat again seconds before anything reaches its worker. Two things prove the streams,
seen from one robot:

* its worker's token appeared on the data session after the node was gone: that came over a living link;
* the token has stood for a whole zenoh lease since the node is back: zenoh closes a link over which it hears nothing
  for so long, and its tokens go. (Workers that show no token before they own the task are given this time, too.)

After `LIMIT_S` a node is judged like any other: a token that never comes is no affair of the cut's any more, and the
handover waits for it. The rule is about *getting* a task: an owner is not left for want of proof.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from zsched.core.values.fleet import Standby, TaskSpec
from zsched.core.values.in_force import InForce
from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.plan import ReadyWhen
from zsched.core.values.struct import Struct, field

LEASE_MARGIN_S = 0.5
"""zenoh looks at its leases now and then, and a token's end has a way to go."""
LIMIT_S = 10.0
"""This long after its return a node is judged like any other."""
_NONE: Mapping[NodeId, str] = {}


class _Return(Struct):
    gone_at: float
    back_at: float = math.inf


class Probation(Struct):
    """What one robot knows of the streams to nodes that were gone."""

    in_force: InForce
    _returns: dict[NodeId, _Return] = field(default_factory=dict)
    _tokens: dict[tuple[NodeId, TaskId], dict[str, float]] = field(default_factory=dict)
    """{(node, task): {worker's incarnation: when its token came}} of the tokens that are there."""

    def __post_init__(self) -> None:
        # Not so tokens: another node may go by a document before us, and its worker shows itself once. Our relay
        # bounds them (`zsched.relay.tokens`).
        self._returns = self.in_force.by_node()

    def on_gone(self, node: NodeId, now: float) -> None:
        """A peer is gone: what was known of its streams is worth nothing any more."""
        self._returns[node] = _Return(gone_at=now)

    def on_back(self, node: NodeId, now: float) -> None:
        """A peer that was gone beats again."""
        known = self._returns.get(node)
        if known is not None and known.back_at == math.inf:
            known.back_at = now

    def on_token(self, node: NodeId, task: TaskId, incarnation: str, *, is_present: bool, now: float) -> None:
        """Our relay saw a worker's token come or go."""
        tokens = self._tokens.setdefault((node, task), {})
        if is_present:
            tokens[incarnation] = now
            return
        tokens.pop(incarnation, None)
        if not tokens:
            del self._tokens[node, task]

    def forget_tokens(self) -> None:
        """Our relay is another one: it tells anew what it sees."""
        self._tokens.clear()

    def sees(self, node: NodeId, task: TaskId) -> bool:
        """Whether our relay sees a token of a worker there."""
        return bool(self._tokens.get((node, task)))

    def doubts(self, spec: TaskSpec, now: float) -> Mapping[NodeId, str]:
        """{candidate: why it may not get the task yet}."""
        if not self._returns:
            return _NONE
        for node in [node for node, known in self._returns.items() if now - known.back_at >= LIMIT_S]:
            del self._returns[node]
        reasons = {node: self._doubt(spec, node, now) for node in spec.candidates if node in self._returns}
        return {node: reason for node, reason in reasons.items() if reason}

    def _doubt(self, spec: TaskSpec, node: NodeId, now: float) -> str:
        known = self._returns[node]
        if known.back_at == math.inf:
            return ""
        back_s = now - known.back_at
        tokens = self._tokens.get((node, spec.name), {})
        if any(at > known.gone_at for at in tokens.values()):
            return ""
        has_stood = bool(tokens) or not shows_token(spec)
        if has_stood and back_s >= self.in_force.timing.zenoh_lease_s + LEASE_MARGIN_S:
            return ""
        return f"back for {back_s:.1f} s, its streams are not proven yet"


def shows_token(spec: TaskSpec) -> bool:
    """Whether a candidate's worker shows itself before it owns the task."""
    return spec.worker.ready_when is ReadyWhen.TOKEN and spec.worker.standby is Standby.WARM
