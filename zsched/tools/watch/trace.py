"""`zsched trace`: sends a span for each move to an OpenTelemetry collector (OTLP over HTTP).

Knows: the feed, what of a log belongs to a move, OpenTelemetry's SDK. Does not know: how a log is written.
"""

from __future__ import annotations

import hashlib
import logging
import re
import secrets
import sys
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Annotated, Final
from urllib.parse import urlsplit

import typer

from zsched.commands.base.common import Away, CliError, Json, stopped_by_signal, warn
from zsched.commands.base.options import Local
from zsched.commands.base.page import duration_s
from zsched.commands.look.history import is_move
from zsched.core.values.exits import EXIT_FAILED, EXIT_OK, EXIT_USAGE
from zsched.core.values.struct import Struct, field
from zsched.host.clock import wall_s
from zsched.tools.watch.feed import Feed

if TYPE_CHECKING:
    from opentelemetry.sdk.trace import TracerProvider

PERIOD_S: Final = 1.0
SEND_S: Final = 5.0
LIBRARY: Final = "opentelemetry"
"""Its loggers tell of each attempt..."""
MAX_WHY: Final = 160
"""...and we of the first one, in at most as many characters."""


def trace(
    asked: Local,
    otlp: Annotated[
        str, typer.Option("--otlp", metavar="URL", help="An OpenTelemetry collector (OTLP over HTTP).")
    ] = "http://127.0.0.1:4318",
    since: Annotated[
        str | None, typer.Option("--since", metavar="AGE", help="Also moves not older: 90s, 10m, 2h, 1d.")
    ] = None,
    once: Annotated[bool, typer.Option("--once", help="Only what the decision log holds, then end.")] = False,
) -> int:
    """Send a trace span for each move in this machine's decision log to an OpenTelemetry collector.

    Example: zsched trace --since 1d

    Needs the extra trace. Exits with 1 when the collector refused one.
    """
    if not _is_collector(otlp):
        raise CliError(EXIT_USAGE, f"--otlp {otlp}: no address of a collector; write it as http://HOST:4318")
    feed = Feed(asked.door)
    if (node := feed.door().node) is not None:
        raise CliError(EXIT_USAGE, f"the log of {node} lies on its machine: ask there")
    news = feed.ask()
    if news.status is None:
        raise CliError(news.code, news.why)
    if news.log_why and once:
        raise CliError(EXIT_FAILED, f"nothing was sent: {news.log_why}")
    sender, moves = Sender(otlp, news.status["fleet"], news.status["node"]), Moves()
    oldest, away = news.at - (0.0 if since is None else duration_s(since)), Away("trace")
    away.tell(news.log_why)

    def send(spans: Iterable[Span]) -> None:
        sender.send(span for span in spans if span.end >= oldest)

    with stopped_by_signal() as ended:
        send(moves.take(news.entries))
        while not once and not ended.wait(PERIOD_S):
            news = feed.ask()
            away.tell(news.why or news.log_why)
            send((*moves.take(news.entries), *moves.overdue(wall_s())))
    if once:
        send(moves.rest())
    warn(f"{sender.sent} spans sent, {sender.refused} refused")
    return EXIT_FAILED if sender.refused else EXIT_OK


def _is_collector(url: str) -> bool:
    """Whether it can be a collector's address."""
    try:
        parts = urlsplit(url)
    except ValueError:  # half of a bracket
        return False
    return parts.scheme in ("http", "https") and bool(parts.netloc)


class _Complaints(logging.Handler):
    """Keeps the library's newest complaint, which would be a line of the log for each attempt."""

    why = "no answer"

    def emit(self, record: logging.LogRecord) -> None:
        text = record.getMessage()
        if "code:" in text or "rror" in text:
            found = re.search(r"\[Errno -?\d+\] ([^\"')]+)", text)
            self.why = (found[1] if found else text)[:MAX_WHY]


class Sender:
    """Makes OpenTelemetry's spans of ours and sends each at once."""

    def __init__(self, url: str, fleet: str, node: str) -> None:
        """``url``: of the collector.

        Raises:
            CliError: the library is not installed.
        """
        try:
            from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter  # noqa: PLC0415 - an extra
            from opentelemetry.sdk.resources import Resource  # noqa: PLC0415 - as above
            from opentelemetry.sdk.trace import TracerProvider  # noqa: PLC0415 - as above
            from opentelemetry.sdk.trace.id_generator import IdGenerator  # noqa: PLC0415 - as above
        except ImportError as error:
            raise CliError(
                EXIT_FAILED,
                f"OpenTelemetry is not installed here: {sys.executable} -m pip install 'zsched[trace]'",
            ) from error

        class Named(IdGenerator):
            """Gives a move's trace its name."""

            trace = 1

            def generate_trace_id(self) -> int:
                return self.trace

            def generate_span_id(self) -> int:
                return secrets.randbits(64) or 1

        self._fleet, self._names = fleet, Named()
        self._url, self._is_refused = url, False
        self._complaints = _Complaints()
        logger = logging.getLogger(LIBRARY)
        logger.handlers, logger.propagate = [self._complaints], False
        self._exporter = OTLPSpanExporter(endpoint=f"{url.rstrip('/')}/v1/traces", timeout=SEND_S)
        about = {"service.name": "zsched", "service.namespace": fleet, "service.instance.id": node}
        self._provider: TracerProvider = TracerProvider(
            resource=Resource.create(about), id_generator=self._names, shutdown_on_exit=False
        )
        self.sent = self.refused = 0

    def send(self, spans: Iterable[Span]) -> None:
        """Send each; what no collector takes is counted, not kept."""
        from opentelemetry.sdk.trace import ReadableSpan  # noqa: PLC0415 - an extra
        from opentelemetry.sdk.trace.export import SpanExportResult  # noqa: PLC0415 - as above

        tracer = self._provider.get_tracer("zsched")
        for span in spans:
            self._names.trace = trace_id(self._fleet, span.task, span.epoch)
            made = tracer.start_span(f"move {span.task}", start_time=_ns(span.begin), attributes=_attributes(span))
            for at, stage, text in span.lines:
                made.add_event(text, {"zsched.stage": stage}, timestamp=_ns(at))
            made.end(end_time=_ns(span.end))
            assert isinstance(made, ReadableSpan)
            is_taken = self._exporter.export([made]) is SpanExportResult.SUCCESS
            self.sent += is_taken
            self.refused += not is_taken
            self._tell(is_refused=not is_taken)

    def _tell(self, *, is_refused: bool) -> None:
        """Say that the collector takes nothing any more, or takes spans again."""
        if is_refused and not self._is_refused:
            why = f"takes no spans ({self._complaints.why}): is it a collector, for OTLP over HTTP?"
            warn(f"zsched trace: {self._url} {why} Spans are counted meanwhile, and not kept")
        elif self._is_refused and not is_refused:
            warn(f"zsched trace: {self._url} takes spans again")
        self._is_refused = is_refused


def _attributes(span: Span) -> dict[str, str | int | float]:
    told: dict[str, str | int | float | None] = {
        "zsched.task": span.task,
        "zsched.epoch": span.epoch,
        "zsched.from": span.left,
        "zsched.to": span.owner,
        "zsched.reason": span.reason,
        "zsched.node": span.node,
        "zsched.switched_s": span.switched_s,
    }
    return {name: value for name, value in told.items() if value is not None}


def _ns(at: float) -> int:
    return round(at * 1e6) * 1000


# --- what belongs to a move (pure) -----------------------------------------------------------------------------------


OVERDUE_S: Final = 60.0
"""A move that is not settled by then is reported as far as it came."""
MOST_LINES: Final = 100


class Span(Struct, frozen=True, kw_only=True):
    """One move as one node saw it; times in seconds since 1970, by that node's clock."""

    node: str
    task: str
    epoch: int
    left: str | None
    owner: str | None
    reason: str
    begin: float
    end: float
    switched_s: float | None
    """How long the streams took to switch, ``None`` where they have not, or the node has none."""
    lines: tuple[tuple[float, str, str], ...]
    """(time, stage, text)."""


def trace_id(fleet: str, task: str, epoch: int) -> int:
    """The 128 bits that name a move's trace, the same on every node."""
    return int.from_bytes(hashlib.sha256(f"{fleet}/{task}/{epoch}".encode()).digest()[:16], "big") or 1


class _Open(Struct):
    """A move that is not over."""

    entry: Json
    lines: list[Json] = field(default_factory=list)
    switched_s: float | None = None


class Moves:
    """Takes the lines of one node's log in their order, and gives the moves that are over."""

    def __init__(self) -> None:
        self._before: dict[str, list[Json]] = {}
        """Of each task the lines that may belong to its next move."""
        self._open: dict[str, _Open] = {}

    def take(self, entries: Iterable[Json]) -> Iterator[Span]:
        """The moves that end with these lines."""
        for entry in entries:
            task = str(entry.get("task", ""))
            if not task:
                continue
            if "move" in entry and not is_move(entry):
                yield from self._close(task)  # the daemon has begun anew: no lines of its earlier life follow
            elif "move" in entry:
                yield from self._close(task)
                self._open[task] = _Open(entry, [*self._before.pop(task, []), entry])
            elif task in self._open and entry.get("epoch") == self._open[task].entry["epoch"]:
                yield from self._go_on(task, entry)
            else:
                self._wait(task, entry)

    def overdue(self, now: float) -> Iterator[Span]:
        """The moves that have waited for their end for `OVERDUE_S`; ``now``: the node's clock."""
        for task in [task for task, one in self._open.items() if now - one.entry["at"] > OVERDUE_S]:
            yield from self._close(task)

    def rest(self) -> Iterator[Span]:
        """The moves that are not over, as far as they came."""
        for task in list(self._open):
            yield from self._close(task)

    def _wait(self, task: str, entry: Json) -> None:
        """A move begins with the judgement that calls for it: one that does not, ends what was before."""
        lines = self._before.setdefault(task, [])
        if entry["stage"] == "scheduler" and not entry["text"].startswith("propose"):
            lines.clear()
        else:
            lines.append(entry)
            del lines[:-MOST_LINES]

    def _go_on(self, task: str, entry: Json) -> Iterator[Span]:
        one = self._open[task]
        if entry["stage"] == "scheduler":  # the first judgement under the new owner is no part of the move
            self._wait(task, entry)
            return
        one.lines.append(entry)
        del one.lines[MOST_LINES:]
        one.switched_s = entry.get("took_s", one.switched_s)
        is_drained = "took_s" in entry and not entry["text"].endswith(" drains")
        if is_drained or entry["text"].startswith("settled"):
            yield from self._close(task)

    def _close(self, task: str) -> Iterator[Span]:
        one = self._open.pop(task, None)
        if one is None:
            return
        move = one.entry["move"]
        times = [float(line["at"]) for line in one.lines]
        yield Span(
            node=one.entry["node"],
            task=task,
            epoch=move["epoch"],
            left=move["left"],
            owner=move["owner"],
            reason=move["reason"],
            begin=min(times),
            end=max(times),
            switched_s=one.switched_s,
            lines=tuple((float(line["at"]), str(line["stage"]), str(line["text"])) for line in one.lines),
        )
