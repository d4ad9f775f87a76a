"""Seals what this node says where it counts, and judges the seals of others: by name, signature and order.

Knows: which kinds are sealed, who may seal which, what was heard already. Does not know: how a signature is made
(`zsched.link.signatures`), what a frame means.

What is old is refused like this. A put must have a higher (incarnation, sequence) than the newest of its sender and
kind. An answer is signed together with the attachment of its question, which no other question has. A command is signed
for one life of the node that takes it, and is taken once. A ballot's question is refused by its ballot, in the core.
"""

from __future__ import annotations

import logging
import secrets
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterable
from datetime import UTC, datetime
from enum import StrEnum
from typing import Final

from zsched.core.values.certificates import Holder, Role, parse_common_name
from zsched.core.values.codec import LARGE
from zsched.core.values.errors import WireError
from zsched.core.values.model import NodeId
from zsched.core.values.struct import Struct
from zsched.host.clock import monotonic_s, wall_ns, wall_s
from zsched.link.seal import Act, Seal, pack, signed_bytes, unpack
from zsched.link.sessions.certificate import Parts

PUTS: Final = frozenset({"proposal", "allocation"})
QUESTIONS: Final = frozenset({"register", "command"})
ANSWERS: Final = frozenset({"register", "allocation"})
"""Kinds that are sealed. The question for learnt values reads only; it has a number of its own instead (`nonce`)."""
KEPT_CERTIFICATES: Final = 256
KEPT_COMMANDS: Final = 1024
"""Per operator; a command that is older than the oldest of them is refused."""
LOG_EVERY_S: Final = 60.0

log = logging.getLogger("zsched.bus")


class SealFault(StrEnum):
    """Why a frame with its seal is refused; the word of its counter (``dropped_<kind>_<word>``)."""

    UNSIGNED = "unsigned"  # there is no seal
    CERTIFICATE = "certificate"  # no authority of the fleet has signed it, or it is not valid now
    SIGNER = "signer"  # it is another's, a revoked key's, or of a role that may not say this
    SIGNATURE = "signature"
    REPLAY = "replay"  # it was heard already, or is older than what was heard
    STALE = "stale"  # a command for another life of this node


class Keys(Struct, frozen=True, kw_only=True):
    """What signs and checks, from the certificates of this machine (`zsched.link.bus.sealing` makes it)."""

    sign: Callable[[bytes], bytes]
    certificate: bytes
    """This machine's, DER."""
    certified: Callable[[bytes, datetime], Parts | None]
    """A certificate taken apart, if the fleet's authority signed it and it is valid then."""
    checking_by: Callable[[bytes], Callable[[bytes, bytes], bool]]
    """What checks a signature by a public key."""


class _Known(Struct, frozen=True):
    holder: Holder
    begins: datetime
    ends: datetime
    check: Callable[[bytes, bytes], bool]


def nonce() -> bytes:
    """The attachment of a question that is not sealed: its answers are signed together with it."""
    return secrets.token_bytes(16)


class Seals:
    """The seals of one session; every method may be called from any thread."""

    def __init__(
        self, *, fleet: str, keys: Keys, holders: Iterable[Holder], life: int = 0, takes_unsigned: bool = False
    ) -> None:
        """``holders``: the keys that are let in. ``life``: this node's incarnation; 0: it is none.

        With ``takes_unsigned`` a frame without a seal is taken, while nodes of an older version are in the fleet; a
        seal that is there must be right.
        """
        self._fleet, self._keys, self._holders = fleet, keys, frozenset(holders)
        self._life, self._takes_unsigned = life, takes_unsigned
        self._lock = threading.Lock()
        self._sequence = 0
        self._known: OrderedDict[bytes, _Known] = OrderedDict()
        self._newest: dict[tuple[NodeId, str], tuple[int, int]] = {}
        self._commands: dict[Holder, tuple[set[int], int]] = {}
        """{operator: (the newest numbers, the highest one that is forgotten)}."""
        self._logged_at, self._unlogged = -LOG_EVERY_S, 0

    # --- what we say -------------------------------------------------------------------------------------------------

    def seal(self, act: Act, key: str, frame: bytes, *, question: bytes = b"", life: int | None = None) -> bytes:
        """The attachment for a frame under ``key``; ``life``: that of a command's receiver."""
        with self._lock:
            self._sequence = sequence = max(self._sequence + 1, wall_ns())
        lived = self._life if life is None else life
        data = signed_bytes(act, key, frame, life=lived, sequence=sequence, question=question)
        certificate = self._keys.certificate
        return pack(Seal(life=lived, sequence=sequence, signature=self._keys.sign(data), certificate=certificate))

    # --- what others say ---------------------------------------------------------------------------------------------

    def put(self, kind: str, key: str, frame: bytes, attachment: bytes, owner: NodeId) -> None:
        """Judge a put of the node ``owner``.

        Raises:
            WireError: it is refused; ``reason`` is a `SealFault`, or "seal" or "size" for malformed ones.
        """
        seal, holder = self._judged(Act.PUT, kind, key, frame, attachment, owner)
        if seal is None or holder is None:
            return
        place, at = (owner, kind), (seal.life, seal.sequence)
        with self._lock:
            is_new = at > self._newest.get(place, (-1, 0))
            if is_new:
                self._newest[place] = at
        if not is_new:
            raise self._fault(SealFault.REPLAY, kind, owner)

    def question(self, kind: str, key: str, frame: bytes, attachment: bytes, asker: NodeId) -> Holder | None:
        """Judge a question, or a command; returns the asker, ``None`` where it is unsigned and taken.

        Raises:
            WireError: as `put`.
        """
        seal, holder = self._judged(Act.QUESTION, kind, key, frame, attachment, asker)
        if seal is None or holder is None or kind != "command":
            return holder
        if seal.life != self._life:
            raise self._fault(SealFault.STALE, kind, asker)
        with self._lock:
            kept, forgotten = self._commands.get(holder, (set(), 0))
            is_new = seal.sequence not in kept and seal.sequence > forgotten
            if is_new:
                kept.add(seal.sequence)
                if len(kept) > KEPT_COMMANDS:
                    forgotten = min(kept)
                    kept.remove(forgotten)
                self._commands[holder] = kept, forgotten
        if not is_new:
            raise self._fault(SealFault.REPLAY, kind, asker)
        return holder

    def answer(self, kind: str, key: str, frame: bytes, attachment: bytes, owner: NodeId, question: bytes) -> None:
        """Judge the answer of the node ``owner`` to the question that had this attachment.

        Raises:
            WireError: as `put`.
        """
        self._judged(Act.ANSWER, kind, key, frame, attachment, owner, question)

    def _judged(
        self, act: Act, kind: str, key: str, frame: bytes, attachment: bytes, name: NodeId, question: bytes = b""
    ) -> tuple[Seal | None, Holder | None]:
        if not attachment:
            if self._takes_unsigned:
                return None, None
            raise self._fault(SealFault.UNSIGNED, kind, name)
        if len(frame) > LARGE:
            raise WireError("size", f"{len(frame)} bytes, at most {LARGE}")
        seal = unpack(attachment)
        known = self._certified(seal.certificate)
        if known is None:
            raise self._fault(SealFault.CERTIFICATE, kind, name)
        holder = known.holder
        may = (Role.NODE, Role.OPERATOR) if kind == "command" else (Role.NODE,)
        if holder.name != name or holder.role not in may or holder not in self._holders:
            raise self._fault(SealFault.SIGNER, kind, name, f" certificate={holder.label}")
        data = signed_bytes(act, key, frame, life=seal.life, sequence=seal.sequence, question=question)
        if not known.check(seal.signature, data):
            raise self._fault(SealFault.SIGNATURE, kind, name)
        return seal, holder

    def _certified(self, der: bytes) -> _Known | None:
        """Who a certificate names; one that was right is not checked again, but for its time."""
        now = datetime.fromtimestamp(wall_s(), UTC)
        with self._lock:
            known = self._known.get(der)
        if known is None:
            parts = self._keys.certified(der, now)
            holder = None if parts is None else parse_common_name(parts.common_name, self._fleet)
            if parts is None or holder is None:
                return None
            try:
                check = self._keys.checking_by(parts.key)
            except ValueError:
                return None
            known = _Known(holder, parts.begins, parts.ends, check)
            with self._lock:
                self._known[der] = known
                if len(self._known) > KEPT_CERTIFICATES:
                    self._known.popitem(last=False)
        return known if known.begins <= now <= known.ends else None

    def _fault(self, fault: SealFault, kind: str, name: NodeId, more: str = "") -> WireError:
        """The error, and at most one line of the log in a minute."""
        now = monotonic_s()
        with self._lock:
            is_due = now - self._logged_at >= LOG_EVERY_S
            left_out = self._unlogged
            self._unlogged = 0 if is_due else left_out + 1
            if is_due:
                self._logged_at = now
        if is_due:
            log.warning("refused kind=%s as=%s why=%s%s; %d more in the time before", kind, name, fault, more, left_out)
        return WireError(fault, f"{kind} of {name}{more}")
