"""zenoh's own KeyExpr is the reference for every answer."""

import doctest
import itertools

import pytest
import zenoh
from hypothesis import given, settings
from hypothesis import strategies as st

from zsched.core.route import keyexpr

PIECES = ("a", "b", "ab", "*", "**", "$*", "@a", "@", "a$*", "$*a", "$*b$*", "a$*b", "$*@a", "@a$*", "é", "x y", "{r}")
FAULTY = ("", "#", "a?", "$", "a*", "**a", "$**", "a$*$*b", "@*", "a$b")

chunks = st.sampled_from(PIECES)
texts = st.lists(chunks, min_size=1, max_size=6).map("/".join)
any_text = st.one_of(
    texts,
    st.lists(st.sampled_from(PIECES + FAULTY), min_size=1, max_size=4).map("/".join),
    st.text(alphabet="ab*$@/#?", max_size=10),
    st.text(max_size=12),
)


def reference(text: str) -> zenoh.KeyExpr | None:
    try:
        return zenoh.KeyExpr(text)
    except zenoh.ZError:
        return None


valid_texts = texts.filter(lambda text: reference(text) is not None)


@settings(max_examples=250, deadline=None)
@given(any_text)
def test_validity_is_zenohs(text: str) -> None:
    assert (keyexpr.fault(text) is None) == (reference(text) is not None), keyexpr.fault(text)


@settings(max_examples=250, deadline=None)
@given(valid_texts, valid_texts)
def test_intersects_is_zenohs(first: str, second: str) -> None:
    expected = zenoh.KeyExpr(first).intersects(zenoh.KeyExpr(second))
    assert keyexpr.intersects(first, second) == expected
    assert keyexpr.intersects(second, first) == expected


@settings(max_examples=250, deadline=None)
@given(valid_texts, valid_texts)
def test_includes_is_zenohs(outer: str, inner: str) -> None:
    assert keyexpr.includes(outer, inner) == zenoh.KeyExpr(outer).includes(zenoh.KeyExpr(inner))


@st.composite
def related_pair(draw: st.DrawFn) -> tuple[str, str]:
    """An expression and one made from it by opening or closing chunks: most pairs meet, unlike two random ones."""
    parts = draw(st.lists(st.sampled_from(("a", "ab", "aab", "@a", "b")), min_size=1, max_size=6))
    opened = [draw(st.sampled_from((part, part, "*", "**", "a$*", "$*b", "$*a$*"))) for part in parts]
    return "/".join(parts), "/".join(opened)


@settings(max_examples=250, deadline=None)
@given(related_pair(), related_pair())
def test_relations_of_related_expressions_are_zenohs(left: tuple[str, str], right: tuple[str, str]) -> None:
    pool = [text for text in (*left, *right) if reference(text) is not None]
    for first in pool:
        for second in pool:
            one, two = zenoh.KeyExpr(first), zenoh.KeyExpr(second)
            assert keyexpr.intersects(first, second) == one.intersects(two), (first, second)
            assert keyexpr.includes(first, second) == one.includes(two), (first, second)


FEW = [
    "/".join(parts)
    for parts in (
        *itertools.product(("a", "ab", "*", "**", "$*b", "a$*", "@a")),
        *itertools.product(("a", "*", "**", "a$*b", "@a"), ("b", "*", "**", "$*b")),
        *itertools.product(("a", "**"), ("*", "b$*b"), ("a", "**", "@b")),
        *itertools.product(("$*a$*", "a$*a", "$*a$*b", "aab", "ba")),
    )
]


def test_relations_of_all_pairs_of_few_expressions_are_zenohs() -> None:
    """Each shape against each other one: quick, and whole where random pairs are neither."""
    known = {text: key for text in FEW if (key := reference(text)) is not None}
    assert len(known) > 30
    for (first, one), (second, two) in itertools.product(known.items(), repeat=2):
        assert keyexpr.intersects(first, second) == one.intersects(two), (first, second)
        assert keyexpr.includes(first, second) == one.includes(two), (first, second)


def test_matches_hides_verbatim_chunks_from_wildcards() -> None:
    assert keyexpr.matches("**", "robot1/map")
    assert not keyexpr.matches("**", "@zsched/fleet/beat/robot1")
    assert not keyexpr.matches("robot1/**", "robot1/map/@zsched/end")
    assert keyexpr.matches("robot1/**/@zsched/end", "robot1/map/@zsched/end")


def test_long_hostile_expressions_stay_quick() -> None:
    first, second = "/".join(["**", "a"] * 60), "/".join(["a", "**"] * 60)
    assert keyexpr.intersects(first, second)
    run = "a" + "$*a" * 60
    assert keyexpr.includes(run, "a" * 120)


@pytest.mark.parametrize(
    ("text", "said"),
    [("a/**/*", "'*/**'"), ("/a", "empty chunk"), ("a*", "'$*'"), ("a#b", "'#'"), ("", "empty"), ("a/$*", "'*'")],
)
def test_fault_says_what_to_write(text: str, said: str) -> None:
    assert said in (keyexpr.fault(text) or "")


def test_examples_in_the_module_hold() -> None:
    assert doctest.testmod(keyexpr).failed == 0
