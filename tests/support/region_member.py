"""One zenoh session in a process of its own, driven by lines of JSON (`tests/support/regions.py`).

Run as a program with the session's configuration as its only argument. Each line on stdin is one order, and each is
answered by one line. Times are seconds of the monotonic clock, which all processes of a machine share.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from typing import Any, Final

import zenoh

GET_S: Final = 1.5


class Member:
    """The session, with what it has declared and what has come to it."""

    def __init__(self, config: str) -> None:
        """Open the session."""
        self._session = zenoh.open(zenoh.Config.from_json5(config))
        self._kept: list[Any] = []
        self._samples: dict[str, list[tuple[int, float]]] = {}
        self._events: list[tuple[str, str, float]] = []

    def zid(self) -> str:
        """The session's zenoh id."""
        return str(self._session.zid())

    def neighbours(self) -> list[str]:
        """The zenoh ids at the other ends of its links."""
        info = self._session.info
        return sorted(str(zid) for zid in (*info.peers_zid(), *info.routers_zid()))

    def subscribe(self, key: str) -> None:
        """Keep the number and the time of every sample."""
        kept = self._samples.setdefault(key, [])
        self._kept.append(
            self._session.declare_subscriber(
                key, lambda sample: kept.append((int(sample.payload.to_string()), time.monotonic()))
            )
        )

    def samples(self, key: str) -> list[tuple[int, float]]:
        """What has come since the last call."""
        kept = self._samples[key]
        found = list(kept)
        del kept[: len(found)]
        return found

    def answer(self, key: str, word: str) -> None:
        """Answer questions under a key with a word."""
        self._kept.append(self._session.declare_queryable(key, lambda query: query.reply(query.key_expr, word)))

    def show(self, key: str) -> None:
        """Declare a liveliness token."""
        self._kept.append(self._session.liveliness().declare_token(key))

    def watch(self, key: str) -> None:
        """Keep every coming and going of tokens."""

        def note(sample: zenoh.Sample) -> None:
            kind = "gone" if sample.kind == zenoh.SampleKind.DELETE else "here"
            self._events.append((kind, str(sample.key_expr), time.monotonic()))

        self._kept.append(self._session.liveliness().declare_subscriber(key, note, history=True))

    def seen(self) -> list[tuple[str, str, float]]:
        """The comings and goings since the last call."""
        found = list(self._events)
        del self._events[: len(found)]
        return found

    def tokens(self, key: str) -> list[str]:
        """Whose tokens a question finds now."""
        replies = self._session.liveliness().get(key, timeout=GET_S)
        return sorted(str(reply.ok.key_expr) for reply in replies if reply.ok is not None)

    def put(self, key: str, number: int) -> None:
        """One sample."""
        self._session.put(key, str(number))

    def stream(self, key: str, count: int, hz: float) -> None:
        """Numbers from 0 at a pace, in the background."""

        def run() -> None:
            publisher = self._session.declare_publisher(key)
            begin = time.monotonic()
            for number in range(count):
                time.sleep(max(begin + number / hz - time.monotonic(), 0.0))
                publisher.put(str(number))

        thread = threading.Thread(target=run, daemon=True)
        thread.start()
        self._kept.append(thread)

    def get(self, key: str, timeout: float = GET_S) -> dict[str, Any]:
        """All answers to a question, unmerged, and how long the last one and the end took, seconds."""
        begin, words, last = time.monotonic(), [], 0.0
        for reply in self._session.get(
            key,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=timeout,
        ):
            if reply.ok is not None:
                words.append(reply.ok.payload.to_string())
                last = time.monotonic() - begin
        return {"words": sorted(words), "last": last, "end": time.monotonic() - begin}

    def close(self) -> None:
        """End the session."""
        for kept in self._kept:
            if hasattr(kept, "undeclare"):
                kept.undeclare()
        self._session.close()


def main() -> None:
    """Obey until stdin ends."""
    zenoh.init_log_from_env_or("off")
    member = Member(sys.argv[1])
    print(json.dumps(member.zid()), flush=True)
    for line in sys.stdin:
        name, *arguments = json.loads(line)
        print(json.dumps(getattr(member, name)(*arguments)), flush=True)
    member.close()


if __name__ == "__main__":
    main()
