"""One service of a worker: takes requests, lets the handler answer them one after another, refuses what is not ours.

Knows: queries, who may answer. Does not know: roles and leases (it asks), what a request means.

Only the owner (or the old one, while it drains) answers. A standby that is asked waits a moment for its role, then
refuses, in words by which the asking relay knows that nothing was done.
"""

from __future__ import annotations

import contextlib
import logging
import queue
import threading
from collections.abc import Callable
from time import monotonic
from typing import Final

import zenoh

from zsched.core.route.keyexpr import is_wild
from zsched.core.values.relay_protocol import ERROR_ENCODING, REFUSED_ENCODING
from zsched.core.values.struct import Struct
from zsched.host.clock import monotonic_s
from zsched.host.guard import guarded, tolerant
from zsched.worker.jobs import JobBook
from zsched.worker.troubles import Troubles

ROLE_WAIT_S: Final = 0.3
"""A request may outrun the word that this worker is the owner; a relay's flip waits as long."""
LOOK_AGAIN_S: Final = 0.01

_log = logging.getLogger("zsched.worker")


class Request(Struct, frozen=True, kw_only=True):
    """One request. ``payload`` and ``attachment`` are zenoh's own bytes, ``None`` when there are none."""

    key: str
    parameters: str = ""
    """As in a selector: ``a=1;b=2``."""
    payload: zenoh.ZBytes | None = None
    attachment: zenoh.ZBytes | None = None
    encoding: str = ""


class Answer(Struct, frozen=True, kw_only=True):
    """An answer that is more than a payload."""

    payload: bytes | zenoh.ZBytes = b""
    attachment: bytes | zenoh.ZBytes | None = None
    encoding: str | None = None


Handler = Callable[[Request], bytes | zenoh.ZBytes | Answer]


class Service:
    """A queryable, a bounded queue and a thread. ``is_owner`` says, at any moment, whether this worker may work."""

    def __init__(
        self,
        session: zenoh.Session,
        key_expr: str,
        handler: Handler,
        *,
        is_owner: Callable[[], bool],
        later: Callable[[Callable[[], None]], None],
        troubles: Troubles,
        jobs: JobBook,
        depth: int,
    ) -> None:
        """Declare the queryable; ``later`` runs a call in another thread (zenoh's own must only enqueue).

        Raises:
            zenoh.ZError: ``key_expr`` is no key expression.
        """
        self._key_expr = key_expr
        self._handler = handler
        self._is_owner = is_owner
        self._later = later
        self._troubles = troubles
        self._jobs, self._timer = jobs, jobs.timer()
        self._requests: queue.Queue[tuple[zenoh.Query, float] | None] = queue.Queue(depth)
        self._timer.queued = self._requests.qsize
        self._is_closed = False
        guarded(self._run, name=f"zsched serve {key_expr}", kind="zsched serve").start()
        self._queryable = session.declare_queryable(key_expr, tolerant(self._take, "request"), complete=True)

    def undeclare(self) -> None:
        """Take no more requests; those that wait are refused."""
        self._is_closed = True
        self._queryable.undeclare()
        with contextlib.suppress(queue.Full):  # then the thread sees the flag
            self._requests.put_nowait(None)

    def _take(self, query: zenoh.Query) -> None:
        try:
            self._requests.put_nowait((query, monotonic()))
            self._jobs.wake()
        except queue.Full:
            self._timer.skipped += 1
            self._later(lambda: _refuse(query, f"busy: {self._requests.maxsize} requests wait", ERROR_ENCODING))

    def _run(self) -> None:
        while True:
            taken = self._requests.get()
            if taken is None:
                return
            self._timer.waiting = self._requests.qsize()
            self._timer.least = min(self._timer.least, self._timer.waiting)
            try:
                self._answer(*taken)
            except zenoh.ZError as error:
                _log.info("an answer could not be given (%s)", error)
            if self._is_closed and self._requests.empty():
                return

    def _answer(self, query: zenoh.Query, came_s: float) -> None:
        if self._is_closed or not self._may_work():
            _refuse(query, "not owner: nothing was done", REFUSED_ENCODING)
            return
        with query:
            request = Request(
                key=str(query.key_expr),
                parameters=str(query.parameters),
                payload=query.payload,
                attachment=query.attachment,
                encoding=str(query.encoding or ""),
            )
            self._timer.begin()
            try:
                given = self._handler(request)
            except BaseException as error:  # noqa: BLE001 - the asker must hear of it, whatever it is
                self._fail(query, request, error)
                return
            finally:
                self._timer.end(came_s)
            answer = given if isinstance(given, Answer) else Answer(payload=given)
            key = self._key_expr if is_wild(request.key) else request.key
            try:
                query.reply(key, answer.payload, attachment=answer.attachment, encoding=answer.encoding)
            except zenoh.ZError:
                raise
            except Exception as error:  # noqa: BLE001 - what the handler has returned is no answer
                self._fail(query, request, error)

    def _fail(self, query: zenoh.Query, request: Request, error: BaseException) -> None:
        self._troubles.note(request.key, error)
        query.reply_err(f"failed: {type(error).__name__}: {error}"[:400], encoding=ERROR_ENCODING)

    def _may_work(self) -> bool:
        until = monotonic_s() + ROLE_WAIT_S
        while not self._is_owner():
            if monotonic_s() >= until or self._is_closed:
                return False
            threading.Event().wait(LOOK_AGAIN_S)
        return True


def _refuse(query: zenoh.Query, text: str, encoding: str) -> None:
    with query:
        query.reply_err(text, encoding=encoding)
