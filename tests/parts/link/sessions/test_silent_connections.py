"""Connections that say nothing do not reach a session that listens; who speaks is let in beside them."""

from __future__ import annotations

import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO

import psutil
import zenoh

from support.waiting import free_endpoint, until
from zsched.link.sessions.config import client_config, control_config
from zsched.link.sessions.link_sockets import hold_back_silent
from zsched_lab.fleet.floods import connections

COUNT = 200
LISTENER = """
import sys, zenoh
from zsched.link.sessions.link_sockets import hold_back_silent
session = zenoh.open(zenoh.Config.from_json5(sys.argv[1]))
kept = session.declare_subscriber("greeting", lambda sample: print(sample.payload.to_string(), flush=True))
print(hold_back_silent() if sys.argv[2] == "yes" else 1, flush=True)
sys.stdin.read()
session.close()
"""


def held(process: psutil.Process) -> int:
    return sum(one.status == psutil.CONN_ESTABLISHED for one in process.net_connections("tcp"))


@contextmanager
def listener(endpoint: str, *, holds_back: bool) -> Iterator[tuple[psutil.Process, IO[str]]]:
    """(a process with a session that listens, what it says)."""
    config = control_config(listen=(endpoint,), connect=())
    command = [sys.executable, "-c", LISTENER, config, "yes" if holds_back else "no"]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "1\n", "one socket listens"
        yield psutil.Process(process.pid), process.stdout
        process.communicate("", 20)


def test_the_kernel_keeps_silent_connections_from_a_session() -> None:
    endpoint = free_endpoint()
    member = client_config(connect=(endpoint,), connect_s=20.0)
    with listener(endpoint, holds_back=True) as (process, says), connections(endpoint, COUNT) as made:
        assert made == COUNT
        with zenoh.open(zenoh.Config.from_json5(member)) as session:
            session.put("greeting", "hello")
            assert says.readline() == "hello\n", "who speaks is let in"
            assert held(process) == 1, "the member's"


def test_without_that_they_cost_a_session_descriptors() -> None:
    endpoint = free_endpoint()
    with listener(endpoint, holds_back=False) as (process, _), connections(endpoint, COUNT):
        until(lambda: held(process) > 1, "they are taken")


def test_in_a_process_of_ours_a_socket_that_does_not_listen_is_left_alone() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server, socket.create_connection(server.getsockname()) as other:
        assert hold_back_silent() >= 1
        assert server.getsockopt(socket.IPPROTO_TCP, socket.TCP_DEFER_ACCEPT) > 0
        assert not other.getsockopt(socket.IPPROTO_TCP, socket.TCP_DEFER_ACCEPT)
