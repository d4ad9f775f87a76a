from __future__ import annotations

import pytest
import zenoh
from hypothesis import assume, given
from hypothesis import strategies as st

from zsched.core.keyexpr import is_valid, matches
from zsched.relay.rewrite import rewriter


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


def test_a_wildcard_that_nothing_fills_is_refused() -> None:
    with pytest.raises(ValueError, match="more wildcards"):
        rewriter("robot1/map", "edge1/*")


CHUNKS = st.sampled_from(["a", "b", "ab", "*", "**", "a$*"])


@given(
    st.lists(CHUNKS, min_size=1, max_size=5), st.lists(st.sampled_from(["a", "b", "ab", "@a"]), min_size=1, max_size=5)
)
def test_it_rewrites_exactly_what_zenoh_delivers(expr_chunks: list[str], key_chunks: list[str]) -> None:
    expr, key = "/".join(expr_chunks), "/".join(key_chunks)
    assume(is_valid(expr) and "*" in expr)
    result = rewriter(expr, f"to/{expr}")(key)
    assert (result is not None) == matches(expr, key) == zenoh.KeyExpr(expr).includes(key)
    if result is not None:
        assert result == f"to/{key}"
        zenoh.KeyExpr(result)
