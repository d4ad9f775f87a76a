"""The real daemon with one weak spot: on SIGUSR1 a C call holds Python's global lock for 3 s; zenoh's threads live on.

Takes the daemon's arguments.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys

from zsched.daemon import main

WEDGED_S = 3


def wedge(_number: int, _frame: object) -> None:
    ctypes.PyDLL(None).sleep(WEDGED_S)  # PyDLL, unlike CDLL, keeps the lock


if __name__ == "__main__":
    signal.signal(signal.SIGUSR1, wedge)
    code = main()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
