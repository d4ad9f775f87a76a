"""A member of a secured fleet floods its daemons: nothing changes, nobody is taken for dead, and it is counted."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from support.authorities import secured
from support.ballots import ballot_of
from support.beats import beat_of
from support.proposals import proposal_of
from zsched.core.values import codec as wire
from zsched.core.values.messages import Prepare
from zsched.link.keyspace import Keyspace
from zsched.link.sessions.access_rules import Side
from zsched_lab.fleet.secured import without_rules
from zsched_lab.fleet.testbed import TASK, Testbed, echo_fleet

IDLE = "robot3"
"""In the file, and not started: who floods has its certificate."""
COUNT = 10_000
KEYS = Keyspace("testbed")


@pytest.mark.long
def test_ten_thousand_frames_of_each_kind_change_nothing(tmp_path: Path) -> None:
    tree = secured(echo_fleet(robots=3, edges=1), tmp_path)
    beat = wire.encode(beat_of(IDLE))
    proposal = wire.encode(proposal_of(IDLE, task=TASK, base_revision=1))
    prepare = Prepare(task=TASK, ballot=ballot_of(10**6, IDLE), electorate="e")
    floods = (
        ("frames", KEYS.beat(IDLE), beat, COUNT),
        ("frames", KEYS.proposal(IDLE), proposal, COUNT),
        ("frames", KEYS.profile(IDLE), b"\xc1" * 64, COUNT),
        ("questions", KEYS.register("*", IDLE), wire.encode(prepare), COUNT // 10),
    )
    with Testbed(tmp_path, tree) as bed:
        bed.init()
        bed.start("robot1", "robot2", "edge1")
        bed.wait_settled()
        before = {key: bed.task("robot1")[key] for key in ("owner", "epoch", "revision")}
        config = without_rules(bed, IDLE, Side.CONTROL)
        for kind, key, payload, count in floods:
            command = [sys.executable, "-m", "zsched_lab.fleet.floods", kind, "--config", config, "--key", key]
            command += ["--payload", payload.hex(), "--count", str(count)]
            done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False, input="")
            assert done.stdout.startswith(f"sent={count} "), done.stderr

        wanted = {"dropped_beat_rate", "dropped_proposal_rate", "dropped_profile_garbage", "dropped_register_rate"}
        bed.wait(lambda: wanted <= set(bed.status("robot1")["counters"]), 60, "every flood in the counters")
        assert {key: bed.task("robot1")[key] for key in before} == before
        mine = (f"{node} alive ->" for node in bed.running())
        told = [one for one in mine for node in bed.running() if one in bed.log(node)]
        assert told == [], "nobody who lives is taken for suspect or gone"
