"""The tree finds just what comparing with every expression finds, and looks at few of them."""

from __future__ import annotations

from random import Random

from hypothesis import given
from hypothesis import strategies as st

from zsched.core.route import keyexpr
from zsched.core.route.keytree import KeyTree

CHUNKS = ("a", "b", "ab", "*", "**", "a$*", "$*b", "@a", "@b")
EXPRS = st.lists(st.sampled_from(CHUNKS), min_size=1, max_size=5).map("/".join).map(keyexpr.canonical)


@given(st.lists(EXPRS, max_size=20), EXPRS)
def test_it_finds_what_comparing_each_finds(exprs: list[str], asked: str) -> None:
    every = [number for number, expr in enumerate(exprs) if keyexpr.intersects(asked, expr)]
    assert KeyTree(exprs).meeting(asked) == every


def test_of_many_that_differ_in_a_plain_chunk_it_looks_at_one() -> None:
    looked: list[int] = []
    tree = KeyTree((f"*/task{number}/*/in" for number in range(10_000)), looked.append)
    rng = Random(1)
    for _ in range(100):
        number = rng.randrange(10_000)
        assert tree.meeting(f"robot1/task{number}/*/in") == [number]
    assert looked == [1] * 100
