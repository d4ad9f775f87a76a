"""The error tree: everything raised on purpose has one parent, and a wire error has its counter's word."""

from __future__ import annotations

import re

from zsched.core.values import errors


def test_drawn_tree_names_every_error() -> None:
    drawn = set(re.findall(r"^(?:[├└]── )?(\w+Error)\b", errors.__doc__ or "", flags=re.MULTILINE))
    defined = {name for name, value in vars(errors).items() if isinstance(value, type)}
    assert drawn == defined
