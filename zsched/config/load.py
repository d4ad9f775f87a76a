"""Decides whether a fleet file can be used, and what it says: YAML to `Fleet`, every fault at once with its place.

Knows: how the values of the file relate to each other. Does not know: keys and ranges (`zsched.config.schema`), YAML
(`zsched.config.reader`), this machine.
"""

from __future__ import annotations

import errno
from collections.abc import Mapping
from pathlib import Path

from zsched.config.blocks import Located, Section
from zsched.config.nodes import Cast, read_nodes, select, warn_missing
from zsched.config.parts import Part, placed
from zsched.config.reader import MAX_FILE_BYTES, Collector, Fault, Place, nearest, read_yaml, render_all
from zsched.config.schema import FLEET
from zsched.config.security import read_security
from zsched.config.site import read_site
from zsched.config.tasks import check_secured, read_tasks
from zsched.config.timing import WIFI, timing_faults
from zsched.core.membership.beat_room import most_bytes
from zsched.core.values.beat import MAX_BEAT_BYTES
from zsched.core.values.document import MAX_DOCUMENT_BYTES
from zsched.core.values.errors import ConfigError
from zsched.core.values.fleet import Fleet, Timing
from zsched.core.values.model import NodeId, NodeKind
from zsched.core.values.struct import Struct
from zsched.host.files import owner_of, read_regular
from zsched.host.paths import SYSTEM_CONFIG

__all__ = ["CheckResult", "Fault", "check_bytes", "check_file", "load_fleet", "require_node"]

MORE = "note: more may follow once these are mended: what hangs on a faulty part cannot be judged"
_SEEDS = 2
_PLAIN = ("shared_memory", "replace_s", "away_s")
"""Keys of the fleet file that are fields of `Fleet` as they stand."""
"""How many nodes are seeds when the file names none: one may be down."""


class CheckResult(Struct, frozen=True, kw_only=True):
    """What became of one fleet file: the fleet, or the faults that stand in its way; warnings with either."""

    file: str
    fleet: Fleet | None
    faults: tuple[Fault, ...]
    warnings: tuple[Fault, ...]

    def report(self) -> str:
        """Faults, then warnings, as a compiler shows them; empty when there are none."""
        parts = (render_all(self.file, self.faults), render_all(self.file, self.warnings, "warning"))
        placed_in = [fault.file or self.file for fault in self.faults if fault.line]
        note = f"{placed_in[0]}: {MORE}" if placed_in else ""
        return "\n".join(part for part in (*parts, note) if part)


def load_fleet(path: str | Path) -> Fleet:
    """The fleet that the file at ``path`` describes.

    Raises:
        ConfigError: the file cannot be read or has faults; its text is the whole report.
    """
    result = check_file(path)
    if result.fleet is None:
        raise ConfigError(render_all(result.file, result.faults))
    return result.fleet


def require_node(fleet: Fleet, name: NodeId, path: str | Path) -> None:
    """Refuse a name for this machine that the fleet file at ``path`` does not hold.

    Raises:
        ConfigError: names the nodes that there are, and the nearest.
    """
    known = [node.name for node in fleet.nodes]
    if name in known:
        return
    close = nearest(name, known)
    hint = f"{close} Say" if close.startswith("did you mean") else "say"
    raise ConfigError(
        f"{path}: no node {name!r} under 'nodes' (there are {', '.join(known)}); "
        f"{hint} which one this machine is with --node NAME or ZSCHED_NODE"
    )


def check_file(path: str | Path) -> CheckResult:
    """Read and check the file at ``path``; never raises for what the file holds or for its absence."""
    file = Path(path)
    try:
        data = read_regular(file, MAX_FILE_BYTES)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
        fault = Fault(line=0, col=0, message=f"cannot be read: {reason}", hint=_unread_hint(file, error))
        return CheckResult(file=str(path), fleet=None, faults=(fault,), warnings=())
    return check_bytes(data, str(path))


def _unread_hint(file: Path, error: OSError | ValueError) -> str:
    """What to do about a fleet file that cannot be read."""
    number = error.errno if isinstance(error, OSError) else None
    if number in (errno.EACCES, errno.EPERM):
        return f"{owner_of(file)}; run as that user, or let others read it (chmod a+r), on the way there too"
    if number == errno.EFBIG:
        return "a rule stands for every robot and candidate: write {robot} and {target} in place of their names"
    if number == errno.ENOENT:
        advice = "name the fleet file" if file == SYSTEM_CONFIG else "check the path"  # else somebody has named it
        return (
            f"{advice}; `zsched fleet create NAME` and `zsched join INVITATION` write this machine's, "
            "`zsched new python` one to try"
        )
    return "give the path of a fleet file"


def check_bytes(
    data: bytes, file: str = "fleet.yaml", folder: Path | None = None, part: Part | None = None
) -> CheckResult:
    """As `check_file` for ``data``; file names in it are relative to ``folder``, else to the folder of ``file``.

    Faults in what came from ``part`` name its file.
    """
    root, out = read_yaml(data)
    fleet = None
    if root is not None and part is not None:
        out.add_file(file, data.decode())
        out.add_file(part.file, part.text)
        root = placed(root, file, part)
    if root is not None:
        section = FLEET.read(root, out)
        if section is not None:
            fleet = _fleet(section, folder or Path(file).absolute().parent, len(data), out)
    is_good = fleet is not None and out.count == 0
    return CheckResult(file=file, fleet=fleet if is_good else None, faults=out.faults, warnings=out.warnings)


def _fleet(section: Section, folder: Path, size: int, out: Collector) -> Fleet | None:
    cast = read_nodes(section, folder, out)
    timing = _timing(section, out)
    seeds = _seeds(section, cast, out)
    electors = _electors(section, cast, out)
    tasks = read_tasks(section, cast, out)
    zenoh_config = _zenoh_config(section, folder, out)
    security = read_security(section, cast, folder, out)
    if security is not None:
        check_secured(section, out)
    cells = read_site(section, folder, out)
    if out.count:
        return None
    fleet = Fleet(
        name=section.get("fleet"),
        timing=timing,
        nodes=tuple(sorted(cast.nodes, key=lambda node: node.name)),
        tasks=tuple(sorted(tasks, key=lambda task: task.name)),
        electors=electors,
        is_auto=not section.get("electorate"),
        seeds=seeds,
        zenoh_config=zenoh_config,
        security=security,
        cells=cells,
        **{name: section.get(name) for name in _PLAIN if name in section.values},
    )
    _check_size(size, section.where("tasks"), out)
    if fleet.away_s < fleet.replace_s:
        message = f"away_s is {fleet.away_s:g} s, and an elector is gone after {fleet.replace_s:g} s (replace_s)"
        hint = f"away_s: {fleet.replace_s:g} or more"
        out.error(section.where("away_s" if "away_s" in section.values else "replace_s"), message, hint)
        return None
    _check_beats(fleet, section.where("tasks"), out)
    return fleet


def _check_size(size: int, place: Place, out: Collector) -> None:
    """A daemon reads a larger file than nodes can agree on."""
    if size > MAX_DOCUMENT_BYTES:
        message = f"the file has {size} bytes: nodes agree on a document of at most {MAX_DOCUMENT_BYTES}"
        out.warn(place, message, "shorten comments; write {robot} and {target} in place of names")


def _check_beats(fleet: Fleet, place: Place, out: Collector) -> None:
    """Every beat holds a part for each task and each node: all of them must have room in one."""
    needed = most_bytes(fleet)
    if needed > MAX_BEAT_BYTES:
        count = sum(task.exclusive for task in fleet.tasks)
        message = f"a beat of this fleet may take {needed} bytes, at most {MAX_BEAT_BYTES} are sent"
        hint = f"fewer tasks ({len(fleet.tasks)}, {count} of them exclusive) or shorter names; or two fleets"
        out.error(place, message, hint)


# --- timing ----------------------------------------------------------------------------------------------------------


def _timing(section: Section, out: Collector) -> Timing:
    given = section.get("timing", WIFI)
    if isinstance(given, Timing):
        return given
    base: Timing = given.get("profile", WIFI)
    changes = {name: value for name, value in given.values.items() if name != "profile"}
    timing = _changed(base, changes)
    if given.is_whole:
        for name, message in timing_faults(timing):
            # a relation may be broken by the other of its fields: point at one that the file sets
            place = given.places.get(name) or next(
                (given.places[other] for other in changes if other in message), given.place
            )
            out.error(place, message)
    return timing


def _changed(base: Timing, changes: Mapping[str, float]) -> Timing:
    values = {name: getattr(base, name) for name in base.__dataclass_fields__}
    return Timing(**{**values, **changes})


# --- seeds and electors ----------------------------------------------------------------------------------------------


def _seeds(section: Section, cast: Cast, out: Collector) -> tuple[NodeId, ...]:
    given: tuple[Located[str], ...] | None = section.get("seeds")
    if given is None:
        seeds = tuple(node.name for node in cast.nodes if node.can_be_dialled)[:_SEEDS]
        is_sound = cast.is_whole and cast.sound == set(cast.names)  # a faulty `listen:` is told of in its own place
        if not seeds and len(cast.names) > 1 and is_sound and "seeds" not in section.places:
            message = "no node can be dialled, so none would find another"
            hint = "give one or two nodes `host:` and `listen: {control: tcp/0.0.0.0:7457, data: tcp/0.0.0.0:7458}`"
            out.error(cast.place, message, hint)
        return seeds
    for seed in cast.known(given, out):
        node = next((node for node in cast.nodes if node.name == seed.value), None)
        if node is not None and node.name in cast.sound and not node.can_be_dialled:
            hint = "it needs `listen: {control:, data:}` with fixed ports, and a `host:` when it listens on 0.0.0.0"
            out.error(seed.place, f"the seed {seed.value!r} cannot be dialled", hint)
    return tuple(dict.fromkeys(seed.value for seed in given))


def _electors(section: Section, cast: Cast, out: Collector) -> tuple[NodeId, ...]:
    robots = cast.of_kind(NodeKind.ROBOT)
    given = section.get("electorate")
    electors = select(given, cast, out) if given else robots or tuple(sorted(cast.names))
    place = section.where("electorate") if given is not None else cast.place
    if not robots and cast.is_whole:
        out.warn(
            cast.place, "the fleet has no robot: nobody votes, and no task gets an owner", "a robot may join later"
        )
    if not electors and cast.is_whole:
        out.error(place, "no node is an elector")
    elif electors and cast.is_whole:
        _advise_electors(electors, cast, place, out)
    return electors


def _advise_electors(electors: tuple[NodeId, ...], cast: Cast, place: Place, out: Collector) -> None:
    spare, count = [name for name in cast.names if name not in electors], len(electors)
    three = (*electors, *spare[: 3 - count])
    hint = f"electorate: [{', '.join(sorted(three))}]" if len(three) == 3 else ""  # two would be no better than one
    if count <= 2:
        away = f"{electors[0]!r} is the only elector: while it" if count == 1 else "two electors: while either"
        out.warn(place, f"{away} is away no task can move", hint, is_of_electors=True)
    elif count % 2 == 0:
        message = f"{count} electors survive the loss of {(count - 1) // 2}, as {count - 1} would"
        out.warn(place, message, "an odd number is better", is_of_electors=True)


# --- zenoh -----------------------------------------------------------------------------------------------------------


def _zenoh_config(section: Section, folder: Path, out: Collector) -> str:
    zenoh: Section | None = section.get("zenoh")
    if zenoh is None or "config" not in zenoh.values:
        return ""
    path = folder / zenoh.get("config")
    warn_missing(path, zenoh.where("config"), out)
    return str(path)
