"""Puts the map-merging service on the data network: `zsched.worker` on one side, `MapMergeService` on the other.

Knows: keys, the worker's life. Does not know: how maps are merged.

    in   {prefix}/<robot>/map               nav_msgs/msg/OccupancyGrid, CDR
    out  {prefix}/{epoch}/global_map        nav_msgs/msg/OccupancyGrid, CDR; attachment {"merge": n, "inputs": {...}}
         {prefix}/{epoch}/tf                tf2_msgs/msg/TFMessage, CDR
         {prefix}/{epoch}/status            JSON
    asked {prefix}/<robot>/merge_now        merge at once; the answer is the status, JSON
"""

from __future__ import annotations

import argparse
import logging
import os
import queue
from collections.abc import Mapping

import cv2

import zsched.worker
from zsched.core.values.plan import WorkerRole
from zsched.host.clock import monotonic_s
from zsched.tasks.map_merge.merger import MergerSettings, Mode
from zsched.tasks.map_merge.pairs import Rule
from zsched.tasks.map_merge.poses import read_poses
from zsched.tasks.map_merge.ros import RosPublisher
from zsched.tasks.map_merge.service import MapMergeService, Output
from zsched.worker import Received, Worker

TASK = "map_merge"
POLL_S = 0.05
"""How often the main thread looks for work; half of it is added to a merge's latency."""


def run(options: argparse.Namespace) -> None:
    """Merge until told to stop.

    Raises:
        ConfigError: the poses or the worker's environment are wrong.
    """
    settings = _settings(options)
    cv2.setNumThreads(options.threads)
    with Worker.from_env(standalone=TASK if options.standalone else "") as worker:
        outputs = {
            output: worker.publisher(f"{{prefix}}/{{epoch}}/{output.value}", latest=True, keep_last=1)
            for output in Output
        }

        ros = _ros_publishers(outputs) if options.ros2 else {}

        def publish(output: Output, payload: bytes, attachment: bytes | None = None) -> bool:
            if output in ros:
                return ros[output].put(payload)
            return outputs[output].put(payload, attachment=attachment)

        service = MapMergeService(
            settings,
            publish,
            clock=monotonic_s,
            rate_hz=options.rate,
            job=lambda skipped: worker.job(skipped=skipped),
        )

        def on_map(received: Received) -> None:
            robot = received.key.removeprefix(f"{worker.prefix}/").removesuffix("/map")
            service.receive(robot, received.payload.to_bytes(), is_deleted=received.deleted)

        restored: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        worker.on_snapshot(restored.put)  # `restore` and `step` share a thread
        worker.subscribe("{prefix}/*/map", on_map, keep_last=1)
        worker.offer_snapshot(service.snapshot)
        worker.serve("{prefix}/*/merge_now", lambda _request: service.merge_now())
        worker.ready()
        while worker.wait(POLL_S):
            is_active = worker.role.role is not WorkerRole.IDLE  # read first: what comes before it is in the queue
            while not restored.empty():
                service.restore(restored.get())
            service.step(is_active=is_active)
    if service.is_searching:
        logging.shutdown()
        os._exit(0)  # a thread inside OpenCV would delay the interpreter's end, or abort it


def _ros_publishers(outputs: Mapping[Output, zsched.worker.Output]) -> dict[Output, RosPublisher]:
    """The outputs that are ROS messages; the status is not one."""

    def publisher(output: zsched.worker.Output) -> RosPublisher:
        return RosPublisher(lambda payload, attachment: output.put(payload, attachment=attachment))

    return {name: publisher(outputs[name]) for name in (Output.GLOBAL_MAP, Output.TF)}


def _settings(options: argparse.Namespace) -> MergerSettings:
    rule = Rule(min_score=options.min_score, min_agreeing=options.min_agreeing, min_margin=options.min_margin)
    return MergerSettings(
        mode=Mode(options.mode),
        resolution=options.resolution,
        poses=read_poses(options.pose, options.poses),
        rule=rule,
        world_frame=options.world_frame,
    )
