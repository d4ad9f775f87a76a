"""What the opener of one session lacks of another one: the workers that were started before it changed.

Knows: the text of a zenoh configuration. Does not know: which worker has read which.
"""

from __future__ import annotations

import json
from typing import Any, Final

from zsched.core.values.endpoint import Endpoint

OTHER_SETTINGS: Final = "new settings"


def lacking(read: str, now: str) -> str:
    """What the reader of one session lacks of another, in words; empty: nothing.

    A node that it dials beyond that is gone, or joins by itself: no reason to start it again.
    """
    if read == now:
        return ""
    try:
        old, new = json.loads(read), json.loads(now)
        old_ends, new_ends = _take_endpoints(old), _take_endpoints(new)
    except (ValueError, KeyError, TypeError, AttributeError):
        return OTHER_SETTINGS
    if old != new:
        return OTHER_SETTINGS
    return ", ".join(Endpoint.of(one).place for one in new_ends if one not in old_ends)


def _take_endpoints(session: dict[str, Any]) -> list[str]:
    """The endpoints that a session dials, taken out of it."""
    endpoints = session["connect"].pop("endpoints")
    if not isinstance(endpoints, list):
        raise TypeError
    return [str(one) for one in endpoints]
