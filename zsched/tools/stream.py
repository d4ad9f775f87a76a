"""`zsched stream`: what flows where right now, for any node: counters (`list`) or the samples themselves.

Knows: how a word becomes keys, windows, tables and JSON lines. Does not know: zenoh (the tap is an adapter).
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from zsched.commands.base.ask import Door, ask_door
from zsched.commands.base.common import CliError, Json, counted, nearest, print_json, say, warn
from zsched.commands.base.options import Answers, AskedOption, JsonOption, Local, new_group
from zsched.commands.base.page import Page, since_drop, size, span
from zsched.core.route import keyexpr
from zsched.core.values.errors import AdapterError
from zsched.core.values.exits import EXIT_FAILED, EXIT_OK, EXIT_UNREACHABLE, EXIT_USAGE
from zsched.core.values.struct import Struct, field
from zsched.host.clock import monotonic_s
from zsched.host.screen import printable

if TYPE_CHECKING:
    from zsched.link.bus.stream_tap import StreamTap, Tapped

WIDTH: Final = 100
PREVIEW: Final = 64
"""Bytes of a payload that `tail` shows."""
OWN_WORDS: Final = ("from_expr", "to_expr", "hz", "bytes_per_s")
"""What `list` tells in its own way."""
KINDS: Final = {"in": "input", "out": "output", "srv": "service"}


class StreamView(Struct, frozen=True, kw_only=True):
    """Which daemon to ask, and how to show the answer."""

    door: Door
    is_json: bool
    window_s: float
    count: int | None = None
    """How many windows (``tail``: samples) to show; ``None``: until Ctrl-C."""
    timeout_s: float | None = None
    """``tail``: for how long; ``None``: until Ctrl-C."""


# --- list ------------------------------------------------------------------------------------------------------------


def show_list(view: StreamView, key: str | None) -> int:
    """Print the node's streams with their rates over one window; returns the exit code."""
    door = view.door
    first = ask_door(door, {"verb": "status"})
    started = monotonic_s()
    time.sleep(view.window_s)
    second = ask_door(door, {"verb": "status"})
    streams = _chosen(rates(first, second, monotonic_s() - started), key)
    if view.is_json:
        body = {"schema": "zsched.stream.list/1", "node": second["node"], "window_s": view.window_s}
        print_json({**body, "streams": streams})
    else:
        sys.stdout.write(_table(second["node"], streams))
    return EXIT_OK


def rates(before: Json, after: Json, elapsed_s: float) -> list[Json]:
    """The streams of the later status, each with ``hz`` and ``bytes_per_s`` since the earlier one.

    The relay counts once a second, so a window of a second is right by one count; a service that restarted meanwhile
    starts from 0, and its rates are ``None``.
    """
    old = {stream["stream"]: stream for task in before["tasks"] for stream in task["streams"]}
    found = []
    for task in after["tasks"]:
        for stream in task["streams"]:
            was = old.get(stream["stream"])
            is_whole = was is not None and was["messages"] <= stream["messages"] and elapsed_s > 0
            hz = (stream["messages"] - was["messages"]) / elapsed_s if was is not None and is_whole else None
            speed = (stream["bytes"] - was["bytes"]) / elapsed_s if was is not None and is_whole else None
            found.append(
                {
                    "task": task["name"],
                    "owner": task["owner"],
                    "epoch": task["epoch"],
                    "kind": KINDS.get(stream["stream"].split("/")[-2], "input"),
                    "from": stream.get("from_expr", ""),
                    "to": stream.get("to_expr", ""),
                    "hz": hz,
                    "bytes_per_s": speed,
                    **{name: value for name, value in stream.items() if name not in OWN_WORDS},
                }
            )
    return found


def _chosen(streams: list[Json], key: str | None) -> list[Json]:
    if key is None:
        return streams
    named = [stream for stream in streams if _is_named(stream, key)]
    if named:
        return named
    _check_key(key)
    touched = [stream for stream in streams if any(_meets(key, stream[side]) for side in ("from", "to"))]
    if touched:
        return touched
    names = [stream["stream"] for stream in streams]
    raise CliError(EXIT_FAILED, f"no stream here is called {key!r} or touches such a key{nearest(key, names)}")


def _is_named(stream: Json, word: str) -> bool:
    return word in (stream["stream"], stream["stream"].removeprefix(f"{stream['task']}/"))


def _meets(key: str, expr: str) -> bool:
    return bool(expr) and keyexpr.intersects(key, expr)


def _table(node: str, streams: list[Json]) -> str:
    if not streams:
        return f"{node}: no streams (edges have none; a robot has those of the tasks' rules)\n"
    page = Page(WIDTH, color=False)
    wide = max(len(stream["stream"]) for stream in streams)
    page.row(("STREAM", wide, ""), ("HZ", -8, ""), ("SPEED", -11, ""), ("LAST", -6, ""), ("DROPPED", 30, ""))
    for stream in streams:
        drops = " ".join(f"{count} {reason}" for reason, count in stream["drops"].items())
        speed = "-" if stream["bytes_per_s"] is None else f"{size(round(stream['bytes_per_s']))}/s"
        page.row(
            (stream["stream"], wide, ""),
            (_number(stream["hz"]), -8, ""),
            (speed, -11, ""),
            (span(stream["last_seen_s"]), -6, ""),
            (f"{drops}{since_drop(stream)}" if drops else "-", 50, ""),
        )
        if stream["from"]:
            page.lines.append(f"  {stream['from']} -> {stream['to']}")
    return "\n".join(page.lines) + "\n"


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"


# --- which keys ------------------------------------------------------------------------------------------------------


def keys_for(status: Json, word: str | None) -> tuple[str, ...]:
    """The key expressions that ``word`` means: a stream's two ends, a key as it is; all streams' own ends for ``None``.

    Raises:
        CliError: there is no such stream, it has no keys now, or the word is no key expression.
    """
    streams = [{"task": task["name"], **stream} for task in status["tasks"] for stream in task["streams"]]
    if word is None:
        ends = [end for stream in streams if (end := _own_end(stream))]
        if not ends:
            raise CliError(
                EXIT_FAILED, f"{status['node']} has no streams now; give a key, e.g. `zsched stream hz '**'`"
            )
        return tuple(dict.fromkeys(ends))
    for stream in streams:
        if not _is_named(stream, word):
            continue
        if stream["stream"].split("/")[-2] == "srv":
            raise CliError(
                EXIT_USAGE, f"{word} is a service: requests are no samples; `zsched stream list` counts them"
            )
        if not stream.get("from_expr"):
            raise CliError(EXIT_FAILED, f"{word} leads nowhere: its task has no owner")
        return (stream["from_expr"], stream["to_expr"])
    _check_key(word)
    if not any(_meets(word, str(stream.get(end, ""))) for stream in streams for end in ("from_expr", "to_expr")):
        names = ", ".join(stream["stream"] for stream in streams) or "none"
        text = f"no stream here is called {word!r} or touches such a key (there are {names}): listening on it as a key"
        warn(text)
    return (word,)


def _own_end(stream: Json) -> str:
    """The robot's own key of a stream."""
    ends = {"in": "from_expr", "out": "to_expr"}
    return str(stream.get(ends.get(stream["stream"].split("/")[-2], ""), ""))


def _check_key(word: str) -> None:
    fault = keyexpr.fault(word)
    if fault is not None:
        raise CliError(EXIT_USAGE, f"{word!r} is no key expression: {fault}")


# --- hz, bw, tail ----------------------------------------------------------------------------------------------------


class KeyStats(Struct):
    """What came on one key in one window."""

    count: int = 0
    size: int = 0
    smallest: int = 0
    largest: int = 0
    last_at: float | None = None
    gaps: list[float] = field(default_factory=list)

    def add(self, size: int, at: float) -> None:
        """Take one sample of ``size`` bytes at ``at`` seconds."""
        self.smallest = size if not self.count else min(self.smallest, size)
        self.largest = max(self.largest, size)
        self.count += 1
        self.size += size
        if self.last_at is not None:
            self.gaps.append(at - self.last_at)
        self.last_at = at

    def as_json(self, window_s: float) -> Json:
        """Rates over the window; gaps between two samples in seconds, ``None`` with fewer than two samples."""
        return {
            "messages": self.count,
            "hz": self.count / window_s,
            "bytes_per_s": self.size / window_s,
            "mean_bytes": self.size / self.count if self.count else None,
            "min_bytes": self.smallest if self.count else None,
            "max_bytes": self.largest if self.count else None,
            "min_gap_s": min(self.gaps, default=None),
            "max_gap_s": max(self.gaps, default=None),
        }


def show_rates(view: StreamView, word: str | None, verb: str) -> int:
    """Print one table per window: rates and gaps (``hz``) or bytes and sizes (``bw``); returns the exit code."""
    with _tap(view, word) as tap:
        carry: dict[tuple[str, str], KeyStats] = {}
        code, turns = EXIT_OK, 0
        while view.count is None or turns < view.count:
            turns += 1
            found = _window(tap, view.window_s, carry)
            code = EXIT_OK if found else EXIT_FAILED
            _print_rates(view, verb, found, tap.missed, tap.told("counted"))
            # a gap across windows counts in the last one; other keys may have come in those between
            carry |= {name: KeyStats(last_at=stats.last_at) for name, stats in found.items()}
    return code


def _window(tap: StreamTap, window_s: float, carry: dict[tuple[str, str], KeyStats]) -> dict[tuple[str, str], KeyStats]:
    stats: dict[tuple[str, str], KeyStats] = {}
    for sample in tap.until(monotonic_s() + window_s):
        name = (sample.side, sample.key)
        if name not in stats:
            stats[name] = KeyStats(last_at=carry[name].last_at) if name in carry else KeyStats()
        stats[name].add(sample.size, sample.at)
    return stats


def _print_rates(
    view: StreamView, verb: str, found: dict[tuple[str, str], KeyStats], missed: int, told: str = ""
) -> None:
    rows = {name: stats.as_json(view.window_s) for name, stats in sorted(found.items())}
    if view.is_json:
        keys = [{"key": key, "side": side, **row} for (side, key), row in rows.items()]
        schema = f"zsched.stream.{verb}/1"
        print_json({"schema": schema, "window_s": view.window_s, "missed": missed, "keys": keys}, is_line=True)
        return
    if not rows:
        say(f"nothing in {view.window_s:g} s")
    for (side, key), row in rows.items():
        where = printable(f"{key} ({side} side)" if side != "fleet" else key)
        say(f"{where}: {_hz_text(row) if verb == 'hz' else _bw_text(row)}")
    if told:
        say(f"... {told}")


def _hz_text(row: Json) -> str:
    text = f"{row['hz']:.2f} Hz, {counted(row['messages'], 'messages')}"
    if row["max_gap_s"] is not None:
        text += f", gaps {row['min_gap_s'] * 1000:.1f}..{row['max_gap_s'] * 1000:.1f} ms"
    return text


def _bw_text(row: Json) -> str:
    sizes = f"{size(row['min_bytes'])}..{size(row['max_bytes'])}"
    return f"{size(round(row['bytes_per_s']))}/s, {counted(row['messages'], 'messages')} of {sizes}"


def show_tail(view: StreamView, word: str | None) -> int:
    """Print each sample as it comes; returns the exit code: 1 when the time was over before the first one."""
    seen = 0
    with _tap(view, word, PREVIEW) as tap:
        try:
            for sample in _samples(tap, view.timeout_s):
                _print_sample(view, sample)
                seen += 1
                if view.count is not None and seen >= view.count:
                    break
        finally:
            if told := tap.told("printed"):
                warn(f"zsched stream: {told}")
    return EXIT_OK if seen else EXIT_FAILED


def _samples(tap: StreamTap, timeout_s: float | None) -> Iterator[Tapped]:
    if timeout_s is not None:
        yield from tap.until(monotonic_s() + timeout_s)
        return
    while True:
        yield from tap.until(monotonic_s() + 3600.0)


def _print_sample(view: StreamView, sample: Tapped) -> None:
    head = sample.payload[:PREVIEW]
    if view.is_json:
        body: Json = {
            "schema": "zsched.stream.tail/1",
            "key": sample.key,
            "side": sample.side,
            "kind": sample.kind,
            "bytes": sample.size,
            "encoding": sample.encoding,
            "attachment_bytes": sample.attachment_size,
            "head_hex": head.hex(),
        }
        print_json(body, is_line=True)
        return
    kind = "" if sample.kind == "put" else f" {sample.kind}"
    side = "" if sample.side == "fleet" else f" ({sample.side} side)"
    more = "…" if sample.size > PREVIEW else ""
    say(printable(f"{sample.key}{side}{kind} {size(sample.size)} {sample.encoding} {_shown(head)}{more}"))


def _shown(head: bytes) -> str:
    """Text as text, anything else as hexadecimal digits."""
    try:
        text = head.decode()
    except UnicodeDecodeError:
        return head.hex(" ")
    return text if text.isprintable() else head.hex(" ")


def _tap(view: StreamView, word: str | None, kept_bytes: int = 0) -> StreamTap:
    """A tap on the keys that ``word`` means at the node that is asked; it keeps so much of each payload.

    Raises:
        CliError: no daemon (3), no way to the node's data (3), no such stream or key (1, 2), a node of a cell (2).
    """
    door = view.door
    if door.cell is not None:
        raise CliError(EXIT_USAGE, "--node CELL/NODE: this verb joins the data network; ask on a machine of that fleet")
    keys = keys_for(ask_door(door, {"verb": "status"}), word)
    access = ask_door(Door(socket=door.socket), {"verb": "access", **_asked(door)})
    sides: dict[str, str] = access["sides"]
    if door.node is not None and access["via"] != door.node:
        warn(f"zsched stream: {door.node} has no address in the fleet file; listening at {access['via']}")
    from zsched.link.bus.stream_tap import StreamTap  # noqa: PLC0415 - loads zenoh, which only these verbs need

    try:
        return StreamTap(sides, keys, kept_bytes=kept_bytes)
    except AdapterError as error:
        ways: Sequence[Any] = access["endpoints"]
        raise CliError(EXIT_UNREACHABLE, f"{', '.join(map(str, ways))}: {error}") from error


def _asked(door: Door) -> Json:
    return {} if door.node is None else {"node": door.node}


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

    def run(self, verb: str, key: str | None, window: float = 1.0, timeout: float | None = None) -> int:
        """Until there were enough, or Ctrl-C: that is how these verbs are meant to end."""
        door, code = self.door(), 0
        view = StreamView(door=door, is_json=self.json_, window_s=window, count=self.count, timeout_s=timeout)
        with contextlib.suppress(KeyboardInterrupt):
            code = show_tail(view, key) if verb == "tail" else show_rates(view, key, verb)
        return code


def list_(asked: Answers, key: KeyArgument = None, window: WindowOption = 2.0) -> int:
    """List a node's streams: from where to where, how fast, and what was dropped.

    Example: zsched stream list
    """
    return show_list(StreamView(door=asked.door(), is_json=asked.json_, window_s=window), key)


def hz(tap: Tap, key: KeyArgument = None, window: WindowOption = 2.0) -> int:
    """Show how often something comes on each key, and the shortest and longest gap.

    Example: zsched stream hz map_merge/in/0

    Of a stream, both its ends are shown. Exits with 1 when nothing came in the last window.
    """
    return tap.run("hz", key, window)


def bw(tap: Tap, key: KeyArgument = None, window: WindowOption = 2.0) -> int:
    """Show how many bytes per second come on each key, and the smallest and largest message.

    Example: zsched stream bw map_merge/in/0
    """
    return tap.run("bw", key, window)


def tail(
    tap: Tap,
    key: KeyArgument = None,
    timeout: Annotated[
        float | None, typer.Option("--timeout", min=0.1, metavar="S", help="End after S seconds. [go on until Ctrl-C]")
    ] = None,
) -> int:
    """Print every message as it comes: key, size, encoding, the first bytes.

    Example: zsched stream tail map_merge/in/0

    Exits with 1 when nothing came within the timeout.
    """
    return tap.run("tail", key, timeout=timeout)


stream = new_group(
    "stream", "What flows where right now, for any node.", {"list": list_, "hz": hz, "bw": bw, "tail": tail}
)
