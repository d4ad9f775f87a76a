"""An elector's state folder is brought back from a backup, on real daemons: peers remember votes that it does not."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from zsched_lab.fleet.testbed import Testbed, echo_fleet

pytestmark = pytest.mark.long


def test_an_elector_whose_folder_was_restored_votes_no_more_and_says_so_on_every_node(tmp_path: Path) -> None:
    with Testbed(tmp_path, echo_fleet(edges=2)) as bed:
        bed.init()
        bed.start()
        first = bed.wait_settled()
        folder, backup = bed.folder / "robot3", bed.folder / "backup"
        bed.stop("robot3")
        shutil.copytree(folder, backup)

        bed.wait_whole()
        owner = first
        for _ in range(2):
            bed.kill(owner)
            bed.wait(lambda: bed.owner() not in {owner, None}, 60, "another owner")  # noqa: B023 - called at once
            owner = bed.wait_whole()
        assert (folder / "state").read_bytes() != (backup / "state").read_bytes(), "it has voted since"

        bed.stop("robot3")
        shutil.rmtree(folder)
        shutil.copytree(backup, folder)
        bed.start("robot3")
        for node in ("robot1", "edge1"):
            bed.wait(lambda: bed.status(node)["quorum"]["stateless"] == ["robot3"], 60, f"{node} to be told")  # noqa: B023 - called at once
        own = bed.status("robot3")
        assert own["quorum"]["this_node"] != "elector"
        (said,) = [one for one in own["problems"] if "brought back from a backup" in one]
        assert "it works all the same" in said
        assert "--generation" not in said, "two electors of three agree: nothing has to begin anew"

        bed.stop("robot3")
        bed.start("robot3")
        bed.wait(lambda: bed.status("robot3")["quorum"]["this_node"] != "elector", 60, "what is on its disk")
        bed.kill(owner)
        bed.wait(lambda: bed.owner() not in {owner, None}, 60, "two electors of three that go on")
