"""Decides whether a fleet's sessions are encrypted: by its `security:` section, or the operator's zenoh file.

Knows: which of zenoh's settings make TLS. Does not know: certificates (`zsched.link.sessions.secured`), sessions.

Where TLS is set up, nothing of ours listens in plain text: what the fleet file does not say, we choose alike.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from typing import Final

from zsched.core.values.endpoint import Endpoint
from zsched.core.values.errors import ConfigError
from zsched.core.values.fleet import Fleet, NodeSpec
from zsched.core.values.model import NodeId
from zsched.core.values.snapshot import Exposure
from zsched.link.sessions import config as zenoh_config
from zsched.link.sessions.access_rules import Side
from zsched.link.sessions.secured import identity_of, secured_text
from zsched.link.sessions.zenoh_file import operator_json5

PLAIN: Final = "tcp"
ENCRYPTED: Final = ("tls", "quic")
TO_LISTEN: Final = ("listen_certificate", "listen_private_key")


def session_text(fleet: Fleet, side: Side, env: Mapping[str, str] = os.environ, home: NodeId = "") -> str:
    """The zenoh configuration on which sessions of one kind are built: the operator's own, secured where the file says.

    ``env``: where systemd has put this machine's key, if it has; ``home``: as in `access_control`.

    Raises:
        ConfigError: the operator's file or this machine's certificate cannot be used.
    """
    text = operator_json5(fleet)
    return text if fleet.security is None else secured_text(fleet, fleet.security, side, text, env, home)


def visits(fleet: Fleet, endpoints: Iterable[str]) -> list[str]:
    """The configuration of a client session to each of these addresses, for a tool that asks a moment.

    Raises:
        ConfigError: as `session_text`.
        ValueError: the operator's file is no zenoh configuration.
    """
    text = session_text(fleet, Side.VISIT)
    return [zenoh_config.client_config(connect=(one,), timing=fleet.timing, operator_json5=text) for one in endpoints]


def asker_in(fleet: Fleet, name: str) -> str:
    """In whose name a tool asks: a secured fleet takes questions only in that of the certificate.

    Raises:
        ConfigError: this machine's certificate cannot be used.
    """
    return name if fleet.security is None else identity_of(fleet, fleet.security).holder.name


def protocol_of(fleet: Fleet, text: str) -> str:
    """What sessions listen with where the fleet file does not say: ``tls`` or ``tcp``; ``text``: the operator's file.

    Raises:
        ConfigError: there is TLS, but nothing to listen with.
    """
    settings = zenoh_config.tls_settings(text)
    if fleet.security is not None:
        return "tls"
    endpoints = [end for node in fleet.nodes for end in (node.listen_control, node.listen_data) if end]
    if not settings and not any(_scheme(end) in ENCRYPTED for end in endpoints):
        return PLAIN
    missing = [name for name in TO_LISTEN if name not in settings]
    if missing:
        raise ConfigError(
            f"{fleet.zenoh_config or 'the fleet file'}: TLS without {' and '.join(missing)}, with which every node's "
            "sessions listen; set them under transport/link/tls in the file that `zenoh: {config: ...}` names"
        )
    return "tls"


def exposure(fleet: Fleet, me: NodeSpec, protocol: str, listens: Iterable[str]) -> Exposure:
    """Who may speak to the node ``me``, which listens with ``protocol``, or as the file says, at ``listens``.

    Its local side is for programs of its machine; where it listens beyond, no certificate keeps anybody out.
    """
    if _open_sides(me):
        return Exposure.OPEN
    if fleet.security is not None:
        return Exposure.SECURED
    plain = [end for end in listens if _scheme(end) not in ENCRYPTED]
    if protocol != PLAIN and not plain:
        return Exposure.ENCRYPTED
    return Exposure.LOCAL if all(Endpoint.of(end).is_own_host for end in plain) else Exposure.OPEN


def _open_sides(me: NodeSpec) -> tuple[str, ...]:
    """Where the node's local side listens for other machines, too."""
    return () if me.local is None else tuple(end for end in me.local.listen if not Endpoint.of(end).is_own_host)


def plain_text_problem(me: NodeSpec, protocol: str) -> str | None:
    """Where this node listens in plain text although the fleet has TLS, because the fleet file says so."""
    given = (me.listen_control, me.listen_data)
    plain = [end for end in given if end and _scheme(end) not in ENCRYPTED]
    if protocol == PLAIN or not (plain or _open_sides(me)):
        return None
    if plain:
        return f"TLS is set up, but the fleet file lets {me.name} listen on {', '.join(plain)}: write tls/ there"
    return (
        f"TLS is set up, but the local side of {me.name}, which is plain text, listens for other machines on "
        f"{', '.join(_open_sides(me))}: who reaches it speaks as its applications; write 127.0.0.1 there"
    )


def _scheme(endpoint: str) -> str:
    return endpoint.partition("/")[0]
