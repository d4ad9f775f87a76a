"""Decides whether the counters of an input stream account for every sample.

Knows: `StreamCount`. Does not know: relays, workers, why a sample was lost.

Every sample that came, or was given to one owner more, is somewhere: its worker processed it, it is known to be lost,
it was dropped for a reason, it is on its way (queued, or sent and not acknowledged), it was on its way to a worker that
died, or it waits for the first owner (class ``latest``)::

    messages + repeated = acknowledged + lost + drops + in flight + at most lost + unsent + unconfirmed

The last is what went to workers that acknowledge nothing; towards `zsched.worker` it is 0.

What is missing on the right was lost silently; what is too much was counted twice. Both are bugs of ours.
"""

from __future__ import annotations

from zsched.core.values.plan import StreamCount


def unaccounted(count: StreamCount) -> int | None:
    """Samples that the counters say nothing of (below 0: counted twice); ``None``: no input.

    Counters are read while samples move; one that is in a thread's hand is accounted for, so 0 holds at any time.
    """
    if count.in_flight is None:
        return None
    known = (count.acknowledged or 0) + given_up(count) + count.unconfirmed
    return count.messages + count.repeated - known - count.in_flight - count.unsent


def given_up(count: StreamCount) -> int:
    """Samples that the counters of an input or an output call lost, perhaps lost, or dropped."""
    return count.lost + count.at_most_lost + sum(number for _, number in count.drops)
