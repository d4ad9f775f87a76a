"""Checks of the fleet file on this machine.

Knows: faults and warnings of a fleet file, its hash. Does not know: what else a node of it needs.
"""

from __future__ import annotations

from zsched.config.reader import Fault
from zsched.core.values.fleet import fleet_hash
from zsched.tools.doctor.model import (
    OTHER_ELECTORS,
    Result,
    Scene,
    counted,
    failed,
    goes_by_other_electors,
    passed,
    skipped,
    warned,
)


def valid(scene: Scene) -> Result:
    """Whether the fleet file has no fault."""
    fleet = scene.reading.fleet
    if fleet is None:
        hints = [fault.hint for fault in scene.reading.faults if not fault.line and fault.hint]
        return failed(*_lines(scene, scene.reading.faults), fix=(hints or [f"zsched check {scene.file}"])[0])
    if scene.document is not None:
        return passed(f"{scene.file} has no fault; nothing goes by it, for a document is agreed (file.in_force)")
    counts = ((len(fleet.nodes), "nodes"), (len(fleet.tasks), "tasks"), (len(fleet.electors), "electors"))
    told = ", ".join(counted(number, noun) for number, noun in counts)
    return passed(f"{scene.file}: {told}, hash {fleet_hash(fleet)}")


def without_warnings(scene: Scene) -> Result:
    """Whether what the fleet goes by, the agreed document or the file, has no warning."""
    if scene.document is not None:
        found = scene.document.warnings
        told = [f"{scene.source}:{fault.line}:{fault.col}: {fault.message}" for fault in found]
        return warned(*told, fix="zsched edit") if told else passed(f"{scene.source}: no warnings")
    if not scene.reading.warnings:
        return passed(f"{scene.file}: no warnings")
    return warned(*_lines(scene, scene.reading.warnings), fix=f"zsched check {scene.file}")


def names_this_machine(scene: Scene) -> Result:
    """Whether this machine is a node of the fleet."""
    names = ", ".join(node.name for node in scene.fleet.nodes)
    if scene.is_node:
        return passed(f"this machine is {scene.node}, {scene.me.kind}")
    if scene.is_visit:
        return skipped(f"this machine is no node of the fleet ({names}): only the fleet is looked at")
    return failed(
        f"there is no node {scene.node!r}, there are {names}",
        fix="name this machine with --node or ZSCHED_NODE (in the unit: systemctl edit zsched)",
    )


def in_force(scene: Scene) -> Result:
    """Whether the daemon goes by the fleet file as it is now, where no document is agreed."""
    if scene.status.get("document"):
        told = f"the daemon goes by the agreed document, hash {scene.status['fleet_file']}, and not by {scene.file}"
        counts = ((len(scene.fleet.nodes), "nodes"), (len(scene.fleet.tasks), "tasks"))
        held = ", ".join(counted(number, noun) for number, noun in counts)
        more = () if scene.document is None else (f"revision {scene.revision}: {held}",)
        return passed(f"{told}; `zsched apply FILE` changes the document", *more)
    mine, running = fleet_hash(scene.fleet), str(scene.status["fleet_file"])
    if mine == running:
        return passed(f"the daemon goes by this file, hash {mine}")
    return warned(
        f"the daemon goes by a file of hash {running}, {scene.file} has {mine}",
        fix=OTHER_ELECTORS
        if goes_by_other_electors(scene, scene.status)
        else "sudo systemctl reload zsched; zsched status then names what waits for a restart",
    )


def _lines(scene: Scene, faults: tuple[Fault, ...]) -> list[str]:
    return [
        f"{scene.file}:{fault.line}:{fault.col}: {fault.message}" if fault.line else f"{scene.file}: {fault.message}"
        for fault in faults
    ]
