"""A machine that dies while it shakes hands: zenoh's close of its connection holds a thread for 10 s, and no link."""

from __future__ import annotations

import socket
import sys
import threading

import pytest
import zenoh

from support.programs import process
from support.waiting import until
from zsched.core.values.fleet import Timing
from zsched.link.sessions.config import data_config, pool_threads, relay_pools
from zsched_lab.fleet import netns

WHY_NOT = netns.why_not()
PORT = 7458
BESIDE_S = 8.0
"""Shorter than zenoh's SO_LINGER, 10 s."""
MOST_S = 3.0
"""The longest silence of the others: a lease, in which a thread that rests takes over what the held one has read."""
RELAY = """
import sys, time, zenoh
session = zenoh.open(zenoh.Config.from_json5(sys.argv[1]))
heard = []
kept = session.declare_subscriber("there", lambda sample: heard.append(time.monotonic()))
print(flush=True)
for line in sys.stdin:
    now = [*heard, time.monotonic()]
    print(len(heard), max((late - early for early, late in zip(now, now[1:])), default=0.0), flush=True)
"""
APPLICATION = """
import sys, time, zenoh
session = zenoh.open(zenoh.Config.from_json5(sys.argv[1]))
print(flush=True)
while True:
    session.put("there", b"x")
    time.sleep(0.05)
"""
DYING = """
import socket, sys
link = socket.create_connection((sys.argv[1], int(sys.argv[2])))
print(flush=True)
sys.stdin.readline()
link.send(bytes.fromhex(sys.argv[3]))
print(flush=True)
sys.stdin.readline()
"""


def first_words() -> bytes:
    """The first bytes that a session sends to the address that it dials."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(20.0)
        port = server.getsockname()[1]
        config = data_config(listen=(), connect=(f"tcp/127.0.0.1:{port}",), timing=Timing(), shared_memory=False)
        opening = threading.Thread(target=lambda: zenoh.open(zenoh.Config.from_json5(config)).close())
        opening.start()
        with server.accept()[0] as link:
            said = link.recv(4096)
    opening.join(20.0)
    assert not opening.is_alive()
    return said


@pytest.mark.long
@pytest.mark.root
@pytest.mark.skipif(WHY_NOT is not None, reason=str(WHY_NOT))
@pytest.mark.timeout(90)
def test_a_machine_that_dies_while_it_shakes_hands_silences_no_application_of_the_relay() -> None:
    """Applications and workers dial their relay: with one thread that accepts, none of them was heard for 10 s."""
    greeting = first_words()
    with netns.Network(("robot", "dying")) as network:
        endpoint = f"tcp/{network.address('robot')}:{PORT}"
        listens = data_config(listen=(endpoint,), connect=(), timing=Timing(), shared_memory=False)
        dials = data_config(listen=(), connect=(endpoint,), timing=Timing(), shared_memory=False)
        relay = network.wrap("robot", [sys.executable, "-c", RELAY, listens])
        application = network.wrap("robot", [sys.executable, "-c", APPLICATION, dials])
        peer = [sys.executable, "-c", DYING, network.address("robot"), str(PORT), greeting.hex()]
        with (
            process(relay, ZENOH_RUNTIME=relay_pools(pool_threads(1, 1))) as ask_relay,
            process(application),
            process(network.wrap("dying", peer)) as ask_dying,
        ):
            until(lambda: int(ask_relay("heard").split()[0]) > 5, "the application is heard")
            network.deafen("dying")  # it hears no answer, as if it were gone
            ask_dying("speak")
            threading.Event().wait(BESIDE_S)
            count, longest_s = ask_relay("heard").split()
            print(f"{count} samples, longest silence {float(longest_s):.2f} s")
            assert float(longest_s) < MOST_S
