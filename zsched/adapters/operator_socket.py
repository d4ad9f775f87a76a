"""The local door for operators: a unix socket that speaks one JSON object per line.

Knows: sockets, lines, size and time limits. Does not know: what a request means (`serve` is given a function).

Every request is an object with a ``verb``; the answer is one object on one line. Only who may write the socket's file
may ask: it is created with mode 0660 in the runtime folder.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from zsched.errors import AdapterError
from zsched.guard import guarded

MAX_LINE = 1 << 20
MAX_CONNECTIONS = 16
IDLE_S = 30.0

Json = dict[str, Any]
log = logging.getLogger("zsched.operator")


class OperatorSocket:
    """Serves ``answer(request) -> response`` on a unix socket, one thread per connection, at most 16."""

    def __init__(self, path: Path, answer: Callable[[Json], Json]) -> None:
        self.path = path
        self._answer = answer
        self._listener: socket.socket | None = None
        self._slots = threading.BoundedSemaphore(MAX_CONNECTIONS)
        self._thread = guarded(self._accept, name="zsched-operator")

    def open(self) -> None:
        """Bind and listen; a socket file that nobody answers on is replaced.

        Raises:
            AdapterError: another daemon answers there, or the place cannot be used.
        """
        if len(os.fsencode(self.path)) > 107:
            raise AdapterError(f"{self.path} is too long for a unix socket; choose a shorter --runtime-dir")
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            if self.path.exists():
                self._replace_stale()
            listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            listener.bind(str(self.path))
            self.path.chmod(0o660)
            listener.listen(MAX_CONNECTIONS)
        except OSError as error:
            raise AdapterError(f"cannot listen on {self.path}: {error.strerror}; check --runtime-dir") from error
        self._listener = listener
        self._thread.start()

    def _replace_stale(self) -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
            probe.settimeout(0.5)
            try:
                probe.connect(str(self.path))
            except (ConnectionRefusedError, FileNotFoundError):
                self.path.unlink(missing_ok=True)
                return
            except (BlockingIOError, TimeoutError):
                pass  # somebody listens, and is busy
        raise AdapterError(f"a daemon answers on {self.path} already; stop it or choose another --runtime-dir")

    def close(self) -> None:
        """Stop listening and remove the file."""
        if self._listener is None:
            return
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._listener = None
        with contextlib.suppress(OSError):
            self.path.unlink()

    def _accept(self) -> None:
        listener = self._listener
        while listener is not None and self._listener is not None:
            try:
                connection, _ = listener.accept()
            except OSError:
                return
            if not self._slots.acquire(blocking=False):
                connection.close()
                continue
            guarded(self._serve, connection, name="zsched-operator-1", is_lasting=False).start()

    def _serve(self, connection: socket.socket) -> None:
        try:
            with connection, connection.makefile("rb") as lines:
                connection.settimeout(IDLE_S)
                while line := lines.readline(MAX_LINE):
                    if not line.endswith(b"\n"):  # half a request, or longer than any: not ours to guess at
                        connection.sendall(b'{"error": "expected one line of less than 1 MiB"}\n')
                        return
                    connection.sendall(json.dumps(self._respond(line)).encode() + b"\n")
        except OSError:
            pass  # the operator went away
        finally:
            self._slots.release()

    def _respond(self, line: bytes) -> Json:
        try:
            request = json.loads(line)
        except (ValueError, RecursionError) as error:
            return {"error": f"not a JSON object on one line: {error}"}
        if not isinstance(request, dict) or not isinstance(request.get("verb"), str):
            return {"error": "expected an object with a verb"}
        try:
            return self._answer(request)
        except Exception as error:
            log.exception("request_failed verb=%s", request["verb"])
            return {"error": f"{type(error).__name__}: {error}"}


def ask(path: Path, request: Json, timeout_s: float = 5.0) -> Json:
    """Ask the daemon behind ``path`` one thing.

    Raises:
        AdapterError: nobody listens there, no answer in time, or the answer is no JSON object.
    """
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as connection:
            connection.settimeout(timeout_s)
            connection.connect(str(path))
            connection.sendall(json.dumps(request).encode() + b"\n")
            with connection.makefile("rb") as lines:
                answer = json.loads(lines.readline())
    except (BlockingIOError, TimeoutError) as error:  # the first: its queue of connections is full
        raise AdapterError(f"the daemon at {path} did not answer within {timeout_s:g} s; is it wedged?") from error
    except (OSError, ValueError) as error:
        detail = getattr(error, "strerror", None) or error
        raise AdapterError(f"no daemon answers at {path} ({detail}); start it with `zsched up`") from error
    if not isinstance(answer, dict):
        raise AdapterError(f"the daemon at {path} answered something that is no object")
    return answer
