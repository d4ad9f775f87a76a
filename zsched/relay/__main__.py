"""Starts the relay process: its socket and its daemon's greeting first, thread pools then, zenoh afterwards.

Knows: the command line, signals, how long a relay is without a daemon. Does not know: streams.

``python -m zsched.relay --socket PATH``; everything else it hears from the daemon that comes to the socket. Logs go to
stderr. It ends when its daemon says so, at SIGTERM, and when no daemon has come for `ALONE_S`.
"""

from __future__ import annotations

import argparse
import faulthandler
import os
import signal
from pathlib import Path
from typing import Final

from zsched.core.values.exits import EXIT_FAILED, EXIT_OK
from zsched.host.guard import end_with
from zsched.host.heap import share_heaps
from zsched.host.log_limit import log_to_stderr
from zsched.link.sessions.config import relay_pools
from zsched.relay.visits import RefusedError, Visits

ALONE_S: Final = 60.0
"""How long streams run on without a daemon: it begins anew within this time, however slow the machine is."""


def main() -> int:
    """Run the relay; the exit code: 0 it was told to end, or nobody came; 1 another relay is needed, or it failed."""
    parser = argparse.ArgumentParser(prog="python -m zsched.relay", description="zsched's data plane")
    parser.add_argument("--socket", required=True, type=Path, help="where daemons come")
    parser.add_argument("--log-level", default="WARNING")
    arguments = parser.parse_args()
    log_to_stderr(arguments.log_level, "%(name)s %(levelname)s %(message)s")
    share_heaps()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of a terminal: the daemon ends us
    signal.signal(signal.SIGTERM, _stop)
    faulthandler.enable()
    faulthandler.register(signal.SIGUSR1)  # where every thread stands, for the reader of the journal
    visits = Visits(arguments.socket)
    try:
        daemon = visits.next_daemon(ALONE_S)
        if daemon is None:
            return EXIT_OK
        hello = daemon.hello
        os.environ["ZENOH_RUNTIME"] = relay_pools(hello.threads + hello.spare_threads)  # read once, when zenoh starts
        from zsched.relay.process import run  # noqa: PLC0415 - imports zenoh, which must find ZENOH_RUNTIME set

        return run(visits, daemon, ALONE_S)
    except RefusedError:
        return EXIT_FAILED
    finally:
        visits.close()


def _stop(_signal: int, _frame: object) -> None:
    raise SystemExit(EXIT_OK)


if __name__ == "__main__":
    end_with(main)
