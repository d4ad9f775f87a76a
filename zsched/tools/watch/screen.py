"""`zsched top`: asks in a thread of its own, draws on a terminal, and takes keys.

Knows: terminals, keys, intervals, exit codes. Does not know: what stands on the screen (`zsched.tools.watch.top`).
"""

from __future__ import annotations

import contextlib
import os
import queue
import re
import select
import shutil
import signal
import sys
import termios
import threading
import tty
from collections.abc import Callable, Iterator
from typing import Annotated, Final

import typer

from zsched.commands.base.ask import Door
from zsched.commands.base.common import CliError, wants_color
from zsched.commands.base.options import Asks, NoColorOption
from zsched.commands.look.status import code_of
from zsched.core.values.exits import EXIT_USAGE
from zsched.core.values.struct import Struct, replace
from zsched.host.clock import wall_s
from zsched.host.guard import guarded
from zsched.host.screen import CUT_LINES, WRAP_LINES, drawn
from zsched.tools.watch.feed import Feed, News, Past
from zsched.tools.watch.top import MIN_HEIGHT, MIN_WIDTH, Frame, render_top

ENTER, LEAVE = f"\x1b[?1049h\x1b[?25l{CUT_LINES}", f"{WRAP_LINES}\x1b[?25h\x1b[?1049l"
"""To the other screen of the terminal, without a cursor; and back to what stood there. Lines may be too wide, for a
character may take two columns."""
ENDS: Final = ("q", "Q", "\x03", "\x04")
STEPS: Final = {"\x1b[A": -1, "\x1b[B": 1, "k": -1, "j": 1, "\x1b[5~": -10, "\x1b[6~": 10}
"""{key: by how many tasks it scrolls}."""
KEYS: Final = re.compile(r"\x1b\[[0-9;]*[A-Za-z~]|.", re.DOTALL)
"""One key of those that were read at once: held down, or typed before the screen was drawn."""


class TopView(Struct, frozen=True, kw_only=True):
    """Which daemon to ask, and how to show the answer."""

    find: Callable[[], Door]
    is_plain: bool
    interval_s: float


def show_top(view: TopView, *, is_once: bool) -> int:
    """Show the fleet until ``q``, Ctrl-C or SIGTERM, or once; returns the exit code of the last answer, or of none.

    Raises:
        CliError: already the first question found nobody, or there is no terminal (2).
    """
    feed, past = Feed(view.find), Past()
    feed.door()
    first = feed.ask()
    if first.status is None:
        raise CliError(first.code, first.why)
    past.take(first)
    if not is_once and not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise CliError(
            EXIT_USAGE, "a full screen needs a terminal; print it with --once, or see `zsched status --watch`"
        )
    if is_once:
        frame = _frame(view, 0)
        width, height = max(frame.width, MIN_WIDTH), max(frame.height, MIN_HEIGHT)
        lines = render_top(past, replace(frame, width=width, height=height, is_live=False))
        sys.stdout.write("\n".join(lines) + "\n")
        return code_of(first.status)
    _live(view, feed, past)
    return past.code if past.why or past.status is None else code_of(past.status)


def _live(view: TopView, feed: Feed, past: Past) -> None:
    """Draw on every news, key and change of size, until a key ends it."""
    told: queue.SimpleQueue[News] = queue.SimpleQueue()
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    stop = threading.Event()

    def ask() -> None:
        while not stop.wait(view.interval_s):
            told.put(feed.ask())
            with contextlib.suppress(OSError):  # full of wake-ups, or closed at the end
                os.write(writing, b"n")

    asker = guarded(ask, name="zsched-top-asker")
    first_task = 0
    with _screen(writing):
        asker.start()
        try:
            while True:
                sys.stdout.write(drawn(render_top(past, _frame(view, first_task)), "\r\n"))
                sys.stdout.flush()
                ready = select.select([sys.stdin.fileno(), reading], [], [])[0]
                if reading in ready:
                    os.read(reading, 4096)
                while not told.empty():
                    past.take(told.get())
                if sys.stdin.fileno() in ready:
                    keys = KEYS.findall(os.read(sys.stdin.fileno(), 32).decode(errors="replace"))
                    if not keys or any(key in ENDS for key in keys):
                        return
                    tasks = 0 if past.status is None else len(past.status["tasks"])
                    for key in keys:
                        first_task = max(0, min(first_task + STEPS.get(key, 0), tasks - 1))
        except KeyboardInterrupt:
            return
        finally:
            stop.set()


@contextlib.contextmanager
def _screen(wake: int) -> Iterator[None]:
    """The terminal for ourselves: no echo, keys at once; as it was afterwards. A new size is written to ``wake``.

    SIGTERM is a Ctrl-C meanwhile: the default would leave the terminal to the shell as it is.
    """
    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)
    old_handler = signal.signal(signal.SIGWINCH, lambda _number, _frame: None)
    old_end = signal.signal(signal.SIGTERM, signal.default_int_handler)
    old_wake = signal.set_wakeup_fd(wake, warn_on_full_buffer=False)
    sys.stdout.write(ENTER)
    try:
        tty.setcbreak(descriptor)
        yield
    finally:
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)
        sys.stdout.write(LEAVE)
        sys.stdout.flush()
        signal.set_wakeup_fd(old_wake)
        signal.signal(signal.SIGTERM, old_end)
        signal.signal(signal.SIGWINCH, old_handler)


def _frame(view: TopView, first_task: int) -> Frame:
    columns, lines = shutil.get_terminal_size((100, 30))
    return Frame(
        width=columns,
        height=lines,
        is_colored=wants_color(view.is_plain),
        now=wall_s(),
        first_task=first_task,
        period_s=max(view.interval_s, 1.0),
    )


def top(
    asked: Asks,
    once: Annotated[bool, typer.Option("--once", help="Print one screen and exit, as status does.")] = False,
    interval: Annotated[float, typer.Option(min=0.2, max=3600.0, metavar="S", help="Seconds between two.")] = 1.0,
    no_color: NoColorOption = False,
) -> int:
    """Show the fleet on the full screen: nodes, their worth over time, streams, the last moves; q ends.

    Example: zsched top
    """
    return show_top(TopView(find=asked.door, is_plain=no_color, interval_s=interval), is_once=once)
