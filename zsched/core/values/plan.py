"""The frozen values that pass between the executor, the route stage and the relay process.

Knows: streams, routes, slots, plans, roles, counters. Does not know: zenoh, pipes, or why a task moved.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from zsched.core.values.limits import Range, check_ranges, key
from zsched.core.values.model import MAX_COUNTER, NodeId, TaskId, check_counter, check_name
from zsched.core.values.struct import Struct
from zsched.core.values.words import check_range, missed


class Direction(StrEnum):
    """Inputs go from the robot's applications to the owner's worker, outputs come back; services are asked."""

    INPUT = "input"
    OUTPUT = "output"
    SERVICE = "service"


class StreamClass(StrEnum):
    """The needs of a stream (classes of streams in docs/guide/streams.md)."""

    BEST_EFFORT = "best_effort"
    LATEST = "latest"
    RELIABLE = "reliable"


class HandoverRule(StrEnum):
    """When an output switches to the new owner: at its first sample, or after the old one's last."""

    LATEST = "latest"
    ALL = "all"


class OnCrash(StrEnum):
    """Inputs of class ``reliable``: the fate of samples that an owner had not acknowledged when it died."""

    REPORT = "report"  # they are counted: each is done at most once
    REPLAY = "replay"  # the next owner gets them: each is done at least once


class RosGraph(StrEnum):
    """In which ROS graph a stream's endpoints are announced (`zsched.core.route.ros2`)."""

    NONE = "none"
    RMW_ZENOH = "rmw_zenoh"
    ROS2DDS = "ros2dds"


class ReadyWhen(StrEnum):
    """How the relay knows that a worker can take its inputs."""

    TOKEN = "token"  # zsched.worker's liveliness token on the data session
    MATCHING = "matching"  # a foreign worker: a subscriber matches


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamSettings:
    """How one stream is carried."""

    stream_class: StreamClass = key(StreamClass.BEST_EFFORT, "What the stream needs.", name="class")
    keep_last: int = key(
        1, "Class `latest`: samples per key and publisher that a new owner gets at once.", Range(0, 1000)
    )
    depth: int = key(16, "Samples that may wait between subscriber and publisher.", Range(1, 100_000))
    handover: HandoverRule = key(
        HandoverRule.LATEST, "Outputs: switch at the new owner's first sample, or lose nothing."
    )
    max_hz: float | None = key(
        None, "Highest rate per key; not for `reliable`.", Range(0.01, 10_000, "Hz"), shown="no limit"
    )
    """The rest is dropped, the newest of class ``latest`` never."""
    mirror: bool = key(False, "Inputs: feed both owners during a move (outputs with `handover: latest`).")
    graph: RosGraph = RosGraph.NONE
    """Set by the fleet file's `ros2:` sections."""
    on_crash: OnCrash = key(
        OnCrash.REPORT,
        "Inputs of class `reliable`: samples that a dead owner had not acknowledged are reported (done at most once) "
        "or replayed (at least once).",
    )

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class ServiceSettings:
    """How the requests of one service are carried."""

    retry: bool = key(False, "Ask the next owner when the old one did not answer: it may be done twice.")
    timeout_s: float = key(10.0, "Every request is answered within this time.", Range(0.05, 3600, "s"))
    """With an error if need be."""
    hold_s: float = key(3.0, "How long a request waits for an owner while there is none.", Range(0, 3600, "s"))
    """With `retry`: as long as the request's time lasts.

    The default is what a killed owner's takeover may take at most with the profile ``wifi``, 1.8 s, and an exclusive
    task's lease on top (docs/design/timing.md).
    """
    max_pending: int = key(16, "Requests at the owner at one time; then `busy`.", Range(1, 256))

    def __post_init__(self) -> None:
        check_ranges(self)


class Route(Struct, frozen=True, kw_only=True):
    """One stream of one robot for one owner, with every placeholder filled in (concrete key expressions)."""

    stream: str
    """Stable name of the rule on this node, e.g. ``map_merge/in/0``: counters and kept values belong to it."""
    direction: Direction
    from_expr: str
    to_expr: str
    settings: StreamSettings
    service: ServiceSettings = ServiceSettings()
    """Services only."""

    @property
    def near(self) -> str:
        """The robot's end of an input or an output: the key that its applications know."""
        return self.from_expr if self.direction is Direction.INPUT else self.to_expr


class Slot(Struct, frozen=True, kw_only=True):
    """The routes of one task towards one owner in one epoch."""

    epoch: int
    owner: NodeId
    routes: tuple[Route, ...]
    ready_when: ReadyWhen


class DrainingSlot(Struct, frozen=True, kw_only=True):
    """A slot that the relay has left ``since_s`` ago, and that has not drained."""

    epoch: int
    owner: NodeId
    since_s: float = 0.0

    def __post_init__(self) -> None:
        check_counter("draining.epoch", self.epoch)
        check_name("draining.owner", self.owner)
        check_range("draining.since_s", self.since_s, 0.0, MAX_COUNTER)


class RoutePhase(StrEnum):
    """How far the handover to `RoutePlan.current` may go (the executor's table decides, the relay obeys)."""

    PREPARE = "prepare"  # open the new slot, watch for readiness; the old slot still carries the streams
    FLIP = "flip"  # warm up and switch; the old slot drains
    CLOSE = "close"  # drop every old slot


class RoutePlan(Struct, frozen=True, kw_only=True):
    """What this node's relay shall do for one task; the newest plan of a task replaces the previous one whole.

    ``predecessors`` are the slots that were left and have not drained, the oldest first, and last the one that carries
    until the flip. The relay closes every slot that the plan does not name.
    """

    task: TaskId
    phase: RoutePhase
    current: Slot | None
    predecessors: tuple[Slot, ...] = ()


class WorkerRole(StrEnum):
    """The role that a worker is told."""

    IDLE = "idle"
    ACTIVE = "active"
    DRAINING = "draining"


class Role(Struct, frozen=True, kw_only=True):
    """The role of this node's worker for one task; ``epoch`` is 0 while idle.

    ``predecessor`` is the owner of the epoch before, whose worker may still have a snapshot of its state; ``None`` when
    there was none, or it is known to be gone.

    ``lease_until_s`` is set for exclusive tasks only: the worker publishes nothing from then on (seconds of this
    machine by `zsched.host.clock.monotonic_s`; 0: it has no lease yet).
    """

    task: TaskId
    role: WorkerRole
    epoch: int = 0
    lease_until_s: float | None = None
    predecessor: NodeId | None = None


STILL_S = 2.0
"""A stream without a message for this long is still: nothing has come for two periods of the counters."""


class StreamCount(Struct, frozen=True, kw_only=True):
    """Counters of one stream, over all relays of this node since its service started."""

    stream: str
    messages: int = 0
    bytes: int = 0
    drops: tuple[tuple[str, int], ...] = ()
    """(reason, count): ``overflow``, ``no_route``, ``stale_epoch``, ``loop``, ``stalled``..."""
    dropped_s: float | None = None
    """Filled in by the status: seconds since `missed` last rose; ``None``: not since the daemon's start."""
    last_seen_s: float | None = None
    """Seconds since the newest message, ``None`` before the first."""
    acknowledged: int | None = None
    """Inputs: samples that workers have processed; ``None``: no worker counts them (a foreign one)."""
    in_flight: int | None = None
    """Inputs: samples taken and not processed yet: they wait here, or were sent and are not acknowledged."""
    lost: int = 0
    """Numbers that never came over the hop."""
    doubled: int = 0
    """Numbers that came twice and were dropped."""
    reordered: int = 0
    """Numbers that came behind newer ones and were dropped."""
    replayed: int = 0
    """Kept values sent once more to a new owner, and samples sent again for want of an acknowledgement, or after a
    crash (`OnCrash.REPLAY`)."""
    at_most_lost: int = 0
    """Inputs: in flight to workers that died: at most this many had no result."""
    repeated: int = 0
    """Inputs: samples that were given to one more receiver: kept values and mirrors."""
    unsent: int = 0
    """Inputs of class ``latest``: values that came while there was no owner; the newest are kept for the next one."""
    unconfirmed: int = 0
    """Inputs: sent to a worker that acknowledges nothing (a foreign one): nobody knows what came of them."""
    answer_s: float | None = None
    """Outputs: mean seconds from inputs to their answers since the count before, network included. An answer without
    its input's timestamp counts since the newest input before it: a lower bound, told where no other is known."""
    paired_hz: float | None = None
    """Outputs: answers per second since then that had their input's timestamp, from which ``answer_s`` is; ``None``:
    none had."""
    gap_s: float | None = None
    """Outputs: the longest time between two answers that passed, since the count before; ``None``: no two have passed.
    The status tells the longest of the last seconds (`zsched.core.route.gaps`)."""
    move_gap_s: float | None = None
    """Outputs: seconds between the last answer of the owner before and the first one of `move_epoch`."""
    move_epoch: int = 0
    """Outputs: the newest epoch whose owner has answered after another one's; 0: there was none."""
    from_expr: str = ""
    """Filled in by the status: the keys of the newest slot, empty while the task has no owner."""
    to_expr: str = ""
    hz: float | None = None
    """Filled in by the status: messages per second over the last seconds, ``None`` while that is not known."""
    bytes_per_s: float | None = None

    @property
    def missed(self) -> int:
        """Samples that somebody may miss."""
        return missed(self.drops, self.lost, self.at_most_lost)

    def is_still(self, told_s: float = 0.0) -> bool:
        """Whether nothing flows and nothing is under way, by what was told ``told_s`` ago."""
        return not self.in_flight and (self.last_seen_s is None or self.last_seen_s + told_s >= STILL_S)
