"""Shows the running fleet: a full-screen view on a terminal, plain lines otherwise.

Knows: how a `FleetView` looks in 100 x 30 characters, and in 80 x 24. Does not know: where its values come from.
"""

from __future__ import annotations

import math
import sys
import textwrap
from types import TracebackType
from typing import Protocol, Self, TextIO

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from zsched_lab.demo.map_panel import map_panel
from zsched_lab.fleet.view import FleetView, MapView, NodeView, TaskView
from zsched_lab.maps.picture import MapPicture

PROGRESS_PERIOD_S = 10.0
WIDE = 96
"""From this many columns on the bars are long."""
WIDEST = 160
"""From this many columns on the maps' table has all its words, in half of them."""
SHORT_NAMES = ("robot", "maps", "rate", "age", "gap", "drive")


class View(Protocol):
    """Where the run is shown; a context, so that the terminal is given back whatever happens."""

    def show(self, view: FleetView) -> None:
        """Show the fleet as it is now."""

    def event(self, t_s: float, text: str) -> None:
        """Tell one thing that happened, ``t_s`` seconds after the start."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...


class PlainLines:
    """One line per event, and one of progress every 10 s."""

    def __init__(self, stream: TextIO | None = None) -> None:
        self._stream = stream or sys.stdout
        self._next_s = 0.0

    def show(self, view: FleetView) -> None:
        """Print the progress line when it is due."""
        if view.phase != "running" or view.elapsed_s < self._next_s:
            return
        self._next_s = (view.elapsed_s // PROGRESS_PERIOD_S + 1) * PROGRESS_PERIOD_S
        self.event(view.elapsed_s, progress_line(view))

    def event(self, t_s: float, text: str) -> None:
        """Print the event."""
        self._stream.write(f"{t_s:6.1f} s  {text}\n")
        self._stream.flush()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return None


def progress_line(view: FleetView) -> str:
    """The run in one line."""
    owner = view.task.owner if view.task else None
    alive = sum(node.state == "alive" for node in view.nodes)
    return (
        f"progress {100 * ratio_done(view):.0f} %: owner {owner or 'none yet'}, "
        f"epoch {view.task.epoch if view.task else 0}, nodes {alive} of {len(view.nodes)}, "
        f"maps at robots {rates(view.maps)}, {remaining(view)}"
    )


class LiveScreen:
    """The full-screen view; `event` lines are shown in its last panel (the caller puts them into the view)."""

    def __init__(self, console: Console) -> None:
        self._live = Live(console=console, screen=True, auto_refresh=False, vertical_overflow="crop")
        self._console = console

    def show(self, view: FleetView) -> None:
        """Redraw."""
        self._live.update(render(view, self._console.width, self._console.height), refresh=True)

    def event(self, t_s: float, text: str) -> None:
        """Nothing to do: the next `show` has it."""

    def __enter__(self) -> Self:
        self._live.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._live.__exit__(kind, error, trace)


def make_view(*, headless: bool) -> View:
    """The full screen when stdout is a terminal of at least 80 x 24 and nobody asked otherwise; else plain lines."""
    console = Console()
    if headless or not console.is_terminal or console.is_dumb_terminal or console.width < 80 or console.height < 24:
        return PlainLines()
    return LiveScreen(console)


# --- one frame -------------------------------------------------------------------------------------------------------


def render(view: FleetView, width: int, height: int) -> RenderableType:
    """One frame of ``height`` lines at most: nodes and the task, below them the map, and beside it what robots see."""
    wide = width >= WIDE
    middle = halves()
    middle.add_row(nodes_panel(view.nodes, wide=wide), task_panel(view.task))
    rows = max(len(view.nodes) + 1, task_rows(view.task)) + 2
    left = height - 2 - rows
    columns = width // 2
    table_rows = len(view.maps) + 3
    beside: list[RenderableType] = [maps_panel(view.maps, wide=width >= WIDEST)]
    if left - table_rows >= 3:
        beside.append(events_panel(view, width - columns - 2, left - table_rows - 2))
    bottom = halves()
    bottom.add_row(map_panel(newest_picture(view.maps), columns, max(3, left)), Group(*beside))
    return Group(header(view), middle, bottom)


def halves() -> Table:
    """Two columns of the same width."""
    grid = Table.grid(expand=True, padding=0)
    grid.add_column(ratio=1)
    grid.add_column(ratio=1)
    return grid


def newest_picture(maps: tuple[MapView, ...]) -> MapPicture | None:
    """The map of the robot that has heard the newest one."""
    seen = [row for row in maps if row.picture is not None]
    return min(seen, key=lambda row: math.inf if row.age_s is None else row.age_s).picture if seen else None


def header(view: FleetView) -> RenderableType:
    """Title on the left, time on the right, the progress bar below."""
    line = Table.grid(expand=True)
    line.add_column(no_wrap=True, overflow="ellipsis", ratio=1)
    line.add_column(justify="right", no_wrap=True)
    moves = f"{view.moves} move{'s' if view.moves != 1 else ''}"
    line.add_row(Text(view.title, style="bold"), f"{view.phase}, {moves}, {remaining(view)} ")
    bar = Table.grid(expand=True)  # a bare bar ends without a line feed
    bar.add_row(ProgressBar(total=1.0, completed=ratio_done(view)))
    return Group(line, bar)


def ratio_done(view: FleetView) -> float:
    """How much of the run is over, 0 to 1."""
    return min(1.0, max(0.0, view.elapsed_s / view.duration_s)) if view.duration_s > 0 else 1.0


def remaining(view: FleetView) -> str:
    """The time left in words."""
    return f"{max(0.0, math.ceil(view.duration_s - view.elapsed_s)):.0f} s left"


def nodes_panel(nodes: tuple[NodeView, ...], *, wide: bool) -> RenderableType:
    """Nodes with CPU, memory, link and worker."""
    table = Table(box=None, expand=True, padding=(0, 1, 0, 0), header_style="dim")
    table.add_column("node", no_wrap=True)
    table.add_column("cpu", no_wrap=True)
    table.add_column("mem", justify="right", no_wrap=True)
    table.add_column("link", no_wrap=True)
    table.add_column("state", no_wrap=True, overflow="ellipsis")
    for node in nodes:
        bar = cpu_bar(node.cpu_ratio, 8 if wide else 4)
        table.add_row(node_name(node), bar, percent(node.memory_ratio), node.link or "-", node_state(node))
    return Panel(table, title="nodes", title_align="left", padding=(0, 0))


def node_name(node: NodeView) -> Text:
    """The name, marked when it owns the task."""
    return Text(f"{'>' if node.is_owner else ' '}{node.name}", style="bold green" if node.is_owner else "")


def node_state(node: NodeView) -> Text:
    """Its state; the load we inject and a worker that is not ready come first, they are the story."""
    if node.state != "alive":
        return Text(node.state, style="red")
    if node.is_loaded:
        return Text("LOADED", style="bold yellow")
    if node.worker and node.worker != "ready":
        return Text(f"worker {node.worker}", style="yellow")
    return Text("owner" if node.is_owner else "alive", style="green" if node.is_owner else "")


def cpu_bar(ratio: float | None, width: int) -> Text:
    """A bar and the percentage; dashes when nobody measured."""
    if ratio is None:
        return Text("-" * width + "   - ", style="dim")
    full = round(min(1.0, ratio) * width)
    style = "red" if ratio > 0.9 else "yellow" if ratio > 0.6 else "green"
    return Text.assemble(("█" * full, style), ("░" * (width - full), "dim"), f" {percent(ratio):>4}")


def percent(ratio: float | None) -> str:
    """A ratio in percent, or a dash."""
    return "-" if ratio is None else f"{100 * ratio:.0f}%"


def task_rows(task: TaskView | None) -> int:
    """Lines inside the task's panel."""
    return 1 if task is None else len(task.utilities) + 4


def task_panel(task: TaskView | None) -> RenderableType:
    """Utilities per voter, the aggregate with the owner's bonus, the votes, and why."""
    if task is None:
        return Panel("waiting for the first answer", title="task", title_align="left", padding=(0, 0))
    table = Table(box=None, expand=True, padding=(0, 1, 0, 0), header_style="dim")
    table.add_column("utility", no_wrap=True)
    for candidate in task.candidates:
        style = "bold green" if candidate == task.owner else ""
        table.add_column(candidate, justify="right", no_wrap=True, style=style)
    table.add_column("vote", no_wrap=True)
    votes = dict(task.votes)
    for voter, row in task.utilities:
        values = dict(row)
        table.add_row(voter, *(decimal(values.get(name)) for name in task.candidates), votes.get(voter, "-"))
    totals = dict(task.aggregates)
    table.add_row(Text("joint", style="bold"), *(decimal(totals.get(name)) for name in task.candidates), "")
    since = f", {task.since_s:.0f} s" if task.since_s is not None else ""
    where = Text(f"owner {task.owner or 'none'}, epoch {task.epoch}{since}, {task.phase}", no_wrap=True)
    why = Text(task.reason, style="dim", no_wrap=True, overflow="ellipsis")
    return Panel(Group(where, table, why), title=f"task {task.name}", title_align="left", padding=(0, 0))


def decimal(value: float | None) -> str:
    """A utility, or a dash when it is absent."""
    return "-" if value is None else f"{value:.2f}"


def maps_panel(maps: tuple[MapView, ...], *, wide: bool) -> RenderableType:
    """What the robots see of the merged map, and how far they have driven."""
    table = Table(box=None, expand=True, padding=(0, 1, 0, 0), header_style="dim")
    names = ("robot", "merged maps", "rate", "age", "longest gap", "drive") if wide else SHORT_NAMES
    for column in names:
        table.add_column(column, no_wrap=True)
    for row in maps:
        rate = "-" if row.rate_hz is None else f"{row.rate_hz:.1f} Hz"
        table.add_row(row.robot, str(row.maps), rate, seconds(row.age_s), seconds(row.gap_max_s), drive(row, wide=wide))
    return Panel(table, title="as the robots see it", title_align="left", padding=(0, 0))


def drive(row: MapView, *, wide: bool) -> str:
    """How much of its laser log a robot has driven."""
    if not row.scans_total:
        return "-"
    share = f"{100 * row.scans / row.scans_total:.0f}%"
    return f"{share} ({row.scans} of {row.scans_total} scans)" if wide else share


def seconds(value: float | None) -> str:
    """A duration, or a dash."""
    return "-" if value is None else f"{value:.1f} s"


def rates(maps: tuple[MapView, ...]) -> str:
    """The robots' map rates in a few characters."""
    return "/".join("-" if row.rate_hz is None else f"{row.rate_hz:.1f}" for row in maps) + " Hz"


def events_panel(view: FleetView, columns: int, lines: int) -> RenderableType:
    """The newest events, each with all its words; problems that exist now come first."""
    shown = [Text(problem, style="red", no_wrap=True, overflow="ellipsis") for problem in view.problems]
    shown = shown[: max(1, lines // 3)]
    room = lines - len(shown)
    told: list[Text] = []
    for event in reversed(view.events):
        folded = textwrap.wrap(event.strip(), columns, subsequent_indent="  ")[: room - len(told)]
        told[:0] = [Text(line) for line in folded]
        if len(told) >= room:
            break
    shown += told
    shown += [Text("")] * (lines - len(shown))
    return Panel(Group(*shown), title="events", title_align="left", padding=(0, 0))
