"""Checks of the whole fleet: what the nodes say of one another, compared.

Knows: the status of every node that answers. Does not know: how they were asked (`zsched.tools.doctor.look`).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from typing import Final, TypeVar

from zsched.core.values.errors import ConfigError
from zsched.core.values.fleet import TUNED_LINKS, TUNED_RULES, fleet_hash
from zsched.core.values.problems import Problem, of_kind
from zsched.core.values.struct import replace
from zsched.core.values.words import shown
from zsched.link.bus.node_ping import LARGE_S, SIZES, ping
from zsched.link.keyspace import Keyspace
from zsched.link.sessions.tls import visits
from zsched.tools.doctor.daemon import judged_lag, lacks_of_owners, problems_of
from zsched.tools.doctor.model import (
    OTHER_ELECTORS,
    SEAT_ADVICE,
    Json,
    Result,
    Scene,
    counted,
    failed,
    goes_by_other_electors,
    joined,
    passed,
    skipped,
    warned,
)
from zsched.tools.doctor.network import Address, addresses, connected

T = TypeVar("T")
HASH_DIGITS: Final = 8
HEARD: Final = ("alive", "suspect")


def answer(scene: Scene) -> Result:
    """Whether every node of the fleet file answers."""
    names = [spec.name for spec in scene.fleet.nodes]
    silent = [name for name in names if name not in scene.statuses]
    if not silent:
        return passed(f"{counted(len(names), 'nodes')}, all answer")
    told = f"{len(silent)} of {len(names)} nodes do not answer: {', '.join(silent)}"
    fix = "switch them on; on each: systemctl status zsched, zsched doctor"
    return failed(told, fix=fix) if not scene.statuses else warned(told, fix=fix)


def addresses_answer(scene: Scene) -> Result:
    """Whether the addresses of all others that live take connections from here, and data sessions large samples.

    Not our own: behind an address translation that serves the others it may lead nowhere from inside.
    """
    named = addresses(spec for spec in scene.fleet.nodes if spec.name != scene.node)
    living = [address for address in named if address.node in scene.statuses or _is_heard(scene, address.node)]
    if not living:
        return skipped("no other living node has an address in the fleet file")
    shut = list(connected(living))
    found = shut or _small_only(scene, [address for address in living if address.session == "data"])
    return joined(found, passed(f"{counted(len(living), 'addresses')} of living nodes, all take connections"))


def _small_only(scene: Scene, living: list[Address]) -> Iterator[Result]:
    """A result for each data session that is asked in vain with a large question."""
    keys = Keyspace(scene.fleet.name)
    try:
        configs = visits(scene.fleet, (address.endpoint for address in living))
    except (ConfigError, ValueError):
        return  # a check of its own says what is wrong with that file

    def lost(address: Address, config: str) -> str:
        selector = keys.role(address.node, "*")
        for name, size in SIZES.items():
            if ping(config, selector, count=1, timeout_s=LARGE_S, interval_s=0, needs_answer=False, size=size).missed:
                return name or "1 KiB"
        return ""

    with ThreadPoolExecutor(max_workers=16) as pool:
        for address, size in zip(living, pool.map(lost, living, configs), strict=True):
            if size:
                fix = "a link in between loses large packets: give both machines' interfaces the smaller MTU (ip link)"
                yield failed(f"{address} takes no {size} from here", fix=fix)


def _is_heard(scene: Scene, name: str) -> bool:
    return any(_states(status).get(name) in HEARD for status in scene.statuses.values())


def _states(status: Json) -> dict[str, str]:
    return {str(node["name"]): str(node["state"]) for node in status["nodes"]}


def have_one_file(scene: Scene) -> Result:
    """Whether all nodes go by the same fleet file."""
    mine = fleet_hash(scene.fleet)
    others = {name: str(status["fleet_file"]) for name, status in sorted(scene.statuses.items())}
    apart = {name: found for name, found in others.items() if found != mine}
    if not apart:
        return passed(f"{counted(len(others), 'nodes')} with hash {mine}")
    told = [f"{name} goes by hash {found}, {scene.source} here has {mine}" for name, found in apart.items()]
    if scene.document is not None:
        return failed(*told, fix="zsched fleet show names the revision of each node, and why it does not follow")
    if any(goes_by_other_electors(scene, scene.statuses[name]) for name in apart):
        return failed(*told, fix=OTHER_ELECTORS)
    fix = (
        "copy the one file to all machines, and `sudo systemctl reload zsched` on each; zsched status names what waits"
    )
    return failed(*told, fix=fix)


def have_one_version(scene: Scene) -> Result:
    """Whether all nodes are of one version."""
    found: dict[str, list[str]] = {}
    for name, status in sorted(scene.statuses.items()):
        found.setdefault(str(status["version"]), []).append(name)
    told = [f"zsched {version}: {', '.join(names)}" for version, names in sorted(found.items())]
    return passed(*told) if len(found) == 1 else warned(*told, fix="install one version everywhere")


def hear_each_other(scene: Scene) -> Result:
    """Whether every node that answers hears every other, in both directions."""
    found, pairs = [], 0
    for listener, status in sorted(scene.statuses.items()):
        states = _states(status)
        for speaker in sorted(scene.statuses):
            if speaker == listener:
                continue
            pairs += 1
            state = states.get(speaker, "not in its fleet file")
            if state not in HEARD:
                back = _states(scene.statuses[speaker]).get(listener, "not in its fleet file")
                told = f"{listener} does not hear {speaker} ({state}); {speaker} finds {listener} {back}"
                fix = f"between {speaker} and {listener}: firewalls, routes, `host:` and `listen:` of both"
                found.append(failed(told, fix=fix))
    return joined(found, passed(f"{pairs} directions between {len(scene.statuses)} nodes, all heard"))


def agree_on_registers(scene: Scene) -> Result:
    """Whether every node knows the same revision, epoch, owner, tuning and orders of each task."""
    found = [result for task in scene.fleet.tasks for result in _register(task.name, scene.statuses)]
    told = f"{counted(len(scene.fleet.tasks), 'registers')}, equal on {counted(len(scene.statuses), 'nodes')}"
    return joined(found, passed(told))


def differs(statuses: Mapping[str, Json]) -> bool:
    """Whether any two nodes know another value of a task's register: a move may be under way."""
    tasks = {str(task["name"]) for status in statuses.values() for task in status["tasks"]}
    return any(len(_values(task, statuses)) > 1 for task in tasks)


def _values(task: str, statuses: Mapping[str, Json]) -> dict[tuple[int, int, str, str], list[str]]:
    found: dict[tuple[int, int, str, str], list[str]] = {}
    for name, status in sorted(statuses.items()):
        for one in status["tasks"]:
            if one["name"] == task:
                value = (int(one["revision"]), int(one["epoch"]), str(one["owner"] or "nobody"), _rest_hash(one))
                found.setdefault(value, []).append(name)
    return found


LEFT_TO_FILE: Final = frozenset((*TUNED_RULES, *TUNED_LINKS))


def _rest_hash(task: Json) -> str:
    """A hash of what else the register holds: tuning and orders, but not for how long each node has known them.

    Settings that a tuning may leave to the file stand in the status as they are in force there. Where files differ they
    do, too, and no register does.
    """
    orders = {key: task.get(key) for key in ("pause", "pin")}
    kept = {key: {name: hold[name] for name in hold if name != "known_s"} for key, hold in orders.items() if hold}
    agreed = {name: value for name, value in (task.get("tuning") or {}).items() if name not in LEFT_TO_FILE}
    text = json.dumps({"tuning": agreed, **kept}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:HASH_DIGITS]


def _register(task: str, statuses: Mapping[str, Json]) -> Iterator[Result]:
    values = _values(task, statuses)
    if len(values) < 2:
        return
    newest = max(values)
    told = [
        f"{task}: revision {shown(revision)}, epoch {shown(epoch)}, owner {owner}, hash {rest} on {', '.join(names)}"
        for (revision, epoch, owner, rest), names in sorted(values.items(), reverse=True)
    ]
    if any(value[0] == newest[0] and value != newest for value in values):
        fix = (
            "two values of one revision: a state came from a backup or was made anew. What is agreed cannot be told "
            "any more: stop every daemon, and run `sudo zsched fleet recover --generation G --force` on each, with G "
            "one above the generation that `zsched status --json` tells (quorum)"
        )
        yield failed(*told, fix=fix)
        return
    behind = ", ".join(name for value, names in sorted(values.items()) if value != newest for name in names)
    yield failed(*told, fix=f"{behind}: look there for what keeps the news away (zsched doctor, zsched status)")


def have_electors(scene: Scene) -> Result:
    """Whether every elector is there with its state, as the nodes that answer say."""
    electors, found = scene.fleet.electors, []
    for name, status in sorted(scene.statuses.items()):
        quorum = status["quorum"]
        if name in electors and quorum["this_node"] != "elector":
            fix = f"on {name}: zsched status says why; zsched fleet recover --help says what to do"
            found.append(failed(f"{name} is an elector without a valid state ({quorum['this_node']})", fix=fix))
        for other in quorum["apart"]:
            fix = f"bring one fleet file to {name} and {other}; zsched status on both names the generation"
            found.append(failed(f"{name} and {other} refuse each other's votes", fix=fix))
        for other in quorum["stateless"]:
            if other not in scene.statuses:
                fix = f"on {other}: zsched status says why; zsched fleet recover --help says what to do"
                found.append(warned(f"{name} says that {other} has lost its state", fix=fix))
    if scene.unseated:
        names = ", ".join(scene.unseated)
        told = f"{scene.source} names electors that are none: {names}"
        found.append(warned(told, fix=SEAT_ADVICE.format(names=names)))
    missing = [name for name in electors if name not in scene.statuses]
    if missing:
        enough = len(electors) - len(missing) > len(electors) // 2
        told = f"{len(missing)} of {len(electors)} electors do not answer: {', '.join(missing)}"
        fix = "switch them on; a majority must be there for every move"
        found.append(warned(told, fix=fix) if enough else failed(told, fix=fix))
    return joined(found, passed(f"{counted(len(electors), 'electors')}, each with its state"))


def are_quick(scene: Scene) -> Result:
    """Whether every node's decision loop turns in time."""
    timing = scene.fleet.timing
    lags = {name: judged_lag(name, status, timing.beat_s, timing.suspect_s) for name, status in scene.statuses.items()}
    most = max((float(status["loop_lag_s"]) for status in scene.statuses.values()), default=0.0)
    bad = (result for result in lags.values() if result.fix)
    return joined(bad, passed(f"the slowest decision loop lagged by up to {1000 * most:.1f} ms of late"))


def answer_in_time(scene: Scene) -> Result:
    """Whether answers come quickly enough for the timing of the fleet file."""
    timing = scene.fleet.timing
    if not scene.answered_s:
        return skipped("no other node was asked through the daemon here")
    name, most_s = max(scene.answered_s.items(), key=lambda one: one[1])
    told = f"the slowest answer, of {name}, took {1000 * most_s:.0f} ms; timing: {timing.name}"
    if most_s <= timing.gather_s:
        return passed(told)
    fix = "`timing: wan` or a longer gather_s and ballot_s, or a better link (zsched ping NODE)"
    if most_s > timing.ballot_s:
        return warned(told, f"answers count for {timing.gather_s:g} s, ballots for {timing.ballot_s:g} s", fix=fix)
    return warned(told, f"answers count for {timing.gather_s:g} s", fix=fix)


def have_true_clocks(scene: Scene) -> Result:
    """Whether no node says that its clock cannot be trusted."""
    found = []
    for name, status in sorted(scene.statuses.items()):
        fix = f"on {name}: chronyc tracking, timedatectl; a time service should step the clock at boot"
        found += [warned(f"{name}: {text}", fix=fix) for text in of_kind(status, Problem.CLOCK)]
    return joined(found, passed(f"{counted(len(scene.statuses), 'nodes')}, no clock in doubt"))


def have_room(scene: Scene) -> Result:
    """Whether each task has a candidate that has what the task needs at least."""
    machines = {str(node["name"]): node for status in scene.statuses.values() for node in status["nodes"]}
    found, known = [], 0
    for task in scene.fleet.tasks:
        there = [machines[name] for name in task.candidates if machines.get(name, {}).get("memory_mb") is not None]
        known += len(there)
        fits = [
            one for one in there if _cores(one) >= task.demand.cpu_cores and one["memory_mb"] >= task.demand.memory_mb
        ]
        if there and not fits:
            need = f"{task.demand.cpu_cores:g} cores and {task.demand.memory_mb:g} MiB"
            largest = ", ".join(f"{one['name']} {_cores(one):.1f} cores, {one['memory_mb']:.0f} MiB" for one in there)
            fix = f"another candidate, or a true `demand:` of {task.name}"
            found.append(warned(f"{task.name} needs {need}; no candidate has that: {largest}", fix=fix))
    return joined(found, passed("each task fits on a candidate") if known else skipped("no candidate is measured"))


def _cores(machine: Json) -> float:
    return float(machine["cpu_cores"] or 0.0) * float(machine.get("speed") or 1.0)


def _who_tells(scene: Scene, told: Callable[[Json], Iterable[T]]) -> dict[T, list[str]]:
    """{what a status tells: the nodes whose status does}, in the order of the nodes."""
    found: dict[T, list[str]] = {}
    for name, status in sorted(scene.statuses.items()):
        for one in told(status):
            found.setdefault(one, []).append(name)
    return found


def have_owners(scene: Scene) -> Result:
    """Whether every node sees a quorum, and an owner of each task that works."""
    told = [
        replace(lack, evidence=tuple(f"{', '.join(names)}: {line}" for line in lack.evidence))
        for lack, names in _who_tells(scene, lacks_of_owners).items()
    ]
    return joined(told, passed(f"{counted(len(scene.statuses), 'nodes')}, each sees an owner of every task"))


def see_no_problem(scene: Scene) -> Result:
    """Whether no other node names a problem, of its own or of a task: what its streams wait for, say."""
    lines = [f"{', '.join(names)}: {problem}" for problem, names in _who_tells(scene, problems_of).items()]
    if not lines:
        return passed(f"{counted(len(scene.statuses), 'nodes')}, no problem")
    return warned(*lines, fix="each line says what to do; zsched status --node NAME shows them")
