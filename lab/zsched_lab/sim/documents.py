"""Documents and changes of the fleet in a simulation: what is stored where, and the judge of what is chosen.

Knows: which document says what, which machine has it on its disk, how it comes from another one. Does not know: who
wants a change (a test, a schedule), how it is agreed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, Protocol

from zsched.core.electorate.founding import founded
from zsched.core.electorate.numbers import in_force
from zsched.core.values import codec as wire
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.document import Document, Flag, Text
from zsched.core.values.durable import DurableState
from zsched.core.values.fleet import Fleet
from zsched.core.values.model import NodeId, RegisterState
from zsched_lab.sim.chosen import Chosen
from zsched_lab.sim.network import Message
from zsched_lab.sim.parts import Machine

FlagsOf = dict[str, tuple[Flag, ...]]
"""{hash of a document: its flags}."""
Instruction = do.StoreDocument | do.AmendDocument | do.FetchDocument | do.KeepDocuments
STORE_S = (0.005, 0.05, 0.4)
"""How long checking and writing a document takes."""


class World(Protocol):
    """What documents need of the simulator."""

    machines: dict[str, Machine]

    def later(self, seconds: float, action: Callable[..., None], *arguments: Any) -> None:
        """Do something after a while."""

    def deliver(self, machine: Machine, event: ev.Event) -> None:
        """Let an event reach a machine."""

    def named(self, name: NodeId) -> list[Machine]:
        """The machines that call themselves so."""

    def ask(self, asked: Machine, asker: Machine, make: Callable[[Any], ev.Event]) -> int:
        """The number of a new question."""

    def send(self, source: Machine, target: Machine, message: Message) -> None:
        """Send one message."""


class Documents:
    """All documents of one simulated fleet."""

    def __init__(self, sim: World, pick: Callable[[tuple[float, ...]], float]) -> None:
        self._sim, self._pick = sim, pick
        self.says: dict[str, Fleet] = {}
        """{hash: what the document says}."""
        self._texts: dict[str, Fleet] = {}
        self.contents: dict[str, Document] = {}
        """{hash: the document}."""
        self.unfit: set[tuple[str, str]] = set()
        """(machine, hash): not valid there."""
        self.judge: Chosen | None = None
        """It judges what is chosen, if a test asks for it; schedules with generations do without."""

    def write(self, fleet: Fleet, flags: tuple[Flag, ...] = ()) -> Document:
        """A document that says this."""
        known = next((text for text, said in self._texts.items() if said == fleet), None)
        text = known or f"document {len(self._texts)}"
        self._texts[text] = fleet
        content = Document(text=Text(text), flags=flags)
        name = wire.document_hash(content)
        self.says[name], self.contents[name] = fleet, content
        return content

    def judge_from(self, fleet: Fleet, generation: int) -> None:
        """Judge from the start on what is chosen."""
        self.judge = Chosen(founded(fleet.name, generation, fleet.electors))

    def on_sent(self, instruction: do.Instruction) -> None:
        """A question leaves."""
        if self.judge is None:
            return
        if isinstance(instruction, do.SendAccept):
            self.judge.note(instruction.accept)
        elif isinstance(instruction, do.SendBallots):
            for accept in instruction.ballots.accepts:
                self.judge.note(accept)
            if instruction.ballots.ahead is not None:
                self.judge.note(instruction.ballots.ahead)
        elif isinstance(instruction, do.AskElectors):
            self.judge.note(instruction.question)

    def on_synced(self, machine: Machine, state: DurableState) -> None:
        """A state reached the disk."""
        if self.judge is None:
            return
        first = founded(state.fleet, state.generation, machine.fleet.electors)
        held = state.fleet_register or RegisterState(task=state.fleet, learnt=first)
        assert held.learnt is not None
        for value in (held.learnt, None if held.accepted is None else held.accepted.value):
            if value is not None and value.document:
                stored = value.document in machine.disk.documents or value.document in machine.disk.lost
                assert stored, f"{machine.key} has no document of {value}"
        self.judge.on_disk(machine.name, state.disk, held, state.registers)

    def at_start(self, machine: Machine, state: DurableState | None) -> tuple[Fleet, dict[str, Fleet], FlagsOf]:
        """What a starting node goes by, the documents that its state names, and their flags."""
        register = None if state is None else state.fleet_register
        if register is None or register.learnt is None:
            return machine.fleet, {}, {}
        named = [register.learnt.document, "" if register.accepted is None else register.accepted.value.document]
        stored = {one: self.says[one] for one in named if one in machine.disk.documents}
        document = stored.get(register.learnt.document)
        flags = {one: self.contents[one].flags for one in stored}
        return machine.fleet if document is None else in_force(document, register.learnt), stored, flags

    def do(self, machine: Machine, instruction: Instruction) -> None:
        """Carry out what concerns documents."""
        if isinstance(instruction, do.StoreDocument):
            self._store(machine, wire.document_hash(instruction.content), instruction.request)
        elif isinstance(instruction, do.AmendDocument):
            if instruction.document in machine.disk.documents:
                amended = self.write(self.says[instruction.document], instruction.flags)
                self._store(machine, wire.document_hash(amended), None)
        elif isinstance(instruction, do.KeepDocuments):
            self._keep(machine, instruction.documents)
        else:
            for peer in instruction.peers:
                self._fetch(machine, peer, instruction.document)

    def _fetch(self, machine: Machine, peer: NodeId, document: str) -> None:
        for other in self._sim.named(peer):
            number = self._sim.ask(other, machine, lambda _: self._came(machine, document))
            self._sim.send(machine, other, Message(ev.DocumentAsked(request=number, document=document)))

    def _came(self, machine: Machine, document: str) -> ev.Event:
        """A document's frame reached a machine: the library takes its time, the loop hears of it after that."""
        self._store(machine, document, None)
        return ev.DeadlineReached()

    def _store(self, machine: Machine, document: str, request: int | None) -> None:
        self._sim.later(self._pick(STORE_S), self._stored, machine, machine.life, document, request)

    def _stored(self, machine: Machine, life: int, document: str, request: int | None) -> None:
        if machine.life != life or machine.node is None:
            return
        if machine.disk.is_broken or (machine.key, document) in self.unfit:
            is_of_disk = (machine.key, document) not in self.unfit
            refused = ev.DocumentRefused(
                document=document, reason="not valid here", request=request, is_of_disk=is_of_disk
            )
            self._sim.deliver(machine, refused)
            return
        if document not in machine.disk.documents:
            machine.disk.documents.append(document)
        fleet, flags = self.says[document], self.contents[document].flags
        self._sim.deliver(machine, ev.DocumentStored(document=document, fleet=fleet, flags=flags, request=request))

    @staticmethod
    def _keep(machine: Machine, documents: Iterable[str]) -> None:
        recent = machine.disk.documents[-8:]
        machine.disk.documents[:] = [one for one in machine.disk.documents if one in documents or one in recent]

    def is_on_one_of(self, names: Iterable[NodeId], document: str) -> bool:
        """Whether one of these machines has a document on its disk, and runs."""
        others = [self._sim.machines[name] for name in names]
        return any(document in other.disk.documents for other in others if other.node is not None)

    def content(self, machine: Machine, document: str) -> Document | None:
        """What a machine answers to a question for a document."""
        if document not in machine.disk.documents:
            return None
        return self.contents[document]
