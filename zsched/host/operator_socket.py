"""The operators' unix socket on this machine: one JSON object per line.

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

from zsched.core.values.errors import AdapterError
from zsched.host.guard import guarded

MAX_LINE = 1 << 20
MAX_CONNECTIONS = 16
IDLE_S = 10.0
"""A connection that says nothing for this long, or does not take its answer, is closed..."""
NESTED = "a request is an object of words and numbers: this one is nested too deeply"
RETRY_S = 0.2
"""Pause after a connection that could not be taken (no descriptors, no memory, no thread)."""

Json = dict[str, Any]
log = logging.getLogger("zsched.operator")


class OperatorSocket:
    """Serves ``answer(request) -> response`` on a unix socket, one thread per connection, at most 16.

    ...or at once when another wants its place: a silent connection keeps nobody from asking.
    """

    def __init__(self, path: Path, answer: Callable[[Json], Json]) -> None:
        self.path = path
        self._answer = answer
        self._listener: socket.socket | None = None
        self._lock = threading.Lock()
        self._open: dict[socket.socket, bool] = {}
        """{connection: whether it is being answered}, in the order of their last words."""
        self._closing = threading.Event()
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
        listener, self._listener = self._listener, None
        if listener is None:
            return
        self._closing.set()
        with contextlib.suppress(OSError):
            listener.shutdown(socket.SHUT_RDWR)
        listener.close()
        with contextlib.suppress(OSError):
            self.path.unlink()

    def _accept(self) -> None:
        is_failing = False
        while (listener := self._listener) is not None:
            try:
                connection, _ = listener.accept()
                self._take(connection)
            except (OSError, RuntimeError) as error:  # the second: no thread could be started
                if self._closing.is_set():
                    return
                if not is_failing:
                    log.warning("no_connection_taken why=%s; trying on every %g s", error, RETRY_S)
                is_failing = True
                self._closing.wait(RETRY_S)
            else:
                if is_failing:
                    log.warning("connections are taken again")
                is_failing = False

    def _take(self, connection: socket.socket) -> None:
        """Serve it, in the place of the one that has been silent for longest if need be."""
        with self._lock:
            silent = next((one for one, is_busy in self._open.items() if not is_busy), None)
            is_full = len(self._open) >= MAX_CONNECTIONS
            if not is_full or silent is not None:
                self._open[connection] = False
            if is_full and silent is not None:
                del self._open[silent]
                with contextlib.suppress(OSError):  # its thread sees the end, and closes it
                    silent.shutdown(socket.SHUT_RDWR)
            is_taken = connection in self._open
        if not is_taken:
            with connection, contextlib.suppress(OSError):
                connection.settimeout(RETRY_S)
                connection.sendall(b'{"error": "busy with other questions; ask again"}\n')
            return
        try:
            guarded(self._serve, connection, name="zsched-operator-1", is_lasting=False).start()
        except RuntimeError:
            self._forget(connection)
            connection.close()
            raise

    def _forget(self, connection: socket.socket) -> None:
        with self._lock:
            self._open.pop(connection, None)

    def _mark(self, connection: socket.socket, *, is_busy: bool) -> bool:
        """Note that it has spoken, or has its answer; false when its place was given to another."""
        with self._lock:
            if self._open.pop(connection, None) is None:
                return False
            self._open[connection] = is_busy
            return True

    def _serve(self, connection: socket.socket) -> None:
        try:
            with connection, connection.makefile("rb") as lines:
                connection.settimeout(IDLE_S)
                while (line := lines.readline(MAX_LINE)) and self._mark(connection, is_busy=True):
                    if not line.endswith(b"\n"):  # half a request, or longer than any: not ours to guess at
                        connection.sendall(b'{"error": "expected one line of less than 1 MiB"}\n')
                        return
                    connection.sendall(self._respond(line).encode() + b"\n")
                    self._mark(connection, is_busy=False)
        except OSError:
            pass  # the operator went away
        finally:
            self._forget(connection)

    def _respond(self, line: bytes) -> str:
        try:
            return json.dumps(self._answered(line))
        except RecursionError:
            return json.dumps({"error": NESTED})

    def _answered(self, line: bytes) -> Json:
        try:
            request = json.loads(line)
        except ValueError as error:
            return {"error": f"not a JSON object on one line: {error}"}
        if not isinstance(request, dict) or not isinstance(request.get("verb"), str):
            return {"error": "expected an object with a verb"}
        try:
            return self._answer(request)
        except RecursionError:
            raise
        except Exception as error:
            log.exception("request_failed verb=%s", request["verb"])
            return {"error": f"{type(error).__name__}: {error}"}
