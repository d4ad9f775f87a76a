"""Bugs in relays and workers that the tests with real sessions and processes must find.

Knows: which text of which module each bug replaces, and which tests must find it. Does not know: how it is planted. The
simulator has no streams, so no schedules are played for these.
"""

from __future__ import annotations

from zsched_lab.bugs.core_bugs import Bug

ACKS, RECEIVER, SERIAL = "zsched.hop.acknowledger", "zsched.core.hop.receiver", "zsched.core.hop.serial"
INPUTS, SHARED = "zsched.worker.inputs", "zsched.core.hop.shared"
KEPT, HELD, SLOTS = "zsched.core.hop.kept", "zsched.core.hop.held", "zsched.relay.streams.slots"
GREETINGS, SENDER, OUTLET = "zsched.relay.streams.greetings", "zsched.core.hop.sender", "zsched.relay.streams.outlet"

BOOKS, TASK = "zsched.relay.books", "zsched.relay.task"

_BOOKS = ("tests/unit/relay/test_books.py",)
_TASK = ("tests/parts/relay/test_task.py",)
_GREETINGS = ("tests/parts/relay/streams/test_greetings.py",)
_GATES = ("tests/parts/relay/streams/test_gates.py",)
_RECEIVE = ("tests/parts/relay/streams/test_receive.py",)
_ACKS = ("tests/unit/hop/test_acknowledger.py",)
_RECEIVER = ("tests/unit/core/hop/test_receiver.py",)
_HOP = ("tests/sim/test_hop.py",)
_SENDER = ("tests/unit/core/hop/test_sender.py",)
_SHARED = ("tests/unit/core/hop/test_shared.py",)
_WORKER = "tests/parts/worker/test_worker.py"
_FROZEN = "tests/integration/test_relay_frozen_moves.py"
_REPLAY = "tests/integration/test_relay_replay.py"
_CHAOS = "tests/system/test_chaos_streams.py"
_RELAY_STREAMS = "tests/integration/test_relay_streams.py"


def _bug(name: str, module: str, old: str, new: str, tests: tuple[str, ...]) -> Bug:
    return Bug(name=name, module=module, changes=((old, new),), tests=tests, has_schedules=False)


STREAM_BUGS = (
    _bug(
        "what a cut owner had on its way is in no counter",
        "zsched.relay.streams.outputs",
        "        if feed is not None and is_cut:\n",
        "        if feed is not None and is_cut and feed is None:\n",
        _GATES,
    ),
    _bug(
        "what gives way in front of a stream is in no counter",
        "zsched.relay.streams.receive",
        "self._give_way(waiting.popleft())",
        "waiting.popleft()",
        _RECEIVE,
    ),
    _bug(
        "zenoh's ring in front of a stream drops what it likes",
        "zsched.relay.streams.receive",
        "zenoh.handlers.FifoChannel(max(settings.depth, QUEUE_DEPTH))",
        "zenoh.handlers.RingChannel(max(settings.depth, QUEUE_DEPTH))",
        _RECEIVE,
    ),
    _bug(
        "a new lane does not wait for its greeting's answer",
        OUTLET,
        "if greetings.is_waiting and not (greets and greetings.greet(len(self._lanes))):\n                return False",
        "if greetings.is_waiting and greets:\n                greetings.greet(len(self._lanes))",
        _GREETINGS,
    ),
    _bug(
        "a worker that lost its link is not greeted again",
        GREETINGS,
        "                for lane in lanes.values():\n                    lane.part(now)\n",
        "                for lane in ():\n                    lane.part(now)\n",
        _GREETINGS,
    ),
    _bug(
        "any word of a receiver answers its greeting",
        SENDER,
        "if self.is_met or self.greeted_at is None or self.ack is None or self.ack.arrived < self.base:",
        "if self.is_met or self.ack is None:",
        _SENDER,
    ),
    _bug(
        "what a stopped process slept counts as waiting",
        RECEIVER,
        "self._stood_s += max(0.0, now - self._asked_at - STEP_S)",
        "pass",
        _RECEIVER,
    ),
    _bug(
        "newer samples pass for an answer to a gap",
        SENDER,
        "is_still = now - self.asked_at > self.pause_s / 3",
        "is_still = now - self.moved_at > self.pause_s / 3",
        _SENDER,
    ),
    _bug(
        "what a worker that died left open is not told",
        SENDER,
        "ended = self.sums()._replace(at_most_lost=max(0, start - self.processed))",
        "ended = self.sums()",
        _HOP,
    ),
    _bug(
        "a new life's first number is not asked for",
        SENDER,
        "start = self.count if self.is_whole else min(",
        "start = self.processed if self.is_whole else min(",
        (*_HOP, *_GREETINGS),
    ),
    _bug(
        "a replay skips what is on its way",
        SENDER,
        "self.replay_end = self.count + count\n        return self.lowest",
        "self.replay_end = self.count + count\n        return self.count",
        _GREETINGS,
    ),
    _bug(
        "a sample that the thread has just taken is not replayed",
        OUTLET,
        "                owed.append(LeftOpen(*self._queue.in_hand))",
        "                pass",
        _GREETINGS,
    ),
    _bug(
        "a forged start that is taken back leaves a loss",
        RECEIVER,
        "self.first = min(self.first, jump.at)",
        "pass",
        _ACKS,
    ),
    _bug(
        "a sample that was shed counts as acknowledged",
        ACKS,
        "            if source is not None:\n                source.lost += 1\n                self._mark(name)",
        "            if source is not None:\n                self._mark(name)",
        _ACKS,
    ),
    _bug(
        "what was given up is not counted",
        SENDER,
        "known = max(0, self.ack.lost - before) + max(0, first - self.base)",
        "known = max(0, first - self.base)",
        (*_SENDER, *_GREETINGS),
    ),
    _bug(
        "numbers are compared without their wrap",
        SERIAL,
        "number = reference + (ahead if ahead < _HALF else ahead - SPAN)",
        "number = serial",
        ("tests/unit/core/hop/test_serial.py", *_ACKS),
    ),
    _bug(
        "a forged jump stands",
        RECEIVER,
        "        return self.count >= RETURN",
        "        return False",
        _ACKS,
    ),
    _bug(
        "applications are not asked whether they have room",
        OUTLET,
        "self._crowd = self._make_crowd() if has_crowd else None",
        "self._crowd = None",
        ("tests/integration/test_relay_receivers.py::test_a_frozen_application_delays_no_other",),
    ),
    _bug(
        "a sample in hand overtakes what a worker withheld",
        INPUTS,
        "return is_early or is_behind",
        "return is_early",
        (f"{_WORKER}::test_the_sample_in_hand_when_the_role_comes_does_not_overtake_what_was_withheld",),
    ),
    _bug(
        "a lease that is back lets newer samples out first",
        INPUTS,
        "is_early = self._is_begin_due or self._epoch != epoch",
        "is_early = self._epoch != epoch",
        (f"{_WORKER}::test_what_was_withheld_for_want_of_a_lease_goes_out_before_what_comes_with_it",),
    ),
    _bug(
        "the name of a slot comes too late for its first value",
        INPUTS,
        "if in_turn and self._epoch:  # a standby's",
        "if False:  # a standby's",
        (f"{_WORKER}::test_a_name_that_comes_behind_the_first_value_counts_for_it_too",),
    ),
    _bug(
        "the name of a slot is heard once only",
        INPUTS,
        "if state is not None and state.in_turn:",
        "if False:",
        (f"{_WORKER}::test_a_name_that_comes_behind_the_first_value_counts_for_it_too",),
    ),
    _bug(
        "a backlog is answered by keys",
        "zsched.worker.backlog",
        "deque(sorted((*self._again, *kept), key=_turn_of))",
        "deque((*self._again, *kept))",
        ("tests/unit/worker/test_backlog.py",),
    ),
    _bug(
        "what comes behind a worker's own end goes nowhere",
        "zsched.worker.worker",
        "if epoch is None:  # without",
        "if not has_lease:  # without",
        (f"{_WORKER}::test_what_comes_behind_the_end_of_an_epoch_is_answered_in_the_next_one",),
    ),
    _bug(
        "a worker skips what a reliable input brings",
        INPUTS,
        "is_whole=end.is_whole, replayed=end.replayed",
        "is_whole=bool(end.replayed), replayed=end.replayed",
        (f"{_WORKER}::test_what_a_slow_worker_keeps_follows_the_class_and_what_it_sheds_of_a_reliable_input_is_lost",),
    ),
    _bug(
        "what a worker skips of a reliable input counts as processed",
        "zsched.worker.samples",
        "return is_whole or self.keep_last is None",
        "return self.keep_last is None",
        (f"{_WORKER}::test_what_a_slow_worker_keeps_follows_the_class_and_what_it_sheds_of_a_reliable_input_is_lost",),
    ),
    _bug(
        "what a relay's former life has had is lost",
        "zsched.relay.streams.answers",
        "before if marker.had is None else marker.had",
        "before",
        ("tests/parts/relay/streams/test_answers.py",),
    ),
    _bug(
        "a relay's next life is sent what the former one has had",
        SHARED,
        "arrived = max(receiver.waits_for, receiver.had or 0)",
        "arrived = receiver.waits_for",
        ("tests/parts/worker/test_keep.py",),
    ),
    _bug(
        "an input is done before its answers have come",
        INPUTS,
        "processed(name, number, size, self._owed, ",
        "processed(name, number, size, {}, ",
        ("tests/integration/test_relay_last_answers.py", "tests/parts/worker/test_done.py"),
    ),
    _bug(
        "an input whose answer was withheld is done",
        INPUTS,
        "is_unanswered = self._has_withheld and waiting.is_whole",
        "is_unanswered = False",
        ("tests/parts/worker/test_done.py",),
    ),
    _bug(
        "an input does not wait for its robot's first word",
        SHARED,
        "low = self.count if is_known or not self._is_expected(name, now) else 0",
        "low = self.count",
        ("tests/unit/worker/test_debts.py",),
    ),
    _bug(
        "a robot that takes long over a large answer has it",
        SHARED,
        "return not self.has_left and (is_own or is_moving)",
        "return not self.has_left and is_moving",
        ("tests/unit/worker/test_debts.py",),
    ),
    _bug(
        "a frozen robot stalls the inputs of the others",
        SHARED,
        "return not self.has_left and (is_own or is_moving)",
        "return not self.has_left",
        ("tests/unit/worker/test_debts.py",),
    ),
    _bug(
        "a slot that closes does not say so",
        "zsched.relay.streams.answers",
        "self._acks.leave(heard)",
        "self._acks.flush()",
        ("tests/parts/relay/streams/test_answers.py",),
    ),
    _bug(
        "what a foreign worker was sent is in no counter",
        OUTLET,
        "self.tally.unconfirmed += 1",
        "self.tally.unconfirmed += 0",
        (f"{_RELAY_STREAMS}::test_what_a_foreign_worker_was_sent_is_unconfirmed_and_never_dropped",),
    ),
    _bug(
        "an input of an epoch that is not told yet is answered in the old one",
        "zsched.worker.epochs",
        "if in_hand is not None and in_hand > role.epoch:",
        "if in_hand is not None and in_hand < 0:",
        ("tests/unit/worker/test_epochs.py",),
    ),
    _bug(
        "what is too old for a newer epoch is done all the same",
        "zsched.worker.backlog",
        "return self.quiet_at is None and 0 < self.slot < epoch and now - self.at > STALE_S",
        "return False",
        ("tests/unit/worker/test_backlog.py",),
    ),
    _bug(
        "a slot that leaves work does not give it up",
        OUTLET,
        "left = self._queue.close(self._leave)",
        "left = self._queue.close(self._undeclare)",
        _GREETINGS,
    ),
    _bug(
        "one answer proves its sample done",
        "zsched.relay.streams.proofs",
        "if not is_answered or one.lane not in answered:",
        "if not is_answered:",
        ("tests/unit/relay/streams/test_proofs.py",),
    ),
    _bug(
        "a relay leaves a put to a frozen worker to zenoh",
        OUTLET,
        "= acks.stalled if acks else contextlib.nullcontext()",
        "= contextlib.nullcontext()",
        ("tests/parts/sessions/test_stalled_links.py::test_a_relay_ends_the_link_of_a_frozen_worker_behind_its_put",),
    ),
    _bug(
        "a relay closes links, and reads those it has dialled, with a single thread",
        "zsched.sessions.config",
        "return _pools(rx=threads, tx=threads, net=threads, acc=threads)",
        "return _pools(rx=threads, tx=threads, acc=threads)",
        ("tests/unit/sessions/test_config.py", "tests/integration/test_zenoh_pools.py"),
    ),
    _bug(
        "a relay accepts, and reads those that have dialled it, with a single thread",
        "zsched.sessions.config",
        "return _pools(rx=threads, tx=threads, net=threads, acc=threads)",
        "return _pools(rx=threads, tx=threads, net=threads)",
        ("tests/unit/sessions/test_config.py", "tests/integration/test_zenoh_pools.py"),
    ),
    _bug(
        "a daemon has as many threads as zenoh likes",
        "zsched.daemon",
        'os.environ.setdefault("ZENOH_RUNTIME",',
        'os.environ.setdefault("ZENOH_RUNTIME_UNREAD",',
        ("tests/integration/test_zenoh_pools.py",),
    ),
    _bug(
        "a worker has the threads that its daemon has",
        "zsched.runtime.recipes",
        '            "ZENOH_RUNTIME": pools,\n',
        "",
        ("tests/integration/test_zenoh_pools.py",),
    ),
    _bug(
        "a relay has the threads that its daemon has",
        "zsched.relay.__main__",
        'os.environ["ZENOH_RUNTIME"] = relay_pools(arguments.threads)',
        "relay_pools(arguments.threads)",
        ("tests/integration/test_zenoh_pools.py",),
    ),
    _bug(
        "a relay does not tell a role again whose token goes",
        "zsched.relay.process",
        "self._roles.remind(ended.task, ended.epoch)",
        "pass",
        ("tests/integration/test_relay_process.py::test_a_role_whose_token_goes_is_told_again_by_the_relay",),
    ),
    _bug(
        "a reliable lane sends to whoever subscribes",
        OUTLET,
        "is_open=self._is_open if is_reliable and self._acks is not None else None,",
        "is_open=None,",
        (f"{_FROZEN}::test_an_owner_that_is_frozen_before_it_is_greeted_misses_nothing",),
    ),
    _bug(
        "a lane waits for an answer to a greeting that was not put",
        GREETINGS,
        "                self._put_start(lane, lowest)\n",
        "                pass\n",
        (f"{_FROZEN}::test_an_owner_that_is_frozen_before_it_is_greeted_misses_nothing",),
    ),
    _bug(
        "what an input's rule says of a crash is not read",
        "zsched.config.tasks",
        '"graph", "on_crash")',
        '"graph")',
        (f"{_CHAOS}::test_a_power_cut_loses_nothing_where_the_rule_says_replay",),
    ),
    _bug(
        "a cold standby without a command is let through",
        "zsched.config.tasks",
        'is Standby.COLD and not (command or section.get("command")):',
        'is Standby.COLD and section.get("command") == ():',
        ("tests/unit/config/test_load.py::test_one_fault_is_reported_once_at_its_place",),
    ),
    _bug(
        "one forged acknowledgement lets go of what is kept",
        SENDER,
        "        self._take_back(limit)\n",
        "",
        (
            "tests/unit/core/hop/test_sender.py::test_what_an_acknowledgement_says_is_taken_back_by_one_that_says_less",
            "tests/integration/test_relay_reliable.py",
        ),
    ),
    _bug(
        "a start marker skips what one forged acknowledgement has let go of",
        SENDER,
        "first = self.spare[0].number if self.spare else self.kept.first(self.count)",
        "first = self.kept.first(self.count)",
        (*_SENDER, *_GREETINGS),
    ),
    _bug(
        "a timestamp that several samples have proves one of them done",
        "zsched.relay.streams.proofs",
        "return self._alone.get(stamp, False)",
        "return stamp in self._alone",
        ("tests/unit/relay/streams/test_proofs.py",),
    ),
    _bug(
        "a timestamp that was forgotten is alone when it comes again",
        "zsched.relay.streams.proofs",
        "if self._floor is not None and not self._floor < stamp:",
        "if self._floor is not None and False:",
        ("tests/unit/relay/streams/test_proofs.py",),
    ),
    _bug(
        "nobody asks whether a timestamp is one sample's",
        "zsched.relay.task",
        "is_proof and self._stamps.is_alone(stamp) and",
        "is_proof and",
        (f"{_REPLAY}::test_a_timestamp_that_several_samples_have_proves_none_of_them_done",),
    ),
    _bug(
        "beats in turn wait for a loop that does not come",
        "zsched.adapters.network.control_bus",
        "zenoh.handlers.RingChannel(RING)",
        "zenoh.handlers.FifoChannel(RING)",
        ("tests/parts/adapters/network/test_control_bus.py",),
    ),
    _bug(
        "a relay that does not stay is its own node's secret",
        "zsched.core.profile.profile",
        "profile = replace(profile, progress=progress, relay=relay)",
        "profile = replace(profile, progress=progress)",
        ("tests/unit/core/test_node.py",),
    ),
    _bug(
        "what class latest has lost is put again by nobody",
        SENDER,
        "if not self.may_resend or not self.is_late(now):",
        "if not self.is_whole or not self.may_resend or not self.is_late(now):",
        _HOP,
    ),
    _bug(
        "a late receiver of class latest is sent old values unasked",
        SENDER,
        "            self.resend_from, self.question, self.is_start_due = None, self.count, True",
        "            pass",
        _SENDER,
    ),
    _bug(
        "a late receiver of class latest is sent old values behind a newer one",
        SENDER,
        "elif self.question == self.count:",
        "elif self.question is not None:",
        _SENDER,
    ),
    _bug(
        "one old number takes a jump back",
        RECEIVER,
        "RETURN: Final = 3",
        "RETURN: Final = 1",
        _RECEIVER,
    ),
    _bug(
        "a skip of what is kept no more is not told",
        KEPT,
        "skip=first if first > waits_for else None",
        "skip=None",
        _SENDER,
    ),
    _bug(
        "a relay that is late is sent nothing",
        SHARED,
        "            if self._is_late(one, first, now):",
        "            if self._is_late(one, self.count, now) and False:",
        _HOP,
    ),
    _bug(
        "a relay that asks is told to skip what is kept",
        SHARED,
        "skip=owed.skip if wanted.is_asked else None",
        "skip=until if wanted.is_asked else None",
        _HOP,
    ),
    _bug(
        "what a slower relay lacks is let go of",
        SHARED,
        "self.kept.let_go(min(one.arrived for",
        "self.kept.let_go(max(one.arrived for",
        _HOP,
    ),
    _bug(
        "a relay that comes late finds no beginning",
        SHARED,
        "now - self.began_at < NEWCOMERS_S",
        "now < self.began_at",
        _SHARED,
    ),
    _bug(
        "a relay that lacks much is sent the first part only",
        SHARED,
        "receiver.batch_end = end if end < wanted.until else None",
        "receiver.batch_end = None",
        _SHARED,
    ),
    _bug(
        "a late relay is sent old values of class latest unasked",
        SHARED,
        "is_question = not self.is_whole and one.arrived < self.count",
        "is_question = False",
        _SHARED,
    ),
    _bug(
        "an input is done before the one in front of it",
        HELD,
        "if not owed and not is_unanswered and line is None:",
        "if not owed and not is_unanswered:",
        ("tests/unit/worker/test_debts.py",),
    ),
    _bug(
        "what a relay had in its hand goes with it",
        "zsched.core.hop.books",
        "        at_most_lost=count.at_most_lost + in_hand,\n",
        "",
        _BOOKS,
    ),
    _bug(
        "what a killed relay took since its last count is in no counter",
        BOOKS,
        "closed(count, untold.get(stream, 0))",
        "closed(count)",
        _BOOKS,
    ),
    _bug(
        "the cells of another life are counted once more",
        BOOKS,
        "            if life == found.life  # else no cells had been made yet\n",
        "",
        _BOOKS,
    ),
    _bug(
        "a beginning that no relay gets is in no counter",
        SLOTS,
        "serial if first is None else first",
        "serial",
        ("tests/parts/relay/streams/test_answers.py",),
    ),
    _bug(
        "a full machine that is silent for 0.3 s is taken for a dead one",
        "zsched.worker.snapshot",
        "CONTEST_S if is_whole else math.inf, until",
        "CONTEST_S if is_whole else math.inf if has_come else 0.3, until",
        ("tests/integration/test_snapshot_moves.py",),
    ),
    _bug(
        "an owner of a moment hands on the state that it has not got",
        "zsched.worker.snapshot",
        "        return self._coming > 0 and (",
        "        return self._coming < 0 and (",
        ("tests/integration/test_snapshot_moves.py",),
    ),
    _bug(
        "a standby gives its state for the owner's",
        "zsched.worker.snapshot",
        "self._worked >= epoch - 1",
        "self._worked >= epoch - 9",
        ("tests/integration/test_snapshot_moves.py",),
    ),
    _bug(
        "an owner's next worker begins with the state of before the move",
        "zsched.core.executor.handover",
        "        if epoch == self.role.epoch and self.role.predecessor is not None:\n",
        "        if epoch > self.role.epoch and self.role.predecessor is not None:\n",
        ("tests/unit/core/executor/test_predecessor.py",),
    ),
    _bug(
        "a predecessor whose machine is gone is waited for",
        "zsched.core.executor.handover",
        "        if self.role.predecessor == node:\n",
        "        if self.role.predecessor == node and not self.runs_worker:\n",
        ("tests/unit/core/executor/test_predecessor.py",),
    ),
    _bug(
        "an owner that is told to stop takes its worker's state along",
        "zsched.runtime.leaving",
        "LEAVE_S = 1.5",
        "LEAVE_S = 0.1",
        ("tests/integration/test_snapshot_chain.py",),
    ),
    _bug(
        "what a long job waits for a CPU comes before the job",
        "zsched.worker.jobs",
        "return self._booked_s",
        "return self._waited_s",
        ("tests/parts/worker/test_jobs.py",),
    ),
    _bug(
        "a worker puts the handler of one that has ended back",
        "zsched.worker.worker",
        "behind it\n                signal.signal(number, self._handler_before(number))",
        "behind it\n                signal.signal(number, self._handlers[number])",
        (f"{_WORKER}::test_workers_closed_in_any_order_and_by_any_thread_give_the_signals_back",),
    ),
    _bug(
        "a wait without an end lets no handler run",
        "zsched.latch",
        "timeout=min(SLICE_S, left_s)",
        "timeout=None if timeout_s is None else left_s",
        ("tests/unit/test_latch.py::test_a_signal_that_another_thread_has_releases_the_main_thread",),
    ),
    _bug(
        "a lease drops what has to be processed again",
        INPUTS,
        "            self._backlog.begin(is_settled=not self._is_held and self._first is None)\n",
        "            self._backlog.begin()\n"
        "            if not self._is_held and self._first is None:\n"
        "                self._backlog.settle(is_restored=False, now=monotonic_s())\n",
        (_WORKER,),
    ),
    _bug(
        "a recorder is taken for a worker that is away",
        TASK,
        "if is_counted and not self._tokens.workers(slot.owner, self._task):",
        "if False:",
        _TASK,
    ),
    _bug(
        "a changed file takes the slot that carries away",
        TASK,
        "        self._carry_on()\n",
        "",
        _TASK,
    ),
    _bug(
        "a foreign worker that is back at once gets no kept values",
        TASK,
        " or any(returned)",
        "",
        _TASK,
    ),
    _bug(
        "a worker that no relay sees stays ready",
        "zsched.runtime.crew",
        "if not is_there and supervisor is not None:",
        "if False:",
        ("tests/parts/runtime/test_crew.py",),
    ),
)
