"""The best moves in hindsight, moves paid: exact, for one task and for several together.

Knows: dynamic programming over placements. Does not know: machines, rules.
"""

from __future__ import annotations

import numpy as np

from zsched_lab.decisions.loads import Array


def best_path(worth: Array, price: Array, shape: tuple[int, ...]) -> tuple[float, list[int]]:
    """(worth of the best sequence of placements, moves paid; the placement in every stretch).

    Viterbi over all placements of all tasks at once. Every task that moves costs its own price, so moves of several
    tasks are taken one task after the other, which is exact: the price of a change is the sum over the tasks that it
    moves.
    Within a stretch nothing changes, so a move in its middle is never better than one at its beginning.

    Args:
        worth: [S, P] of each of P placements in each stretch.
        price: [S, K] of a move of each task as each stretch begins, in the unit of ``worth``.
        shape: candidates of every of the K tasks; P is its product.
    """
    value = worth[0].reshape(shape)
    moved: list[list[tuple[Array, Array]]] = []
    for gain, prices in zip(worth[1:], price[1:], strict=True):
        choices: list[tuple[Array, Array]] = []
        for axis in range(len(shape)):
            best = value.max(axis=axis, keepdims=True) - prices[axis]
            choices.append((value >= best, np.broadcast_to(value.argmax(axis=axis, keepdims=True), shape)))
            value = np.maximum(value, best)
        moved.append(choices)
        value = value + gain.reshape(shape)
    last = int(value.argmax())
    placed = list(np.unravel_index(last, shape))
    path = [last]
    for choices in reversed(moved):
        for axis in reversed(range(len(shape))):
            stays, origin = choices[axis]
            if not stays[tuple(placed)]:
                placed[axis] = origin[tuple(placed)]
        path.append(int(np.ravel_multi_index(placed, shape)))
    path.reverse()
    return float(value.max()), path
