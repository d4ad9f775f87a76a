"""The error tree: everything raised on purpose has one parent, and a wire error has its counter's word."""

from __future__ import annotations

import re

import pytest

from zsched.core.values import errors
from zsched.core.values.errors import AdapterError, ConfigError, InvariantError, WireError, ZschedError


@pytest.mark.parametrize("kind", [ConfigError, WireError, AdapterError, InvariantError])
def test_error_is_caught_as_zsched_error(kind: type[ZschedError]) -> None:
    with pytest.raises(ZschedError, match="why"):
        raise kind("why")


def test_wire_error_keeps_the_reason_for_the_counter() -> None:
    assert (WireError("size").reason, str(WireError("size"))) == ("size", "size")
    assert (WireError("size", "9 bytes").reason, str(WireError("size", "9 bytes"))) == ("size", "size: 9 bytes")


def test_drawn_tree_names_every_error() -> None:
    drawn = set(re.findall(r"^(?:[├└]── )?(\w+Error)\b", errors.__doc__ or "", flags=re.MULTILINE))
    defined = {name for name, value in vars(errors).items() if isinstance(value, type)}
    assert drawn == defined
