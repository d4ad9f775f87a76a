"""Checks of the streams of this machine's applications: does somebody publish, only one, and somebody listen?

Knows: counters of streams, keys of applications, a tap on the data network. Does not know: what is published.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from zsched.core.values.errors import AdapterError
from zsched.core.values.words import COUNTED_ANEW
from zsched.host.clock import monotonic_s
from zsched.link.bus.listeners import keys_with_listeners
from zsched.link.bus.stream_tap import StreamTap, Tapped
from zsched.tools.doctor.model import Json, Result, Scene, counted, failed, joined, passed, skipped, warned

YOUNG_S: Final = 60.0
"""In a fleet that has just started, streams have not begun."""
LISTEN_S: Final = 1.5
LOOK_S: Final = 1.0
"""In this time a new session knows who subscribes; on one machine it takes some milliseconds."""
RELAY_FIX: Final = "journalctl -u zsched -u zsched-relay says what became of the relay"


def inputs_have_publishers(scene: Scene) -> Result:
    """Whether each input of this machine has had a message, on the key that it has now."""
    streams = list(_carried(scene, "/in/"))
    if not streams:
        return skipped(f"{scene.node} carries no inputs")
    if (young := _young(scene)) is not None:
        return young
    found = []
    for task, stream in streams:
        if stream["last_seen_s"] is None and task["owner"] is not None:
            told = f"{stream['stream']}: nobody has published {stream['from_expr'] or 'its key'} on {scene.node}"
            told += f" {COUNTED_ANEW}" if stream["messages"] else ""
            found.append(warned(told, fix=f"the application must put that key, and dial {_joins_at(scene)}"))
    return joined(found, passed(f"{counted(len(streams), 'inputs')}, each has had messages"))


def outputs_have_listeners(scene: Scene) -> Result:
    """Whether somebody subscribes to what each output of this machine puts."""
    carried = (stream for _, stream in _carried(scene, "/out/"))
    outputs = {str(stream["to_expr"]): str(stream["stream"]) for stream in carried if stream["to_expr"]}
    if not outputs or not scene.sides:
        return skipped(f"{scene.node} carries no outputs")
    if (young := _young(scene)) is not None:
        return young
    try:
        # applications are on the machine's own side, where it has one
        heard = keys_with_listeners(scene.sides.get("local", scene.sides["fleet"]), sorted(outputs), LOOK_S)
    except AdapterError as error:
        return failed(str(error), fix=RELAY_FIX)
    fix = f"the application must subscribe to that key, and dial {_joins_at(scene)}"
    found = [
        warned(f"{stream}: nobody on {scene.node} subscribes to {key}", fix=fix)
        for key, stream in sorted(outputs.items())
        if key not in heard
    ]
    return joined(found, passed(f"{counted(len(outputs), 'outputs')}, each has a subscriber"))


def _carried(scene: Scene, way: str) -> Iterable[tuple[Json, Json]]:
    """(task, stream) of each stream of this machine that goes this ``way``: ``/in/``, ``/out/``."""
    return ((task, one) for task in scene.status["tasks"] for one in task["streams"] if way in one["stream"])


def _young(scene: Scene) -> Result | None:
    up_s = float(scene.status["up_s"])
    return skipped(f"the daemon has been up for {up_s:.0f} s only") if up_s < YOUNG_S else None


def _joins_at(scene: Scene) -> str:
    return ", ".join(scene.status.get("joins_at") or ()) or "where zsched status says that applications join"


def keys_have_one_publisher(scene: Scene) -> Result:
    """Whether each key of an input has one publisher, as far as publishers tell who they are."""
    keys = sorted(set(_keys(scene)))
    if not keys or not scene.sides:
        return skipped(f"{scene.node} carries no inputs whose keys stand for one publisher each")
    try:
        with StreamTap(scene.sides, keys) as tap:
            return judged_sources(tap.until(monotonic_s() + LISTEN_S))
    except AdapterError as error:
        return failed(str(error), fix=RELAY_FIX)


def _keys(scene: Scene) -> Iterable[str]:
    """Where applications put inputs; a wildcard may stand for many publishers by right."""
    for _, stream in _carried(scene, "/in/"):
        if stream["from_expr"] and "*" not in stream["from_expr"]:
            yield str(stream["from_expr"])


def judged_sources(samples: Iterable[Tapped]) -> Result:
    """What was heard, by key and publisher."""
    sources: dict[str, set[str]] = {}
    untold: set[str] = set()
    for sample in samples:
        sources.setdefault(sample.key, set())
        if sample.source:
            sources[sample.key].add(sample.source)
        else:
            untold.add(sample.key)
    found = []
    for key, names in sorted(sources.items()):
        if len(names) > 1:
            fix = f"only one program may publish {key}: stop the other, or give it another key"
            found.append(warned(f"{key} has {len(names)} publishers: {', '.join(sorted(names))}", fix=fix))
    told = f"{counted(len(sources), 'keys')} with messages within {LISTEN_S:g} s"
    if untold:
        told += f"; the publishers of {', '.join(sorted(untold))} do not tell who they are"
    return joined(found, passed(told) if len(untold) < len(sources) or not sources else skipped(told))
