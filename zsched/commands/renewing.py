"""Who renews a fleet's certificates: where its authority's folder is looked for, and what is said when it stays behind.

Knows: the place at which zsched-renew.service looks. Does not know: how certificates are made (`zsched.pki`), which
verb asks.
"""

from __future__ import annotations

import contextlib
import json
from pathlib import Path
from typing import Final

from zsched.commands.pki import holds_authority
from zsched.config.load import check_bytes
from zsched.config.reader import MAX_FILE_BYTES
from zsched.files import read_regular
from zsched.paths import AUTHORITY_RECORD

TIMER: Final = "zsched-renew.timer"
UNIT_FOLDER: Final = Path("/root/.local/share/zsched/authority")
"""Where the timer's unit looks for the folder of each fleet."""
HOLDS_AUTHORITY: Final = "holds-authority"
"""The danger: the machine holds the authority of a fleet that goes on without it."""
MAX_RECORD: Final = 4 << 20


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
