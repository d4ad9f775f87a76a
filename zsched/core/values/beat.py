"""The heartbeat, with the grants and releases of leases in it.

Knows: what a beat tells, and in which range. Does not know: when to beat, what follows from a beat.
"""

from __future__ import annotations

from zsched.core.values.electorate import check_id
from zsched.core.values.model import NodeId, TaskId, check_counter, check_length, check_name
from zsched.core.values.struct import Struct
from zsched.core.values.words import check_range

MAX_BEAT_BYTES = 16 * 1024


class Grant(Struct, frozen=True, kw_only=True):
    """An exclusive task's lease in numbers: beat ``number`` of ``owner``'s life ``incarnation``, working in ``epoch``.

    In an elector's beat it is the grant (an echo); in the owner's, a release of all numbers up to this one.
    """

    task: TaskId
    owner: NodeId
    incarnation: int
    epoch: int
    number: int

    def __post_init__(self) -> None:
        check_name("grant.task", self.task)
        check_name("grant.owner", self.owner)
        check_counter("grant.incarnation", self.incarnation)
        check_counter("grant.epoch", self.epoch)
        check_counter("grant.number", self.number)


class Beat(Struct, frozen=True, kw_only=True):
    """The heartbeat, sent from the decision loop itself (a wedged loop stops it; zenoh's own keep-alives go on)."""

    node: NodeId
    incarnation: int
    sequence: int
    loop_lag_s: float
    learnt: tuple[tuple[TaskId, int, int], ...] = ()
    """(task, revision, epoch) of every value this node has learnt."""
    suspects: tuple[NodeId, ...] = ()
    """Nodes that this node suspects or takes for gone: the second observer's word."""
    echoes: tuple[Grant, ...] = ()
    """Exclusive tasks: this elector's grants."""
    released: tuple[Grant, ...] = ()
    """Exclusive tasks: this owner's releases."""
    asked_to_leave: tuple[tuple[TaskId, NodeId, int], ...] = ()
    """(task, owner, epoch): this elector has refused another owner because of them."""
    fleet_file: str = ""
    """Hash of the fleet file that this node goes by."""
    has_voted: bool = False
    """Whether this elector has ever promised anything."""
    generation: int = 0
    """Of this node's state; what nodes of another generation have learnt means nothing here."""
    lease_terms: str = ""
    """The terms of this node's leases; an echo under other terms does not count."""
    has_lost_state: bool = False
    """This node is in the electorate and answers no proposer: its state is lost, disputed or cannot be written."""

    votes: int = 0
    """How many promises and acceptances this elector has ever given."""

    number: int = 0
    fleet_revision: int = 0
    """Of the learnt fleet value; 0 while it is the one that every node makes of its file."""

    electorate: str = ""
    """Hash of the electors that this elector counts with, and its generation; empty: it answers no proposer."""
    twins: tuple[NodeId, ...] = ()
    """Names with two daemons, as this node hears them; the daemons themselves ask about it."""
    lacks_state_file: bool = False
    """With `has_lost_state`: there is no file at all, so `zsched init` may only have been forgotten."""
    disk: str = ""
    """Id of the disk with which this node may elect; empty: it may not."""
    gone: tuple[NodeId, ...] = ()
    """Electors that this elector takes for gone (`zsched.core.electorate.pilot`)."""
    away: tuple[NodeId, ...] = ()
    """Robots that this elector takes for away."""
    may_return: bool = False
    """With `has_lost_state`: once its seat is given up, this node can be added as an elector again."""
    calm: bool = False
    """Nothing goes on at this node: its next beat may come at the slow pace (`zsched.core.membership.pace`)."""

    save_s: float = 0.0
    """How long a save of this node's state takes, of late; 0: next to nothing, or nothing was saved."""
    disk_refusal: str = ""
    """Why this node's disk refuses what must be saved; empty: it does not."""

    def __post_init__(self) -> None:
        check_name("beat.node", self.node)
        check_counter("beat.votes", self.votes)
        check_counter("beat.number", self.number)
        check_counter("beat.fleet_revision", self.fleet_revision)
        check_counter("beat.incarnation", self.incarnation)
        check_counter("beat.sequence", self.sequence)
        check_range("beat.loop_lag_s", self.loop_lag_s, 0.0, 86400.0)
        check_range("beat.save_s", self.save_s, 0.0, 86400.0)
        check_length("beat.disk_refusal", self.disk_refusal)
        check_counter("beat.generation", self.generation)
        check_id("beat.disk", self.disk)
