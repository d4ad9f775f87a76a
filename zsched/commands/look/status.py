"""`zsched status`: asks once or again and again, and prints what the daemon answers.

Knows: terminals, intervals, exit codes. Does not know: what a status looks like (`zsched.core.values.report`).
"""

from __future__ import annotations

import shutil
import sys
import time
from collections.abc import Callable
from typing import Annotated

import typer

from zsched.commands.base.ask import Door, ask_door
from zsched.commands.base.common import CliError, Json, print_json, wants_color, warn
from zsched.commands.base.options import Answers, NoColorOption
from zsched.commands.base.page import page_width
from zsched.commands.base.report import TROUBLES, degradations, render_brief, render_status
from zsched.core.values.exits import EXIT_DEGRADED, EXIT_FAILED, EXIT_OK, EXIT_USAGE
from zsched.host.clock import wall_ns
from zsched.host.screen import CUT_LINES, WRAP_LINES, drawn, fitted

MAJOR = "1"
"""Of the status's schema: within it fields are only added."""
CLEAR = "\x1b[2J"


def status(
    asked: Answers,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="All six stages, not only a line per task.")] = False,
    watch: Annotated[bool, typer.Option("--watch", "-w", help="Again and again; with --json one line each.")] = False,
    interval: Annotated[float, typer.Option(min=0.1, max=3600.0, metavar="S", help="Seconds between two.")] = 1.0,
    site: Annotated[bool, typer.Option("--site", help="A line for each fleet of the site, with --json only.")] = False,
    no_color: NoColorOption = False,
) -> int:
    """Show nodes, tasks, owners and what is wrong; with -v also decisions, votes and streams.

    Example: zsched status -v

    Exits with 4 while the fleet is degraded: no quorum, or a task without a live owner. With --site it asks the fleets
    under `site:` in the document, or in the fleet file, and one that does not answer is degraded, too.
    """
    if site:
        from zsched.commands.look.cells import show_site  # noqa: PLC0415 - only a site has them

        if verbose or watch:
            raise CliError(EXIT_USAGE, "--site shows a line for each fleet; leave out -v and --watch")
        return show_site(asked)
    door, render = asked.door(), render_status if verbose else render_brief

    def text(status: Json) -> str:
        return render(status, page_width(), wants_color(no_color), wall_ns() / 1e9)

    status = ask_status(door)
    if watch:
        return _watch_on(door, status, interval, None if asked.json_ else text)
    if asked.json_:
        print_json(_with_reasons(status))
    else:
        sys.stdout.write(text(status))
    return code_of(status)


def _watch_on(door: Door, status: Json, interval_s: float, text: Callable[[Json], str] | None) -> int:
    """Print a status every ``interval_s`` until Ctrl-C; a daemon that goes away meanwhile is waited for.

    ``text``: for people; ``None``: lines of JSON. Returns the exit code of the last status.
    """
    is_screen = sys.stdout.isatty() and text is not None
    code = code_of(status)
    try:
        sys.stdout.write(CLEAR if is_screen else "")
        _print_next(status, text, is_screen=is_screen)
        while True:
            time.sleep(interval_s)
            try:
                status = ask_status(door)
            except CliError as error:
                code, why = error.code, f"zsched status: {error}"
                if is_screen:
                    _draw(fitted(f"{why}\nasking again until Ctrl-C\n", sys.stdout))
                else:
                    warn(why)
            else:
                code = code_of(status)
                _print_next(status, text, is_screen=is_screen)
    except KeyboardInterrupt:
        sys.stdout.write("\n" if is_screen else "")
        return code


def _print_next(status: Json, text: Callable[[Json], str] | None, *, is_screen: bool) -> None:
    if text is None:
        print_json(_with_reasons(status), is_line=True)
    elif is_screen:
        _draw(text(status))
    else:
        sys.stdout.write(f"{text(status)}\n")
        sys.stdout.flush()


def _draw(text: str) -> None:
    """Who stops us between two pictures has the terminal as it was."""
    sys.stdout.write(f"{CUT_LINES}{_fitted(text)}{WRAP_LINES}")
    sys.stdout.flush()


def _fitted(text: str) -> str:
    """The text from the top of the screen, fitted to its height; what was there is overwritten, so nothing flickers.

    Of a text that is too high the problems stay, at most in the lower half, with a count of those that have no room.
    """
    height = shutil.get_terminal_size((100, 30)).lines
    lines = text.splitlines()
    if len(lines) > height:
        last = next((at for at, line in enumerate(lines) if TROUBLES in line[:20]), len(lines))
        last -= last < len(lines) and lines[last - 1] == ""
        tail, most = lines[last:], height // 2
        if len(tail) > most:
            tail = [*tail[: most - 1], f"... {len(tail) - most + 1} more lines of problems: a higher window shows them"]
        room = height - 1 - len(tail)
        note = f"... {max(last - room, 0)} more lines: a higher window shows them"
        lines = [*lines[: min(room, last)], note, *tail]
    return drawn(lines)


def ask_status(door: Door) -> Json:
    """The status of the node behind a door.

    Raises:
        CliError: nobody answers (3), not in time (5), or in words of another major version (1).
    """
    status = ask_door(door, {"verb": "status"})
    if str(status.get("schema")).partition("/")[2].partition(".")[0] != MAJOR:
        found = status.get("schema")
        text = f"the daemon's status is {found!r}, this zsched reads zsched.status/{MAJOR}; update the older of the two"
        raise CliError(EXIT_FAILED, text)
    return status


def _with_reasons(status: Json) -> Json:
    """The daemon's answer, and why the exit code says that the fleet is degraded."""
    return {**status, "degraded": list(degradations(status))}


def code_of(status: Json) -> int:
    """The exit code that tells how the fleet is: 0, or 4 while it is degraded."""
    return EXIT_DEGRADED if degradations(status) else EXIT_OK
