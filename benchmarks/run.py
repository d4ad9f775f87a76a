"""All benchmarks, one after the other: ``python -m benchmarks.run`` (about 15 minutes on a quiet machine)."""

from __future__ import annotations

import subprocess
import sys

MODULES = ("status", "idle", "commit", "failover", "streams", "handover", "map_merge")


def main() -> None:
    """Run each in a process of its own."""
    for name in MODULES:
        print(f"\n== python -m benchmarks.{name}", flush=True)
        subprocess.run([sys.executable, "-m", f"benchmarks.{name}"], check=False)


if __name__ == "__main__":
    main()
