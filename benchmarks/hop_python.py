"""What the relay's own code costs per message: real samples through a real stream that nobody subscribes to.

``python -m benchmarks.hop_python [--count 3000] [--repeats 7] [--size 1024]``. Between zenoh's handler and zenoh's put
are numbers, counters, gates, queues. A put without a subscriber sends nothing, so what is left is ours. CPU time of
this thread (``carry``) and of the whole process (``all``: queue and acknowledgement threads, too), the smallest of all
repeats: it depends little on how busy the machine is. *floor*: the same samples put on with all that a hop must keep,
by a bare loop.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import zenoh

from zsched.core.values.plan import Direction, HandoverRule, Route, StreamClass, StreamSettings
from zsched.link.keyspace import Keyspace
from zsched.link.sessions.config import data_config, worker_config
from zsched.relay.streams.acks import Acks
from zsched.relay.streams.inputs import InputStream
from zsched.relay.streams.outputs import OutputStream
from zsched.relay.streams.receive import undeclare
from zsched_lab.fleet.loopback import free_endpoint
from zsched_lab.fleet.waiting import until

KEY = "robot1/in"
OWNER = "edge1/t/1/out"
Carry = Callable[[zenoh.Sample], None]
Way = tuple[Carry, Callable[[], bool], Callable[[], None]]
"""(carry a sample, is everything through, close)."""


@contextmanager
def sessions() -> Iterator[tuple[zenoh.Session, zenoh.Session]]:
    """A relay's session and an application's."""
    endpoint = free_endpoint()
    hub = data_config(listen=(endpoint,), connect=(), shared_memory=False)
    beside = worker_config(connect=(endpoint,), shared_memory=False)
    with zenoh.open(zenoh.Config.from_json5(hub)) as relay, zenoh.open(zenoh.Config.from_json5(beside)) as application:
        yield relay, application


def matches(publisher: Any) -> bool:
    """Whether somebody subscribes; the status object itself is always true."""
    return bool(publisher.matching_status.matching)


def collect(relay: zenoh.Session, application: zenoh.Session, key: str, count: int, size: int) -> list[zenoh.Sample]:
    """So many numbered samples as they came over TCP, with an attachment."""
    taken: list[zenoh.Sample] = []
    subscriber = relay.declare_subscriber(key, taken.append)
    publisher = application.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
    until(lambda: matches(publisher), "a subscriber")
    for number in range(count):
        source = zenoh.SourceInfo(publisher.id, number)
        publisher.put(bytes(size), attachment=b"a" * 33, source_info=source)
    until(lambda: len(taken) == count, "all samples")
    undeclare(subscriber)
    undeclare(publisher)
    return taken


def floor(relay: zenoh.Session) -> Way:
    """A bare loop's put."""
    publisher = relay.declare_publisher("edge1/t/robot1/in")
    source_id = publisher.id

    def carry(sample: zenoh.Sample) -> None:
        publisher.put(
            sample.payload,
            encoding=sample.encoding,
            attachment=sample.attachment,
            timestamp=sample.timestamp,
            source_info=zenoh.SourceInfo(source_id, 1),
        )

    return carry, lambda: True, partial(undeclare, publisher)


def settings_of(stream_class: StreamClass) -> StreamSettings:
    """Deep enough that nothing gives way."""
    return StreamSettings(stream_class=stream_class, depth=100_000, handover=HandoverRule.ALL)


def inward(relay: zenoh.Session, stream_class: StreamClass) -> Way:
    """The way of an input to a worker of `zsched.worker`."""
    acks = Acks(relay, Keyspace("bench"), "robot1", lambda *_: True).of("edge1", "t")
    route = Route(
        stream="t/in/0",
        direction=Direction.INPUT,
        from_expr="nothing/comes/here",
        to_expr="edge1/t/robot1/in",
        settings=settings_of(stream_class),
    )
    stream = InputStream(relay, route, frozenset({str(relay.zid())}))
    stream.open(1, route, acks)
    stream.flip(1)
    _meet(stream)
    return stream._carry, lambda: _sent(stream), stream.close  # noqa: SLF001 - what its receiver's thread calls


def _meet(stream: InputStream) -> None:
    """As if the worker had answered its greeting: nobody is there."""
    active = stream._active  # noqa: SLF001
    greetings = None if active is None else active.outlet._greetings  # noqa: SLF001
    if greetings is not None:
        setattr(greetings, "is_there", lambda *_, **__: True)  # noqa: B010 - a method of this one alone
        greetings._unmet.clear()  # noqa: SLF001


def _sent(stream: InputStream) -> bool:
    active = stream._active  # noqa: SLF001 - how far its queue is
    queue = None if active is None else active.outlet._queue  # noqa: SLF001
    return queue is None or (not queue._items and queue._busy_since is None)  # noqa: SLF001


def outward(relay: zenoh.Session, stream_class: StreamClass) -> Way:
    """The way of an answer back to the application."""
    acks = Acks(relay, Keyspace("bench"), "robot1", lambda *_: True).of("edge1", "t")
    route = Route(
        stream="t/out/0",
        direction=Direction.OUTPUT,
        from_expr=OWNER,
        to_expr="robot1/out",
        settings=settings_of(stream_class),
    )
    stream = OutputStream(relay, route, frozenset({str(relay.zid())}), lambda: None)
    stream.open(1, route, acks, is_from_start=True)
    stream.flip(1, drops_held=False)
    feed = stream._slots[1].feed  # noqa: SLF001 - its receiver's
    assert feed is not None

    def sent() -> bool:
        queue = stream._outlet._queue  # noqa: SLF001 - how far its queue is
        return queue is None or (not queue._items and queue._busy_since is None)  # noqa: SLF001

    return lambda sample: stream._carry(feed, sample), sent, stream.close  # noqa: SLF001


def cost(made: Way, samples: list[zenoh.Sample]) -> tuple[float, float]:
    """(this thread's, the whole process's) CPU time per message, µs."""
    carry, is_through, close = made
    whole, mine = time.process_time(), time.thread_time()
    for sample in samples:
        carry(sample)
    mine = time.thread_time() - mine
    while not is_through():
        time.sleep(0.001)
    whole = time.process_time() - whole
    close()
    return 1e6 * mine / len(samples), 1e6 * whole / len(samples)


def main() -> None:
    """Print one line per way and class."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=3000)
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--size", type=int, default=1024)
    options = parser.parse_args()
    with sessions() as (relay, application):
        there = collect(relay, application, KEY, options.count, options.size)
        back = collect(relay, application, OWNER, options.count, options.size)
        ways: dict[str, tuple[Callable[[], Way], list[zenoh.Sample]]] = {"floor": (partial(floor, relay), there)}
        for one in StreamClass:
            ways[f"input {one}"] = (partial(inward, relay, one), there)
            ways[f"output {one}"] = (partial(outward, relay, one), back)
        best = {name: (float("inf"), float("inf")) for name in ways}
        for _ in range(options.repeats):
            for name, (make, samples) in ways.items():
                found = cost(make(), samples)
                best[name] = (min(best[name][0], found[0]), min(best[name][1], found[1]))
    for name, (mine, whole) in best.items():
        print(f"{name:<20} carry {mine:6.2f} us  all {whole:6.2f} us")
    sys.stdout.flush()
    os._exit(0)  # as a relay ends: threads that wait in zenoh do not survive the interpreter's own end


if __name__ == "__main__":
    main()
