"""Whether somebody matches a zenoh publisher or querier: the one place that reads it.

Knows: what is odd about zenoh's answer. Does not know: what is put or asked, who matches.
"""

from __future__ import annotations

from typing import Any


def is_matched(entity: Any) -> bool:
    """Whether a subscriber (of a publisher) or a queryable (of a querier) matches it, a recorder's too.

    zenoh's ``matching_status`` itself is always true: it is an object, which the stubs call a bool.
    """
    return bool(entity.matching_status.matching)
