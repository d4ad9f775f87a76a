"""Puts the nodes of a run into network namespaces, each behind a link of a set rate (tbf), where a block asks for it.

Knows: which process belongs to which node (by its name's end), how a fleet file looks inside. Does not know: schemes.

What a node *sends* is limited: a robot's maps on their way to the owner, and the merged maps that leave the owner for
all robots together. Within a node nothing is: its applications and the recorder beside them stand for one machine.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from ruamel.yaml import YAML

from zsched.core.values.model import NodeId
from zsched_lab.fleet.children import Child, Children
from zsched_lab.fleet.netbed import DATA_PORT, in_namespaces
from zsched_lab.fleet.netns import Network
from zsched_lab.fleet.runner import LabFleet, read_tree


@contextlib.contextmanager
def narrow_links(nodes: Sequence[NodeId], bandwidth_mbit: float | None) -> Iterator[Network | None]:
    """A namespace per node behind a link of this many Mbit/s; ``None`` without a limit: all nodes share this machine's.

    Raises:
        NetworkError: this user may not; `zsched_lab.fleet.netns.why_not` tells beforehand.
    """
    if bandwidth_mbit is None:
        yield None
        return
    with Network(nodes) as network:
        for node in nodes:
            network.narrow(node, bandwidth_mbit)
        yield network


class NodeChildren(Children):
    """Children of which those whose name ends in a node's (``daemon-edge1``) are started in that node's namespace."""

    def __init__(self, logs: Path, network: Network | None, nodes: Sequence[NodeId]) -> None:
        super().__init__(logs)
        self._network, self._nodes = network, frozenset(nodes)

    def start(self, name: str, command: list[str], *, output: Path | None = None) -> Child:
        """As `Children.start`."""
        node = name.rpartition("-")[2]
        if self._network is not None and node in self._nodes:
            command = [str(word) for word in self._network.wrap(node, command)]
        return super().start(name, command, output=output)


def spaced(fleet: LabFleet, network: Network) -> LabFleet:
    """The fleet with its nodes at their namespaces' addresses, rewritten in place.

    Shared memory is off: namespaces share it, and what goes through it would not pass the link.
    """
    tree = in_namespaces(read_tree(fleet.path), network) | {"shared_memory": "off"}
    with fleet.path.open("w", encoding="utf-8") as file:
        file.write("# Effective fleet file of one run, for nodes in network namespaces.\n")
        YAML().dump(tree, file)
    return replace(fleet, data_endpoints=dict.fromkeys(fleet.kinds, f"tcp/127.0.0.1:{DATA_PORT}"))
