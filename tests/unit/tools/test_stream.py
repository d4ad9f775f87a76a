"""`zsched stream`: rates out of two statuses, words into keys, statistics of what came."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self

import pytest

from support.fleets import fleet_of, node_of
from support.schemas import faults
from zsched.commands.base.ask import Door
from zsched.commands.base.common import CliError
from zsched.core.values.fleet import Cell, LocalSide
from zsched.core.values.in_force import InForce
from zsched.link.bus.stream_tap import Tapped
from zsched.runtime.access import StreamAccess
from zsched.tools import stream as stream_verb
from zsched.tools.stream import KeyStats, StreamView, _print_rates, _print_sample, keys_for, show_rates


def stream(name: str = "merge/in/0", messages: int = 10, size: int = 100, **more: Any) -> dict[str, Any]:
    found = {"stream": name, "messages": messages, "bytes": size, "drops": {}, "last_seen_s": 0.1}
    return found | {"from_expr": "robot1/map", "to_expr": "edge1/merge/robot1/map"} | more


def status(*streams: dict[str, Any]) -> dict[str, Any]:
    return {"node": "robot1", "tasks": [{"name": "merge", "owner": "edge1", "epoch": 3, "streams": list(streams)}]}


OUT: dict[str, Any] = {"name": "merge/out/0", "from_expr": "edge1/merge/3/all", "to_expr": "robot1/all"}


@pytest.mark.parametrize(("word", "is_told"), [("nosuch", True), ("robot1/*", False), ("merge/in/7", True)])
def test_a_word_that_touches_no_stream_is_told_with_those_that_there_are(
    word: str, capsys: pytest.CaptureFixture[str], *, is_told: bool
) -> None:
    assert keys_for(status(stream(), stream(**OUT)), word) == (word,)
    text = f"no stream here is called {word!r} or touches such a key (there are merge/in/0, merge/out/0): listening"
    told = capsys.readouterr().err
    assert told.startswith(text) if is_told else not told


def test_a_node_of_a_cell_is_no_place_to_listen_from_here() -> None:
    """Its status came through the gateway, and then a socket "." was asked for its data."""
    cell = Cell(name="hall-b", gateways=("tcp/127.0.0.1:1",))
    view = StreamView(door=Door(socket=Path(), endpoint="x", cell=cell), is_json=False, window_s=1.0)
    with pytest.raises(CliError, match="CELL/NODE: this verb joins the data network") as caught:
        show_rates(view, None, "hz")
    assert caught.value.code == 2


def test_streams_without_an_owner_lead_nowhere() -> None:
    idle = status(stream(from_expr="", to_expr=""))
    with pytest.raises(CliError, match="no owner"):
        keys_for(idle, "in/0")
    with pytest.raises(CliError, match="no streams"):
        keys_for(idle, None)


def test_statistics_of_a_key() -> None:
    stats = KeyStats(last_at=0.9)
    for size, at in ((100, 1.0), (300, 1.5), (200, 1.6)):
        stats.add(size, at)
    found = stats.as_json(2.0)
    assert (found["messages"], found["hz"], found["bytes_per_s"], found["mean_bytes"]) == (3, 1.5, 300.0, 200.0)
    assert (found["min_bytes"], found["max_bytes"]) == (100, 300)
    assert found["min_gap_s"] == pytest.approx(0.1)
    assert found["max_gap_s"] == pytest.approx(0.5)


def test_a_gap_of_one_key_counts_though_another_has_come_meanwhile(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A stream that was away for two windows looked as even as ever."""
    windows = iter([[("scan", 0.9), ("odom", 0.9)], [("odom", 1.9)], [("odom", 2.9)], [("scan", 3.9), ("odom", 3.9)]])

    class Tap:
        missed = 0

        def told(self, _done: str) -> str:
            return ""

        def __enter__(self) -> Self:
            return self

        def __exit__(self, *_: object) -> None:
            pass

        def until(self, _at: float) -> Iterator[SimpleNamespace]:
            for key, at in next(windows):
                yield SimpleNamespace(side="fleet", key=key, size=10, at=at)

    monkeypatch.setattr(stream_verb, "_tap", lambda _view, _word: Tap())
    view = StreamView(door=Door(socket=Path()), is_json=True, window_s=1.0, count=4)
    assert show_rates(view, None, "hz") == 0
    last = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert {one["key"]: one["max_gap_s"] for one in last["keys"]} == pytest.approx({"odom": 1.0, "scan": 3.0})


# --- the way to the data ---------------------------------------------------------------------------------------------

FLEET = fleet_of(
    of=(
        node_of("edge1", host="192.0.2.11", listen_data="tcp/0.0.0.0:7458"),
        node_of("robot1", local=LocalSide(connect=("tcp/127.0.0.1:7447",))),
        "robot2",
    ),
    tasks=(),
)


def access(me: str) -> StreamAccess:
    return StreamAccess(InForce(FLEET), me, ("tcp/127.0.0.1:9999",), "")


def test_the_own_relay_is_the_way_to_the_own_streams_and_the_local_side_is_another() -> None:
    found = access("robot1").answer("robot1")
    assert (found["via"], found["endpoints"], set(found["sides"])) == (
        "robot1",
        ["tcp/127.0.0.1:9999"],
        {"fleet", "local"},
    )
    assert json.loads(found["sides"]["local"])["connect"]["endpoints"] == ["tcp/127.0.0.1:7447"]


def test_the_local_side_of_a_secured_fleet_is_plain_text() -> None:
    secured = StreamAccess(
        InForce(FLEET), "robot1", ("tls/127.0.0.1:9999",), '{transport: {link: {protocols: ["tls"]}}}'
    )
    sides = {name: json.loads(text) for name, text in secured.answer("robot1")["sides"].items()}
    assert sides["fleet"]["transport"]["link"]["protocols"] == ["tls"]
    assert not sides["local"].get("transport", {}).get("link", {}).get("protocols"), "it dials tcp"


def test_another_node_is_dialled_where_the_file_says_how() -> None:
    found = access("robot1").answer("edge1")
    assert (found["via"], found["endpoints"]) == ("edge1", ["tcp/192.0.2.11:7458"])


def test_a_node_without_an_address_is_heard_through_this_one() -> None:
    found = access("robot1").answer("robot2")
    assert (found["via"], found["endpoints"]) == ("robot1", ["tcp/127.0.0.1:9999"])


# --- the verbs -------------------------------------------------------------------------------------------------------


def test_the_manual_shows_every_verb() -> None:
    manual = (Path(__file__).parents[3] / "docs" / "guide" / "cli.md").read_text()
    assert "| `zsched stream` |" in manual
    for verb in ("list", "hz", "bw", "tail"):
        assert f"zsched stream {verb}" in manual


# --- JSON ------------------------------------------------------------------------------------------------------------

VIEW = StreamView(door=Door(socket=Path()), is_json=True, window_s=1.0)


@pytest.mark.parametrize("verb", ["hz", "bw"])
def test_rates_are_printed_as_their_schemas_say(verb: str, capsys: pytest.CaptureFixture[str]) -> None:
    once, twice = KeyStats(), KeyStats()
    for stats, times in ((once, (1.0,)), (twice, (1.0, 1.5))):
        for at in times:
            stats.add(5, at)
    _print_rates(VIEW, verb, {("fleet", "robot1/in"): once, ("local", "robot1/in"): twice}, 3)
    body = json.loads(capsys.readouterr().out)
    assert (faults(body), len(body["keys"]), body["missed"]) == ([], 2, 3)


def test_a_message_is_printed_as_its_schema_says(capsys: pytest.CaptureFixture[str]) -> None:
    seen = Tapped(
        side="fleet",
        key="robot1/in",
        at=1.0,
        payload=b"hello",
        size=5,
        encoding="text/plain",
        kind="put",
        attachment_size=0,
    )
    _print_sample(VIEW, seen)
    body = json.loads(capsys.readouterr().out)
    assert (faults(body), body["head_hex"]) == ([], b"hello".hex())
