"""The verbs that look for what is wrong: `doctor`, `ping`, `bugreport`: arguments in, exit code out.

Knows: options. Does not know: how anything is done (files of the verbs' names, imported by the verb that runs).
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from zsched.commands.options import JsonOption, Machine, NameOption, NoColorOption, RuntimeOption


def doctor(
    here: Machine,
    fleet: Annotated[bool, typer.Option("--fleet", help="Ask every node, and compare what they say.")] = False,
    strict: Annotated[bool, typer.Option("--strict", help="Exit with 1 on a warning, too.")] = False,
    json_: JsonOption = False,
    no_color: NoColorOption = False,
) -> None:
    """Look for what is wrong with this machine, its daemon, or the whole fleet, and say what to do.

    Each check says PASS, WARN, FAIL or SKIP, and what it saw. It changes nothing. Exits with 1 on a FAIL.
    """
    from zsched.commands.doctor import diagnose  # noqa: PLC0415 - each verb imports what it needs

    raise typer.Exit(diagnose(here.machine(), is_fleet=fleet, is_strict=strict, is_json=json_, is_plain=no_color))


def ping(
    whom: Annotated[str, typer.Argument(metavar="NODE", help="A node of the fleet file.")],
    count: Annotated[int, typer.Option("--count", "-c", min=1, max=10_000, metavar="N", help="Questions.")] = 4,
    timeout: Annotated[float, typer.Option(min=0.1, max=60.0, metavar="S", help="Seconds for an answer.")] = 1.0,
    interval: Annotated[float, typer.Option(min=0.0, max=60.0, metavar="S", help="Seconds between two.")] = 0.2,
    json_: JsonOption = False,
    config: Annotated[
        Path | None, typer.Option("--config", metavar="FILE", help="Fleet file. [ZSCHED_CONFIG, else as for up]")
    ] = None,
    node: NameOption = None,
    runtime_dir: RuntimeOption = None,
) -> None:
    """Measure how long a node's control and data sessions take to answer, and by which address.

    Exits with 3 when the node answers by no way, with 1 when by some only.
    """
    from zsched.commands.here import own_name  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.ping import Question, ping_node  # noqa: PLC0415 - as above

    own_name(node)
    question = Question(node=whom, count=count, timeout_s=timeout, interval_s=interval)
    raise typer.Exit(ping_node(question, node, config, runtime_dir, is_json=json_))


def bugreport(
    here: Machine,
    file: Annotated[
        Path | None, typer.Argument(metavar="[FILE]", help="A new file. [zsched-bugreport-NODE-TIME.tar.gz]")
    ] = None,
    json_: JsonOption = False,
) -> None:
    """Write one file for the person who looks for a fault: every node's status, the doctor's words, the journal.

    Secrets that a name gives away are taken out. It prints what is in the file.
    """
    from zsched.commands.bugreport import report  # noqa: PLC0415 - each verb imports what it needs

    raise typer.Exit(report(here.machine(), file, is_json=json_))
