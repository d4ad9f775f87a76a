"""Options that several verbs take: each is declared once.

Knows: their names, words and the environment that stands in for them. Does not know: any verb.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

ConfigOption = Annotated[
    Path | None,
    typer.Option("--config", "-c", metavar="FILE", help="Fleet file. [ZSCHED_CONFIG, else /etc/zsched/fleet.yaml]"),
]
NameOption = Annotated[
    str | None,
    typer.Option("--node", "-n", metavar="NAME", help="This machine's name in it. [ZSCHED_NODE, else the host name]"),
]
StateOption = Annotated[
    Path | None,
    typer.Option(
        "--state-dir", metavar="DIR", help="Durable state. [ZSCHED_STATE_DIR, else /var/lib/zsched; yours if not root]"
    ),
]
RuntimeOption = Annotated[
    Path | None,
    typer.Option("--runtime-dir", metavar="DIR", help="Operator sockets. [ZSCHED_RUNTIME_DIR, else /run/zsched]"),
]
AskedOption = Annotated[
    str | None,
    typer.Option("--node", "-n", metavar="NAME", help="Ask this node of the fleet, or CELL/NODE of another one."),
]
HereOption = Annotated[
    str | None, typer.Option("--node", "-n", metavar="NAME", help="Which daemon on this machine, if there are several.")
]
ConnectOption = Annotated[
    str | None,
    typer.Option("--connect", metavar="ENDPOINT", help="No daemon here: ask at this node's control endpoint."),
]
JsonOption = Annotated[bool, typer.Option("--json", help="JSON, with its schema; --json=1: of that version.")]
PlanOption = Annotated[
    bool, typer.Option("--plan", "--dry-run", help="Only show what would change; exits with 10 if anything.")
]
YesOption = Annotated[bool, typer.Option("--yes", "-y", help="Do not ask; off a terminal it takes this.")]
