"""What this machine goes by: its own node's name, and a fleet file that can be read.

Knows: where the words come from, what to say of a wrong one. Does not know: what is in the file, any verb.
"""

from __future__ import annotations

import os
from pathlib import Path

from zsched.commands.base.common import BECOME_A_NODE, CliError, check_name
from zsched.config.reader import MAX_FILE_BYTES
from zsched.core.values.exits import EXIT_CONFIG
from zsched.host import paths as places
from zsched.host.files import owner_of, read_regular


def own_name(given: str | None) -> str:
    """This node's name. Raises `CliError` (2) when it is no name."""
    name = places.node_name(given, os.environ)
    where = "--node" if given else "ZSCHED_NODE" if os.environ.get("ZSCHED_NODE") else "the host name"
    check_name(name, where, "give the fleet file's with --node")
    return name


def need_file(file: Path) -> None:
    """Raise `CliError` (78) unless the fleet file can be read."""
    try:
        read_regular(file, MAX_FILE_BYTES)
    except OSError as error:
        other = f"name it with --config, or {BECOME_A_NODE}"
        advice = owner_of(file) if isinstance(error, PermissionError) else other
        raise CliError(EXIT_CONFIG, f"{file}: cannot be read: {error.strerror}; {advice}") from error
