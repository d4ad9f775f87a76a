"""The command line `zsched`: arguments in, exit code out.

Knows: verbs, options, exit codes. Does not know: how anything is done. What a verb needs is imported inside it:
`status` must answer within 200 ms, and a robot has no numpy.

Exit codes: 0 fine, 1 failed, 2 usage, 3 daemon not reachable, 4 reachable but degraded (no quorum, a task without a
live owner), 5 timed out, 10 by a plan something would change, 75 the name is another machine's, 78 bad configuration.
"""

from __future__ import annotations

import atexit
import contextlib
import errno
import io
import os
import shlex
import signal
import sys
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from zsched.commands.common import CliError, Json, Verb, Verbs, print_json, say, warn
from zsched.commands.example import Example, write_example
from zsched.commands.flag_verbs import add_flag_verbs
from zsched.commands.fleet_verbs import (
    AcceptOption,
    PauseAfterOption,
    PlanOption,
    ReasonOption,
    RevisionOption,
    YesOption,
    fleet_app,
    node_app,
    task_app,
)
from zsched.commands.member_verbs import add_member_verbs
from zsched.commands.options import (
    AskedOption,
    ConfigOption,
    ConnectOption,
    HereOption,
    JsonOption,
    NameOption,
    RuntimeOption,
    StateOption,
)
from zsched.commands.order_verbs import add_order_verbs
from zsched.commands.pki_verbs import pki_app
from zsched.commands.program import Program
from zsched.commands.rehearse_verb import add_rehearse_verb
from zsched.commands.stream_verbs import stream_app
from zsched.errors import ConfigError
from zsched.exits import EXIT_CONFIG, EXIT_FAILED, EXIT_USAGE

if TYPE_CHECKING:
    from zsched.commands.recover import Place  # imports zenoh
    from zsched.runtime.init import Heard  # likewise

EPILOG = (
    "Exit codes: 0 fine, 1 failed, 2 usage, 3 daemon not reachable, 4 reachable but degraded, 5 timed out, "
    "10 something would change (--plan), 75 the name is taken by another machine (up), 78 bad fleet file."
)

app = typer.Typer(
    name="zsched",
    cls=Program,
    help="Masterless scheduling of shared robot tasks: profile, score, vote, commit, reroute.",
    epilog=EPILOG,
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,  # rich costs 60 ms of import
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


app.add_typer(stream_app)
for group in (fleet_app, task_app, node_app):
    app.add_typer(group)
app.add_typer(pki_app)
metrics_app = typer.Typer(
    name="metrics", cls=Verbs, help="Figures for Prometheus.", no_args_is_help=True, rich_markup_mode=None
)
app.add_typer(metrics_app)


def _show_version(is_wanted: bool) -> None:
    if is_wanted:
        from zsched import __version__  # noqa: PLC0415 - each verb imports what it needs

        typer.echo(f"zsched {__version__}")
        raise typer.Exit


@app.callback()
def program(
    version_: Annotated[
        bool,
        typer.Option("--version", help="Show the version and exit.", is_eager=True, callback=_show_version),
    ] = False,
) -> None:
    """Masterless scheduling of shared robot tasks: profile, score, vote, commit, reroute."""


UNWRITABLE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO)
"""Why stdout takes no more: the disk behind ``>`` is full, or gone."""
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class LogLevel(StrEnum):
    """How much the daemon says on stderr."""

    DEBUG = "DEBUG"
    INFO = "INFO"
    WARNING = "WARNING"
    ERROR = "ERROR"


# --- the daemon ------------------------------------------------------------------------------------------------------


@app.command(cls=Verb)
def up(
    config: ConfigOption = None,
    node: NameOption = None,
    state_dir: StateOption = None,
    runtime_dir: RuntimeOption = None,
    log_level: Annotated[LogLevel, typer.Option("--log-level", help="What goes to stderr.")] = LogLevel.INFO,
) -> None:
    """Run this machine's daemon in the foreground (what systemd runs)."""
    from zsched import paths as places  # noqa: PLC0415 - each verb imports what it needs

    file = places.config_path(config, os.environ)
    _need_file(file)
    name = _node_name(node)
    state = places.state_folder(state_dir, os.environ)
    runtime = places.runtime_folder(runtime_dir, os.environ)
    daemon = [sys.executable, "-m", "zsched.daemon", "--config", str(file), "--node", name]
    daemon += ["--state-dir", str(state), "--runtime-dir", str(runtime), "--log-level", log_level.value]
    sys.stdout.flush()
    sys.stderr.flush()
    signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)  # the daemon takes what comes while it loads, see there
    # the same process id (systemd's main process), without this command line's memory
    os.execv(sys.executable, daemon)  # noqa: S606 - no shell is wanted


@app.command(cls=Verb)
def init(
    folder: Annotated[
        Path | None, typer.Argument(metavar="DIR", help="With --example: where; without it the current folder.")
    ] = None,
    example: Annotated[
        Example | None, typer.Option("--example", help="Write an example into DIR instead; nothing is overwritten.")
    ] = None,
    config: ConfigOption = None,
    node: NameOption = None,
    state_dir: StateOption = None,
    generation: Annotated[
        int,
        typer.Option("--generation", metavar="G", min=0, help="Above 0: start anew, on every node."),
    ] = 0,
    force: Annotated[
        bool, typer.Option("--force", help="With --generation: although nobody says that it is needed.")
    ] = False,
    settle: Annotated[
        bool, typer.Option("--settle", help="The other machine of this name is gone: be an elector again.")
    ] = False,
) -> None:
    """Create this node's blank state: "this name has never voted here".

    Refuses in another node's folder, and when a node that can be reached knows this name as an elector that has voted.
    If too many states are lost to agree, stop every daemon, and run it on every node with the --generation that
    `zsched status` names. That is refused while the fleet agrees, and where a good state would be lost.

    With --example it writes no state but a small task: a fleet file, a worker, an application (see `zsched dev`).
    """
    if example is not None:
        if config or node or state_dir or generation or force or settle:
            raise CliError(EXIT_USAGE, "--example goes with a folder only")
        _write_example(example, folder or Path())
        return
    if folder is not None:
        raise CliError(EXIT_USAGE, f"{folder}: a folder goes with --example; name the state folder with --state-dir")
    from zsched import paths as places  # noqa: PLC0415 - each verb imports what it needs
    from zsched.adapters.machine import core_speed  # noqa: PLC0415 - likewise
    from zsched.config.load import load_fleet, require_node  # noqa: PLC0415 - ruamel.yaml is slow to import
    from zsched.core.vote.belief import MAX_GENERATION  # noqa: PLC0415 - likewise
    from zsched.runtime.init import begin_anew, check_blank, init_state, settle_dispute, standing_state  # noqa: PLC0415 - imports zenoh

    if generation > MAX_GENERATION:
        raise CliError(EXIT_USAGE, f"--generation {generation}: at most {MAX_GENERATION}")
    file = places.config_path(config, os.environ)
    fleet = load_fleet(file)
    name = _node_name(node)
    try:
        require_node(fleet, name, file)
    except ConfigError as error:
        if node is None:
            raise
        raise CliError(EXIT_USAGE, str(error)) from error  # a wrong word, and no wrong file
    state = places.state_folder(state_dir, os.environ)
    if settle:
        done = settle_dispute(fleet, name, state)
        say(f"{name}: {'settled; restart its daemon' if done else 'there was no dispute'}")
        return
    if force and not generation:
        raise CliError(EXIT_USAGE, "--force goes with --generation G")
    standing = standing_state(fleet, name, state)
    if standing is not None and generation in (0, standing.generation):
        text = f"{name} has its state in fleet {fleet.name}, generation {standing.generation}: nothing to do"
        say(f"{state}: {text}")
        return
    heard = check_blank(fleet, name, state, generation, standing, is_forced=force)
    side = heard.side
    path = init_state(fleet, name, state, generation) if side is None else begin_anew(fleet, name, state, side)
    warn(_heard(heard, name, generation, is_elector=name in fleet.electors))
    say(f"a core of this machine has speed {core_speed.kept_or_new(state):.2f}")
    if side is not None:
        text = "the others know it as an elector with another disk: it is a new member, and no elector until"
        say(f"{path}: blank state of {name} in fleet {fleet.name}; {text} it is added as one")
        return
    say(f"{path}: blank state of {name} in fleet {fleet.name}, generation {generation}")


@app.command(cls=Verb)
def recover(
    config: ConfigOption = None,
    node: NameOption = None,
    state_dir: StateOption = None,
    brought: Annotated[
        list[Path] | None,
        typer.Option("--from", metavar="STATE_FILE", help="State of a dead machine's disk; give it once for each."),
    ] = None,
    plan: PlanOption = False,
    yes: YesOption = False,
    accept: AcceptOption = None,
) -> None:
    """Begin a new generation on one survivor when a majority of the electors is lost for good.

    Tasks keep their newest values of all states that are given, under higher epochs. Its daemon must be stopped. It is
    refused while a majority of the electors can agree. Every other node changes sides by `zsched rejoin` there.
    """
    from zsched.commands.recover import Manner  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.recover import recover as run  # noqa: PLC0415 - as above

    words = ["recover", *_place_words(config, node, state_dir)]
    words += [part for path in brought or () for part in ("--from", str(path))]
    manner = Manner(words=tuple(words), is_plan=plan, is_sure=yes, accepted=tuple(accept or ()))
    raise typer.Exit(run(_place(config, node, state_dir), manner, tuple(brought or ())))


@app.command(cls=Verb)
def rejoin(
    generation: Annotated[
        str, typer.Argument(metavar="GENERATION", help="The beginning of its id; needed where there are several.")
    ] = "",
    config: ConfigOption = None,
    node: NameOption = None,
    state_dir: StateOption = None,
    plan: PlanOption = False,
    yes: YesOption = False,
) -> None:
    """Let this node change sides to another generation of its fleet, as after `zsched recover` elsewhere.

    It starts blank there: what it has promised and learnt in its own generation is dropped. Its daemon must be stopped.
    """
    from zsched.commands.recover import Manner  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.recover import rejoin as run  # noqa: PLC0415 - as above

    words = ("rejoin", *([generation] if generation else []), *_place_words(config, node, state_dir))
    manner = Manner(words=words, is_plan=plan, is_sure=yes)
    raise typer.Exit(run(_place(config, node, state_dir), manner, generation))


def _place_words(config: Path | None, node: str | None, state_dir: Path | None) -> list[str]:
    """The options that name a node and its files, as they were given."""
    given = (("--config", config), ("--node", node), ("--state-dir", state_dir))
    return [part for name, value in given if value is not None for part in (name, str(value))]


def _place(config: Path | None, node: str | None, state_dir: Path | None) -> Place:
    from zsched import paths as places  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.recover import Place  # noqa: PLC0415 - likewise
    from zsched.config.load import load_fleet, require_node  # noqa: PLC0415 - ruamel.yaml is slow to import

    file = places.config_path(config, os.environ)
    fleet = load_fleet(file)
    name = _node_name(node)
    require_node(fleet, name, file)
    return Place(fleet=fleet, node=name, config=file, folder=places.state_folder(state_dir, os.environ))


def _write_example(example: Example, folder: Path) -> None:
    for path in write_example(example, folder):
        say(str(path))
    words = shlex.join(("zsched", "dev", *(() if folder == Path() else (str(folder),))))
    warn(f"next: `{words}`; it prints the line that starts the application in another terminal")


def _heard(heard: Heard, name: str, generation: int, *, is_elector: bool) -> str:
    """Which nodes were asked before a blank state was written, and what their answers say."""
    if not heard.asked:
        return "no other node has an address in the fleet file: nobody was asked"
    asked = f"asked {_count(heard.asked, 'other nodes')}"
    if not heard.answers:
        return f"{asked}: none answered" + (f", so nobody could say whether {name} has voted" if is_elector else "")
    said = f"{asked}, {len(heard.answers)} answered"
    where = f" in generation {generation}" if generation else ""
    return f"{said}: none remembers a vote of {name}{where}" if is_elector else said


@app.command(cls=Verb)
def dev(
    file: Annotated[
        Path | None, typer.Argument(metavar="FILE", help="Fleet file, or its folder; else ./fleet.yaml.")
    ] = None,
    task: Annotated[
        list[str] | None,
        typer.Option("--task", metavar="[TASK=]FILE", help="This worker in place of the fleet file's."),
    ] = None,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="All that the daemons log.")] = False,
) -> None:
    """Run every node of a fleet file on this machine, to try a task of your own; nothing of it stays.

    It prints where applications join, and starts a worker again when its file is saved. On a terminal keys move the
    task, kill its owner and load it.
    """
    from zsched.commands.dev import DevOptions  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.dev import dev as run  # noqa: PLC0415 - as above

    raise typer.Exit(run(DevOptions(file=file, workers=task or (), is_verbose=verbose)))


# --- questions -------------------------------------------------------------------------------------------------------


@app.command(cls=Verb)
def status(
    json_: JsonOption = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="All six stages, not only a line per task.")] = False,
    watch: Annotated[bool, typer.Option("--watch", "-w", help="Again and again; with --json one line each.")] = False,
    interval: Annotated[float, typer.Option(min=0.1, max=3600.0, metavar="S", help="Seconds between two.")] = 1.0,
    node: AskedOption = None,
    runtime_dir: RuntimeOption = None,
    connect: ConnectOption = None,
    no_color: Annotated[bool, typer.Option("--no-color", help="Plain text (also: NO_COLOR).")] = False,
) -> None:
    """Show nodes, tasks, owners and what is wrong; with -v also decisions, votes and streams.

    Exits with 4 while the fleet is degraded: no quorum, or a task without a live owner.
    """
    from zsched.commands.status import StatusView, show, watch_on  # noqa: PLC0415 - each verb imports what it needs

    view = StatusView(
        runtime_dir=runtime_dir, node=node, is_json=json_, is_plain=no_color, is_whole=verbose, connect=connect
    )
    raise typer.Exit(watch_on(view, interval) if watch else show(view))


@app.command(cls=Verb)
def site(json_: JsonOption = False, node: AskedOption = None, runtime_dir: RuntimeOption = None) -> None:
    """Ask every fleet of the site how it is: nodes alive, tasks and their owners.

    The fleets are those under `site:` in the document, or in the fleet file. `--node CELL/NODE` of the other verbs
    asks a node of one of them. Exits with 4 when a cell does not answer or is degraded, with 3 when none answers.
    """
    from zsched.commands.cells import show_site  # noqa: PLC0415 - each verb imports what it needs

    raise typer.Exit(show_site(runtime_dir, node, is_json=json_))


@app.command(cls=Verb)
def top(
    once: Annotated[bool, typer.Option("--once", help="Print one screen and exit, as status does.")] = False,
    interval: Annotated[float, typer.Option(min=0.2, max=3600.0, metavar="S", help="Seconds between two.")] = 1.0,
    node: AskedOption = None,
    runtime_dir: RuntimeOption = None,
    connect: ConnectOption = None,
    no_color: Annotated[bool, typer.Option("--no-color", help="Plain text (also: NO_COLOR).")] = False,
) -> None:
    """Show the fleet on the full screen: nodes, utilities over time, streams, the last moves; q ends."""
    from zsched.commands.watch.screen import TopView  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.watch.screen import top as show  # noqa: PLC0415 - as above

    view = TopView(runtime_dir=runtime_dir, node=node, connect=connect, is_plain=no_color, interval_s=interval)
    raise typer.Exit(show(view, is_once=once))


@app.command(cls=Verb)
def web(
    listen: Annotated[
        str, typer.Option("--listen", metavar="ADDRESS:PORT", help="Where; beyond this machine only with a token.")
    ] = "127.0.0.1:7459",
    token_file: Annotated[
        Path | None,
        typer.Option("--token-file", metavar="FILE", help="Readers must know its only word. [ZSCHED_WEB_TOKEN]"),
    ] = None,
    host: Annotated[
        list[str] | None,
        typer.Option("--host", metavar="NAME", help="Browsers may call this server so, besides its addresses."),
    ] = None,
    node: AskedOption = None,
    runtime_dir: RuntimeOption = None,
    connect: ConnectOption = None,
) -> None:
    """Serve a page that shows the fleet live, and Prometheus' figures under /metrics; it changes nothing.

    It asks one daemon once a second, however many look; a daemon that is not there is waited for.
    """
    from zsched.commands.watch.web import WebView  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.watch.web import web as serve  # noqa: PLC0415 - as above

    view = WebView(
        runtime_dir=runtime_dir,
        node=node,
        connect=connect,
        listen=listen,
        token_file=token_file,
        hosts=tuple(host or ()),
    )
    raise typer.Exit(serve(view))


@app.command(cls=Verb)
def record(
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="A new file, as run.mcap.")],
    for_: Annotated[
        str | None, typer.Option("--for", metavar="DURATION", help="How long: 90s, 10m, 2h. [until Ctrl-C]")
    ] = None,
    interval: Annotated[float, typer.Option(min=0.1, max=3600.0, metavar="S", help="Seconds between two.")] = 1.0,
    map_: Annotated[
        list[str] | None,
        typer.Option(
            "--map", metavar="KEY", help="A key whose samples are maps (OccupancyGrid, CDR) is recorded, too."
        ),
    ] = None,
    tf: Annotated[
        list[str] | None,
        typer.Option("--tf", metavar="KEY", help="The same of a key whose samples are frames (TFMessage, CDR)."),
    ] = None,
    node: AskedOption = None,
    runtime_dir: RuntimeOption = None,
    connect: ConnectOption = None,
) -> None:
    """Record what the fleet does as MCAP, for Foxglove: owners, utilities, moves, streams, events, maps, tf.

    Needs the extra mcap. Maps and frames on ROS topics are found by their type.
    """
    from zsched.commands.history import duration_s  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.watch.record import RecordView  # noqa: PLC0415 - as above
    from zsched.commands.watch.record import record as write  # noqa: PLC0415 - as above

    view = RecordView(
        runtime_dir=runtime_dir,
        node=node,
        connect=connect,
        file=output,
        interval_s=interval,
        for_s=None if for_ is None else duration_s(for_),
        maps=tuple(map_ or ()),
        frames=tuple(tf or ()),
    )
    raise typer.Exit(write(view))


@app.command(cls=Verb)
def trace(
    otlp: Annotated[
        str, typer.Option("--otlp", metavar="URL", help="An OpenTelemetry collector (OTLP over HTTP).")
    ] = "http://127.0.0.1:4318",
    since: Annotated[
        str | None, typer.Option("--since", metavar="AGE", help="Also moves not older: 90s, 10m, 2h, 1d.")
    ] = None,
    once: Annotated[bool, typer.Option("--once", help="Only what the decision log holds, then end.")] = False,
    node: HereOption = None,
    runtime_dir: RuntimeOption = None,
) -> None:
    """Send a trace span for each move in this machine's decision log to an OpenTelemetry collector.

    Needs the extra trace. Exits with 1 when the collector refused one.
    """
    from zsched.commands.history import duration_s  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.watch.trace import TraceView  # noqa: PLC0415 - as above
    from zsched.commands.watch.trace import trace as send  # noqa: PLC0415 - as above

    view = TraceView(
        runtime_dir=runtime_dir,
        node=node,
        url=otlp,
        since_s=None if since is None else duration_s(since),
        is_once=once,
    )
    raise typer.Exit(send(view))


@app.command(cls=Verb)
def explain(
    task: Annotated[str, typer.Argument(metavar="TASK", help="A task of the fleet file.")],
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
    json_: JsonOption = False,
    node: AskedOption = None,
    runtime_dir: RuntimeOption = None,
    connect: ConnectOption = None,
    no_color: Annotated[bool, typer.Option("--no-color", help="Plain text (also: NO_COLOR).")] = False,
) -> None:
    """Show a robot's last judgement of a task with all its figures, and what would have to change for a move.

    On an edge, which decides nothing, a robot is asked in its place. With --at 12 it shows the judgement that came
    before the move to epoch 12, and that move; with an age or a time, the one of that moment.
    """
    from zsched.commands.ask import find_door  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.common import wants_color  # noqa: PLC0415 - as above
    from zsched.commands.explain import ExplainView  # noqa: PLC0415 - as above
    from zsched.commands.explain import explain as ask_why  # noqa: PLC0415 - as above

    view = ExplainView(plan=plan, at=at, robot=robot, is_json=json_, is_colored=wants_color(no_color))
    raise typer.Exit(ask_why(find_door(runtime_dir, node, connect=connect), task, view))


@app.command(cls=Verb)
def history(
    task: Annotated[str | None, typer.Argument(metavar="[TASK]", help="Only its moves.")] = None,
    about: Annotated[
        str | None, typer.Option("--for", metavar="node/NAME", help="Only moves to this node or away from it.")
    ] = None,
    since: Annotated[str | None, typer.Option("--since", metavar="AGE", help="Not older: 90s, 10m, 2h, 1d.")] = None,
    json_: JsonOption = False,
    node: HereOption = None,
    runtime_dir: RuntimeOption = None,
) -> None:
    """Show every change of owner in the decision log: when, from where to where, why, and who voted for it."""
    from zsched.commands.ask import find_door  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.history import duration_s, subject_of  # noqa: PLC0415 - as above
    from zsched.commands.history import history as show_moves  # noqa: PLC0415 - as above

    of_task, of_node = (None, None) if about is None else subject_of(about)
    since_s = None if since is None else duration_s(since)
    if task is not None and of_task not in (None, task):
        raise CliError(EXIT_USAGE, f"{task} and --for {about} are two tasks; name one")
    door = find_door(runtime_dir, node)
    raise typer.Exit(show_moves(door, task or of_task, about=of_node, since_s=since_s, is_json=json_))


@app.command(cls=Verb)
def events(
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Go on until Ctrl-C.")] = False,
    since: Annotated[str | None, typer.Option("--since", metavar="AGE", help="Not older: 90s, 10m, 2h, 1d.")] = None,
    about: Annotated[
        str | None, typer.Option("--for", metavar="task/NAME", help="Or node/NAME: only what is about it.")
    ] = None,
    types: Annotated[
        str | None, typer.Option("--types", metavar="A,B", help="Only moves, or stages: move, vote, executor, ...")
    ] = None,
    json_: Annotated[bool, typer.Option("--json", help="One JSON object per line.")] = False,
    node: HereOption = None,
    runtime_dir: RuntimeOption = None,
) -> None:
    """Show what the decision log tells: judgements that changed, votes, moves, steps of handovers, workers, peers."""
    from zsched.commands.ask import find_door  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.history import EventsView, duration_s, subject_of, types_of  # noqa: PLC0415 - as above
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
    raise typer.Exit(show_events(find_door(runtime_dir, node), view))


@app.command(cls=Verb)
def replay(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A decision log; may be packed (.gz).")],
    json_: JsonOption = False,
) -> None:
    """Make every judgement of a decision log again from its figures; exits with 1 at the first that differs."""
    from zsched.commands.replay import replay as make_again  # noqa: PLC0415 - each verb imports what it needs

    raise typer.Exit(make_again(file, is_json=json_))


add_order_verbs(app)
add_flag_verbs(app)
add_member_verbs(app)
add_rehearse_verb(app)


@app.command(cls=Verb)
def doctor(
    fleet: Annotated[bool, typer.Option("--fleet", help="Ask every node, and compare what they say.")] = False,
    strict: Annotated[bool, typer.Option("--strict", help="Exit with 1 on a warning, too.")] = False,
    json_: JsonOption = False,
    config: ConfigOption = None,
    node: NameOption = None,
    state_dir: StateOption = None,
    runtime_dir: RuntimeOption = None,
    no_color: Annotated[bool, typer.Option("--no-color", help="Plain text (also: NO_COLOR).")] = False,
) -> None:
    """Look for what is wrong with this machine, its daemon, or the whole fleet, and say what to do.

    Each check says PASS, WARN, FAIL or SKIP, and what it saw. It changes nothing. Exits with 1 on a FAIL.
    """
    from zsched.commands.doctor import diagnose, machine_of  # noqa: PLC0415 - each verb imports what it needs

    _node_name(node)
    machine = machine_of(config, node, state_dir, runtime_dir)
    raise typer.Exit(diagnose(machine, is_fleet=fleet, is_strict=strict, is_json=json_, is_plain=no_color))


@app.command(cls=Verb)
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
    from zsched.commands.ping import Question, ping_node  # noqa: PLC0415 - each verb imports what it needs

    _node_name(node)
    question = Question(node=whom, count=count, timeout_s=timeout, interval_s=interval)
    raise typer.Exit(ping_node(question, node, config, runtime_dir, is_json=json_))


@app.command(cls=Verb)
def bugreport(
    file: Annotated[
        Path | None, typer.Argument(metavar="[FILE]", help="A new file. [zsched-bugreport-NODE-TIME.tar.gz]")
    ] = None,
    json_: JsonOption = False,
    config: ConfigOption = None,
    node: NameOption = None,
    state_dir: StateOption = None,
    runtime_dir: RuntimeOption = None,
) -> None:
    """Write one file for the person who looks for a fault: every node's status, the doctor's words, the journal.

    Secrets that a name gives away are taken out. It prints what is in the file.
    """
    from zsched.commands.bugreport import report  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.doctor import machine_of  # noqa: PLC0415 - as above

    _node_name(node)
    raise typer.Exit(report(machine_of(config, node, state_dir, runtime_dir), file, is_json=json_))


@app.command(cls=Verb)
def wait(
    condition: Annotated[
        str,
        typer.Option(
            "--for",
            metavar="CONDITION",
            help="healthy, quorum, owner=TASK@NODE, settled=TASK, empty=NODE.",
        ),
    ],
    timeout: Annotated[
        float, typer.Option("--timeout", min=0.0, max=86400.0, metavar="S", help="Seconds; 0: look once.")
    ] = 30.0,
    json_: JsonOption = False,
    node: AskedOption = None,
    runtime_dir: RuntimeOption = None,
    connect: ConnectOption = None,
) -> None:
    """Wait until a condition holds; say what is missing if it does not in time.

    Exits with 5 when the time is over, with 3 when nobody answers then. A daemon that is not there yet is waited for.
    """
    from zsched.commands.wait import WaitView, wait_for  # noqa: PLC0415 - each verb imports what it needs

    view = WaitView(runtime_dir=runtime_dir, node=node, connect=connect, timeout_s=timeout, is_json=json_)
    raise typer.Exit(wait_for(view, condition))


@metrics_app.command("print", cls=Verb)
def metrics_print(node: AskedOption = None, runtime_dir: RuntimeOption = None, connect: ConnectOption = None) -> None:
    """Print a node's figures in Prometheus' text format."""
    from zsched.commands.metrics import print_metrics  # noqa: PLC0415 - each verb imports what it needs

    raise typer.Exit(print_metrics(runtime_dir, node, connect))


@metrics_app.command("write", cls=Verb)
def metrics_write(
    path: Annotated[Path, typer.Argument(metavar="PATH", help="As /var/lib/node_exporter/zsched.prom.")],
    node: AskedOption = None,
    runtime_dir: RuntimeOption = None,
    connect: ConnectOption = None,
) -> None:
    """Write them to a file, whole or not at all, for node_exporter's textfile collector.

    Where nobody answers the file says zsched_up 0, and this exits with 3.
    """
    from zsched.commands.metrics import write_metrics  # noqa: PLC0415 - each verb imports what it needs

    raise typer.Exit(write_metrics(path, runtime_dir, node, connect))


@app.command(cls=Verb)
def logs(
    task: Annotated[str, typer.Argument(metavar="TASK", help="A task of the fleet file.")],
    whose: Annotated[str | None, typer.Argument(metavar="[NODE]", help="Whose worker; without it the owner's.")] = None,
    follow: Annotated[bool, typer.Option("--follow", "-f", help="Also what it prints from now on.")] = False,
    lines: Annotated[int, typer.Option("--lines", min=0, max=400, metavar="N", help="The newest N.")] = 100,
    level: Annotated[
        str | None, typer.Option("--level", metavar="LEVEL", help="At least: debug, info, warning, error, critical.")
    ] = None,
    json_: JsonOption = False,
    node: AskedOption = None,
    runtime_dir: RuntimeOption = None,
    connect: ConnectOption = None,
) -> None:
    """Show what a task's worker has printed lately, on whichever node it runs.

    A daemon keeps the last 400 lines of each of its workers since its own start; that machine's journal has older ones.
    """
    from zsched.commands.logs import LogsView, show_logs  # noqa: PLC0415 - each verb imports what it needs

    view = LogsView(
        runtime_dir=runtime_dir,
        node=node,
        connect=connect,
        is_json=json_,
        is_followed=follow,
        most=lines,
        level=level,
    )
    raise typer.Exit(show_logs(view, task, whose))


# --- the fleet file --------------------------------------------------------------------------------------------------


@app.command(cls=Verb)
def check(
    file: Annotated[Path | None, typer.Argument(metavar="[FILE]", help="Fleet file; as --config.")] = None,
    config: ConfigOption = None,
    json_: JsonOption = False,
) -> None:
    """Check a fleet file: all faults that can be judged at once, each with file:line:col; exits with 78 on any.

    Of a file without fault it says in words when each task moves, setting by setting, once for tasks alike.
    """
    from zsched import paths as places  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.rules import told_once  # noqa: PLC0415 - as above
    from zsched.config.load import check_file  # noqa: PLC0415 - ruamel.yaml is slow to import
    from zsched.core.values.fleet import fleet_hash  # noqa: PLC0415 - as above

    result = check_file(places.config_path(file or config, os.environ))
    fleet = result.fleet
    counts: Json | None = None
    digest = None if fleet is None else fleet_hash(fleet)
    if fleet is not None:
        counts = {"nodes": len(fleet.nodes), "tasks": len(fleet.tasks), "electors": len(fleet.electors)}
    if json_:
        lists = {"faults": result.faults, "warnings": result.warnings}
        keys = ("line", "col", "message", "hint", "source_line")
        found = {name: [{key: getattr(fault, key) for key in keys} for fault in items] for name, items in lists.items()}
        named = None if fleet is None else {"name": fleet.name, **(counts or {})}
        body = {"schema": "zsched.check/1", "file": result.file, "ok": fleet is not None, "hash": digest}
        print_json({**body, "fleet": named, **found})
    elif report := result.report():
        warn(report)
    if counts is None:
        raise typer.Exit(EXIT_CONFIG)
    if not json_:
        say("ok: " + ", ".join(_count(number, noun) for noun, number in counts.items()))
        say(f"hash: {digest} (nodes whose files have another one say so in `zsched status`)")
    for first, *more in told_once(fleet.tasks, fleet.timing) if fleet is not None and not json_ else ():
        say(first)
        for line in more:
            say(f"  {line}", indent=4)


@app.command(cls=Verb)
def apply(
    file: Annotated[str, typer.Argument(metavar="FILE", help="Fleet file; -: stdin.")],
    plan: PlanOption = False,
    yes: YesOption = False,
    revision: RevisionOption = None,
    accept: AcceptOption = None,
    pause_after: PauseAfterOption = None,
    reason: ReasonOption = "",
    json_: JsonOption = False,
    node: AskedOption = None,
    runtime_dir: RuntimeOption = None,
    connect: ConnectOption = None,
) -> None:
    """Change the running fleet to what a fleet file says: shows what follows, asks, and has it agreed for all nodes.

    The first one of a fleet agrees the file that its nodes run by. A danger has a name, and --accept takes it.
    Exits with 1 when the fleet was changed meanwhile, with 4 without a quorum, with 10 when --plan shows a change.
    """
    from zsched.commands.apply import apply as change  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.apply import read_text  # noqa: PLC0415 - as above
    from zsched.commands.ask import find_door  # noqa: PLC0415 - as above
    from zsched.commands.fleet_verbs import view_of  # noqa: PLC0415 - as above

    words = ("apply", file)
    view = view_of(
        words,
        plan=plan,
        yes=yes,
        revision=revision,
        accept=accept,
        reason=reason,
        is_json=json_,
        pause_after=pause_after,
        at=(node, runtime_dir, connect),
    )
    door = find_door(runtime_dir, node, connect=connect)
    text = read_text(file)
    raise typer.Exit(change(door, view, lambda _held: text, file))


@app.command(cls=Verb)
def edit(
    plan: PlanOption = False,
    yes: YesOption = False,
    revision: RevisionOption = None,
    accept: AcceptOption = None,
    pause_after: PauseAfterOption = None,
    reason: ReasonOption = "",
    node: AskedOption = None,
    runtime_dir: RuntimeOption = None,
    connect: ConnectOption = None,
) -> None:
    """Open the fleet's document in your editor (VISUAL, EDITOR, else vi), and apply what comes of it.

    A text with faults, or one that is refused, stays in a file that the message names.
    """
    from zsched.commands.ask import find_door  # noqa: PLC0415 - each verb imports what it needs
    from zsched.commands.fleet import edit as open_document  # noqa: PLC0415 - as above
    from zsched.commands.fleet_verbs import view_of  # noqa: PLC0415 - as above

    view = view_of(
        ("edit",),
        plan=plan,
        yes=yes,
        revision=revision,
        accept=accept,
        reason=reason,
        is_json=False,
        at=(node, runtime_dir, connect),
        pause_after=pause_after,
    )
    raise typer.Exit(open_document(find_door(runtime_dir, node, connect=connect), view))


# --- everything else -------------------------------------------------------------------------------------------------


@app.command(cls=Verb)
def version(json_: JsonOption = False) -> None:
    """Show the versions of zsched, its wire format, zenoh and Python."""
    from zsched.commands.versions import versions  # noqa: PLC0415 - each verb imports what it needs

    found = versions()
    if json_:
        print_json({"schema": "zsched.version/1", **found})
    else:
        typer.echo("\n".join(f"{name} {text}" for name, text in found.items()))


class Shell(StrEnum):
    """Where completion is wanted."""

    BASH = "bash"
    ZSH = "zsh"
    FISH = "fish"


@app.command(cls=Verb)
def completion(shell: Annotated[Shell, typer.Argument(metavar="SHELL", help="bash, zsh or fish.")]) -> None:
    """Print the script that completes verbs, options, nodes and tasks in a shell.

    For bash: zsched completion bash > /etc/bash_completion.d/zsched
    """
    from zsched.commands.completion import script_file  # noqa: PLC0415 - each verb imports what it needs

    typer.echo(script_file(shell.value).read_text(encoding="utf-8"), nl=False)


@app.command(cls=Verb, hidden=True)
def complete(
    ctx: typer.Context,
    words: Annotated[list[str] | None, typer.Argument(metavar="WORD...", help="Typed so far.")] = None,
) -> None:
    """Print what the last word may become, for the scripts of `zsched completion`."""
    from zsched.commands.completion import next_words  # noqa: PLC0415 - each verb imports what it needs

    for word in next_words(typer.main.get_command(app), ctx, words or ()):
        typer.echo(word)


RootOption = Annotated[
    Path, typer.Option("--root", metavar="DIR", help="Below this folder instead; starts, stops and asks nothing.")
]
PlanOnlyOption = Annotated[
    bool, typer.Option("--plan", "--dry-run", help="Only show what would be done; exits with 10 if anything.")
]


@app.command(cls=Verb)
def install(plan: PlanOnlyOption = False, root: RootOption = Path("/")) -> None:
    """Let the system find a zsched that pip installed: units, the user, completion, manual pages, the program.

    It links or copies, says each step, and starts and enables nothing. Once more, it renews what is old.
    """
    from zsched.commands.install import install as do  # noqa: PLC0415 - each verb imports what it needs

    raise typer.Exit(do(root.absolute(), is_plan=plan))


@app.command(cls=Verb)
def uninstall(plan: PlanOnlyOption = False, root: RootOption = Path("/")) -> None:
    """Stop the services and take away what `zsched install` made. Fleet file, state and the program stay."""
    from zsched.commands.install import uninstall as do  # noqa: PLC0415 - each verb imports what it needs

    raise typer.Exit(do(root.absolute(), is_plan=plan))


@app.command(cls=Verb)
def man(folder: Annotated[Path, typer.Argument(metavar="DIR", help="Where to.")]) -> None:
    """Write the manual pages of all verbs, as files for man."""
    from zsched.commands.manual import pages  # noqa: PLC0415 - each verb imports what it needs

    found = pages(typer.main.get_command(app))
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in found.items():
            (folder / name).write_text(text, encoding="utf-8")
    except OSError as error:
        raise CliError(
            EXIT_FAILED, f"{error.filename or folder}: {error.strerror}; give a folder to write to"
        ) from error
    say(f"{folder}: {_count(len(found), 'pages')}")


def _count(number: int, plural: str) -> str:
    return f"{number} {plural if number != 1 else plural.removesuffix('s')}"


def _node_name(given: str | None) -> str:
    """This node's name. Raises `CliError` (2) when it is no name."""
    from zsched import paths as places  # noqa: PLC0415 - each verb imports what it needs
    from zsched.core.values.words import NAME  # noqa: PLC0415 - as above

    name = places.node_name(given, os.environ)
    if NAME.fullmatch(name) is None:
        where = "--node" if given else "ZSCHED_NODE" if os.environ.get("ZSCHED_NODE") else "the host name"
        raise CliError(
            EXIT_USAGE,
            f"{where}: {name!r} is not a name ([a-z0-9][a-z0-9_-]{{0,62}}); give the fleet file's with --node",
        )
    return name


def _need_file(file: Path) -> None:
    """Raise `CliError` (78) unless the fleet file can be read."""
    from zsched.config.reader import MAX_FILE_BYTES  # noqa: PLC0415 - each verb imports what it needs
    from zsched.files import owner_of, read_regular  # noqa: PLC0415 - as above

    try:
        read_regular(file, MAX_FILE_BYTES)
    except PermissionError as error:
        raise CliError(EXIT_CONFIG, f"{file}: cannot be read: {error.strerror}; {owner_of(file)}") from error
    except OSError as error:
        raise CliError(
            EXIT_CONFIG, f"{file}: cannot be read: {error.strerror}; name the fleet file with --config or ZSCHED_CONFIG"
        ) from error


NEED_ALL = ("complete", "man")
"""Verbs that tell of the others."""


def _leave_out_others(word: str) -> None:
    """Keep only the verb that is meant: to build the options of all takes as long as to ask a daemon."""
    commands = [one for one in app.registered_commands if word == (one.name or getattr(one.callback, "__name__", ""))]
    groups = [
        one for one in app.registered_groups if one.typer_instance is not None and one.typer_instance.info.name == word
    ]
    if (commands or groups or word == "--version") and word not in NEED_ALL:
        app.registered_commands, app.registered_groups = commands, groups


def main() -> None:
    """The console entry point."""
    _leave_out_others("".join(sys.argv[1:2]))
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # bars in a terminal without UTF-8
    code: str | int | None = EXIT_FAILED
    try:
        try:
            app(prog_name="zsched")
        except SystemExit as end:
            code = end.code
        sys.stdout.flush()
    except OSError as error:
        if error.errno not in UNWRITABLE or error.filename is not None:
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # the interpreter will try once more
        warn(f"zsched: the answer cannot be written: {error.strerror}; see where stdout goes")
    _end(code)


def _end(code: str | int | None) -> NoReturn:
    """End the process: at once where zenoh's threads run, for the interpreter's end may abort one that waits there."""
    if "zenoh" in sys.modules and not isinstance(code, str):
        atexit._run_exitfuncs()  # noqa: SLF001 - what closes sessions
        with contextlib.suppress(OSError):
            sys.stdout.flush()
            sys.stderr.flush()
        os._exit(code or 0)
    sys.exit(code)


if __name__ == "__main__":
    main()
