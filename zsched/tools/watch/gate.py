"""Which requests `zsched web` answers: the method, the Host, where a page asks from, the path, the token (pure).

Only reading: GET and HEAD. The Host header must be an address, or a name that this machine goes by: a page of another
site that had its own name point here (DNS rebinding) is refused. The page's own files hold no data and need no token;
everything that tells of the fleet does, where there is one. A token in an address is refused: addresses get into logs.

Knows: headers, paths, refusals. Does not know: sockets, what is answered.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import re
from collections.abc import Callable, Sequence
from typing import Final

from zsched.core.values.struct import Struct
from zsched.core.values.words import NAME

METHODS: Final = ("GET", "HEAD")
LEAST_TOKEN: Final = 16
"""Characters: a shorter one could be tried out."""
FILES: Final = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
    "/icon.svg": ("icon.svg", "image/svg+xml"),
}
"""{path: (file, type)}; nothing else of the disk can be asked for."""
LIVE, STATUS, METRICS, EXPLAIN = "/api/live", "/api/status", "/metrics", "/api/explain/"
HEADERS: Final = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self'; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
"""Of every answer."""
_HOST: Final = re.compile(r"(?:\[(?P<v6>[^\]]+)\]|(?P<name>[^:\[\]]+))(?::[0-9]{1,5})?")


class Asked(Struct, frozen=True, kw_only=True):
    """One request."""

    method: str
    target: str
    """Path and query as they came."""
    headers: Callable[[str], Sequence[str]]
    """All values of a header, by its name."""


class Refusal(Struct, frozen=True, kw_only=True):
    """Why a request is not answered."""

    status: int
    why: str
    headers: tuple[tuple[str, str], ...] = ()


class Route(Struct, frozen=True, kw_only=True):
    """What is to be answered."""

    path: str
    task: str = ""
    """`EXPLAIN` only."""


class Gate(Struct, frozen=True, kw_only=True):
    """The rules of one server."""

    names: frozenset[str]
    """Host names besides addresses, in small letters."""
    token: str = ""
    """Empty: none is needed."""

    def judge(self, asked: Asked) -> Route | Refusal:
        """Whether a request is answered, and with what."""
        if asked.method not in METHODS:
            return Refusal(status=405, why="this page only shows", headers=(("Allow", ", ".join(METHODS)),))
        hosts = asked.headers("Host")
        if len(hosts) != 1 or not self.is_host(hosts[0]):
            return Refusal(status=421, why="this name is not one of this server's: start it with --host NAME")
        path, mark, _ = asked.target.partition("?")
        if mark:
            return Refusal(status=400, why="no query is read here, and a token does not belong into an address")
        if path in FILES:
            return Route(path=path)
        task = path.removeprefix(EXPLAIN)
        is_explain = path.startswith(EXPLAIN) and NAME.fullmatch(task) is not None
        if path not in (LIVE, STATUS, METRICS) and not is_explain:
            return Refusal(status=404, why="there is nothing under this path")
        if any(site not in ("same-origin", "none") for site in asked.headers("Sec-Fetch-Site")):
            return Refusal(status=403, why="pages of other sites may not ask")
        if not self.is_token(asked.headers("Authorization")):
            return Refusal(
                status=401, why="the token is needed", headers=(("WWW-Authenticate", 'Bearer realm="zsched"'),)
            )
        return Route(path=EXPLAIN, task=task) if is_explain else Route(path=path)

    def is_host(self, host: str) -> bool:
        """Whether a Host header is an address, or a name of this server; a port may follow.

        >>> gate = Gate(names=frozenset({"localhost"}))
        >>> [gate.is_host(host) for host in ("127.0.0.1:7459", "[::1]", "LOCALHOST:1", "evil.example", "")]
        [True, True, True, False, False]
        """
        found = _HOST.fullmatch(host)
        if found is None:
            return False
        if found["name"] is not None and found["name"].lower() in self.names:
            return True
        try:
            (ipaddress.IPv4Address if found["v6"] is None else ipaddress.IPv6Address)(found["v6"] or found["name"])
        except ValueError:
            return False
        return True

    def is_token(self, given: Sequence[str]) -> bool:
        """Whether the Authorization headers hold the token; takes as long for a wrong one as for the right one."""
        if not self.token:
            return True
        scheme, _, word = given[0].partition(" ") if len(given) == 1 else ("", "", "")
        is_same = hmac.compare_digest(_digest(word.strip()), _digest(self.token))
        return is_same and scheme.lower() == "bearer"


def _digest(word: str) -> bytes:
    """Of one length for all words, so that a comparison tells nothing of the token's."""
    return hashlib.sha256(word.encode(errors="surrogateescape")).digest()
