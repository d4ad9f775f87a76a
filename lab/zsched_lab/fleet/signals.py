"""What the lab's processes do with the signals that ask them to stop.

Knows: SIGINT, SIGTERM, SIGHUP. Does not know: what is to be stopped.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from zsched.host.guard import guarded

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
LOOK_AGAIN_S = 0.2
"""So often it is looked whether a stop signal's exception was dropped by the code that it hit."""


class StopFlag:
    """Set by the first stop signal; its holder looks between two pieces of work."""

    def __init__(self) -> None:
        self.is_set = False

    def install(self) -> None:
        """Route the stop signals here (main thread only)."""
        for number in STOP_SIGNALS:
            signal.signal(number, self._stop)

    def _stop(self, number: int, frame: object) -> None:
        del number, frame
        self.is_set = True


class Interrupted(BaseException):
    """A stop signal arrived; not an `Exception`, so that nobody takes it for a failure and goes on."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


@contextmanager
def interruptible() -> Iterator[None]:
    """Raise `Interrupted` at the first stop signal, once: further ones cannot cut the clean-up.

    The exception may come up inside foreign code that drops it: compiled modules do while they are imported (numpy's
    registering of a class, for one), and so does every ``__del__``. It is therefore raised again until it is seen.
    Main thread only.
    """
    raised: list[Interrupted] = []
    done = threading.Event()

    def interrupt(number: int, frame: object) -> None:
        del frame
        if not raised:
            raised.append(Interrupted(number))
            reminder.start()
        elif is_handled(raised[0]):
            return
        raise raised[0]

    def remind() -> None:
        while not done.wait(LOOK_AGAIN_S):
            signal.pthread_kill(main, raised[0].number)

    main = threading.get_ident()
    reminder = guarded(remind, name="reminder", is_lasting=False)
    before = {number: signal.signal(number, interrupt) for number in STOP_SIGNALS}
    try:
        yield
    finally:
        done.set()
        if raised:
            reminder.join()  # its last signal must not meet the handlers of before
        for number, handler in before.items():
            signal.signal(number, handler)


def is_handled(error: BaseException) -> bool:
    """Whether a clean-up or an ``except`` that ``error`` led to is running in the caller's thread."""
    handled = sys.exception()
    while handled is not None and handled is not error:
        handled = handled.__context__
    return handled is not None
