"""Who renews a fleet's certificates: what the timer needs for an authority, and what is said when one stays behind.

Knows: the place at which zsched-renew.service looks, what it cannot see, how its drop-in is written. Does not know: how
certificates are made (`zsched.pki`), which verb asks.
"""

from __future__ import annotations

import contextlib
import json
import os
import shlex
from pathlib import Path
from typing import Final

from zsched.config.load import check_bytes
from zsched.config.reader import MAX_FILE_BYTES
from zsched.host.files import read_regular
from zsched.host.paths import AUTHORITY_RECORD, authority_folder, has_authority

TIMER: Final = "zsched-renew.timer"
UNIT_FOLDER: Final = Path("/root/.local/share/zsched/authority")
"""Where the timer's unit looks for the folder of each fleet."""
SERVICE: Final = "zsched-renew.service"
UNSEEN: Final = ("/home", "/tmp", "/var/tmp")  # noqa: S108 - what that unit hides
HOLDS_AUTHORITY: Final = "holds-authority"
"""The danger: the machine holds the authority of a fleet that goes on without it."""
MAX_RECORD: Final = 4 << 20


def holds_authority(fleet: str, given: Path | None) -> Path | None:
    """The folder of a fleet's authority on this machine; ``None``: there is none."""
    folder = authority_folder(given, os.environ, fleet)
    return folder if has_authority(folder) else None


def authority_here(fleet: str, config: Path, text: str = "") -> Path | None:
    """The folder of the authority on this machine by which a fleet's certificates are renewed; ``None``: there is none.

    Args:
        fleet: its name.
        config: its fleet file here, which counts where there is no ``text``.
        text: its document.
    """
    try:
        folder = holds_authority(fleet, None)
    except PermissionError:  # who may not look into it renews nothing by it
        folder = None
    if folder is None or not _is_secured(text, config) or _named(folder) not in (fleet, None):
        return None
    return folder


def left_behind(folder: Path, fleet: str) -> str:
    """What follows where a machine with the authority goes, in words."""
    return (
        f"{folder} holds the authority of {fleet}: once {TIMER} renews nothing here, all certificates of {fleet} end "
        f"within 30 days, and its links with them. First move the folder to {UNIT_FOLDER / fleet} on another node, and "
        f"enable {TIMER} there"
    )


def bring_advice(folder: Path, fleet: str) -> str:
    """What is to be done with the authority of a fleet whose node this machine was."""
    return (
        f"move {folder} to {UNIT_FOLDER / fleet} on another node of {fleet}, there `sudo systemctl enable --now "
        f"{TIMER}`, here `sudo systemctl disable --now {TIMER}`: else the certificates of {fleet} end within 30 days"
    )


def renew_advice(folder: Path, fleet: str, *, is_locked: bool) -> str:
    """How the certificates of a new authority are renewed in time: by the timer, what its unit needs first, by hand."""
    folder = folder.absolute()
    words = ["zsched", "pki", "renew", "--deliver"]
    if folder != authority_folder(None, {}, fleet).absolute():
        words += ["--authority", str(folder)]
    first = _first(folder, fleet, is_locked=is_locked)
    return (
        f"certificates last 30 days: {f'{first}; then ' if first else ''}on the machine with the key `sudo systemctl "
        f"enable --now {TIMER}` lets them be renewed in time, else `{shlex.join(words)}` there"
    )


def _first(folder: Path, fleet: str, *, is_locked: bool) -> str:
    """What the timer's unit needs beside what it is shipped with; empty: nothing."""
    steps, lines = [], []
    if folder != UNIT_FOLDER / fleet and any(folder.is_relative_to(place) for place in UNSEEN):
        steps.append(f"move {folder} to {UNIT_FOLDER / fleet}, for {SERVICE} does not see it")
    elif folder != UNIT_FOLDER / fleet:
        lines += ["[Unit]", "ConditionPathExistsGlob=", f"ConditionPathExists={_literal(folder)}/{AUTHORITY_RECORD}"]
        lines += ["[Service]", f"Environment={_word(f'ZSCHED_AUTHORITY={folder}')}", f"ReadWritePaths={_word(folder)}"]
    if is_locked:
        steps.append("write the passphrase to /root/FILE, which only root may read")
        lines += [*([] if lines else ["[Service]"]), "LoadCredential=passphrase:/root/FILE"]
    if lines:
        steps.append(f"`sudo systemctl edit {SERVICE}` with the lines {' '.join(f'`{line}`' for line in lines)}")
    return ", then ".join(steps)


def _literal(text: object) -> str:
    """As a unit writes it without a specifier of systemd's (systemd.unit(5))."""
    return str(text).replace("%", "%%")


def _word(text: object) -> str:
    """The same as one word (systemd.syntax(7))."""
    literal = _literal(text)
    if shlex.quote(literal.replace("%", "")) == literal.replace("%", ""):
        return literal
    return '"{}"'.format(literal.replace("\\", "\\\\").replace('"', '\\"'))


def _is_secured(text: str, config: Path) -> bool:
    """Whether the fleet has certificates; one that cannot be read may have some."""
    content = text.encode()
    with contextlib.suppress(OSError):
        content = content or read_regular(config, MAX_FILE_BYTES)
    fleet = check_bytes(content).fleet
    return fleet is None or fleet.security is not None


def _named(folder: Path) -> str | None:
    """Whose authority it is; ``None``: its record cannot be read."""
    try:
        record = json.loads(read_regular(folder / AUTHORITY_RECORD, MAX_RECORD))
    except (OSError, ValueError):
        return None
    return str(record["fleet"]) if isinstance(record, dict) and "fleet" in record else None
