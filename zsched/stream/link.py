"""An application's link to its node's relay: finds the socket, says the keys, reads what it is told, comes again.

Knows: frames, the socket's path. Does not know: plans, streams, what the words mean.
"""

from __future__ import annotations

import os
import socket
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from zsched import paths
from zsched.core.relay_protocol import RelayReport
from zsched.errors import AdapterError, WireError
from zsched.ipc.pipe import TO_APPLICATIONS, read_frame, write_frame
from zsched.ipc.protocol import RelayRefused, StreamKeys, StreamsHere
from zsched.ipc.takeover import set_timeout
from zsched.wire import codec as wire

ANSWERS_S: Final = 2.0
"""A relay answers the first word within this time, and reads each later one."""

NEEDS: Final = "the robot needs `listen: {streams: ...}` in the fleet file and a running daemon"
NO_LIMIT: Final = bytes(16)
"""Of a socket's time to read, as setsockopt(2) takes it."""


def place_of(runtime_dir: Path | None, node: str, env: Mapping[str, str]) -> Path:
    """The socket of this machine's node; ``node`` says which where there are several.

    Raises:
        AdapterError: there is none, or there are several.
    """
    folder = paths.asked_folder(runtime_dir, env)
    if node:
        return paths.streams_path(folder, node)
    found = paths.local_streams(folder)
    if len(found) == 1:
        return found[0]
    if found:
        names = ", ".join(path.stem for path in found)
        raise AdapterError(f"{folder} has several nodes: {names}; say which (Streams.join(node=...), ZSCHED_NODE)")
    raise AdapterError(
        f"no relay lets applications have their streams themselves in {folder}: {NEEDS}, and the folder must be "
        "readable"
    )


class RefusedError(AdapterError):
    """The relay is there, and does not let this application in."""


class Link:
    """A connection to the relay that has let us in."""

    def __init__(self, path: Path, keys: tuple[str, ...]) -> None:
        """Connect and say our keys.

        Raises:
            RefusedError: another application is there.
            AdapterError: nobody answers.
        """
        self._sending = threading.Lock()
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            answer, text = self._greet(path, keys)
        except FileNotFoundError as error:
            self._socket.close()
            raise AdapterError(f"no relay answers at {path}: {NEEDS}") from error
        except (OSError, WireError) as error:
            self._socket.close()
            raise AdapterError(f"no relay answers at {path}: {error}") from error
        if isinstance(answer, StreamsHere) and text is not None:
            self.fleet, self.node, self.session = answer.fleet, answer.node, text.decode()
            return
        self._socket.close()
        if isinstance(answer, RelayRefused):
            raise RefusedError(answer.reason)
        raise AdapterError(f"no relay answers at {path}: it went away")

    def _greet(self, path: Path, keys: tuple[str, ...]) -> tuple[StreamsHere | RelayRefused | None, bytes | None]:
        set_timeout(self._socket, ANSWERS_S)
        self._socket.connect(str(path))
        self.say(StreamKeys(keys=keys, pid=os.getpid()))
        frame = read_frame(self._socket.fileno())
        answer: StreamsHere | RelayRefused | None = None
        if frame is not None:
            answer = wire.decode(frame, StreamsHere, RelayRefused)  # type: ignore[assignment] # one of both
        text = read_frame(self._socket.fileno()) if isinstance(answer, StreamsHere) else None
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, NO_LIMIT)
        return answer, text

    def read(self) -> Any:
        """The next thing that we are told; ``None``: the relay is gone."""
        try:
            frame = read_frame(self._socket.fileno())
            return None if frame is None else wire.decode(frame, *TO_APPLICATIONS)
        except (OSError, WireError):
            return None

    def say(self, word: RelayReport | StreamKeys) -> None:
        """Tell the relay; nothing where it is gone: the reader hears of that."""
        with self._sending:
            try:
                write_frame(self._socket.fileno(), wire.encode(word))
            except BlockingIOError:  # it does not read: half a word may have gone
                self.hang_up()
            except (OSError, ValueError, WireError):
                return

    def hang_up(self) -> None:
        """End it for both sides; `read` answers ``None``."""
        try:
            self._socket.shutdown(socket.SHUT_RDWR)
        except OSError:
            return

    def close(self) -> None:
        """Give the descriptor back, when nobody reads any more; who writes ends first."""
        self.hang_up()
        with self._sending:
            self._socket.close()
