"""A service through a whole fleet: the rule in the fleet file, real daemons, the owner killed under way."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
import zenoh

from zsched_lab.fleet.testbed import Testbed, echo_fleet

SERVICES = [{"from": "{robot}/ask", "to": "{target}/echo/{robot}/ask", "timeout_s": 5}]


@dataclass
class Asker:
    """Asks without a pause, from two threads; each request is a number of its own."""

    session: zenoh.Session
    answers: dict[int, list[tuple[float, str]]] = field(default_factory=dict)
    errors: dict[int, list[str]] = field(default_factory=dict)
    halt: threading.Event = field(default_factory=threading.Event)
    numbers: Iterator[int] = field(default_factory=itertools.count)

    def run(self) -> None:
        while not self.halt.is_set():
            number = next(self.numbers)
            self.answers[number], self.errors[number] = [], []
            for reply in self.session.get("robot1/ask", payload=str(number).encode(), timeout=8.0):
                if reply.ok is None:
                    assert reply.err is not None
                    self.errors[number].append(reply.err.payload.to_string())
                else:
                    assert reply.ok.payload.to_string() == str(number)
                    node = str(reply.ok.encoding).rsplit(";", 1)[-1]
                    self.answers[number].append((time.monotonic(), node))
            time.sleep(0.005)


@pytest.fixture
def bed(tmp_path: Path) -> Iterator[Testbed]:
    with Testbed(tmp_path, echo_fleet(robots=1, edges=2, task={"services": SERVICES})) as made:
        made.init()
        made.start()
        yield made


def test_requests_go_on_over_a_kill_of_the_owner_and_none_is_left_without_a_word(bed: Testbed) -> None:
    first = bed.wait_settled()
    asker = Asker(bed.app("robot1"))
    threads = [threading.Thread(target=asker.run) for _ in range(2)]
    for thread in threads:
        thread.start()
    try:
        bed.wait(lambda: sum(map(bool, asker.answers.values())) > 100, 60, "requests are answered")
        bed.kill(first)
        second = bed.wait_settled()
        assert second != first

        def by_second() -> int:
            return sum(node == second for got in tuple(asker.answers.values()) for _, node in got)

        bed.wait(lambda: by_second() > 100, 60, "the new owner answers")
    finally:
        asker.halt.set()
        for thread in threads:
            thread.join(60)
    assert not any(thread.is_alive() for thread in threads)
    words = {number: len(asker.answers[number]) + len(asker.errors[number]) for number in asker.answers}
    assert set(words.values()) == {1}, "one answer or one error for each"
    errors = [error for said in asker.errors.values() for error in said]
    assert len(errors) <= 2, errors  # those that were in the owner's hands
    assert all(error.startswith("owner gone: ") for error in errors), errors

    def counted() -> int:
        return sum(one["messages"] for one in bed.task("robot1")["streams"] if one["stream"] == "echo/srv/0")

    bed.wait(lambda: counted() == len(words), 60, "the status counts every request")
