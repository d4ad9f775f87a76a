"""What tokens cost a session whose rules deny them: CPU of who listens, by how many it has been shown before.

``python -m benchmarks.denied_tokens [--steps 2000 2000 2000 4000 5000 5000] [--taken]``. Two processes on loopback, set
up as control sessions over TLS with access rules; the one shows tokens that are not its own. ``--taken``: without
rules, so that each one is told. CPU is measured until 2 s after the last token of a step. Bytes are those that the
other end has acknowledged.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import psutil

from benchmarks.common import machine
from benchmarks.silent import certificates, with_tls
from zsched.link.sessions.config import control_config
from zsched_lab.fleet.loopback import free_endpoint

OWN = "robot1.yard.zsched.internal"
LISTENER = """
import sys, zenoh
session = zenoh.open(zenoh.Config.from_json5(sys.argv[1]))
seen = [0]
def take(_): seen[0] += 1
kept = session.liveliness().declare_subscriber("@zsched/yard/alive/**", take)
print(flush=True)
for _ in sys.stdin:
    print(seen[0], flush=True)
"""
SHOWER = """
import sys, time, zenoh
from zsched.link.sessions.link_sockets import LinkSockets
session = zenoh.open(zenoh.Config.from_json5(sys.argv[1]))
time.sleep(0.5)
(link,) = LinkSockets(session).links()
held = []
print(flush=True)
for line in sys.stdin:
    before = link.taken()
    for _ in range(int(line)):
        held.append(session.liveliness().declare_token(f"@zsched/yard/alive/edge1/{len(held)}"))
    time.sleep(2.0)
    print(link.taken() - before, flush=True)
"""


def with_rules(config: str) -> str:
    """The holder may show its own tokens, and everything else but those of others."""
    tree = json.loads(config)
    everything = ["put", "delete", "declare_subscriber", "query", "reply", "declare_queryable"]
    everything += ["liveliness_query", "declare_liveliness_subscriber"]
    shapes = {
        "all": (["ingress", "egress"], everything, ["@zsched/**", "**"]),
        "own": (["ingress"], ["liveliness_token"], ["@zsched/yard/alive/robot1/*"]),
    }
    tree["access_control"] = {
        "enabled": True,
        "default_permission": "deny",
        "rules": [
            {"id": name, "permission": "allow", "flows": flows, "messages": messages, "key_exprs": keys}
            for name, (flows, messages, keys) in shapes.items()
        ],
        "subjects": [{"id": "member", "cert_common_names": [OWN]}],
        "policies": [{"subjects": ["member"], "rules": list(shapes)}],
    }
    return json.dumps(tree)


def ask(process: subprocess.Popen[str], word: str) -> str:
    """What it answers."""
    assert process.stdin is not None
    assert process.stdout is not None
    if word:
        process.stdin.write(word + "\n")
        process.stdin.flush()
    return process.stdout.readline().strip()


def main() -> None:
    """Print one line for each step."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, nargs="+", default=[2000, 2000, 2000, 4000, 5000, 5000])
    parser.add_argument("--taken", action="store_true")
    given = parser.parse_args()
    print(machine())
    with tempfile.TemporaryDirectory() as folder:
        tls = certificates(Path(folder))
        end = free_endpoint().partition("#")[0].replace("tcp/", "tls/")
        listens = with_tls(control_config(listen=(end,), connect=()), tls)
        listens = listens if given.taken else with_rules(listens)
        programs = ((LISTENER, listens), (SHOWER, with_tls(control_config(listen=(), connect=(end,)), tls)))
        pipe, processes = subprocess.PIPE, []
        try:
            for program, config in programs:
                command = [sys.executable, "-c", program, config]
                processes.append(subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True))
                ask(processes[-1], "")
            listener, shower = processes
            times, shown = psutil.Process(listener.pid).cpu_times, 0
            for count in given.steps:
                before = times()
                size = int(ask(shower, str(count)))
                after = times()
                shown += count
                cpu = after.user + after.system - before.user - before.system
                told = f"{1e6 * cpu / count:.0f} us each, {size / count:.0f} bytes each, told {ask(listener, 'x')}"
                print(f"{count} tokens, {shown} in all: {cpu:.2f} s of CPU, {told}", flush=True)
        finally:
            for process in processes:
                process.kill()


if __name__ == "__main__":
    main()
