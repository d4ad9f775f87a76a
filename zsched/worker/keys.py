"""The keys that a worker names: fills their placeholders, and finds outputs that no rule of its task takes.

Knows: the placeholders of the library, the outputs' keys that the daemon tells. Does not know: sessions, epochs.
"""

from __future__ import annotations

import json
from typing import Final

from zsched.core.route import keyexpr
from zsched.core.route.route import placeholders
from zsched.core.values.errors import ConfigError
from zsched.core.values.model import MAX_REASON

OUTPUT_KEYS: Final = "ZSCHED_OUTPUT_KEYS"
"""The variable with the key expressions of the task's output rules on this node, a JSON list."""
IN_INPUTS: Final = ("prefix",)
IN_OUTPUTS: Final = ("prefix", "epoch")
_MORE: Final = 60
"""Of `MAX_REASON`, for the words before it."""


def filled(template: str, prefix: str, known: tuple[str, ...] = IN_INPUTS) -> str:
    """``template`` with its prefix filled in. Raises `ValueError` for a placeholder that is not ``known``."""
    names = " and ".join(f"{{{name}}}" for name in known)
    for name in placeholders(template):
        if name not in known:
            raise ValueError(f"{template!r}: there is no placeholder {{{name}}} here; known: {names}")
    key = template.replace("{prefix}", prefix)
    if "{" in key.replace("{epoch}", "") or "}" in key.replace("{epoch}", ""):
        raise ValueError(f"{template!r}: a brace is not closed; known: {names}")
    return key


def output_key(template: str, prefix: str) -> str:
    """The key of an output, still with its epoch's placeholder. Raises `ValueError` when it is none."""
    key = filled(template, prefix, IN_OUTPUTS)
    if wrong := keyexpr.fault(_of_an_epoch(key)):
        raise ValueError(f"{template!r} is no key: {wrong}")
    return key


def output_keys(text: str) -> tuple[str, ...]:
    """The list that the daemon tells; empty: it has told none. Raises `ConfigError` when it is no list of keys."""
    try:
        found = json.loads(text) if text else []
    except ValueError as error:
        raise ConfigError(f"{OUTPUT_KEYS}: {text!r:.80} is no JSON list of keys") from error
    if not isinstance(found, list) or any(not isinstance(one, str) or keyexpr.fault(one) for one in found):
        raise ConfigError(f"{OUTPUT_KEYS}: {text!r:.80} is no JSON list of keys")
    return tuple(found)


def untaken(key: str, rules: tuple[str, ...]) -> str:
    """What to tell of an output under ``key`` (still with its epoch's placeholder); empty: a rule takes it."""
    concrete = _of_an_epoch(key)
    if not rules or any(keyexpr.intersects(concrete, rule) for rule in rules):
        return ""
    text = f"puts on {key}, which no output rule takes: the rules take {', '.join(rules)}"
    return text[: MAX_REASON - _MORE]


def _of_an_epoch(key: str) -> str:
    return key.replace("{epoch}", "1")
