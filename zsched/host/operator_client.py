"""Asks a daemon on this machine through its operators' socket: one JSON object, one line each way.

Knows: sockets, lines, why nobody answers. Does not know: what is asked; how it is served (`operator_socket`), so that a
verb which only asks loads no logging.
"""

from __future__ import annotations

import contextlib
import errno
import json
import socket
from pathlib import Path
from typing import Any

from zsched.core.values.errors import AdapterError

Json = dict[str, Any]


def ask(path: Path, request: Json, timeout_s: float = 5.0) -> Json:
    """Ask the daemon behind ``path`` one thing.

    Raises:
        AdapterError: nobody listens there, no answer in time, or the answer is no JSON object.
    """
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
            connection.settimeout(timeout_s)
            connection.connect(str(path))
            with contextlib.suppress(BrokenPipeError):  # it has said why already
                connection.sendall(json.dumps(request).encode() + b"\n")
            with connection.makefile("rb") as lines:
                line = lines.readline()
            if not line:
                raise ConnectionAbortedError(errno.ECONNABORTED, "it ended before it answered")
            answer = json.loads(line)
    except (BlockingIOError, TimeoutError) as error:  # the first: its queue of connections is full
        what = f"the daemon at {path} did not answer within {timeout_s:g} s; is it wedged?"
        raise AdapterError(f"{what} If it stays so: sudo systemctl restart zsched (its relay goes on)") from error
    except (OSError, ValueError, RecursionError) as error:
        detail = getattr(error, "strerror", None) or error
        raise AdapterError(f"no daemon answers at {path} ({detail}); start it with `zsched up`") from error
    if not isinstance(answer, dict):
        raise AdapterError(f"the daemon at {path} answered something that is no object")
    return answer
