"""A long cable for network namespaces: every frame arrives later, in order, both ways.

``python -m zsched_lab.fleet.delay_line SECONDS OUTER OUTER_IF INNER INNER_IF``: makes a TAP interface in each of two
named namespaces and copies frames between them until its standard input ends; says ``ready`` once both are there.

For kernels without ``netem``. It copies some thousand frames a second; what it cannot take the kernel drops.

Knows: TAP devices, times. Does not know: addresses, bridges, what is sent.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import os
import queue
import struct
import sys
import threading
import time
from typing import Final

from zsched.host.guard import guarded

TUNSETIFF: Final = 0x400454CA
IFF_TAP, IFF_NO_PI = 0x0002, 0x1000
FRAME: Final = 65_536
QUEUED: Final = 20_000
"""Frames under way in one direction."""


def open_tap(namespace: str, interface: str) -> int:
    """A TAP interface in a named namespace; its descriptor.

    Raises:
        OSError: there is no such namespace, or the interface cannot be made.
    """
    home = os.open("/proc/self/ns/net", os.O_RDONLY)
    there = os.open(f"/run/netns/{namespace}", os.O_RDONLY)
    try:
        _enter(there)
        try:
            tap = os.open("/dev/net/tun", os.O_RDWR)
            fcntl.ioctl(tap, TUNSETIFF, struct.pack("16sH22x", interface.encode(), IFF_TAP | IFF_NO_PI))
            return tap
        finally:
            _enter(home)
    finally:
        os.close(there)
        os.close(home)


def _enter(namespace: int) -> None:
    """This thread's network from now on (`os.setns` needs Python 3.12)."""
    library = ctypes.CDLL(None, use_errno=True)
    if library.setns(namespace, 0) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def copy(source: int, target: int, delay_s: float) -> None:
    """Copy frames until the source is closed, each ``delay_s`` after it came."""
    under_way: queue.Queue[tuple[float, bytes]] = queue.Queue(QUEUED)

    def deliver() -> None:
        pause = threading.Event()
        while True:
            due, frame = under_way.get()
            left_s = due - time.monotonic()
            if left_s > 0:
                pause.wait(left_s)
            with contextlib.suppress(OSError):  # the other end is down: the frame is lost
                os.write(target, frame)

    guarded(deliver, name="delay-line").start()
    while True:
        try:
            frame = os.read(source, FRAME)
        except OSError:  # the interface is down, or gone
            time.sleep(0.01)
            continue
        with contextlib.suppress(queue.Full):
            under_way.put_nowait((time.monotonic() + delay_s, frame))


def main() -> int:
    """Until standard input ends."""
    delay_s, outer, outer_if, inner, inner_if = float(sys.argv[1]), *sys.argv[2:6]
    ends = open_tap(outer, outer_if), open_tap(inner, inner_if)
    for source, target in (ends, ends[::-1]):
        guarded(copy, source, target, delay_s, name="delay-line").start()
    print("ready", flush=True)
    sys.stdin.read()
    return 0


if __name__ == "__main__":
    sys.exit(main())
