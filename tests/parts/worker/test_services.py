"""A worker's service by itself: what its asker and its node hear of a handler's faults."""

from __future__ import annotations

from collections.abc import Callable
from threading import Event
from typing import Any

import pytest
import zenoh

from support.waiting import until
from zsched.core.values.relay_protocol import ERROR_ENCODING
from zsched.link.sessions.config import data_config
from zsched.worker.jobs import JobBook
from zsched.worker.services import Request, Service
from zsched.worker.troubles import Troubles

KEY = "edge1/t/robot1/job"


def serve(
    session: zenoh.Session, handle: Callable[[Request], Any], troubles: Troubles, jobs: JobBook, *, depth: int
) -> Service:
    """The owner's service under `KEY`."""
    return Service(
        session,
        KEY,
        handle,
        is_owner=lambda: True,
        later=lambda call: call(),
        troubles=troubles,
        jobs=jobs,
        depth=depth,
    )


@pytest.mark.parametrize("first", [{}, SystemExit(3)])
def test_what_is_no_answer_is_the_handler_s_failure_and_the_next_request_is_answered(first: object) -> None:
    """The thread ended by it and began again, later each time; the asker heard nothing, and neither did the node."""
    told: list[tuple[int, str]] = []
    given: list[Any] = [first, b"done"]

    def handle(_request: Request) -> bytes:
        answer: bytes | SystemExit = given.pop(0)
        if isinstance(answer, SystemExit):
            raise answer
        return answer

    troubles = Troubles(lambda count, text: told.append((count, text)))
    jobs = JobBook("t", "1", lambda _jobs: None, None)
    with zenoh.open(zenoh.Config.from_json5(data_config(listen=(), connect=()))) as session:
        service = serve(session, handle, troubles, jobs, depth=2)
        (failed,) = session.get(KEY, timeout=20.0)
        assert failed.err is not None
        kind = "SystemExit" if isinstance(first, SystemExit) else "TypeError"
        assert failed.err.payload.to_string().startswith(f"failed: {kind}: ")
        assert str(failed.err.encoding) == ERROR_ENCODING
        until(lambda: told, "the node hears of it")
        assert told[0][0] == 1
        (answered,) = session.get(KEY, timeout=20.0)
        assert answered.ok is not None
        assert answered.ok.payload.to_bytes() == b"done"
        service.undeclare()
    troubles.close()
    jobs.close()


def test_requests_behind_one_that_hangs_are_told_as_waiting() -> None:
    troubles, jobs, go_on = Troubles(lambda _count, _text: None), JobBook("t", "1", lambda _jobs: None), Event()

    def handle(_request: Request) -> bytes:
        go_on.wait(60)
        return b"done"

    with zenoh.open(zenoh.Config.from_json5(data_config(listen=(), connect=()))) as session:
        service = serve(session, handle, troubles, jobs, depth=4)
        answers = [session.get(KEY, timeout=20.0) for _ in range(3)]
        try:
            until(lambda: jobs.report().waiting == 2, "two wait behind the first")
            assert jobs.report().waiting == 2, "however often it is told"
        finally:
            go_on.set()
        assert [reply.ok is not None for answer in answers for reply in answer] == [True] * 3
        service.undeclare()
    troubles.close()
    jobs.close()
