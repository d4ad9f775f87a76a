"""A worker's link that is up and brings nothing while its machine is heard: it ends, and the worker dials anew."""

from __future__ import annotations

import sys
import time

import pytest

from support.programs import process
from support.waiting import until
from zsched.core.values.fleet import Timing
from zsched.link.sessions.config import data_config, worker_config
from zsched_lab.fleet import netns

pytestmark = [
    pytest.mark.root,
    pytest.mark.skipif(netns.why_not() is not None, reason="no network namespaces here"),
    pytest.mark.timeout(90),
]

PORT = 7458
MENDED_S, SLACK_S = 4.0, 4.0
RELAY = """
import sys, time, zenoh
from zsched.relay.mute_links import MuteLinks
from zsched.link.keyspace import Keyspace
session = zenoh.open(zenoh.Config.from_json5(sys.argv[1]))
mute, tokens = MuteLinks(session, Keyspace("hall")), set()
def note(sample):
    (tokens.add if sample.kind == zenoh.SampleKind.PUT else tokens.discard)(str(sample.key_expr))
kept = session.liveliness().declare_subscriber("@zsched/hall/worker/**", note, history=True)
print(flush=True)
for line in sys.stdin:
    if line.strip() == "look":
        mute.look(set() if any("merge" in one for one in tokens) else {"edge1"}, time.monotonic())
    links = sorted(f"{one.zid}@{one.dst}" for one in session.info.links())
    print(len(tokens), *links, flush=True)
"""
"""It misses edge1's worker for the task merge."""
PEER = """
import sys, zenoh
session = zenoh.open(zenoh.Config.from_json5(sys.argv[1]))
at, kept = int(sys.argv[3]), []
def note(event):
    if event.kind == zenoh.SampleKind.PUT:
        kept.append(None)
        if len(kept) == at:
            kept.append(session.liveliness().declare_token(sys.argv[2].replace("ZID", str(session.zid()))))
kept_too = session.info.declare_link_events_listener(note, history=True)
print(flush=True)
for line in sys.stdin:
    print(session.zid(), flush=True)
"""
"""It declares a token when its link is made for the n-th time: the declarations of the ones before are lost."""


def test_a_worker_whose_link_has_lost_what_it_declared_is_seen_again_by_a_new_link() -> None:
    with netns.Network(("robot", "edge")) as network:
        endpoint = f"tcp/{network.address('robot')}:{PORT}"
        listens = data_config(listen=(endpoint,), connect=(), timing=Timing(), shared_memory=False)
        dials = worker_config(connect=(endpoint,), listen=(), timing=Timing(), shared_memory=False)

        def peer(token: str, at: int) -> list[str]:
            return [str(one) for one in network.wrap("edge", [sys.executable, "-c", PEER, dials, token, str(at)])]

        with (
            process(network.wrap("robot", [sys.executable, "-c", RELAY, listens])) as ask_relay,
            process(peer("@zsched/hall/relay/edge1/ZID", 1)) as ask_edge,
            process(peer("@zsched/hall/worker/edge1/slam/1", 1)),
        ):
            until(lambda: ask_relay("tell").split()[0] == "1", "another worker of that machine is seen")
            relay_zid = ask_edge("zid").strip()
            (kept,) = [link for link in ask_relay("tell").split()[1:] if link.startswith(relay_zid)]
            with process(peer("@zsched/hall/worker/edge1/merge/1", 2)):
                until(lambda: len(ask_relay("tell").split()) == 4, "three links")
                began, at = time.monotonic(), 0
                while ask_relay("tell").split()[0] != "2":
                    assert time.monotonic() - began < MENDED_S + SLACK_S
                    if time.monotonic() - began >= at:
                        at += 1
                        ask_relay("look")
                    time.sleep(0.05)
            assert kept in ask_relay("tell").split(), "its relay's link stays"
