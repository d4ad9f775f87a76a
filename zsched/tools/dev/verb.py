"""`zsched dev`: makes a fleet file fit for this machine, says how applications join, and runs it until it is ended.

Knows: options, what is printed. Does not know: how nodes are run (`zsched.tools.dev`).
"""

from __future__ import annotations

import os
import shlex
import shutil
import sys
import textwrap
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Annotated, Final

import typer

from zsched.commands.base.common import CliError, Json, nearest, say, stopped_by_signal, wants_color
from zsched.commands.base.report import render_status
from zsched.config.load import load_fleet
from zsched.core.route.route import routes_for
from zsched.core.values.exits import EXIT_CONFIG, EXIT_FAILED, EXIT_USAGE
from zsched.core.values.fleet import Fleet, NodeSpec, TaskSpec
from zsched.core.values.model import NodeId, NodeKind, TaskId
from zsched.core.values.plan import Direction
from zsched.host import paths as places
from zsched.host.screen import harmless
from zsched.link.sessions.endpoints import DATA_PORT, PortClaim, claim_port, free_port
from zsched.tools.dev.fleet import Addresses, LoopbackFile, on_loopback
from zsched.tools.dev.nodes import Nodes, shares
from zsched.tools.dev.run import KEYS, Run
from zsched.tools.dev.terminal import Keys
from zsched.tools.dev.watch import Watched
from zsched.tools.example import APPLICATION

HERE: Final = Path("fleet.yaml")
ENTER: Final = "enter.sh"
INDENT: Final = "    "
"""Of what is there to be copied."""
PORT_STEP: Final = 10
"""From one robot's data port to the next one's."""
NARROW: Final = 80
DEFAULT_JOINS: Final = f"tcp/127.0.0.1:{DATA_PORT}"
"""Where an application joins that is told nothing."""


def dev(
    file: Annotated[
        Path | None, typer.Argument(metavar="FILE", help="Fleet file, or its folder; else ./fleet.yaml.")
    ] = None,
    task: Annotated[
        list[str] | None,
        typer.Option("--task", metavar="[TASK=]FILE", help="This worker in place of the fleet file's."),
    ] = None,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="All that the daemons log.")] = False,
) -> int:
    """Run every node of a fleet file on this machine, to try a task of your own; nothing of it stays.

    Example: zsched dev my-task --task worker.py

    It prints where applications join, and starts a worker again when its file is saved. On a terminal keys move the
    task, kill its owner and load it.
    """
    file = _file(file)
    fleet = load_fleet(file)
    if not fleet.tasks:
        advice = "write one under `tasks:` (docs/guide/fleet-file.md), or begin with `zsched new python`"
        raise CliError(EXIT_CONFIG, f"{file} has no task, and there is nothing to run; {advice}")
    commands = _commands(fleet, file, task or ())
    with ExitStack() as stack:
        addresses = _addresses(fleet, stack)
        here = on_loopback(file, addresses, commands)
        candidates = sorted({node for task in fleet.tasks for node in task.candidates})
        cpus = shares(candidates, os.sched_getaffinity(0))
        folder = file.resolve().parent
        words = {**{task.name: task.worker.command for task in fleet.tasks}, **commands}
        nodes = Nodes(fleet, here.text, folder, cpus)
        stop = stack.enter_context(stopped_by_signal())
        keys = stack.enter_context(Keys())
        with nodes:
            _introduce(fleet, file, nodes, addresses, here)
            _say(f"keys: {KEYS}" if keys.is_there else "no terminal, no keys: Ctrl-C or SIGTERM ends it")
            run = Run(nodes, Watched(words, folder), say=_say, show=_show, stop=stop, is_verbose=verbose)
            code = run.run(keys)
            _say("ends")
    if nodes.left_behind:
        raise CliError(EXIT_FAILED, f"could not be removed: {', '.join(nodes.left_behind)}")
    return code


def _file(given: Path | None) -> Path:
    if given is not None and not given.is_dir():
        return given
    if given is not None:
        if not (given / HERE).exists():
            raise CliError(
                EXIT_CONFIG,
                f"no {HERE} in the folder {given}; name the fleet file, or begin with "
                f"`zsched new python {shlex.quote(str(given))}`",
            )
        return given / HERE
    file = HERE if HERE.exists() else places.config_path(None, os.environ)
    if not file.exists():
        raise CliError(
            EXIT_CONFIG,
            f"no {HERE} here, and no {file}; name the fleet file, or begin with `zsched new python`",
        )
    return file


def _commands(fleet: Fleet, file: Path, workers: Sequence[str]) -> dict[TaskId, tuple[str, ...]]:
    """{task: command} of every ``--task [TASK=]PROGRAM``; a Python file runs by this interpreter."""
    names = [task.name for task in fleet.tasks]
    found: dict[TaskId, tuple[str, ...]] = {}
    for given in workers:
        task, equals, program = given.partition("=")
        if not equals and len(names) > 1:
            text = f"{file} has several tasks ({', '.join(names)}); say whose worker it is: --task TASK=worker.py"
            raise CliError(EXIT_USAGE, text)
        if not equals:
            task, program = names[0], given
        if task not in names:
            raise CliError(EXIT_USAGE, f"--task {given}: {file} has no task {task!r}{nearest(task, names)}")
        path = Path(program).absolute()
        if not path.is_file():
            raise CliError(EXIT_USAGE, f"--task {given}: {path} is no file")
        found[task] = ("python", str(path)) if path.suffix == ".py" else (str(path),)
    return found


def _addresses(fleet: Fleet, stack: ExitStack) -> dict[NodeId, Addresses]:
    """Where each node listens: the first robot where a robot's relay always does, if that port is free."""
    robots = [node.name for node in fleet.nodes if node.kind is NodeKind.ROBOT]
    taken: set[int] = set()

    def free() -> str:
        port = free_port()
        while port in taken:
            port = free_port()
        taken.add(port)
        return f"tcp/127.0.0.1:{port}"

    def joins(name: NodeId) -> str:
        claim: PortClaim | None = None
        if name in robots:
            claim = claim_port(DATA_PORT + PORT_STEP * robots.index(name))
        if claim is None:
            return free()
        stack.callback(claim.close)
        return f"tcp/127.0.0.1:{claim.port}"

    def here(node: NodeSpec) -> Addresses:
        if node.local is None:
            return Addresses(control=free(), data=joins(node.name))
        return Addresses(control=free(), data=free(), local=joins(node.name))

    return {node.name: here(node) for node in fleet.nodes}


# --- what is printed -------------------------------------------------------------------------------------------------


def _introduce(
    fleet: Fleet, file: Path, nodes: Nodes, addresses: Mapping[NodeId, Addresses], here: LoopbackFile
) -> None:
    """Everything that somebody needs who writes an application."""
    _say(f"{file}: fleet {fleet.name}, {len(nodes.names)} nodes on this machine; nothing of it stays")
    for text in here.left_out:
        _say(f"differs from the field: {text}")
    width = max(map(len, nodes.names))
    for name in nodes.names:
        cpus = nodes.cpus.get(name)
        share = f", CPU {' '.join(map(str, sorted(cpus)))}" if cpus else ""
        _say(f"{name:{width}}  {fleet.node(name).kind.value:5}  data endpoint {addresses[name].joins}{share}")
    if not nodes.cpus:
        _say("one CPU only, or one candidate: all nodes look alike, and load moves nothing")
    robot = next((name for name in nodes.names if fleet.node(name).kind is NodeKind.ROBOT), nodes.names[0])
    for task in fleet.tasks:
        _say_streams(task, robot)
    say(f"\nAn application of {robot} joins by this configuration of zenoh (JSON5):\n")
    _say_to_copy(json5(addresses[robot].joins))
    say('\nIn Python: zenoh.open(zenoh.Config.from_json5("""..."""))\n')
    if (words := application(nodes.work_folder, fleet.tasks[0].worker.command, addresses[robot].joins)) is not None:
        _say("the application, in another terminal:")
        _say_to_copy(words)
    enter = nodes.folder / ENTER
    enter.write_text(entrance(nodes, robot), encoding="utf-8")
    _say("zsched asks this fleet in a terminal that begins with:")
    _say_to_copy(f"source {shlex.quote(str(enter))}")
    _say(f"in others: `zsched status --runtime-dir {nodes.folder} --node {robot}`")


def entrance(nodes: Nodes, robot: NodeId) -> str:
    """A script for a shell: ``zsched`` and ``python`` are this run's, in the file's folder, and verbs ask ``robot``."""
    activate = Path(sys.prefix) / "bin" / "activate"
    words = {
        "ZSCHED_NODE": robot,
        "ZSCHED_CONFIG": nodes.file,
        "ZSCHED_RUNTIME_DIR": nodes.folder,
        "ZSCHED_STATE_DIR": nodes.folder / robot,
    }
    lines = [f"cd {shlex.quote(str(nodes.work_folder))}"]
    lines += [f"source {shlex.quote(str(activate))}"] if activate.is_file() else []
    lines += [f"export {name}={shlex.quote(str(value))}" for name, value in words.items()]
    return "\n".join(lines) + "\n"


def application(folder: Path, worker: Sequence[str], joins: str) -> str | None:
    """The command line that starts an example's application from any folder; None where there is none.

    It runs by the Python of the task's worker, so a ROS node by the system's.
    """
    file = folder / APPLICATION
    if not file.is_file():
        return None
    named = Path(worker[0]) if worker else Path()
    python = named if named.is_absolute() and named.name.startswith("python") else Path(sys.executable)
    elsewhere = () if joins == DEFAULT_JOINS else (joins,)
    return shlex.join((str(python), str(file), *elsewhere))


def json5(endpoint: str) -> str:
    """The zenoh configuration of an application that joins at ``endpoint``."""
    lines = (
        f'{{mode: "client", connect: {{endpoints: ["{endpoint}"]}},',
        " scouting: {multicast: {enabled: false}},",
        " transport: {shared_memory: {enabled: false}}}",
    )
    return "\n".join(lines)


def _say_streams(task: TaskSpec, robot: NodeId) -> None:
    routes = routes_for(task, robot, task.candidates[0], 1)
    keys = {way: [one for one in routes if one.direction is way] for way in Direction}
    told = [f"publishes {', '.join(one.from_expr for one in keys[Direction.INPUT])}"] if keys[Direction.INPUT] else []
    told += [f"subscribes to {', '.join(one.to_expr for one in keys[Direction.OUTPUT])}"] * bool(keys[Direction.OUTPUT])
    told += [f"asks {', '.join(one.from_expr for one in keys[Direction.SERVICE])}"] * bool(keys[Direction.SERVICE])
    _say(f"{task.name}: an application of {robot} {', '.join(told)}")


def _say(text: str) -> None:
    say(f"dev: {text}", indent=len("dev: "))


def _say_to_copy(text: str) -> None:
    """Lines that are copied as they are, though a terminal may be narrower."""
    sys.stdout.write(f"{textwrap.indent(harmless(text), INDENT)}\n")
    sys.stdout.flush()


def _show(status: Json) -> None:
    print(render_status(status, max(shutil.get_terminal_size().columns, NARROW), color=wants_color(False)), flush=True)
