"""`zsched task add|remove` and `zsched node add|remove|forget`: one entry of the document, the rest as it stands.

Knows: which entry is meant, when a node may not go. Does not know: where an entry stands in the text
(`zsched.config.editing`), what follows from the change (`zsched.config.difference`).
"""

from __future__ import annotations

from pathlib import Path

from zsched.commands.apply import apply, read_text
from zsched.commands.common import CliError, Json, nearest
from zsched.commands.document import DOCUMENT, HERE, InForce, document_text, status_of
from zsched.commands.orders import OrderView
from zsched.config.editing import add_entries, remove_node, remove_task
from zsched.config.parts import Part
from zsched.exits import EXIT_FAILED, EXIT_USAGE


def add(view: OrderView, section: str, file: Path) -> int:
    """Add the entries of ``file`` (a text with the one key ``section``) to the document; the exit code.

    Raises:
        CliError, ConfigError: as of `apply`; or the file holds something else, or an entry that is there already.
    """
    fragment = read_text(str(file))
    part = Part(section=section, text=fragment, file=str(file))
    return apply(view, lambda held: add_entries(document_text(held), section, fragment, str(file)), DOCUMENT, part)


def drop_task(view: OrderView, task: str) -> int:
    """Take a task out of the document; the exit code.

    Raises:
        CliError, ConfigError: as of `apply`; or there is no such task (2).
    """
    return apply(view, lambda held: remove_task(document_text(held), _known(view, task, "tasks")), DOCUMENT)


def drop_node(view: OrderView, node: str, *, is_lost: bool) -> int:
    """Take a node out of the document; the exit code.

    Args:
        view: whom to ask, and how the change is shown and confirmed.
        node: which one.
        is_lost: it does not come back: only a node that is not there may be forgotten.

    Raises:
        CliError, ConfigError: as of `apply`; or there is no such node (2), or it may not go (1).
    """

    def make(held: InForce) -> str:
        text = document_text(held)
        status = status_of(view.door)
        _known(view, node, "nodes", status)
        _check_may_go(held, status, node, is_lost=is_lost)
        return remove_node(text, node)

    return apply(view, make, DOCUMENT)


def _known(view: OrderView, name: str, section: str, status: Json | None = None) -> str:
    status = status_of(view.door) if status is None else status
    names = [str(one["name"]) for one in status[section]]
    if name not in names:
        what = section.removesuffix("s")
        raise CliError(EXIT_USAGE, f"fleet {status['fleet']} has no {what} {name!r}{nearest(name, names)}")
    return name


def _check_may_go(held: InForce, status: Json, node: str, *, is_lost: bool) -> None:
    """Refuse to take out a node that the fleet needs, with what to do."""
    state = next(str(one["state"]) for one in status["nodes"] if one["name"] == node)
    owned = [str(task["name"]) for task in status["tasks"] if task["owner"] == node]
    if [name for name, _ in held.electors] == [node]:
        advice = "add another elector first (`electorate:` in `zsched edit`)"
        raise CliError(EXIT_FAILED, f"{node} is the last elector: without it nothing can be agreed; {advice}")
    if is_lost and state in HERE:
        raise CliError(EXIT_FAILED, f"{node} is {state}: zsched node remove {node}")
    if state in HERE and owned:
        flags = next(one.get("flags", ()) for one in status["nodes"] if one["name"] == node)
        advice = f"`zsched drain {node}` first: it hands them over, and gets nothing new"
        if any(flag["kind"] in ("drain", "leave") for flag in flags):
            advice = f"it is drained: `zsched drain {node}` says what it waits for"
        raise CliError(EXIT_FAILED, f"{node} is {state} and owns {', '.join(owned)}; {advice}")
