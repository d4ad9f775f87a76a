"""What a node keeps across restarts: one value, one file.

Knows: the fields of the state. Does not know: bytes, disks (`zsched.host.state_file`), what the fields mean to
their stages.
"""

from __future__ import annotations

from zsched.core.values.electorate import FleetValue, check_id
from zsched.core.values.model import NodeId, RegisterState
from zsched.core.values.struct import Struct


class DurableState(Struct, frozen=True, kw_only=True):
    """Everything that a node keeps across restarts (one file, `zsched.host.state_file`)."""

    fleet: str
    node: NodeId
    incarnation: int
    generation: int
    hardware: str
    electorate: str
    registers: tuple[RegisterState, ...] = ()
    voted: tuple[NodeId, ...] = ()
    """Electors that this node has heard to have voted: such a name must not be initialised anew."""
    disputed: str = ""
    """Why this node stands down as elector until the operator settles it; empty: it does not."""
    lease_s: float = 0.0
    """How long a lease may last that this elector granted in a life before (its file may have said another length)."""
    votes: int = 0
    """How many promises and acceptances this elector has ever given."""
    seen: tuple[tuple[NodeId, int, int], ...] = ()
    """(elector, incarnation, votes), as others answered: they may lose their state (`zsched.core.vote.witness`)."""
    disk: str = ""
    """Id of the disk, drawn with this state; empty: the state is older than such ids."""
    fleet_register: RegisterState[FleetValue] | None = None
    """``None``: the fleet value is still the one that every node makes of its file (`founded`)."""
    joins: str = ""
    """Generation id that this node is to follow, by its operator's word; empty: that of its fleet file."""
    lost: str = ""
    """Why peers have seen a newer state of this node than this one; empty: they have not."""

    def __post_init__(self) -> None:
        check_id("state.joins", self.joins)
