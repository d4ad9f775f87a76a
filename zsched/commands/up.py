"""`zsched up`: the process becomes this machine's daemon.

Knows: the daemon's own options, the signals that wait for it. Does not know: what a daemon does.
"""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path
from typing import Final, NoReturn

from zsched import paths as places
from zsched.commands.here import need_file, own_name

STOP_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)


def become_daemon(
    config: Path | None, node: str | None, state_dir: Path | None, runtime_dir: Path | None, log_level: str
) -> NoReturn:
    """Run the daemon in this process, whose memory of the command line goes.

    Raises:
        CliError: the fleet file cannot be read, or the node's name is none.
    """
    file = places.config_path(config, os.environ)
    need_file(file)
    name = own_name(node)
    state = places.state_folder(state_dir, os.environ)
    runtime = places.runtime_folder(runtime_dir, os.environ)
    daemon = [sys.executable, "-P", "-m", "zsched.daemon", "--config", str(file), "--node", name]
    daemon += ["--state-dir", str(state), "--runtime-dir", str(runtime), "--log-level", log_level]
    sys.stdout.flush()
    sys.stderr.flush()
    signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)  # the daemon takes what comes while it loads, see there
    # the same process id (systemd's main process), without this command line's memory
    os.execv(sys.executable, daemon)  # noqa: S606 - no shell is wanted
