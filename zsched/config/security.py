"""Decides what the `security:` section of a fleet file says: where certificates lie, and which other names are let in.

Knows: how names and endpoints relate to it. Does not know: certificates, zenoh's rules.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from pathlib import Path

from zsched.config.blocks import Located, Section
from zsched.config.nodes import Cast
from zsched.config.reader import Collector
from zsched.config.schema import PKI_FOLDER
from zsched.core.values.certificates import MAX_COMMON_NAME, Holder, Role, parse_label
from zsched.core.values.endpoint import Endpoint
from zsched.core.values.fleet import Security, Signatures
from zsched.core.values.struct import replace

TLS = "tls"
_A = {"node": "a node", "operator": "an operator", "guest": "a guest"}


def read_security(section: Section, cast: Cast, folder: Path, out: Collector) -> Security | None:
    """The section, with what is wrong with it reported; ``None``: there is none."""
    given: Section | None = section.get("security")
    if given is None:
        return None
    operators = _names(given, "operators", cast, out)
    guests = _names(given, "guests", cast, out)
    for name in sorted(set(operators) & set(guests)):
        out.error(given.where("guests"), f"{name!r} is an operator, too", "an operator may do all that a guest may")
    fleet = section.get("fleet", "")
    holders = [
        *(Holder(name=node) for node in cast.names),
        *(Holder(name=name, role=Role.OPERATOR) for name in operators),
        *(Holder(name=name, role=Role.GUEST) for name in guests),
    ]
    for holder in holders:
        name = holder.common_name(fleet)
        if len(name) > MAX_COMMON_NAME:
            message = (
                f"the certificate's name {name} has {len(name)} characters, at most {MAX_COMMON_NAME} are possible"
            )
            out.error(given.place, message, f"shorter names: {holder.name!r}, or the fleet's, {fleet!r}")
    _check_endpoints(section, given, out)
    return Security(
        folder=str(folder / given.get("folder", PKI_FOLDER)),
        operators=operators,
        guests=guests,
        revoked=_revoked(given, {(one.name, one.role) for one in holders}, out),
        signatures=given.get("signatures", Signatures.REQUIRED),
        orders=_orders(given, cast, operators, out),
    )


def _names(given: Section, key: str, cast: Cast, out: Collector) -> tuple[str, ...]:
    found: tuple[Located[str], ...] = given.get(key, ())
    seen: set[str] = set()
    for one in found:
        if one.value in cast.names:
            out.error(one.place, f"{one.value!r} is a node", "give people names of their own")
        elif one.value in seen:
            out.error(one.place, f"{one.value!r} is there twice")
        seen.add(one.value)
    return tuple(sorted(seen))


def _orders(given: Section, cast: Cast, operators: tuple[str, ...], out: Collector) -> tuple[str, ...] | None:
    """The nodes that may give commands; ``None``: each of them."""
    found: tuple[Located[str], ...] | None = given.get("orders")
    for one in found or ():
        if one.value not in cast.names:
            out.error(one.place, f"{one.value!r} is no node", "operators give orders anyway: name nodes only")
    if found == () and not operators:
        out.error(given.where("orders"), "nobody could give an order", "name a node, or an operator below `operators:`")
    return None if found is None else tuple(sorted({one.value for one in found}))


def _misspelt(name: str, known: Iterable[str]) -> str:
    """The name of the file that another one is near to; empty: none is.

    A name with other digits is another machine's. It may have left the fleet: its line keeps its key out if the name
    comes back, so nothing is to be said of it.

    >>> _misspelt("robto1", ["robot1", "robot2"]), _misspelt("robot3", ["robot1", "robot2"])
    ('robot1', '')
    """
    alike = [one for one in known if _digits(one) == _digits(name)]
    return next(iter(difflib.get_close_matches(name, alike, n=1)), "")


def _digits(name: str) -> str:
    return "".join(filter(str.isdigit, name))


def _revoked(given: Section, known: set[tuple[str, Role]], out: Collector) -> tuple[str, ...]:
    found: tuple[Located[str], ...] = given.get("revoked", ())
    for one in found:
        holder = parse_label(one.value)
        if holder is None or (holder.name, holder.role) in known:
            continue
        meant = sorted(str(role) for name, role in known if name == holder.name)
        if meant:
            label = replace(holder, role=Role(meant[0])).label
            message = f"{one.value!r} is a key of nobody: {holder.name} is no {holder.role} here, but {_A[meant[0]]}"
            out.warn(one.place, message, f"the line keeps nobody out; if that key is meant: {label}")
        elif close := _misspelt(holder.name, {name for name, _ in known}):
            message = f"{one.value!r} is a key of nobody in this file"
            out.warn(one.place, message, f"the line keeps nobody out; did you mean {close!r}?")
    return tuple(sorted({one.value for one in found}))


def _check_endpoints(section: Section, given: Section, out: Collector) -> None:
    """A secured node listens with TLS only: what is written otherwise is a mistake of either section."""
    nodes: dict[str, Located[Section | None]] = section.get("nodes", {})
    for entry in nodes.values():
        listen: Section | None = entry.value.get("listen") if entry.value is not None else None
        for kind in ("control", "data") if listen is not None else ():
            assert listen is not None
            listener = Endpoint.of(listen.get(kind, ""))
            if listener.protocol not in ("", TLS):
                why = f"{listener.protocol}/ is plain text"
                if listener.protocol == "quic":
                    why = "zenoh cannot end a refused link of quic/"
                message = f"{why}, and the fleet is secured (line {given.place.line})"
                out.error(listen.where(kind), message, str(replace(listener, protocol=TLS)))
        local: Section | None = entry.value.get("local") if entry.value is not None else None
        ends: tuple[Located[str], ...] = () if local is None else local.get("listen", ())
        for end in ends:
            if not Endpoint.of(end.value).is_own_host:
                message = f"{end.value}: other machines reach this local side, and it has no certificates"
                out.warn(end.place, message, "who reaches it speaks as the node's applications: listen on 127.0.0.1")
