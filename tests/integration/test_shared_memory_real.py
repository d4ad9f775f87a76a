"""`shared_memory: auto` in a fleet file: large payloads go that way within a machine, or status says why not."""

from __future__ import annotations

from pathlib import Path

import pytest
import zenoh

from support.waiting import until
from zsched.link.sessions.config import client_config
from zsched_lab.fleet.testbed import Testbed, echo_fleet

LARGE = bytes(1 << 18)


def is_shared(bed: Testbed, *, is_wanted: bool = False) -> bool:
    """Whether an answer to a large question came through shared memory: of twenty, or ever where ``is_wanted``.

    A message goes the other way while no segment is free: that of a machine too busy to read them says nothing.
    """
    endpoint = bed.fleet.node("robot1").listen_data
    config = client_config(connect=(endpoint,), timing=bed.fleet.timing, shared_memory=True)
    taken: list[bool] = []
    with zenoh.open(zenoh.Config.from_json5(config)) as session:
        publisher = session.declare_publisher("robot1/in")
        subscriber = session.declare_subscriber(
            "robot1/out", lambda sample: taken.append(sample.payload.as_shm() is not None)
        )
        until(lambda: publisher.put(LARGE) or (any(taken) if is_wanted else len(taken) >= 20), "answers")
        subscriber.undeclare()
    return any(taken)


@pytest.mark.parametrize("word", ["auto", "off"])
def test_the_fleet_files_word_on_shared_memory_holds(tmp_path: Path, word: str) -> None:
    tree = {**echo_fleet(robots=1, edges=1), "shared_memory": word}
    with Testbed(tmp_path, tree) as bed:
        bed.init()
        bed.start()
        bed.wait_settled()
        problems = [text for text in bed.status("robot1")["problems"] if "shared memory" in text]
        if word == "off":
            assert problems == []
            assert not is_shared(bed)
        else:
            assert is_shared(bed, is_wanted=not problems) is not bool(problems)


def test_a_reliable_stream_keeps_it_off_and_status_says_so(tmp_path: Path) -> None:
    tree = {**echo_fleet(robots=1, edges=1, stream_class="reliable"), "shared_memory": "auto"}
    with Testbed(tmp_path, tree) as bed:
        bed.init()
        bed.start()
        bed.wait_settled()
        assert any("class reliable" in text for text in bed.status("robot1")["problems"])
        assert not is_shared(bed)
