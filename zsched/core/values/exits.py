"""The exit codes of every program here: zsched's verbs, its daemon, the reference tasks, the lab.

Knows: numbers. Does not know: which program ends with which. Only `zsched.host.workers.launch` says its 78 itself:
it is run by path and imports nothing of zsched.
"""

from __future__ import annotations

from typing import Final

EXIT_OK: Final = 0
EXIT_FAILED: Final = 1
EXIT_USAGE: Final = 2
EXIT_UNREACHABLE: Final = 3
"""No daemon answers."""
EXIT_DEGRADED: Final = 4
"""It answers, and the fleet has no quorum, or a task no live owner."""
EXIT_TIMED_OUT: Final = 5
EXIT_WOULD_CHANGE: Final = 10
"""A plan was asked for, and by it something would change."""
EXIT_NAME_TAKEN: Final = 75
"""EX_TEMPFAIL of sysexits.h: another machine has this name; trying again may help."""
EXIT_CONFIG: Final = 78
"""EX_CONFIG: the fleet file or the environment is wrong; trying again does not help (systemd does not, either)."""
EXIT_LEFT: Final = 79
"""`zsched leave` has ended the daemon: this machine is in no fleet any more, and no service starts it again."""
EXIT_SIGNAL: Final = 128
"""Plus the signal's number, as a shell counts."""
EXIT_INTERRUPTED: Final = 130
"""The one of Ctrl-C."""
