"""Every thread of zsched is started through here: none ends in silence.

Knows: what happens when a thread's function raises. Does not know: what threads do.

An exception, a `SystemExit` too (a thread of Python's own ends by it without a word), is logged with its stack,
counted under the thread's name, and reported to `on_failure` (the daemon and the relay show it in `status`). A thread
that serves as long as its process lives (``is_lasting``) then begins again, after a pause that doubles while it keeps
failing; one that has a single errand ends. What has not failed again for ten minutes is no problem any more (`calmed`);
its log line and its count stay.
"""

from __future__ import annotations

import contextlib
import logging
import os
import sys
import threading
from collections import Counter
from collections.abc import AsyncGenerator, Callable, Coroutine, Generator
from functools import partial
from pathlib import Path
from typing import Any, Final, NoReturn, TypeVar

from zsched.core.values.exits import EXIT_FAILED, EXIT_OK
from zsched.host.clock import monotonic_s

PAUSE_S: Final = 0.1
MAX_PAUSE_S: Final = 5.0
CALM_S: Final = 60.0
"""A thread that has run for this long fails for the first time again."""

TOLD_S: Final = 600.0
"""A failure is told for so long, if no other one of its kind follows."""
NAME_BYTES: Final = 15
"""The kernel keeps this much of a thread's name."""

T = TypeVar("T")

_log = logging.getLogger("zsched.guard")

failures: Counter[str] = Counter()
"""{kind of thread: how often one has failed} of this process."""

_failed_at: dict[str, float] = {}
"""{kind: when one failed last}, as long as that is told."""
_listeners: list[Callable[[str, str], None]] = []


def on_failure(listener: Callable[[str, str], None]) -> None:
    """Have ``listener(kind, text)`` called, in the failing thread, whenever a thread of this process fails."""
    _listeners[:] = [listener]


def guarded(
    run: Callable[..., object], *args: Any, name: str, kind: str = "", is_lasting: bool = True
) -> threading.Thread:
    """A thread for ``run(*args)``, not started yet; it does not keep the process alive.

    Args:
        run: its function.
        args: for it.
        name: of the thread.
        kind: what failures are counted under, where ``name`` holds a key or a task.
        is_lasting: ``run`` returns only when it is meant to end, and may be called again when it has raised.
    """
    begin = partial(_run, partial(run, *args), kind or name, is_lasting=is_lasting)
    return threading.Thread(target=_named, args=(name, begin), name=name, daemon=True)


def ends_within(limit_s: float, run: Callable[..., object], *args: Any, name: str) -> bool:
    """Run what may hang in a thread of its own; whether it has ended in time. If not, it goes on without us."""
    thread = guarded(run, *args, name=name, is_lasting=False)
    thread.start()
    thread.join(limit_s)
    return not thread.is_alive()


def end_with(main: Callable[[], object]) -> NoReturn:
    """Run a program, and end the process with its code, or with that of a failure, whatever it raises.

    Zenoh's threads are not waited for: the interpreter would wait for ever, and the process live on without its socket.
    What zenoh raises when it panics is no `Exception`.
    """
    code: object = EXIT_FAILED
    try:
        code = main()
    except SystemExit as error:
        code = error.code or EXIT_OK
    except BaseException as error:  # noqa: BLE001 - it ends with the process
        _log.critical("the process ends: %s: %s", type(error).__name__, error, exc_info=True)
    with contextlib.suppress(OSError, ValueError):
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(code if isinstance(code, int) else EXIT_FAILED)


def tolerant(callback: Callable[[T], object], kind: str) -> Callable[[T], None]:
    """``callback`` for one of zenoh's threads: what it raises is noted (zenoh would print every one, without limit)."""

    def call(value: T) -> None:
        try:
            callback(value)
        except BaseException as error:  # noqa: BLE001 - one frame must not end what follows it, nor fill the log
            note(kind, error)

    return call


def call_plain(callback: Callable[[T], object], value: T) -> None:
    """Call what an author has given, in a thread without an event loop.

    Raises:
        TypeError: it is an ``async def`` or a generator function, of which nothing runs by being called.
    """
    returned = callback(value)
    if returned is None or not isinstance(returned, Coroutine | Generator | AsyncGenerator):
        return
    if isinstance(returned, Coroutine):
        returned.close()  # else Python warns that nobody has awaited it
    raise TypeError("a callback must be a plain function: of an async def or a generator function nothing runs here")


def _named(name: str, begin: Callable[[], None]) -> None:
    """Tell the kernel the thread's name, for `top -H` and other tools that show what a process costs."""
    with contextlib.suppress(OSError):
        Path(f"/proc/self/task/{threading.get_native_id()}/comm").write_bytes(name.encode()[:NAME_BYTES])
    begin()


def _run(run: Callable[[], object], kind: str, *, is_lasting: bool) -> None:
    pause_s = PAUSE_S
    while True:
        began_at = monotonic_s()
        try:
            run()
        except BaseException as error:  # noqa: BLE001 - whatever it is, it must not end in silence
            note(kind, error)
        else:
            return
        if not is_lasting:
            return
        if monotonic_s() - began_at > CALM_S:
            pause_s = PAUSE_S
        threading.Event().wait(pause_s)
        pause_s = min(2 * pause_s, MAX_PAUSE_S)


def note(kind: str, error: BaseException) -> None:
    """Log, count and tell that something in a thread has failed."""
    failures[kind] += 1
    _failed_at[kind] = monotonic_s()
    _log.error("thread %s failed (%d times so far)", kind, failures[kind], exc_info=error)
    text = f"a thread failed ({failures[kind]} times), last with {type(error).__name__}: {error}"[:400]
    for listener in _listeners:
        try:
            listener(kind, text)
        except Exception:  # noqa: BLE001 - who tells must not make it worse
            _log.exception("a failure could not be told")


def calmed(now: float) -> tuple[str, ...]:
    """Kinds of which none has failed for `TOLD_S`, each once: who was told of them may be told that it is over."""
    over = []
    for kind, at in tuple(_failed_at.items()):
        if now - at >= TOLD_S and _failed_at.get(kind) == at:  # else it has failed again meanwhile
            del _failed_at[kind]
            over.append(kind)
    return tuple(over)
