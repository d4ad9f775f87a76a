"""Threads that fail are told, counted and begin again; no line is logged without limit."""

from __future__ import annotations

import ast
import logging
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import zsched
from zsched.host import guard
from zsched.host.guard import ends_within, guarded
from zsched.host.log_limit import LIBRARY, MAX_PLACES, LogLimit, PlainLines, limit_library
from zsched.host.log_limit import LIMIT as SHARED

PACKAGE = Path(zsched.__file__).parent
LAB = PACKAGE.parent / "lab" / "zsched_lab"


@pytest.fixture
def told() -> Iterator[list[tuple[str, str]]]:
    """What the guard tells of this test's threads; threads of the tests before it may have failed."""
    guard.failures.clear()
    guard._failed_at.clear()
    heard: list[tuple[str, str]] = []
    before = tuple(guard._listeners)
    guard.on_failure(lambda kind, text: heard.append((kind, text)))
    yield heard
    guard._listeners[:] = before
    guard.failures.clear()
    guard._failed_at.clear()


EXAMPLES = PACKAGE / "tools" / "examples"


def wait(condition: Callable[[], bool], timeout_s: float = 10.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_a_failure_is_over_once_none_of_its_kind_has_followed_for_a_while(told: list[tuple[str, str]]) -> None:
    for kind in ("one", "two"):
        guard.note(kind, OSError("broken"))
    began = time.monotonic()
    assert guard.calmed(began + guard.TOLD_S - 60.0) == ()
    assert guard.calmed(began + guard.TOLD_S + 60.0) == ("one", "two")
    assert guard.calmed(began + guard.TOLD_S + 60.0) == (), "each once"
    guard.note("one", OSError("broken"))
    assert guard.calmed(time.monotonic() + guard.TOLD_S + 60.0) == ("one",)
    assert guard.failures["one"] == 2, "its count stays"
    assert len(told) == 3


def test_every_thread_is_started_by_the_guard() -> None:
    """Whoever makes a thread by hand makes one that may end in silence."""
    makers = {"Thread", "Timer", "start_new_thread"}
    found = []
    for path in (*sorted(PACKAGE.rglob("*.py")), *sorted(LAB.rglob("*.py"))):
        if path.name == "guard.py":
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call):
                continue
            name = node.func
            called = name.attr if isinstance(name, ast.Attribute) else name.id if isinstance(name, ast.Name) else ""
            if called in makers:
                found.append(f"{path.name}:{node.lineno}")
    assert found == []


def test_every_callback_of_zenoh_is_tolerant() -> None:
    """What a callback raises in zenoh's thread is printed by zenoh every time, and told to nobody."""
    found = [
        f"{path.relative_to(PACKAGE)}:{handler.lineno}"
        for path in sorted(PACKAGE.rglob("*.py"))
        if EXAMPLES not in path.parents  # programs of a user's own, which import nothing of zsched's inside
        for scope in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(scope, ast.FunctionDef)
        for handler in handlers_in(scope)
        if not is_tolerant(handler, scope)
    ]
    assert found == []


def handlers_in(scope: ast.FunctionDef) -> list[ast.expr]:
    """What is given to zenoh in a function, to be called or filled by it."""
    found = []
    for node in ast.walk(scope):
        if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)):
            continue
        first = {"declare_subscriber": 1, "declare_queryable": 1, "declare_matching_listener": 0, "Callback": 0}
        place = first.get(node.func.attr)
        if place is not None:
            found += [*node.args[place : place + 1], *(word.value for word in node.keywords if word.arg == "handler")]
    return found


def is_tolerant(handler: ast.expr, scope: ast.FunctionDef) -> bool:
    """A channel, or a callback in the guard's hands; a name is what the same function has made of it."""
    if isinstance(handler, ast.Name):
        made = [node for node in ast.walk(scope) if isinstance(node, (ast.Assign, ast.AnnAssign))]
        values = [node.value for node in made if handler.id in ast.unparse(node).partition("=")[0]]
        return bool(values) and all(value is not None and is_tolerant(value, scope) for value in values)
    called = ast.unparse(handler.func) if isinstance(handler, ast.Call) else ""
    return called == "tolerant" or called.startswith("zenoh.handlers.")


@pytest.mark.parametrize(
    ("line", "is_seen"),
    [
        ("session.declare_subscriber(key, self._hear)", True),
        ("session.declare_subscriber(key, tolerant(self._hear, 'put'))", False),
        ("session.declare_subscriber(key, zenoh.handlers.RingChannel(4))", False),
        ("session.declare_queryable(key, lambda query: None, complete=True)", True),
        ("session.liveliness().declare_subscriber(key, handler=partial(self._hear, 1))", True),
        ("publisher.declare_matching_listener(self._wake)", True),
        ("session.get(key, zenoh.handlers.Callback(self._take, lambda: None))", True),
        ("hear = self._hear; session.declare_subscriber(key, hear)", True),
        ("hear = tolerant(self._hear, 'put'); session.declare_subscriber(key, hear)", False),
    ],
)
def test_a_bare_callback_is_seen(line: str, is_seen: bool) -> None:
    (scope,) = ast.parse(f"def run(self): {line}").body
    assert isinstance(scope, ast.FunctionDef)
    assert any(not is_tolerant(handler, scope) for handler in handlers_in(scope)) is is_seen


def test_a_lasting_thread_that_fails_is_told_and_begins_again(told: list[tuple[str, str]]) -> None:
    calls: list[int] = []

    def run(number: int) -> None:
        calls.append(number)
        if len(calls) < 3:
            raise KeyError("a bug")

    thread = guarded(run, 7, name="one of many", kind="many")
    thread.start()
    thread.join(60)
    assert not thread.is_alive()
    assert calls == [7, 7, 7]
    assert guard.failures["many"] == 2
    assert told == [
        ("many", "a thread failed (1 times), last with KeyError: 'a bug'"),
        ("many", "a thread failed (2 times), last with KeyError: 'a bug'"),
    ]


def test_a_lasting_thread_that_calls_exit_is_told_and_begins_again(told: list[tuple[str, str]]) -> None:
    """Python's own threads end by a `SystemExit` without a word."""
    calls: list[int] = []

    def run() -> None:
        calls.append(1)
        if len(calls) == 1:
            sys.exit(3)

    thread = guarded(run, name="leaving")
    thread.start()
    thread.join(60)
    assert not thread.is_alive()
    assert len(calls) == 2
    assert told == [("leaving", "a thread failed (1 times), last with SystemExit: 3")]


@pytest.mark.parametrize("error", [ValueError("no"), SystemExit(3)])
def test_an_errand_that_fails_is_told_and_ends(told: list[tuple[str, str]], error: BaseException) -> None:
    def run() -> None:
        raise error

    thread = guarded(run, name="errand", is_lasting=False)
    thread.start()
    thread.join(60)
    assert not thread.is_alive()
    assert [kind for kind, _ in told] == ["errand"]


def test_a_thread_that_fails_at_once_does_not_spin(told: list[tuple[str, str]]) -> None:
    stop = threading.Event()

    def run() -> None:
        if not stop.is_set():
            raise ValueError("no")

    thread = guarded(run, name="spinning")
    thread.start()
    time.sleep(0.5)
    assert 1 <= len(told) <= 10  # 3 or 4, and a few more on a busy machine; thousands without a pause
    stop.set()
    thread.join(60)
    assert not thread.is_alive()


def test_what_a_callback_raises_in_zenoh_s_thread_is_told_and_the_next_one_comes(told: list[tuple[str, str]]) -> None:
    heard: list[int] = []

    def hear(number: int) -> None:
        heard.append(10 // number)

    callback = guard.tolerant(hear, "put")
    for number in (1, 0, 5):
        callback(number)
    assert heard == [10, 2]
    assert [kind for kind, _ in told] == ["put"]


def test_a_listener_that_fails_itself_changes_nothing(told: list[tuple[str, str]]) -> None:
    def bad(_kind: str, _text: str) -> None:
        raise OSError("no")

    guard.on_failure(bad)
    guard.note("x", ValueError("y"))
    assert guard.failures["x"] == 1
    assert told == []


# --- log lines -------------------------------------------------------------------------------------------------------


class Lines(logging.Handler):
    """Keeps what is logged."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(record.getMessage())


def logger_with(limit: LogLimit, name: str) -> tuple[logging.Logger, Lines]:
    log, lines = logging.getLogger(name), Lines()
    log.propagate = False
    log.setLevel(logging.INFO)
    lines.addFilter(limit)
    log.handlers = [lines]
    return log, lines


def test_a_line_that_repeats_is_cut_and_the_rest_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr("zsched.host.log_limit.monotonic_s", lambda: now[0])
    log, lines = logger_with(LogLimit(burst=3.0, rate_hz=1.0), "zsched.test.repeats")

    def storm(count: int) -> None:
        for number in range(count):
            log.info("sample %d", number)

    storm(1000)
    assert lines.lines == ["sample 0", "sample 1", "sample 2"]
    log.info("another place is not held up")
    now[0] += 1.0
    storm(10)
    assert lines.lines[3:] == ["another place is not held up", "sample 0 [997 more from here were left out]"]


def test_no_text_of_a_line_begins_another_line_or_commands_a_terminal() -> None:
    reason = "new fan\n2026-11-24 INFO zsched.vote forged\r\x1b[2J\u2028\x85"
    record = logging.LogRecord("zsched.vote", logging.INFO, "file", 1, "drained: %s", (reason,), None)
    first, second = PlainLines("%(levelname)s %(name)s %(message)s").format(record).split("\n")
    assert first == "INFO zsched.vote drained: new fan"
    assert second == "  2026-11-24 INFO zsched.vote forged??[2J??"


def test_a_traceback_stays_readable() -> None:
    try:
        int("one\ntwo")
    except ValueError:
        record = logging.LogRecord("x", logging.ERROR, "file", 1, "failed", None, sys.exc_info())
    lines = PlainLines("%(message)s").format(record).splitlines()
    assert lines[:2] == ["failed", "  Traceback (most recent call last):"]
    assert lines[-1].startswith("  ValueError: ")
    assert all(line.startswith("  ") for line in lines[1:])


def test_what_is_remembered_of_places_is_bounded() -> None:
    limit = LogLimit()
    for number in range(3 * MAX_PLACES):
        limit.filter(logging.LogRecord("x", logging.INFO, f"file{number}", 1, "m", None, None))
    assert len(limit._places) == MAX_PLACES


def test_the_library_s_loggers_are_limited() -> None:
    """Every logger that a worker's process can reach, for its handlers are not ours."""
    limit_library()
    assert all(SHARED in logging.getLogger(name).filters for name in LIBRARY)
    names = set()
    single = (PACKAGE / "link" / "sessions" / "send_queue.py", PACKAGE / "host" / "guard.py")
    for path in (*PACKAGE.glob("worker/*.py"), *PACKAGE.glob("hop/*.py"), *single):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "getLogger":
                names |= {one.value for one in node.args if isinstance(one, ast.Constant)}
    assert names <= set(LIBRARY)


def test_a_record_that_passes_two_filters_is_counted_once() -> None:
    limit = LogLimit(burst=2.0, rate_hz=0.0)
    log, lines = logger_with(limit, "zsched.test.twice")
    log.addFilter(limit)
    for _ in range(5):
        log.info("m")
    assert len(lines.lines) == 2


def test_what_hangs_is_not_waited_for_longer_than_its_time() -> None:
    hanging = threading.Event()
    try:
        assert ends_within(5.0, lambda: None, name="short")
        began_at = time.monotonic()
        assert not ends_within(0.05, hanging.wait, name="long")
        assert 0.05 <= time.monotonic() - began_at < 5.0
    finally:
        hanging.set()
