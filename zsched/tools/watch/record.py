"""`zsched record`: writes what a fleet does into an MCAP file, for Foxglove and every other reader of MCAP.

Knows: the file, intervals, the tap on maps and frames. Does not know: topics, schemas
(`zsched.tools.watch.tracks`).
"""

from __future__ import annotations

import contextlib
import json
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, BinaryIO, Final

import typer

from zsched.commands.base.ask import Door, ask_door
from zsched.commands.base.common import Away, CliError, stopped_by_signal, warn
from zsched.commands.base.options import Asks
from zsched.commands.base.page import duration_s, size
from zsched.core.route import keyexpr
from zsched.core.values.errors import AdapterError
from zsched.core.values.exits import EXIT_FAILED, EXIT_OK, EXIT_UNREACHABLE, EXIT_USAGE
from zsched.core.values.struct import replace
from zsched.host.clock import monotonic_s, wall_s
from zsched.host.latch import Latch
from zsched.tools.watch import tracks
from zsched.tools.watch.feed import Feed

if TYPE_CHECKING:
    from mcap.writer import Writer

    from zsched.link.bus.stream_tap import StreamTap

LIBRARY: Final = "zsched"


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
) -> int:
    """Record what the fleet does as MCAP, for Foxglove: owners, worth, moves, streams, events, maps, tf.

    Example: zsched record --output run.mcap

    Needs the extra mcap. Maps and frames on ROS topics are found by their type.
    """
    maps, frames = tuple(map_ or ()), tuple(tf or ())
    for_s = float("inf") if for_ is None else duration_s(for_)
    for option, keys in (("--map", maps), ("--tf", frames)):
        for key in keys:
            if (fault := keyexpr.fault(key)) is not None:
                raise CliError(EXIT_USAGE, f"{option}: {key!r} is no key expression: {fault}")
    feed = Feed(asked.door)
    door = feed.door()
    if door.cell is not None and (maps or frames):
        raise CliError(EXIT_USAGE, "--map and --tf join the data network: record them on a machine of that fleet")
    if door.endpoint and (maps or frames):
        raise CliError(EXIT_USAGE, "--map and --tf join the data network of a daemon here; --connect only asks")
    first = feed.ask()
    if first.status is None:
        raise CliError(first.code, first.why)
    with contextlib.ExitStack() as stack:
        named = {**dict.fromkeys(maps, tracks.GRID), **dict.fromkeys(frames, tracks.FRAMES)}
        kinds = {} if door.endpoint else {**tracks.ros_keys(first.status), **named}
        tap = stack.enter_context(_tapped(door, tuple(kinds)))
        tape = stack.enter_context(_taped(output, kinds))
        ended = stack.enter_context(stopped_by_signal())
        end = monotonic_s() + for_s
        news, away = replace(first, entries=()), Away("record")  # the log of before is no part of the recording
        is_over = False
        while True:
            if news.status is not None:
                for message in tracks.of_status(news.status, news.at):
                    tape.put(message)
            for entry in news.entries:
                for message in tracks.of_entry(entry):
                    tape.put(message)
            if is_over:
                break
            _wait(min(monotonic_s() + interval, end), tap, tape, ended)
            is_over = ended.is_set() or monotonic_s() >= end  # what has happened since the last look belongs to it
            news = feed.ask()
            away.tell(news.why or news.log_why)
    told = f"{output}: {tape.messages} messages of {len(tape.topics)} topics, {size(output.stat().st_size)}"
    missed = "" if tap is None else tap.told("written")
    warn(f"{told}; {missed}" if missed else told)
    return EXIT_OK


def _wait(until: float, tap: StreamTap | None, tape: Tape, ended: Latch) -> None:
    """Write what the tap hears as it comes, until then."""
    if tap is None:
        ended.wait(max(until - monotonic_s(), 0.0))
        return
    while not ended.is_set() and (now := monotonic_s()) < until:
        for sample in tap.until(min(now + 0.2, until)):
            if sample.kind == "put" and sample.side == "fleet":
                tape.put_ros(sample.key, sample.payload, wall_s() - (monotonic_s() - sample.at))


@contextlib.contextmanager
def _tapped(door: Door, keys: tuple[str, ...]) -> Iterator[StreamTap | None]:
    """A tap on the keys that carry maps and frames; ``None`` where there are none."""
    if not keys:
        yield None
        return
    asked = {} if door.node is None else {"node": door.node}
    access = ask_door(Door(socket=door.socket), {"verb": "access", **asked})
    from zsched.link.bus.stream_tap import StreamTap  # noqa: PLC0415 - loads zenoh, which only these need

    try:
        tap = StreamTap({"fleet": access["sides"]["fleet"]}, keys, kept_bytes=None)
    except AdapterError as error:
        raise CliError(EXIT_UNREACHABLE, f"maps and frames cannot be listened to: {error}") from error
    with tap:
        yield tap


# --- the file --------------------------------------------------------------------------------------------------------


class Tape:
    """An MCAP file while it is written."""

    def __init__(self, writer: Writer, kinds: dict[str, str]) -> None:
        """``kinds``: {key expression: ROS 2 type} of samples that are written as they come."""
        self._writer = writer
        self._kinds = kinds
        self._schemas: dict[str, int] = {}
        self.topics: dict[str, int] = {}
        self._numbers: Counter[str] = Counter()

    @property
    def messages(self) -> int:
        """How many have been written."""
        return self._numbers.total()

    def put(self, message: tracks.Message) -> None:
        """Write a message of zsched's own."""
        text = tracks.status_schema() if message.schema == tracks.STATUS else tracks.JSON_SCHEMAS[message.schema]
        self._put(
            message.topic, message.schema, "jsonschema", text, "json", json.dumps(message.body).encode(), message.at_ns
        )

    def put_ros(self, key: str, data: bytes, at: float) -> None:
        """Write a map or frames as their publisher has sent them; ``at``: seconds since 1970."""
        kind = next(kind for expr, kind in self._kinds.items() if keyexpr.matches(expr, key))
        topic, stamp = tracks.topic_of(key), tracks.nanoseconds(at)
        self._put(topic, kind, "ros2msg", tracks.ROS_DEFINITIONS[kind], "cdr", data, stamp)

    def _put(self, topic: str, schema: str, kind: str, definition: str, encoding: str, data: bytes, at_ns: int) -> None:
        if topic not in self.topics:
            if schema not in self._schemas:
                self._schemas[schema] = self._writer.register_schema(schema, kind, definition.encode())
            self.topics[topic] = self._writer.register_channel(topic, encoding, self._schemas[schema])
        self._numbers[topic] += 1
        self._writer.add_message(self.topics[topic], at_ns, data, at_ns, self._numbers[topic])


@contextlib.contextmanager
def _taped(path: Path, kinds: dict[str, str]) -> Iterator[Tape]:
    """A new file; what has been written is whole when the block ends, however it ends."""
    try:
        from mcap.writer import Writer  # noqa: PLC0415 - an extra
    except ImportError as error:
        raise CliError(
            EXIT_FAILED, f"MCAP cannot be written here: {sys.executable} -m pip install 'zsched[mcap]'"
        ) from error
    try:
        file: BinaryIO = path.open("xb")
    except FileExistsError as error:
        raise CliError(EXIT_FAILED, f"{path} is there already: name a new file") from error
    except OSError as error:
        raise CliError(EXIT_FAILED, f"{path} cannot be written: {error.strerror}; see its folder") from error
    try:
        with file:  # a disk that is full may be found as late as at the end
            writer = Writer(file)
            writer.start(profile="", library=LIBRARY)
            try:
                yield Tape(writer, kinds)
            finally:
                with contextlib.suppress(OSError):
                    writer.finish()  # type: ignore[no-untyped-call]
    except OSError as error:
        raise CliError(EXIT_FAILED, f"{path} cannot be written any more: {error.strerror}") from error
