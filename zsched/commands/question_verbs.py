"""The verbs that ask and change nothing: of the fleet now, of its past, and what to wait for.

Knows: options. Does not know: how anything is done (files of the verbs' names, imported by the verb that runs).
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from zsched.commands.common import CliError
from zsched.commands.options import (
    AgeOption,
    Answers,
    Asks,
    Local,
    NoColorOption,
    TaskArgument,
    new_group,
)
from zsched.exits import EXIT_USAGE


def status(
    asked: Answers,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="All six stages, not only a line per task.")] = False,
    watch: Annotated[bool, typer.Option("--watch", "-w", help="Again and again; with --json one line each.")] = False,
    interval: Annotated[float, typer.Option(min=0.1, max=3600.0, metavar="S", help="Seconds between two.")] = 1.0,
    site: Annotated[bool, typer.Option("--site", help="A line for each fleet of the site, with --json only.")] = False,
    no_color: NoColorOption = False,
) -> None:
    """Show nodes, tasks, owners and what is wrong; with -v also decisions, votes and streams.

    Exits with 4 while the fleet is degraded: no quorum, or a task without a live owner. With --site it asks the fleets
    under `site:` in the document, or in the fleet file, and one that does not answer is degraded, too.
    """
    if site:
        from zsched.commands.cells import show_site  # noqa: PLC0415 - each verb imports what it needs

        if verbose or watch:
            raise CliError(EXIT_USAGE, "--site shows a line for each fleet; leave out -v and --watch")
        raise typer.Exit(show_site(*_of_site(asked), is_json=asked.json_))
    from zsched.commands.status import StatusView, show, watch_on  # noqa: PLC0415 - each verb imports what it needs

    view = StatusView(door=asked.door(), is_json=asked.json_, is_plain=no_color, is_whole=verbose)
    raise typer.Exit(watch_on(view, interval) if watch else show(view))


def explain(
    asked: Answers,
    task: Annotated[str | None, typer.Argument(metavar="[TASK]", help="A task; not with --replay.")] = None,
    plan: Annotated[
        str | None, typer.Option("--plan", metavar="NODE=down", help="Reckon again without that node; 10: it moves.")
    ] = None,
    at: Annotated[
        str | None,
        typer.Option("--at", metavar="EPOCH|AGE|TIME", help="The judgement before that, from this machine's log."),
    ] = None,
    robot: Annotated[
        str | None, typer.Option("--robot", metavar="NAME", help="Only what this robot sees: its terms, whom it hears.")
    ] = None,
    replay: Annotated[
        Path | None,
        typer.Option("--replay", metavar="FILE", help="Judge all of a decision log again (also .gz); 1: one differs."),
    ] = None,
    no_color: NoColorOption = False,
) -> None:
    """Show a robot's last judgement of a task with all its figures, and what would have to change for a move.

    On an edge, which decides nothing, a robot is asked in its place. With --at 12 it shows the judgement that came
    before the move to epoch 12, and that move; with an age or a time, the one of that moment.
    """
    if (task is None) == (replay is None):
        raise CliError(EXIT_USAGE, "name a task, or a decision log with --replay FILE")
    if replay is not None:
        from zsched.commands.replay import replay as make_again  # noqa: PLC0415 - each verb imports what it needs

        raise typer.Exit(make_again(replay, is_json=asked.json_))
    assert task is not None
    from zsched.commands.common import wants_color  # noqa: PLC0415 - as above
    from zsched.commands.explain import ExplainView  # noqa: PLC0415 - as above
    from zsched.commands.explain import explain as ask_why  # noqa: PLC0415 - as above

    view = ExplainView(plan=plan, at=at, robot=robot, is_json=asked.json_, is_colored=wants_color(no_color))
    raise typer.Exit(ask_why(asked.door(), task, view))


def history(
    asked: Answers,
    task: Annotated[str | None, typer.Argument(metavar="[TASK]", help="Only what was done to it.")] = None,
    about: Annotated[
        str | None,
        typer.Option(
            "--for", metavar="node/NAME", help="Only moves to this node or away from it, and orders that name it."
        ),
    ] = None,
    since: AgeOption = None,
    site: Annotated[bool, typer.Option("--site", help="Of every fleet of the site, merged by age.")] = False,
) -> None:
    """Show every change of owner in a node's decision log: when, from where to where, why, and who voted for it.

    It also tells what operators have changed, with their names.

    With --site one node of each fleet of the site is asked. A fleet that does not answer is named, and the others are
    shown; exits with 3 when none answers.
    """
    from zsched.commands.history import Past, duration_s, subject_of  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.history import history as show_moves  # noqa: PLC0415 - as above

    of_task, of_node = (None, None) if about is None else subject_of(about)
    since_s = None if since is None else duration_s(since)
    if task is not None and of_task not in (None, task):
        raise CliError(EXIT_USAGE, f"{task} and --for {about} are two tasks; name one")
    if site:
        from zsched.commands.cells import show_histories  # noqa: PLC0415 - as above

        past = Past(task=task or of_task, about=of_node, since_s=since_s)
        raise typer.Exit(show_histories(*_of_site(asked), past, is_json=asked.json_))
    raise typer.Exit(show_moves(asked.door(), task or of_task, about=of_node, since_s=since_s, is_json=asked.json_))


def _of_site(asked: Asks) -> tuple[Path | None, str | None]:
    """(folder of sockets, node) of the daemon here, which knows the cells. Raises `CliError`: another one is meant."""
    if asked.connect is not None or "/" in (asked.node or ""):
        raise CliError(EXIT_USAGE, "--site asks every cell; leave out --connect and CELL/NODE")
    return asked.runtime_dir, asked.node


def events(
    asked: Local,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Go on until Ctrl-C.")] = False,
    since: AgeOption = None,
    about: Annotated[
        str | None, typer.Option("--for", metavar="task/NAME", help="Or node/NAME: only what is about it.")
    ] = None,
    types: Annotated[
        str | None, typer.Option("--types", metavar="A,B", help="Only moves, or stages: move, vote, executor, ...")
    ] = None,
    json_: Annotated[bool, typer.Option("--json", help="One JSON object per line.")] = False,
) -> None:
    """Show what the decision log tells: judgements that changed, votes, moves, steps of handovers, workers, peers."""
    from zsched.commands.history import EventsView, duration_s, subject_of, types_of  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.history import events as show_events  # noqa: PLC0415 - as above

    of_task, of_node = (None, None) if about is None else subject_of(about)
    view = EventsView(
        task=of_task,
        node=of_node,
        since_s=None if since is None else duration_s(since),
        types=() if types is None else types_of(types),
        is_following=follow,
        is_json=json_,
    )
    raise typer.Exit(show_events(asked.door(), view))


def wait(
    asked: Answers,
    condition: Annotated[
        str,
        typer.Option("--for", metavar="CONDITION", help="healthy, quorum, owner=TASK@NODE, settled=TASK, empty=NODE."),
    ],
    timeout: Annotated[
        float, typer.Option("--timeout", min=0.0, max=86400.0, metavar="S", help="Seconds; 0: look once.")
    ] = 30.0,
) -> None:
    """Wait until a condition holds; say what is missing if it does not in time.

    Exits with 5 when the time is over, with 3 when nobody answers then. A daemon that is not there yet is waited for.
    """
    from zsched.commands.wait import WaitView, wait_for  # noqa: PLC0415 - each verb imports what it needs

    raise typer.Exit(wait_for(WaitView(find=asked.door, timeout_s=timeout, is_json=asked.json_), condition))


def metrics_print(asked: Asks) -> None:
    """Print a node's figures in Prometheus' text format."""
    from zsched.commands.metrics import print_metrics  # noqa: PLC0415 - each verb imports what it needs

    raise typer.Exit(print_metrics(asked.door))


def metrics_write(
    asked: Asks,
    path: Annotated[Path, typer.Argument(metavar="PATH", help="As /var/lib/node_exporter/zsched.prom.")],
) -> None:
    """Write them to a file, whole or not at all, for node_exporter's textfile collector.

    Where nobody answers the file says zsched_up 0, and this exits with 3.
    """
    from zsched.commands.metrics import write_metrics  # noqa: PLC0415 - each verb imports what it needs

    raise typer.Exit(write_metrics(path, asked.door))


def logs(
    asked: Answers,
    task: TaskArgument,
    whose: Annotated[str | None, typer.Argument(metavar="[NODE]", help="Whose worker; without it the owner's.")] = None,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Also what it prints from now on.")] = False,
    lines: Annotated[int, typer.Option("--lines", min=0, max=400, metavar="N", help="The newest N.")] = 100,
    level: Annotated[
        str | None, typer.Option("--level", metavar="LEVEL", help="At least: debug, info, warning, error, critical.")
    ] = None,
) -> None:
    """Show what a task's worker has printed lately, on whichever node it runs.

    A daemon keeps the last 400 lines of each of its workers since its own start; that machine's journal has older ones.
    """
    from zsched.commands.logs import LogsView, show_logs  # noqa: PLC0415 - each verb imports what it needs

    view = LogsView(door=asked.door(), is_json=asked.json_, is_followed=follow, most=lines, level=level)
    raise typer.Exit(show_logs(view, task, whose))


METRICS = new_group("metrics", "Figures for Prometheus.", {"print": metrics_print, "write": metrics_write})
