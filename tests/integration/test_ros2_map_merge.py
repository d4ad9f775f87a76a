"""configs/ros2.yaml as it stands: robots whose ROS nodes publish /map, the real merging worker, ROS messages back."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import zenoh
from zenoh import ext

from support.books import assert_nothing_is_unaccounted
from support.waiting import free_endpoint, until
from zsched.config.load import load_fleet
from zsched.core.route.ros2 import Attachment, decode_attachment, encode_attachment
from zsched.core.route.route import plan_for, slot_for
from zsched.core.values.events import RelayChanged, SlotFlipped, SlotReady
from zsched.core.values.fleet import LocalSide
from zsched.core.values.plan import Role, RoutePhase, WorkerRole
from zsched.core.values.relay_protocol import HandleReport
from zsched.link.sessions.config import client_config, data_config, local_config, worker_config
from zsched.runtime.relay.streams import RelayHandle
from zsched.tasks.map_merge.cdr import decode_grid, decode_transforms, encode_grid
from zsched.tasks.map_merge.geometry import Pose2
from zsched.tasks.map_merge.grid import Grid
from zsched_lab.fleet.relays import hello_of

CONFIG = Path(__file__).parents[2] / "configs" / "ros2.yaml"
GRID = "nav_msgs::msg::dds_::OccupancyGrid_/RIHS01_8d348150c12913a31ee0ec170fbf25089e4745d17035792a1ba94d6f0bc0cfc7"
TF = "tf2_msgs::msg::dds_::TFMessage_/RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"
ROBOTS = ("robot1", "robot2")


def opened(text: str, **more: str) -> zenoh.Session:
    config = zenoh.Config.from_json5(text)
    for key, value in {"timestamping/enabled": "true", **more}.items():
        config.insert_json5(key, value)
    return zenoh.open(config)


class Host:
    """A robot: a router, a node with a latched /map, listeners to the results, the relay."""

    def __init__(self, stack: contextlib.ExitStack, folder: Path, name: str, listen: str, seed: str) -> None:
        endpoint = free_endpoint()
        more = {"mode": '"router"', "listen/endpoints": f'["{endpoint}"]'}
        stack.callback(opened(client_config(connect=()), **more).close)
        self.name = name
        self.heard: dict[str, list[zenoh.Sample]] = {"merged_map": [], "tf_static": []}
        self.reports: list[HandleReport] = []
        node = opened(client_config(connect=(endpoint,)))
        stack.callback(node.close)
        self.publisher = ext.declare_advanced_publisher(
            node, f"0/map/{GRID}", cache=ext.CacheConfig(1), publisher_detection=True
        )
        stack.callback(self.publisher.undeclare)
        for topic, kind in (("merged_map", GRID), ("tf_static", TF)):
            node.declare_subscriber(f"0/{topic}/{kind}", self.heard[topic].append)
        self.relay = RelayHandle(
            hello=hello_of("ros_fleet", name),
            path=folder / f"{name}.relay",
            zenoh_config=data_config(listen=(listen,), connect=() if listen == seed else (seed,), shared_memory=False),
            on_report=self.reports.append,
            local_config=local_config(LocalSide(connect=(endpoint,))),
        )
        self.relay.start()
        stack.callback(self.relay.stop, 2.0)

    def publish(self, grid: Grid) -> None:
        value = Attachment(sequence=1, stamp_ns=time.time_ns(), gid=os.urandom(16))
        self.publisher.put(encode_grid(grid), attachment=encode_attachment(value))

    def wait(self, kind: type) -> None:
        until(lambda: any(isinstance(one, kind) for one in tuple(self.reports)), f"{kind.__name__} of {self.name}")


@pytest.fixture
def hosts(tmp_path: Path) -> Iterator[dict[str, Host]]:
    task = load_fleet(CONFIG).task("map_merge")
    assert "--ros2" in task.worker.command
    seed, edge = free_endpoint(), free_endpoint()
    with contextlib.ExitStack() as stack:
        ends = {name: seed if name == ROBOTS[0] else free_endpoint() for name in ROBOTS}
        made = {name: Host(stack, tmp_path, name, end, seed) for name, end in ends.items()}
        relay = RelayHandle(
            hello=hello_of("ros_fleet", "edge1"),
            path=tmp_path / "edge1.relay",
            zenoh_config=data_config(listen=(edge,), connect=(seed,), shared_memory=False),
            on_report=lambda _report: None,
        )
        relay.start()
        stack.callback(relay.stop, 2.0)
        relay.set_role(Role(task="map_merge", role=WorkerRole.ACTIVE, epoch=1))
        stack.callback(_reap, _start_worker(tmp_path, edge))
        for host in made.values():
            host.wait(RelayChanged)
            for phase, kind in ((RoutePhase.PREPARE, SlotReady), (RoutePhase.FLIP, SlotFlipped)):
                host.relay.apply(plan_for(task, phase, slot_for(task, host.name, "edge1", 1), ()))
                host.wait(kind)
        yield made
        for host in made.values():
            assert_nothing_is_unaccounted(lambda host=host: tuple(host.reports))  # type: ignore[misc] # at once


def _start_worker(folder: Path, edge: str) -> subprocess.Popen[bytes]:
    path = folder / "worker.json5"
    path.write_text(worker_config(connect=(edge,), shared_memory=False))
    env = os.environ | {
        "ZSCHED_FLEET": "ros_fleet",
        "ZSCHED_NODE": "edge1",
        "ZSCHED_TASK": "map_merge",
        "ZSCHED_INCARNATION": "1",
        "ZSCHED_ZENOH_CONFIG": str(path),
    }
    poses = [word for name in ROBOTS for word in ("--pose", f"{name}=0,0,0")]
    command = [sys.executable, "-m", "zsched.tasks.map_merge", "--mode", "known", "--ros2", *poses]
    return subprocess.Popen(command, env=env, stderr=subprocess.DEVNULL)


def _reap(worker: subprocess.Popen[bytes]) -> None:
    worker.kill()
    worker.wait(60)


def test_ros_nodes_get_the_merged_map_with_their_attachment(hosts: dict[str, Host]) -> None:
    for number, host in enumerate(hosts.values()):
        data = np.full((40, 40), -1, dtype=np.int8)
        data[5:35, 5 + 10 * number : 20 + 10 * number] = 0
        data[5:35, 5 + 10 * number] = 100
        host.publish(Grid(data=data, resolution=0.05, origin=Pose2(x=0, y=0, yaw=0), stamp_ns=7, frame_id="map"))

    def merged(host: Host) -> bool:
        maps = [decode_grid(sample.payload.to_bytes()) for sample in tuple(host.heard["merged_map"])]
        frames = {
            transform.child
            for sample in tuple(host.heard["tf_static"])
            for transform in decode_transforms(sample.payload.to_bytes())
        }
        return bool(maps) and (maps[-1].data == 100).sum() >= 60 and frames == {"robot1/map", "robot2/map"}

    for host in hosts.values():
        until(lambda host=host: merged(host), f"the map of both robots at {host.name}")  # type: ignore[misc] # bound at once
        for samples in host.heard.values():
            values = [decode_attachment(one.attachment.to_bytes()) for one in samples if one.attachment is not None]
            assert len(values) == len(samples)
            numbers = [value.sequence for value in values if value is not None]
            assert len(numbers) == len(samples), "every attachment is rmw_zenoh's"
            assert numbers == sorted(numbers)
            assert len({value.gid for value in values if value is not None}) == 1
