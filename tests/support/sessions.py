"""Opens zenoh sessions on loopback. Knows: zsched's own configurations. Does not know: what is sent."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import zenoh

from support.waiting import free_endpoint
from zsched.link.sessions.config import data_config, worker_config


def opened(text: str, **more: str) -> zenoh.Session:
    """A session of a configuration as JSON5 text; ``more`` is {path of a setting: its value as JSON}."""
    config = zenoh.Config.from_json5(text)
    for path, value in more.items():
        config.insert_json5(path, value)
    return zenoh.open(config)


@contextmanager
def hub_and_neighbour(
    endpoint: str = "", *, shared_memory: bool = False
) -> Iterator[tuple[zenoh.Session, zenoh.Session]]:
    """The session of a relay (at ``endpoint``), and one beside it for everybody else: applications, workers, liars."""
    endpoint = endpoint or free_endpoint()
    hub = opened(data_config(listen=(endpoint,), connect=(), shared_memory=shared_memory))
    try:
        neighbour = opened(worker_config(connect=(endpoint,), shared_memory=shared_memory))
        try:
            yield hub, neighbour
        finally:
            neighbour.close()
    finally:
        hub.close()


def matches(publisher: Any) -> bool:
    """Whether somebody subscribes to what a publisher (or querier) puts; the status object itself is always true."""
    return bool(publisher.matching_status.matching)
