"""What a daemon finds on its machine when it starts, for the status and the advice in it.

Knows: where things lie, why there is no state. Does not know: what follows from it, files.
"""

from enum import StrEnum

from zsched.core.values.struct import Struct


class NoState(StrEnum):
    """Why a node has no state, where that is not a fault of the file or of its disk."""

    MISSING = "missing"
    """There is no file: it was never initialised, or its folder is gone."""
    ANOTHER_ELECTORATE = "another electorate"
    """The file is whole, and was made with another electorate than the fleet file names."""
    ANOTHER_NODE = "another node"
    """The file is whole, and another fleet's or node's, of whose electors it says nothing here."""


class Startup(Struct, frozen=True, kw_only=True):
    """Facts that hold for one life of a daemon."""

    version: str = ""
    """Of the program."""
    fleet_path: str = ""
    """Where the fleet file lies."""
    copied_file: str = ""
    """Hash of the file that was written here as a copy of an earlier document; empty: it is the operator's own."""
    joins_at: tuple[str, ...] = ()
    """Where applications on this machine join its streams."""
    security: str = ""
    """Who is let in to this node's sessions (`zsched.core.values.snapshot.Exposure`)."""
    no_state: NoState | None = None
