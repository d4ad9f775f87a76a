"""Whose links end: what the thread that ends them outlives."""

from __future__ import annotations

import errno
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from support.threads import no_threads
from support.waiting import until
from zsched.link.sessions.expulsion import MAX_SHOWN, Expulsion


def expulsion_of(links: Callable[[], list[Any]]) -> Expulsion:
    info = SimpleNamespace(links=links, declare_link_events_listener=lambda *_, **__: None)
    session: Any = SimpleNamespace(info=info)
    return Expulsion(session, "hall", (), lambda *_: None)


def test_links_are_ended_later_where_no_thread_was_to_be_had() -> None:
    """No link was ended any more, and the counters looked as if they were."""
    looks: list[int] = []

    def links() -> list[Any]:
        looks.append(1)
        return []

    expulsion = expulsion_of(links)
    try:
        for _ in range(MAX_SHOWN):
            expulsion.shows("edge1", is_present=True)
        with no_threads(), pytest.raises(RuntimeError):
            expulsion.shows("edge1", is_present=True)
        for _ in range(MAX_SHOWN):
            expulsion.shows("edge1", is_present=True)
        until(lambda: bool(looks), "a look at the links")
    finally:
        expulsion.close()


def test_links_are_ended_also_after_the_thread_has_failed() -> None:
    looks: list[int] = []

    def links() -> list[Any]:
        looks.append(1)
        if len(looks) == 1:
            raise OSError(errno.EMFILE, "Too many open files")
        return []

    expulsion = expulsion_of(links)
    try:
        for _ in range(2):  # it shows too many tokens, and twice as many
            before = len(looks)
            for _ in range(MAX_SHOWN + 1):
                expulsion.shows("edge1", is_present=True)
            until(lambda before=before: len(looks) > before, "a look at the links")  # type: ignore[misc]
    finally:
        expulsion.close()
