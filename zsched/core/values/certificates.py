"""Certificate names: who holds a certificate of the fleet, in which role, with which key (pure).

Knows: the shape of the names. Does not know: certificates, who may do what (`zsched.link.sessions.access_rules`).

The common name of a certificate is ``<label>.<fleet>.zsched.internal``. No public authority issues names below
``internal``, so a certificate of the public web never bears one. The label is ``robot1`` for a node,
``ana.operator`` for an operator, ``screen.guest`` for a guest. Once a key is revoked its name goes on with a new key
whose number stands in the label: ``robot1.k2``. So a list of labels revokes keys, not only names.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from enum import StrEnum
from typing import Final

from zsched.core.values.struct import Struct
from zsched.core.values.words import NAME

DOMAIN: Final = "zsched.internal"
MAX_COMMON_NAME: Final = 64
"""Characters (RFC 5280, ub-common-name)."""
MAX_KEY: Final = 9999
"""Highest number of a holder's key."""
_KEY: Final = re.compile(r"k([2-9]|[1-9][0-9]{1,3})")


class Role(StrEnum):
    """What the holder of a certificate is in the fleet."""

    NODE = "node"
    OPERATOR = "operator"
    GUEST = "guest"


class Holder(Struct, frozen=True, kw_only=True, order=True):
    """The holder of one key: its name, its role, and the number of the key (1..9999)."""

    name: str
    role: Role = Role.NODE
    key: int = 1

    @property
    def label(self) -> str:
        """What ``security: {revoked: [...]}`` and `zsched pki` call it.

        >>> Holder(name="robot1").label, Holder(name="ana", role=Role.OPERATOR, key=2).label
        ('robot1', 'ana.operator.k2')
        """
        role = "" if self.role is Role.NODE else f".{self.role}"
        return f"{self.name}{role}" + (f".k{self.key}" if self.key > 1 else "")

    def common_name(self, fleet: str) -> str:
        """The common name of its certificate."""
        return f"{self.label}.{fleet}.{DOMAIN}"


def parse_label(text: str) -> Holder | None:
    """The holder that a label names; ``None`` when it is no label.

    >>> parse_label("ana.operator.k2"), parse_label("robot1.k1")
    (Holder(name='ana', role=<Role.OPERATOR: 'operator'>, key=2), None)
    """
    name, *rest = text.split(".")
    role = Role.NODE
    if rest and rest[0] in (Role.OPERATOR, Role.GUEST):
        role = Role(rest.pop(0))
    number = _KEY.fullmatch(rest.pop(0)) if rest else None
    if rest or not NAME.fullmatch(name) or (number is None and text != Holder(name=name, role=role).label):
        return None
    return Holder(name=name, role=role, key=1 if number is None else int(number[1]))


def parse_common_name(text: str, fleet: str) -> Holder | None:
    """The holder that a common name names in ``fleet``; ``None`` when it names none there."""
    end = f".{fleet}.{DOMAIN}"
    return parse_label(text.removesuffix(end)) if text.endswith(end) else None


def accepted(name: str, role: Role, revoked: Iterable[str]) -> tuple[Holder, ...]:
    """The keys with which a holder is let in: all up to the one after the highest that is revoked, less those revoked.

    >>> [one.label for one in accepted("robot1", Role.NODE, ["robot1", "edge1"])]
    ['robot1.k2']
    """
    gone = {one.key for one in map(parse_label, revoked) if one is not None and (one.name, one.role) == (name, role)}
    highest = max(gone, default=0)
    return tuple(Holder(name=name, role=role, key=key) for key in range(1, highest + 2) if key not in gone)
