"""Holds what zsched believes of rmw_zenoh_cpp against live ROS 2 containers, Humble and Kilted: keys, tokens, bytes.

    .venv/bin/python tests/live/rmw_zenoh.py [DISTRO ...]

Each container runs rmw_zenoh's router, a publisher, a listener and a service; a zenoh session here reads and writes
what `zsched.core.route.ros2` says. Needs podman or docker, and a registry or the images `localhost/zsched-ros:DISTRO`
(ROS with ros-DISTRO-rmw-zenoh-cpp and ros-DISTRO-demo-nodes-cpp). Where they are missing it says `skipped` with why,
and ends with 0; with 1 when a fact does not hold. CI does not run it: it has bytes that were caught from a live one
(tests/unit/core/route/test_ros2.py).
"""

from __future__ import annotations

import os
import queue
import shutil
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

import zenoh

from zsched.core.route import ros2
from zsched.core.values.plan import RosGraph
from zsched.link.sessions.config import client_config

T = TypeVar("T")
DISTROS = ("humble", "kilted")
ROUTER = "tcp/127.0.0.1:7447"
STRING = "std_msgs::msg::dds_::String_"
DEADLINE_S = 60.0
PULL_S = 900.0
RECIPE = """FROM docker.io/library/ros:{distro}-ros-base
RUN apt-get update && apt-get install -y ros-{distro}-rmw-zenoh-cpp ros-{distro}-demo-nodes-cpp
"""
START = """. /opt/ros/{distro}/setup.sh; export RMW_IMPLEMENTATION=rmw_zenoh_cpp
ros2 run rmw_zenoh_cpp rmw_zenohd & sleep 3
ros2 topic pub --rate 5 /chatter std_msgs/msg/String '{{data: live}}' > /dev/null &
ros2 topic echo /answer std_msgs/msg/String &
ros2 run demo_nodes_cpp add_two_ints_server & wait
"""


class SkippedError(Exception):
    """It cannot be tried here; says why."""


def engine() -> str:
    """What runs containers. Raises `SkippedError`."""
    found = next((name for name in ("podman", "docker") if shutil.which(name)), None)
    if found is None:
        raise SkippedError("neither podman nor docker is installed")
    return found


def image(run: str, distro: str) -> str:
    """An image with the distribution, built where there is none. Raises `SkippedError`."""
    name = f"localhost/zsched-ros:{distro}"
    if subprocess.run([run, "image", "inspect", name], capture_output=True, timeout=60, check=False).returncode == 0:
        return name
    command = [run, "build", "--network=host", "-t", name, "-"]
    recipe = RECIPE.format(distro=distro)
    try:
        made = subprocess.run(command, input=recipe, capture_output=True, text=True, timeout=PULL_S, check=False)
    except subprocess.TimeoutExpired as error:
        raise SkippedError(f"no image of ROS 2 {distro} within {PULL_S:.0f} s: is there a registry?") from error
    if made.returncode != 0:
        last = (made.stderr.strip() or made.stdout.strip()).splitlines()[-1:]
        raise SkippedError(f"no image of ROS 2 {distro} can be had: {' '.join(last)[-200:]}")
    return name


@contextmanager
def live(run: str, distro: str) -> Iterator[Callable[[], str]]:
    """The distribution's nodes; gives what they have printed."""
    name = f"zsched-ros-{distro}-{os.getpid()}"
    command = [run, "run", "--rm", "-d", "--network=host", "--name", name, image(run, distro)]
    began = subprocess.run(
        [*command, "bash", "-c", START.format(distro=distro)], capture_output=True, text=True, timeout=120, check=False
    )
    if began.returncode != 0:
        raise SkippedError(f"{run} starts nothing here: {began.stderr.strip()[-200:]}")
    try:
        yield (
            lambda: subprocess.run([run, "logs", name], capture_output=True, text=True, timeout=30, check=False).stdout
        )
    finally:
        subprocess.run([run, "rm", "--force", name], capture_output=True, timeout=60, check=False)


def within(look: Callable[[], T | None], what: str) -> T:
    """Wait for something. Raises `AssertionError`."""
    end = time.monotonic() + DEADLINE_S
    while (found := look()) is None:
        assert time.monotonic() < end, f"not within {DEADLINE_S:.0f} s: {what}"
        time.sleep(0.1)
    return found


def text_cdr(text: str) -> bytes:
    """A std_msgs/String as CDR, little endian."""
    data = text.encode() + b"\0"
    return b"\0\1\0\0" + struct.pack("<I", len(data)) + data


def facts(session: zenoh.Session, printed: Callable[[], str]) -> Iterator[str]:
    """Each fact that holds, in words; raises `AssertionError` at the first that does not."""
    heard: queue.Queue[zenoh.Sample] = queue.Queue(1000)
    chatter = ros2.ros_key(RosGraph.RMW_ZENOH, "/chatter", domain=0)
    session.declare_subscriber(chatter, lambda sample: heard.put(sample) if not heard.full() else None)
    first, second = heard.get(timeout=DEADLINE_S), heard.get(timeout=DEADLINE_S)
    key = str(first.key_expr)
    assert ros2.is_rmw_key(key), key
    assert key.split("/")[2] == STRING, key
    yield f"a publisher's key is as ours: {key}"
    assert first.payload.to_bytes() == text_cdr("live"), first.payload.to_bytes().hex()
    yield "its payload is CDR with a header of four bytes"
    raw = [sample.attachment.to_bytes() if sample.attachment else b"" for sample in (first, second)]
    told = [ros2.decode_attachment(one) for one in raw]
    assert None not in told, f"attachments {[one.hex() for one in raw]}"
    one, two = (value for value in told if value is not None)
    assert two.sequence == one.sequence + 1, (one, two)
    assert (two.gid, ros2.encode_attachment(one)) == (one.gid, raw[0])
    assert abs(one.stamp_ns / 1e9 - time.time()) < DEADLINE_S, one
    yield f"its attachment is sequence, nanoseconds, id in {len(raw[0])} bytes: {raw[0].hex()}"

    def token() -> str | None:
        replies = session.liveliness().get(ros2.token_selector(RosGraph.RMW_ZENOH), timeout=5.0)
        names = (str(reply.ok.key_expr) for reply in replies if reply.ok is not None)
        return next((name for name in names if "/MP/" in name and "%chatter" in name), None)

    name = within(token, "the publisher's token")
    parsed = ros2.parse_token(name)
    assert parsed is not None, name
    assert (parsed[1].kind, parsed[1].key) == (ros2.EndpointKind.PUBLISHER, key), parsed
    yield f"its token is read: {name}"

    out = f"0/answer/{key.split('/', 2)[2]}"
    publisher = session.declare_publisher(out)
    sequence = 0

    def is_heard() -> bool | None:
        nonlocal sequence
        sequence += 1
        value = ros2.Attachment(sequence=sequence, stamp_ns=time.time_ns(), gid=bytes(range(16)))
        publisher.put(text_cdr("from zsched"), attachment=ros2.encode_attachment(value))
        return "from zsched" in printed() or None

    within(is_heard, f"`ros2 topic echo` prints what we publish on {out}:\n{printed()[-500:]}")
    yield "a ROS subscription takes samples with our attachment"
    service = ros2.ros_key(RosGraph.RMW_ZENOH, "/add_two_ints", domain=0)
    value = ros2.Attachment(sequence=1, stamp_ns=time.time_ns(), gid=bytes(range(16)))
    request = b"\0\1\0\0" + struct.pack("<qq", 20, 22)

    def answer() -> bytes | None:
        replies = session.get(service, payload=request, attachment=ros2.encode_attachment(value), timeout=5.0)
        return next((reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None), None)

    assert struct.unpack_from("<q", within(answer, "the service answers"), 4) == (42,)
    yield "a ROS service answers our query"


def main(distros: list[str]) -> int:
    """Try each distribution; the exit code."""
    failed = 0
    for distro in distros or DISTROS:
        try:
            with live(engine(), distro) as printed:
                time.sleep(5.0)
                with zenoh.open(zenoh.Config.from_json5(client_config(connect=(ROUTER,)))) as session:
                    for fact in facts(session, printed):
                        print(f"{distro}: ok: {fact}", flush=True)
        except SkippedError as error:
            print(f"{distro}: skipped: {error}", flush=True)
        except (AssertionError, queue.Empty, zenoh.ZError) as error:
            failed = 1
            print(f"{distro}: FAILED: {error!r}", flush=True)
    return failed


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
