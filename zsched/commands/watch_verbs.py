"""The verbs that look on for as long as they run: `top`, `web`, `record`, `trace`: arguments in, exit code out.

Knows: options. Does not know: how anything is done (`zsched.commands.watch`, imported by the verb that runs).
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from zsched.commands.options import Asks, Local, NoColorOption


def top(
    asked: Asks,
    once: Annotated[bool, typer.Option("--once", help="Print one screen and exit, as status does.")] = False,
    interval: Annotated[float, typer.Option(min=0.2, max=3600.0, metavar="S", help="Seconds between two.")] = 1.0,
    no_color: NoColorOption = False,
) -> None:
    """Show the fleet on the full screen: nodes, utilities over time, streams, the last moves; q ends."""
    from zsched.commands.watch.screen import TopView  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.watch.screen import top as show  # noqa: PLC0415 - as above

    raise typer.Exit(show(TopView(find=asked.door, is_plain=no_color, interval_s=interval), is_once=once))


def web(
    asked: Asks,
    listen: Annotated[
        str, typer.Option("--listen", metavar="ADDRESS:PORT", help="Where; beyond this machine only with a token.")
    ] = "127.0.0.1:7459",
    token_file: Annotated[
        Path | None,
        typer.Option("--token-file", metavar="FILE", help="Readers must know its only word. [ZSCHED_WEB_TOKEN]"),
    ] = None,
    host: Annotated[
        list[str] | None,
        typer.Option("--host", metavar="NAME", help="Browsers may call this server so, besides its addresses."),
    ] = None,
) -> None:
    """Serve a page that shows the fleet live, and Prometheus' figures under /metrics; it changes nothing.

    It asks one daemon once a second, however many look; a daemon that is not there is waited for.
    """
    from zsched.commands.watch.web import WebView  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.watch.web import web as serve  # noqa: PLC0415 - as above

    raise typer.Exit(serve(WebView(find=asked.door, listen=listen, token_file=token_file, hosts=tuple(host or ()))))


def record(
    asked: Asks,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="A new file, as run.mcap.")],
    for_: Annotated[
        str | None, typer.Option("--for", metavar="DURATION", help="How long: 90s, 10m, 2h. [until Ctrl-C]")
    ] = None,
    interval: Annotated[float, typer.Option(min=0.1, max=3600.0, metavar="S", help="Seconds between two.")] = 1.0,
    map_: Annotated[
        list[str] | None,
        typer.Option(
            "--map", metavar="KEY", help="A key whose samples are maps (OccupancyGrid, CDR) is recorded, too."
        ),
    ] = None,
    tf: Annotated[
        list[str] | None,
        typer.Option("--tf", metavar="KEY", help="The same of a key whose samples are frames (TFMessage, CDR)."),
    ] = None,
) -> None:
    """Record what the fleet does as MCAP, for Foxglove: owners, utilities, moves, streams, events, maps, tf.

    Needs the extra mcap. Maps and frames on ROS topics are found by their type.
    """
    from zsched.commands.history import duration_s  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.watch.record import RecordView  # noqa: PLC0415 - as above
    from zsched.commands.watch.record import record as write  # noqa: PLC0415 - as above

    view = RecordView(
        find=asked.door,
        file=output,
        interval_s=interval,
        for_s=None if for_ is None else duration_s(for_),
        maps=tuple(map_ or ()),
        frames=tuple(tf or ()),
    )
    raise typer.Exit(write(view))


def trace(
    asked: Local,
    otlp: Annotated[
        str, typer.Option("--otlp", metavar="URL", help="An OpenTelemetry collector (OTLP over HTTP).")
    ] = "http://127.0.0.1:4318",
    since: Annotated[
        str | None, typer.Option("--since", metavar="AGE", help="Also moves not older: 90s, 10m, 2h, 1d.")
    ] = None,
    once: Annotated[bool, typer.Option("--once", help="Only what the decision log holds, then end.")] = False,
) -> None:
    """Send a trace span for each move in this machine's decision log to an OpenTelemetry collector.

    Needs the extra trace. Exits with 1 when the collector refused one.
    """
    from zsched.commands.history import duration_s  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.watch.trace import TraceView  # noqa: PLC0415 - as above
    from zsched.commands.watch.trace import trace as send  # noqa: PLC0415 - as above

    since_s = None if since is None else duration_s(since)
    view = TraceView(find=asked.door, url=otlp, since_s=since_s, is_once=once)
    raise typer.Exit(send(view))
