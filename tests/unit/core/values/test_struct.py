"""Structs: what `dataclasses` sees of one, and what `replace` checks."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from zsched.core.values.struct import Struct, field, replace


class Shelf(Struct, frozen=True, kw_only=True):
    """Has every sort of field."""

    width: int
    label: str = "top"
    books: dict[str, int] = field(default_factory=lambda: {"atlas": 1})
    slots: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        if self.width < 1:
            raise ValueError("width: at least 1")


class Deep(Shelf, frozen=True, kw_only=True):
    """Adds one."""

    depth: int


ANY: Any = Shelf


def test_dataclasses_sees_the_fields_in_order_with_types_and_defaults() -> None:
    found: list[Any] = list(dataclasses.fields(ANY))
    assert [(one.name, one.type) for one in found] == [
        ("width", "int"),
        ("label", "str"),
        ("books", "dict[str, int]"),
        ("slots", "list[int]"),
    ]
    missing = dataclasses.MISSING
    assert [one.default for one in found] == [missing, "top", missing, missing]
    assert found[0].default_factory is missing
    assert found[2].default_factory() == {"atlas": 1}
    assert found[3].default_factory() == []
    assert dataclasses.is_dataclass(ANY)
    assert [one.name for one in dataclasses.fields(Deep)] == ["width", "label", "books", "slots", "depth"]


@pytest.mark.parametrize("change", [replace, dataclasses.replace])
def test_replace_keeps_the_other_fields_and_checks_again(change: Any) -> None:
    shelf = Shelf(width=2, label="low")
    assert change(shelf, width=3) == Shelf(width=3, label="low")
    assert shelf.width == 2
    with pytest.raises(ValueError, match="at least 1"):
        change(shelf, width=0)
    with pytest.raises(TypeError, match="height"):
        change(shelf, height=1)


def test_replace_takes_a_dataclass_too() -> None:
    @dataclasses.dataclass(frozen=True)
    class Plain:
        one: int

    assert replace(Plain(1), one=2) == Plain(2)


def test_a_made_default_is_no_other_structs() -> None:
    one, other = Shelf(width=1), Shelf(width=1)
    one.books["map"] = 2
    assert other.books == {"atlas": 1}
