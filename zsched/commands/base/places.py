"""Where this machine's things are: values of paths that verbs pass on."""

from pathlib import Path

from zsched.core.values.model import NodeId
from zsched.core.values.struct import Struct


class Places(Struct, frozen=True, kw_only=True):
    """Where a machine keeps what belongs to its node."""

    config: Path
    state: Path


class Machine(Struct, frozen=True, kw_only=True):
    """Where this machine's things are, and what it is called."""

    file: Path
    state_folder: Path
    runtime_folder: Path
    node: NodeId
