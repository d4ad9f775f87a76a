"""The composition root: builds the adapters, one queue and one loop, and runs a node until it is told to stop.

Knows: which adapter exists for what, and in which order things start and stop. Does not know: how anything is decided.

``python -m zsched.daemon --config FILE --node NAME``; `zsched up` becomes this process. Exit codes: 0 stopped,
1 failed, 75 the node's name is alive elsewhere, 78 the fleet file or the node's name is wrong, 79 the node has left its
fleet.
"""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import functools
import gc
import logging
import os
import random
import signal
import sys
import time
from pathlib import Path

from zsched import __version__
from zsched.config.load import load_fleet, require_node
from zsched.core.node.node import Node, in_parts
from zsched.core.node.status import status_line
from zsched.core.values import events as ev
from zsched.core.values.endpoint import Endpoint
from zsched.core.values.errors import AdapterError, ConfigError, NameTakenError
from zsched.core.values.exits import EXIT_CONFIG, EXIT_FAILED, EXIT_LEFT, EXIT_NAME_TAKEN, EXIT_OK
from zsched.core.values.fleet import Fleet, WorkerLink, electorate_hash, fleet_hash
from zsched.core.values.in_force import InForce
from zsched.core.values.model import NodeId, NodeKind
from zsched.core.values.problems import Problem
from zsched.core.values.snapshot import Exposure
from zsched.core.values.startup import Startup
from zsched.core.values.struct import Struct
from zsched.host import paths as places
from zsched.host import zenoh_log
from zsched.host.clock import SleepWatch, monotonic_s
from zsched.host.decision_log import DecisionLog
from zsched.host.document_store import copied_file
from zsched.host.guard import calmed, end_with, on_failure
from zsched.host.heap import Leftovers, give_back, share_heaps
from zsched.host.log_limit import log_to_stderr
from zsched.host.operator_socket import OperatorSocket
from zsched.host.rehearsals import RehearsalStore
from zsched.host.screen import fitted
from zsched.host.state_file import StateFile
from zsched.host.systemd import Notifier, watchdog_interval_s
from zsched.host.workers.hired import FOLDER, relay_socket
from zsched.host.workers.supervisor import WorkerContext, WorkerSupervisor
from zsched.link.bus.control_bus import ControlBus
from zsched.link.bus.limits import in_turn_hz, limit_for
from zsched.link.bus.sealing import seals_of
from zsched.link.pipe.protocol import RelayHello
from zsched.link.pipe.relay_socket import PROTOCOL, ask_relay
from zsched.link.sessions import config as zenoh_config
from zsched.link.sessions import tls as daemon_tls
from zsched.link.sessions.access_rules import Side, common_names_of, names_of
from zsched.link.sessions.endpoints import DATA_PORT, Endpoints, claim_port, endpoints_for, free_port, is_here
from zsched.link.sessions.memory import shared_memory_objection
from zsched.link.sessions.secured import CREDENTIALS, digest_of, require_own
from zsched.link.sessions.zenoh_file import denied_by, operator_json5
from zsched.runtime.access import StreamAccess, joins_at
from zsched.runtime.adoption import Adoption, tell_orders
from zsched.runtime.descriptors import take_descriptors
from zsched.runtime.desk import Desk
from zsched.runtime.inbox import INBOX_LIMIT, Inbox
from zsched.runtime.leaving import Leaving, Told
from zsched.runtime.library import Library
from zsched.runtime.recipes import Recipes
from zsched.runtime.relay.streams import SILENCE_S, RelayHandle
from zsched.runtime.reload import Reload
from zsched.runtime.restoring import Restored, Stored, read_stored, restore
from zsched.runtime.sampler import Sampler
from zsched.runtime.session_watch import SessionWatch
from zsched.runtime.sessions import SessionsRead
from zsched.runtime.shell import Shell
from zsched.runtime.strikes import Strikes

NAME_TAKEN_WAIT_S = 5.0
CLOSE_WORKERS_S = 0.7
"""How long workers have to end..."""
FINISH_WORKERS_S = 4.0
"""...and where the daemon begins anew: they do what has come, and nobody counts the seconds."""
LOOP_MAX_WAIT_S = 1.0
SPARE_NODES = 2
"""A relay is carried on while its fleet grows by at most this many nodes."""
STDERR = 2
RELAY = "ZSCHED_RELAY"
"""The socket of a relay that somebody else starts, as a unit of systemd does."""
RESTART_SIGNAL = signal.SIGUSR2
"""As SIGTERM, but the relay stays and carries the streams on for the daemon that follows (`systemctl restart`)."""
RELOAD_SIGNAL = signal.SIGHUP
"""Read the fleet file again and go by it (`systemctl reload`)."""
SIGNALS = (signal.SIGTERM, signal.SIGINT, RESTART_SIGNAL, RELOAD_SIGNAL)
"""What a daemon is told by."""
ALERT_S, ALERT_WAIT_S = 1.0, 0.01
"""After a token went, beats are looked at this often and for this long: they tell whether its node lives."""

log = logging.getLogger("zsched.daemon")


class Options(Struct, frozen=True, kw_only=True):
    """What a daemon is started with; every path is resolved already."""

    config: Path
    node: NodeId
    state_dir: Path
    runtime_dir: Path


class Daemon:
    """One node's process."""

    def __init__(self, options: Options) -> None:
        self._options = options
        self._fleet = load_fleet(options.config)
        require_node(self._fleet, options.node, options.config)
        self._spec = self._fleet.node(options.node)
        self._inbox = Inbox()
        on_failure(lambda kind, text: self._inbox.post(ev.ProblemReported(source=f"thread/{kind}", problem=text)))
        self._notify = Notifier()
        self._next_status = self._alert_until = 0.0
        self._leftovers = Leftovers()
        self._told = Told()
        self._has_left = False
        """This machine is in no fleet any more, by `zsched leave`."""
        self._sleeps = SleepWatch()
        self._certificate = ""
        """Digest of the certificate that open sessions listen with."""
        unit = os.environ.get(RELAY)
        self._relay_path = Path(unit) if unit else places.relay_path(options.runtime_dir, options.node)
        self._is_ready = False
        self._library = Library(
            fleet=self._fleet.name,
            node=options.node,
            config=options.config.absolute(),
            state_dir=options.state_dir,
            post=self._inbox.post,
        )
        self._in_file = fleet_hash(self._fleet)
        self._pools: str | None = None
        """An operator's own ``ZENOH_RUNTIME``."""
        self._read_settings()

    @property
    def begins_anew(self) -> bool:
        """Whether the process becomes another daemon, in place, once this one has ended."""
        return self._told.begins_anew

    def run(self) -> int:
        """Run until SIGTERM or SIGINT; the exit code."""
        state_file = StateFile(self._options.state_dir, fleet=self._fleet.name, node=self._spec.name)
        with state_file, contextlib.ExitStack() as stack:
            here = self._options
            restored = restore(state_file, self._fleet, config=here.config, node=here.node, state_dir=here.state_dir)
            stored = read_stored(self._library, restored.state)
            if stored.fleet is not None:
                self._go_by(stored.fleet)
            # Read once, when zenoh's runtime starts. An operator's own setting wins, and workers inherit it.
            self._pools = os.environ.get("ZENOH_RUNTIME")
            os.environ.setdefault("ZENOH_RUNTIME", zenoh_config.daemon_pools(len(self._fleet.nodes)))
            if self._pools is None:  # the daemon that this process may become must not take ours for an operator's
                stack.callback(os.environ.pop, "ZENOH_RUNTIME", None)
            incarnation = restored.incarnation
            points = endpoints_for(
                self._fleet, self._spec, functools.partial(self._data_port, stack), is_here, self._protocol
            )
            self._watch = SessionWatch(
                self._fleet,
                self._spec,
                points,
                certificate=self._certificate,
                config=here.config,
                state_dir=here.state_dir,
                post=self._inbox.post,
            )
            self._handle_signals(stack)  # first: a stop that comes while things open is an orderly one, too
            shell = self._build(stack, state_file, incarnation, points)
            node = self._node(restored, stored, incarnation, points)
            gc.freeze()  # what lives until the end need not be looked at again
            give_back()
            self._loop(node, shell)
        return EXIT_LEFT if self._has_left else EXIT_OK

    # --- building ----------------------------------------------------------------------------------------------------

    def _go_by(self, fleet: Fleet) -> None:
        """An agreed document is in force, not the fleet file."""
        self._fleet = fleet
        self._spec = fleet.node(self._options.node)
        self._read_settings()

    def _node(self, restored: Restored, stored: Stored, incarnation: int, points: Endpoints) -> Node:
        node = Node(
            fleet=self._fleet,
            me=self._spec.name,
            durable=restored.state,
            incarnation=incarnation,
            electorate=electorate_hash(self._fleet),
            rng=random.Random(f"{self._spec.name}/{incarnation}"),
            now=monotonic_s(),
            startup=Startup(
                version=__version__,
                fleet_path=str(self._options.config.absolute()),
                copied_file=copied_file(self._options.state_dir),
                joins_at=joins_at(self._spec, points.worker_connect[:1]),
                security=self._exposure(points),
                no_state=restored.no_state,
            ),
            stored=stored.fleets,
            flags=stored.flags,
        )
        node.solitude.dialled = points.control_connect
        node.solitude.dialled_at = self._spec.control_at
        node.by_file = self._in_file
        if restored.is_unsaved:
            node.agreement.on_persist_failed(restored.problem or "")
        elif restored.problem is not None:
            node.set_problem(Problem.STATE, restored.problem)
        if self._memory_objection:
            log.warning("shared_memory off why=%s", self._memory_objection)
            node.set_problem("shared_memory", f"shared memory is off here: {self._memory_objection}")
        node.set_problem("tls", daemon_tls.plain_text_problem(self._spec, self._protocol) or None)
        return node

    def _exposure(self, points: Endpoints) -> Exposure:
        listens = (*points.control_listen, *points.data_listen)
        found = daemon_tls.exposure(self._fleet, self._spec, self._protocol, listens)
        if found is Exposure.OPEN:
            log.warning(
                "not_secured: whoever reaches this network reads and changes everything; see docs/guide/secure.md"
            )
        return found

    def _read_settings(self) -> None:
        """What hangs on the fleet in force, and is the same for as long as the process lives."""
        text = operator_json5(self._fleet)
        for fault in denied_by(self._fleet, text)[1]:
            log.warning("zenoh_file %s; %s", fault.message, fault.hint)
        self._protocol = daemon_tls.protocol_of(self._fleet, text)
        socket = relay_socket(self._spec.name)
        self._by_socket = f"{zenoh_config.WORKERS_BY}/{socket}"
        self._lets_in_keyless = (
            self._fleet.has_keyless_workers and bool(os.environ.get(FOLDER)) and socket.parent.is_dir()
        )
        homes = {Side.DATA: self._spec.name} if self._lets_in_keyless else {}
        self._texts = {side: daemon_tls.session_text(self._fleet, side, home=homes.get(side, "")) for side in Side}
        self._plain_text = text
        if self._fleet.security is not None:
            require_own(self._fleet, self._fleet.security, self._spec.name)
            self._certificate = digest_of(self._fleet.security)
        self._memory_objection = shared_memory_objection(self._fleet, self._spec)

    def _data_port(self, stack: contextlib.ExitStack) -> int:
        """A port for the data session: that of the relay that runs, else the default, else a free one."""
        here = ask_relay(self._relay_path)
        if here is not None and here.listen and (port := Endpoint.of(here.listen).port):
            return port
        claim = claim_port(DATA_PORT)
        if claim is None:
            return free_port()
        stack.callback(claim.close)
        return claim.port

    def _build(self, stack: contextlib.ExitStack, state_file: StateFile, incarnation: int, points: Endpoints) -> Shell:
        """Open the adapters; each is closed by ``stack`` in the reverse order."""
        zenoh_log.capture(os.environ)
        fleet, me = self._fleet, self._spec.name
        is_exclusive = any(task.exclusive for task in fleet.tasks)
        bus = ControlBus(
            fleet=fleet.name,
            node=me,
            incarnation=incarnation,
            zenoh_config=zenoh_config.control_config(
                listen=points.control_listen,
                connect=points.control_connect,
                timing=fleet.timing,
                operator_json5=self._texts[Side.CONTROL],
                dials_by_gossip=points.control_by_gossip,
                at_most_hz=None if is_exclusive else in_turn_hz(fleet),  # without a ring, none is pushed out
            ),
            post=self._inbox.post,
            members=None if fleet.security is None else common_names_of(fleet, fleet.security),
            is_voter=self._spec.kind is NodeKind.ROBOT,
            hears_all_beats_at_once=is_exclusive,
            seals=seals_of(fleet, incarnation),
            limit=limit_for(fleet.timing, len(fleet.tasks)),
            names=names_of(fleet),
        )
        here = InForce(fleet)
        access = StreamAccess(here, me, points.worker_connect[:1], self._texts[Side.VISIT])
        decisions = DecisionLog(
            self._options.state_dir,
            me,
            incarnation,
            lambda problem: self._inbox.post(ev.ProblemReported(source="log", problem=problem)),
        )
        desk = Desk(me, self._inbox, bus, here, access.answer, decisions.answer, self._leave)
        tell_orders(fleet, bus)
        operators = OperatorSocket(places.socket_path(self._options.runtime_dir, me), desk.answer)
        operators.open()
        with contextlib.suppress(OSError):
            places.again_path(self._options.runtime_dir, me).unlink(missing_ok=True)
        stack.callback(operators.close)
        bus.open()
        stack.callback(bus.close)
        shell = Shell(node=me, inbox=self._inbox, bus=bus, state_file=state_file, desk=desk, fleet=fleet)
        shell.log, shell.library = decisions, self._library
        shell.take_certificate = self._watch.take_certificate
        shell.rehearsals = RehearsalStore(self._options.state_dir)
        shell.strikes = Strikes(me, shell.answer_operator)
        self._library.fetch = bus.fetch_document
        self._library.start()
        stack.callback(self._library.close)
        decisions.start()
        stack.callback(decisions.close)
        shell.relay = relay = self._relay(shell, points)
        shell.crew.supervisor = supervisor = self._supervisor(stack, shell, incarnation, points)
        shell.crew.begin()
        sampler = Sampler(
            self._spec,
            fleet.timing.sample_s,
            self._options.state_dir,
            shell,
            self._inbox,
            is_watched=is_exclusive,
        )
        shell.measure_soon = sampler.hurry
        adoption = Adoption(
            me=me,
            here=here,
            started_with=fleet,
            points=points,
            protocol=self._protocol,
            recipes=self._recipes,
            crew=shell.crew,
            supervisor=supervisor,
            relay=relay,
            bus=bus,
            sampler=sampler,
            compare_sessions=self._watch.note,
            post=self._inbox.post,
        )
        adoption.begin()
        shell.follow, shell.end = adoption.follow, adoption.end
        relay.start()
        stack.callback(lambda: relay.leave() if self._told.keeps_relay else relay.stop(1.0))
        stack.callback(lambda: supervisor.close(FINISH_WORKERS_S if self.begins_anew else CLOSE_WORKERS_S))
        sampler.start()
        stack.callback(sampler.stop)
        return shell

    def _relay(self, shell: Shell, points: Endpoints) -> RelayHandle:
        fleet = self._fleet
        size, tasks = len(fleet.nodes), tuple(task.name for task in fleet.tasks)
        threads = zenoh_config.pool_threads(size, len(tasks))
        hello = RelayHello(
            protocol=PROTOCOL,
            fleet=fleet.name,
            node=self._spec.name,
            threads=threads,
            spare_threads=zenoh_config.pool_threads(size + SPARE_NODES, len(tasks)) - threads,
            certificate="" if fleet.security is None else digest_of(fleet.security),
            addresses=() if self._spec.local else self._watch.gossiped,
            listen=points.data_listen[0],
            credentials=os.environ.get(CREDENTIALS, ""),
            tasks=tasks,
        )
        return RelayHandle(
            hello=hello,
            path=self._relay_path,
            starts=RELAY not in os.environ,
            zenoh_config=zenoh_config.data_config(
                listen=self._data_listen(points),
                connect=points.data_connect,
                timing=fleet.timing,
                shared_memory=self._memory_objection == "",
                operator_json5=self._texts[Side.DATA],
                dials_by_gossip=points.data_by_gossip,
            ),
            on_report=shell.on_report,
            local_config=zenoh_config.local_config(side, timing=fleet.timing) if (side := self._spec.local) else "",
            silence_s=max(SILENCE_S, fleet.timing.zenoh_lease_s + 0.5),
        )

    def _data_listen(self, points: Endpoints) -> tuple[str, ...]:
        """Where the relay listens; where it cannot let workers without a key in, it works for all others."""
        keyless = (f"{self._by_socket}#exit_on_failure=false",) if self._lets_in_keyless else ()
        return (*self._for_members(points), *keyless)

    def _for_members(self, points: Endpoints) -> tuple[str, ...]:
        """A relay keeps its process when it roams, and zenoh the addresses of its process: they are named, then.

        Without a local side the host's applications join this session at any address, and the process is replaced.
        """
        gossiped = self._watch.gossiped
        if not self._spec.local or not gossiped:
            return points.data_listen
        listen, here = Endpoint.of(points.data_listen[0]), Endpoint.of(points.worker_connect[0])
        if not listen.is_everywhere:
            return points.data_listen
        return tuple(str(listen.at(host)) for host in (here.host, *gossiped) if host)

    def _supervisor(
        self, stack: contextlib.ExitStack, shell: Shell, incarnation: int, points: Endpoints
    ) -> WorkerSupervisor:
        fleet, me = self._fleet, self._spec.name
        recipes = self._recipes = Recipes(
            me,
            self._options.runtime_dir,
            SessionsRead(self._options.state_dir),
            shared_memory=self._memory_objection == "",
            operator_json5={
                WorkerLink.PEER: self._texts[Side.DATA],
                WorkerLink.CLIENT: self._texts[Side.VISIT],
            },
            pools=self._pools,
            by_socket=((self._by_socket,), self._plain_text),
        )
        stack.callback(recipes.close)
        recipes.make(fleet, points.worker_connect, dials_by_gossip=points.worker_by_gossip)
        shell.crew.sessions, shell.crew.sessions_read = recipes.paths, recipes.read
        return WorkerSupervisor(
            specs=recipes.specs,
            context=WorkerContext(fleet=fleet.name, node=me, incarnation=incarnation),
            events=shell.crew,
            environment=recipes.environment,
            session=recipes.session,
            starter=recipes.starter,
            rng=random.Random(f"{me}/{incarnation}/workers"),
            why_not_ready=shell.crew.why_not_ready,
        )

    # --- the loop ----------------------------------------------------------------------------------------------------

    def _handle_signals(self, stack: contextlib.ExitStack) -> None:
        def stop(number: int, _frame: object) -> None:
            self._told.stop(keeps_relay=number == RESTART_SIGNAL)
            self._inbox.post(ev.StopRequested())

        for number in (signal.SIGTERM, signal.SIGINT, RESTART_SIGNAL):
            previous = signal.signal(number, stop)
            stack.callback(signal.signal, number, previous)
        reload = Reload(self._options.config, self._spec.name, self._inbox.post)
        # at a terminal the same signal says that the terminal is gone: then nobody is there to stop us later
        hung_up = stop if os.isatty(0) else lambda _number, _frame: reload.ask()
        previous = signal.signal(RELOAD_SIGNAL, hung_up)
        stack.callback(signal.signal, RELOAD_SIGNAL, previous)
        # `zsched up`, or the daemon before us in this process, has held them back since before we loaded: an early
        # Ctrl-C is an orderly stop, and no traceback
        signal.pthread_sigmask(signal.SIG_UNBLOCK, SIGNALS)

    def _leave(self) -> None:
        """An operator has taken this machine out of its fleet; called by the operator socket's threads."""
        self._has_left = True
        self._told.stop()
        log.info("left node=%s: the service does not start it again", self._options.node)
        self._inbox.post(ev.StopRequested())

    def _loop(self, node: Node, shell: Shell) -> None:
        """Take an event, handle it, carry the batch out; wake up in time for the node's next deadline."""
        shell.carry_out(node.start(monotonic_s()))
        watchdog_s = watchdog_interval_s()
        next_ping, leaving = 0.0, Leaving()
        while True:
            wait = min(node.next_deadline() - monotonic_s(), LOOP_MAX_WAIT_S)
            if monotonic_s() < self._alert_until:
                wait = min(wait, ALERT_WAIT_S)
            taken, now = self._turn(node, shell, self._inbox.take(wait) or ev.DeadlineReached())
            if shell.stand_down:
                raise NameTakenError(f"{node.me}: {shell.stand_down}")
            if any(isinstance(one, ev.TokenLost) for one in taken):
                self._alert_until = now + ALERT_S
            for _ in (one for one in taken if isinstance(one, ev.StopRequested)):
                is_first = leaving.ask(node.owned(), now, begins_anew=self.begins_anew)
                if is_first and not self.begins_anew:
                    self._notify.stopping()
            self._watch.look_around(node, now)
            if leaving.asked_at is None and not self.begins_anew and self._watch.is_due(node, now):
                self._end_to_begin_anew()
            if leaving.asked_at is not None and leaving.is_over(
                node.owned(), node.movable(now), now, finishing=node.finishing()
            ):
                self._say_goodbye(node, leaving.last_words(node.owned(), now))
                return
            if watchdog_s is not None and now >= next_ping:
                next_ping = now + min(watchdog_s, 1.0)
                self._notify.watchdog()
            if now >= self._next_status:
                self._next_status = now + 1.0
                self._leftovers.tend(now)
                for kind in calmed(now):
                    self._inbox.post(ev.ProblemReported(source=f"thread/{kind}", problem=None))
                self._notify.status(status_line(node))

    def _end_to_begin_anew(self) -> None:
        self._told.begin_anew()
        if not self.begins_anew:
            return  # somebody has told us to end while we looked whether it is our turn
        log.info(
            "sessions node=%s are opened anew: others are let in or dialled, or its certificate or address is another",
            self._options.node,
        )
        with contextlib.suppress(OSError):  # without it an operator's command says that there is no daemon
            places.again_path(self._options.runtime_dir, self._options.node).touch()
        self._inbox.post(ev.StopRequested())

    def _say_goodbye(self, node: Node, last_words: str) -> None:
        if last_words:
            log.warning("stopping node=%s %s", node.me, last_words)
            self._notify.status(last_words)
        else:
            log.info("stopping node=%s", node.me)

    def _turn(self, node: Node, shell: Shell, event: ev.Event) -> tuple[list[ev.Event], float]:
        """Handle one event, and what came with it; all these events, and when they were judged."""
        taken, now = self._take_all(node, shell, event)
        parts = in_parts(taken)
        while parts:
            *before, last = parts.pop(0)
            for waiting in before:
                node.absorb(waiting, now)
            shell.carry_out(node.handle(last, now))
            if (first := self._inbox.take_first()) is not None:  # before any other event: a disk has refused
                more, now = self._take_all(node, shell, first)
                taken += more
                parts = in_parts([*(left for part in parts for left in part), *more])
        return taken, now

    def _take_all(self, node: Node, shell: Shell, event: ev.Event) -> tuple[list[ev.Event], float]:
        """The event, behind a deadline also all that have come since, in their order; and the time to judge them by.

        Else a loop that stood still, maybe in its own write, would take a node for silent whose beat or answer waits.
        """
        taken, now = [event], self._now(node)
        if now >= node.next_deadline() or now < self._alert_until or isinstance(event, ev.TokenLost):
            self._absorb_waiting(node, shell)  # before the event: they came before it, and nobody may look silent
            now = self._now(node)
        while now >= node.next_deadline() and len(taken) < INBOX_LIMIT:  # a flood must not put deadlines off for ever
            behind = self._inbox.take(0.0)
            if behind is None:
                break  # nothing had come by `now`
            taken.append(behind)
            now = self._now(node)
        return taken, now

    def _now(self, node: Node) -> float:
        """The time by which an event is judged; the node hears first that the machine has slept.

        The sampler would tell of it up to a second later. By then an elector whose clock counts too long a sleep might
        have granted a task to a second owner.
        """
        now = monotonic_s()
        if slept_s := self._sleeps.look():
            node.absorb(ev.ClockCompared(error_ratio=0.0, jump_s=slept_s), now)
        return now

    def _absorb_waiting(self, node: Node, shell: Shell) -> None:
        """Let the node absorb what has come without waking the loop: our own samples, and periodic frames."""
        for waiting in (*self._inbox.waiting(), *shell.waiting_frames()):
            node.absorb(waiting, self._now(node))
            self._note_ready(node, waiting)

    def _note_ready(self, node: Node, event: ev.Event) -> None:
        """Ready is who runs and has measured its machine."""
        if self._is_ready or not isinstance(event, ev.ProfileSampled):
            return
        self._is_ready = True
        self._notify.ready()
        log.info("ready node=%s fleet=%s incarnation=%d", node.me, self._fleet.name, node.incarnation)


def main(arguments: list[str] | None = None) -> int:
    """The daemon's command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m zsched.daemon", description="zsched's daemon (see: zsched up)")
    parser.add_argument("--config", type=Path)
    parser.add_argument("--node")
    parser.add_argument("--state-dir", type=Path)
    parser.add_argument("--runtime-dir", type=Path)
    parser.add_argument("--log-level", default="INFO", choices=["DEBUG", "INFO", "WARNING", "ERROR"])
    given = parser.parse_args(arguments)
    _set_up_logging(given.log_level)
    take_descriptors()
    share_heaps()
    faulthandler.enable(
        file=STDERR
    )  # a crash, or systemd's watchdog (SIGABRT), leaves every thread's place in the journal
    options = Options(
        config=places.config_path(given.config, os.environ),
        node=places.node_name(given.node, os.environ),
        state_dir=places.state_folder(given.state_dir, os.environ),
        runtime_dir=places.runtime_folder(given.runtime_dir, os.environ),
    )
    # Where a renewed certificate is looked for (`zsched.link.sessions.secured`), however the state folder was named.
    os.environ["ZSCHED_STATE_DIR"] = str(options.state_dir)
    try:
        daemon = Daemon(options)
        code = daemon.run()
    except ConfigError as error:
        print(fitted(str(error), sys.stderr), file=sys.stderr)
        return EXIT_CONFIG
    except NameTakenError as error:
        # It may have been somebody's forgery, so the service tries again; not at once, for each try disturbs the other.
        print(fitted(str(error), sys.stderr), file=sys.stderr, flush=True)
        time.sleep(NAME_TAKEN_WAIT_S)
        return EXIT_NAME_TAKEN
    except AdapterError as error:
        print(fitted(f"zsched up: {error}", sys.stderr), file=sys.stderr)
        return EXIT_FAILED
    if daemon.begins_anew:
        _begin_anew()
    return code


def _begin_anew() -> None:
    """Become the next daemon: the same process, so that its supervisor starts no second one."""
    sys.stdout.flush()
    sys.stderr.flush()
    signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)  # it takes what comes while it loads
    Notifier().watchdog()  # no loop turns from the end of ours to the beginning of its own: seconds, on a small machine
    os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])  # noqa: S606 - no shell is wanted


def _set_up_logging(level: str) -> None:
    # journald stamps its own times; elsewhere a person wants them.
    stamp = "" if "JOURNAL_STREAM" in os.environ else "%(asctime)s "
    log_to_stderr(level, f"{stamp}%(levelname)s %(name)s %(message)s")


if __name__ == "__main__":
    end_with(main)
