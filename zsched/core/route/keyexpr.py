"""Decides which keys a zenoh key expression matches, and how two expressions relate.

Knows: the key expression language of zenoh 1.10. Does not know: zenoh itself, templates, streams.

A key expression is chunks joined by ``/``. ``*`` stands for exactly one chunk, ``**`` for any number of chunks (zero
too), ``$*`` inside a chunk for any run of characters (empty too). A chunk that starts with ``@`` is *verbatim*: it
equals only itself, and no wildcard stands for it. ``#`` and ``?`` belong to endpoints and selectors. Only the canonical
spelling is valid, so that equal sets of keys are equal strings.

Source: zenoh's key expression language (`zenoh_keyexpr`); tests compare every function with `zenoh.KeyExpr`.
"""

from __future__ import annotations

import itertools
from typing import Final

SINGLE: Final = "*"
DOUBLE: Final = "**"
ANY_RUN: Final = "$*"
VERBATIM: Final = "@"


def fault(expr: str) -> str | None:
    """Why ``expr`` is not a valid canonical key expression, in words for an operator; ``None`` when it is one.

    >>> fault("a/**/*")
    "'**/*' must be written '*/**'"
    """
    if not expr:
        return "it is empty"
    chunks = expr.split("/")
    for chunk in chunks:
        problem = _chunk_fault(chunk)
        if problem is not None:
            return problem
    for left, right in itertools.pairwise(chunks):
        if left == DOUBLE and right == DOUBLE:
            return "'**/**' must be written '**'"
        if left == DOUBLE and right == SINGLE:
            return "'**/*' must be written '*/**'"
    return None


def is_wild(expr: str) -> bool:
    """True when ``expr`` (valid) stands for more than one key."""
    return "*" in expr


def canonical(expr: str) -> str:
    """The canonical spelling of ``expr``, whose chunks are valid by themselves: ``**`` behind ``*``, and once.

    >>> canonical("a/**/*/**/b")
    'a/*/**/b'
    """
    chunks: list[str] = []
    for chunk in expr.split("/"):
        if chunk == DOUBLE and chunks[-1:] == [DOUBLE]:
            continue
        if chunk == SINGLE and chunks[-1:] == [DOUBLE]:
            chunks.insert(len(chunks) - 1, SINGLE)
            continue
        chunks.append(chunk)
    return "/".join(chunks)


def intersects(first: str, second: str) -> bool:
    """True when some key matches both expressions (both valid).

    >>> intersects("robot1/**", "*/map"), intersects("robot1/**", "robot1/@adv/map")
    (True, False)
    """
    if first == second:
        return True
    left, right = first.split("/"), second.split("/")
    if not (is_wild(first) or is_wild(second)):
        return False
    # reach[j] answers "do left[i:] and right[j:] share a key?" for the i of the current turn, built from the ends
    reach = _intersects_end(right)
    for chunk in reversed(left):
        reach = _intersects_row(chunk, right, reach)
    return reach[0]


def includes(outer: str, inner: str) -> bool:
    """True when every key that ``inner`` matches is matched by ``outer`` (both valid).

    >>> includes("a/**", "a"), includes("a/*", "a/**")
    (True, False)
    """
    if outer == inner:
        return True
    if not is_wild(outer):
        return False
    chunks = inner.split("/")
    row = [False] * len(chunks) + [True]
    for chunk in reversed(outer.split("/")):
        row = _includes_row(chunk, chunks, row)
    return row[0]


def matches(expr: str, key: str) -> bool:
    """True when the concrete ``key`` (no wildcards) is one of those that ``expr`` stands for."""
    return includes(expr, key)


# --- chunks ----------------------------------------------------------------------------------------------------------


def _chunk_fault(chunk: str) -> str | None:
    if not chunk:
        return "it has an empty chunk (a leading, trailing or double '/')"
    if chunk in (SINGLE, DOUBLE):
        return None
    if "#" in chunk or "?" in chunk:
        return "'#' and '?' may not stand in a key"
    if chunk == ANY_RUN:
        return "a chunk '$*' must be written '*'"
    if ANY_RUN + "$" in chunk:
        return "'$*$*' must be written '$*'"
    rest = chunk.replace(ANY_RUN, "")
    if "*" in rest:
        return f"'*' in {chunk!r} stands for a whole chunk; inside a chunk write '$*'"
    if "$" in rest:
        return f"'$' in {chunk!r} may stand only in '$*'"
    return None


def _is_verbatim(chunk: str) -> bool:
    return chunk.startswith(VERBATIM)


def _chunks_intersect(first: str, second: str) -> bool:
    """Two chunks, neither of them ``**``."""
    if first == second:
        return True
    if _is_verbatim(first) or _is_verbatim(second):
        return False
    if SINGLE in (first, second):
        return True
    if ANY_RUN not in first and ANY_RUN not in second:
        return False
    return _runs_intersect(_tokens(first), _tokens(second))


def _chunk_includes(outer: str, inner: str) -> bool:
    """Two chunks, neither of them ``**``."""
    if outer == inner:
        return True
    if _is_verbatim(outer) or _is_verbatim(inner) or inner == SINGLE:
        return False
    if outer == SINGLE:
        return True
    if ANY_RUN not in outer:
        return False
    return _run_includes(_tokens(outer), _tokens(inner))


def _tokens(chunk: str) -> list[str]:
    """The characters of a chunk, each ``$*`` as one token."""
    tokens: list[str] = []
    for index, part in enumerate(chunk.split(ANY_RUN)):
        if index:
            tokens.append(ANY_RUN)
        tokens.extend(part)
    return tokens


def _runs_intersect(first: list[str], second: list[str]) -> bool:
    reach = [True]
    for token in reversed(second):
        reach.insert(0, token == ANY_RUN and reach[0])
    for token in reversed(first):
        row = [False] * len(second) + [token == ANY_RUN and reach[-1]]
        for j in range(len(second) - 1, -1, -1):
            if token == ANY_RUN:
                row[j] = reach[j] or row[j + 1]
            elif second[j] == ANY_RUN:
                row[j] = row[j + 1] or reach[j]
            else:
                row[j] = token == second[j] and reach[j + 1]
        reach = row
    return reach[0]


def _run_includes(outer: list[str], inner: list[str]) -> bool:
    row = [False] * len(inner) + [True]
    for token in reversed(outer):
        new = [False] * len(inner) + [token == ANY_RUN and row[-1]]
        for j in range(len(inner) - 1, -1, -1):
            if token == ANY_RUN:
                new[j] = row[j] or new[j + 1]
            else:
                new[j] = token == inner[j] and row[j + 1]
        row = new
    return row[0]


# --- rows of the two tables ------------------------------------------------------------------------------------------


def _intersects_end(right: list[str]) -> list[bool]:
    """The row after the last left chunk: only ``**`` may be left over on the right."""
    row = [True]
    for chunk in reversed(right):
        row.insert(0, chunk == DOUBLE and row[0])
    return row


def _intersects_row(chunk: str, right: list[str], below: list[bool]) -> list[bool]:
    row = [False] * len(right) + [chunk == DOUBLE and below[-1]]
    for j in range(len(right) - 1, -1, -1):
        if chunk == DOUBLE:
            row[j] = below[j] or (row[j + 1] and not _is_verbatim(right[j]))
        elif right[j] == DOUBLE:
            row[j] = row[j + 1] or (below[j] and not _is_verbatim(chunk))
        else:
            row[j] = below[j + 1] and _chunks_intersect(chunk, right[j])
    return row


def _includes_row(chunk: str, inner: list[str], below: list[bool]) -> list[bool]:
    row = [False] * len(inner) + [chunk == DOUBLE and below[-1]]
    for j in range(len(inner) - 1, -1, -1):
        if chunk == DOUBLE:
            row[j] = below[j] or (row[j + 1] and not _is_verbatim(inner[j]))
        elif inner[j] != DOUBLE:
            row[j] = below[j + 1] and _chunk_includes(chunk, inner[j])
    return row
