"""What takes root's rights from a command: a folder of mode 0 is closed to it, as to any other user."""

from __future__ import annotations

import os

WITHOUT_RIGHTS = ("setpriv", "--bounding-set", "-all", "--inh-caps", "-all") if os.geteuid() == 0 else ()
"""To be put before the command."""
