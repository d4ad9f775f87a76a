"""Runs pytest; when a few tests fail, runs those once more, alone, and names those that passed then as FLAKY.

``python .ci/repeat.py PYTEST_ARGUMENTS...``. Only `.ci/run` uses it, for tests with real processes: one busy second of
a shared machine must not cost a whole submission. A flaky test is a fault to mend, so it is printed last. More than
`FEW` failures, or a run that ended otherwise (collection, a crash of pytest), are what they are.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

FEW = 12
"""A fleet that a whole module shares fails with all of its tests."""
TESTS_FAILED = 1
"""pytest's exit code when tests were run and some failed."""
LIMIT_S = 3600
FAILED = Path(".pytest_cache/v/cache/lastfailed")


def run(arguments: list[str]) -> int:
    """Pytest's exit code."""
    return subprocess.run([sys.executable, "-m", "pytest", *arguments], check=False, timeout=LIMIT_S).returncode


def passes(name: str) -> bool:
    """Whether a test passes alone; one that is skipped then does not."""
    words = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", name]
    done = subprocess.run(words, check=False, timeout=LIMIT_S, stdout=subprocess.PIPE, text=True)
    print(done.stdout, end="", flush=True)
    return done.returncode == 0 and " passed" in done.stdout


def failed() -> list[str]:
    """Node ids of what failed in the last run."""
    return sorted(json.loads(FAILED.read_text(encoding="utf-8"))) if FAILED.exists() else []


def main(arguments: list[str]) -> int:
    """The exit code of the first run, or 0 when everything that failed in it passes alone."""
    FAILED.unlink(missing_ok=True)
    code = run(arguments)
    names = failed()
    if code != TESTS_FAILED or not 0 < len(names) <= FEW:
        return code
    print(f"repeat: {len(names)} failed; once more, alone", flush=True)
    left = [name for name in names if not passes(name)]
    for name in names:
        print(f"{'FAILED twice' if name in left else 'FLAKY'}: {name}", flush=True)
    return TESTS_FAILED if left else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
