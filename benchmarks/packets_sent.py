"""What the packets are that a network namespace sends: ``python -m benchmarks.packets_sent SECONDS``.

Run in the namespace, by `benchmarks.idle`. Counts TCP over IPv4 on a packet socket (packet(7)), so it needs root. A
packet belongs to the control or data network by either port (`zsched_lab.fleet.netbed`), and is an acknowledgement when
it carries no byte (RFC 9293). Prints one JSON object: packets a second by kind.
"""

from __future__ import annotations

import json
import socket
import sys
import time

from zsched_lab.fleet.netbed import CONTROL_PORT, DATA_PORT

KINDS = ("control", "control acks", "data", "data acks", "other")
_ETH_P_ALL, _TCP = 0x0003, 6
_NETWORKS = {CONTROL_PORT: "control", DATA_PORT: "data"}


def kind_of(packet: bytes) -> str:
    """Of an IPv4 packet, from its first header on; `KINDS`."""
    if len(packet) < 40 or packet[0] >> 4 != 4 or packet[9] != _TCP:
        return "other"
    header = 4 * (packet[0] & 0x0F)
    ports = int.from_bytes(packet[header : header + 2]), int.from_bytes(packet[header + 2 : header + 4])
    network = next((_NETWORKS[port] for port in ports if port in _NETWORKS), None)
    if network is None:
        return "other"
    carried = int.from_bytes(packet[2:4]) - header - 4 * (packet[header + 12] >> 4)
    return network if carried else f"{network} acks"


def count(seconds: float) -> dict[str, float]:
    """Packets that leave by other interfaces than the loopback, a second, over so many seconds."""
    found = dict.fromkeys(KINDS, 0)
    with socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, socket.htons(_ETH_P_ALL)) as watch:
        began = time.monotonic()
        while (left := began + seconds - time.monotonic()) > 0:
            watch.settimeout(left)
            try:
                packet, (interface, _, direction, *_) = watch.recvfrom(128)
            except TimeoutError:
                break
            if direction == socket.PACKET_OUTGOING and interface != "lo":
                found[kind_of(packet)] += 1
        took = time.monotonic() - began
    return {kind: number / took for kind, number in found.items()}


if __name__ == "__main__":
    print(json.dumps(count(float(sys.argv[1]))))
