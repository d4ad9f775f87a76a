"""A ROS 2 node with a life cycle: its services, the bytes of their questions and answers, which step leads on.

Knows: `lifecycle_msgs` (ids, CDR of ChangeState and GetState), the states of a managed node. Does not know: zenoh,
processes, roles.

Sources: the design article "Managed nodes" of ROS 2; lifecycle_msgs. Read, not copied.
"""

from __future__ import annotations

from enum import IntEnum
from typing import Final

HEADER: Final = b"\x00\x01\x00\x00"
"""CDR, little endian."""


class State(IntEnum):
    """The states in which a node stays (`lifecycle_msgs/msg/State`); all others are passed through."""

    UNCONFIGURED = 1
    INACTIVE = 2
    ACTIVE = 3
    FINALIZED = 4


class Transition(IntEnum):
    """What is asked of a node (`lifecycle_msgs/msg/Transition`)."""

    CONFIGURE = 1
    ACTIVATE = 3
    DEACTIVATE = 4


GET_STATE_REQUEST: Final = HEADER + b"\x00"
"""A request without fields is one byte."""


def change_state_key(domain: int, node: str) -> str:
    """The key of the service that changes the state of ``node``, whatever its type's hash.

    >>> change_state_key(0, "/edge1/slam")
    '0/edge1/slam/change_state/lifecycle_msgs::srv::dds_::ChangeState_/*'
    """
    return f"{domain}{node}/change_state/lifecycle_msgs::srv::dds_::ChangeState_/*"


def get_state_key(domain: int, node: str) -> str:
    """The key of the service that tells the state of ``node``, whatever its type's hash."""
    return f"{domain}{node}/get_state/lifecycle_msgs::srv::dds_::GetState_/*"


def change_state_request(transition: Transition) -> bytes:
    """The id, and an empty label: a label that is not empty would count instead of the id."""
    return HEADER + bytes((transition, 0, 0, 0)) + b"\x01\x00\x00\x00\x00"


def is_changed(answer: bytes) -> bool | None:
    """Whether the node has done what was asked; ``None``: this is no answer of ChangeState."""
    return None if len(answer) <= len(HEADER) or answer[:2] != HEADER[:2] else answer[len(HEADER)] == 1


def state_of(answer: bytes) -> int | None:
    """The id of the state that an answer of GetState tells; ``None``: this is none."""
    return None if len(answer) <= len(HEADER) or answer[:2] != HEADER[:2] else answer[len(HEADER)]


def step(state: int, *, is_owner: bool) -> Transition | None:
    """What leads from ``state`` to *active* (an owner) or *inactive*; ``None``: it is there, on its way, or finalized.

    >>> step(State.UNCONFIGURED, is_owner=True).name, step(State.INACTIVE, is_owner=False)
    ('CONFIGURE', None)
    """
    if state == State.UNCONFIGURED:
        return Transition.CONFIGURE
    if state == State.INACTIVE and is_owner:
        return Transition.ACTIVATE
    if state == State.ACTIVE and not is_owner:
        return Transition.DEACTIVATE
    return None
