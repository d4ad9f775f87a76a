"""Names in certificates: whom they name, and which keys of a name are let in."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zsched.core.values.certificates import MAX_KEY, Holder, Role, accepted, parse_common_name, parse_label

NAMES = st.from_regex(r"[a-z0-9][a-z0-9_-]{0,20}", fullmatch=True)
HOLDERS = st.builds(Holder, name=NAMES, role=st.sampled_from(Role), key=st.integers(1, MAX_KEY))


@given(HOLDERS, NAMES)
def test_a_label_and_a_common_name_are_read_as_they_were_written(holder: Holder, fleet: str) -> None:
    assert parse_label(holder.label) == holder
    assert parse_common_name(holder.common_name(fleet), fleet) == holder


@given(HOLDERS, HOLDERS)
def test_two_holders_never_have_one_label(one: Holder, other: Holder) -> None:
    assert (one == other) == (one.label == other.label)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "Robot1",
        "robot1.",
        "robot1.k1",
        "robot1.k0",
        "robot1.k10000",
        "robot1.k02",
        "a.operator.guest",
        "a.b",
        "a.k2.k3",
    ],
)
def test_what_is_no_label_names_nobody(text: str) -> None:
    assert parse_label(text) is None


@pytest.mark.parametrize(
    "text",
    [
        "robot1",
        "robot1.yard",
        "robot1.yard.zsched.internal.evil.com",
        "robot1.field.zsched.internal",
        ".yard.zsched.internal",
    ],
)
def test_names_of_elsewhere_name_nobody(text: str) -> None:
    assert parse_common_name(text, "yard") is None


def test_the_key_after_the_highest_revoked_one_is_let_in_and_no_revoked_one() -> None:
    def keys(*revoked: str) -> list[int]:
        return [one.key for one in accepted("ana", Role.OPERATOR, revoked)]

    assert keys() == [1]
    assert keys("ana.operator") == [2]
    assert keys("ana.operator.k2") == [1, 3]
    assert keys("ana.operator", "ana.operator.k2") == [3]
    assert keys("ana", "ana.guest", "bob.operator", "no label") == [1]
