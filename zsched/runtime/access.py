"""Tells an operator's tool on this machine how to join the data network: ready-made zenoh configurations.

Knows: which endpoint leads to which node's streams. Does not know: zenoh, what the tool listens to.

The answer may hold what the operator's own zenoh file holds (certificates' paths): it is given over the operator socket
only, never to another node.
"""

from __future__ import annotations

from typing import Any

from zsched.core.values.fleet import LocalSide, NodeSpec
from zsched.core.values.in_force import InForce
from zsched.core.values.model import NodeId
from zsched.link.sessions import config as zenoh_config
from zsched.link.sessions.own_addresses import dialled_here

Json = dict[str, Any]


class StreamAccess:
    """The ways from this machine to the streams of any node of the fleet."""

    def __init__(self, in_force: InForce, me: NodeId, own_endpoints: tuple[str, ...], operator_json5: str) -> None:
        """``own_endpoints``: where this node's relay is dialled on this machine."""
        self._in_force, self._me = in_force, me
        self._own = own_endpoints
        self._operator_json5 = operator_json5

    def answer(self, node: NodeId) -> Json:
        """``{"sides": {name: zenoh configuration}, "via": node}`` or ``{"error": ...}``.

        Where the fleet file gives a node no address, this node's own relay is the way: it sees all but what stays on
        that node's local side.
        """
        fleet = self._in_force.fleet
        names = [spec.name for spec in fleet.nodes]
        if node not in names:
            return {"error": f"fleet {fleet.name} has no node {node!r}; there are {', '.join(names)}"}
        spec = fleet.node(node)
        is_direct = node == self._me or bool(spec.data_at)
        connect = self._own if node == self._me or not spec.data_at else (spec.data_at,)
        sides = {"fleet": self._config(connect, self._operator_json5)}
        if node == self._me and spec.local is not None:  # plain text and for this host, whatever the fleet's side is
            sides["local"] = self._config(_ways_to(spec.local), "")
        return {"sides": sides, "via": node if is_direct else self._me, "endpoints": list(connect)}

    def _config(self, connect: tuple[str, ...], operator_json5: str) -> str:
        return zenoh_config.client_config(
            connect=connect, timing=self._in_force.timing, shared_memory=False, operator_json5=operator_json5
        )


def joins_at(spec: NodeSpec, own_endpoints: tuple[str, ...]) -> tuple[str, ...]:
    """Where applications on this machine join its streams: their own network where there is one, else our relay."""
    return own_endpoints if spec.local is None else _ways_to(spec.local)


def _ways_to(side: LocalSide) -> tuple[str, ...]:
    return (*side.connect, *filter(None, map(dialled_here, side.listen)))
