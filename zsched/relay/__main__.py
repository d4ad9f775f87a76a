"""Starts the relay process: thread pools first, zenoh afterwards.

Knows: the command line, signals, the parent's death. Does not know: streams.

``python -m zsched.relay --fleet F --node N [--threads T] [--parent PID] [--local]``; the first frame on stdin is
the zenoh session as JSON (with ``--local`` the second one is that of the host's own side). Logs go to stderr.
With ``--books PATH`` its counters go on from those of the relay before.
With ``--door FD --orphan S`` it outlives its daemon for S seconds and obeys the next one that comes through the door;
without, it dies with its parent.
"""

from __future__ import annotations

import argparse
import ctypes
import faulthandler
import os
import signal
import sys
from pathlib import Path

from zsched.guard import end_with
from zsched.heap import share_heaps
from zsched.ipc.protocol import RelayHello
from zsched.log_limit import log_to_stderr
from zsched.sessions.config import relay_pools

PR_SET_PDEATHSIG = 1
DEFAULT_THREADS = 6
STOP_S = 2.0
"""A daemon that stops hands its tasks over first, and its robot's streams must run until then."""


def main() -> int:
    """Run the relay; the exit code."""
    arguments = _arguments()
    log_to_stderr(arguments.log_level, "%(name)s %(levelname)s %(message)s")
    share_heaps()
    if arguments.door is None:
        _die_with(arguments.parent)
    # Both may reach the whole group: the daemon needs us for its own orderly stop, and ends us with it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _stop_soon)
    faulthandler.enable()
    faulthandler.register(signal.SIGUSR1)  # where every thread stands, for the reader of the journal
    os.environ["ZENOH_RUNTIME"] = relay_pools(arguments.threads)  # read once, when zenoh's runtime starts
    from zsched.relay.process import run  # noqa: PLC0415 - imports zenoh, which must find ZENOH_RUNTIME set

    pipes = (sys.stdin.fileno(), sys.stdout.fileno())
    me = RelayHello(
        fleet=arguments.fleet,
        node=arguments.node,
        incarnation=arguments.incarnation,
        digest=arguments.digest,
        session=arguments.session,
        threads=arguments.threads,
    )
    return run(
        me,
        *pipes,
        has_local_side=arguments.local,
        door=arguments.door,
        orphan_s=arguments.orphan,
        parent=arguments.parent,
        books=Path(arguments.books) if arguments.books else None,
    )


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m zsched.relay", description="zsched's data plane")
    parser.add_argument("--fleet", required=True)
    parser.add_argument("--node", required=True)
    threads = "threads that transmit, receive, and close links, each"
    parser.add_argument("--threads", type=int, default=DEFAULT_THREADS, help=threads)
    parser.add_argument("--parent", type=int, default=0, help="process id of the daemon, which must be our parent")
    parser.add_argument("--local", action="store_true", help="a second frame holds the session of the host's own side")
    parser.add_argument("--door", type=int, help="listening socket (inherited) for the daemon's successors")
    parser.add_argument("--orphan", type=float, default=0.0, help="seconds to go on without a daemon (with --door)")
    parser.add_argument("--incarnation", type=int, default=0, help="of the daemon that starts us")
    parser.add_argument("--digest", default="", help="what the next daemon must have been started with")
    parser.add_argument("--session", default="", help="a digest over what the data session is opened with")
    parser.add_argument("--books", default="", help="the file in which a relay finds what those before have counted")
    parser.add_argument("--log-level", default="WARNING")
    return parser.parse_args()


def _die_with(parent: int) -> None:
    """Let the kernel kill us when the daemon dies, however it dies."""
    if not sys.platform.startswith("linux"):
        return
    ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if parent and os.getppid() != parent:  # it died before we asked
        os._exit(0)


def _stop_soon(_signal: int, _frame: object) -> None:
    """End when the daemon says so, as it will if it was told the same, or a little later."""
    signal.signal(signal.SIGALRM, _stop)
    signal.setitimer(signal.ITIMER_REAL, STOP_S)


def _stop(_signal: int, _frame: object) -> None:
    raise SystemExit(0)


if __name__ == "__main__":
    end_with(main)
