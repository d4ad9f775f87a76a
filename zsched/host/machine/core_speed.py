"""Times one core of this machine by three small kernels, once, and keeps the figure in the state folder.

Speed 1 is a core that does all three in `REFERENCE_S`. What is timed is the thread's own CPU time, the best of a few
tries: others on the machine, and a quota, make it later but not slower. The kernels are integer work, sorting and
compression, in C: a task's own ratio between two machines differs, and is learnt of no figure but its own.

Knows: kernels, a file, which processor it was. Does not know: what a speed is for.
"""

from __future__ import annotations

import hashlib
import json
import math
import zlib
from collections.abc import Callable
from pathlib import Path
from random import Random
from time import thread_time
from typing import Final

from zsched.core.values.profile import MAX_SPEED, MIN_SPEED
from zsched.host.files import put_whole, read_regular

NAME: Final = "speed.json"
SCHEMA: Final = "zsched.speed/1"
TRIES: Final = 5
REFERENCE_S: Final = {"hash": 0.00076, "sort": 0.00063, "pack": 0.00134}
"""CPU seconds of each kernel on a core of speed 1: one of an AMD EPYC server, in a virtual machine."""
MAX_BYTES: Final = 4096
READABLE: Final = 0o644
"""Root writes it, the service reads it."""
PROCESSOR_FIELDS: Final = ("model name", "Model", "Hardware", "CPU part")
"""Of /proc/cpuinfo, on x86 and ARM."""


def kernels() -> dict[str, Callable[[], object]]:
    """{name: one small piece of work}, the same bytes everywhere."""
    rng = Random(1)
    raw = rng.randbytes(1 << 20)
    numbers = [rng.random() for _ in range(8_000)]
    words = b" ".join(rng.choice((b"edge", b"robot", b"map", b"scan", b"merge")) for _ in range(14_000))
    return {
        "hash": lambda: hashlib.blake2b(raw).digest(),
        "sort": lambda: sorted(numbers),
        "pack": lambda: zlib.compress(words, 6),
    }


def measure() -> float:
    """Speed of the core that this thread runs on; about 20 ms of CPU."""
    ratios = []
    for name, work in kernels().items():
        took_s = []
        for _ in range(TRIES):
            began_s = thread_time()
            work()
            took_s.append(thread_time() - began_s)
        ratios.append(REFERENCE_S[name] / max(min(took_s), 1e-9))
    return min(max(math.prod(ratios) ** (1.0 / len(ratios)), MIN_SPEED), MAX_SPEED)


def keep(folder: Path) -> float:
    """Measure, and write the figure into ``folder``. Raises `OSError`."""
    speed = round(measure(), 3)
    text = json.dumps({"schema": SCHEMA, "speed": speed, "processor": processor()})
    # root writes into the service's folder: under a name that nobody can have laid a link at before
    put_whole(folder / NAME, f"{text}\n".encode(), READABLE, lambda _descriptor: None)
    return speed


def kept(folder: Path) -> float | None:
    """The figure that `keep` wrote on a processor like this one; ``None`` when there is none that can be used."""
    try:
        found = json.loads(read_regular(folder / NAME, MAX_BYTES))
        speed = float(found["speed"])
        is_ours = found["schema"] == SCHEMA and found["processor"] == processor()
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return speed if is_ours and MIN_SPEED <= speed <= MAX_SPEED else None


def kept_or_new(folder: Path) -> float:
    """The figure of ``folder``, or a new one; a folder that cannot be written costs a measurement at every start."""
    speed = kept(folder)
    if speed is not None:
        return speed
    try:
        return keep(folder)
    except OSError:
        return round(measure(), 3)


def processor(cpuinfo: Path = Path("/proc/cpuinfo")) -> str:
    """What the kernel calls this processor; empty when it says nothing."""
    try:
        lines = cpuinfo.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return ""
    fields = dict(line.partition(":")[::2] for line in reversed(lines) if ":" in line)
    named = {name.strip(): value.strip() for name, value in fields.items()}
    return next((named[name] for name in PROCESSOR_FIELDS if named.get(name)), "")
