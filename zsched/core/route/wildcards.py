"""Decides a sample's new key when a rule's expressions hold wildcards, and which wildcards go together.

Knows: key expressions as text. Does not know: zenoh, streams, templates, its callers.

The n-th wildcard of ``to`` stands for the match of the n-th wildcard of ``from``. Both are of one kind, so the match
always fits. A ``to`` with as many wildcards as ``from`` can be inverted: `rewriter` with the two expressions swapped
gives every key back. (That is why a side may hold only one ``**``: with two, the end of the first would be unknown.) A
``to`` with fewer wildcards drops the last ones, and several keys become one.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Final

from zsched.core.route.keyexpr import ANY_RUN, DOUBLE, is_wild

KEPT_OWNERS: Final = 4
"""Newest owners whose keys still find their way."""

Rewriter = Callable[[str], str | None]

_WILD: Final = re.compile(r"\*\*|\$\*|\*")


def wildcards(expr: str) -> tuple[str, ...]:
    """The wildcards of an expression (or of a template), in order.

    >>> wildcards("robot1/*/cam$*/**")
    ('*', '$*', '**')
    """
    return tuple(_WILD.findall(expr))


def ambiguity(expr: str) -> str | None:
    """Why the meaning of each wildcard of ``expr`` would be unclear; ``None`` when it is clear."""
    if wildcards(expr).count(DOUBLE) > 1:
        return "it has more than one '**': where the first one ends could not be told"
    if any(chunk.count(ANY_RUN) > 1 for chunk in expr.split("/")):
        return "a chunk of it has more than one '$*': where the first one ends could not be told"
    return None


def capture_fault(from_expr: str, to_expr: str) -> str | None:
    """Why the matches of ``from_expr`` cannot fill ``to_expr``; ``None`` when they can."""
    sources, places = wildcards(from_expr), wildcards(to_expr)
    if len(places) > len(sources):
        return f"{to_expr!r} has more wildcards than {from_expr!r} can fill"
    for number, (source, place) in enumerate(zip(sources, places, strict=False), start=1):
        if source != place:
            return f"wildcard {number} of 'to' is {place!r}, but the one that fills it is {source!r}"
    return None


def rewriter(from_expr: str, to_expr: str) -> Rewriter:
    """A function from a key that ``from_expr`` matches to its key under ``to_expr`` (``None``: it does not match).

    Raises:
        ValueError: ``to_expr`` cannot be filled (see `capture_fault`).
    """
    problem = capture_fault(from_expr, to_expr)
    if problem is not None:
        raise ValueError(problem)
    pattern = _pattern(from_expr)

    def rewrite(key: str) -> str | None:
        match = pattern.fullmatch("/" + key)
        return None if match is None else _fill(to_expr, match.groups())

    return rewrite


class Rewriting:
    """From the keys of one or several owners to those of one place; for one thread."""

    def __init__(self, from_expr: str, to_expr: str) -> None:
        """Raises `ValueError`: ``to_expr`` cannot be filled from ``from_expr``."""
        self.is_wild = is_wild(to_expr)
        """Whether several keys lead there."""
        self._to = to_expr
        self._rewriters: dict[str, Rewriter] = {from_expr: rewriter(from_expr, to_expr)}

    def also_from(self, from_expr: str) -> None:
        """Take keys of another owner, too: its ``from`` captures what fills the wildcards of ``to``.

        Raises:
            ValueError: ``to`` cannot be filled from it.
        """
        made = rewriter(from_expr, self._to)
        self._rewriters.pop(from_expr, None)  # one that comes back is the newest again
        self._rewriters[from_expr] = made
        while len(self._rewriters) > KEPT_OWNERS:
            self._rewriters.pop(next(iter(self._rewriters)))

    def key(self, key: str) -> str | None:
        """The new key, by the newest owner whose ``from`` the old one matches; ``None``: it fits none."""
        if not self.is_wild:
            return self._to
        for rewrite in reversed(tuple(self._rewriters.values())):
            if (result := rewrite(key)) is not None:
                return result
        return None


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
