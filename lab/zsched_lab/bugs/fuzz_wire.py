"""Feeds damaged frames of every kind to the codec and to a running node.

``python -m zsched_lab.bugs.fuzz_wire --frames N``.

Knows: how to make a valid frame of any class, and how to damage one by bytes or by structure. Does not know: what any
frame means.

What must hold: `wire.decode` returns a value of a known class or raises `WireError`, nothing else; what it returns is
encoded and decoded to itself; an invalid frame moves nothing in a node but a counter; no event takes 100 ms. The last
line is ``N frames, V violations``; the exit code is 1 when there is any.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
import types
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, fields, is_dataclass, replace
from enum import Enum
from random import Random
from typing import Any, Union, get_args, get_origin

import msgpack

from zsched.core.electorate.founding import founded
from zsched.core.node.node import Node
from zsched.core.node.status import build_snapshot
from zsched.core.values import codec as wire
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.beat import Beat
from zsched.core.values.document import Text
from zsched.core.values.durable import DurableState
from zsched.core.values.electorate import FleetValue
from zsched.core.values.errors import WireError
from zsched.core.values.fleet import Fleet, NodeSpec, TaskSpec, Timing, WorkerSpec, electorate_hash
from zsched.core.values.messages import (
    Accept,
    Accepted,
    Ballots,
    ChangeFleet,
    FleetAnswer,
    FleetQuestion,
    Learnt,
    Prepare,
    Promise,
    ReadHistory,
    Refused,
    TuneTask,
    Utilities,
    Votes,
    fleet_answer,
    votes_of,
)
from zsched.core.values.model import NodeKind, Proposal, ScoreForm, Tuning, Weights
from zsched.core.values.profile import DeviceSample, Profile, WorkerLoad, WorkerState
from zsched.core.values.rehearsal import FAULTS, Strike
from zsched.link.pipe import frames as relay_pipe
from zsched_lab.sim.network import mutated

REASONS = frozenset({"size", "garbage", "frame", "version", "kind", "type", "missing", "range", "checksum"})
LAG_S = 0.1
"""No event may keep the loop longer."""
NODE_SHARE = 4
"""Every fourth frame goes to the node as well."""
LOOK_EVERY = 200
"""How often the node's whole status is compared before and after an invalid frame (its registers always are)."""
DUE_AT_MOST = 8
NAMES = ("robot1", "robot2", "robot3", "edge1", "edge2", "ghost")
TASKS = ("merge", "other")
assert relay_pipe.REPORTS  # imported for the kinds that it registers

CLASSES: tuple[type[Any], ...] = tuple(cls for cls, _ in wire.KINDS.values())


# --- valid frames ----------------------------------------------------------------------------------------------------


FOUNDED = tuple(founded("lab", generation, ("robot1", "robot2")) for generation in (0, 1))


ONE_OF: dict[type, tuple[str, ...]] = {
    FleetQuestion: ("prepare", "accept"),
    FleetAnswer: ("promise", "accepted", "refused"),
    ChangeFleet: ("document", "add_elector", "remove_elector"),
}
"""{class: its fields of which exactly one is given}."""


def sample(hint: Any, rng: Random, name: str = "") -> Any:
    """Some value of a type hint; ``name`` is the field that holds it."""
    if hint is bool:
        return rng.random() < 0.5
    if hint is int:
        return rng.choice((0, 1, 2, 5, rng.randrange(1000)))
    if hint is float:
        return rng.random()
    if hint is Text:
        return rng.choice(("", "fleet: lab  # a comment\n"))
    if hint is str:
        return rng.choice(TASKS) if "task" in name else rng.choice(NAMES)
    origin, inner = get_origin(hint), get_args(hint)
    if origin is tuple and len(inner) == 2 and inner[1] is Ellipsis:
        return tuple(sample(inner[0], rng, name) for _ in range(rng.choice((0, 1, 1, 3))))
    if origin is tuple:
        return tuple(sample(one, rng, name) for one in inner)
    if origin in (Union, types.UnionType):
        (one,) = [part for part in inner if part is not type(None)]
        return None if rng.random() < 0.3 else sample(one, rng, name)
    if isinstance(hint, type) and issubclass(hint, Enum):
        return rng.choice(tuple(hint))
    return _dataclass(hint, rng)


def _dataclass(cls: Any, rng: Random) -> Any:
    made = get_origin(cls) or cls
    assert is_dataclass(made), cls
    if cls is Weights:
        cpu = rng.choice((0.0, 0.25, 1.0))
        return Weights(cpu=cpu, memory=1.0 - cpu, network=0.0)
    if cls is FleetValue:
        return rng.choice(FOUNDED)
    if cls is Ballots:
        return Ballots(
            prepares=(_dataclass(Prepare, rng),),
            accepts=(_dataclass(Accept, rng),),
            ahead=_dataclass(Prepare, rng),
            fleet=rng.choice(FOUNDED),
        )
    if cls is Votes:
        elector = rng.choice(NAMES)
        ahead = fleet_answer(replace(_dataclass(Accepted, rng), elector=elector))
        answers = (replace(_dataclass(kind, rng), elector=elector) for kind in (Promise, Accepted, Refused))
        return votes_of(answers, ahead)
    hints = wire.hints_of(cls)
    values = {one.name: sample(hints[one.name], rng, one.name) for one in fields(made)}
    if made is Accept:
        values["task"] = values["acceptance"].value.task
    if made is Strike:
        values["step"] = rng.choice(FAULTS)
    if made is ReadHistory:
        values["cursor"] = rng.choice(("", "4711:65536"))
    chosen = rng.choice(ONE_OF.get(made, ("",)))
    for other in ONE_OF.get(made, ()):
        if other != chosen:
            values[other] = "" if hints[other] is str else None
        while not values[chosen]:
            values[chosen] = sample(hints[chosen], rng, chosen)
    for _ in range(20):
        try:
            return made(**values)
        except ValueError as error:  # a range that the hint does not tell: the message names the field
            wrong = str(error).partition(":")[0].rpartition(".")[2]
            values[wrong] = _in_range(wrong, hints[wrong], rng)
    raise AssertionError(f"cannot make a {made.__name__}")


def _in_range(name: str, hint: Any, rng: Random) -> Any:
    if get_origin(hint) is tuple:
        return ()
    if hint is int or int in get_args(hint):
        return 1
    if hint is str:
        return rng.choice(("0d", "0e"))
    return -50.0 if "dbm" in name else 0.5 if "floor" in name else 1.0


# --- damaged frames --------------------------------------------------------------------------------------------------

HOSTILE: tuple[Any, ...] = (
    *(None, True, -1, 0, 2**53, 2**53 + 1, 2**63, -(2**63), 2**64 - 1, 1.5, -0.0, 1e308, math.nan, math.inf),
    *("", "x" * 600, "Robot 1", "\x00", "é", b"", b"\xff" * 10, [], {}, [[]], [1, 2, 3], {"node": "robot1"}),
    msgpack.ExtType(1, b"x"),
    msgpack.Timestamp(0),
)


def damaged(frames: list[bytes], rng: Random) -> bytes:
    """One frame, damaged somehow."""
    frame, how = rng.choice(frames), rng.random()
    if how < 0.55:
        return mutated(frame, rng)
    if how < 0.6:
        other = rng.choice(frames)
        return frame[: rng.randrange(len(frame))] + other[rng.randrange(len(other)) :]
    if how < 0.62:
        return rng.choice((b"\x91", b"\x81\xa1a")) * rng.choice((10, 600, 2000)) + frame
    parts = msgpack.unpackb(frame, strict_map_key=False)
    parts = _poisoned(parts, rng, 0)
    packed: bytes = msgpack.packb(parts)
    return packed


def _poisoned(value: Any, rng: Random, depth: int) -> Any:
    """The same structure with one part replaced, left out, repeated or renamed."""
    if isinstance(value, list) and value and rng.random() < 0.8:
        at, out = rng.randrange(len(value)), list(value)
        if depth == 0 and rng.random() < 0.8:
            at = len(value) - 1
        if rng.random() < 0.1:
            return out + out[at:]
        out[at] = _poisoned(out[at], rng, depth + 1)
        return out
    if isinstance(value, dict) and value and rng.random() < 0.9:
        key = rng.choice(list(value))
        rest = {name: part for name, part in value.items() if name != key}
        how = rng.random()
        if how < 0.1:
            return rest
        if how < 0.15:
            return {**rest, rng.choice(("new", 7, "")): value[key]}
        return {**rest, key: _poisoned(value[key], rng, depth + 1)}
    return rng.choice(HOSTILE)


# --- a node that hears them ------------------------------------------------------------------------------------------


def _fleet() -> Fleet:
    nodes = tuple(
        NodeSpec(name=name, kind=NodeKind.ROBOT if name.startswith("robot") else NodeKind.EDGE)
        for name in sorted(NAMES[:-1])
    )
    tuning = Tuning(weights=Weights(cpu=0.5, memory=0.5, network=0.0), score=ScoreForm.SERVICE, deadline_ms=100.0)
    worker = WorkerSpec(command=("work",))
    task = TaskSpec(name="merge", candidates=NAMES[:4:3], tuning=tuning, worker=worker, exclusive=True)
    return Fleet(name="fuzz", timing=Timing(), nodes=nodes, tasks=(task,), electors=NAMES[:3])


def _event(value: Any) -> ev.Event | None:
    """What the bus makes of a valid value that came under its sender's key; ``None``: no peer sends such a thing."""
    make = _EVENTS.get(type(value))
    return None if make is None else make(value)


_EVENTS: dict[type[Any], Callable[[Any], ev.Event]] = {
    Beat: lambda v: ev.BeatReceived(beat=v),
    Profile: lambda v: ev.ProfileReceived(profile=v),
    Proposal: lambda v: ev.ProposalReceived(proposal=v),
    Learnt: lambda v: ev.LearntReceived(learnt=v),
    Utilities: lambda v: ev.UtilityReceived(gather=1, utilities=v),
    Prepare: lambda v: ev.PrepareAsked(request=1, asker=v.ballot.node, prepare=v),
    Accept: lambda v: ev.AcceptAsked(request=1, asker=v.acceptance.ballot.node, accept=v),
    Promise: lambda v: ev.ElectorAnswered(answer=v),
    Accepted: lambda v: ev.ElectorAnswered(answer=v),
    Refused: lambda v: ev.ElectorAnswered(answer=v),
    Ballots: lambda v: ev.BallotsAsked(request=1, asker="robot2", ballots=v),
    Votes: lambda v: ev.VotesReceived(votes=v),
    FleetQuestion: lambda v: ev.FleetAsked(request=1, asker=v.ballot.node, question=v),
    FleetAnswer: lambda v: ev.FleetAnswered(answer=v),
    ChangeFleet: lambda v: ev.FleetCommanded(request=1, command=v),
    TuneTask: lambda v: ev.TuneCommanded(request=1, command=v),
    ev.WorkerJobs: lambda v: v,  # of this node's own worker, by way of its relay
}
_SAMPLE = DeviceSample(
    cpu_cores=4.0,
    cpu_used_cores=3.9,
    memory_mb=4000.0,
    memory_used_mb=1000.0,
    workers=(WorkerLoad(task="merge", state=WorkerState.READY, cpu_cores=0.5, memory_mb=100.0),),
)


@dataclass(slots=True)
class Fuzz:
    """One run by seed."""

    seed: int
    violations: list[str] = field(default_factory=list)
    reasons: Counter[str] = field(default_factory=Counter)
    """How often each reason was given; ``valid``: the damage made another valid frame."""
    slowest_s: float = 0.0
    now: float = 100.0
    _rng: Random = field(init=False)
    _node: Node = field(init=False)
    _frames: list[bytes] = field(init=False)

    def __post_init__(self) -> None:
        self._rng = Random(self.seed)
        self._frames = [wire.encode(_dataclass(cls, self._rng)) for cls in CLASSES for _ in range(30)]
        fleet = _fleet()
        electorate = electorate_hash(fleet)
        state = DurableState(
            fleet="fuzz", node="robot1", incarnation=1, generation=0, hardware="", electorate=electorate
        )
        self._node = Node(
            fleet=fleet,
            me="robot1",
            durable=state,
            incarnation=1,
            electorate=electorate,
            rng=Random(1),
            now=self.now,
        )
        self._node.start(self.now)

    def run(self, frames: int) -> None:
        """Damage and feed this many frames."""
        for number in range(frames):
            frame = damaged(self._frames, self._rng)
            try:
                value = self._decode(frame)
                if number % NODE_SHARE == 0:
                    self._feed(value, is_looked_at=number % LOOK_EVERY == 0)
            except Exception as error:  # noqa: BLE001 - whatever escapes is what is looked for
                self.violations.append(f"seed {self.seed} frame {number} {frame[:60]!r}: {error!r}")

    def _decode(self, frame: bytes) -> Any:
        try:
            value = wire.decode(frame, *CLASSES)
        except WireError as error:
            if error.reason not in REASONS:
                raise AssertionError(f"unknown reason {error.reason}") from error
            self.reasons[error.reason] += 1
            return None
        self.reasons["valid"] += 1
        assert wire.decode(wire.encode(value), *CLASSES) == value
        return value

    def _feed(self, value: Any, *, is_looked_at: bool) -> None:
        self.now += self._rng.choice((0.0, 0.001, 0.05))
        event = _event(value) if value is not None else None
        if event is not None:
            self._handle(event)
            if isinstance(event, ev.WorkerJobs):  # its figures become a profile, and that a score
                self._handle(ev.ProfileSampled(device=_SAMPLE))
            return
        self._handle(ev.DeadlineReached())
        for _ in range(DUE_AT_MOST):  # what is due by now is no work of the frame
            if self._node.next_deadline() > self.now:
                break
            self._handle(ev.DeadlineReached())
        before = self._picture(is_whole=is_looked_at)
        batch = self._handle(ev.FrameDropped(kind="beat", reason="garbage"))
        assert not batch, batch
        assert self._picture(is_whole=is_looked_at) == before, "an invalid frame changed the node"

    def _handle(self, event: ev.Event) -> tuple[do.Instruction, ...]:
        began_at = time.thread_time()
        batch = self._node.handle(event, self.now)
        took_s = time.thread_time() - began_at
        self.slowest_s = max(self.slowest_s, took_s)
        assert took_s < LAG_S, f"{type(event).__name__} kept the loop for {took_s:.3f} s"
        assert self._node.next_deadline() >= self.now
        return batch

    def _picture(self, *, is_whole: bool) -> object:
        node = self._node
        registers = [register.state for register in node.registers.values()]
        if not is_whole:
            return registers, node.membership.states()
        return registers, replace(build_snapshot(node, self.now), counters=(), frames_dropped_s=None, dropped_ages=())


def main(arguments: list[str] | None = None) -> int:
    """Fuzz, print, return the exit code."""
    parser = argparse.ArgumentParser(prog="python -m zsched_lab.bugs.fuzz_wire", description=__doc__)
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(arguments)
    fuzz, began_at = Fuzz(given.seed), time.monotonic()
    fuzz.run(given.frames)
    print(", ".join(f"{reason} {count}" for reason, count in sorted(fuzz.reasons.items())))
    rate = given.frames / max(time.monotonic() - began_at, 1e-9)
    print(f"slowest event {fuzz.slowest_s * 1000:.1f} ms, {rate:.0f} frames a second")
    for violation in fuzz.violations[:20]:
        print(violation)
    print(f"{given.frames} frames, {len(fuzz.violations)} violations")
    return 1 if fuzz.violations else 0


if __name__ == "__main__":
    sys.exit(main())
