"""zenoh's words in our log: read, shortened, not repeated; and captured from a real zenoh that has something to say."""

from __future__ import annotations

import logging
import os
import subprocess
import sys

from support.waiting import free_endpoint
from zsched.host.zenoh_log import PERIOD_S, Digest

ERROR = (
    "\x1b[2m2026-11-20T08:55:12.368733Z\x1b[0m \x1b[31mERROR\x1b[0m acc-0 ThreadId(04) "
    "\x1b[2mzenoh_transport::unicast::establishment::open\x1b[0m\x1b[2m:\x1b[0m "
    "Received a close message (reason GENERIC) "
    "at /root/.cargo/git/checkouts/zenoh-9c59/io/zenoh-transport/src/unicast/establishment/open.rs:526."
)
SAID = "zenoh_transport::unicast::establishment::open: Received a close message (reason GENERIC)"


def test_a_line_is_said_once_a_minute_and_the_others_are_counted() -> None:
    digest = Digest()
    assert digest.line(ERROR, 100.0) == (logging.WARNING, SAID)
    assert digest.line(ERROR, 101.0) is None
    assert digest.line(ERROR.replace("GENERIC", "INVALID"), 102.0) is None
    other = digest.line(ERROR.replace("::open", "::accept"), 103.0)
    assert other is not None
    assert "accept: Received" in other[1]
    again = digest.line(ERROR, 100.0 + PERIOD_S)
    assert again == (logging.WARNING, f"{SAID} (and 2 more of this kind before)")


def test_what_is_no_line_of_zenoh_s_is_passed_on_and_nothing_is_not() -> None:
    digest = Digest()
    assert digest.line("thread 'x' panicked", 1.0) == (logging.INFO, "thread 'x' panicked")
    assert digest.line(" \x1b[0m ", 1.0) is None
    long = digest.line("x" * 10_000, 1.0)
    assert long is not None
    assert len(long[1]) == 300


SCRIPT = """
import logging, os, sys, time
logging.basicConfig(stream=sys.stderr, format="%(levelname)s %(name)s %(message)s")
from zsched.host import zenoh_log
print("captured" if zenoh_log.capture(os.environ) else "left alone", file=sys.stderr)
import zenoh
zenoh.init_log_from_env_or("error")
there = sys.argv[1]
PEER = '{mode: "peer", listen: {endpoints: ["%s"]}, scouting: {multicast: {enabled: false}}}'
peer = zenoh.open(zenoh.Config.from_json5(PEER % there))
TWIN = '{mode: "client", id: "abcd", connect: {timeout_ms: 0, endpoints: ["%s"]}}'
first = zenoh.open(zenoh.Config.from_json5(TWIN % there))
for _ in range(3):  # a second one of that id is refused, and zenoh says so
    try:
        zenoh.open(zenoh.Config.from_json5(TWIN % there))
    except zenoh.ZError:
        pass
time.sleep(0.2)
sys.stderr.flush()
os._exit(0)
"""


def run(**env: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", SCRIPT, free_endpoint()]
    inherited = {name: value for name, value in os.environ.items() if name != "RUST_LOG"}
    return subprocess.run(command, capture_output=True, text=True, timeout=30, check=True, env=inherited | env)


def test_a_real_zenoh_s_errors_come_once_into_the_log_and_not_on_standard_output() -> None:
    done = run()
    assert "captured" in done.stderr
    assert done.stdout == ""
    lines = [line for line in done.stderr.splitlines() if line.startswith("WARNING zsched.zenoh zenoh")]
    assert [line for line in lines if "Received a close message" in line], done.stderr
    causes = [line.split(": ", 1)[0] for line in lines]
    assert len(causes) == len(set(causes)), lines


def test_an_operator_who_sets_rust_log_gets_zenoh_s_own_log() -> None:
    done = run(RUST_LOG="error")
    assert "left alone" in done.stderr
    assert "ERROR" in done.stdout
