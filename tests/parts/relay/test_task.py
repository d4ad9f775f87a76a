"""One task's relay on real sessions: what it holds back for a worker that is away, what carries on in a move."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator
from functools import partial
from types import SimpleNamespace
from typing import Any, cast

import pytest
import zenoh

from support.allocations import allocation_of
from support.fleets import task_of
from support.sessions import hub_and_neighbour, matches
from support.threads import no_threads
from support.waiting import until
from zsched.core.executor.handover import Executor, Phase
from zsched.core.values import codec as wire
from zsched.core.values.events import ProblemReported, SlotDrained, SlotFlipped, SlotReady
from zsched.core.values.fleet import StreamRule, WorkerSpec
from zsched.core.values.instructions import ApplyRoutes
from zsched.core.values.plan import (
    Direction,
    HandoverRule,
    ReadyWhen,
    Route,
    RoutePhase,
    RoutePlan,
    ServiceSettings,
    Slot,
    StreamClass,
    StreamCount,
    StreamSettings,
)
from zsched.core.values.relay_protocol import RelayReport, StreamAck, StreamAcks, TaskEnded, WorkerWatch
from zsched.core.values.struct import replace
from zsched.core.values.todo import ToDo
from zsched.host.clock import monotonic_s
from zsched.link.keyspace import END_CHUNK, Keyspace
from zsched.link.pipe.frames import decode_end
from zsched.relay import task as task_module
from zsched.relay.graph import GraphMirror
from zsched.relay.open_streams import OpenStreams
from zsched.relay.process import RelayProcess
from zsched.relay.streams import greetings
from zsched.relay.streams.acks import Acks
from zsched.relay.streams.receive import undeclare
from zsched.relay.task import TaskRelay
from zsched.relay.tokens import Tokens

KEYS = Keyspace("test")
IN = Route(
    stream="t/in/0",
    direction=Direction.INPUT,
    from_expr="robot1/in",
    to_expr="edge1/t/robot1/in",
    settings=StreamSettings(stream_class=StreamClass.RELIABLE, depth=100),
)


class Scene:
    """A robot's relay of one task, whose owner is settled; the test is the owner's machine."""

    def __init__(self, relay: zenoh.Session, other: zenoh.Session) -> None:
        self.relay, self.other = relay, other
        self.tokens = Tokens(relay, KEYS, lambda _seen: None, lambda _node, _ended: None, self._wake)
        acks = Acks(relay, KEYS, "robot1", self.tokens.has_worker)
        self.streams = OpenStreams(relay, frozenset({str(relay.zid())}))
        graph = GraphMirror(relay, None, "robot1")
        self.words: deque[RelayReport] = deque(maxlen=1000)
        self.task = TaskRelay(relay, "t", self.tokens, acks, self.words.append, graph, self.streams)

    def _wake(self) -> None:
        self.task.wake()

    def settle(self, route: Route = IN, ready: ReadyWhen = ReadyWhen.TOKEN) -> None:
        slot = Slot(epoch=3, owner="edge1", routes=(route,), ready_when=ready)
        self.task.apply(RoutePlan(task="t", phase=RoutePhase.CLOSE, current=slot))
        until(
            lambda: (source := self.streams.inputs.get(IN.stream)) is not None and source._active is not None, "the way"
        )

    def put(self, count: int) -> None:
        before = self.count().messages
        publisher = self.other.declare_publisher("robot1/in", congestion_control=zenoh.CongestionControl.BLOCK)
        until(lambda: matches(publisher), "the relay subscribes, and the application has heard of it")
        for _ in range(count):
            publisher.put(b"x")
        until(lambda: self.count().messages == before + count, "the relay has them")
        undeclare(publisher)

    def count(self) -> StreamCount:
        return next(iter(self.task.counts()), StreamCount(stream="t/in/0"))


def test_however_often_it_is_woken_one_look_is_enough(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Somebody's end markers, faster than a look: the queue grew, and a plan waited behind all of them."""
    is_in, go_on = threading.Event(), threading.Event()

    def step() -> None:
        is_in.set()
        go_on.wait(60)

    monkeypatch.setattr(scene.task, "_step", step)
    scene.task.wake()
    try:
        assert is_in.wait(60)
        for _ in range(1000):
            scene.task.wake()
        assert scene.task._queue.qsize() == 1
    finally:
        go_on.set()
    until(lambda: not scene.task._queue.qsize(), "the look behind all of them")


@pytest.fixture
def scene(monkeypatch: pytest.MonkeyPatch) -> Iterator[Scene]:
    monkeypatch.setattr(greetings, "FOREIGN_S", 0.3)
    with hub_and_neighbour() as (relay, other):
        made = Scene(relay, other)
        yield made
        made.task.end()


def test_what_comes_while_the_worker_is_away_waits_for_it_also_beside_a_recorder(scene: Scene) -> None:
    """This relay has never seen the worker: a recorder of everything was taken for it after a while."""
    recorded: list[str] = []
    recorder = scene.other.declare_subscriber("**", lambda sample: recorded.append(str(sample.key_expr)))
    scene.settle()
    scene.put(5)
    time.sleep(1.0)
    assert (scene.count().drops, scene.count().in_flight) == ((), 5)
    assert IN.to_expr not in recorded
    got: list[bytes] = []

    def greeted(sample: zenoh.Sample) -> None:
        marker, info = decode_end(sample.payload.to_bytes()), sample.source_info
        assert marker is not None
        assert info is not None
        ack = StreamAck(eid=info.source_id.eid, first=0, arrived=marker.count, processed=marker.count)
        key = KEYS.ack("edge1", "t", "7", str(scene.relay.zid()))
        scene.other.put(key, wire.encode(StreamAcks(acks=(ack,))))

    ends = scene.other.declare_subscriber(f"{IN.to_expr}/{END_CHUNK}", greeted)
    data = scene.other.declare_subscriber(IN.to_expr, lambda sample: got.append(sample.payload.to_bytes()))
    token = scene.other.liveliness().declare_token(KEYS.worker("edge1", "t", "7"))
    until(lambda: got == [b"x"] * 5, "the worker gets all of it")
    for one in (token, data, ends, recorder):
        undeclare(one)


def test_nor_is_one_after_another_data_session_that_has_not_seen_the_worker(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(task_module, "REJOIN_S", 0.2)
    recorder = scene.other.declare_subscriber("**", lambda _sample: None)
    token = scene.other.liveliness().declare_token(KEYS.worker("edge1", "t", "7"))
    until(scene.tokens.seen, "the worker")
    scene.settle()
    assert scene.task.leave(0.1, 0.2).wait(60)
    undeclare(token)
    until(lambda: not scene.tokens.seen(), "its end")
    scene.tokens.rejoin(scene.relay)
    scene.task.rejoin(scene.relay, frozenset({str(scene.relay.zid())}))
    scene.put(3)
    time.sleep(1.2)
    assert (scene.count().drops, scene.count().in_flight) == ((), 3)
    undeclare(recorder)


def test_a_worker_that_takes_nothing_of_this_robot_is_looked_for_ten_times_a_second(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A hundred times took 4 % of a core for each such task, for good."""
    monkeypatch.setattr(task_module, "FRESH_S", 0.2)
    steps: deque[float] = deque(maxlen=1000)
    step = scene.task._step

    def noted() -> None:
        steps.append(monotonic_s())
        step()

    monkeypatch.setattr(scene.task, "_step", noted)
    token = scene.other.liveliness().declare_token(KEYS.worker("edge1", "t", "7"))
    until(scene.tokens.seen, "the worker")
    scene.settle()
    lack = SlotReady(task="t", epoch=3, is_ready=False, has_token=True, untaken=(IN.to_expr,))
    until(lambda: lack in scene.words, "what the worker lacks is told")
    began = monotonic_s()
    until(lambda: monotonic_s() - began >= 1.0, "a second")
    assert 2 <= sum(at >= began for at in steps) <= 20
    data = scene.other.declare_subscriber(IN.to_expr, lambda _sample: None)
    until(lambda: SlotReady(task="t", epoch=3) in scene.words, "the worker is ready")
    for one in (token, data):
        undeclare(one)


LATCHED = replace(IN, settings=StreamSettings(stream_class=StreamClass.LATEST, keep_last=1))


def test_a_foreign_worker_that_is_back_before_anybody_has_looked_gets_the_kept_values(scene: Scene) -> None:
    """Its publisher puts a map once: without it the next life of the worker never had one."""
    scene.settle(LATCHED, ReadyWhen.MATCHING)
    scene.put(1)
    for _ in range(5):
        got: list[bytes] = []
        life = scene.other.declare_subscriber(LATCHED.to_expr, partial(_take, got))
        until(partial(bool, got), "the map", 5.0)
        undeclare(life)
        until(lambda: not scene.streams.inputs[IN.stream].is_matching(3), "zenoh tells of its end")


BEST = StreamSettings(stream_class=StreamClass.BEST_EFFORT)
BRIEF = ServiceSettings(timeout_s=5.0, hold_s=0.2)


def whole(epoch: int, owner: str, settings: StreamSettings, service: ServiceSettings) -> Slot:
    """With a stream of each kind, of a worker that shows no token."""
    ends = {"in": ("robot1/in", f"{owner}/t/robot1/in"), "out": (f"{owner}/t/{epoch}/robot1/out", "robot1/out")}
    ends["srv"] = ("robot1/ask", f"{owner}/t/ask")
    routes = tuple(
        Route(
            stream=f"t/{name}/0",
            direction=direction,
            from_expr=ends[name][0],
            to_expr=ends[name][1],
            settings=settings,
            service=service,
        )
        for name, direction in (("in", Direction.INPUT), ("out", Direction.OUTPUT), ("srv", Direction.SERVICE))
    )
    return Slot(epoch=epoch, owner=owner, routes=routes, ready_when=ReadyWhen.MATCHING)


def test_what_carries_goes_on_when_the_fleet_file_changes_its_streams_in_the_middle_of_a_move(scene: Scene) -> None:
    """The next owner is not ready for long; until then inputs, answers and requests had no way at all."""
    old, got, answers = whole(3, "edge1", BEST, BRIEF), list[bytes](), list[bytes]()
    other, kept = scene.other, list[Any]()
    kept.append(other.declare_subscriber("edge1/t/robot1/in", partial(_take, got)))
    kept.append(other.declare_subscriber("robot1/out", partial(_take, answers)))
    kept.append(
        other.declare_queryable("edge1/t/ask", lambda query: query.reply(query.key_expr, b"told"), complete=True)
    )
    scene.task.apply(RoutePlan(task="t", phase=RoutePhase.CLOSE, current=old))
    changes = ((BEST, BRIEF), (replace(BEST, depth=20), replace(BRIEF, hold_s=0.3)))
    for depth, (settings, service) in enumerate(changes, 1):
        new = whole(4, "edge2", settings, service)
        scene.task.apply(RoutePlan(task="t", phase=RoutePhase.PREPARE, current=new, predecessors=(old,)))
        until(lambda new=new: scene.task._plan is not None and scene.task._plan.current == new, "the plan")  # type: ignore[misc]
        until(lambda: {one.stream for one in scene.task.counts()} == {"t/in/0", "t/out/0", "t/srv/0"}, "the streams")
        time.sleep(0.3)
        other.put("robot1/in", b"x")
        other.put("edge1/t/3/robot1/out", b"y")
        until(partial(_counts, got, depth), "the input", 5.0)
        until(partial(_counts, answers, depth), "the answer", 5.0)
        said = [reply.ok.payload.to_bytes() for reply in other.get("robot1/ask") if reply.ok is not None]
        assert said == [b"told"]
    for one in kept:
        undeclare(one)


def test_a_slot_that_was_left_gets_nothing_new_when_one_of_its_streams_changes(scene: Scene) -> None:
    """A changed fleet file may come with a slot that still drains: what runs on goes to the one that carries."""
    left, now = whole(3, "edge1", BEST, BRIEF), whole(4, "edge2", BEST, BRIEF)
    before, got = list[bytes](), list[bytes]()
    kept = [
        scene.other.declare_subscriber(f"{edge}/t/robot1/in", partial(_take, heard))
        for edge, heard in (("edge1", before), ("edge2", got))
    ]
    scene.task.apply(RoutePlan(task="t", phase=RoutePhase.CLOSE, current=left))
    for phase in (RoutePhase.PREPARE, RoutePhase.FLIP):
        scene.task.apply(RoutePlan(task="t", phase=phase, current=now, predecessors=(left,)))
    until(lambda: any(isinstance(word, SlotFlipped) and word.epoch == 4 for word in scene.words), "the flip")
    out = replace(left.routes[1], settings=replace(BEST, depth=20))
    changed = replace(left, routes=(left.routes[0], out, left.routes[2]))
    scene.task.apply(RoutePlan(task="t", phase=RoutePhase.FLIP, current=now, predecessors=(changed,)))
    until(lambda: 3 not in scene.task._slots or scene.task._slots[3].slot == changed, "the change")
    assert 3 in scene.task._slots, "it drains still"
    scene.other.put("robot1/in", b"x")
    until(lambda: before or got, "the input", 5.0)
    assert (before, got) == ([], [b"x"])
    for one in kept:
        undeclare(one)


def _counts(got: list[bytes], count: int) -> bool:
    return len(got) == count


def _take(got: list[bytes], sample: zenoh.Sample) -> None:
    got.append(sample.payload.to_bytes())


@pytest.mark.parametrize("has_owner", [False, True])
def test_who_waits_for_an_answer_when_the_relay_ends_is_told_so(scene: Scene, *, has_owner: bool) -> None:
    """The session closed over the request: who had asked got nothing at all."""
    held: list[zenoh.Query] = []
    service = Route(
        stream="t/srv/0",
        direction=Direction.SERVICE,
        from_expr="robot1/job",
        to_expr="edge1/t/robot1/job",
        settings=StreamSettings(),
        service=ServiceSettings(),
    )
    slot = Slot(epoch=3, owner="edge1", routes=(service,), ready_when=ReadyWhen.TOKEN)
    if has_owner:
        owner = scene.other.declare_queryable(service.to_expr, held.append)
    scene.task.apply(RoutePlan(task="t", phase=RoutePhase.CLOSE, current=slot))
    asker = scene.other.declare_querier(service.from_expr, timeout=20.0)
    until(lambda: matches(asker), "the service is there")
    heard: list[str] = []

    def ask() -> None:
        heard.extend(reply.err.payload.to_string() for reply in asker.get() if reply.err is not None)

    thread = threading.Thread(target=ask)
    thread.start()
    until(lambda: bool(held) if has_owner else scene.count().messages == 1, "the request is under way")
    assert scene.task.finish(monotonic_s() + 0.1).wait(5.0)
    assert dict(scene.count().drops) == {"owner_gone" if has_owner else "no_owner": 1}
    scene.relay.close()
    thread.join(5.0)
    gone = "owner gone: no answer from edge1/t/robot1/job; it may have been done"
    assert heard == [gone if has_owner else "no owner: nobody serves robot1/job: it was not done"]
    if has_owner:
        undeclare(owner)
    for query in held:
        query.drop()


@pytest.mark.parametrize("stream_class", [StreamClass.BEST_EFFORT, StreamClass.RELIABLE])
@pytest.mark.parametrize("refused", [1, 1000], ids=["the first one", "all"])
def test_what_no_thread_was_to_be_had_for_is_opened_later(
    scene: Scene, stream_class: StreamClass, refused: int
) -> None:
    """A limit of the machine's, for a moment: the routes behind the first one stayed closed for the whole epoch."""
    slot, other = whole(3, "edge1", replace(BEST, stream_class=stream_class), BRIEF), scene.other
    got, answers, kept = list[bytes](), list[bytes](), list[Any]()
    kept.append(other.declare_subscriber("edge1/t/robot1/in", partial(_take, got)))
    kept.append(other.declare_subscriber("robot1/out", partial(_take, answers)))
    kept.append(
        other.declare_queryable("edge1/t/ask", lambda query: query.reply(query.key_expr, b"told"), complete=True)
    )
    with no_threads(refused):
        scene.task.apply(RoutePlan(task="t", phase=RoutePhase.CLOSE, current=slot))
        until(lambda: any(isinstance(word, ProblemReported) for word in scene.words), "the problem")
    names = {"t/in/0", "t/out/0", "t/srv/0"}
    until(lambda: {one.stream for one in scene.task.counts()} == names, "the streams", 5.0)
    until(lambda: scene.streams.inputs[IN.stream]._active is not None, "the way", 5.0)
    source, owner = other.declare_publisher("robot1/in"), other.declare_publisher("edge1/t/3/robot1/out")
    asker = other.declare_querier("robot1/ask")
    for end in (source, owner, asker):
        until(partial(matches, end), "the relay is seen there", 5.0)
    source.put(b"x")
    owner.put(b"y")
    until(lambda: got == [b"x"], "the input", 5.0)
    until(lambda: answers == [b"y"], "the answer", 5.0)
    said = [reply.ok.payload.to_bytes() for reply in asker.get() if reply.ok is not None]
    assert said == [b"told"]
    problems = [word.problem for word in scene.words if isinstance(word, ProblemReported)]
    assert problems[-1] is None, "it is over"
    for one in (source, owner, asker, *kept):
        undeclare(one)


def test_what_an_input_kept_is_there_when_its_next_one_opens_later(scene: Scene) -> None:
    """The file has changed: the input is closed and opened, and the map's publisher puts it once."""
    got: list[bytes] = []
    worker = scene.other.declare_subscriber(LATCHED.to_expr, partial(_take, got))
    scene.settle(LATCHED, ReadyWhen.MATCHING)
    scene.put(1)
    until(partial(_counts, got, 1), "the map")
    changed = replace(LATCHED, settings=replace(LATCHED.settings, depth=2000))
    with no_threads():
        scene.words.clear()
        slot = Slot(epoch=4, owner="edge1", routes=(changed,), ready_when=ReadyWhen.MATCHING)
        scene.task.apply(RoutePlan(task="t", phase=RoutePhase.CLOSE, current=slot))
        until(lambda: any(isinstance(word, ProblemReported) for word in scene.words), "the problem")
    until(partial(_counts, got, 2), "the map once more", 5.0)
    undeclare(worker)


def test_an_input_of_a_task_without_an_owner_is_taken_later(scene: Scene) -> None:
    with no_threads():
        scene.task.listen((replace(IN, settings=BEST),))
        until(lambda: any(isinstance(word, ProblemReported) for word in scene.words), "the problem")
    until(lambda: IN.stream in scene.streams.inputs, "the input", 5.0)
    publisher = scene.other.declare_publisher("robot1/in")
    until(partial(matches, publisher), "the relay subscribes", 5.0)
    scene.put(3)
    undeclare(publisher)


ECHO = task_of(
    "t",
    candidates=("edge1", "edge2"),
    drain_s=1.0,
    worker=WorkerSpec(ready_when=ReadyWhen.MATCHING),
    rules=(
        StreamRule(
            direction=Direction.INPUT,
            from_template="{robot}/in",
            to_template="{target}/t/{robot}/in",
            settings=replace(BEST, handover=HandoverRule.ALL),
        ),
        StreamRule(
            direction=Direction.OUTPUT,
            from_template="{target}/t/{epoch}/{robot}/out",
            to_template="{robot}/out",
            settings=replace(BEST, handover=HandoverRule.ALL),
        ),
    ),
)


class Daemon:
    """A robot's part of a daemon: its executor, the real one, tells the relay its plans, and hears what that says."""

    def __init__(self, scene: Scene) -> None:
        self.scene, self.executor = scene, Executor(spec=ECHO, me="robot1", has_streams=True)

    def carry_out(self, todo: ToDo) -> None:
        for one in todo.apply:
            if isinstance(one, ApplyRoutes):
                self.scene.task.apply(one.plan)

    def hear(self) -> None:
        todo = ToDo()
        while self.scene.words:
            word = self.scene.words.popleft()
            if isinstance(word, SlotReady) and word.is_ready:
                self.executor.on_ready(word.epoch, todo)
            elif isinstance(word, SlotFlipped):
                self.executor.on_flipped(word.epoch, word.replayed, todo, monotonic_s(), word.draining)
            elif isinstance(word, SlotDrained):
                self.executor.on_drained(word.epoch, todo)
        self.executor.tick(todo, monotonic_s())
        self.carry_out(todo)

    def learn(self, epoch: int, owner: str) -> None:
        todo = ToDo()
        self.executor.execute(allocation_of(epoch, owner, task=ECHO.name), todo, monotonic_s())
        self.carry_out(todo)

    def until(self, *phases: Phase) -> None:
        def is_there() -> bool:
            self.hear()
            return self.executor.phase in phases

        until(is_there, f"one of {phases}")


@pytest.mark.parametrize("has_flipped", [True, False])
def test_an_old_owner_drains_on_while_the_daemon_restarts(scene: Scene, *, has_flipped: bool) -> None:
    """The next daemon knows the new owner only, and closed the old one's slot at the flip."""
    answers, other = list[bytes](), scene.other
    kept = [other.declare_subscriber(f"{edge}/t/robot1/in", lambda _sample: None) for edge in ("edge1", "edge2")]
    kept.append(other.declare_subscriber("robot1/out", partial(_take, answers)))
    first = Daemon(scene)
    first.learn(1, "edge1")
    first.until(Phase.SETTLED)
    if has_flipped:
        first.learn(2, "edge2")
        first.until(Phase.DRAINING)
    scene.task.lose_daemon()
    scene.words.clear()
    began_at, second = monotonic_s(), Daemon(scene)
    second.learn(2, "edge2")
    second.until(Phase.DRAINING, Phase.SETTLED)
    time.sleep(0.2)
    other.put("edge1/t/1/robot1/out", b"in hand", congestion_control=zenoh.CongestionControl.BLOCK)
    until(lambda: answers == [b"in hand"], "the old owner's answer", 5.0)
    second.until(Phase.SETTLED)
    assert monotonic_s() - began_at < ECHO.drain_s + 1.0
    until(lambda: set(scene.task._slots) == {2}, "the old slot is closed")
    for one in kept:
        undeclare(one)


def test_an_input_whose_rule_has_gone_is_taken_no_more_though_nobody_owns_the_task(scene: Scene) -> None:
    """It took samples, and showed them as a stream's, until the task had an owner."""
    other = replace(IN, stream="t/in/1", from_expr="robot1/other", to_expr="edge1/t/robot1/other")
    scene.task.listen((IN, other))
    until(lambda: sorted(scene.streams.inputs) == ["t/in/0", "t/in/1"], "both")
    known = scene.other.declare_publisher(IN.from_expr)
    until(lambda: matches(known), "the relay subscribes")
    scene.put(2)
    scene.task.listen((replace(other, stream=IN.stream),))  # the rule above it has gone
    until(lambda: sorted(scene.streams.inputs) == ["t/in/0"], "one rule, one stream")
    assert scene.streams.inputs["t/in/0"].route.from_expr == "robot1/other"
    scene.task.listen(())
    until(lambda: not scene.streams.inputs, "none")
    scene.task.listen((IN,))
    until(lambda: scene.count().messages == 2, "it goes on with its counters")


def test_a_relay_hears_that_a_task_has_no_input_any_more(scene: Scene) -> None:
    relay = RelayProcess(scene.relay, "test", "robot1", cast("Any", SimpleNamespace(report=lambda _word: None)))
    relay._do(WorkerWatch(task="t", unowned=(IN,)))
    streams = relay._tasks["t"]._streams
    until(lambda: list(streams.inputs) == ["t/in/0"], "the input")
    relay._do(WorkerWatch(task="t"))
    until(lambda: not streams.inputs, "its end")
    relay._do(TaskEnded(task="t"))
