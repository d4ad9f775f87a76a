"""What the steps of `prove.py` have in common: a command that must succeed, and how a step ends otherwise."""

from __future__ import annotations

import subprocess
from typing import Any

PROVE_S = 900.0


class SkippedError(Exception):
    """A step cannot be tried here; says why."""


class FailedError(Exception):
    """Something is not as it was promised."""


def run(*command: str, timeout_s: float = PROVE_S, **options: Any) -> str:
    """What a command prints. Raises `FailedError`."""
    done: subprocess.CompletedProcess[str] = subprocess.run(
        command, capture_output=True, text=True, timeout=timeout_s, check=False, **options
    )
    if done.returncode != 0:
        raise FailedError(
            f"{' '.join(command)[:200]}: ended with {done.returncode}:\n{(done.stdout + done.stderr)[-3000:]}"
        )
    return done.stdout
