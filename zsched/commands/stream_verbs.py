"""The verbs below `zsched stream`: arguments in, exit code out.

Knows: options. Does not know: how anything is done (`zsched.commands.stream`, imported by the verb that runs).
"""

from __future__ import annotations

import contextlib
from typing import Annotated

import typer

from zsched.commands.options import Answers, AskedOption, JsonOption, Local, new_group

KeyArgument = Annotated[
    str | None,
    typer.Argument(metavar="[KEY]", help="A stream (map_merge/in/0, in/0) or a key expression. [the robot's own keys]"),
]
WindowOption = Annotated[float, typer.Option("--window", min=0.1, max=3600.0, metavar="S", help="Seconds to look at.")]
CountOption = Annotated[
    int | None, typer.Option("--count", min=1, metavar="N", help="End after N of them. [go on until Ctrl-C]")
]


class Tap(Local):
    """Where samples are listened to, how many, and how they are shown."""

    json_: JsonOption = False
    count: CountOption = None
    node: AskedOption = None

    def run(self, verb: str, key: str | None, window: float = 1.0, timeout: float | None = None) -> None:
        """Until there were enough, or Ctrl-C: that is how these verbs are meant to end."""
        from zsched.commands import stream  # noqa: PLC0415 - each verb imports what it needs

        door, code = self.door(), 0
        view = stream.StreamView(door=door, is_json=self.json_, window_s=window, count=self.count, timeout_s=timeout)
        with contextlib.suppress(KeyboardInterrupt):
            code = stream.show_tail(view, key) if verb == "tail" else stream.show_rates(view, key, verb)
        raise typer.Exit(code)


def list_(asked: Answers, key: KeyArgument = None, window: WindowOption = 2.0) -> None:
    """List a node's streams: from where to where, how fast, and what was dropped."""
    from zsched.commands.stream import StreamView, show_list  # noqa: PLC0415 - each verb imports what it needs

    raise typer.Exit(show_list(StreamView(door=asked.door(), is_json=asked.json_, window_s=window), key))


def hz(tap: Tap, key: KeyArgument = None, window: WindowOption = 2.0) -> None:
    """Show how often something comes on each key, and the shortest and longest gap.

    Of a stream, both its ends are shown. Exits with 1 when nothing came in the last window.
    """
    tap.run("hz", key, window)


def bw(tap: Tap, key: KeyArgument = None, window: WindowOption = 2.0) -> None:
    """Show how many bytes per second come on each key, and the smallest and largest message."""
    tap.run("bw", key, window)


def tail(
    tap: Tap,
    key: KeyArgument = None,
    timeout: Annotated[
        float | None, typer.Option("--timeout", min=0.1, metavar="S", help="End after S seconds. [go on until Ctrl-C]")
    ] = None,
) -> None:
    """Print every message as it comes: key, size, encoding, the first bytes.

    Exits with 1 when nothing came within the timeout.
    """
    tap.run("tail", key, timeout=timeout)


GROUP = new_group(
    "stream", "What flows where right now, for any node.", {"list": list_, "hz": hz, "bw": bw, "tail": tail}
)
