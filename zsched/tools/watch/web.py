"""`zsched web`: serves one page, what it shows, and Prometheus' figures; reads only.

A connection answers one request and ends. At most `MOST_CONNECTIONS` are open; one that has not said within
`REQUEST_S` what it wants, or takes its answer too slowly, is cut off. Requests are not logged.

Knows: HTTP, connections, the page's files. Does not know: which requests may ask
(`zsched.tools.watch.gate`), what they get (`zsched.tools.watch.hub`).
"""

from __future__ import annotations

import contextlib
import http.server
import io
import ipaddress
import json
import os
import queue
import socket
import threading
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from zsched.commands.base.common import CliError, Json, stopped_by_signal, warn
from zsched.commands.base.options import Asks
from zsched.core.values.errors import ZschedError
from zsched.core.values.exits import EXIT_FAILED, EXIT_OK, EXIT_UNREACHABLE, EXIT_USAGE
from zsched.host.clock import monotonic_s
from zsched.host.files import read_regular
from zsched.host.guard import guarded
from zsched.tools.watch.feed import Feed
from zsched.tools.watch.gate import EXPLAIN, FILES, HEADERS, LEAST_TOKEN, LIVE, METRICS, Asked, Gate, Refusal, Route
from zsched.tools.watch.hub import Hub

DEFAULT_LISTEN: Final = "127.0.0.1:7459"
TOKEN_VARIABLE: Final = "ZSCHED_WEB_TOKEN"
MOST_CONNECTIONS: Final = 32
REQUEST_S: Final = 5.0
"""From the connection to the last header."""
SEND_S: Final = 10.0
"""For a receiver that takes nothing."""
PING_S: Final = 15.0
"""A live connection says something at least this often, so that one whose other end is gone is noticed."""
MOST_TOKEN_BYTES: Final = 4096
MOST_HEAD_BYTES: Final = 16384
"""Of a request: its line and all headers, among them what a proxy adds."""


def web(
    asked: Asks,
    listen: Annotated[
        str, typer.Option("--listen", metavar="ADDRESS:PORT", help="Where; beyond this machine only with a token.")
    ] = "127.0.0.1:7459",
    token_file: Annotated[
        Path | None,
        typer.Option("--token-file", metavar="FILE", help="Readers must know its only word. [ZSCHED_WEB_TOKEN]"),
    ] = None,
    host: Annotated[
        list[str] | None,
        typer.Option("--host", metavar="NAME", help="Browsers may call this server so, besides its addresses."),
    ] = None,
) -> int:
    """Serve a page that shows the fleet live, and Prometheus' figures under /metrics; it changes nothing.

    Example: zsched web

    It asks one daemon once a second, however many look; a daemon that is not there is waited for.
    """
    address, port = endpoint_of(listen)
    token = token_of(token_file)
    if not token and not ipaddress.ip_address(address).is_loopback:
        raise CliError(EXIT_USAGE, f"--listen {listen} is open to other machines: give a token with --token-file FILE")
    feed = Feed(asked.door)
    try:
        feed.door()
    except CliError as error:
        if error.code != EXIT_UNREACHABLE:
            raise
        warn(f"zsched web: {error}; asking again")
    names = {"localhost", socket.gethostname().lower(), *(name.lower() for name in host or ())}
    server = WebServer(address, port, Gate(names=frozenset(names), token=token), Hub(feed))
    with contextlib.closing(server), stopped_by_signal() as ended:
        server.start()
        warn(f"zsched web: {server.address}{', with a token' if token else ''}; Ctrl-C ends it")
        ended.wait()
    return EXIT_OK


def endpoint_of(text: str) -> tuple[str, int]:
    """(address, port) of ``ADDRESS:PORT``; an IPv6 address stands in brackets, ``localhost`` is 127.0.0.1.

    >>> endpoint_of("localhost:7459"), endpoint_of("[::1]:80")
    (('127.0.0.1', 7459), ('::1', 80))

    Raises:
        CliError: it is none.
    """
    host, _, port = text.rpartition(":")
    bare = host[1:-1] if host.startswith("[") and host.endswith("]") else host
    with contextlib.suppress(ValueError):
        address = ipaddress.ip_address("127.0.0.1" if bare == "localhost" else bare)
        if port.isascii() and port.isdigit() and int(port) <= 65535 and (address.version == 6) == (bare != host):
            return str(address), int(port)
    raise CliError(EXIT_USAGE, f"--listen: {text!r} is no address with a port; write {DEFAULT_LISTEN}")


def token_of(file: Path | None) -> str:
    """The token: a file's only line, else the environment's; empty where there is none.

    Raises:
        CliError: it cannot be read (1), or is no word of at least 16 printable ASCII characters (2).
    """
    where, token = TOKEN_VARIABLE, os.environ.get(TOKEN_VARIABLE, "")
    if file is not None:
        try:
            where, token = str(file), read_regular(file, MOST_TOKEN_BYTES).decode(errors="replace").strip()
        except OSError as error:
            raise CliError(EXIT_FAILED, f"--token-file {file}: cannot be read: {error.strerror}") from error
    elif not token:
        return ""
    if len(token) < LEAST_TOKEN or not all("!" <= char <= "~" for char in token):
        raise CliError(EXIT_USAGE, f"{where}: a token is one word of at least {LEAST_TOKEN} ASCII characters")
    return token


# --- the server ------------------------------------------------------------------------------------------------------


class WebServer:
    """Listens at one address; a thread for each connection."""

    def __init__(self, host: str, port: int, gate: Gate, hub: Hub, *, request_s: float = REQUEST_S) -> None:
        """Bind.

        Raises:
            CliError: the place cannot be had.
        """
        try:
            self._server = _Server((host, port), gate, hub, request_s)
        except OSError as error:
            raise CliError(
                EXIT_FAILED, f"cannot listen at {host}:{port}: {error.strerror}; give another place with --listen"
            ) from error
        self._hub = hub
        self._thread = guarded(self._server.serve_forever, 0.1, name="zsched-web")
        self._is_started = False

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self._server.server_address[1])

    @property
    def address(self) -> str:
        """For a browser."""
        host = str(self._server.server_address[0])
        return f"http://{f'[{host}]' if ':' in host else host}:{self.port}/"

    def start(self) -> None:
        """Begin to ask and to serve."""
        self._hub.start()
        self._thread.start()
        self._is_started = True

    def close(self) -> None:
        """End every connection and stop."""
        self._hub.close()
        if self._is_started:
            self._server.shutdown()
        self._server.server_close()


class _Server(http.server.HTTPServer):
    """Threads, bounded."""

    request_queue_size = MOST_CONNECTIONS

    def __init__(self, place: tuple[str, int], gate: Gate, hub: Hub, request_s: float) -> None:
        self.address_family = socket.AF_INET6 if ":" in place[0] else socket.AF_INET
        self.gate, self.hub = gate, hub
        self._request_s = request_s
        self._lock = threading.Lock()
        self._open: dict[socket.socket, float | None] = {}
        """{connection: until when it must have said what it wants; ``None``: it has}."""
        super().__init__(place, _Handler)

    def server_bind(self) -> None:
        """Without the look-up of a host name that the standard library's makes."""
        super(http.server.HTTPServer, self).server_bind()
        self.server_name, self.server_port = str(self.server_address[0]), int(self.server_address[1])

    def process_request(self, request: Any, client_address: Any) -> None:
        """Serve a connection in a thread of its own, or refuse it when there are too many."""
        with self._lock:
            is_taken = len(self._open) < MOST_CONNECTIONS
            if is_taken:
                self._open[request] = monotonic_s() + self._request_s
        if not is_taken:
            with contextlib.suppress(OSError):
                request.settimeout(0.2)
                request.sendall(b"HTTP/1.1 503 Service Unavailable\r\nConnection: close\r\nContent-Length: 0\r\n\r\n")
            self.shutdown_request(request)
            return
        try:
            guarded(self._serve, request, client_address, name="zsched-web-1", is_lasting=False).start()
        except RuntimeError:  # no thread could be started
            self._forget(request)
            self.shutdown_request(request)

    def has_asked(self, request: socket.socket) -> None:
        """It has said what it wants."""
        with self._lock:
            if request in self._open:
                self._open[request] = None

    def service_actions(self) -> None:
        """Cut off who takes too long to say what it wants; called ten times a second."""
        now = monotonic_s()
        with self._lock:
            late = [request for request, until in self._open.items() if until is not None and until < now]
        for request in late:
            with contextlib.suppress(OSError):  # its thread sees the end, and closes it
                request.shutdown(socket.SHUT_RDWR)

    def server_close(self) -> None:
        """Stop listening, and end what is open."""
        super().server_close()
        with self._lock:
            left = list(self._open)
        for request in left:
            with contextlib.suppress(OSError):
                request.shutdown(socket.SHUT_RDWR)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A client that went away is no error; the thread's guard reports our own faults."""

    def _serve(self, request: socket.socket, client_address: Any) -> None:
        try:
            with contextlib.suppress(OSError):
                self.finish_request(request, client_address)
        finally:
            self._forget(request)
            self.shutdown_request(request)

    def _forget(self, request: socket.socket) -> None:
        with self._lock:
            self._open.pop(request, None)


class _Handler(http.server.BaseHTTPRequestHandler):
    """One request."""

    server: _Server
    protocol_version = "HTTP/1.1"
    timeout = SEND_S

    def handle(self) -> None:
        """Answer one request, and end."""
        self.close_connection = True
        head = self._read_head()
        self.rfile = io.BytesIO(head)  # the library reads lines of 64 KiB, a hundred of them
        self.raw_requestline = self.rfile.readline()
        if len(head) > MOST_HEAD_BYTES:
            self.requestline = self.request_version = self.command = ""
            self._refuse(Refusal(status=431, why=f"a request's head has at most {MOST_HEAD_BYTES} bytes"))
            return
        if not self.raw_requestline or not self.parse_request():
            return
        self.close_connection = True
        self.server.has_asked(self.connection)
        asked = Asked(method=self.command, target=self.path, headers=lambda name: self.headers.get_all(name) or ())
        route = self.server.gate.judge(asked)
        if isinstance(route, Refusal):
            self._refuse(route)
        elif route.path == LIVE:
            self._live()
        else:
            self._answer(route)

    def _read_head(self) -> bytes:
        """All up to the empty line, or one byte more than may be."""
        head = line = self.rfile.readline(MOST_HEAD_BYTES + 1)
        while line.strip() and len(head) <= MOST_HEAD_BYTES:
            line = self.rfile.readline(MOST_HEAD_BYTES + 1 - len(head))
            head += line
        return head

    def _answer(self, route: Route) -> None:
        hub = self.server.hub
        if route.path in FILES:
            name, kind = FILES[route.path]
            self._send(200, kind, files("zsched.tools.watch").joinpath("page", name).read_bytes())
        elif route.path == METRICS:
            self._send(200, "text/plain; version=0.0.4; charset=utf-8", hub.metrics().encode())
        elif route.path == EXPLAIN:
            try:
                self._send_json(200, hub.explain(route.task))
            except ZschedError as error:
                self._send_json(503, {"error": str(error)})
        else:
            self._send_json(200, hub.status())

    def _live(self) -> None:
        """Server-sent events until either side ends."""
        hub = self.server.hub
        client = hub.join()
        if client is None:
            self._refuse(Refusal(status=503, why="as many look as may", headers=(("Retry-After", "5"),)))
            return
        try:
            self._head(200, "text/event-stream")
            while self.command != "HEAD":
                try:
                    message = client.messages.get(timeout=PING_S)
                except queue.Empty:
                    message = b": still here\n\n"
                if message is None or client.is_dropped:
                    return
                self.wfile.write(message)
        finally:
            hub.leave(client)

    def _refuse(self, refusal: Refusal) -> None:
        self._send_json(refusal.status, {"error": refusal.why}, refusal.headers)

    def _send_json(self, status: int, body: Json, headers: tuple[tuple[str, str], ...] = ()) -> None:
        self._send(status, "application/json", json.dumps(body).encode(), headers)

    def _send(self, status: int, kind: str, body: bytes, headers: tuple[tuple[str, str], ...] = ()) -> None:
        self._head(status, kind, (("Content-Length", str(len(body))), *headers))
        if self.command != "HEAD":
            self.wfile.write(body)

    def _head(self, status: int, kind: str, more: tuple[tuple[str, str], ...] = ()) -> None:
        self.send_response_only(status)
        self.send_header("Content-Type", kind)
        for name, value in (*HEADERS.items(), *more, ("Connection", "close")):
            self.send_header(name, value)
        self.end_headers()

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """A request that is none: the standard library's parser says why, in its words."""
        del explain
        self.server.has_asked(self.connection)
        self._refuse(Refusal(status=code, why=message or "no HTTP request"))

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002 - the standard library's name
        """Nothing: addresses of requests are not kept."""
