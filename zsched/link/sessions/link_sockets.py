"""Finds the sockets beneath a zenoh session, says how far its receivers are, and keeps silent strangers from it.

Knows: this process's descriptors, TCP's own counters. Does not know: streams, who subscribes to what, what is done
about a slow receiver.

zenoh tells nobody that a receiver takes nothing: a put waits, or drops, in silence. The kernel knows it for every link:
whether there is room in its send buffer, and how many bytes the other end has taken. The descriptors are zenoh's; they
are only looked at, but for `cut`, `hold`, `abort` and `set_send_buffer`, which look twice, and `hold_back_silent`.
zenoh's admin space names subscribers; but a question to it from within its own process stops for ever when somebody
declares something at the same moment (1.10.2).
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import re
import select
import socket
import struct
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

import zenoh
from zenoh import Session

from zsched.core.hop.room import LARGE, OWN, Account
from zsched.core.values.struct import Struct

SILENT_S: Final = 3600
"""A connection that has said nothing for about this long is given to zenoh after all."""
WAITING: Final = 4096
"""At most this many connections wait; others go to zenoh at once, by SYN cookies. The kernel has this limit, too."""
_INTERNET: Final = (socket.AF_INET, socket.AF_INET6)
_BYTES_ACKED: Final = struct.Struct("<Q")
_BYTES_ACKED_AT: Final = 120
"""Where ``tcpi_bytes_acked`` stands in Linux's ``struct tcp_info`` (4.1 and later)."""
_BYTES_RECEIVED_AT: Final = 128
"""Where ``tcpi_bytes_received`` stands there."""
_LAST_DATA_RECV: Final = struct.Struct("<I")
_LAST_DATA_RECV_AT: Final = 52
"""Where ``tcpi_last_data_recv`` stands there, in ms."""
_TCP_INFO_BYTES: Final = 152
"""Up to ``tcpi_min_rtt`` (4.6 and later)."""
_MIN_RTT: Final = struct.Struct("<I")
_MIN_RTT_AT: Final = 148
"""Where ``tcpi_min_rtt`` stands there, in us; all ones: not measured."""
_INT: Final = struct.Struct("=i")
_UNMEASURED: Final = 0xFFFFFFFF
_SIOCOUTQ: Final = 0x5411
"""How much of what was written is not acknowledged (tcp(7))."""
_SO_BUF_LOCK: Final = 72
"""Which buffers the kernel may not size by itself (5.15 and later)."""
_SNDBUF_LOCKED: Final = 1
_TCP_THIN_LINEAR_TIMEOUTS: Final = 16
"""Equal waits for links with fewer than four packets under way (tcp(7) lacks it; Linux 2.6.34 and later)."""
_WITH_THRESHOLD: Final = b"reno"
"""A congestion control by which those waits become equal, as with CUBIC, not with BBR; every user may choose it."""
_ADDRESS: Final = re.compile(r"(?:tcp|tls)/\[?([^\]#?]+)\]?:(\d+)")
_NEVER: Final = 1 << 30
_NOBODY: Final = struct.pack("=H14x", socket.AF_UNSPEC)
_LIBC: Final = ctypes.CDLL(None, use_errno=True)
Ends = tuple[tuple[str, int], tuple[str, int]]
"""(our address, theirs) of a connection."""


class LinkSocket(Struct, frozen=True):
    """One TCP (or TLS) link of a session."""

    zid: str
    """The session at the other end."""
    ends: Ends
    fd: int

    @property
    def name(self) -> str:
        """Where the other end is."""
        host, port = self.ends[1]
        return f"{host}:{port}"

    def taken(self) -> int:
        """How many bytes the other end has taken so far; 0 when the socket is gone."""
        return self._tcp_info(_BYTES_ACKED, _BYTES_ACKED_AT)

    def brought(self) -> int:
        """How many bytes have come from the other end so far; 0 when the socket is gone."""
        return self._tcp_info(_BYTES_ACKED, _BYTES_RECEIVED_AT)

    def silent_s(self) -> float:
        """How long nothing has come from the other end; zenoh sends three or four signs of life in a lease."""
        return self._tcp_info(_LAST_DATA_RECV, _LAST_DATA_RECV_AT) / 1000

    def _tcp_info(self, value: struct.Struct, at: int) -> int:
        with contextlib.suppress(OSError, struct.error), _borrowed(self.fd) as held:
            return int(value.unpack_from(held.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, at + value.size), at)[0])
        return 0

    def account(self) -> Account | None:
        """What TCP has counted about the link; ``None``: it is gone, or the kernel does not count it."""
        with contextlib.suppress(OSError, struct.error), _borrowed(self.fd) as held:
            if _ends_of(held) != self.ends:
                return None
            told = held.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _TCP_INFO_BYTES)
            round_trip = _MIN_RTT.unpack_from(told, _MIN_RTT_AT)[0]
            return Account(
                acked=_BYTES_ACKED.unpack_from(told, _BYTES_ACKED_AT)[0],
                held=_INT.unpack(fcntl.ioctl(held, _SIOCOUTQ, bytes(_INT.size)))[0],
                round_trip_s=0.0 if round_trip == _UNMEASURED else round_trip / 1e6,
            )
        return None

    def send_buffer(self) -> int:
        """The size of its send buffer as it was asked for, in bytes; 0: the kernel's own, or the link is gone."""
        with contextlib.suppress(OSError), _borrowed(self.fd) as held:
            if _ends_of(held) == self.ends and _is_set(held):
                return held.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF) // 2  # the kernel doubles it, socket(7)
        return 0

    def set_send_buffer(self, size: int) -> bool:
        """Make its send buffer so large, in bytes; what it holds stays.

        `OWN`: as the kernel likes, for what is under way, and 1 MiB for what has not been sent.
        """
        with contextlib.suppress(OSError), _borrowed(self.fd) as held:
            if _ends_of(held) == self.ends:
                if size == OWN and _can_unset(held):
                    others = held.getsockopt(socket.SOL_SOCKET, _SO_BUF_LOCK) & ~_SNDBUF_LOCKED
                    held.setsockopt(socket.SOL_SOCKET, _SO_BUF_LOCK, others)
                    held.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, 2 * LARGE)
                else:
                    held.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, size or 2 * LARGE)
                return True
        return False

    def retry_steadily(self) -> None:
        """Let TCP send again what was lost after equal waits, while little is under way (as `link_retries` does)."""
        with contextlib.suppress(OSError), _borrowed(self.fd) as held:
            if _ends_of(held) == self.ends:
                held.setsockopt(socket.IPPROTO_TCP, _TCP_THIN_LINEAR_TIMEOUTS, 1)

    def cut(self) -> bool:
        """End the connection; ``False`` when the descriptor is another one's by now."""
        with contextlib.suppress(OSError), _borrowed(self.fd) as held:
            if _ends_of(held) == self.ends:
                held.shutdown(socket.SHUT_RDWR)
                return True
        return False

    def hold(self) -> bool:
        """Let zenoh read nothing more of it, but for what fills its buffer; ``False``: it cannot be.

        A descriptor counts as readable once so many bytes are there (``SO_RCVLOWAT``, tcp(7)).
        """
        with contextlib.suppress(OSError), _borrowed(self.fd) as held:
            if _ends_of(held) == self.ends:
                held.setsockopt(socket.SOL_SOCKET, socket.SO_RCVLOWAT, _NEVER)
                return True
        return False

    def abort(self) -> bool:
        """End the connection as `cut` does, and forget what has come by it: zenoh would read that first."""
        with contextlib.suppress(OSError), _borrowed(self.fd) as held:
            if _ends_of(held) == self.ends:
                return bool(_LIBC.connect(self.fd, _NOBODY, len(_NOBODY)) == 0)  # connect(2), AF_UNSPEC
        return False


class LinkSockets:
    """The sockets of one session's links, found once for every link; used by one thread at a time."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._known: dict[Ends, int] = {}

    def links(self) -> tuple[LinkSocket, ...]:
        """The links there are now, as far as they are TCP."""
        found = {(str(link.zid), ends_of(link)) for link in self._session.info.links()}
        links = {ends: zid for zid, ends in found if ends is not None}
        self._find(links)
        return tuple(LinkSocket(zid, ends, self._known[ends]) for ends, zid in links.items() if ends in self._known)

    def _find(self, links: Iterable[Ends]) -> None:
        """Look up the descriptors of links that are new."""
        wanted = set(links)
        self._known = {ends: fd for ends, fd in self._known.items() if ends in wanted}
        if wanted == self._known.keys():
            return
        with contextlib.suppress(OSError):  # no descriptor is left to list them with: the next call finds them
            for path in Path("/proc/self/fd").iterdir():
                with contextlib.suppress(OSError), _borrowed(int(path.name)) as held:
                    ends = _ends_of(held)
                    if ends in wanted:
                        self._known[ends] = int(path.name)


def opened(config: str) -> Session:
    """A session of this configuration (JSON5); whoever dials it and says nothing waits in the kernel.

    Raises:
        zenoh.ZError, ValueError: it cannot be opened.
    """
    session = zenoh.open(zenoh.Config.from_json5(config))
    hold_back_silent()
    return session


def retry_steadily(wanted: Iterable[Ends]) -> int:
    """Let TCP send again what was lost on these links of few packets after equal waits; how many links do so now.

    Their congestion control becomes one that allows it. Links that carry streams keep theirs (`LinkSocket`).

    Raises:
        OSError: no descriptor is left to list them with.
    """
    count, left = 0, set(wanted)
    for path in Path("/proc/self/fd").iterdir() if left else ():
        with contextlib.suppress(OSError), _borrowed(int(path.name)) as held:
            if _ends_of(held) in left:
                held.setsockopt(socket.IPPROTO_TCP, socket.TCP_CONGESTION, _WITH_THRESHOLD)
                held.setsockopt(socket.IPPROTO_TCP, _TCP_THIN_LINEAR_TIMEOUTS, 1)
                count += 1
    return count


def hold_back_silent() -> int:
    """Let the kernel keep connections that say nothing from this process's sessions; how many listeners do so.

    Who dials a session of zenoh speaks first, with TLS or without. A connection that does not costs zenoh 7 KiB and a
    descriptor, and 0.1 s of its listener's time at the end of each handshake: thousands keep new members out for
    minutes. Sockets that are made later need another call.
    """
    count = 0
    for held in _listeners():
        with contextlib.suppress(OSError):
            held.setsockopt(socket.IPPROTO_TCP, socket.TCP_DEFER_ACCEPT, SILENT_S)
            held.listen(WAITING)
            count += 1
    return count


def _listeners() -> Iterator[socket.socket]:
    """This process's internet sockets that listen; each is ours until the next one is asked for."""
    for path in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError), _borrowed(int(path.name)) as held:
            if held.family in _INTERNET and held.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN):
                yield held


def with_room(links: Iterable[LinkSocket], wait_s: float) -> set[int]:
    """The descriptors with room (or gone), waiting at most this long for the first one."""
    poll = select.poll()
    for link in links:
        poll.register(link.fd, select.POLLOUT)
    return {fd for fd, _ in poll.poll(wait_s * 1000)}


@contextlib.contextmanager
def _borrowed(fd: int) -> Iterator[socket.socket]:
    """A socket of zenoh's as one of Python's, which does not close it."""
    held = socket.socket(fileno=fd)  # raises OSError for what is no socket
    try:
        yield held
    finally:
        held.detach()


def _can_unset(held: socket.socket) -> bool:
    """Whether the kernel knows how to size a buffer by itself again."""
    with contextlib.suppress(OSError):
        held.getsockopt(socket.SOL_SOCKET, _SO_BUF_LOCK)
        return True
    return False


def _is_set(held: socket.socket) -> bool:
    """Whether somebody has set the send buffer's size; an older kernel does not tell."""
    return not _can_unset(held) or bool(held.getsockopt(socket.SOL_SOCKET, _SO_BUF_LOCK) & _SNDBUF_LOCKED)


def _ends_of(held: socket.socket) -> Ends:
    ours, theirs = held.getsockname(), held.getpeername()
    if not isinstance(ours, tuple) or not isinstance(theirs, tuple):
        raise OSError("no internet socket")
    return (_plain(ours[0]), ours[1]), (_plain(theirs[0]), theirs[1])


def ends_of(link: zenoh.Link) -> Ends | None:
    """The addresses of a link; ``None``: it is not TCP."""
    ours, theirs = _ADDRESS.match(str(link.src)), _ADDRESS.match(str(link.dst))
    if ours is None or theirs is None:
        return None
    return (_plain(ours[1]), int(ours[2])), (_plain(theirs[1]), int(theirs[2]))


def _plain(host: str) -> str:
    """An address as both sides write it: an IPv4 one without IPv6's prefix."""
    return host.removeprefix("::ffff:").partition("%")[0]
