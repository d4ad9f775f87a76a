"""`zsched status`: asks once or again and again, and prints what the daemon answers.

Knows: terminals, intervals, exit codes. Does not know: what a status looks like (`zsched.report`).
"""

from __future__ import annotations

import shutil
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from zsched.cli_ask import Door, ask_door, find_door
from zsched.cli_common import EXIT_DEGRADED, EXIT_OK, CliError, Json, print_json, wants_color
from zsched.report_text import degradations, render_status

MIN_WIDTH, DEFAULT_WIDTH, MAX_WIDTH = 60, 100, 160
HOME, CLEAR, REST_OF_LINE, REST_OF_SCREEN = "\x1b[H", "\x1b[2J", "\x1b[K", "\x1b[J"


@dataclass(frozen=True, slots=True, kw_only=True)
class StatusView:
    """Whom to ask and how to show it."""

    runtime_dir: Path | None
    node: str | None
    is_json: bool
    is_plain: bool


def show(view: StatusView) -> int:
    """Print one status; returns the exit code."""
    status = _ask(find_door(view.runtime_dir, view.node))
    if view.is_json:
        print_json(status)
    else:
        sys.stdout.write(render_status(status, _width(), wants_color(view.is_plain)))
    return _code(status)


def watch_on(view: StatusView, interval_s: float) -> int:
    """Print a status every ``interval_s`` until Ctrl-C; a daemon that goes away is waited for.

    Returns the exit code of the last status.

    Raises:
        CliError: already the first question found nobody.
    """
    door, code = find_door(view.runtime_dir, view.node), EXIT_OK
    status: Json | None = _ask(door)
    screen = sys.stdout.isatty() and not view.is_json
    if screen:
        sys.stdout.write(CLEAR)
    try:
        while True:
            if status is not None:
                code = _code(status)
                _print_next(view, status, screen)
            time.sleep(interval_s)
            status = _ask_again(door)
    except KeyboardInterrupt:
        return code


def _ask_again(door: Door) -> Json | None:
    try:
        return _ask(door)
    except CliError as error:
        print(f"zsched status: {error}", file=sys.stderr)
        return None


def _print_next(view: StatusView, status: Json, screen: bool) -> None:
    if view.is_json:
        print_json(status, is_line=True)
        return
    text = render_status(status, _width(), wants_color(view.is_plain))
    sys.stdout.write(_fitted(text) if screen else f"{text}\n")
    sys.stdout.flush()


def _fitted(text: str) -> str:
    """The text from the top of the screen, cut to its height; what was there before is overwritten, not cleared."""
    height = shutil.get_terminal_size((DEFAULT_WIDTH, 30)).lines
    lines = text.splitlines()
    if len(lines) > height:
        hidden = len(lines) - height + 1
        lines = [*lines[: height - 1], f"... {hidden} more lines: a higher window shows them"]
    return HOME + f"{REST_OF_LINE}\n".join(lines) + REST_OF_LINE + REST_OF_SCREEN


def _ask(door: Door) -> Json:
    return ask_door(door, {"verb": "status"})


def _code(status: Json) -> int:
    return EXIT_DEGRADED if degradations(status) else EXIT_OK


def _width() -> int:
    return max(MIN_WIDTH, min(shutil.get_terminal_size((DEFAULT_WIDTH, 30)).columns, MAX_WIDTH))
