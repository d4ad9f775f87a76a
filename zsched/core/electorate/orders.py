"""Operators' changes of the fleet: what a command asks for, and what becomes of it.

Knows: which change of a fleet value each command is, in which words it ends. Does not know: how a change is agreed
(`zsched.core.electorate.numbers`), how a document is stored.

A command ends when its change is chosen, or cannot be. The electors of the new number are settled after that.

What a document says in an operator's name (its flags and rollouts) travels inside the document, so a program could put
any name there. The node that takes the command writes the name of who gives it beside all that is new or changed.
"""

from __future__ import annotations

from zsched.core.electorate.changes import AddElector, AdoptDocument, FleetChange, RemoveElector, SetDocument
from zsched.core.electorate.numbers import Numbers
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.change import Rewrite, RoundOutcome, told_end
from zsched.core.values.document import Document, Flag, in_the_name_of
from zsched.core.values.electorate import FleetValue
from zsched.core.values.fleet import Fleet
from zsched.core.values.messages import ChangeFleet, CommandOutcome, CommandResult
from zsched.core.values.model import as_reason, told_by
from zsched.core.values.struct import replace
from zsched.core.values.todo import ToDo

MAX_OPEN = 16
"""Operators' commands that may wait for their documents; of more the oldest ends, and its operator is answered so."""

MAX_STORY = 500
"""Characters of a line of the journal: a text on the wire has at most 512."""

_UNCHANGED = "that is what is agreed"


class Orders:
    """One node's open commands."""

    def __init__(self, numbers: Numbers) -> None:
        self._numbers = numbers
        self._storing: dict[int, ChangeFleet] = {}
        """{request: its command} while the document is checked and written."""
        self._running: list[tuple[FleetChange, int, ChangeFleet]] = []
        self._ending: tuple[int, tuple[Flag, ...]] | None = None
        """(revision, the flags that stay) while the document is written without those whose time is over."""

    def take(self, event: ev.FleetCommanded, todo: ToDo, now: float) -> None:
        """An operator gives a command."""
        command, request = event.command, event.request
        value = self._numbers.value
        if value is None:
            detail = "this node does not know the fleet's generation yet; wait until it hears an elector"
            self._answer(request, CommandOutcome.NO_QUORUM, detail, todo)
        elif command.base_revision not in (None, value.revision):
            detail = f"the fleet is at revision {value.revision}, not {command.base_revision}; look and try again"
            self._answer(request, CommandOutcome.CONFLICT, detail, todo)
        elif command.document is not None:
            content = self._named(command.document, command, value)
            self._storing[request] = replace(command, base_revision=value.revision)
            for old in tuple(self._storing)[:-MAX_OPEN]:
                del self._storing[old]
                detail = f"{MAX_OPEN} newer changes wait here for their documents; nothing is changed, try again"
                self._answer(old, CommandOutcome.CONFLICT, detail, todo)
            todo.add(do.StoreDocument(request=request, content=content))
        elif command.add_elector:
            change = AddElector(base_revision=value.revision, name=command.add_elector, disk=command.disk)
            self._propose(request, change, command, todo, now)
        else:
            gone = RemoveElector(base_revision=value.revision, name=command.remove_elector)
            self._propose(request, gone, command, todo, now)

    def _named(self, content: Document, command: ChangeFleet, value: FleetValue) -> Document:
        """The document of a command, in which its operator's name stands beside what it changes."""
        if command.asked is None:
            return content
        documents, present = self._numbers.documents, value.document
        return in_the_name_of(command.asked.by, content, documents.flags(present), documents.rollouts(present))

    def on_stored(self, event: ev.DocumentStored, todo: ToDo, now: float) -> None:
        """The document of a command is on disk, or one without the flags whose time is over: propose it."""
        if event.request is None:
            self._end_flags(event, todo, now)
            return
        command, value = self._storing.pop(event.request, None), self._numbers.value
        if command is None or value is None or command.base_revision is None:
            return
        change = document_change(
            value,
            event.document,
            event.fleet,
            base_revision=command.base_revision,
            file_lease_s=self._numbers.file_lease_s,
        )
        self._propose(event.request, change, command, todo, now)

    def on_refused(self, event: ev.DocumentRefused, todo: ToDo) -> None:
        """The document of a command is not valid here, or the disk refused it."""
        if event.request is not None and self._storing.pop(event.request, None) is not None:
            self._answer(event.request, CommandOutcome.INVALID, event.reason, todo)

    def end_flags(self, flags: tuple[Flag, ...], todo: ToDo) -> None:
        """The time of some flags is over: agree a document that has only ``flags``."""
        value = self._numbers.value
        if value is not None and value.document:
            self._ending = value.revision, flags
            todo.add(do.AmendDocument(document=value.document, flags=flags))

    def _end_flags(self, event: ev.DocumentStored, todo: ToDo, now: float) -> None:
        ending, value = self._ending, self._numbers.value
        if ending is None or value is None or ending != (value.revision, event.flags):
            return
        if event.fleet != self._numbers.documents.fleet(value.document):
            return  # another document without these flags, which was fetched meanwhile
        self._ending = None
        change = document_change(value, event.document, event.fleet)
        self._numbers.propose(replace(change, reason="the time of a drain or of its like is over"), todo, now)

    def _propose(self, request: int, change: FleetChange, command: ChangeFleet, todo: ToDo, now: float) -> None:
        change = replace(change, reason=command.reason) if command.reason else change
        fault = self._numbers.propose(change, todo, now)
        if fault:
            self._answer(request, CommandOutcome.INVALID, fault, todo)
        else:
            self._running.append((change, request, command))

    def on_ended(self, change: Rewrite[FleetValue], outcome: RoundOutcome, todo: ToDo) -> None:
        """A change of the fleet has ended; if a command asked for it, its operator hears so."""
        request, command = next(
            ((number, order) for one, number, order in self._running if one is change), (None, None)
        )
        self._running = [one for one in self._running if one[0] is not change]
        value = self._numbers.value
        todo.add(_story(change, outcome, command))
        if request is None or value is None:
            return
        if outcome is RoundOutcome.COMMITTED:
            self._answer(request, CommandOutcome.OK, _committed(value), todo, value.revision)
            return
        kind, detail = told_end(outcome, len(value.electors))
        if outcome is RoundOutcome.UNCHANGED:
            detail = _UNCHANGED
            if fault := self._numbers.fault(change):
                kind, detail = CommandOutcome.INVALID, fault
        self._answer(request, kind, detail, todo, value.revision)

    @staticmethod
    def _answer(request: int, outcome: CommandOutcome, detail: str, todo: ToDo, revision: int | None = None) -> None:
        result = CommandResult(outcome=outcome, detail=detail, revision=revision)
        todo.add(do.AnswerCommand(request=request, result=result))


def _story(change: Rewrite[FleetValue], outcome: RoundOutcome, command: ChangeFleet | None) -> do.RecordStory:
    """What became of a change, with the name of the operator who has given the command, if one has."""
    asked = None if command is None else command.asked
    end = f", on revision {change.base_revision}: {outcome}"
    if asked is None:
        return do.RecordStory(stage="vote", text=f"{change.reason}{end}")
    text = as_reason(f"{told_by(asked)}: {change.reason}", MAX_STORY - len(end))
    is_done = outcome in (RoundOutcome.COMMITTED, RoundOutcome.UNKNOWN)
    return do.RecordStory(stage="vote", text=f"{text}{end}", by=asked.by if is_done else "")


def document_change(
    value: FleetValue,
    document: str,
    fleet: Fleet,
    *,
    base_revision: int | None = None,
    file_lease_s: float = 0.0,
) -> AdoptDocument | SetDocument:
    """The change by which a fleet goes by a document: the first one, or another one.

    Args:
        value: the fleet value that it is to change.
        document: the document's hash.
        fleet: what it says.
        base_revision: of the value that the operator saw; ``None``: this one.
        file_lease_s: the length of leases in the fleet file by which nodes have gone so far.
    """
    base = value.revision if base_revision is None else base_revision
    tasks = tuple((task.name, task.exclusive) for task in fleet.tasks)
    lease_s = fleet.timing.lease_s
    if value.document:
        return SetDocument(base_revision=base, document=document, tasks=tasks, lease_s=lease_s)
    return AdoptDocument(base_revision=base, document=document, tasks=tasks, lease_s=lease_s, file_lease_s=file_lease_s)


def _committed(value: FleetValue) -> str:
    names = ", ".join(value.electorate.names)
    told = f"committed by a majority of the electors; electors: {names}"
    return told if value.settled else f"{told}; number {value.number} is being settled, which the next change waits for"
