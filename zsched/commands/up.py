"""`zsched up`: the process becomes this machine's daemon.

Knows: the daemon's own options, the signals that wait for it. Does not know: what a daemon does.
"""

from __future__ import annotations

import os
import signal
import sys
from enum import StrEnum
from typing import Annotated, Final, NoReturn

import typer

from zsched.commands.base.here import need_file, own_name
from zsched.commands.base.options import Machine
from zsched.host import paths as places

STOP_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)


class LogLevel(StrEnum):
    """How much the daemon says on stderr."""

    DEBUG = "DEBUG"
    INFO = "INFO"
    WARNING = "WARNING"
    ERROR = "ERROR"


def up(
    here: Machine,
    log_level: Annotated[LogLevel, typer.Option("--log-level", help="What goes to stderr.")] = LogLevel.INFO,
) -> NoReturn:
    """Run this machine's daemon in the foreground (what systemd runs).

    Example: sudo zsched up
    """
    file = places.config_path(here.config, os.environ)
    need_file(file)
    name = own_name(here.node)
    state = places.state_folder(here.state_dir, os.environ)
    runtime = places.runtime_folder(here.runtime_dir, os.environ)
    daemon = [sys.executable, "-P", "-m", "zsched.daemon", "--config", str(file), "--node", name]
    daemon += ["--state-dir", str(state), "--runtime-dir", str(runtime), "--log-level", log_level.value]
    sys.stdout.flush()
    sys.stderr.flush()
    signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)  # the daemon takes what comes while it loads, see there
    # the same process id (systemd's main process), without this command line's memory
    os.execv(sys.executable, daemon)  # noqa: S606 - no shell is wanted
