"""The one table of all checks, those of other distributions included, and how they are run.

Knows: the checks and their order, the entry point group `zsched.checks`. Does not know: what a check looks at.
"""

from __future__ import annotations

from collections.abc import Iterable
from importlib.metadata import EntryPoint, entry_points
from typing import Final

from zsched.tools.doctor import daemon, fleet, fleet_file, machine, network, security, service, state, streams, workers
from zsched.tools.doctor.model import Check, Needs, Result, Scene, Verdict, failed, skipped

GROUP: Final = "zsched.checks"
"""Entry points whose values are a `Check` each, or several."""

CHECKS: Final[tuple[Check, ...]] = (
    Check(name="file.valid", asks="Has the fleet file no fault?", run=fleet_file.valid, needs=Needs.NOTHING),
    Check(
        name="file.warnings",
        asks="Has the fleet file no warning?",
        run=fleet_file.without_warnings,
        needs=Needs.FILE,
    ),
    Check(
        name="file.node",
        asks="Does the fleet file name this machine?",
        run=fleet_file.names_this_machine,
        needs=Needs.FILE,
    ),
    Check(
        name="file.in_force",
        asks="Does the daemon go by the file as it is now?",
        run=fleet_file.in_force,
        needs=Needs.STATUS,
    ),
    Check(name="state.valid", asks="Is there a state, whole and this node's own?", run=state.valid),
    Check(name="state.elector", asks="May this node vote by it?", run=state.makes_an_elector),
    Check(name="state.fsync", asks="Is a save on disk in time for a ballot?", run=state.syncs_quickly),
    Check(name="state.space", asks="Has the state's disk room?", run=state.has_space, needs=Needs.NOTHING),
    Check(name="daemon.answers", asks="Does the daemon run and answer?", run=daemon.answers, needs=Needs.FILE),
    Check(
        name="daemon.version",
        asks="Are it and its relay of the installed version?",
        run=daemon.is_of_this_version,
        needs=Needs.STATUS,
    ),
    Check(name="daemon.lag", asks="Does its decision loop turn in time?", run=daemon.is_quick, needs=Needs.STATUS),
    Check(name="daemon.problems", asks="Does it name no problem?", run=daemon.sees_no_problem, needs=Needs.STATUS),
    Check(
        name="task.owners",
        asks="Is there a quorum, and has each task a living owner?",
        run=daemon.tasks_have_owners,
        needs=Needs.STATUS,
    ),
    Check(
        name="node.flags",
        asks="May every node get tasks?",
        run=daemon.nodes_get_tasks,
        needs=Needs.STATUS,
    ),
    Check(name="clock.rate", asks="Does the clock run true?", run=machine.clock_runs_true),
    Check(name="machine.descriptors", asks="May the daemon open enough files?", run=machine.has_descriptors),
    Check(
        name="machine.shared_memory",
        asks="Can /dev/shm be used where the file wants it?",
        run=machine.shares_memory,
    ),
    Check(name="machine.demand", asks="Is this machine large enough for each task?", run=machine.can_do_its_tasks),
    Check(name="machine.memory", asks="Has it memory for all its workers?", run=machine.can_do_all_at_once),
    Check(name="radio.power_save", asks="Is Wi-Fi power save off?", run=machine.radio_stays_awake),
    Check(name="unit.installed", asks="Is there a systemd unit?", run=service.is_installed, needs=Needs.NOTHING),
    Check(name="unit.enabled", asks="Does it start at boot?", run=service.is_enabled, needs=Needs.NOTHING),
    Check(name="unit.paths", asks="Does the service see the files that it needs?", run=service.can_see_its_files),
    Check(
        name="net.names",
        asks="Has every host of the file an address here?",
        run=network.names_resolve,
        needs=Needs.FILE,
    ),
    Check(
        name="net.loopback",
        asks="Can others use this machine's address?",
        run=network.is_not_alone_on_loopback,
    ),
    Check(name="net.ports", asks="Does nobody else listen on its ports?", run=network.ports_are_ours),
    Check(
        name="tls.certificates",
        asks="Are its certificates its own, and far from their end?",
        run=security.certificates_last,
    ),
    Check(name="tls.key", asks="Does nobody but its owner read its key?", run=security.keys_are_private),
    Check(
        name="tls.refused",
        asks="Was nobody refused who linked or spoke?",
        run=security.nobody_is_refused,
        needs=Needs.STATUS,
    ),
    Check(name="tls.open", asks="Is it closed to the internet, or secured?", run=security.is_not_open_to_everybody),
    Check(name="worker.command", asks="Are its workers' programs there?", run=workers.commands_are_there),
    Check(name="worker.user", asks="Can they be started as their users?", run=workers.users_are_there),
    Check(name="worker.imports", asks="Do they find what they import?", run=workers.packages_are_there),
    Check(name="worker.engine", asks="Is what their drivers keep there?", run=workers.engines_are_there),
    Check(name="worker.state", asks="Are its workers well?", run=workers.run_well, needs=Needs.STATUS),
    Check(
        name="stream.silent",
        asks="Has each input had a message?",
        run=streams.inputs_have_publishers,
        needs=Needs.STATUS,
    ),
    Check(
        name="stream.twice",
        asks="Has each input one publisher?",
        run=streams.keys_have_one_publisher,
        needs=Needs.STATUS,
    ),
    Check(
        name="stream.unheard",
        asks="Does somebody listen to each output?",
        run=streams.outputs_have_listeners,
        needs=Needs.STATUS,
    ),
    Check(name="fleet.answers", asks="Does every node answer?", run=fleet.answer, needs=Needs.FLEET),
    Check(
        name="fleet.addresses",
        asks="Do all others' addresses take connections?",
        run=fleet.addresses_answer,
        needs=Needs.FLEET,
    ),
    Check(name="fleet.files", asks="Do all nodes go by one file?", run=fleet.have_one_file, needs=Needs.FLEET),
    Check(name="fleet.versions", asks="Are all of one version?", run=fleet.have_one_version, needs=Needs.FLEET),
    Check(name="fleet.pairs", asks="Does everybody hear everybody?", run=fleet.hear_each_other, needs=Needs.FLEET),
    Check(
        name="fleet.registers",
        asks="Do all know the same value of each task?",
        run=fleet.agree_on_registers,
        needs=Needs.FLEET,
    ),
    Check(
        name="fleet.owners",
        asks="Does every node see a quorum, and an owner of each task?",
        run=fleet.have_owners,
        needs=Needs.FLEET,
    ),
    Check(name="fleet.electors", asks="Has every elector its state?", run=fleet.have_electors, needs=Needs.FLEET),
    Check(name="fleet.lag", asks="Does every decision loop turn in time?", run=fleet.are_quick, needs=Needs.FLEET),
    Check(name="fleet.timing", asks="Do answers come in time?", run=fleet.answer_in_time, needs=Needs.FLEET),
    Check(name="fleet.clocks", asks="Does every node trust its clock?", run=fleet.have_true_clocks, needs=Needs.FLEET),
    Check(name="fleet.demand", asks="Does each task fit on a candidate?", run=fleet.have_room, needs=Needs.FLEET),
    Check(name="fleet.problems", asks="Does no node name a problem?", run=fleet.see_no_problem, needs=Needs.FLEET),
)
"""In the order in which they are run and shown: what others rest on comes first."""


def run_all(scene: Scene) -> list[tuple[Check, Result]]:
    """Every check that ``scene`` is for, with its result; those of the fleet only when the fleet was asked.

    From a machine that is no node of the fleet only the fleet is looked at.
    """
    left_out = {Needs.NODE, Needs.STATUS} if scene.is_visit else set() if scene.is_fleet else {Needs.FLEET}
    wanted = (check for check in (*CHECKS, *brought()) if check.needs not in left_out)
    return [(check, _run(check, scene)) for check in wanted]


def _run(check: Check, scene: Scene) -> Result:
    why = _missing(check, scene)
    if why:
        return skipped(why)
    try:
        return check.run(scene)
    except Exception as error:  # noqa: BLE001 - a check that fails must not take the others along
        told = f"the check itself failed: {type(error).__name__}: {error}"
        return failed(told, fix=f"report it, with zsched bugreport: {check.name}")


def _missing(check: Check, scene: Scene) -> str:
    """What a check lacks; empty: nothing. That nobody answers is a finding of the check that asks for it."""
    needs = check.needs
    if needs is Needs.NOTHING:
        return ""
    if scene.known is None:
        return "it needs a fleet file without faults"
    if needs in (Needs.NODE, Needs.STATUS) and not scene.is_node:
        return "it needs this machine's name in the fleet file"
    if needs is Needs.STATUS and scene.own is None:
        return "it needs the daemon's answer"
    if needs is Needs.FLEET and not scene.statuses and (check.run is not fleet.answer or not scene.is_fleet):
        return "no node answers" if scene.is_fleet else "it needs --fleet"
    return ""


def brought(points: Iterable[EntryPoint] | None = None) -> tuple[Check, ...]:
    """The checks of other distributions; one that cannot be loaded is a check that says so."""
    found: list[Check] = []
    for point in entry_points(group=GROUP) if points is None else points:
        try:
            checks = _checks(point.load())
        except Exception as error:  # noqa: BLE001 - another distribution's fault must not take the checks along
            checks = (_unloaded(point, f"{type(error).__name__}: {error}"),)
        found += checks
    return tuple(found)


def _checks(loaded: object) -> tuple[Check, ...]:
    checks = tuple(loaded) if isinstance(loaded, Iterable) else (loaded,)
    if not all(isinstance(check, Check) for check in checks):
        raise TypeError("it is neither a zsched.tools.doctor.model.Check nor several")
    return checks


def _unloaded(point: EntryPoint, why: str) -> Check:
    def run(_scene: Scene) -> Result:
        return failed(f"{point.value} cannot be loaded: {why}", fix="update or remove the distribution that brings it")

    return Check(name=point.name, asks="Can this check be loaded?", run=run, needs=Needs.NOTHING)


def worst(results: Iterable[tuple[Check, Result]]) -> Verdict:
    """FAIL, WARN or PASS over all results."""
    found = {result.verdict for _, result in results}
    return next((verdict for verdict in (Verdict.FAIL, Verdict.WARN) if verdict in found), Verdict.PASS)
