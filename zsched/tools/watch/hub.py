"""Asks one daemon for all who look at `zsched web`, and passes what is new on to each of them.

However many look, the daemon is asked once in `PERIOD_S`, and once in `IDLE_S` while nobody looks and it answers.
A client that takes its messages too slowly is dropped: it comes again by itself and gets everything again.

Knows: the feed, the past, clients with their queues, messages as bytes. Does not know: HTTP.
"""

from __future__ import annotations

import contextlib
import json
import queue
import threading
from collections.abc import Iterable
from typing import Final

from zsched.commands.base.common import Json
from zsched.commands.base.report import all_problems, degradations
from zsched.commands.look.explain import explanation
from zsched.host.clock import monotonic_s
from zsched.host.guard import guarded
from zsched.tools.metrics import down_text, metrics_text
from zsched.tools.watch.feed import Feed, Past, Point

PERIOD_S: Final = 1.0
IDLE_S: Final = 5.0
"""While nobody looks, so that there is a past to show."""
MOST_CLIENTS: Final = 8
WAITING: Final = 8
"""Messages that a client may be behind; with one more it is dropped."""
EXPLAIN_S: Final = 1.0
"""An explanation that is not older is given again."""
MOST_EXPLAINED: Final = 64

Message = bytes
"""One server-sent event."""


class Client:
    """One that looks: its messages, oldest first; ``None`` ends it."""

    def __init__(self) -> None:
        self.messages: queue.Queue[Message | None] = queue.Queue(WAITING + 1)
        self.is_dropped = False


class Hub:
    """One feed and many clients. `start` begins, `close` ends; all else may be called by any thread."""

    def __init__(self, feed: Feed, *, most_clients: int = MOST_CLIENTS) -> None:
        self._feed, self._most = feed, most_clients
        self._past = Past()
        self._lock = threading.Lock()
        self._clients: list[Client] = []
        self._asking, self._asked_at = threading.Lock(), -PERIOD_S
        self._joined, self._closing = threading.Event(), threading.Event()
        self._explained: dict[str, tuple[float, Json]] = {}
        self._explaining = threading.Lock()
        self._thread = guarded(self._run, name="zsched-web-feed")

    def start(self) -> None:
        """Begin to ask."""
        self._thread.start()

    def close(self) -> None:
        """End every client."""
        self._closing.set()
        self._joined.set()
        with self._lock:
            for client in self._clients:
                _drop(client)
            self._clients.clear()

    # --- who looks ---------------------------------------------------------------------------------------------------

    def join(self) -> Client | None:
        """A new client, which gets everything so far first; ``None``: there are as many as may be."""
        client = Client()
        with self._lock:
            if self._closing.is_set() or len(self._clients) >= self._most:
                return None
            client.messages.put(_message("past", self._whole()))
            client.messages.put(_message("now", self._present()))
            self._clients.append(client)
        self._joined.set()
        return client

    def leave(self, client: Client) -> None:
        """It looks no more."""
        with self._lock:
            if client in self._clients:
                self._clients.remove(client)

    # --- single questions --------------------------------------------------------------------------------------------

    def status(self) -> Json:
        """What is known now: the newest status, when it was told, and what is wrong; at most `PERIOD_S` old."""
        self._step_if_old()
        with self._lock:
            return self._present()

    def metrics(self) -> str:
        """The status as Prometheus' text, at most `PERIOD_S` old; ``zsched_up 0`` alone while nobody answers."""
        self._step_if_old()
        with self._lock:
            status = None if self._past.why else self._past.status
        return down_text() if status is None else metrics_text(status)

    def explain(self, task: str) -> Json:
        """Why a task is where it is, as ``zsched.explain/1`` has it.

        Raises:
            CliError: nobody answers, there is no such task, or no judgement yet.
        """
        with self._explaining:  # one question at a time, however many ask
            at, body = self._explained.get(task, (-EXPLAIN_S, {}))
            if body and monotonic_s() - at < EXPLAIN_S:
                return body
            body, _ = explanation(self._feed.door(), task)
            if len(self._explained) >= MOST_EXPLAINED:
                self._explained.clear()
            self._explained[task] = (monotonic_s(), body)
            return body

    # --- the feed: its thread, and who needs newer words ------------------------------------------------------------

    def _run(self) -> None:
        while not self._closing.is_set():
            self._step()
            with self._lock:
                is_watched = bool(self._clients) or bool(self._past.why)
                self._joined.clear()
            if not is_watched:
                self._joined.wait(IDLE_S - PERIOD_S)
            self._closing.wait(PERIOD_S)

    def _step_if_old(self) -> None:
        with self._asking:
            if monotonic_s() - self._asked_at > PERIOD_S:
                self._ask()

    def _step(self) -> None:
        with self._asking:
            self._ask()

    def _ask(self) -> None:
        self._asked_at = monotonic_s()
        news = self._feed.ask()
        with self._lock:
            before = self._moved()
            self._past.take(news)
            messages = [_message("now", self._present())]
            if news.entries or self._moved() != before:
                messages.append(_message("log", {"events": list(news.entries), "moves": self._past.moves()}))
            self._clients = [client for client in self._clients if _give(client, messages)]

    def _moved(self) -> list[tuple[str, int]]:
        return [(move["task"], move["epoch"]) for move in self._past.moves()]

    def _present(self) -> Json:
        past = self._past
        status = past.status
        body: Json = {"why": past.why, "answered_at": past.answered_at, "status": status, "points": {}}
        if status is not None:
            body |= {"degraded": list(degradations(status)), "problems": all_problems(status)}
            body["points"] = {task: _plain(points[-1]) for task, points in past.points.items()}
        return body

    def _whole(self) -> Json:
        points = {task: [_plain(point) for point in kept] for task, kept in self._past.points.items()}
        return {"points": points, "moves": self._past.moves(), "events": list(self._past.events)}


def _plain(point: Point) -> Json:
    totals = {name: round(total, 4) for name, total in point.totals.items()}
    return {"at": round(point.at, 3), "owner": point.owner, "totals": totals}


def _message(kind: str, body: Json) -> Message:
    return f"event: {kind}\ndata: {json.dumps(body)}\n\n".encode()


def _give(client: Client, messages: Iterable[Message]) -> bool:
    """False: it is too far behind, and has been dropped."""
    for message in messages:
        if client.messages.qsize() >= WAITING:
            _drop(client)
            return False
        client.messages.put_nowait(message)
    return True


def _drop(client: Client) -> None:
    """There is room for one more than it may be behind: for this."""
    client.is_dropped = True
    with contextlib.suppress(queue.Full):
        client.messages.put_nowait(None)
