"""`zsched bugreport`: one file with what somebody needs who looks for a fault from afar, secrets taken out.

Knows: what goes into it, tar, the journal. Does not know: what is wrong.
"""

from __future__ import annotations

import io
import json
import os
import platform
import subprocess
import tarfile
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Final

import typer

from zsched.commands.base.common import CliError, Json, harmless_json, print_json, say
from zsched.commands.base.options import JsonOption, Machine
from zsched.commands.base.page import size
from zsched.commands.base.versions import versions
from zsched.config.reader import MAX_FILE_BYTES
from zsched.core.values.exits import EXIT_FAILED, EXIT_OK
from zsched.core.values.struct import Struct, replace
from zsched.host.clock import wall_ns
from zsched.host.decision_log import FILE_BYTES, NAME, NAMES
from zsched.host.files import read_regular
from zsched.host.screen import harmless
from zsched.tools.doctor.look import look
from zsched.tools.doctor.model import Result, Scene
from zsched.tools.doctor.table import run_all
from zsched.tools.doctor.verb import as_json, as_text
from zsched.tools.redaction import clean, clean_json, clean_yaml, secrets_of

SCHEMA: Final = "zsched.bugreport/1"
UNIT: Final = "zsched"
RELAY_UNIT: Final = "zsched-relay.service"
JOURNAL_MINUTES: Final = 10
JOURNAL_LINES: Final = 20_000
JOURNAL_S: Final = 20.0
TEXT_WIDTH: Final = 120

Journal = Callable[[], str]


class Member(Struct, frozen=True, kw_only=True):
    """One file of the report; ``missing``: why it is not there."""

    name: str
    content: bytes = b""
    missing: str = ""


def bugreport(
    here: Machine,
    file: Annotated[
        Path | None, typer.Argument(metavar="[FILE]", help="A new file. [zsched-bugreport-NODE-TIME.tar.gz]")
    ] = None,
    json_: JsonOption = False,
) -> int:
    """Write one file for the person who looks for a fault: every node's status, the doctor's words, the journal.

    Example: sudo zsched bugreport

    Secrets that a name gives away are taken out. It prints what is in the file.
    """
    now = datetime.fromtimestamp(wall_ns() / 1e9, UTC)
    scene = look(here.machine(), is_fleet=True)
    path = file or Path(f"zsched-bugreport-{scene.node}-{now:%Y%m%d-%H%M%S}.tar.gz")
    members = tuple(gathered(scene))
    _write(path, packed(members, path.name.removesuffix(".gz").removesuffix(".tar"), now))
    if json_:
        print_json(_as_json(path, members))
    else:
        for line in _lines(path, members):
            say(line, indent=4)
    return EXIT_OK


def gathered(scene: Scene, journal: Journal | None = None) -> Iterator[Member]:
    """Every file of the report, secrets taken out."""
    secrets = (*secrets_of(scene.reading.fleet), *secrets_of(scene.known))
    machine = {"system": platform.platform(), "machine": platform.machine(), "node": scene.node}
    yield _json("versions.json", {**versions(), **machine})
    try:
        text = read_regular(scene.file, MAX_FILE_BYTES).decode("utf-8", errors="replace")
        yield Member(name="fleet.yaml", content=harmless(clean_yaml(text, secrets)).encode())
    except OSError as error:
        yield Member(name="fleet.yaml", missing=f"{scene.file}: {error.strerror}")
    if scene.text:
        yield Member(name="document.yaml", content=harmless(clean_yaml(scene.text, secrets)).encode())
    results = [(check, _cleaned(result, secrets)) for check, result in run_all(scene)]  # before lines are broken
    yield Member(name="doctor.txt", content=as_text(results, TEXT_WIDTH, is_colored=False).encode())
    yield _json("doctor.json", as_json(scene, results))
    statuses = dict(scene.statuses) or ({} if scene.own is None else {scene.node: scene.own})
    nodes = () if scene.known is None else scene.known.nodes
    for name in sorted({*statuses, *(spec.name for spec in nodes)}):
        if name in statuses:
            yield _json(f"status/{name}.json", clean_json(statuses[name], secrets))
        else:
            yield Member(name=f"status/{name}.json", missing=f"{name} does not answer")
    yield from _decision_logs(scene.state_folder, secrets)
    try:
        yield Member(name="journal.txt", content=harmless(clean((journal or _journal)(), secrets)).encode())
    except OSError as error:
        yield Member(name="journal.txt", missing=str(error.strerror or error))


def _decision_logs(folder: Path, secrets: tuple[str, ...]) -> Iterator[Member]:
    """This machine's decision log, for `zsched explain --replay`; an older file is there once one was full."""
    for name in NAMES:
        try:
            text = read_regular(folder / name, 2 * FILE_BYTES, is_own=True).decode("utf-8", errors="replace")
        except FileNotFoundError as error:
            if name == NAME:
                yield Member(name=name, missing=f"{folder / name}: {error.strerror}")
        except OSError as error:
            yield Member(name=name, missing=f"{folder / name}: {error.strerror}")
        else:
            yield Member(name=name, content=harmless_json(clean(text, secrets)).encode())


def _cleaned(result: Result, secrets: tuple[str, ...]) -> Result:
    evidence = tuple(clean(line, secrets) for line in result.evidence)
    return replace(result, evidence=evidence, fix=clean(result.fix, secrets))


def _json(name: str, body: Json) -> Member:
    return Member(name=name, content=f"{harmless_json(json.dumps(body, ensure_ascii=False, indent=1))}\n".encode())


def _journal() -> str:
    """What the unit has written in the last minutes. Raises `OSError`: it cannot be read."""
    units = ("--unit", UNIT, "--unit", RELAY_UNIT)
    words = ["journalctl", *units, "--since", f"-{JOURNAL_MINUTES}min", "--lines", str(JOURNAL_LINES)]
    try:
        done = subprocess.run(
            [*words, "--no-pager", "--quiet", "--output", "short-iso-precise"],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=JOURNAL_S,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise OSError(f"journalctl took more than {JOURNAL_S:g} s") from error
    if done.returncode or not done.stdout:
        told = done.stderr.decode(errors="replace").strip() or f"the unit {UNIT} wrote nothing that this user may read"
        raise OSError(told.splitlines()[0])
    return done.stdout.decode(errors="replace")


def packed(members: tuple[Member, ...], folder: str, now: datetime) -> bytes:
    """The files that are there as a packed archive, below ``folder``."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as archive:
        for member in members:
            if not member.missing:
                info = tarfile.TarInfo(f"{folder}/{member.name}")
                info.size, info.mode, info.mtime = len(member.content), 0o600, int(now.timestamp())
                archive.addfile(info, io.BytesIO(member.content))
    return buffer.getvalue()


def _write(path: Path, content: bytes) -> None:
    """A new file that only its user may read."""
    try:
        fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600)
    except FileExistsError as error:
        raise CliError(EXIT_FAILED, f"{path} is there already; give another name") from error
    except OSError as error:
        raise CliError(EXIT_FAILED, f"{path} cannot be written: {error.strerror}; give another FILE") from error
    try:
        with os.fdopen(fd, "wb") as file:
            file.write(content)
    except OSError as error:
        path.unlink(missing_ok=True)
        raise CliError(EXIT_FAILED, f"{path} cannot be written: {error.strerror}; give another FILE") from error


def _as_json(path: Path, members: tuple[Member, ...]) -> Json:
    there = {member.name: len(member.content) for member in members if not member.missing}
    missing = {member.name: member.missing for member in members if member.missing}
    return {"schema": SCHEMA, "file": str(path), "members": there, "missing": missing}


def _lines(path: Path, members: tuple[Member, ...]) -> Iterator[str]:
    for member in members:
        yield f"{member.name:<28} {f'not there: {member.missing}' if member.missing else size(len(member.content))}"
    yield f"{path}: secrets that a name gives away are taken out; read it before you hand it on"
