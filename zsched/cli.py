"""The command line `zsched`: arguments in, exit code out.

Knows: streams, exit codes. Does not know: any verb (`zsched.commands.program` has the table of them).

Exit codes: 0 fine, 1 failed, 2 usage, 3 daemon not reachable, 4 reachable but degraded (no quorum, a task without a
live owner), 5 timed out, 10 by a plan something would change, 75 the name is another machine's, 78 bad configuration.
"""

from __future__ import annotations

import atexit
import contextlib
import errno
import io
import os
import sys
from typing import Annotated, NoReturn

import typer

from zsched.commands.base.common import warn
from zsched.commands.program import Program, show_all
from zsched.core.values.exits import EXIT_FAILED

app = typer.Typer(
    name="zsched",
    cls=Program,
    epilog="Exit codes: 0 fine, 1 failed, 2 usage, 3 daemon not reachable, 4 reachable but degraded, 5 timed out, "
    "10 --plan: it would change, 75 up: the name is taken, 78 bad fleet file, 79 up: ended by `zsched leave`.",
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,  # rich costs 60 ms of import
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _show_version(is_wanted: bool) -> None:
    if is_wanted:
        from zsched import __version__  # noqa: PLC0415 - each verb imports what it needs

        typer.echo(f"zsched {__version__}")
        raise typer.Exit


@app.callback()
def program(
    version_: Annotated[
        bool,
        typer.Option("--version", help="Show the version and exit.", is_eager=True, callback=_show_version),
    ] = False,
    all_: Annotated[
        bool, typer.Option("--help-all", help="Show every verb, by noun.", is_eager=True, callback=show_all)
    ] = False,
) -> None:
    """Masterless scheduling of shared robot tasks: profile, score, vote, commit, reroute."""


UNWRITABLE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)
"""Why stdout takes no more: the disk behind ``>`` is full, or gone."""


STANDARD = ("stdin", "stdout", "stderr")
"""By their descriptors' numbers."""


def open_missing() -> None:
    """Open /dev/null for each standard stream that the caller has closed (``<&-``, some supervisors).

    Else Python has none there, and the next file or socket that is opened gets its number.
    """
    for number, name in enumerate(STANDARD):
        if getattr(sys, name) is not None:
            continue
        null = os.open(os.devnull, os.O_RDWR)
        if null != number:
            os.dup2(null, number)
            os.close(null)
        os.set_inheritable(number, True)  # `up` becomes the daemon, and others are started from here
        mode = "r" if name == "stdin" else "w"
        setattr(sys, name, open(number, mode, encoding="utf-8", closefd=False))  # noqa: SIM115 - until the end


def main() -> None:
    """The console entry point."""
    open_missing()
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # bars in a terminal without UTF-8
    code: str | int | None = EXIT_FAILED
    try:
        try:
            app(prog_name="zsched")
        except SystemExit as end:
            code = end.code
        sys.stdout.flush()
    except OSError as error:
        if error.errno not in (*UNWRITABLE, errno.EPIPE) or error.filename is not None:
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the interpreter will try once more
        if error.errno != errno.EPIPE:  # who read it has seen enough
            warn(f"zsched: the answer cannot be written: {error.strerror}; see where stdout goes")
            code = code or EXIT_FAILED
    _end(code)


def _end(code: str | int | None) -> NoReturn:
    """End the process: at once where zenoh's threads run, for the interpreter's end may abort one that waits there."""
    if "zenoh" in sys.modules and not isinstance(code, str):
        atexit._run_exitfuncs()  # noqa: SLF001 - what closes sessions
        with contextlib.suppress(OSError):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code or 0)
    sys.exit(code)


if __name__ == "__main__":
    main()
