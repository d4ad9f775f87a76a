"""Whose links end: what the thread that ends them outlives."""

from __future__ import annotations

import errno
from types import SimpleNamespace
from typing import Any

from support.waiting import until
from zsched.sessions.expulsion import MAX_SHOWN, Expulsion


def test_links_are_ended_also_after_the_thread_has_failed() -> None:
    looks: list[int] = []

    def links() -> list[Any]:
        looks.append(1)
        if len(looks) == 1:
            raise OSError(errno.EMFILE, "Too many open files")
        return []

    info = SimpleNamespace(links=links, declare_link_events_listener=lambda *_, **__: None)
    session: Any = SimpleNamespace(info=info)
    expulsion = Expulsion(session, "hall", (), lambda *_: None)
    try:
        for _ in range(2):  # it shows too many tokens, and twice as many
            before = len(looks)
            for _ in range(MAX_SHOWN + 1):
                expulsion.shows("edge1", is_present=True)
            until(lambda before=before: len(looks) > before, "a look at the links")  # type: ignore[misc]
    finally:
        expulsion.close()
