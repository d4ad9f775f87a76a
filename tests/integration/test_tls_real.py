"""A real fleet with certificates: whatever its processes listen on speaks TLS, named in the file or not."""

from __future__ import annotations

import contextlib
import re
import shutil
import socket
import ssl
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from support.certificates import make_tls
from zsched_lab.fleet.netbed import descendants
from zsched_lab.fleet.testbed import Json, Testbed, echo_fleet

LISTENING = "0A"
SOCKET = re.compile(r"socket:\[(\d+)\]")


def secured(folder: Path) -> Json:
    """Three robots and two edges; one of each gives no address."""
    tree = echo_fleet(edges=2)
    for node in tree["nodes"].values():
        if "listen" in node:
            node["listen"] = {kind: end.replace("tcp/", "tls/") for kind, end in node["listen"].items()}
    for name in ("robot3", "edge2"):
        del tree["nodes"][name]["host"], tree["nodes"][name]["listen"]
    tree["zenoh"] = {"config": str(make_tls(folder))}
    return tree


@pytest.fixture
def bed(tmp_path: Path) -> Iterator[Testbed]:
    with Testbed(tmp_path, secured(tmp_path)) as testbed:
        testbed.init()
        testbed.start()
        testbed.wait_settled(90)
        yield testbed


def listeners() -> dict[str, tuple[str, int]]:
    """{inode: (address, port)} of every TCP socket in this network that listens."""
    found = {}
    for line in Path("/proc/net/tcp").read_text().splitlines()[1:]:
        words = line.split()
        if words[3] == LISTENING:
            address, port = words[1].split(":")
            found[words[9]] = (socket.inet_ntoa(bytes.fromhex(address)[::-1]), int(port, 16))
    return found


def listened_on(pid: int) -> list[tuple[str, int]]:
    """Where one process listens."""
    found, sockets = [], listeners()
    with contextlib.suppress(OSError):
        for descriptor in Path(f"/proc/{pid}/fd").iterdir():
            with contextlib.suppress(OSError):
                inode = SOCKET.fullmatch(str(descriptor.readlink()))
                if inode is not None and inode[1] in sockets:
                    found.append(sockets[inode[1]])
    return found


def speaks_tls(address: str, port: int, authority: Path) -> bool:
    """Whether who listens there shows a certificate of ours."""
    context = ssl.create_default_context(cafile=str(authority))
    context.check_hostname = False
    place = ("127.0.0.1" if address == "0.0.0.0" else address, port)  # noqa: S104 - as the kernel shows it
    try:
        with socket.create_connection(place, 5) as plain, context.wrap_socket(plain) as encrypted:
            return encrypted.version() is not None
    except (ssl.SSLError, OSError):
        return False


def test_every_socket_of_every_process_speaks_tls(bed: Testbed) -> None:
    """Daemons, relays and workers, of nodes with an address and without."""
    places: dict[str, list[tuple[str, int]]] = {}
    for node in bed.names:
        daemon, relay = bed.pid(node), bed.relay_pid(node)
        assert relay is not None
        workers = [pid for pid in descendants(daemon) if pid != relay]
        assert listened_on(daemon), f"{node}'s daemon listens"
        assert listened_on(relay), f"{node}'s relay listens"
        assert bool(workers) is node.startswith("edge"), f"{node}'s workers"
        assert not any(map(listened_on, workers)), "nobody dials a worker"
        places[node] = [place for pid in (daemon, relay) for place in listened_on(pid)]
    authority = bed.folder / "ca.pem"
    plain = {node: [one for one in found if not speaks_tls(*one, authority)] for node, found in places.items()}
    assert plain == {node: [] for node in bed.names}
    for node in bed.names:
        assert not [one for one in bed.status(node)["problems"] if one.startswith("tls")]


@pytest.mark.long
def test_init_asks_the_fleet_over_tls(bed: Testbed) -> None:
    """A blank state for a name that has voted is refused, as it is without certificates."""
    bed.wait(lambda: "robot2" in bed.status("robot1")["quorum"]["voted"], 60, "robot1 to remember robot2's vote")
    bed.kill("robot2")
    shutil.rmtree(bed.folder / "robot2")
    command = [sys.executable, "-m", "zsched.cli", "init", "--config", str(bed.file), "--node", "robot2"]
    command += ["--state-dir", str(bed.folder / "robot2")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1, done.stderr
    assert "knows robot2 as an elector that has voted" in done.stderr
