"""A program with a session of zenoh ends."""

from __future__ import annotations

import subprocess
import sys

import pytest


@pytest.mark.parametrize(
    ("last", "code"),
    [("return 5", 5), ("raise Panic('no reactor')", 1), ("raise SystemExit(78)", 78), ("raise SystemExit", 0)],
)
def test_a_program_ends_with_its_code_whatever_it_raises(last: str, code: int) -> None:
    """What zenoh raises when it panics is no `Exception`, and its threads hold an interpreter that ends by itself."""
    program = f"""
import zenoh
from zsched.host.guard import end_with
class Panic(BaseException): ...
def main():
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    global session, kept
    session = zenoh.open(config)
    kept = session.declare_subscriber("a", lambda sample: None)
    {last}
end_with(main)
"""
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=30, check=False)
    assert ended.returncode == code
    assert ("Panic: no reactor" in ended.stderr) is ("Panic" in last)
