"""Decides under which key a stream's samples go on towards one place: `zsched.core.route.wildcards`, for several.

Knows: the ``from`` of the newest owners. Does not know: zenoh, streams, callers. The outlet's thread alone uses it.
"""

from __future__ import annotations

from typing import Final

from zsched.core.route.keyexpr import is_wild
from zsched.core.route.wildcards import Rewriter, rewriter

KEPT_OWNERS: Final = 4


class Rewriting:
    """From the keys of one or several owners to those of one place."""

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
        self._rewriters[from_expr] = rewriter(from_expr, self._to)
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
