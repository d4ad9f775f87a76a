"""The steps of `zsched task hand`: from one cell to another, or back; each is seen in both, and passed over when done.

Knows: what must be true before the next step, how it is seen, what is said. Does not know: what an operator may ask
for, what is shown before (`zsched.commands.hand`).

The task works on here until it is ready there. An exclusive one stops here first, and begins there once no lease of it
can be left.
"""

from __future__ import annotations

import contextlib
import shlex
import time
from collections.abc import Callable, Iterator
from typing import Final

from zsched.clock import monotonic_s
from zsched.commands.ask import Door, ask_door
from zsched.commands.common import CliError, Json, print_json, say, told_task, warn
from zsched.commands.document import (
    OVERTAKEN_S,
    UNKNOWING,
    ConflictError,
    ask_all,
    change,
    document_text,
    in_force,
    ordered,
    status_of,
    wait_until_settled,
)
from zsched.commands.lacks import UselessError, wait_for
from zsched.commands.membership import fleet_of
from zsched.commands.orders import OrderView
from zsched.commands.page import span
from zsched.commands.rollout import kept_rollouts
from zsched.commands.wait import Condition, missing
from zsched.config.editing import add_entries, remove_task, task_entry
from zsched.config.handing import Mark, mark_of, marked, unmarked
from zsched.config.load import check_bytes
from zsched.core.values.document import MAX_DOCUMENT_BYTES
from zsched.core.values.electorate import FleetValue
from zsched.core.values.fleet import Fleet, TaskSpec
from zsched.core.values.lease import hold_s
from zsched.core.values.model import TaskId
from zsched.core.values.quorum import majority
from zsched.core.values.struct import Struct, replace
from zsched.errors import AdapterError, ConfigError
from zsched.exits import EXIT_DEGRADED, EXIT_FAILED, EXIT_OK, EXIT_TIMED_OUT
from zsched.wire.codec import from_plain

SCHEMA: Final = "zsched.task.hand/1"
PAUSE_S: Final = 0.2
BACK_S: Final = 60.0
"""How long each step of taking it back may take."""


class HandOrder(Struct, frozen=True, kw_only=True):
    """What the operator has said."""

    task: TaskId
    cell: str
    """Where it goes; this machine's own one: it is taken back."""
    door: Door
    """To a node of the cell that has it."""
    entry: str | None = None
    """A file with the task's entry as it shall be there; ``None``: as here."""
    deadline_s: float = 120.0
    """How long it may take to be ready there, in seconds."""
    reason: str = ""
    is_plan: bool = False
    is_yes: bool = False
    is_json: bool = False
    where: tuple[str, ...] = ()
    """The words that say which daemon is asked."""

    def to(self, cell: str, *more: str) -> str:
        """The command to that cell, as it is to be given again."""
        return shlex.join(("zsched", "task", "hand", self.task, cell, *more, *self.where))


class Side(Struct, frozen=True, kw_only=True):
    """One of the two cells."""

    name: str
    door: Door


class Way(Struct, frozen=True, kw_only=True):
    """One task on its way."""

    order: HandOrder
    here: Side
    there: Side
    began: float
    wanted: str = ""
    """Its entry there; empty: the other cell has it already, or it is taken back."""
    is_exclusive: bool = False
    entry: str = ""
    """Its entry here when it was looked at; empty: this cell's document is without it."""
    run: str = ""
    """What this command's mark says, as `Mark.by`: who begins, goes on or takes it back writes its own first."""

    @property
    def task(self) -> TaskId:
        """Its name, in both cells."""
        return self.order.task

    @property
    def on(self) -> str:
        """The command that takes it on, given again."""
        more = () if self.order.entry is None else ("--entry", self.order.entry)
        return self.order.to(self.there.name, *more)

    @property
    def back(self) -> str:
        """The command that takes it back."""
        return self.order.to(self.here.name)

    def tell(self, text: str) -> None:
        """A step that is done, for people; programs read the end."""
        if not self.order.is_json:
            say(text)

    def left_s(self) -> float:
        """Of the deadline."""
        return max(self.order.deadline_s - (monotonic_s() - self.began), 0.0)


class _RefusedError(UselessError):
    """The other cell cannot have the task as it is: waiting does not help."""


class _OvertakenError(UselessError):
    """The mark is another command's, or gone: this one may do nothing more."""


def task_in(fleet: Fleet, task: TaskId) -> TaskSpec | None:
    """The task of this name; ``None``: the fleet has none."""
    return next((one for one in fleet.tasks if one.name == task), None)


def has_task(text: str, task: TaskId) -> bool:
    """Whether a document has the task. Raises `CliError`: it has faults for this version."""
    return task_in(fleet_of(text), task) is not None


def by_file(way: Way) -> str:
    """What to do where the other cell cannot have the entry as it is here."""
    again = way.order.to(way.there.name, "--entry", "FILE")
    return f"write the entry as it shall be there, below the one key `tasks`: {again}"


def text_with(way: Way, text: str, entry: str) -> str:
    """The other cell's document with the task.

    Raises:
        ConfigError: it would have faults.
    """
    longer = add_entries(text, "tasks", entry, f"the entry of {way.task}")
    if faults := _faults(longer, f"the document of {way.there.name} with {way.task}"):
        raise ConfigError(f"nothing was changed: {faults}\n{by_file(way)}")
    return longer


def _faults(text: str, name: str) -> str:
    """Why no cell could agree on a document; empty: it could."""
    result = check_bytes(text.encode(), name)
    if result.fleet is None:
        return result.report()
    size = len(text.encode())
    return "" if size <= MAX_DOCUMENT_BYTES else f"{name} would have {size} bytes, at most {MAX_DOCUMENT_BYTES} can be"


def body_of(order: HandOrder, here: str, there: str, outcome: str, owner: str | None = None) -> Json:
    """What came of it, as JSON."""
    return {"schema": SCHEMA, "task": order.task, "from": here, "to": there, "outcome": outcome, "owner": owner}


def tell_end(order: HandOrder, here: str, there: str, outcome: str, said: str, owner: str | None = None) -> int:
    """The end of it, for people or as JSON."""
    if order.is_json:
        print_json(body_of(order, here, there, outcome, owner))
    else:
        say(said)
    return EXIT_OK


# --- to the other cell -----------------------------------------------------------------------------------------------


def go_over(way: Way) -> int:
    """Step by step; what is done already is passed over.

    Its mark is written first, whatever is done: another command that is under way stops then, and what an elector has
    accepted of one that ended with "unknown" can come about no more.

    Raises:
        CliError: a step was not agreed, or the other cell did not get it ready in time.
    """
    task, here, there = way.task, way.here.name, way.there.name
    way = replace(way, began=monotonic_s())
    again = f"`{way.on}` goes on, `{way.back}` takes it back"
    if way.wanted and has_task(document_text(in_force(way.there.door)), task):
        raise CliError(EXIT_FAILED, f"{there} has got a task {task} meanwhile: look at it again with --plan")
    with _advised(way, again):
        revision = _agree(way, way.here, lambda text: _begun(way, text))
    works = "nobody does it meanwhile" if way.is_exclusive else f"it works on in {here}"
    with _advised(way, f"{works}; {again}"):
        if way.wanted and revision is not None:
            told = f", without {task}, which" if way.is_exclusive else f": {task}"
            way.tell(f"{here}: revision {revision} is agreed{told} is on its way to {there}")
        lack = _wait(lambda: _not_over(way, way.here), way) if way.is_exclusive and way.wanted else ""
        if not lack:
            lack = _taken(way)
    if lack:
        return _took_back(way, f"{there} has not taken it: {lack}")
    with _advised(way, f"{task} is ready in {there}; `{way.on}` takes it out of {here}"):
        owner = told_task(status_of(way.there.door), task).get("owner")
        way.tell(f"{there}: {task} is ready on {owner}")
        revision = _agree(way, way.here, lambda text: _ended(way, text))
    if revision is not None:
        kept = f"and keeps nothing of {task}" if way.is_exclusive else f"without {task}"
        way.tell(f"{here}: revision {revision} is agreed, {kept}")
    said = f"{task} has gone from {here} to {there}"
    return tell_end(way.order, here, there, "handed", said, owner)


@contextlib.contextmanager
def _advised(way: Way, advice: str) -> Iterator[None]:
    """Say how it goes on when a step fails, or is broken off."""
    try:
        yield
    except KeyboardInterrupt:
        warn(f"{way.task}: broken off; {advice}")
        raise
    except _OvertakenError:
        raise
    except CliError as error:
        raise CliError(error.code, f"{error}; {advice}") from error
    except (AdapterError, ConfigError) as error:
        raise CliError(EXIT_FAILED, f"{error}; {advice}") from error


def _begun(way: Way, text: str) -> str:
    """This cell's document with this command's mark; without the task, if that is exclusive.

    Raises:
        CliError: it is no more as it was looked at.
    """
    entry, mark = (task_entry(text, way.task) if has_task(text, way.task) else ""), mark_of(text, way.task)
    is_elsewhere = mark.cell != way.there.name if mark is not None else not entry
    if entry != way.entry or is_elsewhere:
        raise _OvertakenError(
            EXIT_FAILED, f"{way.task} was changed in {way.here.name} meanwhile: look at it again with --plan"
        )
    if entry and way.is_exclusive:
        text = remove_task(text, way.task)
    kept = entry if mark is None or entry else mark.entry
    return marked(text, Mark(task=way.task, cell=way.there.name, entry=kept, by=way.run))


def _mark(way: Way, text: str) -> Mark:
    """This command's mark in the document of this cell. Raises `_OvertakenError`: it is another one's, or gone."""
    mark = mark_of(text, way.task)
    if mark is None or mark.by != way.run:
        told = f"{way.task} is no more on its way from {way.here.name} to {way.there.name} by this command"
        advice = "somebody else has taken that over, or brought it to its end; `zsched site` tells where it is"
        raise _OvertakenError(EXIT_FAILED, f"{told}: {advice}")
    return mark


def check_steps(way: Way, text: str) -> None:
    """Refuse what could not be taken to its end, or back, in this cell's document, before anything is done.

    Raises:
        ConfigError: without the task it has faults, or the task could not be put in again.
    """
    try:
        begun = _begun(way, text)
        _restored(way, begun)
        texts = begun, _ended(way, begun)
    except ConfigError as error:
        raise ConfigError(f"nothing was changed: {error}") from error
    for then in texts:
        if faults := _faults(then, f"the document of {way.here.name} without {way.task}"):
            raise ConfigError(f"nothing was changed: {faults}\nchange it first: zsched edit")


def _ended(way: Way, text: str) -> str:
    """This cell's document without the task, and without the mark. Raises `_OvertakenError`: as of `_mark`."""
    _mark(way, text)
    return unmarked(remove_task(text, way.task) if has_task(text, way.task) else text, way.task)


def _taken(way: Way) -> str:
    """Have the other cell take the task, and wait until it is ready there; what is missing at the deadline."""
    try:
        return _wait(lambda: _not_ready(way), way)
    except _RefusedError as error:
        return str(error)


def _not_ready(way: Way) -> str:
    """What the task lacks in the other cell, whose document has it from now on; empty: nothing."""
    if way.wanted:
        try:
            revision = _agree(way, way.there, lambda text: _given(way, text))
        except (ConflictError, _OvertakenError):
            raise
        except (CliError, ConfigError) as error:
            if isinstance(error, CliError) and error.code != EXIT_FAILED:
                raise
            raise _RefusedError(EXIT_FAILED, str(error)) from error
        if revision is not None:
            way.tell(f"{way.there.name}: revision {revision} is agreed, with {way.task}")
    return _lack(way.there.door, way.task)


def _given(way: Way, text: str) -> str:
    """The other cell's document with the task, if that is still on its way.

    Raises:
        _OvertakenError: another command has taken it over, or back.
        _RefusedError: this cell has it again, and it is exclusive.
        CliError: too few of this cell's electors tell that it is out: the node that was asked may be cut off from them.
    """
    if has_task(text, way.task):
        return text
    longer = text_with(way, text, way.wanted)
    ours = document_text(in_force(way.here.door))
    _mark(way, ours)
    again = task_in(fleet_of(ours), way.task)
    if again is not None and (way.is_exclusive or again.exclusive):
        raise _RefusedError(EXIT_FAILED, f"it is exclusive, and {way.here.name} has it again")
    if way.is_exclusive and (lack := _knowing(way, way.here)[0]):
        raise CliError(EXIT_DEGRADED, lack)
    return longer


def _lack(door: Door, task: TaskId) -> str:
    """What keeps a task from being settled on a ready owner, as every living robot of its cell sees it."""
    first = status_of(door)
    robots = [str(one["name"]) for one in first["nodes"] if one["kind"] == "robot" and one["state"] == "alive"]
    statuses = {str(first["node"]): first}
    for name, answer in ask_all(door, [one for one in robots if one not in statuses], {"verb": "status"}).items():
        if isinstance(answer, CliError):
            return str(answer)
        statuses[name] = answer
    for name, status in statuses.items():
        if not told_task(status, task):
            return f"{name} has not learnt of it yet"
    return "; ".join(missing(Condition(kind="settled", task=task), statuses)).replace(f"{task}: ", "")


def _not_over(way: Way, side: Side) -> str:
    """Why a worker of the exclusive task may still work in a cell whose document is without it; empty: none can.

    Its electors echo no beat of its owner any more from when they have learnt that document. Once a majority has, no
    lease can be renewed, and the longest one that may run is over in a hold (`zsched.core.vote.lease`).

    Raises:
        _RefusedError: the cell has the task again.
    """
    lack, value, knowing = _knowing(way, side)
    if lack:
        return lack
    time.sleep(hold_s(value.guard_lease_s))
    way.tell(f"{side.name}: nobody works on {way.task}: {', '.join(knowing)} renew no lease, and the last one is over")
    return ""


def _knowing(way: Way, side: Side) -> tuple[str, FleetValue, list[str]]:
    """(what keeps a majority from knowing that a cell is without the task, its newest value, the electors that know).

    Raises:
        _RefusedError: the cell has the task again.
        CliError: the node that was asked knows no value yet.
    """
    told = ask_door(side.door, {"verb": "fleet"})
    if told["revision"] is None:
        raise CliError(EXIT_DEGRADED, f"{told['node']} of {side.name}: {UNKNOWING}")
    value = from_plain(told["value"], FleetValue)
    if value.creation(way.task) is not None:
        raise _RefusedError(EXIT_FAILED, f"{side.name} has a task {way.task} again")
    electors = value.electorate.names
    answers = ask_all(side.door, electors, {"verb": "status"})
    knowing = [name for name, answer in answers.items() if _is_rid(answer, value.revision, way.task)]
    needed = majority(len(electors))
    names, few = ", ".join(electors), len(knowing) < needed
    lack = f"{len(knowing)} of the electors {names} of {side.name} know that it ends, {needed} needed" if few else ""
    return lack, value, knowing


def _is_rid(answer: Json | CliError, revision: int, task: TaskId) -> bool:
    if isinstance(answer, CliError):
        return False
    return int(answer["fleet_revision"]) >= revision and not told_task(answer, task)


# --- and back --------------------------------------------------------------------------------------------------------


def _took_back(way: Way, why: str) -> int:
    """The other cell has not taken it: take it back.

    Raises:
        CliError: always: it did not come about.
    """
    warn(f"{way.task}: {why}; it is taken back")
    bring_back(way)
    raise CliError(EXIT_FAILED, f"{way.task} is a task of {way.here.name} as before, for {why}")


def take_over(way: Way) -> None:
    """Have this command's mark in this cell's document, in place of the one that is there.

    Raises:
        CliError: it is not agreed, or there is none any more.
    """

    def ours(text: str) -> str:
        mark = mark_of(text, way.task)
        return marked(text, _mark(way, text) if mark is None else replace(mark, by=way.run))

    _agree(way, way.here, ours)


def bring_back(way: Way) -> None:
    """Have the other cell without the task, and this one with it as before; the mark is this command's.

    Raises:
        CliError: a step was not done in time.
    """
    task, here, there = way.task, way.here.name, way.there.name
    text = document_text(in_force(way.here.door))
    is_out = not has_task(text, task)
    if is_out:
        works = f"nobody does it in {here}: it may work in {there}"
    else:
        works = f"it works on in {here}, and may work in {there}, too"
    with _advised(way, f"{works}; `{way.on}` goes on, `{way.back}` takes it back"):
        _check_restored(way, text)
        lack = _wait(lambda: _not_there(way, is_out=is_out), way, BACK_S)
        if lack:
            raise CliError(EXIT_TIMED_OUT, f"{task} is not taken back: {lack}")
        revision = _agree(way, way.here, lambda text: _restored(way, text))
    if revision is not None:
        way.tell(f"{here}: revision {revision} is agreed, with {task}")
    lack = _wait(lambda: _lack(way.here.door, task), way, BACK_S) if is_out else ""
    if lack:
        raise CliError(EXIT_TIMED_OUT, f"{task} is a task of {here} again, and is not ready: {lack}")


def _check_restored(way: Way, text: str) -> None:
    """Refuse what this cell could not have again, as long as the other one has it.

    Raises:
        ConfigError: this cell's document with the task would have faults.
    """
    where = f"the document of {way.here.name} with {way.task}"
    advice = f"change the task's entry in the comment at the end of the document of {way.here.name}: zsched edit"
    try:
        faults = _faults(_restored(way, text), where)
    except ConfigError as error:
        faults = str(error)
    if faults:
        raise ConfigError(f"{way.task} is not taken back: {faults}\n{advice}")


def _not_there(way: Way, *, is_out: bool) -> str:
    """Why the other cell may have the task, or get it; empty: it cannot. ``is_out``: this one's document is without it.

    Raises:
        _OvertakenError: as of `_mark`.
        _RefusedError: the other cell has it again.
    """
    task, there = way.task, way.there

    def without(text: str) -> str:
        _mark(way, document_text(in_force(way.here.door)))
        return remove_task(text, task) if has_task(text, task) else text

    revision = _agree(way, there, without)
    if revision is not None:
        way.tell(f"{there.name}: revision {revision} is agreed, without {task}")
    if is_out and (lack := _not_over(way, there)):
        return lack
    _fence(way)
    return ""


def _fence(way: Way) -> None:
    """Have the other cell agree twice on something: a line, and no line.

    What was asked of it before can come about no more then, by an elector that has accepted it and was away, or by a
    command that had looked before: each change names the revision that it is based on.
    """
    line = f"# zsched: task {way.task} stays in cell {way.here.name}\n"

    def without(text: str) -> str:
        if has_task(text, way.task):
            raise CliError(EXIT_FAILED, f"{way.there.name} has {way.task} again")
        return text.removeprefix(line)

    _agree(way, way.there, lambda text: line + without(text))
    _agree(way, way.there, without)


def _restored(way: Way, text: str) -> str:
    """This cell's document with the task as it was, and without the mark. Raises `_OvertakenError`: as of `_mark`."""
    mark = _mark(way, text)
    text = unmarked(text, way.task)
    return text if has_task(text, way.task) else add_entries(text, "tasks", mark.entry, "what was kept")


# --- agreeing, and waiting -------------------------------------------------------------------------------------------


def _agree(way: Way, side: Side, make: Callable[[str], str]) -> int | None:
    """Have a cell agree what ``make`` makes of its newest document; the revision, ``None``: it is so already.

    Once that is not the newest any more, ``make`` is asked again: what it has looked at may have changed as well.

    Raises:
        ConflictError: others change it again and again.
        CliError: it is not agreed, or not settled in time.
        ConfigError: the document would have faults.
    """
    until = monotonic_s() + OVERTAKEN_S
    while True:
        held = in_force(side.door)
        text = document_text(held)
        new = make(text)
        if new == text:
            return None
        if faults := _faults(new, f"the document of {side.name}"):
            raise ConfigError(faults)
        rollouts = list(kept_rollouts(held.rollouts, fleet_of(new)))
        view = OrderView(door=side.door, reason=way.order.reason)
        what = f"task hand {way.task} {way.order.cell}"
        kept = {"flags": list(held.flags), "rollouts": rollouts}
        try:
            base = {"base_revision": held.revision}
            answer = change(side.door, {"text": new, **kept, **ordered(what, view.asked), **base})
        except ConflictError:
            if monotonic_s() > until:
                raise
            time.sleep(PAUSE_S)
        else:
            return wait_until_settled(side.door, int(answer["revision"])).revision


def _wait(look: Callable[[], str], way: Way, for_s: float | None = None) -> str:
    """As `wait_for`; ``for_s``: by default as long as the deadline lets it."""

    def tell(lack: str, left_s: float) -> None:
        way.tell(f"{way.task}: waits, for at most {span(left_s)}: {lack}")

    return wait_for(look, way.left_s() if for_s is None else for_s, tell)
