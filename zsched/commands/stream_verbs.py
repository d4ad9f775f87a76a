"""The verbs below `zsched stream`: arguments in, exit code out.

Knows: options. Does not know: how anything is done (`zsched.commands.stream`, imported by the verb that runs).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from zsched.commands.common import Verb, Verbs
from zsched.commands.options import ConnectOption, JsonOption, RuntimeOption

stream_app = typer.Typer(
    name="stream",
    cls=Verbs,
    help="What flows where right now, for any node.",
    no_args_is_help=True,
    rich_markup_mode=None,
)

KeyArgument = Annotated[
    str | None,
    typer.Argument(metavar="[KEY]", help="A stream (map_merge/in/0, in/0) or a key expression. [the robot's own keys]"),
]
NodeOption = Annotated[
    str | None, typer.Option("--node", "-n", metavar="NAME", help="At this node, here or anywhere in the fleet.")
]
WindowOption = Annotated[float, typer.Option("--window", min=0.1, max=3600.0, metavar="S", help="Seconds to look at.")]
CountOption = Annotated[
    int | None, typer.Option("--count", min=1, metavar="N", help="End after N of them. [go on until Ctrl-C]")
]


@stream_app.command("list", cls=Verb)
def list_(
    key: KeyArgument = None,
    node: NodeOption = None,
    json_: JsonOption = False,
    window: WindowOption = 2.0,
    runtime_dir: RuntimeOption = None,
    connect: ConnectOption = None,
) -> None:
    """List a node's streams: from where to where, how fast, and what was dropped."""
    from zsched.commands.stream import StreamView, show_list  # noqa: PLC0415 - each verb imports what it needs

    view = StreamView(runtime_dir=runtime_dir, node=node, is_json=json_, window_s=window, connect=connect)
    raise typer.Exit(show_list(view, key))


@stream_app.command(cls=Verb)
def hz(
    key: KeyArgument = None,
    node: NodeOption = None,
    json_: JsonOption = False,
    window: WindowOption = 2.0,
    count: CountOption = None,
    runtime_dir: RuntimeOption = None,
) -> None:
    """Show how often something comes on each key, and the shortest and longest gap.

    Of a stream, both its ends are shown. Exits with 1 when nothing came in the last window.
    """
    _rates("hz", key, node, json_=json_, window=window, count=count, runtime_dir=runtime_dir)


@stream_app.command(cls=Verb)
def bw(
    key: KeyArgument = None,
    node: NodeOption = None,
    json_: JsonOption = False,
    window: WindowOption = 2.0,
    count: CountOption = None,
    runtime_dir: RuntimeOption = None,
) -> None:
    """Show how many bytes per second come on each key, and the smallest and largest message."""
    _rates("bw", key, node, json_=json_, window=window, count=count, runtime_dir=runtime_dir)


@stream_app.command(cls=Verb)
def tail(
    key: KeyArgument = None,
    node: NodeOption = None,
    json_: JsonOption = False,
    count: CountOption = None,
    timeout: Annotated[
        float | None, typer.Option("--timeout", min=0.1, metavar="S", help="End after S seconds. [go on until Ctrl-C]")
    ] = None,
    runtime_dir: RuntimeOption = None,
) -> None:
    """Print every message as it comes: key, size, encoding, the first bytes.

    Exits with 1 when nothing came within the timeout.
    """
    from zsched.commands.stream import StreamView, show_tail  # noqa: PLC0415 - each verb imports what it needs

    view = StreamView(runtime_dir=runtime_dir, node=node, is_json=json_, window_s=1.0, count=count, timeout_s=timeout)
    raise typer.Exit(_until_interrupted(lambda: show_tail(view, key)))


def _rates(
    verb: str,
    key: str | None,
    node: str | None,
    *,
    json_: bool,
    window: float,
    count: int | None,
    runtime_dir: Path | None,
) -> None:
    from zsched.commands.stream import StreamView, show_rates  # noqa: PLC0415 - each verb imports what it needs

    view = StreamView(runtime_dir=runtime_dir, node=node, is_json=json_, window_s=window, count=count)
    raise typer.Exit(_until_interrupted(lambda: show_rates(view, key, verb)))


def _until_interrupted(work: Callable[[], int]) -> int:
    """Ctrl-C is how these verbs are meant to end."""
    try:
        return work()
    except KeyboardInterrupt:
        return 0
