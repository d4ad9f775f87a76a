"""Real daemons agree a document and change their electors; an exclusive task never has two owners meanwhile."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from zsched.core.values import codec as wire
from zsched.core.values.document import Document, Text
from zsched.core.values.electorate import FleetValue
from zsched.core.values.messages import ChangeFleet, CommandOutcome, CommandResult
from zsched.core.values.model import NodeId
from zsched.host.document_store import DocumentStore
from zsched.host.state_file import StateFile
from zsched.link.keyspace import Keyspace
from zsched.link.sessions.config import client_config
from zsched_lab.fleet.testbed import TASK, Testbed, echo_fleet

ROBOTS = ("robot1", "robot2", "robot3")


@pytest.fixture
def bed(tmp_path: Path) -> Iterator[Testbed]:
    tree = {
        **echo_fleet(edges=1, task={"exclusive": True, "candidates": ["edge1", "robot1"]}),
        "electorate": list(ROBOTS),
    }
    with Testbed(tmp_path, tree) as testbed:
        testbed.init()
        testbed.start()
        yield testbed


class Operator:
    """Gives commands over the control network, and reads the disks."""

    def __init__(self, bed: Testbed) -> None:
        self._bed, self._keys = bed, Keyspace(bed.fleet.name)
        endpoint = bed.fleet.node("robot2").listen_control
        config = client_config(connect=(endpoint,), timing=bed.fleet.timing)
        self.session = zenoh.open(zenoh.Config.from_json5(config))

    def tell(self, node: NodeId, command: ChangeFleet) -> CommandResult | None:
        """The answer to a command; ``None``: none came."""
        key, payload = self._keys.command(node, "operator"), wire.encode(command)
        replies = self.session.get(key, payload=payload, consolidation=zenoh.ConsolidationMode.NONE, timeout=10.0)
        frames = [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]
        return wire.decode(frames[0], CommandResult) if frames else None

    def change(self, node: NodeId, command: ChangeFleet) -> CommandResult:
        """Give a command until it is carried out, as an operator does; then wait until it is settled."""
        done: list[CommandResult] = []

        def is_done() -> bool:
            answer = self.tell(node, command)
            done.extend([] if answer is None else [answer])
            known = answer is not None and answer.outcome in (CommandOutcome.OK, CommandOutcome.UNCHANGED)
            assert answer is None or answer.outcome is not CommandOutcome.INVALID or "settled" in answer.detail, answer
            return known

        self._bed.wait(is_done, 60, f"{command} to be carried out")
        self._bed.wait(self.is_settled, 60, f"{command} to be settled")
        return done[-1]

    def value(self, node: NodeId) -> FleetValue | None:
        """What a node has learnt, as its disk holds it."""
        file = StateFile(self._bed.folder / node, fleet=self._bed.fleet.name, node=node)
        state = file.load().state
        return None if state is None or state.fleet_register is None else state.fleet_register.learnt

    def disk(self, node: NodeId) -> str:
        state = StateFile(self._bed.folder / node, fleet=self._bed.fleet.name, node=node).load().state
        assert state is not None
        return state.disk

    def is_settled(self) -> bool:
        values = [self.value(name) for name in self._bed.running()]
        return all(one is not None and one.settled and one == values[0] for one in values)


class Watch:
    """Every node's outputs for robot1: who works, by the epoch in the key."""

    def __init__(self, bed: Testbed) -> None:
        self.session = bed.app("robot1")
        self.order: list[tuple[int, str]] = []
        """(epoch, node) of each output, as they came."""
        self._pub = self.session.declare_publisher("robot1/in")
        self._sub = self.session.declare_subscriber(f"*/{TASK}/*/robot1/out", self._on_raw)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _on_raw(self, sample: zenoh.Sample) -> None:
        node, _, epoch, *_ = str(sample.key_expr).split("/")
        self.order.append((int(epoch), node))

    def _run(self) -> None:
        number = 0
        while not self._stop.wait(0.01):
            self._pub.put(f"{number:010d}".encode())
            number += 1

    def end(self) -> None:
        """Stop; no epoch has had two workers, and none worked once a later one had begun."""
        self._stop.set()
        self._thread.join(60)
        assert len({epoch for epoch, _ in self.order}) == len(set(self.order)), set(self.order)
        assert [epoch for epoch, _ in self.order] == sorted(epoch for epoch, _ in self.order)


@pytest.mark.long
def test_electors_change_while_an_exclusive_task_works(bed: Testbed) -> None:
    owner = bed.wait_settled()
    watch, operator = Watch(bed), Operator(bed)
    bed.wait(lambda: len(watch.order) > 50, 60, "outputs")
    text = bed.file.read_text(encoding="utf-8")
    operator.change("robot2", ChangeFleet(document=Document(text=Text(text))))
    value = operator.value("edge1")
    assert value is not None
    assert (value.number, [one.task for one in value.tasks]) == (2, [TASK])
    kept = [DocumentStore(bed.folder / name).load(value.document) for name in bed.names]
    assert [one.text for one in kept if one is not None] == [text] * len(bed.names)
    operator.change("robot2", ChangeFleet(remove_elector="robot1"))
    operator.change("robot3", ChangeFleet(add_elector="edge1", disk=operator.disk("edge1")))
    assert bed.owner() == owner, "a change of the electors moves nothing"
    before = len(watch.order)
    bed.wait(lambda: len(watch.order) > before + 50, 60, "more outputs")
    # The new electors agree without the old one, and a node starts by what its disk holds.
    bed.kill("robot3")
    bed.start("robot3")
    bed.wait(lambda: bed.status("robot3")["quorum"]["this_node"] == "elector", 60, "robot3 to elect again")
    bed.kill(owner)
    other = "robot1" if owner == "edge1" else "edge1"
    living = [name for name in bed.names if name != owner]
    bed.wait(lambda: bed.owner(*living) == other, 60, f"{other} to own the task")
    final = operator.value("robot2")
    assert final is not None
    assert final.electorate.names == ("edge1", "robot2", "robot3")
    assert bed.status("robot2")["quorum"]["electors"] == 3
    operator.session.close()
    watch.end()
