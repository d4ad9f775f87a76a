"""The versions that matter when something is wrong.

Knows: zsched, its wire format, zenoh, Python. Does not know: callers.
"""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError
from importlib.metadata import version as installed

from zsched import __version__
from zsched.commands.common import Json
from zsched.wire import codec as wire


def versions() -> Json:
    """{what: its version}."""
    try:
        zenoh = installed("eclipse-zenoh")
    except PackageNotFoundError:
        zenoh = "not installed"
    return {"zsched": __version__, "wire": wire.VERSION, "zenoh": zenoh, "python": platform.python_version()}
