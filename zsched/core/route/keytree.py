"""Finds the key expressions that share a key with a given one, without a comparison with each of them.

Knows: chunks, wildcards. Does not know: rules, the purpose of the expressions.

A tree by chunks gives the few candidates (below a ``**``, all of them), and `keyexpr.intersects` decides. If the
expressions differ in a plain chunk, a question costs about as many steps as it has chunks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

from zsched.core.route import keyexpr


class _Branch:
    """All expressions that begin alike."""

    __slots__ = ("below", "deep", "ends", "wild")

    def __init__(self) -> None:
        self.below: dict[str, _Branch] = {}
        self.wild: list[_Branch] = []
        """Those of ``below`` whose chunk holds a wildcard."""
        self.deep: list[int] = []
        """Those that go on with ``**``: whatever comes, they may meet it."""
        self.ends: list[int] = []

    def all(self) -> Iterator[int]:
        yield from self.deep
        yield from self.ends
        for branch in self.below.values():
            yield from branch.all()


class KeyTree:
    """Numbered key expressions (valid), from 0 in the order given."""

    def __init__(self, exprs: Iterable[str], spend: Callable[[int], None] = lambda _count: None) -> None:
        """``spend`` hears how many are about to be compared, and may raise to end it."""
        self._spend = spend
        self._exprs = tuple(exprs)
        self._root = _Branch()
        for number, expr in enumerate(self._exprs):
            self._add(number, expr.split("/"))

    def meeting(self, expr: str) -> list[int]:
        """The numbers of all that share a key with ``expr``, in order."""
        may = sorted(self._near(self._root, expr.split("/"), 0))
        self._spend(len(may))
        return [number for number in may if keyexpr.intersects(expr, self._exprs[number])]

    def _add(self, number: int, chunks: list[str]) -> None:
        branch = self._root
        for chunk in chunks:
            if chunk == keyexpr.DOUBLE:
                branch.deep.append(number)
                return
            if chunk not in branch.below:
                branch.below[chunk] = _Branch()
                if "*" in chunk:
                    branch.wild.append(branch.below[chunk])
            branch = branch.below[chunk]
        branch.ends.append(number)

    def _near(self, branch: _Branch, chunks: list[str], at: int) -> Iterator[int]:
        if at < len(chunks) and chunks[at] == keyexpr.DOUBLE:
            yield from branch.all()
            return
        yield from branch.deep
        if at == len(chunks):
            yield from branch.ends
            return
        chunk = chunks[at]
        if "*" in chunk:
            nexts = list(branch.below.values())
        else:
            nexts = [*branch.wild, *([branch.below[chunk]] if chunk in branch.below else [])]
        for one in nexts:
            yield from self._near(one, chunks, at + 1)
