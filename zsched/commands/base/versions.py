"""The versions that matter when something is wrong.

Knows: zsched, its wire format, zenoh, Python. Does not know: callers.
"""

from __future__ import annotations

import platform
import sys
from importlib.metadata import PackageNotFoundError
from importlib.metadata import version as installed

from zsched import __version__
from zsched.commands.base.common import Json, print_json
from zsched.commands.base.options import JsonOption
from zsched.core.values import codec as wire


def versions() -> Json:
    """{what: its version}."""
    try:
        zenoh = installed("eclipse-zenoh")
    except PackageNotFoundError:
        zenoh = "not installed"
    return {"zsched": __version__, "wire": wire.VERSION, "zenoh": zenoh, "python": platform.python_version()}


def version(json_: JsonOption = False) -> None:
    """Show the versions of zsched, its wire format, zenoh and Python.

    Example: zsched version
    """
    found = versions()
    if json_:
        print_json({"schema": "zsched.version/1", **found})
    else:
        sys.stdout.write("".join(f"{name} {text}\n" for name, text in found.items()))
