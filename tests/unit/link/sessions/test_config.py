from __future__ import annotations

import json
from typing import Any

import pytest
import zenoh

from zsched.config.timing import PROFILES
from zsched.core.values.fleet import Timing, WorkerLink
from zsched.link.sessions.config import (
    client_config,
    control_config,
    daemon_pools,
    data_config,
    introduction_config,
    pool_threads,
    relay_pools,
    worker_config,
    worker_pools,
)

HERE, THERE = "tcp/127.0.0.1:7457", "tcp/127.0.0.1:7458"
TIMING = Timing(zenoh_lease_s=1.25)


def read(text: str, path: str) -> Any:
    value = zenoh.Config.from_json5(text).get_json(path)
    return json.loads(value) if isinstance(value, str) else value


ALL = {
    "control": control_config(listen=(HERE,), connect=(THERE,), timing=TIMING),
    "data": data_config(listen=(HERE,), connect=(THERE,), timing=TIMING),
    "worker": worker_config(connect=(THERE,), timing=TIMING),
    "worker by client": worker_config(connect=(THERE,), timing=TIMING, link=WorkerLink.CLIENT),
    "client": client_config(connect=(THERE,), timing=TIMING),
}


@pytest.mark.parametrize("text", ALL.values(), ids=ALL.keys())
def test_every_session_scouts_nowhere_and_has_our_lease(text: str) -> None:
    assert read(text, "scouting/multicast/enabled") is False
    lease_s = TIMING.control_lease_s if text == ALL["control"] else 1.25
    assert read(text, "transport/link/tx/lease") == round(1000 * lease_s)
    assert read(text, "transport/link/tx/keep_alive") == (3 if text == ALL["control"] else TIMING.data_signs)
    assert read(text, "timestamping/enabled") is False
    assert read(text, "id") is None  # random: a fixed one keeps a restarted node out for a lease


@pytest.mark.parametrize("name", ALL)
def test_every_session_looks_again_quickly(name: str) -> None:
    """A relay is back within 0.3 s."""
    assert read(ALL[name], "connect/retry")["period_init_ms"] == (200 if name == "control" else 50)
    assert read(ALL[name], "connect/retry")["period_max_ms"] == 1000


@pytest.mark.parametrize("text", ALL.values(), ids=ALL.keys())
def test_no_dial_is_given_up_at_a_moment_when_tcp_lets_it_succeed(text: str) -> None:
    """Else it may be dropped half done, and the link is dead one way (`benchmarks/relink.py` makes it happen)."""
    syn = [0.0, 1.0, 2.0, 3.0, 4.0, 7.0]  # Linux: by doubling, since 6.5 the first four at equal distances
    data = [0.2, 0.6, 1.4, 3.0]
    opens = read(text, "transport/unicast/open_timeout") / 1000
    accepts = read(text, "transport/unicast/accept_timeout") / 1000
    assert min(abs(opens - (begin + again)) for begin in syn for again in [0.0, *data]) >= 0.09
    assert min(abs(accepts - again) for again in data) >= 0.09


@pytest.mark.parametrize("name", ["control", "data", "worker"])
def test_peers_gossip_and_wait_for_nobody(name: str) -> None:
    assert read(ALL[name], "mode") == "peer"
    assert read(ALL[name], "scouting/gossip/enabled") is True
    assert read(ALL[name], "connect/exit_on_failure") is False


def test_nobody_dials_a_worker_so_it_dials_whom_it_hears_of() -> None:
    """Of two that dial each other one may tell the other nothing again (eclipse-zenoh/zenoh#2806)."""
    strategy = "scouting/gossip/autoconnect_strategy"
    worker = worker_config(connect=(THERE,), listen=(), timing=TIMING)
    assert read(worker, "listen/endpoints") == []
    assert read(worker, strategy)["peer"]["to_peer"] == "always"
    assert read(ALL["data"], strategy)["peer"]["to_peer"] == "greater-zid"
    assert read(ALL["control"], strategy)["peer"]["to_peer"] == "greater-zid"


def test_a_put_waits_longer_for_room_where_applications_receive() -> None:
    wait = "transport/link/tx/queue/congestion_control/drop/wait_before_drop"
    assert (read(ALL["data"], wait), read(ALL["worker"], wait)) == (50_000, 1000)
    assert not any(read(text, "adminspace/enabled") for text in ALL.values()), "its questions may stop for ever"


def test_only_data_has_small_buffers_and_shared_memory() -> None:
    assert read(ALL["control"], "listen/endpoints") == [HERE]
    assert read(ALL["data"], "listen/endpoints") == [f"{HERE}#so_sndbuf=65536"]
    assert read(ALL["control"], "transport/shared_memory/enabled") is False
    assert read(ALL["control"], "transport/link/rx/max_message_size") == 1 << 20
    assert read(ALL["data"], "transport/shared_memory/enabled") is True
    assert read(ALL["data"], "transport/shared_memory/transport_optimization/messages") == ["put"]
    off = data_config(listen=(HERE,), connect=(), shared_memory=False)
    assert read(off, "transport/shared_memory/enabled") is False


def test_the_operators_file_lies_underneath() -> None:
    theirs = (
        "{ /* ours wins */ mode: 'router', transport: {link: {tx: {queue: {size: {data: 4}}}}}, namespace: 'site' }"
    )
    text = data_config(listen=(HERE,), connect=(), operator_json5=theirs)
    assert read(text, "transport/link/tx/queue/size/data") == 4
    assert read(text, "namespace") == "site"
    assert read(text, "mode") == "peer"


def test_an_operators_file_that_is_none_is_refused_in_words() -> None:
    with pytest.raises(ValueError, match="not a zenoh configuration"):
        control_config(listen=(), connect=(), operator_json5="{ nonsense: 1 }")


def test_a_process_has_a_receive_thread_for_every_link_that_may_fall_silent_at_once() -> None:
    assert [pool_threads(nodes) for nodes in (1, 6, 11, 48, 1000)] == [12, 12, 13, 50, 64]
    assert [pool_threads(5, tasks) for tasks in (0, 1, 3)] == [12, 12, 22], "a relay, and a worker per task, on each"
    pools = "(rx: (worker_threads: 14), tx: (worker_threads: 4), net: (worker_threads: 14), acc: (worker_threads: 14))"
    assert worker_pools(6, 1) == pools


def test_a_daemon_has_one_pool_with_a_thread_for_every_link() -> None:
    """Or each packet wakes twice as many threads."""
    assert daemon_pools(6) == "(rx: (worker_threads: 16), tx: (handover: rx), net: (handover: rx), acc: (handover: rx))"


def test_a_relay_reads_the_links_that_it_has_dialled_with_as_many_threads_as_those_that_dial_it() -> None:
    """zenoh gives a socket to the pool that opened it: ``net`` where we dial, ``acc`` where we are dialled."""
    assert relay_pools(7) == f"({', '.join(f'{pool}: (worker_threads: 7)' for pool in ('rx', 'tx', 'net', 'acc'))})"


@pytest.mark.parametrize("profile", PROFILES)
def test_a_control_message_waits_for_room_no_longer_than_a_peer_may_be_silent(profile: str) -> None:
    """zenoh ends such a link, and until then nobody else may use its queue, not even to end it."""
    timing = PROFILES[profile]
    path = "transport/link/tx/queue/congestion_control/block/wait_before_close"
    assert read(control_config(listen=(HERE,), connect=(THERE,), timing=timing), path) == round(1e6 * timing.suspect_s)
    assert read(data_config(listen=(HERE,), connect=(THERE,), timing=timing), path) == 5_000_000


def test_control_sessions_that_know_every_address_do_not_dial_by_gossip() -> None:
    quiet = control_config(listen=(HERE,), connect=(THERE,), dials_by_gossip=False)
    assert read(quiet, "scouting/gossip/autoconnect") == {"router": [], "peer": []}
    assert read(quiet, "scouting/gossip/enabled") is True


def test_of_two_that_meet_by_gossip_one_dials() -> None:
    found = read(control_config(listen=(HERE,), connect=(THERE,)), "scouting/gossip/autoconnect_strategy")
    assert found == {"peer": {"to_router": "always", "to_peer": "greater-zid"}}


def test_an_introduction_dials_the_same_and_everybody_they_know_and_listens_nowhere() -> None:
    text = introduction_config(ALL["data"])
    assert text is not None
    assert read(text, "connect/endpoints") == read(ALL["data"], "connect/endpoints")
    assert read(text, "listen/endpoints") == []
    assert read(text, "scouting/gossip/autoconnect")["peer"] == ["router", "peer"]
    assert read(text, "scouting/gossip/autoconnect_strategy") == {"peer": {"to_router": "always", "to_peer": "always"}}
    assert read(text, "scouting/multicast/enabled") is False
    zenoh.Config.from_json5(text)


def test_an_introduction_keeps_the_operators_own_settings() -> None:
    session = data_config(
        listen=(HERE,), connect=(THERE,), operator_json5="{transport: {auth: {usrpwd: {user: 'u', password: 'p'}}}}"
    )
    assert read(introduction_config(session) or "", "transport/auth/usrpwd/user") == "u"
