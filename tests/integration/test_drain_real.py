"""`zsched drain` on real daemons: a stream's owner is emptied, stays so over a restart, and gets its task back."""

from __future__ import annotations

import json
from pathlib import Path

from support.operators import Operator, Stream
from support.sessions import matches
from zsched_lab.fleet.testbed import TASK, Testbed, echo_fleet


def test_a_drained_owner_loses_nothing_stays_empty_over_a_restart_and_comes_back(tmp_path: Path) -> None:
    tree = echo_fleet(edges=2, stream_class="reliable")
    tree["tasks"][TASK]["outputs"][0]["handover"] = "all"  # by `latest` a move cuts the old owner's late answers off
    with Testbed(tmp_path, tree) as bed:
        bed.init()
        bed.start()
        owner = bed.wait_settled()
        other = next(name for name in ("edge1", "edge2") if name != owner)
        operator, session = Operator(bed), bed.app("robot1")
        stream = Stream(session)
        bed.wait(lambda: matches(stream.publisher), 60, "the relay subscribes")
        stream.start()
        bed.wait(lambda: len(stream.back) > 20, 60, "the stream flows")

        refused = operator.zsched("drain", owner, "--yes")
        assert refused.returncode == 1
        assert b"has no document yet; agree one: zsched apply" in refused.stderr
        file = tmp_path / "agreed.yaml"
        file.write_text(json.dumps(tree))
        operator.done("apply", file, "--yes")

        # a drain is stronger than a pin; the command ends when the node is empty
        operator.done("pin", TASK, owner, "--yes")
        told = operator.done("drain", owner, "--yes", "--json", "-m", "new fan")
        events = [json.loads(line) for line in told.splitlines()]
        moved = next(one for one in events if one["event"] == "moved")
        assert (moved["node"], moved["to"], moved["lost"], moved["doubled"]) == (owner, other, 0, 0)
        assert (events[0]["event"], events[-1]["event"], events[-1]["node"]) == ("agreed", "empty", owner)

        # the machine boots again: it is drained, and the pin does not bring the task back
        bed.stop(owner)
        bed.start(owner)

        def is_kept_out() -> bool:
            own = next(one for one in bed.status(owner)["nodes"] if one["name"] == owner)
            seen = next(one for one in bed.status("robot1")["nodes"] if one["name"] == owner)
            ready = any(worker["state"] == "ready" for worker in seen["workers"])
            decision = bed.task("robot1")["decision"]
            return bool(own["flags"]) and seen["state"] == "alive" and ready and decision["vetoed"].get(owner, "") != ""

        bed.wait(is_kept_out, 60, f"{owner} is back, ready and drained")
        veto = bed.task("robot1")["decision"]["vetoed"][owner]
        assert veto.startswith("drained by "), veto
        assert veto.endswith("@robot1 (new fan)")
        assert bed.owner() == other

        # from a machine without a daemon; the pinned task goes home
        endpoint = bed.fleet.node("robot2").listen_control
        operator.done("undrain", owner, "--yes", "--connect", endpoint)
        bed.wait(lambda: bed.owner() == owner, 60, f"the pinned task is back on {owner}")
        bed.wait_settled()
        stream.end()
        bed.wait(lambda: len(stream.back) >= stream.sent, 60, "every sample is answered")
        assert stream.back == list(range(stream.sent))
        assert f"{owner} is drained by " in operator.done("history")
