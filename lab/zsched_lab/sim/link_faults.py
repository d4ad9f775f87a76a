"""Faults of links: cuts, one direction or one pair, stalls, bursts, streams that are dead while control lives, bad air.

Knows: what each does to the simulator's links, and how it ends. Does not know: when and where (`zsched_lab.sim.swarm`).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

from zsched.core.values import events as ev
from zsched_lab.sim.links import SELF_DELAY_S, Pair
from zsched_lab.sim.scene import Carry, Scene
from zsched_lab.sim.swarm import Fault

SMALL_DELAY_S = (0.0005, 0.003)
SPIKES = 0.02
"""This many messages of a hundred are late while there are spikes."""


@dataclass(slots=True)
class LinkFaults:
    """Carries out what goes wrong between machines."""

    scene: Scene

    def table(self) -> dict[str, Carry]:
        """{kind of fault: who carries it out}."""
        return {
            **dict.fromkeys(("duplicate", "spike", "mutate", "forge", "replay"), self._air),
            **dict.fromkeys(("cut", "one_way", "partial"), self._cut),
            "loss": self._loss,
            "delay": self._delay,
            "version": self._version,
            "stall": self._stall,
            "burst": self._burst,
            "data": self._data,
        }

    def calm(self) -> None:
        """The air clears, and everything passes again."""
        sim = self.scene.sim
        sim.heal()
        sim.weather.calm()
        sim.loss, sim.delay_s = 0.0, SMALL_DELAY_S

    # --- the air -----------------------------------------------------------------------------------------------------

    def _air(self, fault: Fault) -> None:
        """A chance per message."""
        values = {"spike": SPIKES}
        weather, name = self.scene.sim.weather, fault.kind
        if name == "spike":
            weather.spike_s = fault.size
        setattr(weather, name, values.get(name, fault.size))
        self.scene.then(fault.seconds, lambda: setattr(weather, name, 0.0))

    def _loss(self, fault: Fault) -> None:
        sim = self.scene.sim
        sim.loss = fault.size
        self.scene.then(fault.seconds, lambda: setattr(sim, "loss", 0.0))

    def _delay(self, fault: Fault) -> None:
        sim = self.scene.sim
        sim.delay_s = (SMALL_DELAY_S[0], fault.size)
        self.scene.then(fault.seconds, lambda: setattr(sim, "delay_s", SMALL_DELAY_S))

    def _version(self, fault: Fault) -> None:
        names, weather = set(fault.nodes), self.scene.sim.weather
        weather.foreign_version |= names
        self.scene.then(fault.seconds, lambda: weather.foreign_version.difference_update(names))

    # --- links -------------------------------------------------------------------------------------------------------

    def _pairs(self, fault: Fault) -> set[Pair]:
        """Between some machines and the rest, one way or both; or only between two."""
        here = set(fault.nodes)
        if fault.kind == "partial":
            return set(itertools.permutations(fault.nodes, 2))
        rest = [node.name for node in self.scene.sim.fleet.nodes if node.name not in here]
        pairs = set(itertools.product(fault.nodes, rest))
        back = {(b, a) for a, b in pairs}
        if fault.kind == "one_way":
            return pairs if fault.size >= 0.5 else back
        return pairs | back

    def _cut(self, fault: Fault) -> None:
        pairs, sim = self._pairs(fault), self.scene.sim
        sim.cuts |= pairs
        self.scene.then(sim.fleet.timing.control_lease_s, lambda: self._links_end(pairs & sim.cuts))
        self.scene.then(fault.seconds, lambda: sim.cuts.difference_update(pairs))

    def _links_end(self, pairs: set[Pair]) -> None:
        """Links that are still cut end with zenoh's lease: a node that hears nothing loses the other's token."""
        sim = self.scene.sim
        for source, target in sorted(pairs):
            node = sim.machines[source].node
            if node is not None and target in sim.machines:
                event = ev.TokenLost(node=source, incarnation=node.incarnation)
                sim.later(SELF_DELAY_S, sim.deliver, sim.machines[target], event)
                sim.work.lose(sim.machines[source], sim.machines[target])

    def _stall(self, fault: Fault) -> None:
        """Links take everything and deliver nothing, then all of it at once: both directions, or one."""
        sim, pairs = self.scene.sim, self._pairs(fault)
        if fault.size < 0.5:
            pairs = {pair for pair in pairs if (pair[0] in fault.nodes) == (fault.size < 0.25)}
        sim.hold(pairs, until=sim.now + fault.seconds)
        self.scene.then(
            sim.fleet.timing.control_lease_s,
            lambda: self._links_end({pair for pair in pairs if sim.held[pair].until > sim.now}),
        )

    def _burst(self, fault: Fault) -> None:
        """Links deliver what they have taken so often, each burst in order."""
        sim, pairs = self.scene.sim, self._pairs(fault)
        sim.hold(pairs, every_s=fault.size)
        self.scene.then(fault.seconds, lambda: sim.hold(pairs, every_s=0.0))

    def _data(self, fault: Fault) -> None:
        """The data sessions of some machines are cut from the rest; votes and beats pass."""
        sim, pairs = self.scene.sim, self._pairs(fault)
        if fault.size < 0.5:
            pairs = {pair for pair in pairs if (pair[0] in fault.nodes) == (fault.size < 0.25)}
        sim.data_cuts |= pairs
        self.scene.then(sim.fleet.timing.zenoh_lease_s, lambda: self._streams_end(pairs & sim.data_cuts))
        self.scene.then(fault.seconds, lambda: sim.data_cuts.difference_update(pairs))

    def _streams_end(self, pairs: set[Pair]) -> None:
        """As `_links_end`, of the data session: only workers' tokens go."""
        machines = self.scene.sim.machines
        for source, target in sorted(pairs):
            if machines[source].node is not None:
                self.scene.sim.work.lose(machines[source], machines[target])
