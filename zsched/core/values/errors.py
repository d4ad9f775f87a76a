"""The error tree: what may be raised, and whose fault it is.

ZschedError
├── ConfigError          the operator's file or arguments; lists every fault with its place
├── NameTakenError       another daemon has this node's name
├── WireError            a peer's bytes: counted and dropped, never more
├── AdapterError         the outside (socket, disk, process) refused; wraps the cause
└── InvariantError       a bug of ours
"""

from __future__ import annotations


class ZschedError(Exception):
    """Parent of everything zsched raises on purpose."""


class ConfigError(ZschedError):
    """The fleet file or an argument is wrong; the message lists every fault (file:line:col, why, what to do)."""


class NameTakenError(ZschedError):
    """Another daemon with this node's name was here first; trying again later may help."""


class WireError(ZschedError):
    """Bytes that are no valid frame; `reason` is one short word for a counter."""

    def __init__(self, reason: str, detail: str = "") -> None:
        super().__init__(f"{reason}: {detail}" if detail else reason)
        self.reason = reason


class AdapterError(ZschedError):
    """Something outside refused; says what, where and what to do."""


class InvariantError(ZschedError):
    """A rule of the core does not hold: a bug, never an operator's or a peer's fault."""
