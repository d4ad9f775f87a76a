"""Tells this node's workers their roles: put on change, answered on demand.

Knows: the newest role per task, the role keys of this node. Does not know: decisions, what a worker does with it.
"""

from __future__ import annotations

from zenoh import CongestionControl, Priority, Query, Session

from zsched.core.values import codec as wire
from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.plan import Role, WorkerRole
from zsched.host.guard import tolerant
from zsched.link.keyspace import Keyspace


class RoleServer:
    """Serves ``role/<node>/*`` on the data session; a worker that starts late asks and knows at once."""

    def __init__(self, session: Session, keyspace: Keyspace, node: NodeId) -> None:
        self._keyspace = keyspace
        self._node = node
        self._roles: dict[TaskId, Role] = {}
        self.rejoin(session)

    def rejoin(self, session: Session) -> None:
        """Serve on this session."""
        self._session = session
        self._queryable = session.declare_queryable(
            self._keyspace.role(self._node, "*"), tolerant(self._answer, "roles")
        )

    def set(self, role: Role) -> None:
        """Take and tell a task's newest role."""
        self._roles[role.task] = role
        self.tell(role.task)

    def remind(self, task: TaskId, epoch: int) -> None:
        """The worker does not work in an epoch any more: if it should, tell it once more (somebody told it else)."""
        role = self._roles.get(task)
        if role is not None and role.role is WorkerRole.ACTIVE and role.epoch == epoch:
            self.tell(task)

    def forget(self) -> None:
        """Tell nobody anything any more, until the next `set`: the daemon whose word these roles were is gone."""
        self._roles.clear()

    def end(self, task: TaskId) -> None:
        """The task is no task any more: a question for its role gets no answer."""
        self._roles.pop(task, None)

    def tell(self, task: TaskId) -> None:
        """Put the task's role again (its worker has just appeared); nothing when there is none yet."""
        role = self._roles.get(task)
        if role is None:
            return
        self._session.put(
            self._keyspace.role(self._node, task),
            wire.encode(role),
            priority=Priority.INTERACTIVE_HIGH,
            congestion_control=CongestionControl.BLOCK_FIRST,
        )

    def _answer(self, query: Query) -> None:
        with query:  # a query that is kept alive hangs its asker
            for task, role in tuple(self._roles.items()):
                key = self._keyspace.role(self._node, task)
                if query.key_expr.intersects(key):
                    query.reply(key, wire.encode(role))
