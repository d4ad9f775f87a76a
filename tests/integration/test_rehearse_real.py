"""`zsched rehearse` on real daemons: faults under a live stream, a daemon that somebody starts again, what is kept."""

from __future__ import annotations

import json
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
    return subprocess.Popen([*command, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE)


def test_a_fleet_is_moved_hurt_and_killed_and_the_page_tells_what_it_did(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ZSCHED_RESTARTED_BY", "this test")
    tree = echo_fleet(robots=1, edges=2, stream_class="reliable")
    tree["tasks"][TASK]["outputs"][0]["handover"] = "all"
    with Testbed(tmp_path, tree) as bed:
        bed.init()
        bed.start()
        owner = bed.wait_whole()
        operator, stream = Operator(bed), Stream(bed.app("robot1"))
        bed.wait(lambda: matches(stream.publisher), 60, "the relay subscribes")
        stream.start()
        bed.wait(lambda: len(stream.back) > 20, 60, "the stream flows")
        epoch = bed.task("robot1")["epoch"]

        # nothing is done without consent, nor by --plan; links that pass no network are left out with the reason
        refused = operator.zsched("rehearse", TASK)
        assert refused.returncode == 2, refused
        plan = operator.zsched("rehearse", TASK, "--plan", "--json")
        assert plan.returncode == 10, plan
        steps = {one["step"]: one["left_out"] for one in json.loads(plan.stdout)["plan"]}
        link, drain = steps.pop("link"), steps.pop("drain")
        assert steps == {"move": None, "worker": None, "daemon": None}
        assert "on this machine, too: between them there is no network to cut" in link
        assert "document" in drain
        assert bed.task("robot1")["epoch"] == epoch

        pids = {node: bed.pid(node) for node in bed.names}
        bed.let_end("edge1", "edge2")
        played = rehearse(bed, "--steps", "move,worker,daemon", "--pause", "11", "--yes", "--json", "-m", "new radio")
        again: list[str] = []

        def is_over() -> bool:
            for node in ("edge1", "edge2"):  # the supervisor of this fleet
                if bed.has_ended(node):
                    again.append(node)
                    bed.start(node)
            return played.poll() is not None

        with played:
            bed.wait(is_over, WITHIN_S, "the rehearsal is over")
            assert played.stdout is not None
            assert played.stderr is not None
            said, told = played.stdout.read(), played.stderr.read().decode()
        body = json.loads(said)["rehearsal"]
        assert (played.returncode, body["why"]) == (0, "every step is done"), told
        assert [one["step"] for one in body["steps_done"] if not one["left_out"]] == ["move", "worker", "daemon"], told
        killed = next(one for one in body["steps_done"] if one["step"] == "daemon")
        assert again == [killed["node"]]
        assert bed.pid(killed["node"]) != pids[killed["node"]]
        assert {one["taker"] for one in body["steps_done"]} <= {"edge1", "edge2"}
        planned = next(one for one in body["steps_done"] if one["step"] == "move")
        assert (planned["lost"], planned["doubled"]) == (0, 0)
        assert planned["gaps"], "the gap of the move was measured at the robot"
        assert body["way_back"] == f"{TASK} is on {owner} again, where it was" or body["way_back"].endswith("changed")

        # it is kept, and the history says who
        assert operator.done("rehearse", "--list").split() == [body["id"]]
        shown = operator.done("rehearse", "--show", body["id"])
        assert "every promise was kept" in shown
        assert "PASS" in shown
        assert "@robot1" in operator.done("history")
        stream.end()
        bed.wait(lambda: len(stream.back) >= 20, 60, "answers")
