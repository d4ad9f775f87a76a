"""Driver `ros2_lifecycle`: the worker is a managed ROS 2 node, inactive on a standby and active at the owner.

``python -m zsched.drivers.ros2_lifecycle --node /{target}/NAME [--env NAME ...] --arg=WORD ...``. The words are the
node's command. The driver configures the node, activates it when the task comes, and deactivates it when it has gone.

Knows: the role of this worker, the services of a managed node under rmw_zenoh's keys. Does not know: rclpy, streams.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import zenoh

from zsched.core.route.lifecycle import (
    GET_STATE_REQUEST,
    State,
    Transition,
    change_state_key,
    change_state_request,
    get_state_key,
    is_changed,
    state_of,
    step,
)
from zsched.core.route.ros2 import (
    DOMAIN,
    GID_BYTES,
    MAX_DOMAIN,
    Attachment,
    decode_attachment,
    encode_attachment,
    name_fault,
    node_name_fault,
)
from zsched.core.values.errors import ConfigError
from zsched.core.values.exits import EXIT_CONFIG
from zsched.core.values.plan import Role, WorkerRole
from zsched.drivers.engine import Ended, Look, begin
from zsched.drivers.place import Place
from zsched.host.clock import awake_s, wall_ns
from zsched.host.guard import end_with, ends_within, guarded
from zsched.link.keyspace import Keyspace
from zsched.link.sessions.closing import CLOSE_S
from zsched.link.sessions.config import relay_endpoint
from zsched.worker.roles import RoleWatch
from zsched.worker.start import open_session

LOOK_S: Final = 2.0
"""How often the node is asked for its state while the role stays."""
SOON_S: Final = 0.1
"""...while it is on its way, or has not answered yet."""
ASK_S: Final = 2.0
SILENT_S: Final = 10.0
"""A node that has answered once, and then does not for this long, has failed."""
CHANGE_S: Final = {Transition.CONFIGURE: 60.0, Transition.ACTIVATE: 10.0, Transition.DEACTIVATE: 3.0}
"""A node may take this long to change: one that is no owner any more, and stays active, is killed soon."""


class LifecycleNode:
    """One node (`zsched.drivers.engine.Engine`)."""

    is_child = True
    leaves_nothing = True

    def __init__(self, given: argparse.Namespace, place: Place, domain: str) -> None:
        self._command: list[str] = given.arg
        self._place, self._domain_text, self._domain = place, domain, 0
        self._node = name_here(given.node, place.node)
        self._tell_end: Callable[[Ended], None] = lambda _: None
        self._session: zenoh.Session | None = None
        self._gid = os.urandom(GID_BYTES)
        self._sequence = 0
        self._role = WorkerRole.IDLE
        self._is_told = False
        self._stop, self._news = threading.Event(), threading.Event()

    def begin(self, tell_end: Callable[[Ended], None]) -> Ended | None:
        """Open a session at this node's relay; from now on a thread leads the node."""
        fault = fault_of(self._node, self._place.node, self._domain_text)
        if fault is not None:
            return Ended(reason=fault, is_final=True)
        self._domain, self._tell_end = int(self._domain_text), tell_end
        try:
            text = self._place.session.read_text(encoding="utf-8")
            self._session = open_session(as_client(text))
        except (OSError, ConfigError) as error:
            return Ended(reason=f"the services of {self._node} cannot be asked: {error}")
        key = Keyspace(self._place.fleet).role(self._place.node, self._place.task)
        RoleWatch(self._session, key, self._on_role, self._stop, relay_endpoint(text), again_s=LOOK_S).start()
        guarded(self._lead, self._session, name="zsched lifecycle", is_lasting=False).start()
        return None

    def run(self) -> Sequence[str]:
        """The node itself."""
        return self._command

    def log(self) -> Sequence[str]:
        """`run` prints it."""
        return ()

    def pid(self) -> int | None:
        """The node's process: this one's only child."""
        with contextlib.suppress(OSError, IndexError, ValueError):
            me = os.getpid()
            return int(Path(f"/proc/{me}/task/{me}/children").read_text(encoding="ascii").split()[0])
        return None

    def stop(self, *, is_hard: bool) -> None:
        """The node gets the daemon's signals itself; it is led no more."""
        del is_hard
        self._stop.set()
        self._news.set()

    def why(self, status: int) -> Ended:
        """By the status of the node's process."""
        if status < 0:
            return Ended(reason=f"{self._node} was killed by signal {-status}")
        what = "has ended by itself" if status == 0 else f"failed with status {status}"
        return Ended(reason=f"{self._node} {what}", is_final=status == EXIT_CONFIG)

    def last_resort(self) -> str:
        """Nothing: the node dies with this process."""
        return ""

    def close(self) -> None:
        """Close the session; a peer that is stopped does not hold us longer than `CLOSE_S`."""
        self._stop.set()
        self._news.set()
        if self._session is not None:
            ends_within(CLOSE_S, self._session.close, name="zsched close")

    # --- the thread --------------------------------------------------------------------------------------------------

    def _on_role(self, role: Role) -> None:
        self._role, self._is_told = role.role, True
        self._news.set()

    def _lead(self, session: zenoh.Session) -> None:
        """Bring the node where its role wants it, again and again: it may have left that state by itself."""
        heard_s: float | None = None  # the node slept as long as the machine did
        while not self._stop.is_set():
            state = self._state(session)
            if state is not None:
                heard_s = awake_s()
            elif heard_s is not None and not _has_link(session):
                heard_s = awake_s()  # the relay is away, and nobody can be asked
            elif heard_s is not None and awake_s() - heard_s > SILENT_S:
                self._fail(f"{self._node} has not told its state for {SILENT_S:g} s")
                return
            pause_s = SOON_S
            if state is not None:
                if state == State.FINALIZED:
                    self._fail(f"{self._node} is finalized: it cannot be configured again")
                    return
                transition = step(state, is_owner=self._is_owner)
                if transition is not None:
                    if not self._changes(session, transition):
                        return
                    heard_s = awake_s()  # that may have taken longer than a silence may
                    continue
                pause_s = LOOK_S if state in (State.INACTIVE, State.ACTIVE) else SOON_S
            self._news.wait(pause_s)
            self._news.clear()

    @property
    def _is_owner(self) -> bool:
        """An owner that drains still answers what came before the move."""
        return self._role is not WorkerRole.IDLE

    def _changes(self, session: zenoh.Session, transition: Transition) -> bool:
        """Ask for one step; ``False``: the worker has failed."""
        word, within_s = transition.name.lower(), CHANGE_S[transition]
        answer = self._call(
            session, change_state_key(self._domain, self._node), change_state_request(transition), within_s
        )
        done = None if answer is None else is_changed(answer)
        if done:
            print(f"{self._node}: {word} done", file=sys.stderr, flush=True)
            return True
        if self._stop.is_set():
            return False
        if done is None:
            self._fail(f"{self._node} did not answer to {word} within {within_s:g} s")
        else:
            self._fail(f"{self._node} refused to {word}")
        return False

    def _state(self, session: zenoh.Session) -> int | None:
        answer = self._call(session, get_state_key(self._domain, self._node), GET_STATE_REQUEST, ASK_S)
        return None if answer is None else state_of(answer)

    def _call(self, session: zenoh.Session, key: str, request: bytes, within_s: float) -> bytes | None:
        """One call of a service; ``None``: no answer to this question."""
        self._sequence += 1
        asked = Attachment(sequence=self._sequence, stamp_ns=wall_ns(), gid=self._gid)
        try:
            replies = session.get(
                key,
                payload=request,
                attachment=encode_attachment(asked),
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=within_s,
            )
            for reply in replies:
                if reply.ok is None or reply.ok.attachment is None:
                    continue
                said = decode_attachment(reply.ok.attachment.to_bytes())
                if said is not None and (said.sequence, said.gid) == (asked.sequence, asked.gid):
                    return reply.ok.payload.to_bytes()
        except zenoh.ZError as error:
            if not self._stop.is_set():
                print(f"{self._node} could not be asked: {error}", file=sys.stderr, flush=True)
                self._stop.wait(SOON_S)
        return None

    def _fail(self, reason: str) -> None:
        """End this worker: the node is killed with this process, whatever state it is in."""
        self._tell_end(Ended(reason=reason))


def _has_link(session: zenoh.Session) -> bool:
    """Whether the relay is there: a client has no other link."""
    return any((*session.info.routers_zid(), *session.info.peers_zid()))


def name_here(node: str, target: str) -> str:
    """The node's name on this machine.

    >>> name_here("/{target}/slam", "edge1")
    '/edge1/slam'
    """
    return node.replace("{target}", target)


def fault_of(node: str, target: str, domain: str) -> str | None:
    """Why no node can have this name, or no domain this number; ``None``: they can."""
    why = node_name_fault(target)
    if why is not None:
        return f"{target!r} cannot stand in the ROS name {node}: {why}"
    why = name_fault(node)
    if why is not None:
        return f"{node} is no ROS name: {why}"
    if not domain.isascii() or not domain.isdigit() or int(domain) > MAX_DOMAIN:
        return f"{DOMAIN} is {domain!r}, not a number up to {MAX_DOMAIN}"
    return None


def as_client(session: str) -> str:
    """The worker's session as a client of its node's relay, which asks and serves nobody.

    Raises:
        ConfigError: it is no configuration of zenoh, or dials nobody.
    """
    try:
        endpoint = relay_endpoint(session)
        config = zenoh.Config.from_json5(session)
        if not endpoint:
            raise ConfigError("the worker's session file names no relay")
        config.insert_json5("mode", '"client"')
        config.insert_json5("listen/endpoints", "[]")
        config.insert_json5("connect/endpoints", f'["{endpoint}"]')
        config.insert_json5("connect/timeout_ms", "10000")
        return str(config)
    except (zenoh.ZError, ValueError) as error:
        raise ConfigError(f"the worker's session file cannot be read: {error}") from error


def look(arguments: Sequence[str], node: str, task: str) -> Look:
    """Whether the driver could start a node with these ``arguments``; whether it is managed shows at its start."""
    del task
    given = _parser().parse_args(arguments)
    name = name_here(given.node, node)
    fault = fault_of(name, node, "0")
    if fault is not None:
        return Look(told=fault, fix="correct `node:`, or the machine's name")
    if shutil.which(given.arg[0]) is None:
        return Look(told=f"there is no program {given.arg[0]} on this machine", fix="install it, or correct `command:`")
    return Look(told=f"{name} can be started")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m zsched.drivers.ros2_lifecycle", description="a managed ROS 2 node")
    parser.add_argument("--node", required=True)
    parser.add_argument("--arg", action="append", required=True, metavar="WORD")
    parser.add_argument("--env", action="append", default=[], metavar="NAME")
    return parser


def main(arguments: list[str] | None = None) -> int:
    """The driver's command line; the exit status."""
    given = _parser().parse_args(arguments)
    domain = os.environ.get(DOMAIN, "0")
    with contextlib.ExitStack() as stack:
        return begin(
            lambda place: stack.enter_context(contextlib.closing(LifecycleNode(given, place, domain))), given.env
        )


if __name__ == "__main__":
    end_with(main)
