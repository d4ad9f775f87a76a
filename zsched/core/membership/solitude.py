"""Membership, nobody heard: has this node heard any node of its fleet file since its start, and whom does it dial?

Such a node is alive and alone: a wrong host or port, a firewall, or another `fleet:` on each machine. Without a word of
its own its status would only count the electors that are missing.

Knows: the addresses, the time, what a trial of each address has shown. Does not know: how an address is tried.
"""

from __future__ import annotations

import math

from zsched.core.values.in_force import InForce
from zsched.core.values.struct import Struct

ALONE_S = 3.0
"""A node that hears nobody for this long after its start says so; zenoh dials an address at least once a second."""
TRY_PAUSE_S = 30.0
"""Its addresses are tried no more often."""
ADDRESSES_SHOWN = 8
"""More addresses are counted only."""

TAKEN = "takes connections"
"""What became of an address at which somebody listens (`AddressesTried`)."""
CHECK = "Check host, port, firewall, and that every node has the same `fleet:`"


class Solitude(Struct):
    """Of one node: when to try its addresses, and what its status says while nobody was ever heard."""

    in_force: InForce
    started_at: float
    dialled: tuple[str, ...] = ()
    """The addresses that its control session dials."""
    dialled_at: str = ""
    """The address at which the others dial it; empty: they cannot."""
    _found: tuple[tuple[str, str], ...] = ()
    _try_at: float = -math.inf

    def is_alone(self, now: float, *, has_heard: bool) -> bool:
        """Whether nobody was heard for longer than it takes to connect; monotonic seconds."""
        return not has_heard and now >= self.started_at + max(ALONE_S, 2 * self.in_force.timing.suspect_s)

    def must_try(self, now: float, *, has_heard: bool) -> bool:
        """Whether to try the addresses now; ask often."""
        if not self.dialled or now < self._try_at or not self.is_alone(now, has_heard=has_heard):
            return False
        self._try_at = now + TRY_PAUSE_S
        return True

    def on_tried(self, found: tuple[tuple[str, str], ...]) -> None:
        """Take (address, what became of it) of the newest trial."""
        self._found = found

    def problem(self, secured: str = "") -> str:
        """What to tell an operator of a node that is alone; ``secured``: its name, where certificates let nodes in."""
        if not self.dialled:
            if not self.dialled_at:
                return f"heard nobody since the start: this node dials nobody, nobody has an address to dial. {CHECK}"
            return (
                f"no other node has come since the start: they dial this one at {self.dialled_at} once they have "
                f"joined and zsched runs there. If it does: {CHECK[0].lower()}{CHECK[1:]}"
            )
        causes = dict(self._found)
        told = [f"{one} ({causes[one]})" if causes.get(one) else one for one in self.dialled[:ADDRESSES_SHOWN]]
        if len(self.dialled) > ADDRESSES_SHOWN:
            told.append(f"{len(self.dialled) - ADDRESSES_SHOWN} more")
        where = f"heard nobody since the start: dialled {', '.join(told)}. "
        if not secured or TAKEN not in causes.values():
            return f"{where}{CHECK}"
        return (
            f"{where}Who takes connections and is not heard may not let this node in: its certificate is of an earlier "
            f"invitation, or its key is revoked. On a node of the fleet `zsched invite {secured}`, then stop this "
            f"daemon and `zsched join` here; else: {CHECK[0].lower()}{CHECK[1:]}"
        )
