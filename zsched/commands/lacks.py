"""Looks at other machines again and again until nothing is missing there, and says what is where that takes long.

Knows: times, sessions that may have grown old. Does not know: what is looked for.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Final

from zsched.clock import monotonic_s
from zsched.commands.ask import close_sessions
from zsched.commands.common import CliError
from zsched.errors import AdapterError, ConfigError

PAUSE_S: Final = 0.2
LONG_S: Final = 3.0
"""After this time the operator is told what is missing."""


class UselessError(CliError):
    """Waiting does not help."""


def wait_for(
    look: Callable[[], str],
    for_s: float,
    tell: Callable[[str, float], None] | None = None,
    *,
    is_told_once: bool = False,
) -> str:
    """Look until nothing is missing, for ``for_s`` seconds at most; what is missing still.

    An error of a look counts as missing, too, and the next look opens its sessions anew. ``tell(lack, left_s)`` is
    called with what is missing, and again when that is something else, unless ``is_told_once``.

    Raises:
        UselessError: a look has raised it.
    """
    began, told = monotonic_s(), ""
    until = began + for_s
    while True:
        try:
            lack = look()
        except UselessError:
            raise
        except (CliError, AdapterError, ConfigError) as error:
            lack = str(error)
            close_sessions()
        now = monotonic_s()
        if not lack or now > until:
            return lack
        if tell is not None and now >= began + LONG_S and lack != told and not (told and is_told_once):
            told = lack
            tell(lack, until - now)
        time.sleep(PAUSE_S)
