"""Where a node's relay is found: the socket in the runtime folder, and who is behind it.

Knows: the version of what both sides say, connecting, questions, the process that listens. Does not know: zenoh, plans,
how a relay is started.
"""

from __future__ import annotations

import contextlib
import socket
import struct
from pathlib import Path
from typing import Final

from zsched.core.values import codec as wire
from zsched.core.values.errors import WireError
from zsched.link.pipe.frames import read_frame, set_timeout, write_frame
from zsched.link.pipe.protocol import RelayHere, RelayQuestion

PROTOCOL: Final = 3
"""Another one of a relay and a daemon means: the relay is replaced. Raised whenever one of them would misunderstand the
other, or needs a word that the other does not know (the codec reads past what it does not know)."""
GREETING_S: Final = 1.0
"""A relay that does not answer for this long is no relay to go on with."""
_CREDENTIALS: Final = struct.Struct("3i")


def dial(path: Path) -> socket.socket | None:
    """A connection to the relay of a node; ``None``: none listens."""
    link = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        set_timeout(link, GREETING_S)  # a queue that is full would hold us
        link.connect(str(path))
    except OSError:
        link.close()
        return None
    return link


def process_behind(link: socket.socket) -> int:
    """The process that listens where ``link`` goes; 0: of another namespace."""
    found = link.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
    return int(_CREDENTIALS.unpack(found)[0])


def relay_pid(path: Path) -> int | None:
    """The process id of the relay behind a socket, also of one that hangs; ``None``: none runs."""
    link = dial(path)
    if link is None:
        return None
    with link:
        return process_behind(link) or None


def ask_relay(path: Path) -> RelayHere | None:
    """What the relay behind a socket says of itself; ``None``: none answers."""
    link = dial(path)
    if link is None:
        return None
    with link, contextlib.suppress(OSError, WireError):
        write_frame(link.fileno(), wire.encode(RelayQuestion()))
        if (frame := read_frame(link.fileno())) is not None:
            return wire.decode(frame, RelayHere)
    return None
