"""What a rule's wildcards capture goes to the same place on the other side, and can be brought back."""

from __future__ import annotations

import doctest

import pytest
import zenoh
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from zsched.core.route import wildcards as capture
from zsched.core.route.keyexpr import fault, matches
from zsched.core.route.wildcards import KEPT_OWNERS, Rewriting, ambiguity, capture_fault, rewriter, wildcards


@pytest.mark.parametrize(
    ("from_expr", "to_expr", "key", "result"),
    [
        ("robot1/map", "edge1/map_merge/robot1/map", "robot1/map", "edge1/map_merge/robot1/map"),
        ("robot1/*/scan", "edge1/t/*", "robot1/front/scan", "edge1/t/front"),
        ("robot1/**", "edge1/t/**", "robot1/a/b", "edge1/t/a/b"),
        ("robot1/**", "edge1/t/**", "robot1", "edge1/t"),
        ("robot1/**/scan", "edge1/**/s", "robot1/scan", "edge1/s"),
        ("0/map/*/*", "0/edge1/map/*/*", "0/map/nav_msgs::msg::dds_::OccupancyGrid_/RIHS01_ab", None),
        ("robot1/cam$*/raw", "edge1/cam$*/raw", "robot1/cam7/raw", "edge1/cam7/raw"),
        ("robot1/*/*", "edge1/*", "robot1/a/b", "edge1/a"),
        ("robot1/*", "edge1/all", "robot1/a", "edge1/all"),
    ],
)
def test_the_nth_wildcard_takes_what_the_nth_matched(
    from_expr: str, to_expr: str, key: str, result: str | None
) -> None:
    expected = result if result is not None else key.replace("0/map/", "0/edge1/map/")
    assert rewriter(from_expr, to_expr)(key) == expected


@pytest.mark.parametrize("key", ["robot1/@zsched/map", "robot2/x/map", "robot1/map", "robot1/a/b/map"])
def test_what_from_does_not_match_is_not_rewritten(key: str) -> None:
    assert rewriter("robot1/*/map", "edge1/*/map")(key) is None


@pytest.mark.parametrize(
    ("from_expr", "to_expr", "why"),
    [
        ("robot1/map", "edge1/*", "more wildcards"),
        ("robot1/*", "edge1/**", "wildcard 1 of 'to' is '**'"),
        ("robot1/*/**", "edge1/*/*", "wildcard 2"),
    ],
)
def test_a_wildcard_that_nothing_fits_is_refused(from_expr: str, to_expr: str, why: str) -> None:
    assert why in (capture_fault(from_expr, to_expr) or "")
    with pytest.raises(ValueError, match="wildcard"):
        rewriter(from_expr, to_expr)


CHUNKS = st.sampled_from(["a", "b", "ab", "*", "**", "a$*"])
PLAIN = st.sampled_from(["a", "b", "ab", "abc"])
KEYS = st.lists(st.sampled_from(["a", "b", "ab", "@a"]), min_size=1, max_size=5)


@given(st.lists(CHUNKS, min_size=1, max_size=5), KEYS)
def test_it_rewrites_exactly_what_zenoh_delivers(expr_chunks: list[str], key_chunks: list[str]) -> None:
    expr, key = "/".join(expr_chunks), "/".join(key_chunks)
    assume(fault(expr) is None and "*" in expr)
    result = rewriter(expr, f"to/{expr}")(key)
    assert (result is not None) == matches(expr, key) == zenoh.KeyExpr(expr).includes(key)
    if result is not None:
        assert result == f"to/{key}"
        zenoh.KeyExpr(result)


def filled(expr: str, captured: list[str]) -> str:
    """One key that ``expr`` matches: each wildcard replaced by the next of ``captured`` (``**``: by two or none)."""
    values = iter(captured)
    chunks = []
    for chunk in expr.split("/"):
        if chunk == "**":
            value = next(values)
            chunks += [] if value == "a" else [value, value]
        else:
            chunks.append(next(values) if chunk == "*" else chunk.replace("$*", "7"))
    return "/".join(chunks)


@settings(max_examples=500)
@given(
    st.lists(CHUNKS, min_size=1, max_size=5),
    st.lists(st.lists(PLAIN, max_size=2), min_size=6, max_size=6),
    st.lists(PLAIN, min_size=5, max_size=5),
)
def test_rewriting_back_gives_the_key_again(
    from_chunks: list[str], between: list[list[str]], captured: list[str]
) -> None:
    from_expr = "/".join(from_chunks)
    to_chunks = ["edge1", *between[0]]
    for wild, more in zip(wildcards(from_expr), between[1:], strict=False):
        to_chunks += [f"c{wild}" if wild == "$*" else wild, *more]
    to_expr = "/".join(to_chunks)
    assume(fault(from_expr) is None and fault(to_expr) is None and ambiguity(from_expr) is None)
    key = filled(from_expr, captured)
    assume(key != "")
    there = rewriter(from_expr, to_expr)(key)
    assert there is not None
    assert zenoh.KeyExpr(to_expr).includes(there)
    assert rewriter(to_expr, from_expr)(there) == key


def test_two_keys_never_become_one_unless_a_wildcard_is_dropped() -> None:
    keep, drop = rewriter("r/*/*", "e/*/x/*"), rewriter("r/*/*", "e/*")
    assert keep("r/a/b") != keep("r/a/c")
    assert drop("r/a/b") == drop("r/a/c")


@pytest.mark.parametrize("expr", ["a/**/b/**", "cam$*x$*/raw"])
def test_an_expression_that_can_be_read_two_ways_is_ambiguous(expr: str) -> None:
    assert "more than one" in (ambiguity(expr) or "")


def test_examples_in_the_module_hold() -> None:
    assert doctest.testmod(capture).failed == 0


def test_keys_of_several_owners_lead_to_one_place() -> None:
    rewriting = Rewriting("edge1/merge/1/robot1/**", "robot1/merged/**")
    assert rewriting.key("edge1/merge/1/robot1/a") == "robot1/merged/a"
    assert rewriting.key("edge2/merge/2/robot1/a") is None
    rewriting.also_from("edge2/merge/2/robot1/**")
    assert rewriting.key("edge2/merge/2/robot1/b") == "robot1/merged/b"
    assert rewriting.key("edge1/merge/1/robot1/a") == "robot1/merged/a", "what the former owner still sends"
    for number in range(KEPT_OWNERS):
        rewriting.also_from(f"edge1/merge/{number + 3}/robot1/**")
    assert rewriting.key("edge1/merge/1/robot1/a") is None, "it is forgotten"


def test_an_owner_that_comes_back_is_the_newest_and_forgotten_last() -> None:
    """Without an epoch in its ``from`` an owner has the same one each time."""
    rewriting = Rewriting("edge0/merge/*", "robot1/merged/*")
    for number in (*range(1, KEPT_OWNERS), 0, KEPT_OWNERS):
        rewriting.also_from(f"edge{number}/merge/*")
    assert rewriting.key("edge0/merge/a") == "robot1/merged/a", "it has just been left, and still sends"
    assert rewriting.key("edge1/merge/a") is None, "it is forgotten"


def test_where_one_key_is_meant_every_owner_s_leads_to_it() -> None:
    rewriting = Rewriting("edge1/merge/1/robot1/map", "robot1/merged")
    rewriting.also_from("edge2/merge/2/robot1/map")
    assert (rewriting.is_wild, rewriting.key("edge2/merge/2/robot1/map")) == (False, "robot1/merged")
