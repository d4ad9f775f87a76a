"""What a value costs as a struct and as a dataclass, and how long the programs take to load, in one run.

``python -m benchmarks.structs [--n 20]``: making a class of six fields, making a value, comparing, hashing and
replacing (microseconds, one measurement each turn); then the processor time of importing daemon, relay, worker
and command line, and the dataclasses that are left in them.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import subprocess
import sys
import timeit
from collections.abc import Callable
from typing import Any

import msgspec

from benchmarks.common import line, machine
from zsched.core.values.struct import replace

NAMES = tuple("abcdef")
PROGRAMS = ("zsched.daemon", "zsched.relay.__main__", "zsched.worker", "zsched.cli")
LOAD = r"""
import json, re, resource, sys
import dataclasses
made, plain = 0, dataclasses._process_class
def counted(*args, **given):
    global made
    made += 1
    return plain(*args, **given)
dataclasses._process_class = counted
before = resource.getrusage(resource.RUSAGE_SELF)
__import__(sys.argv[1])
after = resource.getrusage(resource.RUSAGE_SELF)
rss_mib = int(re.search(r"VmRSS:\s+(\d+)", open("/proc/self/status").read())[1]) / 1024
print(json.dumps([after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, rss_mib, made]))
"""


def dataclass_of_six() -> Any:
    """A frozen dataclass with slots, as the values were."""
    plain = type("Plain", (), {"__doc__": "Six.", "__annotations__": dict.fromkeys(NAMES, int), "__module__": __name__})
    return dataclasses.dataclass(frozen=True, slots=True, kw_only=True)(plain)


def struct_of_six() -> Any:
    """A frozen struct, as they are."""
    return msgspec.defstruct("Struct", [(name, int) for name in NAMES], frozen=True, kw_only=True)


def each_us(call: Callable[[], object], n: int) -> float:
    """Microseconds of one call, of ``n`` in a row."""
    return timeit.timeit(call, number=n) / n * 1e6


def main() -> None:
    """Print the distributions, measured in turns."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--n", type=int, default=20)
    arguments = parser.parse_args()
    print(machine())
    values: dict[str, list[float]] = {}
    for _ in range(arguments.n):
        for word, make in (("dataclass", dataclass_of_six), ("struct", struct_of_six)):
            kind, given = make(), dict.fromkeys(NAMES, 1)
            one, other = kind(**given), kind(**given)
            calls: dict[str, tuple[Callable[[], object], int]] = {
                "make a class": (make, 5),
                "make a value": (lambda kind=kind, given=given: kind(**given), 2000),  # type: ignore[misc] # bound now
                "compare": (lambda one=one, other=other: one == other, 2000),  # type: ignore[misc] # likewise
                "hash": (lambda one=one: hash(one), 2000),  # type: ignore[misc] # likewise
                "replace": (lambda one=one: replace(one, a=2), 2000),  # type: ignore[misc] # likewise
            }
            for name, (call, count) in calls.items():
                values.setdefault(f"{name}: {word}", []).append(each_us(call, count))
    for name in sorted(values):
        print(line(name, values[name], "us", "-"))
    loads: dict[str, list[list[float]]] = {program: [] for program in PROGRAMS}
    for _ in range(arguments.n):
        for program in PROGRAMS:
            told = subprocess.run(
                [sys.executable, "-c", LOAD, program], capture_output=True, text=True, timeout=60, check=True
            )
            loads[program].append(json.loads(told.stdout))
    for program, found in loads.items():
        print(line(f"load {program}", [one[0] * 1000 for one in found], "ms", "-"))
        print(f"    {found[0][2]:.0f} dataclasses, at most {max(one[1] for one in found):.1f} MiB resident")


if __name__ == "__main__":
    main()
