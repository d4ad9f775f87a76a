"""`zsched apply` and the verbs that change one entry: shows what a changed document does, asks, and has it agreed.

Knows: plans, dangers that are accepted by name, the first document of a fleet. Does not know: what follows from a place
of the file (`zsched.config.difference`), how a change is agreed.
"""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import typer

from zsched.commands.base.ask import Door
from zsched.commands.base.change import (
    QUESTION,
    InForce,
    OrderView,
    Plan,
    ask_all,
    asker,
    change,
    change_over,
    check_revision,
    consent,
    document_text,
    fleet_of,
    in_force,
    ordered,
    status_of,
    wait_until_settled,
)
from zsched.commands.base.common import (
    CliError,
    Json,
    check_dangers,
    print_json,
    warn,
)
from zsched.commands.base.options import Changes, PauseAfterOption
from zsched.commands.base.page import cut
from zsched.commands.base.rollout import Wave, begun, kept_rollouts, told_in
from zsched.config.difference import Change, Danger, Effect, difference, wanted_electors, warnings_in_force
from zsched.config.load import check_bytes
from zsched.config.parts import Part
from zsched.config.reader import MAX_FILE_BYTES, render_all
from zsched.core.values.errors import ConfigError
from zsched.core.values.exits import EXIT_FAILED, EXIT_OK, EXIT_TIMED_OUT
from zsched.core.values.fleet import Fleet, fleet_hash
from zsched.core.values.struct import Struct, replace
from zsched.host import paths as places
from zsched.host.files import read_regular
from zsched.link.sessions.restarts import opens_anew, restarts
from zsched.link.sessions.zenoh_file import judged

SCHEMA = "zsched.apply/1"
OTHER_FILES = "other-files"
"""The danger of a first document: nodes that go by another file now."""
OPEN_NETWORK = "open-network"
"""The danger of a node that strangers may reach, in a fleet without certificates."""
DANGERS = (*(danger.value for danger in Danger), OTHER_FILES, OPEN_NETWORK)
PATH_ROOM, VALUE_ROOM = 44, 28
STDIN = "-"


class Draft(Struct, frozen=True, kw_only=True):
    """What is to be agreed, and what follows."""

    held: InForce
    text: str
    fleet: Fleet
    changes: tuple[Change, ...]
    dangers: tuple[tuple[str, str], ...]
    """(name, what is accepted with it)."""
    restarts: tuple[tuple[str, str], ...] = ()
    """(nodes, what of it their daemons go by after a restart only)."""
    begins_again: bool = False
    """Daemons begin again by themselves for it: such a restart is no work for anybody."""
    warnings: str = ""
    note: str = ""
    """One line above the table."""
    rollouts: tuple[Json, ...] = ()
    """The changed workers that wait for a look afterwards."""

    @property
    def is_nothing(self) -> bool:
        """Whether the document in force is this very text, and its electors are those that are agreed."""
        return self.text == self.held.text and not self.changes

    @property
    def is_first(self) -> bool:
        """Whether no document was agreed yet."""
        return not self.held.document


def read_text(file: str) -> str:
    """The text of a fleet file; ``-`` is stdin.

    Raises:
        ConfigError: it cannot be read, or is no UTF-8.
    """
    try:
        data = sys.stdin.buffer.read(MAX_FILE_BYTES + 1) if file == STDIN else read_regular(Path(file), MAX_FILE_BYTES)
        return data.decode()
    except OSError as error:
        raise ConfigError(f"{file}: cannot be read: {error.strerror}; give the path of a fleet file") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{file}: byte 0x{error.object[error.start]:02x} is not UTF-8; save it as UTF-8") from error


def apply(
    said: Changes,
    file: Annotated[str, typer.Argument(metavar="FILE", help="Fleet file; -: stdin.")],
    pause_after: PauseAfterOption = None,
) -> int:
    """Change the running fleet to what a fleet file says: shows what follows, asks, and has it agreed for all nodes.

    Example: zsched apply fleet.yaml --plan

    The first one of a fleet agrees the file that its nodes run by. A danger has a name, and --accept takes it.
    Exits with 1 when the fleet was changed meanwhile, with 4 without a quorum, with 10 when --plan shows a change.
    """
    view, text = said.order("apply", file, pause_after=pause_after), read_text(file)
    return apply_change(view, lambda _held: text, file)


def apply_change(view: OrderView, make: Callable[[InForce], str], file: str, part: Part | None = None) -> int:
    """Draft the change that ``make`` makes of the document in force, show it, ask, have it agreed; the exit code.

    ``part``: what it adds, as its file has it.

    Raises:
        CliError: nobody answers, the change is refused, overtaken, or not accepted.
        ConfigError: the new file has faults.
    """
    held = in_force(view.door)
    return agree(view, make_plan(view.door, held, make(held), file, view, part))


def agree(view: OrderView, plan: Draft) -> int:
    """Show a plan, ask, have it agreed; the exit code.

    Raises:
        CliError: it is refused, overtaken, or not accepted.
    """
    check_dangers(view.accepted, DANGERS)
    held = plan.held
    check_revision(view, held)
    if plan.warnings and not view.is_json:
        warn(plan.warnings)
    if plan.is_nothing:
        return _tell(view, plan, "unchanged", held.revision)
    shown = Plan(
        text=table(plan),
        body=_body(plan, "planned", held.revision),
        dangers=plan.dangers,
        question=f"Change {held.fleet} for all its nodes?",
        can_ask=view.words[-1] != STDIN,
    )
    code = consent(view, shown)
    return _commit(view, plan) if code is None else code


def make_plan(
    door: Door, held: InForce, text: str, file: str, view: OrderView | None = None, part: Part | None = None
) -> Draft:
    """What ``text`` would change, and which dangers are in it; ``view`` says which changed workers wait for a look.

    ``part``: what was added to the document, as its file has it.

    Raises:
        CliError: it is another fleet's file, the document in force is not there or cannot be read here, or no changed
            worker can wait.
        ConfigError: it has faults.
    """
    config = places.config_path(None, os.environ)
    folder = config.absolute().parent if config.exists() else None  # where the nodes read it
    result = judged(check_bytes(text.encode(), file, folder, part))
    if held.document:
        result = replace(result, warnings=warnings_in_force(text, result.warnings))
    if result.fleet is None:
        raise ConfigError(result.report())
    fleet = result.fleet
    if fleet.name != held.fleet:
        advice = f"ask a node of {fleet.name} with --connect, or write `fleet: {held.fleet}`"
        raise CliError(
            EXIT_FAILED, f"{file} is the file of fleet {fleet.name}, and this is fleet {held.fleet}; {advice}"
        )
    warnings = render_all(file, result.warnings, "warning")
    pause_after = None if view is None else view.pause_after
    if not held.document:
        if pause_after is not None:
            raise CliError(EXIT_FAILED, f"--pause-after: {held.fleet} has no document yet; agree its file first")
        return _first(door, held, text, fleet, warnings)
    old = fleet_of(document_text(held), file, folder)
    status = status_of(door)
    owners = {str(task["name"]): task["owner"] for task in status["tasks"]}
    electors = tuple(name for name, _ in held.electors)
    bound = {str(task["name"]) for task in status["tasks"] if (pin := task.get("pin")) is not None and pin["is_hard"]}
    changes = difference(old, fleet, (held.text, text), owners, electors, bound)
    if not wanted_electors(electors, fleet, text):
        raise CliError(EXIT_FAILED, f"{file}: no elector would be left; keep one of {', '.join(electors)}")
    rollouts = kept_rollouts(held.rollouts, fleet)
    if view is not None and pause_after is not None:
        texts, revision = (held.text, text), held.revision + 1
        wave = Wave(old=old, new=fleet, texts=texts, status=status, electors=electors, revision=revision)
        rollouts = (*rollouts, *begun(wave, pause_after, rollouts, by=asker(door), reason=view.reason))
    changes = tuple(told_in(one, rollouts) for one in changes)
    dangers = [(one.danger.value, one.warning()) for one in changes if one.danger is not None]
    note = "" if changes or text == held.text else "only comments, blanks or the order of keys differ: nothing notices"
    return Draft(
        held=held,
        text=text,
        fleet=fleet,
        changes=changes,
        dangers=tuple(dangers),
        restarts=_restarts(old, fleet),
        begins_again=opens_anew(old, fleet),
        warnings=warnings,
        note=note,
        rollouts=tuple(sorted(rollouts, key=lambda one: str(one["task"]))),
    )


def _restarts(old: Fleet, new: Fleet) -> tuple[tuple[str, str], ...]:
    """(nodes, what of the new fleet their daemons cannot take over); electors and leases change by agreement."""
    stay = {node.name: node.kind for node in old.nodes}
    who: dict[str, list[str]] = {}
    for node in new.nodes:
        if stay.get(node.name) is node.kind:
            for sentence in restarts(old, new, node.name, is_agreed=True):
                who.setdefault(sentence, []).append(node.name)
    return tuple((", ".join(names), sentence) for sentence, names in who.items())


def _first(door: Door, held: InForce, text: str, fleet: Fleet, warnings: str) -> Draft:
    """The first document: every node is asked which file it goes by.

    Raises:
        CliError: its electors are not those by which the fleet runs.
    """
    electors = tuple(sorted(name for name, _ in held.electors))
    if fleet.electors != electors:
        advice = f"agree the file that {held.node} runs by first, then apply this one"
        raise CliError(
            EXIT_FAILED,
            f"this file has the electors {', '.join(fleet.electors)}, the fleet has {', '.join(electors)}; {advice}",
        )
    names = [node.name for node in fleet.nodes]
    answers = ask_all(door, names, {"verb": "status"})
    digest = fleet_hash(fleet)
    other, silent = [], []
    for name, answer in answers.items():
        if isinstance(answer, CliError):
            silent.append(name)
        elif answer["fleet_file"] != digest:
            other.append(name)
    dangers: tuple[tuple[str, str], ...] = ()
    if other:
        means = (
            f"{', '.join(other)} go by another file now (`zsched check` tells a file's hash); this one takes its place"
        )
        dangers = ((OTHER_FILES, means),)
    note = f"{held.fleet} goes by the file on each machine; from then on by this one document"
    if silent:
        note += f"\nnot asked, for they do not answer: {', '.join(silent)}; they follow when they are back"
    return Draft(held=held, text=text, fleet=fleet, changes=(), dangers=dangers, warnings=warnings, note=note)


# --- what is shown ---------------------------------------------------------------------------------------------------


def table(plan: Draft) -> str:
    """What changes, place by place: before -> after, and what follows."""
    head = f"{plan.held.fleet}, revision {plan.held.revision}"
    lines = [f"{head}: {plan.note}" if plan.note else f"{head}:"]
    room = min(max((len(one.path) for one in plan.changes), default=0), PATH_ROOM)
    values = [_values(one) for one in plan.changes]
    wide = min(max((len(value) for value in values), default=0), 2 * VALUE_ROOM + 4)
    for one, value in zip(plan.changes, values, strict=True):
        danger = f" [{one.danger}]" if one.danger is not None else ""
        lines.append(f"  {cut(one.path, room):{room}}  {value:{wide}}  {one.consequence}{danger}")
    lines += [f"until {names} {_until(names, plan.begins_again)}: {why}" for names, why in plan.restarts]
    return "\n".join(lines)


def _until(names: str, is_by_itself: bool) -> str:
    """What the daemons of ``names`` do before they go by all of it."""
    if "," in names:
        return "begin again, by themselves" if is_by_itself else "restart"
    return "begins again, by itself" if is_by_itself else "restarts"


def _values(one: Change) -> str:
    before, after = ("-" if value is None else cut(value, VALUE_ROOM) for value in (one.before, one.after))
    return f"{before} -> {after}"


def _tell(view: OrderView, plan: Draft, outcome: str, revision: int) -> int:
    """The end of it, for people or as JSON."""
    if view.is_json:
        print_json(_body(plan, outcome, revision))
    else:
        told = (
            f", revision {revision}: nothing would change"
            if outcome == "unchanged"
            else f": revision {revision} is agreed"
        )
        (sys.stderr if view.is_data else sys.stdout).write(f"{plan.held.fleet}{told}\n")
    return EXIT_OK


def _body(plan: Draft, outcome: str, revision: int) -> Json:
    changes = [
        {
            "path": one.path,
            "before": one.before,
            "after": one.after,
            "effect": one.effect.value,
            "consequence": one.consequence,
            "danger": None if one.danger is None else one.danger.value,
        }
        for one in plan.changes
    ]
    dangers = [{"name": name, "means": means} for name, means in plan.dangers]
    body = {"schema": SCHEMA, "fleet": plan.held.fleet, "outcome": outcome, "revision_before": plan.held.revision}
    by_itself = plan.begins_again
    waiting = [{"nodes": names.split(", "), "why": why, "by_itself": by_itself} for names, why in plan.restarts]
    told = {"changes": changes, "dangers": dangers, "restarts": waiting}
    return {**body, "revision": revision, "is_first": plan.is_first, **told}


# --- asking, and agreeing --------------------------------------------------------------------------------------------


def _commit(view: OrderView, plan: Draft) -> int:
    """Have it agreed, one change after another, each on the revision that the one before made.

    An elector that leaves the fleet goes first: it would not take a document that does not name it. One that comes, or
    only ceases to be one, follows the document.
    """
    steps = tuple(_steps(view.door, plan))
    held, document = plan.held, plan.held.document
    for number, step in enumerate(steps):
        try:
            _check_same(held, document)
            held = wait_until_settled(view.door, _agreed(step, held, view))
        except KeyboardInterrupt:
            warn(f"\n{number} of {len(steps)} changes are agreed, and the next one may be: give the command again")
            raise
        except CliError as error:
            if number == 0 or error.code == EXIT_TIMED_OUT:
                raise
            done = f"{number} of {len(steps)} changes are agreed, up to revision {held.revision}, and the next is not"
            raise CliError(EXIT_TIMED_OUT, f"{done}: {error}; give the command again") from error
        document = held.document if "text" in step else document
    return _tell(view, plan, "ok", held.revision)


def _agreed(step: Json, held: InForce, view: OrderView) -> int:
    """The revision that one change made.

    Raises:
        CliError: it is refused; somebody else was first, or the fleet does not come to rest.
    """
    what = {**step, **ordered(shlex.join(view.words), view.asked)}
    if "text" in step and view.revision is None:
        return int(change_over(view.door, what, held)["revision"])
    return int(change(view.door, {**what, "base_revision": held.revision})["revision"])


def _check_same(held: InForce, document: str) -> None:
    if held.document != document:
        raise CliError(EXIT_FAILED, "another document was agreed meanwhile")


def _steps(door: Door, plan: Draft) -> Iterator[Json]:
    """The changes that make the plan true, in their order."""
    there = tuple(name for name, _ in plan.held.electors)
    is_asked = not plan.is_first and (
        plan.text != plan.held.text or any(one.effect is Effect.ELECTORS for one in plan.changes)
    )
    wanted = wanted_electors(there, plan.fleet, plan.text) if is_asked else there
    come, go = [name for name in wanted if name not in there], [name for name in there if name not in wanted]
    disks = _disks(door, come, _unseated(plan, there))
    come = [name for name in come if name in disks]
    nodes = {node.name for node in plan.fleet.nodes}
    leave = [name for name in go if name not in nodes]
    yield from ({"remove_elector": name} for name in leave)
    if plan.text != plan.held.text or plan.rollouts != plan.held.rollouts:
        flags = [flag for flag in plan.held.flags if flag["subject"] in nodes]
        yield {"text": plan.text, "flags": flags, "rollouts": list(plan.rollouts)}
    yield from ({"add_elector": name, "disk": disks[name]} for name in come)
    yield from ({"remove_elector": name} for name in go if name not in leave)


def _unseated(plan: Draft, there: tuple[str, ...]) -> tuple[str, ...]:
    """The electors that the document of before names, too, and that have lost their seats."""
    before = check_bytes(plan.held.text.encode(), "the document in force").fleet if plan.held.text else None
    wanted = () if before is None else wanted_electors(there, before, plan.held.text)
    return tuple(name for name in wanted if name not in there)


def _disks(door: Door, names: list[str], unseated: tuple[str, ...]) -> dict[str, str]:
    """{node: id of the disk with which it becomes an elector}.

    Of those that are ``unseated`` already one that does not answer is left out: it keeps nobody from forgetting others.

    Raises:
        CliError: one does not answer, or has no state.
    """
    found = {}
    for name, answer in ask_all(door, names, QUESTION).items() if names else ():
        disk = "" if isinstance(answer, CliError) else str(answer["disk"])
        if not disk and name in unseated:
            continue
        if not disk:
            why = str(answer) if isinstance(answer, CliError) else "it has no state: zsched init there"
            raise CliError(EXIT_FAILED, f"nothing was changed: {name} cannot become an elector now: {why}")
        found[name] = disk
    return found
