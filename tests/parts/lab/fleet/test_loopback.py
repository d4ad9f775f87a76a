"""Addresses of our own: no two processes ask for the same endpoint, and an address goes back by itself."""

from __future__ import annotations

import ipaddress
import os
import signal
import socket
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from zsched_lab.fleet import loopback
from zsched_lab.fleet.loopback import PORTS, free_endpoints, own_address

TELL = "from zsched_lab.fleet.loopback import free_endpoints; print(*free_endpoints(300), flush=True); input()"

FORK = """
import os
from zsched_lab.fleet.loopback import own_address
print(own_address(), flush=True)
if (pid := os.fork()) == 0:
    print(own_address(), flush=True)
    os._exit(0)
os.waitpid(pid, 0)
print(own_address())
"""


def start() -> subprocess.Popen[str]:
    return subprocess.Popen([sys.executable, "-c", TELL], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def told(process: subprocess.Popen[str]) -> list[str]:
    assert process.stdout is not None
    return process.stdout.readline().split()


def port_of(endpoint: str) -> int:
    return int(endpoint.rpartition(":")[2])


def test_an_address_is_on_loopback_and_stays() -> None:
    assert own_address() == own_address()
    assert ipaddress.ip_address(own_address()).is_loopback
    assert own_address() != "127.0.0.1"


def test_endpoints_are_different_and_can_be_listened_on() -> None:
    endpoints = free_endpoints(20)
    assert len(set(endpoints)) == 20
    for endpoint in endpoints:
        assert endpoint.startswith(f"tcp/{own_address()}:")
        with socket.socket() as listener:
            listener.bind((own_address(), port_of(endpoint)))
            listener.listen()


def test_a_port_that_somebody_has_on_every_address_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as other:
        other.bind(("0.0.0.0", 0))  # noqa: S104 - what is tested
        monkeypatch.setattr(loopback, "PORTS", (other.getsockname()[1],))
        monkeypatch.setattr(loopback, "_held", [])
        with pytest.raises(OSError, match="no port of"):
            free_endpoints(1)


def test_processes_at_once_have_nothing_in_common() -> None:
    processes = [start() for _ in range(6)]
    try:
        with ThreadPoolExecutor(len(processes)) as pool:
            found = [one for endpoints in pool.map(told, processes) for one in endpoints]
    finally:
        for process in processes:
            process.kill()
            process.communicate(timeout=60)
    assert len(found) == 6 * 300
    assert len(set(found)) == len(found)


def test_a_taken_address_is_passed_over_and_comes_back_when_its_process_is_killed() -> None:
    process = start()
    try:
        address = told(process)[0].removeprefix("tcp/").partition(":")[0]
        second = loopback._take(process.pid)
        os.close(second.descriptor)
        assert second.address != address
    finally:
        process.send_signal(signal.SIGKILL)
        process.communicate(timeout=60)
    third = loopback._take(process.pid)
    os.close(third.descriptor)
    assert third.address == address


def test_a_forked_child_has_an_address_of_its_own() -> None:
    done = subprocess.run([sys.executable, "-c", FORK], capture_output=True, text=True, timeout=60, check=True)
    parents, childs, parents_again = done.stdout.split()
    assert parents == parents_again != childs


def test_ports_lie_below_those_of_outgoing_connections() -> None:
    outgoing = Path("/proc/sys/net/ipv4/ip_local_port_range").read_text()
    assert PORTS[-1] < int(outgoing.split()[0])
