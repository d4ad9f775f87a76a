"""The step `drain` of `zsched rehearse` on real daemons: judged as a move, and undrained whatever happens."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from support.operators import Operator, Stream
from support.sessions import matches
from zsched_lab.fleet.testbed import TASK, Testbed, echo_fleet

pytestmark = pytest.mark.long

WITHIN_S = 180.0


def rehearse(bed: Testbed, *words: str) -> subprocess.Popen[bytes]:
    command = (sys.executable, "-m", "zsched.cli", "rehearse", TASK, "--node", "robot1", "--runtime-dir", bed.folder)
    more = ("--steps", "drain", "--pause", "11", "--yes", "--json", *words)
    return subprocess.Popen([*command, *more], stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def drained(bed: Testbed) -> list[str]:
    """The nodes that are drained as robot1 knows."""
    return [node["name"] for node in bed.status("robot1")["nodes"] if node["flags"]]


def test_an_owner_is_drained_and_undrained_and_by_ctrl_c_too(tmp_path: Path) -> None:
    tree = echo_fleet(robots=1, edges=2, stream_class="reliable")
    tree["tasks"][TASK]["outputs"][0]["handover"] = "all"
    with Testbed(tmp_path, tree) as bed:
        bed.init()
        bed.start()
        bed.wait_whole()
        operator, stream = Operator(bed), Stream(bed.app("robot1"))
        agreed = tmp_path / "agreed.yaml"
        agreed.write_text(json.dumps(tree))
        operator.done("apply", agreed, "--yes")
        bed.wait(lambda: matches(stream.publisher), 60, "the relay subscribes")
        stream.start()
        bed.wait(lambda: len(stream.back) > 20, 60, "the stream flows")

        owner = bed.wait_settled()
        with rehearse(bed, "-m", "new fan") as played:
            bed.wait(lambda: drained(bed) == [owner], WITHIN_S, f"{owner} is drained")
            bed.wait(lambda: played.poll() is not None, WITHIN_S, "the rehearsal is over")
            assert played.stdout is not None
            assert played.stderr is not None
            said, told = played.stdout.read(), played.stderr.read().decode()
        body = json.loads(said)["rehearsal"]
        assert (played.returncode, body["why"]) == (0, "every step is done"), told
        (step,) = body["steps_done"]
        assert (step["step"], step["node"], step["lost"], step["doubled"]) == ("drain", owner, 0, 0)
        assert step["taker"] not in (None, owner)
        assert step["gaps"], "the gap was measured at the robot"
        assert drained(bed) == []
        assert body["way_back"] == f"{TASK} is on {owner} again, where it was"

        owner = bed.wait_settled()
        with rehearse(bed) as played:
            bed.wait(lambda: drained(bed) == [owner], WITHIN_S, f"{owner} is drained")
            played.send_signal(signal.SIGINT)
            bed.wait(lambda: played.poll() is not None, WITHIN_S, "the rehearsal is over")
            assert played.stderr is not None
            told = played.stderr.read().decode()
        assert f"{owner} is undrained" in told
        bed.wait(lambda: drained(bed) == [], 30, f"{owner} is undrained")
        bed.wait(lambda: bed.owner() == owner, 60, f"{TASK} is on {owner} again")
        stream.end()
        bed.wait(lambda: len(stream.back) >= stream.sent, 60, "every sample is answered")
        assert stream.back == list(range(stream.sent))
