"""Decides what the `ros2:` section of a task says: topics and services by their ROS names, as ordinary rules.

Knows: the section's keys, how names become key templates. Does not know: YAML, what makes a rule a good one
(`zsched.config.tasks` judges these like any other).

Each entry names the robots' side (`topic`, `service`) and the worker's: either another ROS name (`worker_topic`: the
worker is a ROS node) or a plain key (`worker_key`: it is a zenoh program). An action is five such entries in one,
between ROS nodes only.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Final

from zsched.config.blocks import Choice, Field, Here, ListOf, Located, Number, Record, Section, Text, Whole
from zsched.config.reader import Collector
from zsched.core.route.ros2 import (
    ACTION_PARTS,
    ANY,
    MAX_DOMAIN,
    ActionPart,
    action_type_fault,
    hash_fault,
    name_fault,
    node_name_fault,
    ros_key,
    type_fault,
)
from zsched.core.route.route import placeholders
from zsched.core.route.templates import template_fault
from zsched.core.values.model import NodeId
from zsched.core.values.plan import Direction, RosGraph, StreamClass

_BRIDGES: Final = {str(graph): graph for graph in (RosGraph.RMW_ZENOH, RosGraph.ROS2DDS)}
_NAME: Final = Text("a ROS name", name_fault, 'for example "/{robot}/map"')
_KEY: Final = Text("a key template", lambda text: None if len(text) <= 4096 else "it is too long")
_MAX_TIMEOUT_S: Final = 3600.0
"""Of a service (`zsched.core.values.plan.ServiceSettings`): a goal may work this long before its result is there."""


def ros2_record(rule: Record, service: Record) -> Record:
    """The schema of a `ros2:` section; everything but the keys is as in the plain records ``rule`` and ``service``."""
    return Record(
        "a ros2 section",
        {
            "bridge": Field(Choice(_BRIDGES), "How the nodes speak zenoh.", default=f"`{RosGraph.RMW_ZENOH}`"),
            "domain": Field(Whole(0, MAX_DOMAIN), "ROS_DOMAIN_ID (rmw_zenoh).", default="`0`"),
            "inputs": Field(
                ListOf(_entry("a ROS topic", "topic", rule)), "Topics from the robots' nodes to the worker."
            ),
            "outputs": Field(
                ListOf(_entry("a ROS topic", "topic", rule)), "Topics from the worker to the robots' nodes."
            ),
            "services": Field(ListOf(_entry("a ROS service", "service", service)), "Services that the worker offers."),
            "actions": Field(
                ListOf(_action(service)), "Actions that the worker offers: three services and two topics."
            ),
        },
    )


def _action(service: Record) -> Record:
    rest = {name: item for name, item in service.items.items() if name not in ("from", "to")}
    return Record(
        "a ROS action",
        {
            "action": Field(Here(_NAME), "The name that the robot's nodes use.", required=True),
            "type": Field(
                Here(Text("a ROS action type", action_type_fault)), "As `nav2_msgs/action/Spin`.", default="`any`"
            ),
            "worker_action": Field(Here(_NAME), "The name that the worker uses, a ROS node.", required=True),
            "result_timeout_s": Field(
                Number(0.05, _MAX_TIMEOUT_S, "s"),
                "How long a goal may work; `timeout_s` is of the other two services.",
                default=f"`{_MAX_TIMEOUT_S:g}`",
            ),
            **rest,
        },
    )


def _entry(what: str, word: str, plain: Record) -> Record:
    fault = partial(type_fault, is_service=word == "service")
    rest = {name: item for name, item in plain.items.items() if name not in ("from", "to")}
    return Record(
        what,
        {
            word: Field(Here(_NAME), "The name that the robot's nodes use.", required=True),
            "type": Field(Here(Text("a ROS type", fault)), "As `nav_msgs/msg/OccupancyGrid`.", default="`any`"),
            "hash": Field(Here(Text("a type hash", hash_fault)), "As in the key of rmw_zenoh.", default="`any`"),
            f"worker_{word}": Field(Here(_NAME), "The name that the worker uses, a ROS node."),
            "worker_key": Field(Here(_KEY), "Or its key, when it is a plain zenoh program."),
            **rest,
        },
    )


def ros2_rules(
    given: Section, robots: tuple[NodeId, ...], candidates: tuple[NodeId, ...], out: Collector
) -> Iterator[tuple[Direction, Section]]:
    """Each entry as the section of a plain rule: inputs, outputs, services, and then the five of each action."""
    graph: RosGraph = given.get("bridge", RosGraph.RMW_ZENOH)
    if graph is RosGraph.ROS2DDS and "domain" in given.places:
        out.error(
            given.where("domain"), "the bridge's keys have no domain: the bridge itself belongs to one", "delete it"
        )
    domain = given.get("domain", 0)
    for direction in Direction:
        word = "service" if direction is Direction.SERVICE else "topic"
        for entry in given.get(f"{direction}s", ()):
            ends = _ends(entry, word, direction, graph, domain, out)
            if ends is None:
                continue
            _check_node_names(entry, word, robots, candidates, out)
            yield direction, _plain(entry, word, direction, graph, ends)
    for entry in given.get("actions", ()):
        if graph is RosGraph.ROS2DDS and "type" in entry.places:
            out.error(entry.where("type"), "the bridge's keys have none", "delete it")
        elif entry.is_whole and _is_named(entry, robots, candidates, out):
            for part in ACTION_PARTS:
                yield _part(entry, part, graph, domain)


def _is_named(entry: Section, robots: tuple[NodeId, ...], candidates: tuple[NodeId, ...], out: Collector) -> bool:
    """Whether both names of an action may stand in rules: judged once, not in each of its five."""
    before = out.count
    for field, side in (("action", "from"), ("worker_action", "to")):
        held: Located[str] = entry.get(field)
        problem = template_fault(held.value.removeprefix("/"), Direction.SERVICE, side)
        if problem is not None:
            out.error(held.place, f"{held.value!r}: {problem}")
    _check_node_names(entry, "action", robots, candidates, out)
    return out.count == before


def _part(entry: Section, part: ActionPart, graph: RosGraph, domain: int) -> tuple[Direction, Section]:
    """One of an action's five as the section of a plain rule.

    Its result and the end of a goal may be asked for twice, so the next owner is asked when the old one has not
    answered: it says that it does not know the goal. The status is latched (transient local, depth 1).
    """
    action_type = entry.get("type", Located(ANY, entry.place)).value

    def end(held: Located[str]) -> Located[str]:
        name = f"{held.value.rstrip('/')}/_action/{part.word}"
        return Located(ros_key(graph, name, domain=domain, type_name=part.type_name(action_type)), held.place)

    ends = end(entry.get("action")), end(entry.get("worker_action"))
    direction = Direction.SERVICE if part.is_service else Direction.OUTPUT
    rest = entry if part.is_service else Section(place=entry.place)
    rule = _plain(rest, "action", direction, graph, ends)
    if part.word == "status":
        rule.values["class"] = StreamClass.LATEST
    elif part.word == "get_result":
        rule.values |= {"retry": True, "timeout_s": entry.get("result_timeout_s", _MAX_TIMEOUT_S)}
    elif part.word == "cancel_goal":
        rule.values["retry"] = True
    return direction, rule


def _ends(
    entry: Section, word: str, direction: Direction, graph: RosGraph, domain: int, out: Collector
) -> tuple[Located[str], Located[str]] | None:
    """(the robots' key template, the worker's); ``None``, and reported, when they cannot be told."""
    name: Located[str] | None = entry.get(word)
    other: Located[str] | None = entry.get(f"worker_{word}")
    key: Located[str] | None = entry.get("worker_key")
    if len({f"worker_{word}", "worker_key"} & set(entry.places)) != 1:
        out.error(entry.place, f"say one of worker_{word} and worker_key: what the worker's side is called")
        return None
    type_name = entry.get("type", Located(ANY, entry.place))
    type_hash = entry.get("hash", Located(ANY, entry.place))
    if not entry.is_whole or name is None:
        return None
    if graph is RosGraph.ROS2DDS and {"type", "hash"} & set(entry.places):
        out.error(entry.where("type" if "type" in entry.places else "hash"), "the bridge's keys have none", "delete it")
        return None
    is_open = ANY in (type_name.value, type_hash.value) and graph is RosGraph.RMW_ZENOH
    if direction is Direction.OUTPUT and key is not None and is_open:
        hint = "in a running system: ros2 topic info --verbose"
        out.error(name.place, "a plain key has neither type nor hash: say both, the robots' nodes need them", hint)
        return None

    if name.value.endswith("/**") and type_name.value == ANY and key is not None and "*" in key.value:
        what = f"where {word} ends in '**' and its type is open, it cannot be told where the name ends"
        out.error(name.place, what, f"say the type, or worker_{word} in place of worker_key")
        return None

    def made(held: Located[str]) -> Located[str]:
        text = ros_key(graph, held.value, domain=domain, type_name=type_name.value, type_hash=type_hash.value)
        return Located(text, held.place)

    worker = key if key is not None else made(other) if other is not None else None
    return None if worker is None else (made(name), worker)


def _check_node_names(
    entry: Section, word: str, robots: tuple[NodeId, ...], candidates: tuple[NodeId, ...], out: Collector
) -> None:
    """Names of nodes that stand in ROS names must be fit for it."""
    for field in (word, f"worker_{word}"):
        held: Located[str] | None = entry.get(field)
        if held is None:
            continue
        used = set(placeholders(held.value))
        if "epoch" in used:
            out.error(held.place, f"{held.value!r}: an epoch is a number, which no part of a ROS name may begin with")
        nodes = {*(robots if used & {"robot", "node"} else ()), *(candidates if "target" in used else ())}
        for node in sorted(nodes):
            problem = node_name_fault(node)
            if problem is not None:
                out.error(held.place, f"{held.value!r}: the node {node!r} would stand in a ROS name: {problem}")
                return


def _plain(
    entry: Section, word: str, direction: Direction, graph: RosGraph, ends: tuple[Located[str], Located[str]]
) -> Section:
    source, goal = ends[::-1] if direction is Direction.OUTPUT else ends
    own = (word, f"worker_{word}", "worker_key", "type", "hash", "result_timeout_s")
    values = {name: value for name, value in entry.values.items() if name not in own}
    places = {name: place for name, place in entry.places.items() if name not in own}
    values |= {"from": source, "to": goal, "graph": graph}
    places |= {"from": source.place, "to": goal.place}
    return Section(place=entry.place, values=values, places=places)
