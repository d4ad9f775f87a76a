"""What silent connections of strangers cost a session that asks for certificates; when a member is let in meanwhile.

``python -m benchmarks.silent [--connections 1000] [--limit 20] [--bare]``. One session that listens as a daemon's does,
and connections that say nothing. ``--bare``: without what keeps them from zenoh (`link_sockets.hold_back_silent`).
Memory is what its process has more, in proportional shares (PSS). zenoh gives up on a handshake after 10 s, and then
waits 0.1 s before it looks at the next one.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import psutil
import zenoh

from benchmarks.common import machine
from zsched.core.values.certificates import Role
from zsched.host.key_files import PRIVATE, PUBLIC, write_whole
from zsched.link.sessions.config import client_config, control_config
from zsched.pki.authority import create
from zsched_lab.fleet.floods import connections
from zsched_lab.fleet.loopback import free_endpoint

LISTENER = """
import sys, zenoh
from zsched.link.sessions.link_sockets import hold_back_silent
session = zenoh.open(zenoh.Config.from_json5(sys.argv[1]))
if sys.argv[2] == "held":
    hold_back_silent()
print(flush=True)
sys.stdin.read()
"""
LOOKS_S = (0.0, 5.0, 12.0)


def certificates(folder: Path) -> dict[str, Any]:
    """TLS settings of a session with a certificate of a new authority."""
    issued = create(folder / "authority", "yard", b"", datetime.now(UTC)).issue(
        "robot1", Role.NODE, [], b"", b"", datetime.now(UTC)
    )
    write_whole(folder / "certificate.pem", issued.certificate, PUBLIC)
    write_whole(folder / "key.pem", issued.key, PRIVATE)
    write_whole(folder / "ca.pem", issued.trusted, PUBLIC)
    certificate, key = str(folder / "certificate.pem"), str(folder / "key.pem")
    return {
        "root_ca_certificate": str(folder / "ca.pem"),
        "enable_mtls": True,
        "verify_name_on_connect": False,
        "listen_certificate": certificate,
        "listen_private_key": key,
        "connect_certificate": certificate,
        "connect_private_key": key,
    }


def with_tls(text: str, tls: dict[str, Any]) -> str:
    """A session's configuration with TLS settings."""
    config = json.loads(text)
    config["transport"]["link"]["tls"] = tls
    return json.dumps(config)


def let_in(endpoint: str, tls: dict[str, Any], limit_s: float) -> str:
    """How long a member waits for its link."""
    began = time.monotonic()
    try:
        with zenoh.open(zenoh.Config.from_json5(with_tls(client_config(connect=(endpoint,), connect_s=limit_s), tls))):
            return f"after {time.monotonic() - began:.2f} s"
    except zenoh.ZError:
        return f"not within {limit_s:g} s"


def main() -> None:
    """Print one line for each look."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--connections", type=int, default=1000)
    parser.add_argument("--limit", type=float, default=20.0, help="seconds that a member tries")
    parser.add_argument("--bare", action="store_true", help="a session of zenoh as it is")
    given = parser.parse_args()
    print(machine())
    endpoint = free_endpoint().partition("#")[0].replace("tcp/", "tls/")
    with tempfile.TemporaryDirectory() as name:
        tls = certificates(Path(name))
        config = with_tls(control_config(listen=(endpoint,), connect=()), tls)
        command = [sys.executable, "-c", LISTENER, config, "bare" if given.bare else "held"]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as listener:
            assert listener.stdout is not None
            listener.stdout.readline()
            process = psutil.Process(listener.pid)
            before = process.memory_full_info().pss
            with connections(endpoint, given.connections) as made:
                began = time.monotonic()
                for look_s in LOOKS_S:
                    time.sleep(max(0.0, began + look_s - time.monotonic()))
                    more = (process.memory_full_info().pss - before) / 2**20
                    held, member = process.num_fds(), let_in(endpoint, tls, given.limit)
                    print(
                        f"{made} silent, after {look_s:g} s: {more:+.1f} MiB, {held} descriptors, member in {member}",
                        flush=True,
                    )
            listener.kill()


if __name__ == "__main__":
    main()
