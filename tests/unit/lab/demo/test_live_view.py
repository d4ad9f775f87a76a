from __future__ import annotations

import io

import pytest
from rich.console import Console

from zsched_lab.demo.live_view import PlainLines, render
from zsched_lab.fleet.view import FleetView, MapView, NodeView, TaskView

EDGES = ("edge1", "edge2", "edge3")
ROBOTS = ("robot1", "robot2", "robot3")


def a_view(**changes: object) -> FleetView:
    nodes = tuple(NodeView(name=name, kind="robot", state="alive", cpu_ratio=0.3, link="wired") for name in ROBOTS)
    nodes += (
        NodeView(name="edge1", kind="edge", state="alive", cpu_ratio=1.0, memory_ratio=0.3, is_loaded=True),
        NodeView(name="edge2", kind="edge", state="alive", cpu_ratio=0.4, worker="ready", is_owner=True),
        NodeView(name="edge3", kind="edge", state="no answer"),
    )
    task = TaskView(
        name="map_merge",
        owner="edge2",
        epoch=3,
        since_s=12.4,
        phase="settled",
        candidates=EDGES,
        aggregates=tuple(zip(EDGES, (0.31, 0.92, 0.8), strict=True)),
        utilities=tuple((robot, (("edge1", 0.3), ("edge2", 0.82))) for robot in ROBOTS),
        votes=(("robot1", "edge2"),),
        reason="the owner leads",
    )
    maps = tuple(MapView(robot=name, maps=23, rate_hz=1.0, age_s=0.4, gap_max_s=1.6) for name in ROBOTS)
    fields: dict[str, object] = {
        "title": "zsched demo: malaga, known",
        "phase": "running",
        "elapsed_s": 20.0,
        "duration_s": 60.0,
        "nodes": nodes,
        "task": task,
        "maps": maps,
        "moves": 2,
        "events": tuple(f"event {index}" for index in range(50)),
    }
    return FleetView(**(fields | changes))  # type: ignore[arg-type]  # a test's shorthand


def drawn(view: FleetView, width: int, height: int) -> list[str]:
    console = Console(file=io.StringIO(), width=width, height=height, force_terminal=False)
    with console.capture() as capture:
        console.print(render(view, width, height))
    return capture.get().splitlines()


@pytest.mark.parametrize(("width", "height"), [(80, 24), (100, 30), (200, 60)])
def test_a_frame_fits_and_shows_the_story(width: int, height: int) -> None:
    lines = drawn(a_view(), width, height)

    text = "\n".join(lines)
    assert len(lines) <= height
    assert max(len(line) for line in lines) <= width
    assert "40 s left" in text
    assert "owner edge2, epoch 3, 12 s" in text
    assert ">edge2" in text
    assert "LOADED" in text
    assert "no answer" in text
    assert "1.0 Hz" in text
    assert "event 49" in text
    assert "joint" in text


def test_plain_lines_show_events_at_once_and_progress_every_ten_seconds() -> None:
    stream = io.StringIO()
    with PlainLines(stream) as view:
        for tenth in range(250):
            view.show(a_view(elapsed_s=tenth / 10))
        view.event(25.0, "map_merge moves edge1 -> edge2")

    lines = stream.getvalue().splitlines()
    assert [line.split()[0] for line in lines] == ["0.0", "10.0", "20.0", "25.0"]
    assert "owner edge2" in lines[0]
    assert "edge1 -> edge2" in lines[-1]
