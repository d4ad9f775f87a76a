"""Which threads zenoh has in the processes of a real node: a link that falls silent holds one of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from zsched.link.sessions.config import TX_THREADS, daemon_pools, pool_threads, worker_pools
from zsched_lab.fleet.netbed import descendants_running
from zsched_lab.fleet.testbed import Testbed, echo_fleet

NODES, TASKS = 2, 1


@pytest.fixture
def bed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Testbed]:
    monkeypatch.delenv("ZENOH_RUNTIME", raising=False)  # an operator's own setting would win
    with Testbed(tmp_path, echo_fleet(robots=1, edges=1)) as made:
        made.init()
        made.start()
        made.wait_settled()
        yield made


def has_threads(pid: int, **pools: int) -> bool:
    """Whether a process has so many threads of each pool, or one or two more that some call has held up.

    zenoh names them rx-0, rx-1, ...
    """
    names = [(task / "comm").read_text().strip() for task in Path(f"/proc/{pid}/task").iterdir()]
    found = Counter(name.partition("-")[0] for name in names)
    assert all(0 <= found[pool] - count <= 2 for pool, count in pools.items()), found
    return True


def environment(pid: int) -> dict[str, str]:
    """What a process was started with."""
    pairs = Path(f"/proc/{pid}/environ").read_bytes().decode().split("\0")
    return {name: value for name, _, value in (pair.partition("=") for pair in pairs)}


def test_a_daemon_gives_itself_its_relay_and_its_workers_a_thread_for_every_link(bed: Testbed) -> None:
    """Of the daemon and the relay the threads themselves are counted: what they set is in no environment of theirs."""
    count = pool_threads(NODES, TASKS)
    assert count >= TX_THREADS + 2, "or a relay that sets nothing could not be told from one that does"
    assert has_threads(bed.pid("edge1"), rx=pool_threads(NODES) + TX_THREADS, tx=0, net=0, acc=0)
    relay = bed.relay_pid("edge1")
    assert relay is not None
    assert environment(relay)["ZENOH_RUNTIME"] == daemon_pools(NODES), "its daemon's, until it sets its own:"
    assert has_threads(relay, rx=count, tx=count, net=count, acc=count)
    workers = descendants_running(bed.pid("edge1"), "zsched.tasks.echo")
    assert workers
    for worker in workers:
        assert environment(worker)["ZENOH_RUNTIME"] == worker_pools(NODES, TASKS)
        assert has_threads(worker, rx=count, net=count)  # nobody dials it: no `acc`
