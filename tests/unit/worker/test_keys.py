"""A worker's keys: placeholders, and outputs that no rule takes."""

from __future__ import annotations

import pytest

from zsched.core.values.errors import ConfigError
from zsched.core.values.model import MAX_REASON
from zsched.worker.keys import IN_OUTPUTS, filled, output_keys, untaken


def test_the_prefix_is_filled_in_and_the_epoch_stays() -> None:
    assert filled("{prefix}/{epoch}/out", "edge1/t", IN_OUTPUTS) == "edge1/t/{epoch}/out"
    assert filled("{prefix}/*/in", "edge1/t") == "edge1/t/*/in"


@pytest.mark.parametrize("template", ["{prefx}/out", "{prefix}/{robot}/out", "{}/out"])
def test_an_unknown_placeholder_is_refused_with_those_that_there_are(template: str) -> None:
    with pytest.raises(ValueError, match=r"there is no placeholder .*known: \{prefix\} and \{epoch\}"):
        filled(template, "edge1/t", IN_OUTPUTS)


@pytest.mark.parametrize(
    ("key", "is_taken"),
    [
        ("edge1/t/{epoch}/out", True),
        ("edge1/t/{epoch}/robot1/out", False),
        ("edge1/t/out", False),
        ("edge1/t/map", True),
        ("edge1/t/{epoch}/map", False),
    ],
)
def test_an_output_that_no_rule_takes_is_told_with_the_rules(key: str, *, is_taken: bool) -> None:
    rules = ("edge1/t/*/out", "edge1/t/map")
    told = untaken(key, rules)
    expected = f"puts on {key}, which no output rule takes: the rules take edge1/t/*/out, edge1/t/map"
    assert told == ("" if is_taken else expected)


def test_nothing_is_told_where_nobody_has_told_the_rules_and_never_more_than_can_be_carried() -> None:
    assert untaken("edge1/t/out", ()) == ""
    assert len(untaken("a" * 3000, ("b",))) < MAX_REASON


def test_the_list_of_keys_is_checked() -> None:
    assert output_keys("") == ()
    assert output_keys('["a/*", "b"]') == ("a/*", "b")
    for text in ("{", '{"a": 1}', "[1]", '["a//b"]'):
        with pytest.raises(ConfigError, match="ZSCHED_OUTPUT_KEYS"):
            output_keys(text)
