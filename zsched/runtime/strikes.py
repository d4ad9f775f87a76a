"""Does to this daemon what an operator rehearses: ends it, or cuts its links for a while; or says why it cannot.

Knows: what would start this daemon again, nftables. Does not know: whether the fleet can bear it
(`zsched.core.node.rehearsal`).

The kernel ends a cut: the rules drop what goes to or comes from the ports of a set, and the ports leave the set by a
timeout of nftables. So a cut is over in time though this daemon, or the one that gave the order, dies meanwhile. What
goes over the loopback interface is left alone: workers and applications of this machine keep their relay.
"""

from __future__ import annotations

import logging
import os
import re
import signal
import subprocess
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

from zsched.core.values.fleet import Fleet
from zsched.core.values.messages import CommandOutcome, CommandResult
from zsched.core.values.model import NodeId
from zsched.core.values.rehearsal import Step, Strike
from zsched.host.guard import guarded
from zsched.link.sessions.endpoints import is_here

RESTARTED_BY: Final = "ZSCHED_RESTARTED_BY"
"""Set by a supervisor other than systemd that starts its daemon again, whatever it died of: its name."""
ANSWER_S: Final = 0.3
"""Between the answer and the end, so that the answer is out."""
TOOL_S: Final = 5.0
TABLE: Final = "zsched_rehearsal"
_NOT_AGAIN: Final = ("", "no", "on-success", "on-watchdog")
"""Settings of systemd's ``Restart=`` by which a killed service stays dead."""
_PORT: Final = re.compile(r":(\d+)(?:[?#].*)?$")

log = logging.getLogger("zsched.rehearsal")
Answer = Callable[[int, CommandResult], None]


class Strikes:
    """What one daemon can do to itself; each wish has a thread, for systemd and nftables take their time."""

    def __init__(self, me: NodeId, answer: Answer) -> None:
        """``answer`` takes the outcome of a request, from any thread."""
        self._me, self._answer = me, answer

    def order(self, request: int, strike: Strike, fleet: Fleet) -> None:
        """Answer whether it can be done and, unless it is only planned, do it."""
        run = self._end if strike.step is Step.DAEMON else self._cut
        guarded(run, request, strike, fleet, name="zsched-strike", is_lasting=False).start()

    def _end(self, request: int, strike: Strike, _fleet: Fleet) -> None:
        why = why_no_restart(os.environ, os.getpid())
        if why or strike.is_plan:
            self._tell(request, why, "this daemon can be killed")
            return
        self._tell(request, "", "this daemon is killed")
        time.sleep(ANSWER_S)
        log.warning("killed by %s, who rehearses", strike.asked.by)
        os.kill(os.getpid(), signal.SIGKILL)

    def _cut(self, request: int, strike: Strike, fleet: Fleet) -> None:
        why = why_no_cut(fleet, self._me) or _nft(cut_rules(fleet, strike.cut_s), is_check=True)
        if why or strike.is_plan:
            self._tell(request, why, "its links can be cut")
            return
        self._tell(request, "", f"its links are cut for {strike.cut_s:g} s")
        time.sleep(ANSWER_S)
        log.warning("links cut for %g s by %s, who rehearses", strike.cut_s, strike.asked.by)
        failure = _nft(cut_rules(fleet, strike.cut_s), is_check=False)
        if failure:
            log.error("links not cut: %s", failure)
            return
        time.sleep(strike.cut_s + 1.0)
        _nft(f"delete table inet {TABLE}\n", is_check=False)  # its set is empty by now

    def _tell(self, request: int, why: str, done: str) -> None:
        outcome = CommandOutcome.INVALID if why else CommandOutcome.OK
        self._answer(request, CommandResult(outcome=outcome, detail=why or done))


# --- who starts it again ---------------------------------------------------------------------------------------------


def why_no_restart(env: Mapping[str, str], pid: int, cgroup: Path = Path("/proc/self/cgroup")) -> str:
    """Why this daemon must not be killed: nobody would start it again; empty: somebody does."""
    if env.get(RESTARTED_BY):
        return ""
    unit = unit_of(cgroup)
    if not env.get("INVOCATION_ID") or not unit:
        return (
            "nothing would start this daemon again: it is no service of systemd (another supervisor that restarts it "
            f"says so by {RESTARTED_BY}=NAME in its environment)"
        )
    found = _systemctl(unit, is_user="/user@" in cgroup.read_text())
    if found is None:
        return f"`systemctl show {unit}` does not answer: nobody knows whether systemd would start this daemon again"
    if found.get("MainPID") != str(pid):
        return f"{unit} is not this daemon (its main process is {found.get('MainPID')}): nothing would start it again"
    if found.get("Restart", "") in _NOT_AGAIN:
        return f"{unit} has Restart={found.get('Restart') or 'no'}: systemd would not start this daemon again"
    return ""


def unit_of(cgroup: Path) -> str:
    """The service of systemd in whose control group this process is; empty: in none."""
    try:
        path = cgroup.read_text().strip().rpartition(":")[2]
    except OSError:
        return ""
    return next((part for part in reversed(path.split("/")) if part.endswith(".service")), "")


def _systemctl(unit: str, *, is_user: bool) -> dict[str, str] | None:
    command = ["systemctl", *(["--user"] if is_user else []), "show", "-p", "Restart", "-p", "MainPID", "--", unit]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=TOOL_S, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    if done.returncode:
        return None
    pairs = (line.partition("=") for line in done.stdout.splitlines())
    return {name: value for name, _, value in pairs}


# --- cutting links ---------------------------------------------------------------------------------------------------


def why_no_cut(fleet: Fleet, me: NodeId) -> str:
    """Why a cut would not be the cut of this node; empty: it would."""
    if not ports_of(fleet):
        return "the fleet file names no ports"
    here = [node.name for node in fleet.nodes if node.name != me and node.host and is_here(node.host)]
    return f"{', '.join(here)} on this machine, too: between them there is no network to cut" if here else ""


def ports_of(fleet: Fleet) -> tuple[int, ...]:
    """The ports at which the fleet's sessions listen."""
    ends = [end for node in fleet.nodes for end in (node.listen_control, node.listen_data)]
    return tuple(sorted({int(found[1]) for end in ends if (found := _PORT.search(end)) is not None}))


def cut_rules(fleet: Fleet, for_s: float) -> str:
    """The commands of nftables that cut the links of this machine; the set of ports empties itself after ``for_s``."""
    ports = ", ".join(f"{port} timeout {round(for_s * 1000)}ms" for port in ports_of(fleet))
    return (
        f"table inet {TABLE}\n"
        f"delete table inet {TABLE}\n"
        f"table inet {TABLE} {{\n"
        "  set ports { type inet_service; flags timeout; }\n"
        f"{_chain('input', 'iifname')}{_chain('output', 'oifname')}"
        "}\n"
        f"add element inet {TABLE} ports {{ {ports} }}\n"
    )


def _chain(hook: str, interface: str) -> str:
    """What drops everything that comes from, or goes to, one of the ports over a network."""
    of_ports = f'{interface} != "lo" meta l4proto {{ tcp, udp }} th'
    drops = f"{of_ports} sport @ports drop; {of_ports} dport @ports drop;"
    return f"  chain {hook} {{ type filter hook {hook} priority -10; {drops} }}\n"


def _nft(rules: str, *, is_check: bool) -> str:
    """Why nftables did not take these; empty: it did. With ``is_check`` nothing is changed."""
    command = ["nft", *(["-c"] if is_check else []), "-f", "-"]
    try:
        done = subprocess.run(command, input=rules, capture_output=True, text=True, timeout=TOOL_S, check=False)
    except FileNotFoundError:
        return "this machine has no `nft`: install nftables"
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"`nft` does not work: {error}"
    if not done.returncode:
        return ""
    first = (done.stderr.strip() or "no reason given").splitlines()[0]
    return f"this daemon may not use nftables ({first}): it needs the capability CAP_NET_ADMIN"
