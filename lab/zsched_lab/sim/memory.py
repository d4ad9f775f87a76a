"""Votes beyond what is promised: an elector has forgotten some, and nobody in its reach has seen them.

That is not found out, and two values may be chosen (docs/design/failures.md). What such a schedule does to the
agreement is no violation; where somebody in reach remembers, it is one.

Knows: how many votes each disk has stood for, which nodes remember them, which reach each other. Does not know: what
was voted, how a disk forgets.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from zsched.core.values.durable import DurableState
from zsched_lab.sim.links import Links
from zsched_lab.sim.parts import Machine


@dataclass(slots=True)
class Memory:
    """Watches the electors of one simulated fleet whose states go back in time."""

    links: Links
    beyond: str = ""
    """Which votes were the first that nothing could keep back; empty: there are none."""
    _most: dict[tuple[str, int, str], int] = field(default_factory=dict)
    """{(machine, generation, its disk): of how many votes its disk knew when it gave the newest one}."""
    _forgotten: dict[str, tuple[int, int, frozenset[str]]] = field(default_factory=dict)
    """{machine whose life began with less: (the life, votes it began with, who in its reach remembered more)}."""

    def on_started(self, machine: Machine, state: DurableState | None) -> None:
        """A daemon starts from this state."""
        self._forgotten.pop(machine.key, None)
        if state is not None and state.votes < self._most.get((machine.key, state.generation, state.disk), 0):
            self._forgotten[machine.key] = (machine.life, state.votes, self._witnesses(machine, state.votes))

    def on_vote(self, machine: Machine) -> None:
        """A promise or an acceptance leaves, and stands on the disk."""
        state = machine.disk.state
        if state is None:
            return
        key = (machine.key, state.generation, state.disk)
        self._most[key] = max(self._most.get(key, 0), state.votes)
        life, votes, witnesses = self._forgotten.get(machine.key, (-1, 0, frozenset()))
        if life == machine.life and not self.beyond and not witnesses & self._witnesses(machine, votes):
            self.beyond = f"{machine.key} began with {votes} of {self._most[key]} votes; nobody in reach knows better"

    def _witnesses(self, machine: Machine, votes: int) -> frozenset[str]:
        """The nodes that are awake, reach a machine and are reached, and remember more of it than its state knew."""
        return frozenset(
            other.key
            for other in self.links.machines.values()
            if other.name != machine.name and self._is_in_reach(machine, other) and _remembers(other, machine, votes)
        )

    def _is_in_reach(self, one: Machine, other: Machine) -> bool:
        pairs = ((one.key, other.key), (other.key, one.key))
        is_open = all(pair not in self.links.cuts for pair in pairs)
        is_quick = all(pair not in self.links.held or self.links.held[pair].until <= self.links.now for pair in pairs)
        return is_open and is_quick and not other.is_paused


def _remembers(other: Machine, machine: Machine, votes: int) -> bool:
    state = machine.disk.state
    if other.node is None or state is None or other.node.agreement.generation != state.generation:
        return False
    incarnation, seen = other.node.agreement.witness.seen.get(machine.name, (0, 0))
    return incarnation > state.incarnation or seen > votes
