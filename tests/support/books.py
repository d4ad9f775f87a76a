"""The invariant of the books at the end of a test: every sample that came in is in one counter
(`zsched.core.hop.books`).

Knows: a relay's reports. Does not know: which rig they come from.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable

from support.waiting import until
from zsched.core.hop.books import unaccounted
from zsched.core.values.events import StreamsCounted
from zsched.core.values.plan import StreamCount
from zsched.core.values.relay_protocol import HandleReport


def newest_counts(reports: Iterable[HandleReport]) -> tuple[StreamCount, ...]:
    """The counters of the newest of one relay's reports; empty: it has not told any."""
    told = [report for report in reports if isinstance(report, StreamsCounted)]
    return told[-1].counts if told else ()


def wait_for_balance(counts: Callable[[], tuple[StreamCount, ...]]) -> None:
    """Wait until the counters of every stream account for every sample; `AssertionError` with those that do not."""
    found: dict[str, tuple[int, StreamCount]] = {}

    def is_balanced() -> bool:
        books = {count.stream: (unaccounted(count) or 0, count) for count in counts()}
        found.clear()
        found.update({name: book for name, book in books.items() if book[0]})
        return not found

    try:
        until(is_balanced, "an account of every sample")
    except AssertionError as error:
        raise AssertionError(f"{error}, missing {found}") from None


def assert_nothing_is_unaccounted(reports: Callable[[], tuple[HandleReport, ...]]) -> None:
    """The same by a relay that still runs, and by counters that it tells from now on: all that came in is in them."""
    already = len(reports())
    is_told = lambda: any(isinstance(report, StreamsCounted) for report in reports()[already:])  # noqa: E731
    until(is_told, "counters that are told from now on")
    wait_for_balance(lambda: newest_counts(reports()[already:]))
