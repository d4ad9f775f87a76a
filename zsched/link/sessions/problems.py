"""Says why a zenoh session could not be opened, for the operator: which endpoint, why, what to do.

Knows: the configuration's endpoints, the shape of zenoh's error texts. Does not know: sessions, where the words are
shown.

Zenoh's own text names the endpoint with our options on it and the line of its source that noticed; of an address that
cannot be looked up it names nothing at all.
"""

from __future__ import annotations

import errno
import json
import re
from typing import Final

from zsched.core.values.endpoint import Endpoint

MAX_WHY: Final = 200
"""Characters of zenoh's own text that go into ours."""
MAX_NAMED: Final = 4

_SOURCE_LINE: Final = re.compile(r" at \S+\.rs:\d+\.?")
_BOUND_TO: Final = re.compile(r"bound to (\S+) ")
_NO_ANSWER: Final = "Unable to connect to any of"
_ASKED: Final = re.compile(r"Single\(([^)]+)\)")
_OS_ERROR: Final = re.compile(r"os error (\d+)")


def why_not_open(config: str, error: Exception) -> str:
    """The reason and what to do about it; ``config`` is the session's JSON text, ``error`` what opening it raised.

    A session that listens nowhere is a client: it fails because nobody answers it.
    """
    text = _SOURCE_LINE.sub("", str(error))
    endpoints = _listens(config)
    named = _BOUND_TO.search(text)
    endpoints = endpoints[:MAX_NAMED] if named is None else (Endpoint.of(named.group(1).rstrip(":")).place,)
    number = _OS_ERROR.search(text)
    why, remedy = _explained(int(number.group(1)) if number is not None else 0, endpoints, text)
    if not endpoints:
        return f"cannot be joined: {_unanswered(text)[:MAX_WHY]}; is its router up?"
    return f"cannot listen on {' or '.join(endpoints)}: {why}; {remedy}"


def _unanswered(text: str) -> str:
    """Whom a client has asked in vain; zenoh's own text where it says something else."""
    asked = _ASKED.findall(text) if _NO_ANSWER in text else []
    return f"nobody answers at {' or '.join(asked)} in time" if asked else text


def _explained(number: int, endpoints: tuple[str, ...], text: str) -> tuple[str, str]:
    """(why, what to do)."""
    if number == errno.EADDRINUSE:
        ports = " or ".join(f"sport = :{Endpoint.of(endpoint).port}" for endpoint in endpoints)
        return (
            "another program has that port",
            f"end that program (`ss -ltnp '{ports}'` names it), or give this node another port in the fleet file",
        )
    if number == errno.EADDRNOTAVAIL:
        return "this machine does not have that address", "put one of its own, or 0.0.0.0, into the fleet file"
    if number == errno.EACCES:
        return "this user may not use that port", "use one above 1023, or give the service the right to it"
    return text[:MAX_WHY], "see this node's endpoints in the fleet file"


def _listens(config: str) -> tuple[str, ...]:
    """Where the session would listen, without the options behind ``#``."""
    try:
        found = json.loads(config).get("listen", {}).get("endpoints", [])
    except (ValueError, AttributeError):  # an operator's own file may be JSON5: then zenoh's text has to do
        return ()
    return tuple(Endpoint.of(str(one)).place for one in found) if isinstance(found, list) else ()
