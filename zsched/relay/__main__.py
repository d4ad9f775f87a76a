"""Starts the relay process: thread pools first, zenoh afterwards.

Knows: the command line, signals, the parent's death. Does not know: streams.

``python -m zsched.relay --fleet F --node N [--threads T] [--parent PID] [--local]``; the first frame on stdin is
the zenoh session as JSON (with ``--local`` the second one is that of the host's own side). Logs go to stderr.
"""

from __future__ import annotations

import argparse
import ctypes
import faulthandler
import logging
import os
import signal
import sys

PR_SET_PDEATHSIG = 1
DEFAULT_THREADS = 6


def main() -> None:
    """Run the relay; never returns (threads of zenoh must not be waited for at exit)."""
    arguments = _arguments()
    logging.basicConfig(stream=sys.stderr, level=arguments.log_level, format="%(name)s %(levelname)s %(message)s")
    _die_with(arguments.parent)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the daemon stops us in order
    signal.signal(signal.SIGTERM, _stop)
    faulthandler.register(signal.SIGUSR1)  # where every thread stands, for whoever has to ask
    # One stalled target holds one transmit thread: there must be more threads than targets may stall. Read once, when
    # zenoh's runtime starts.
    pools = f"(tx: (worker_threads: {arguments.threads}), rx: (worker_threads: {arguments.threads}))"
    os.environ["ZENOH_RUNTIME"] = pools
    code = 1
    try:
        from zsched.relay.process import run  # noqa: PLC0415 - imports zenoh, which must find ZENOH_RUNTIME set

        pipes = (sys.stdin.fileno(), sys.stdout.fileno())
        code = run(arguments.fleet, arguments.node, *pipes, has_local_side=arguments.local)
    except SystemExit:
        code = 0
    except BaseException:
        logging.getLogger("zsched.relay").exception("the relay ends")
    finally:
        sys.stderr.flush()
        os._exit(code)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m zsched.relay", description="zsched's data plane")
    parser.add_argument("--fleet", required=True)
    parser.add_argument("--node", required=True)
    parser.add_argument("--threads", type=int, default=DEFAULT_THREADS, help="transmit and receive threads, each")
    parser.add_argument("--parent", type=int, default=0, help="process id that must be our parent")
    parser.add_argument("--local", action="store_true", help="a second frame holds the session of the host's own side")
    parser.add_argument("--log-level", default="WARNING")
    return parser.parse_args()


def _die_with(parent: int) -> None:
    """Let the kernel kill us when the daemon dies, however it dies."""
    if not sys.platform.startswith("linux"):
        return
    ctypes.CDLL(None, use_errno=True).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if parent and os.getppid() != parent:  # it died before we asked
        os._exit(0)


def _stop(_signal: int, _frame: object) -> None:
    raise SystemExit(0)


if __name__ == "__main__":
    main()
