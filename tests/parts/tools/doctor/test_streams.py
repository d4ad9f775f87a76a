"""Two programs that publish one input, and an output that nobody takes, over real sessions."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import zenoh

from support.clinic import answer, assert_finds, run, scene_of
from zsched.core.route.ros2 import Attachment, encode_attachment
from zsched.link.sessions import config as zenoh_config
from zsched.tools.doctor.model import Scene, Verdict
from zsched_lab.fleet.loopback import free_endpoint

KEY = "robot1/map"


class Site:
    """A node's data network, which programs publish to in turns until the test ends."""

    def __init__(self, endpoint: str) -> None:
        self._config = zenoh_config.client_config(connect=(endpoint,))
        self._hub = zenoh.open(zenoh.Config.from_json5(zenoh_config.data_config(listen=(endpoint,), connect=())))
        self._sessions: list[zenoh.Session] = []
        self._attachments: list[bytes | None] = []
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._publish)

    @property
    def sides(self) -> dict[str, str]:
        return {"fleet": self._config}

    def publish(self, *attachments: bytes | None, has_stamps: bool = False) -> None:
        """One program for each attachment."""
        for attachment in attachments:
            config = zenoh.Config.from_json5(self._config)
            config.insert_json5("timestamping/enabled", json.dumps(has_stamps))
            self._sessions.append(zenoh.open(config))
            self._attachments.append(attachment)
        self._thread.start()

    def subscribe(self, key_expr: str, mode: str) -> None:
        """One program that joins as a client, or as one peer of others."""
        config = zenoh.Config.from_json5(self._config)
        config.insert_json5("mode", json.dumps(mode))
        self._sessions.append(zenoh.open(config))
        self._sessions[-1].declare_subscriber(key_expr, lambda _: None)

    def _publish(self) -> None:
        while not self._end.wait(0.05):
            for session, attachment in zip(self._sessions, self._attachments, strict=True):
                session.put(KEY, b"map", attachment=attachment)

    def close(self) -> None:
        self._end.set()
        if self._attachments:
            self._thread.join()
        for session in (*self._sessions, self._hub):
            session.close()


@pytest.fixture
def site() -> Iterator[Site]:
    made = Site(free_endpoint())
    yield made
    made.close()


@pytest.fixture
def scene(tmp_path: Path, site: Site) -> Scene:
    return replace(scene_of(tmp_path, node="robot1"), sides=site.sides)


def ros(gid: bytes) -> bytes:
    return encode_attachment(Attachment(sequence=1, stamp_ns=1, gid=gid * 16))


def test_two_ros_nodes_on_one_topic_are_found(scene: Scene, site: Site) -> None:
    site.publish(ros(b"a"), ros(b"b"))
    assert_finds(run("stream.twice", scene), Verdict.WARN, "robot1/map has 2 publishers", "61616161")


def test_two_programs_that_stamp_their_messages_are_found(scene: Scene, site: Site) -> None:
    site.publish(None, None, has_stamps=True)
    assert_finds(run("stream.twice", scene), Verdict.WARN, "robot1/map has 2 publishers")


def test_one_publisher_passes_and_of_silent_ones_nothing_is_claimed(scene: Scene, site: Site) -> None:
    site.publish(ros(b"a"))
    assert run("stream.twice", scene).verdict is Verdict.PASS


def test_of_publishers_that_do_not_tell_who_they_are_nothing_is_claimed(scene: Scene, site: Site) -> None:
    site.publish(None, None)
    result = run("stream.twice", scene)
    assert result.verdict is Verdict.SKIP
    assert "do not tell who they are" in result.evidence[0]


def test_a_data_network_that_cannot_be_joined_is_found(scene: Scene) -> None:
    away = replace(scene, sides={"fleet": zenoh_config.client_config(connect=("tcp/127.0.0.1:1",))})
    assert_finds(run("stream.twice", away), Verdict.FAIL, "cannot be joined")


OUTPUT = {"stream": "merge/out/0", "from_expr": "edge1/robot1/global_map", "to_expr": "robot1/merged"}


def with_output(scene: Scene) -> Scene:
    """The daemon's answer tells of an output, too."""
    (task,) = scene.status["tasks"]
    (stream,) = task["streams"]
    return answer(scene, tasks=[{**task, "streams": [stream, {**stream, **OUTPUT}]}])


@pytest.mark.parametrize("mode", ["peer", "client"])
def test_an_output_that_nobody_takes_is_found(scene: Scene, site: Site, mode: str) -> None:
    merged = with_output(scene)
    assert_finds(run("stream.unheard", merged), Verdict.WARN, "nobody on robot1 subscribes to robot1/merged")
    assert "tcp/127.0.0.1:7458" in run("stream.unheard", merged).fix
    assert run("stream.unheard", answer(merged, up_s=3.0)).verdict is Verdict.SKIP
    site.subscribe("robot1/*", mode)
    assert run("stream.unheard", merged).verdict is Verdict.PASS
    own = {**site.sides, "local": zenoh_config.client_config(connect=("tcp/127.0.0.1:1",))}
    assert_finds(run("stream.unheard", replace(merged, sides=own)), Verdict.FAIL, "cannot be joined")
