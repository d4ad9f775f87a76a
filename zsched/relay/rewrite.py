"""Decides under which key a sample goes on, when a route's expressions hold wildcards.

Knows: key expressions as text. Does not know: zenoh, streams, who asks.

The n-th wildcard of ``to`` stands for what the n-th wildcard of ``from`` matched. A ``to`` with fewer wildcards drops
the rest (many keys become one); a ``to`` with more than ``from`` has no meaning and is refused.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Final

from zsched.core.keyexpr import is_wild

Rewriter = Callable[[str], str | None]

_WILD: Final = re.compile(r"\*\*|\$\*|\*")


def rewriter(from_expr: str, to_expr: str) -> Rewriter:
    """A function from a key that ``from_expr`` matches to its key under ``to_expr`` (``None``: it does not match).

    Raises:
        ValueError: ``to_expr`` has more wildcards than ``from_expr``.
    """
    if len(_WILD.findall(to_expr)) > len(_WILD.findall(from_expr)):
        raise ValueError(f"{to_expr!r} has more wildcards than {from_expr!r} can fill")
    if not is_wild(to_expr):
        return lambda _key: to_expr
    pattern = _pattern(from_expr)

    def rewrite(key: str) -> str | None:
        match = pattern.fullmatch("/" + key)
        return None if match is None else _fill(to_expr, match.groups())

    return rewrite


def _pattern(expr: str) -> re.Pattern[str]:
    """A pattern over ``"/" + key``, one group per wildcard; ``**`` may match no chunk, none a verbatim one."""
    parts = []
    for chunk in expr.split("/"):
        if chunk == "**":
            parts.append(r"((?:/[^/@][^/]*)*)")
        elif chunk == "*":
            parts.append(r"/([^/@][^/]*)")
        else:
            parts.append("/" + "([^/]*)".join(re.escape(piece) for piece in chunk.split("$*")))
    return re.compile("".join(parts))


def _fill(to_expr: str, captures: tuple[str, ...]) -> str:
    values = iter(captures)
    filled = _WILD.sub(lambda _match: next(values).strip("/"), to_expr)
    return "/".join(chunk for chunk in filled.split("/") if chunk)
