"""A way that carries beats, acknowledgements and small samples, and no large ones: a path whose MTU nobody knows."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

import pytest

from zsched_lab.fleet import netns
from zsched_lab.fleet.netbed import Netbed
from zsched_lab.fleet.testbed import echo_fleet

pytestmark = pytest.mark.root

MOST = 1280
LEFT_S = 5.0
SLACK_S = 5.0
"""A busy machine's."""
VERB_S = 90.0
LARGE = ["data 64 KiB", "data 1 MiB"]


def said(bed: Netbed, *words: str) -> str:
    """What a verb says on robot1."""
    options = ("--node", "robot1", "--runtime-dir", str(bed.folder), "--config", str(bed.file))
    command = bed.network.wrap("robot1", [sys.executable, "-m", "zsched.cli", *words, *options])
    done = subprocess.run(command, capture_output=True, text=True, timeout=VERB_S, check=False)
    return done.stdout + done.stderr


def test_an_owner_that_gets_small_samples_only_is_a_problem_and_is_left(tmp_path: Path) -> None:
    reason = netns.why_not()
    if reason is not None:
        pytest.skip(f"no network namespaces here: {reason}")
    tree = echo_fleet(robots=1, edges=2, timing="wired", scheduling={"price_s": 1000})
    with Netbed(tmp_path, tree) as bed:
        bed.init()
        bed.start()
        owner = bed.wait_settled()
        probe = bed.probe("robot1", put="robot1/in", watch=["robot1/out"], hz=12, size=4000)
        bed.wait(lambda: len(probe.received) > 60, 60, "echoes")
        bed.network.keep_out_large(owner, MOST)
        began = time.monotonic()
        other = bed.wait(lambda: (now := bed.owner()) != owner and now, 60, "another owner")
        assert time.monotonic() - began < LEFT_S + SLACK_S
        assert bed.task("robot1")["history"][-1]["reason"].endswith("is reached by 0 of 1 robots")
        bed.wait(probe.is_flowing, 60, "echoes of the next owner")
        told = said(bed, "ping", owner, "-c", "1")
        assert f"data 64 KiB tcp/{bed.network.address(owner)}" in told
        assert [line.split("tcp/")[0].strip() for line in told.splitlines() if "does not answer" in line] == LARGE, told
        assert f"{owner}'s data session" in said(bed, "doctor", "--fleet")
        bed.network.keep_out_large(str(other), MOST)
        told = "has had inputs of this robot and answered none of them"
        bed.wait(lambda: any(told in one for one in bed.task("robot1")["problems"]), 60, "status to say so")
