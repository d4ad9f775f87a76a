"""Takes as many file descriptors as the daemon may have.

Knows: the process's limits. Does not know: their users.

The usual limit is 1024, for programs that call select(2); strangers' connections take as many in seconds.
"""

from __future__ import annotations

import contextlib
import resource
from typing import Final

WANTED: Final = 65_536
"""As the unit's ``LimitNOFILE=``."""


def take_descriptors() -> None:
    """Raise the soft limit to the hard one, or to `WANTED`; what may not be raised stays."""
    with contextlib.suppress(OSError, ValueError):
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        most = WANTED if hard == resource.RLIM_INFINITY else min(hard, WANTED)
        if soft != resource.RLIM_INFINITY and soft < most:
            resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))
