"""How long a process waits for its zenoh session to close: a stopped peer can hold that for seconds.

Knows: times, and why they differ. Does not know: sessions.
"""

from __future__ import annotations

from typing import Final

CLOSE_S: Final = 0.6
"""Of the daemon's own processes (relay, worker, driver), which leave by ``os._exit``: then the process ends."""
ALARM_S: Final = 0.9
"""...and should zenoh hold Python's global lock meanwhile, the kernel ends a process that was told to stop."""
