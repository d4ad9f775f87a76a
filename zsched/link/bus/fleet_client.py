"""Asks a fleet from a machine without a daemon: one session as a client, which hangs on the node at one endpoint.

The node that a client hangs on passes its questions on to all nodes that it has a link to. For a moment after the
session was opened it does not know yet who answers what, so a question that nobody answers is asked again. An order is
not, once somebody can have taken it: the first one may yet have its effect.

Knows: zenoh sessions, the keys of status and commands. Does not know: what the answers mean.
"""

from __future__ import annotations

import contextlib
import time

import zenoh

from zsched.core.values import codec as wire
from zsched.core.values.errors import AdapterError, WireError
from zsched.core.values.fleet import MOST_ORDER_S
from zsched.core.values.messages import Agreed, Asking, Command
from zsched.core.values.model import NodeId
from zsched.core.values.snapshot import Snapshot
from zsched.host.clock import monotonic_s
from zsched.link.bus.control_bus import AT_ONCE_SHARE, Answer, answer_classes
from zsched.link.bus.seals import Seals
from zsched.link.keyspace import Keyspace
from zsched.link.seal import Act
from zsched.link.sessions.problems import why_not_open

ANSWER_S = 3.0
"""A question is asked again for this long, as a daemon waits for another node. So long the end of an order is waited
for that a node knows at once; of one that is agreed, for as long as the node that takes it waits."""
ROUND_S = 1.0
"""After which a question is asked again."""
PAUSE_S = 0.1
ANY_FLEET = "*"
"""The endpoint says which fleet is meant; its name need not be known."""


class FleetClient:
    """One open session; safe to close twice."""

    def __init__(
        self, endpoint: str, zenoh_config: str, asker: NodeId, fleet: str = ANY_FLEET, seals: Seals | None = None
    ) -> None:
        """Open the session. A secured fleet takes questions only by its name, and in that of the certificate.

        ``seals`` signs commands; ``None``: nothing is signed.

        Raises:
            AdapterError: nobody takes the connection.
        """
        zenoh.init_log_from_env_or("off")
        self._endpoint, self._asker, self._keys, self._seals = endpoint, asker, Keyspace(fleet), seals
        try:
            self._session = zenoh.open(zenoh.Config.from_json5(zenoh_config))
        except zenoh.ZError as error:
            why = why_not_open(zenoh_config, error).replace("is its router up?", "is a node's control endpoint there?")
            raise AdapterError(f"{endpoint} {why}") from error

    def close(self) -> None:
        """End the session."""
        with contextlib.suppress(zenoh.ZError):
            self._session.close()

    def ask(self, node: NodeId | None, command: Command | None) -> Answer:
        """The status of a node, or its answer to a command; of the node at the endpoint when none is named.

        A node that is given an order is asked for its status first: where it is silent, no order has left.

        Raises:
            AdapterError: it did not answer in time, or something that this version does not read. With the cause
                `TimeoutError` the order may have been taken, and nobody has told what became of it.
        """
        is_order = command is not None and not isinstance(command, Asking)
        life, within_s = 0, ANSWER_S if is_order else ROUND_S
        if command is not None and (is_order or node is None or self._seals is not None):
            status = self.status(node)  # a command is signed for one life of the node that takes it
            node, life = status.node, status.incarnation
            if isinstance(command, Agreed):
                within_s = max(within_s, min(status.order_s, MOST_ORDER_S))
        asked = monotonic_s()
        end = asked + ANSWER_S
        while asked < end:
            answer = self._ask_once(node, command, life, within_s)
            if answer is not None:
                return answer
            if is_order and monotonic_s() - asked >= AT_ONCE_SHARE * within_s:
                raise AdapterError(f"{node} did not answer within {within_s:g} s") from TimeoutError()
            time.sleep(PAUSE_S)
            asked = monotonic_s()
        who = node or f"the node at {self._endpoint}"
        raise AdapterError(f"{who} did not answer within {ANSWER_S:g} s; is that a node's control endpoint?")

    def status(self, node: NodeId | None = None) -> Snapshot:
        """As `ask`, the status."""
        status = self.ask(node, None)
        assert isinstance(status, Snapshot)
        return status

    def _ask_once(self, node: NodeId | None, command: Command | None, life: int, within_s: float) -> Answer | None:
        keys, whom = self._keys, node or "*"
        key = keys.status(whom, self._asker) if command is None else keys.command(whom, self._asker)
        payload, attachment = None if command is None else wire.encode(command), None
        if payload is not None and self._seals is not None:
            attachment = self._seals.seal(Act.QUESTION, key, payload, life=life)
        replies = self._session.get(
            key,
            payload=payload,
            attachment=attachment,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=within_s,
        )
        here = {str(zid) for zid in (*self._session.info.peers_zid(), *self._session.info.routers_zid())}
        for reply in replies:
            replier = reply.replier_id
            if reply.ok is None or (node is None and (replier is None or str(replier.zid) not in here)):
                continue  # another node's, passed on
            try:
                return wire.decode(reply.ok.payload.to_bytes(), *answer_classes(command))
            except WireError as error:
                raise AdapterError(f"{whom} answered something else ({error}); is it another version?") from error
        return None
