"""A fleet of files and state folders that an older version has written starts as revision 1 of the agreed document.

`older_version/` was written by commit 365de39 (2026-11-22), before fleets had a document: five daemons ran by its file,
and the owner was killed once. Only the addresses and the machine's identity are today's.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

import msgpack
import pytest

from support.operators import Operator
from support.waiting import until
from zsched.host.state_file import hardware_id
from zsched_lab.fleet.testbed import TASK, Json, Testbed, echo_fleet

pytestmark = pytest.mark.long

WRITTEN = Path(__file__).parent / "older_version"
OWNER, EPOCH = "edge2", 2


def at_todays_addresses() -> Json:
    tree: Json = json.loads((WRITTEN / "fleet.json").read_text())
    for name, node in echo_fleet(robots=3, edges=2)["nodes"].items():
        tree["nodes"][name]["listen"] = node["listen"]
        tree["nodes"][name]["host"] = node["host"]
    return tree


def restore(name: str, folder: Path) -> None:
    """The state as if the older version had written it on this machine."""
    frame = msgpack.unpackb((WRITTEN / f"{name}.state").read_bytes().partition(b"\n")[2])
    frame[2]["hardware"] = hardware_id()
    packed = msgpack.packb(frame)
    folder.mkdir(mode=0o700)
    (folder / "state").write_bytes(b"zsched-state/1 " + hashlib.blake2s(packed).hexdigest().encode() + b"\n" + packed)


def test_files_and_states_of_an_older_version_become_revision_1_without_a_generation(tmp_path: Path) -> None:
    with Testbed(tmp_path, at_todays_addresses()) as bed:
        for name in bed.names:
            restore(name, tmp_path / name)
        bed.start()
        assert bed.wait_settled() == OWNER
        for name in bed.names:
            assert (bed.task(name)["epoch"], bed.status(name)["quorum"]["generation"]) == (EPOCH, 0)
            # A busy machine's node may be silent for a moment, and is heard again.
            until(lambda: bed.status(name)["problems"] == [], f"{name} to see no problem")  # noqa: B023 - called at once
        operator = Operator(bed)
        assert operator.done("fleet", "show").startswith("testbed: revision 1, number 1, settled\nno document")

        operator.done("apply", bed.file, "--yes")
        assert "\ndocument " in operator.done("fleet", "show")
        assert (bed.owner(), bed.task("robot3")["epoch"]) == (OWNER, EPOCH)
        operator.done("move", TASK, "edge1", "--yes")
        assert bed.wait_settled() == "edge1"
