"""`zsched fleet show|export` and `zsched edit`: what the fleet goes by, its text, and the text in an editor.

Knows: which nodes tell what they go by, how an editor is started. Does not know: what a change does.
"""

from __future__ import annotations

import contextlib
import os
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from zsched.commands.act.apply import apply_change, read_text
from zsched.commands.act.flags import SEAT_ADVICE, without_seat
from zsched.commands.base.ask import PASSES_ON
from zsched.commands.base.change import QUESTION, InForce, OrderView, ask_all, document_text, in_force, status_of
from zsched.commands.base.common import CliError, Json, print_json, say, warn
from zsched.commands.base.options import Answers, Asks, Edits, OutputOption, PauseAfterOption, new_group
from zsched.commands.members.membership import create
from zsched.commands.members.recover import recover_fleet
from zsched.core.values.errors import ConfigError
from zsched.core.values.exits import EXIT_FAILED, EXIT_OK, EXIT_WOULD_CHANGE
from zsched.host.files import replace_regular
from zsched.host.screen import harmless, is_screen

SCHEMA = "zsched.fleet.show/1"


def show(asked: Answers) -> int:
    """Show the fleet's revision, its electors and its document, and which node goes by which.

    Example: zsched fleet show
    """
    door = asked.door()
    held = in_force(door)
    names = [str(node["name"]) for node in status_of(door)["nodes"]]
    told = [_row(name, answer) for name, answer in ask_all(door, names, QUESTION).items()]
    if asked.json_:
        electors = [{"name": name, "disk": disk} for name, disk in held.electors]
        body = {"schema": SCHEMA, "fleet": held.fleet, "node": held.node, "revision": held.revision}
        body |= {"number": held.number, "settled": held.is_settled, "document": held.document}
        print_json({**body, "electors": electors, "nodes": told})
    else:
        say(_text(held, told).rstrip("\n"), indent=4)
    return EXIT_OK


def _row(name: str, answer: Json | CliError) -> Json:
    """What one node goes by; ``None`` where it did not answer."""
    if isinstance(answer, CliError):
        return {"name": name, "revision": None, "document": None, "fleet_file": None, "problem": str(answer)}
    told = {key: answer.get(key) for key in ("revision", "document", "fleet_file")}
    return {"name": name, **told, "problem": None}


def _text(held: InForce, told: list[Json]) -> str:
    """For people: what stands out is said at the node that differs."""
    state = "settled" if held.is_settled else "not settled yet: a majority of the electors is still being asked"
    goes_by = f"document {held.document[:12]}" if held.document else "no document: each node goes by its own file"
    electors = ", ".join(f"{name} (disk {disk[:8]})" if disk else name for name, disk in held.electors)
    lines = [f"{held.fleet}: revision {held.revision}, number {held.number}, {state}", goes_by, f"electors: {electors}"]
    if lacking := without_seat(held):
        lines.append(f"electors by the document only: {', '.join(lacking)}; once they run: {SEAT_ADVICE}")
    wide = max((len(one["name"]) for one in told), default=0)
    lines += [f"  {one['name']:{wide}}  {_said(held, one, told)}" for one in told]
    return "\n".join(lines) + "\n"


def _said(held: InForce, one: Json, told: list[Json]) -> str:
    if one["problem"] is not None:
        return f"unknown here: {held.node} {PASSES_ON}" if PASSES_ON in one["problem"] else "no answer"
    if one["revision"] is None:
        return "does not know the fleet's generation yet"
    if not held.document and not one["document"]:
        files = [other["fleet_file"] for other in told if other["fleet_file"] is not None]
        is_odd = one["fleet_file"] != max(sorted(files), key=files.count)
        return f"file {one['fleet_file']}{': another one than most nodes have' if is_odd else ''}"
    skew = "" if one["document"] == held.document else f": not {held.document[:12] or 'by its file'}, as {held.node}"
    return f"revision {one['revision']}, document {one['document'][:12] or 'none'}{skew}"


def export(asked: Asks, file: OutputOption = None) -> int:
    """Write the document as its operator wrote it, comments and all.

    Example: zsched fleet export > fleet.yaml
    """
    door = asked.door()
    held = in_force(door)
    text = document_text(held)
    if file is None:
        sys.stdout.buffer.write((harmless(text) if is_screen(sys.stdout) else text).encode())
        return EXIT_OK
    try:
        replace_regular(file, text.encode())
    except OSError as error:
        raise CliError(EXIT_FAILED, f"{file}: {error.strerror}; give a file that can be written") from error
    say(f"{file}: {held.fleet}, revision {held.revision}")
    return EXIT_OK


def edit_document(view: OrderView, env: Mapping[str, str] = os.environ) -> int:
    """Open the document in the operator's editor and apply what comes of it; the exit code.

    What was typed and is not agreed stays in a file, which is named; Ctrl-C is no exception.

    Raises:
        CliError: the editor failed, or as of `apply`.
        ConfigError: the text has faults.
    """
    drafts: dict[Path, str] = {}

    def make(held: InForce) -> str:
        text = document_text(held)
        path = _draft(held.fleet, text)
        drafts[path] = text
        _open_editor(path, env)
        return read_text(str(path))

    try:
        code = apply_change(view, make, "the edited document")
    except KeyboardInterrupt:
        if (path := _edited(drafts)) is not None:
            warn(f"\nbroken off; your text is in {path}: zsched apply {shlex.quote(str(path))}")
        raise
    except (CliError, ConfigError) as error:
        if (path := _edited(drafts)) is None:
            raise
        text = f"{error}\nyour text is in {path}: mend it there, then zsched apply {shlex.quote(str(path))}"
        raise _like(error, text) from error
    if code == EXIT_WOULD_CHANGE and (path := _edited(drafts)) is not None:
        warn(f"your text is in {path}; to have it agreed: zsched apply {shlex.quote(str(path))}")
        return code
    for path in drafts:
        path.unlink(missing_ok=True)
    return code


def _edited(drafts: Mapping[Path, str]) -> Path | None:
    """The draft that says something else than the document; one that does not is deleted."""
    for path, text in drafts.items():
        with contextlib.suppress(OSError):
            if path.read_bytes() != text.encode():
                return path
            path.unlink()
    return None


def _like(error: Any, text: str) -> CliError | ConfigError:
    return CliError(error.code, text) if isinstance(error, CliError) else ConfigError(text)


def _draft(fleet: str, text: str) -> Path:
    """A new file of the operator alone, with the text.

    Raises:
        CliError: there is no room for it.
    """
    name = ""
    try:
        number, name = tempfile.mkstemp(prefix=f"{fleet}-", suffix=".yaml")
        with os.fdopen(number, "wb") as draft:
            draft.write(text.encode())
    except OSError as error:
        place = name or str(error.filename or "")
        if name:
            Path(name).unlink(missing_ok=True)
        where = f"{Path(place).parent}: " if place else ""
        advice = "make room there, or name another folder: TMPDIR=FOLDER zsched edit"
        raise CliError(
            EXIT_FAILED, f"{where}the text for the editor cannot be written: {error.strerror}; {advice}"
        ) from error
    return Path(name)


def _open_editor(path: Path, env: Mapping[str, str]) -> None:
    editor = env.get("VISUAL") or env.get("EDITOR") or "vi"
    try:
        done = subprocess.run([*shlex.split(editor), str(path)], check=False)
    except (OSError, ValueError) as error:
        raise CliError(EXIT_FAILED, f"the editor {editor!r} cannot be started: {error}; set EDITOR") from error
    if done.returncode:
        raise CliError(EXIT_FAILED, f"the editor {editor!r} ended with {done.returncode}; nothing was changed")


def edit(said: Edits, pause_after: PauseAfterOption = None) -> int:
    """Open the fleet's document in your editor (VISUAL, EDITOR, else vi), and apply what comes of it.

    Example: zsched edit

    A text with faults, or one that is refused, stays in a file that the message names.
    """
    return edit_document(said.order("edit", pause_after=pause_after))


fleet = new_group(
    "fleet",
    "The document that all nodes of the fleet go by.",
    {"show": show, "export": export, "create": create, "recover": recover_fleet},
)
