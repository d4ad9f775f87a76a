"""Membership, links that are refused: who dials with a certificate of this fleet, and is not let in?

Such a link says nothing here, so the status would say nothing of a machine whose key is revoked, or that was taken out
and runs on. It is no problem of the fleet, which works as it should: nobody who is not let in may make it look ill.

Knows: keys by their labels, and who is let in. Does not know: links, certificates.
"""

from __future__ import annotations

from zsched.core.values.certificates import Role, accepted, parse_label
from zsched.core.values.fleet import Fleet
from zsched.core.values.struct import Struct, field

SHOWN_S = 60.0
"""Who is refused dials again about once a second; one that has not for so long is told of no more."""
REFUSED_KEPT = 8
"""Keys that status shows: an authority signs as many as it is asked to."""


class RefusedKeys(Struct):
    """The keys with which somebody has dialled one node in vain."""

    _at: dict[str, float] = field(default_factory=dict)

    def on_refused(self, label: str, now: float) -> None:
        """A link of this key was refused; monotonic seconds."""
        self._at = {known: at for known, at in self._at.items() if now < at + SHOWN_S}
        if label in self._at or len(self._at) < REFUSED_KEPT:
            self._at[label] = now

    def told(self, fleet: Fleet, now: float) -> tuple[str, ...]:
        """A line for each, with what to do; none of those that the fleet lets in by now."""
        return tuple(
            text for label, at in sorted(self._at.items()) if now < at + SHOWN_S and (text := _told(label, fleet))
        )


def _told(label: str, fleet: Fleet) -> str:
    holder, security = parse_label(label), fleet.security
    if holder is None or security is None:
        return ""
    name = holder.name
    names = {
        Role.NODE: {node.name for node in fleet.nodes},
        Role.OPERATOR: set(security.operators),
        Role.GUEST: set(security.guests),
    }
    if name in names[holder.role]:
        let_in = accepted(name, holder.role, security.revoked)
        if holder in let_in:
            return ""  # the sessions let it in once they have begun anew
        if holder.key > let_in[-1].key:
            return (
                f"{label} dials with a key that nobody has issued for this fleet as it is: it lets in "
                f"{let_in[-1].label}. "
                f"If `zsched pki show` has {label}, write the keys before it below `revoked:` (`zsched edit`)"
            )
        way = f"`zsched invite {name}` here and `zsched join` there"
        way = way if holder.role is Role.NODE else f"`zsched pki issue {name} --role {holder.role}`"
        return (
            f"{label} dials with a key that is revoked, and is not let in. If {name} shall have another key: {way}. "
            "Else somebody else has this one, and stays out"
        )
    if holder.role is Role.NODE:
        return (
            f"{label} dials with a certificate of this fleet, which has no node {name}, and is not let in: "
            f"`zsched leave` on that machine if it was taken out, `zsched invite {name}` here if it shall come"
        )
    return (
        f"{label} dials with a certificate of this fleet, which has no {holder.role} {name}, and is not let in; "
        f"to let {name} in, `zsched edit`: `security: {{{holder.role}s: [{name}]}}`"
    )
