"""The console entry point: an interrupt while the command line is still loading is no bug, and gets no traceback.

Knows: nothing but that. Does not know: verbs (`zsched.cli`, whose imports take a fifth of a second).
"""

from __future__ import annotations

import sys


def main() -> None:
    """Run the command line."""
    try:
        from zsched.cli import main as run  # noqa: PLC0415 - what may be interrupted

        run()
    except KeyboardInterrupt:
        from zsched.core.values.exits import EXIT_INTERRUPTED  # noqa: PLC0415 - nothing is imported outside of the `try`

        sys.exit(EXIT_INTERRUPTED)


if __name__ == "__main__":
    main()
