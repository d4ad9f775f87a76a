"""`zsched` with another decision rule in the robots, for comparison: ``--rule NAME [--plan FILE] init|up ...``.

Knows: where the product makes its judges. Does not know: what the rules do.

Everything else is the product's own daemon: this program puts `zsched_lab.paper.rules.JudgeMaker` in the place of
`zsched.core.scheduler.rounds.Judge` and then becomes `zsched.daemon`. It must never be used outside the lab.
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from zsched import daemon
from zsched.core.scheduler import rounds
from zsched.host.guard import end_with
from zsched_lab.paper.rules import JudgeMaker, RuleName


def install(rule: RuleName, plan: Path | None) -> JudgeMaker:
    """Let every round that is made from now on judge by ``rule``."""
    maker = JudgeMaker(name=rule, plan_path=plan)
    setattr(rounds, "Judge", maker)  # noqa: B010 - the one seam of this program; an assignment mypy would refuse
    return maker


def main(arguments: list[str] | None = None) -> int:
    """Entry point: the exit code of the verb."""
    parser = argparse.ArgumentParser(prog="python -m zsched_lab.paper.ruled_daemon")
    parser.add_argument("--rule", type=RuleName, choices=list(RuleName), required=True)
    parser.add_argument("--plan", type=Path)
    parser.add_argument("verb", choices=("init", "up"))
    given, rest = parser.parse_known_args(arguments)
    if given.verb == "init":
        os.execv(sys.executable, [sys.executable, "-m", "zsched.cli", "init", *rest])  # noqa: S606 - no shell is wanted
    install(given.rule, given.plan)
    return daemon.main(rest)


if __name__ == "__main__":
    end_with(main)
