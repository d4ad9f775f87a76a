"""Network namespaces for tests: one per node on a bridge of their own, with loss, cuts, thin and long links on demand.

Knows: ip, nft, tc, nsenter; whose namespaces are left over. Does not know: fleets, daemons, what is tested.

Nothing touches the machine's own network: the bridge lives in a namespace, too. Names hold the pid of the process that
made them; what a killed test has left is removed by the next one (`sweep`). A process started through `Network.wrap`
dies with the thread that started it.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Final, Self

from zsched.core.values.errors import ZschedError

PREFIX: Final = "zsched-net"
NET: Final = "198.18.0"
"""RFC 2544's range for benchmarks: nobody's network."""
TOOLS: Final = ("ip", "nft", "tc", "nsenter", "setpriv", "unshare")
INTERFACE: Final = "eth0"
COMMAND_S: Final = 20.0

_numbers = itertools.count(1)


class NetworkError(ZschedError):
    """A namespace, link or rule could not be made."""


def run(*command: str, text: str = "") -> str:
    """Run a tool; its standard output.

    Raises:
        NetworkError: it failed or took longer than `COMMAND_S`.
    """
    try:
        done = subprocess.run(command, input=text, capture_output=True, text=True, timeout=COMMAND_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise NetworkError(f"{' '.join(command)}: {error}") from error
    if done.returncode != 0:
        raise NetworkError(f"{' '.join(command)}: {done.stderr.strip() or done.returncode}")
    return done.stdout


def why_not() -> str | None:
    """Why this user cannot make namespaces with rules here; ``None`` when they can (found out by making one)."""
    if os.geteuid() != 0:
        return "not root"
    missing = [tool for tool in TOOLS if shutil.which(tool) is None]
    if missing:
        return f"not installed: {', '.join(missing)}"
    try:
        with Network(("probe",)) as network:
            network.lose(1, "probe")
    except NetworkError as error:
        return str(error)
    return None


def sweep() -> list[str]:
    """Remove the namespaces of processes that live no more, with whatever runs inside; their names."""
    removed = []
    for line in run("ip", "netns", "list").splitlines():
        name = line.split()[0] if line.split() else ""
        owner = re.fullmatch(rf"{PREFIX}-(\d+)-.*", name)
        if owner is None or Path(f"/proc/{owner[1]}").exists():
            continue
        _remove(name)
        removed.append(name)
    return removed


def _remove(name: str) -> None:
    """Kill what runs in a namespace of ours, then delete it."""
    with contextlib.suppress(NetworkError):
        for pid in run("ip", "netns", "pids", name).split():
            with contextlib.suppress(OSError):
                os.kill(int(pid), signal.SIGKILL)
        run("ip", "netns", "delete", name)


class Network:
    """Namespaces on one bridge. Use as a context manager: afterwards they are gone, and what still ran inside."""

    def __init__(self, names: Iterable[str]) -> None:
        """Make one namespace per name, each with an address.

        Raises:
            NetworkError: the user may not, or a tool fails; nothing is left behind.
        """
        sweep()
        self._prefix = f"{PREFIX}-{os.getpid()}-{next(_numbers)}"
        self._hub = f"{self._prefix}-hub"
        self._addresses: dict[str, str] = {}
        self._rules: dict[str, dict[str, tuple[str, ...]]] = {}
        self._lines: list[subprocess.Popen[str]] = []
        """Delay lines."""
        self._ports: dict[str, str] = {}
        """{name: its interface at the bridge}."""
        self._given = 0
        """Addresses given so far; none is given twice."""
        try:
            run("ip", "netns", "add", self._hub)
            run("ip", "-n", self._hub, "link", "add", "bridge", "type", "bridge")
            run("ip", "-n", self._hub, "link", "set", "bridge", "up")
            for name in names:
                self.add(name)
        except NetworkError:
            self.close()
            raise

    def add(self, name: str) -> None:
        """One more namespace on the bridge.

        Raises:
            NetworkError: a tool fails.
        """
        space, port = self.name_of(name), f"port{len(self._addresses) + 1}"
        address = self._next_address()
        self._addresses[name], self._ports[name] = address, port
        run("ip", "netns", "add", space)
        batch = "\n".join(
            (
                f"link add {port} type veth peer name {INTERFACE} netns {space}",
                f"link set {port} master bridge",
                f"link set {port} up",
            )
        )
        run("ip", "-n", self._hub, "-batch", "-", text=batch)
        inside = "\n".join((f"address add {address}/24 dev {INTERFACE}", f"link set {INTERFACE} up", "link set lo up"))
        run("ip", "-n", space, "-batch", "-", text=inside)

    def _next_address(self) -> str:
        self._given += 1
        return f"{NET}.{self._given}"

    def name_of(self, name: str) -> str:
        """What the kernel calls a namespace."""
        return f"{self._prefix}-{name}"

    def address(self, name: str) -> str:
        """The IPv4 address of a namespace."""
        return self._addresses[name]

    def wrap(self, name: str, command: Sequence[str | Path]) -> list[str | Path]:
        """``command`` as it must be started to run in a namespace (same pid, dies with the thread that starts it)."""
        return [*self._enter(name), "setpriv", "--pdeathsig", "KILL", "--", *command]

    def run(self, name: str, *command: str, text: str = "") -> str:
        """What a short command prints in a namespace; ``text`` goes into it.

        Raises:
            NetworkError: it fails, or takes longer than `COMMAND_S`.
        """
        return run(*self._enter(name), *command, text=text)

    def _enter(self, name: str) -> tuple[str, str]:
        return ("nsenter", f"--net=/run/netns/{self.name_of(name)}")

    # --- faults ------------------------------------------------------------------------------------------------------

    def cut(self, *names: str) -> None:
        """Nothing goes in or out any more; nobody notices by itself (packets vanish)."""
        for name in names:
            self._set(name, "cut", f"in iifname {INTERFACE} drop", f"out oifname {INTERFACE} drop")

    def deafen(self, name: str) -> None:
        """Nothing comes in; what it sends arrives."""
        self._set(name, "cut", f"in iifname {INTERFACE} drop")

    def mute(self, name: str) -> None:
        """Nothing goes out; what others send arrives."""
        self._set(name, "cut", f"out oifname {INTERFACE} drop")

    def separate(self, ours: Iterable[str], theirs: Iterable[str]) -> None:
        """No packet passes between the two sides (each goes on within itself)."""
        addresses = ", ".join(self._addresses[name] for name in theirs)
        for name in ours:
            self._set(name, "split", f"in ip saddr {{ {addresses} }} drop", f"out ip daddr {{ {addresses} }} drop")

    def shut(self, name: str, port: int) -> None:
        """A firewall before one machine lets no packet of this TCP port pass, in or out, whichever end listens."""
        ways = (f"in iifname {INTERFACE}", f"out oifname {INTERFACE}")
        rules = (f"{way} tcp {end} {port} drop" for way in ways for end in ("dport", "sport"))
        self._set(name, "port", *rules)

    def keep_out_large(self, name: str, most: int) -> None:
        """Packets of more than ``most`` bytes to this machine vanish, and nobody is told; small ones pass."""
        self._set(name, "large", f"in iifname {INTERFACE} meta length > {most} drop")

    def lose(self, percent: int, *names: str) -> None:
        """This many of 100 packets that come to each of ``names`` are lost, at random."""
        for name in names:
            self._set(name, "loss", f"in iifname {INTERFACE} numgen random mod 100 < {percent} drop")

    def narrow(self, name: str, mbit: float | None) -> None:
        """Limit what leaves a namespace to this many Mbit/s (``None``: no limit) behind a queue of 100 ms."""
        if mbit is None:
            with contextlib.suppress(NetworkError):
                run("tc", "-n", self.name_of(name), "qdisc", "del", "dev", INTERFACE, "root")
            return
        limit = ("rate", f"{mbit}mbit", "burst", "16kb", "latency", "100ms")
        run("tc", "-n", self.name_of(name), "qdisc", "replace", "dev", INTERFACE, "root", "tbf", *limit)

    def link(self, name: str, *, is_up: bool) -> None:
        """Pull or plug a namespace's cable at the bridge's end."""
        run("ip", "-n", self._hub, "link", "set", self._ports[name], "up" if is_up else "down")

    def lengthen(self, name: str, delay_s: float) -> None:
        """Everything to and from a namespace takes this much longer from now on; call it before anything runs there.

        Raises:
            NetworkError: the delay line could not be made.
        """
        space, port = self.name_of(name), self._ports[name]
        run("ip", "-n", self._hub, "link", "del", port)
        command = (sys.executable, "-m", "zsched_lab.fleet.delay_line", str(delay_s), self._hub, port, space, INTERFACE)
        line = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self._lines.append(line)
        assert line.stdout is not None
        if line.stdout.readline() != "ready\n":
            raise NetworkError(f"{name}: no delay line: it ended with {line.wait(COMMAND_S)}")
        run("ip", "-n", self._hub, "link", "set", port, "master", "bridge", "up")
        inside = f"address add {self._addresses[name]}/24 dev {INTERFACE}\nlink set {INTERFACE} up"
        run("ip", "-n", space, "-batch", "-", text=inside)

    def renumber(self, name: str, address: str = "") -> str:
        """A namespace gets another address, as a robot that roams does; its connections are dead. The new address."""
        space, old = self.name_of(name), self._addresses[name]
        self._addresses[name] = new = address or self._next_address()
        run("ip", "-n", space, "address", "del", f"{old}/24", "dev", INTERFACE)
        run("ip", "-n", space, "address", "add", f"{new}/24", "dev", INTERFACE)
        return new

    def heal(self, *names: str) -> None:
        """End cuts and losses of ``names`` (default: of all)."""
        for name in names or tuple(self._rules):
            if self._rules.pop(name, None):
                self._render(name)

    def _set(self, name: str, kind: str, *rules: str) -> None:
        self._rules.setdefault(name, {})[kind] = rules
        self._render(name)

    def _render(self, name: str) -> None:
        """Replace a namespace's whole rule set at once."""
        rules = [rule for kind in self._rules.get(name, {}).values() for rule in kind]
        lines = ["add table inet zsched", "delete table inet zsched", "add table inet zsched"]
        for chain, hook in (("in", "input"), ("out", "output")):
            lines.append(f"add chain inet zsched c_{chain} {{ type filter hook {hook} priority 0; policy accept; }}")
        lines += [f"add rule inet zsched c_{rule}" for rule in rules]
        self.run(name, "nft", "-f", "-", text="\n".join(lines) + "\n")

    # --- end ---------------------------------------------------------------------------------------------------------

    def close(self) -> None:
        """Kill what still runs inside and remove everything; safe to call twice."""
        while self._lines:
            line = self._lines.pop()
            line.kill()
            line.communicate(timeout=COMMAND_S)
        for name in (*map(self.name_of, self._addresses), self._hub):
            if Path("/run/netns", name).exists():
                _remove(name)
        self._addresses.clear()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
