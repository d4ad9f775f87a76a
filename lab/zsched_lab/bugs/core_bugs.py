"""The bugs that the suite must find: one per rule of the agreement, the lease, membership, vote and handover.

Knows: which text of which module each bug replaces, and which tests may find it. Does not know: how it is planted, the
bugs in relays and workers (`zsched_lab.bugs.stream_bugs`).

A bug is a few words of source. When the source changes so that the words are no longer there, planting fails and says
so: then the bug is written again for the new source.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True, kw_only=True)
class Bug:
    """One planted bug: in ``module`` each of ``changes`` (old text, new text), the old text exactly once."""

    name: str
    module: str
    changes: tuple[tuple[str, str], ...]
    tests: tuple[str, ...] = ()
    """Directed tests that are run when no schedule has found it within its budget."""
    seed: int | None = None
    """A schedule that has found it before: tried first."""
    has_schedules: bool = True
    """Whether the simulator runs the module at all."""
    has_changing_fleets: bool = False
    """Whether schedules of whole nodes whose fleet changes are played (`zsched_lab.sim.fleets`)."""
    has_changing_electors: bool = False
    """Whether schedules of electors that change are played, not those of whole nodes."""
    also: Bug | None = None
    """Its part in another module, for a rule that is kept in two places."""

    @property
    def parts(self) -> tuple[Bug, ...]:
        """What is planted, one module each."""
        return (self,) if self.also is None else (self, *self.also.parts)


CHANGE, BEATS = "zsched.core.values.change", "zsched.core.node.beats"
SEQUENCE, IDENTITY = "zsched.core.values.sequence", "zsched.core.membership.identity"
REGISTER, LEASE, TENURE = "zsched.core.register.register", "zsched.core.vote.lease", "zsched.core.executor.tenure"
HOLD = "zsched.core.values.lease"
SEALING, WITNESS = "zsched.core.executor.sealing", "zsched.core.vote.witness"
NAMESAKES = "zsched.core.membership.namesakes"
BELIEF = "zsched.core.vote.belief"
AGREEMENT, ACCEPTOR = "zsched.core.vote.agreement", "zsched.core.vote.acceptor"
MEMBERSHIP, NODE = "zsched.core.membership.peers", "zsched.core.node.node"
VOTE, VOTING = "zsched.core.vote.tally", "zsched.core.vote.voting"
DECISION, ROUNDS = "zsched.core.scheduler.decision", "zsched.core.scheduler.rounds"
ORDERS, EXPIRY = "zsched.core.node.orders", "zsched.core.vote.expiry"
SCHEDULER, SCORING, USAGE, STANDING, EXECUTOR = (
    "zsched.core.scheduler.judge",
    "zsched.core.scheduler.scoring",
    "zsched.core.scheduler.usage",
    "zsched.core.scheduler.standing",
    "zsched.core.executor.handover",
)

_REGISTER = (
    "tests/sim/test_register_rules.py",
    "tests/unit/core/register/test_register.py",
    "tests/unit/core/register/test_register_proposer.py",
)
_SCHEDULES = ("tests/unit/core/register/test_register_schedules.py",)
_AGREEMENT = ("tests/unit/core/vote/test_agreement.py",)
_JOINING = ("tests/unit/core/vote/test_joining.py",)
_LEASE = ("tests/sim/test_lease_rules.py", "tests/sim/test_exclusive.py")
_GENERATIONS = ("tests/sim/test_generations.py",)
_BEAT_ROOM = ("tests/unit/core/membership/test_beat_room.py",)
_NAMESAKES = ("tests/unit/core/membership/test_namesakes.py",)
_TWINS = ("tests/unit/core/membership/test_twins.py",)
_WITNESS = ("tests/unit/core/vote/test_witness.py",)
_RESTORED = ("tests/sim/test_restored_state.py",)
_ROLLOUT = ("tests/sim/test_exclusive_rollout.py",)
_DOCUMENTS = ("tests/sim/test_fleet_changes.py",)
_NODE_LEASES = ("tests/unit/core/test_node_leases.py",)
_SEALING = ("tests/unit/core/executor/test_sealing.py",)
_MEMBERSHIP = (
    "tests/sim/test_membership_rules.py",
    "tests/unit/core/membership/test_peers.py",
    "tests/sim/test_simulator.py",
)
_NODE = ("tests/unit/core/node/test_node.py",)
_ROUNDS = (
    "tests/sim/test_vote_rules.py",
    "tests/unit/core/scheduler/test_rounds.py",
    "tests/unit/core/vote/test_tally.py",
)
_SCHEDULER = ("tests/unit/core/scheduler/test_judge.py", "tests/unit/core/scheduler/test_scoring.py", "tests/paper")
_BOOKINGS = ("tests/unit/core/scheduler/test_bookings.py",)
_JOB_NEED = ("tests/unit/core/gateway/test_job_need.py",)
_ORPHANS = ("tests/unit/core/scheduler/test_rounds.py",)
_EXECUTOR = ("tests/unit/core/executor/test_handover.py",)
_ORDERS = ("tests/unit/core/node/test_orders.py",)
_EXPIRY = ("tests/unit/core/vote/test_expiry.py",)


def _bug(name: str, module: str, old: str, new: str, tests: tuple[str, ...] = (), seed: int | None = None) -> Bug:
    return Bug(name=name, module=module, changes=((old, new),), tests=tests, seed=seed)


REGISTER_BUGS = (
    _bug(
        "quorum off by one",
        "zsched.core.values.quorum",
        "return count // 2 + 1",
        "return max(count // 2, 1)",
        _REGISTER,
    ),
    _bug(
        "a value that nobody takes stops its task",
        REGISTER,
        "if read != running.unfit or",
        "if read.revision >= 0 or",
        _REGISTER,
    ),
    _bug(
        "an owner that is no candidate any more cannot be learnt",
        BELIEF,
        "value.owner is None or value.owner in names",
        "value.owner is None or value.owner in fleet.task(value.task).candidates",
        _AGREEMENT,
        seed=8008456,
    ),
    _bug(
        "no order is agreed about a task whose owner has left the fleet",
        BELIEF,
        "names = {register.value.owner, *(one.owner for one in known), *(",
        "names = {*(",
        ("tests/unit/core/vote/test_belief.py", "tests/sim/test_pins_of_the_gone.py"),
    ),
    _bug(
        "promise not persisted",
        REGISTER,
        "self._set_state(promised=prepare.ballot)\n            todo.must_persist = True",
        "self._set_state(promised=prepare.ballot)",
        _REGISTER + _SCHEDULES,
    ),
    _bug(
        "acceptance not persisted",
        REGISTER,
        "accepted=accept.acceptance)\n            todo.must_persist = True",
        "accepted=accept.acceptance)",
        _REGISTER + _SCHEDULES,
    ),
    _bug(
        "promises below its promise",
        REGISTER,
        "prepare.ballot < self.state.promised",
        "prepare.ballot.counter < self.state.promised.counter - 9",
        _REGISTER,
    ),
    _bug(
        "accepts below its promise",
        REGISTER,
        "(ballot < self.state.promised or self._highest(",
        "(ballot.counter < self.state.promised.counter - 9 or self._highest(",
        _REGISTER + _SCHEDULES,
    ),
    _bug(
        "accepted value not re-accepted",
        REGISTER,
        "newest = max(accepted, key=lambda held: (held.ballot, self._prevails(held.value)), default=None)",
        "newest = None",
        _REGISTER + _SCHEDULES,
    ),
    _bug(
        "newest by revision instead of ballot",
        REGISTER,
        "key=lambda held: (held.ballot, self",
        "key=lambda held: (-held.value.revision, held.ballot, self",
        _REGISTER + _SCHEDULES,
    ),
    Bug(
        name="own change in the same ballot as a foreign value",
        module=REGISTER,
        changes=(
            (
                "if read.revision > self.value.revision or running.change is None or running.sent is not None:",
                "if running.change is None or running.sent is not None:",
            ),
            (
                "elif running.change.base_revision != read.revision:",
                "elif running.change.base_revision > read.revision:",
            ),
        ),
        tests=_REGISTER + _SCHEDULES,
    ),
    _bug(
        "a retune raises the epoch",
        CHANGE,
        "return replace(read, revision=read.revision + 1, tuning=self.tuning, asked",
        "return replace(read, revision=read.revision + 1, epoch=read.epoch + 1, tuning=self.tuning, asked",
        _REGISTER,
        seed=15,
    ),
    _bug(
        "a change is applied again after an unknown outcome",
        REGISTER,
        "is_identity = running.change is None or running.sent is not None",
        "running.sent = None; is_identity = running.change is None",
        _REGISTER + _SCHEDULES,
    ),
    Bug(
        name="identity rounds skipped",
        module=REGISTER,
        changes=(
            (
                "        if self._is_unlearnt():\n            self._settle_tries = 0",
                "        if False:\n            pass",
            ),
        ),
        tests=_REGISTER + _SCHEDULES,
    ),
    _bug(
        "restart forgets the incarnation",
        REGISTER,
        "counter=self._counter, node=self._me, incarnation=self._incarnation, disk",
        "counter=self._counter, node=self._me, incarnation=0, disk",
        _REGISTER,
    ),
    _bug(
        "learnt value not persisted before routes",
        REGISTER,
        "        todo.must_persist = True\n        self._hand_on",
        "        self._hand_on",
        _REGISTER,
    ),
    Bug(
        name="stranger's answer counts",
        module=REGISTER,
        changes=(
            (
                "answer.ballot != running.ballot or answer.elector not in self._count.names",
                "answer.ballot != running.ballot",
            ),
            ("return seat is not None and seat.is_held_by", "return seat is None or seat.is_held_by"),
        ),
        tests=_REGISTER,
    ),
    _bug(
        "answer to an older ballot counts",
        REGISTER,
        "running is None or answer.ballot != running.ballot or",
        "running is None or",
        _REGISTER,
    ),
    _bug(
        "repeated answer counts twice",
        REGISTER,
        "running.yes[answer.elector] = True",
        'running.yes[f"{answer.elector}/{len(running.yes)}"] = True',
        _REGISTER,
    ),
    _bug(
        "another electorate's ballot is answered",
        REGISTER,
        "if self._count.is_founding and question.electorate != self._electorate:",
        "if not question.electorate:",
        _REGISTER,
    ),
    _bug(
        "node without state is an elector",
        AGREEMENT,
        "is_elector = durable is not None and me in fleet.electors",
        "is_elector = me in fleet.electors",
        _AGREEMENT,
    ),
    _bug(
        "an elector's own round does not tell its leases",
        AGREEMENT,
        "if register.state.learnt is not known:  # our own",
        "if False:  # our own",
        _AGREEMENT,
    ),
    _bug(
        "accepted values are told as learnt",
        AGREEMENT,
        "values = tuple(value for value in self.values().values() if value.revision > 0)",
        "values = tuple(r.state.accepted.value for r in self.registers.values() if r.state.accepted is not None)",
        _AGREEMENT,
    ),
    _bug(
        "refused disk keeps electing",
        AGREEMENT,
        "            self._numbers.roll.stop_electing()",
        "            pass",
        _AGREEMENT,
    ),
    _bug(
        "ballot in another's name is answered",
        ACCEPTOR,
        "return ballot.node == asker and asker in self._in_force.nodes",
        "return True",
        _REGISTER,
        13,
    ),
    _bug(
        "batch in the wrong order",
        NODE,
        "return (*first, *todo.send, *todo.apply)",
        "return (*todo.send, *first, *todo.apply)",
        ("tests/unit/core/test_node_prefixes.py",),
    ),
)

LEASE_BUGS = (
    _bug(
        "an echo of what was not sent yet counts later",
        LEASE,
        "elif grant.number not in self._ahead.get(elector, ()):",
        "else:",
        _LEASE,
    ),
    _bug(
        "numbers that were not sent yet are given back",
        LEASE,
        "if is_its_own and grant.number <= beat.sequence:",
        "if is_its_own:",
        _LEASE,
    ),
    _bug(
        "an elector holds on to a forged number",
        LEASE,
        "if not is_new and not is_newest and self._last is not None and",
        "if not is_new and self._last is not None and",
        _LEASE,
        seed=9003597,
    ),
    _bug(
        "an elector that has echoed a forged number counts no more",
        LEASE,
        "elif grant.number not in self._ahead.get(elector, ()):",
        "elif grant.number > max(self._ahead.get(elector, [-1])):",
        _LEASE,
        seed=9003597,
    ),
    Bug(
        name="echo to an owner that was not accepted",
        module=LEASE,
        changes=(
            ("if accepted is None or accepted[0] != beat.node:", "if accepted is None:"),
            ("if epoch != accepted[1] or self._is_silenced", "if epoch is None or self._is_silenced"),
        ),
        tests=_LEASE,
    ),
    _bug(
        "echo counts before the epoch was learnt",
        LEASE,
        "elif grant.number < self.first_number or grant.number <= self.released:",
        "elif grant.number <= self.released:",
        _LEASE,
    ),
    _bug(
        "grant not honoured after a restart",
        LEASE,
        "if now < self.until and owner != self.standing:",
        "if hold < 0.0:",
        _LEASE,
        114,
    ),
    _bug(
        "silence rule left out",
        LEASE,
        "return self._silent_for == (owner, epoch) and now < self._silent_until",
        "return False",
        _LEASE,
    ),
    _bug(
        "release of another life honoured",
        LEASE,
        "if last is not None and (last.owner, last.incarnation) == key and last.number <= grant.number:",
        "if last is not None and last.owner == grant.owner:",
        _LEASE,
    ),
    _bug(
        "lease from receiving instead of sending",
        LEASE,
        "                self._holders[grant.task].on_echo(beat.node, grant)",
        "                held = self._holders[grant.task]\n"
        "                held.on_echo(beat.node, grant)\n"
        "                held._sent.append((grant.number, now))\n"
        "                held._sent.reverse()",
        _LEASE,
        42,
    ),
    _bug(
        "an empty release is worth a beat at once",
        LEASE,
        "if now - holder.hurried_at < HURRY_S:",
        "if now < holder.hurried_at:",
        _LEASE,
    ),
    _bug(
        "echo of another electorate counts",
        LEASE,
        "is_counted = beat.lease_terms == self.terms and self._counts_like_us(beat)",
        "is_counted = self._counts_like_us(beat)",
        _LEASE,
    ),
    _bug("lease of a minority", LEASE, "number = numbers[needed - 1]", "number = numbers[0]", _LEASE, 26),
    _bug(
        "released number is granted again",
        LEASE,
        "if beat.sequence <= self._released.get((beat.node, beat.incarnation), -1):",
        "if beat.sequence < 0:",
        _LEASE,
    ),
    _bug("next life is granted at once", LEASE, "if self._is_held(beat, now):", "if not epoch:", _LEASE, 30),
    _bug(
        "next owner is granted at once",
        LEASE,
        "if last is None or (last.owner, last.incarnation) == (beat.node, beat.incarnation):",
        "if last is None or last.owner != beat.node or last.incarnation == beat.incarnation:",
        _LEASE,
    ),
    _bug(
        "granted although others need no lease",
        AGREEMENT,
        "and value.owner is not None and value.leased",
        "and value.owner is not None",
        _ROLLOUT,
        150,
    ),
    _bug(
        "worker without a lease is not waited for",
        SEALING,
        "if spec.name in answer.unleased:",
        "if False:",
        _ROLLOUT,
        38,
    ),
    _bug(
        "an owner does not wait for its own worker without a lease",
        SEALING,
        "if self.executors[spec.name].may_work_unleased(now):",
        "if False:",
        _SEALING + _ROLLOUT,
        310003726,
    ),
    _bug(
        "the number of an agreed document is taken for other leases",
        "zsched.core.node.stages",
        "lambda: leases.terms)",
        "lambda at_first=leases.terms: at_first)",
        _DOCUMENTS,
    ),
    _bug(
        "a former owner that is gone is not waited for",
        SEALING,
        "if name not in self._gone or name in owners}",
        "if name not in self._gone}",
        _SEALING,
    ),
    _bug(
        "a worker that was never ready is waited for",
        EXECUTOR,
        "before = self._unleased_epoch\n        self._confirm()",
        "before = self._unleased_epoch",
        _NODE_LEASES,
    ),
    _bug(
        "old fleet file needs no lease",
        EXECUTOR,
        "self.spec.exclusive or allocation.leased",
        "self.spec.exclusive",
        _ROLLOUT,
        42,
    ),
    _bug(
        "a new generation forgets a longer lease",
        "zsched.core.vote.generations",
        "lease_s=0.0 if before is None else before.lease_s",
        "lease_s=0.0",
        ("tests/unit/commands/members/test_init.py",),
        seed=2140,
    ),
    _bug(
        "a new generation waits for the leases of exclusive tasks only",
        LEASE,
        "(is_leased or _is_first(value)) and task.name",
        "is_leased and task.name",
        _ROLLOUT,
    ),
    _bug(
        "a clock in doubt holds up tasks that are not exclusive",
        LEASE,
        "            del self._granters[value.task]\n        elif",
        "            granter.on_newer_value()\n        elif",
        ("tests/unit/core/vote/test_lease.py",),
    ),
    _bug(
        "what a generation's first owner was granted is forgotten",
        LEASE,
        "granter.is_for_first = granter.is_for_first and not value.leased",
        "granter.is_for_first = granter.is_for_first",
        ("tests/unit/core/vote/test_lease.py",),
    ),
    _bug(
        "restart forgets a longer lease",
        LEASE,
        "hold_s(max(self.in_force.timing.lease_s, self.granted_s))",
        "hold_s(self.fleet.timing.lease_s)",
        _ROLLOUT,
    ),
    _bug(
        "restarted elector echoes at once",
        LEASE,
        "        if now < self.until:\n            return True",
        "        if self.lease_s < 0.0:\n            return True",
        _LEASE,
        74,
    ),
    _bug(
        "hold shorter than the lease",
        HOLD,
        "return lease_s * (1 + RHO) / (1 - RHO)",
        "return lease_s * (1 - RHO) / (1 + RHO) - 0.02",
        _LEASE,
        50,
    ),
    _bug(
        "accepts without asking the lease",
        LEASE,
        "return granter is None or granter.may_accept",
        "return True or granter.may_accept",
        (*_LEASE, "tests/unit/core/vote/test_numbers.py"),
    ),
    _bug(
        "identity round ends the silence",
        ACCEPTOR,
        "if isinstance(answer, Accepted) and (known is None or value.revision > known.revision):",
        "if isinstance(answer, Accepted):",
        (*_LEASE, "tests/unit/core/vote/test_parked_accepts.py"),
    ),
    _bug(
        "echoes prolong the wait for a stopped worker",
        TENURE,
        "if now >= self.leases.given_until(task):",
        "if now >= self.leases.until(task):",
        _LEASE,
        60191,
    ),
    _bug(
        "a generation that begins gives back a lease that is in use",
        TENURE,
        "        if value.owner is None:\n",
        "        if value.owner is None and not self.exclusive:\n",
        ("tests/unit/core/executor/test_tenure.py",),
    ),
    _bug(
        "late word of an earlier stop gives a newer lease back",
        LEASE,
        "not holder.is_leaving or holder.expects_late_report:",
        "not holder.is_leaving:",
        _LEASE,
    ),
    _bug(
        "asked to leave only for echoed grants",
        LEASE,
        "if self._sent and self._sent[-1][0] > self.released:",
        "if self._echoed and max(self._echoed.values()) > self.released:",
        _LEASE,
    ),
    _bug(
        "a worker that never says that it has stopped is waited for again and again",
        LEASE,
        "        holder.awaits_report = False  # when it comes",
        "        pass  # when it comes",
        _LEASE,
    ),
)

MEMBERSHIP_BUGS = (
    _bug(
        "a beat does not tell that its elector has lost its state",
        BEATS,
        "    if beat.has_lost_state:\n",
        "    if beat.twins:\n",
        ("tests/unit/core/node/test_status.py", "tests/sim/test_status_words.py", "tests/sim/test_restored_state.py"),
        seed=9000013,
    ),
    _bug(
        "two tokens of one name are twins at their first beats",
        NAMESAKES,
        "if life.stays_s() >= self._beside_s > now - life.at",
        "if self._beside_s > now - life.at",
        _NAMESAKES,
    ),
    _bug(
        "beats of a life without a token make a twin",
        NAMESAKES,
        "        if beat.incarnation not in name.tokens:\n            return False\n",
        "",
        _NAMESAKES,
    ),
    _bug(
        "a twin's later life is this elector's forgotten one",
        WITNESS,
        "if incarnation > self.incarnation and not self._has_twin:",
        "if incarnation > self.incarnation:",
        _WITNESS,
    ),
    _bug(
        "a life that begins after our own start is no twin's",
        WITNESS,
        "self._has_twin |= learnt.node in self._answered and self._is_later(learnt)",
        "self._has_twin |= False",
        _WITNESS,
    ),
    _bug(
        "a twin's life is not compared with our own votes",
        WITNESS,
        "if incarnation >= self.incarnation else self._at_start",
        "if incarnation == self.incarnation else self._at_start",
        _WITNESS,
    ),
    _bug(
        "a slewed clock is believed",
        "zsched.core.vote.clocks",
        "abs(event.error_ratio) > RHO or",
        "abs(event.error_ratio) > 1.0 or",
        ("tests/sim/test_clock_doubt.py",),
    ),
    _bug(
        "a jump of the clock is believed",
        "zsched.core.vote.clocks",
        " or abs(event.jump_s) > JUMP_S + RHO * event.since_s",
        "",
        ("tests/sim/test_clock_doubt.py",),
    ),
    _bug(
        "a beat that is too large is sent whole",
        "zsched.core.membership.beat_room",
        "if beat_bytes(beat) <= MAX_BEAT_BYTES:",
        "if beat.node:",
        _BEAT_ROOM,
        seed=242,
    ),
    _bug(
        "what had no room in a beat has none in the next",
        "zsched.core.membership.beat_room",
        "first = self._next % len(parts)",
        "first = 0",
        _BEAT_ROOM,
    ),
    _bug(
        "a vote in vain loses its task's turn",
        VOTING,
        "            self._first_call_at = now\n",
        "            self.called_at = now\n",
        ("tests/unit/core/scheduler/test_turns.py",),
        seed=598,
    ),
    _bug(
        "a lease that forbids an accept ends its ballot",
        REGISTER,
        "return running.phase is _Phase.ACCEPT and passes.issuperset(running.no.values()) and bool(running.no)",
        "return False",
        ("tests/unit/core/register/test_register_proposer.py",),
    ),
    _bug(
        "who is overtaken ends the accept that waits",
        REGISTER,
        "now < (until := min(self._lease_over_at, self._gives_up_at(running)))",
        "now < (until := -math.inf)",
        ("tests/unit/core/register/test_register_proposer.py", "tests/sim/test_exclusive.py"),
    ),
    _bug(
        "token resurrects a peer",
        BEATS,
        '    node.counters["tokens_seen"] += 1\n',
        '    node.counters["tokens_seen"] += 1\n'
        "    if event.node in node.membership._peers:\n"
        "        node.membership._change(event.node, PeerState.ALIVE, 'token', now)\n"
        "        node.membership._peers[event.node].beat_at = now\n",
        (*_MEMBERSHIP, "tests/unit/core/node/test_node.py"),
    ),
    _bug(
        "vouching ignored",
        MEMBERSHIP,
        "any(at.beat_at > peer.suspect_since for _, at in self._observers(name))",
        "any(at.beat_at < 0.0 for _, at in self._observers(name))",
        _MEMBERSHIP,
    ),
    _bug("suspicion never confirmed", MEMBERSHIP, 'return "nobody speaks for it"', 'return ""', _MEMBERSHIP),
    _bug(
        "second observer not needed",
        MEMBERSHIP,
        "if name in observer.accuses)",
        "if observer.accuses or True)",
        _MEMBERSHIP,
    ),
    _bug(
        "older life's beats count",
        SEQUENCE,
        "if self.incarnation < 0 or (may_begin and incarnation != self.incarnation):",
        "if self.incarnation < 0 or incarnation != self.incarnation:",
        _MEMBERSHIP,
    ),
    _bug(
        "any number ahead is believed",
        SEQUENCE,
        "0 < ahead <= WINDOW + RATE_HZ * (now - self.at)",
        "0 < ahead",
        _MEMBERSHIP,
    ),
    _bug(
        "a number that was overtaken never counts again",
        SEQUENCE,
        "return other.count >= RUN",
        "return False",
        _MEMBERSHIP,
    ),
    _bug(
        "restored state votes on",
        AGREEMENT,
        'self._lose(why if self._is_of_our_seat(learnt) else "", todo)',
        "pass",
        _RESTORED,
        2,
    ),
    _bug(
        "votes of an earlier life are not compared",
        WITNESS,
        'if votes > known else ""',
        'if votes > known + 10**9 else ""',
        _RESTORED,
    ),
    _bug("starting elector asks nobody", WITNESS, "return is_enough and (", "return True or (", _RESTORED),
    _bug(
        "node without state proposes by generation 0",
        AGREEMENT,
        "self.registers[task.name].follow(self._by_file, initial",
        "self.registers[task.name].follow(self._electorate, initial",
        _GENERATIONS,
        26,
    ),
    _bug("a put teaches an allocation", AGREEMENT, "if not event.is_answer:", "if False:", _AGREEMENT),
    _bug("any answer is believed", AGREEMENT, "elif is_proven(", "elif True or is_proven(", _AGREEMENT),
    _bug("beats alone dispute a name", IDENTITY, " if beat.incarnation in self._tokens else Verdict.TWIN", "", _NODE),
    _bug(
        "of twins the older one leaves",
        IDENTITY,
        "(my_sequence, -self.incarnation) < (sequence, -incarnation)",
        "(my_sequence, -self.incarnation) > (sequence, -incarnation)",
        _TWINS,
    ),
    _bug(
        "an echo that does not rise is a twin",
        IDENTITY,
        "if sequence <= self._twin[1]:",
        "if sequence < self._twin[1]:",
        _TWINS,
    ),
    _bug(
        "one answer of a peer proves a twin",
        IDENTITY,
        "return verdict if is_lasting else Verdict.TWIN",
        "return verdict",
        _TWINS,
    ),
    _bug(
        "a twin that has left disputes the name of who stood still meanwhile",
        IDENTITY,
        "min(now - self._twin[2], lived_s) >= STAYS_S",
        "now - self._twin[2] >= STAYS_S",
        _TWINS,
    ),
    _bug(
        "the first node heard after a cut speaks for nobody",
        MEMBERSHIP,
        "if is_back and before is PeerState.GONE:",
        "if is_back and before is PeerState.ALIVE:",
        _MEMBERSHIP,
    ),
    _bug(
        "the old link's token accuses a node that has just come back",
        MEMBERSHIP,
        "if now < peer.back_at + self._timing.control_lease_s:",
        "if now < peer.back_at:",
        _MEMBERSHIP,
    ),
    _bug(
        "a node without memory speaks for those it has not heard yet",
        MEMBERSHIP,
        "before, is_back = peer.state, peer.has_been_gone and not restarted",
        "before, is_back = peer.state, peer.has_been_gone",
        _MEMBERSHIP,
    ),
    _bug(
        "a minority's wish waits for the network to heal",
        DECISION,
        "heard >= majority(len(electors)):",
        "heard >= 1:",
        _ROUNDS,
    ),
)

VOTE_BUGS = (
    _bug(
        "an accept waits for a lease although it came with others",
        AGREEMENT,
        "self.acceptor.on_accept(yes, todo, now, park_s=0)",
        "self.acceptor.on_accept(yes, todo, now)",
        _JOINING,
    ),
    _bug(
        "a question that had no success together is asked together again",
        REGISTER,
        "return running.change is None and not running.is_alone",
        "return running.change is None",
        _JOINING,
    ),
    _bug(
        "each question of a frame counts at the rate",
        AGREEMENT,
        "self.acceptor.on_prepare(promise, todo, now, may_ask=may_ask)",
        "self.acceptor.on_prepare(promise, todo, now)",
        _JOINING,
    ),
    Bug(
        name="stale proposal counted",
        module=VOTING,
        changes=(
            ("if proposal.base_revision != allocation.revision:\n            return False", "pass"),
            ("and proposal.base_revision == allocation.revision", ""),
        ),
        tests=_ROUNDS,
    ),
    _bug(
        "escape ignores the quorum",
        VOTE,
        "needed = max(min(needed, majority(len([voter for voter in voters if voter in present]))), 1)",
        "needed = 1",
        _ROUNDS,
    ),
    Bug(
        name="commit without supporters",
        module=VOTING,
        changes=(
            (
                "if self._me not in supporters or counted.winner is None:\n            return\n",
                "supporters.append(self._me)\n        if counted.winner is None:\n            return\n",
            ),
            ("reason=fresh[self._me].reason", "reason=counted.reason"),
        ),
        tests=_ROUNDS,
    ),
    Bug(
        name="a vote that stays is committed",
        module=VOTING,
        changes=(("if counted.outcome is VoteOutcome.WON:", "if counted.winner is not None:"),),
        tests=("tests/unit/core/vote/test_epochs.py",),
        seed=44,
        also=_bug(
            "a move to the owner raises the epoch",
            CHANGE,
            "if self.owner == read.owner:",
            "if False:",
            _REGISTER,
        ),
    ),
    _bug(
        "called vote ignored",
        VOTING,
        "return self._me in self._voters and self.commit is None and (",
        "return False and (",
        _ROUNDS,
    ),
    _bug(
        "a robot at rest goes by its first answers for ever",
        ROUNDS,
        " or now >= kept.at + self._in_force.timing.profile_ttl_s",
        "",
        _ROUNDS,
    ),
    _bug(
        "a robot that sees a change goes by the answers from before it",
        ROUNDS,
        " and is_like(own, kept.vectors[self._me])",
        "",
        _ROUNDS,
    ),
    _bug(
        "a move is free",
        SCHEDULER,
        "if more_s < price_s:",
        "if more_s < 0.0:",
        _SCHEDULER,
    ),
    _bug(
        "cap of moves forgotten",
        SCHEDULER,
        "return None if done < limit else f",
        "return None if done < 10 * limit else f",
        ("tests/unit/core/scheduler/test_fuse.py",),
    ),
    _bug(
        "bonus twice",
        SCHEDULER,
        "worth[owner] += allocation.tuning.bonus",
        "worth[owner] += 2 * allocation.tuning.bonus",
        _SCHEDULER,
    ),
    _bug(
        "unreachable left out instead of 0",
        SCORING,
        "utilities += [Utility(candidate=name, value=0.0, reachable=False) for name in unreachable]",
        "pass",
        _SCHEDULER,
    ),
    _bug(
        "a young suspicion takes the owner for unreachable",
        SCORING,
        "state is PeerState.ALIVE or (is_owner and candidate in doubts.in_grace)",
        "state is PeerState.ALIVE",
        (*_SCHEDULER, "tests/sim/test_vote_rules.py"),
    ),
    _bug(
        "a node that is back gets a task before its streams are proven",
        "zsched.core.scheduler.eligibility",
        'return "" if case.is_owner else case.doubts.unproven.get(case.node, "")',
        'return ""',
        (*_SCHEDULER, "tests/sim/test_return.py"),
    ),
    _bug(
        "who beats is reached by streams",
        SCORING,
        "(not is_there or candidate in doubts.unseen) and",
        "not is_there and",
        _SCHEDULER,
    ),
    _bug(
        "a token of a task that we do not know yet is missed",
        "zsched.core.node.work",
        "    node.probation.on_token(event.node",
        "    _ = event.task in node.executors and node.probation.on_token(event.node",
        ("tests/unit/core/node/test_status.py",),
    ),
    _bug(
        "a worker that has nothing more to do lacks what it lacked before",
        "zsched.core.profile.jobs",
        "if newest.is_idle and undone <= 0:",
        "if newest.is_idle and undone < 0:",
        ("tests/unit/core/profile/test_jobs.py", "tests/unit/core/test_closed_loop.py"),
    ),
    _bug(
        "an owner without work gives the task nothing",
        SCORING,
        "load is not None and is_short(load)",
        "load is not None",
        ("tests/unit/core/test_closed_loop.py",),
    ),
    _bug(
        "a candidate gains by a far robot that leaves it out",
        STANDING,
        "return whole if len(whole) >= majority(len(rows)) else rows",
        "return rows",
        ("tests/unit/core/scheduler/test_compare.py",),
    ),
    _bug(
        "a task that has just come uses no GPU yet",
        USAGE,
        'readings["gpu"] + coming, own',
        'readings["gpu"], own',
        ("tests/unit/core/scheduler/test_turns.py",),
    ),
    _bug(
        "a task that has come to a GPU counts twice there",
        USAGE,
        "profile.node, now, GPU_SHOWS_S)",
        "profile.node, now, 1e9)",
        _BOOKINGS,
    ),
    _bug(
        "a worker that has failed keeps what it had learnt booked",
        USAGE,
        "other.demand if load.state is WorkerState.FAILED else gateway.demand(other, profile)",
        "gateway.demand(other, profile)",
        _BOOKINGS,
    ),
    _bug(
        "a full machine's crowd is work of a job of several threads",
        "zsched.core.gateway.job_need",
        "return cpu_s if is_calm or known is None else",
        "return cpu_s if known is None or known is not None else",
        _JOB_NEED,
    ),
    _bug(
        "what a job of several threads waits for is nothing",
        "zsched.core.gateway.job_need",
        "waits_s = _for_others(jobs.time_s - cpu_s, known, is_calm=is_calm)",
        "waits_s = 0.0",
        _JOB_NEED,
    ),
    _bug(
        "a queue behind a wait for a GPU is as short as one behind work alone",
        "zsched.core.gateway.job_need",
        "        holds_turn=True,\n",
        "",
        _JOB_NEED,
    ),
    _bug(
        "the work of a worker that was killed hangs in the next one",
        "zsched.core.node.work",
        "        node.profiler.note_end(event.task)",
        "        pass",
        ("tests/unit/core/node/test_node.py",),
    ),
    _bug(
        "a task that nobody has keeps the margin of its limits",
        "zsched.core.scheduler.eligibility",
        "has_margin=True) if case.is_kept and not case.is_owner else",
        "has_margin=True) if not case.is_owner else",
        ("tests/unit/core/scheduler/test_scoring.py",),
    ),
    _bug(
        "a task on its way home is told to wait for others' worth",
        "zsched.core.scheduler.explain",
        "    if is_away and verdict.outcome == Outcome.WAIT:",
        "    if False:",
        ("tests/unit/core/scheduler/test_explain.py",),
    ),
    _bug(
        "one extreme profile makes a need that no demand may be",
        "zsched.core.gateway.demand",
        "min((known.work or 0.0) / speed_of(profile), MAX_CPU_CORES)",
        "(known.work or 0.0) / speed_of(profile)",
        (*_BOOKINGS, *_JOB_NEED, "tests/unit/core/gateway/test_demand.py"),
    ),
    _bug(
        "tasks that lose one owner together all go where one fits",
        "zsched.core.scheduler.claims",
        "if name != mine}",
        "if name == mine}",
        _ORPHANS,
    ),
    _bug(
        "a claim takes a task's only place",
        "zsched.core.scheduler.decision",
        "return rest if rest.aggregates.keys() - {figures.allocation.owner} else standing",
        "return rest",
        (*_ORPHANS, "tests/sim/test_orphans.py"),
    ),
    _bug(
        "a claim takes the place of a task that is pinned hard",
        "zsched.core.scheduler.decision",
        "if figures.allocation.is_bound:",
        "if not figures.rules.candidates:",
        _ORPHANS,
    ),
    _bug(
        "a pin holds a task on a machine that was never heard",
        "zsched.core.scheduler.judge",
        " and not (is_unheard and winner != home)",
        "",
        _SCHEDULER,
    ),
    _bug(
        "a vote that others have won takes no room",
        VOTING,
        "if now < self.awaited_until and self.tally is not None:",
        "if now < self.awaited_until and self.tally is None:",
        _ORPHANS,
    ),
    _bug(
        "each robot judges orphans in an order of its own",
        "zsched.core.scheduler.rounds",
        "return [*sorted(lost), *(name for name in in_turn(self._turns) if name not in lost)]",
        "return in_turn(self._turns) or sorted(lost)",
        _ORPHANS,
    ),
    _bug(
        "what a task's processes do not show of its memory counts twice",
        USAGE,
        "    if is_at_work:\n        memory = max(",
        "    if is_at_work and memory is None:\n        memory = max(",
        ("tests/unit/core/scheduler/test_scoring.py", "tests/unit/core/test_closed_loop.py"),
    ),
    _bug(
        "a task's thread that waits is somebody else's",
        "zsched.core.gateway.sharing",
        "    if load.runnable is not None:",
        "    if load.runnable == -1.0:",
        ("tests/unit/core/gateway/test_sharing.py", "tests/unit/core/test_closed_loop.py"),
    ),
    _bug(
        "what a machine did not keep is forgotten when the task leaves",
        "zsched.core.scheduler.kept",
        "found[name] -= (promised - gave) * 0.5 ** (max(now - at, 0.0) / memory_s)",
        "pass",
        ("tests/unit/core/scheduler/test_kept.py", "tests/unit/core/test_closed_loop.py"),
    ),
    _bug(
        "what a machine did not keep counts whatever it promises",
        "zsched.core.scheduler.kept",
        "gave < promised and abs(found.get(name, math.inf) - promised) <= SAME_WORTH",
        "gave < promised and name in found",
        ("tests/unit/core/scheduler/test_kept.py",),
    ),
    _bug(
        "a machine that the file prefers is worth no more",
        "zsched.core.scheduler.judge",
        "value + head_starts.get(name, 0.0)",
        "value",
        ("tests/unit/core/test_closed_loop_tasks.py",),
    ),
    _bug(
        "tasks that spread keep together",
        "zsched.config.tasks",
        "beside[task] = -(held.value or 0.0)",
        "beside[task] = held.value or 0.0",
        ("tests/unit/config/test_load.py",),
    ),
    _bug(
        "a task of less priority holds its place",
        "zsched.core.scheduler.usage",
        "if other.priority < spec.priority:",
        "if other.priority > spec.priority:",
        ("tests/unit/core/test_closed_loop_tasks.py",),
    ),
    _bug(
        "a machine that fails at once, again and again, counts as if it had failed once",
        "zsched.core.scheduler.kept",
        "if before is None or before[2] <= now:",
        "if True:",
        ("tests/unit/core/scheduler/test_kept.py",),
    ),
    _bug(
        "a load that comes is a promise that was not kept",
        "zsched.core.scheduler.kept",
        "(max if now - self.since >= RISES_S else min)(gave, before[1])",
        "min(gave, before[1])",
        ("tests/unit/core/scheduler/test_kept.py",),
    ),
    _bug(
        "a task's own thread takes from its share where it runs",
        "zsched.core.gateway.sharing",
        "max(profile.runnable - own + coming_cores, 0.0)\n",
        "max(profile.runnable + coming_cores, 0.0)\n",
        ("tests/unit/core/gateway/test_sharing.py", "tests/unit/core/test_closed_loop.py"),
    ),
    _bug(
        "a slow machine's queue is as short as a quick one's",
        "zsched.core.gateway.job_need",
        "self.queueing * crowd(self.hz * (held_s + cpu_s))",
        "self.queueing * crowd(self.hz * self.work_s)",
        ("tests/unit/core/gateway/test_job_need.py", "tests/unit/core/test_closed_loop.py"),
    ),
    _bug(
        "what comes is taken off the share of an owner that is short",
        SCORING,
        "least=min(fair, own), share",
        "least=0.0, share",
        ("tests/unit/core/scheduler/test_bookings.py", "tests/unit/core/test_closed_loop_tasks.py"),
    ),
    _bug(
        "an owner that is gone leaves its memory's veto behind",
        SCORING,
        "needed = demand if is_comer else spec.demand",
        "needed = demand",
        ("tests/unit/core/scheduler/test_scoring.py",),
    ),
    _bug(
        "a foreign worker's demand counts beside its use",
        "zsched.core.scheduler.usage",
        "unshown = 1.0 if other.worker.command else gateway",
        "unshown = 1.0 if other.worker is not None else gateway",
        ("tests/unit/core/scheduler/test_bookings.py",),
    ),
    _bug(
        "a need is kept for as long as the machine is full",
        "zsched.core.gateway.demand",
        "not is_calm and not _gets_all(load, load.cpu_cores)",
        "not is_calm",
        ("tests/unit/core/gateway/test_demand.py",),
    ),
    _bug(
        "a program that was tried on one node makes it slow",
        "zsched.core.node.fleet",
        "((before.worker_on(node), after.worker_on(node)) for",
        "((before.worker, after.worker) for",
        ("tests/unit/core/node/test_fleet.py",),
    ),
    _bug(
        "a foreign worker's word of its jobs stays at home",
        "zsched.core.profile.profile",
        "(self._told(task, state) if is_measured else WorkerLoad(task=task, state=state)),",
        "WorkerLoad(task=task, state=state),",
        ("tests/unit/core/profile/test_profile.py",),
    ),
    _bug(
        "late jobs are worth nothing",
        "zsched.core.scheduler.utility",
        "return LATE_WORTH + (1.0 - LATE_WORTH) * on_time_ratio",
        "return on_time_ratio",
        ("tests/unit/core/scheduler/test_latency.py",),
    ),
    _bug(
        "an account holds more than a move costs above the least",
        "zsched.core.scheduler.ledger",
        "min(one - least, price_s if name == owner else ELSEWHERE * price_s)",
        "one - least",
        ("tests/unit/core/scheduler/test_ledger.py",),
    ),
    _bug(
        "a call to a vote outlives its value",
        "zsched.core.scheduler.rounds",
        "        task.is_called = task.is_called_escape = False  # a call is to a vote on the value before\n",
        "",
        ("tests/unit/core/scheduler/test_rounds.py",),
    ),
    _bug(
        "a signal that scatters about nu moves a task there and back",
        "zsched.core.scheduler.scoring",
        "margin_db = REACH_MARGIN_DB\n",
        "margin_db = 0.0\n",
        ("tests/unit/core/scheduler/test_scoring.py",),
    ),
    _bug(
        "each robot asks for a margin, though too few reach the owner",
        STANDING,
        "allocation.owner is not None and (lost_for_s < LOST_S or reaches_owner(spec, allocation, vectors)):",
        "allocation.owner is not None:",
        ("tests/unit/core/scheduler/test_scoring.py",),
    ),
    _bug(
        "an owner whose clock is in doubt is left like one that is only worse",
        "zsched.core.scheduler.judge",
        "if veto is not None and veto.filter is Filter.LEASE:",
        "if False:",
        ("tests/sim/test_clock_doubt.py",),
    ),
    _bug(
        "electors that an owner does not hear count for its lease",
        "zsched.core.vote.lease",
        "count = sum(not are_apart(node, elector) for elector in granting)",
        "count = len(granting)",
        ("tests/sim/test_lease_reach.py",),
    ),
    _bug(
        "an owner that says that it rests keeps its task",
        "zsched.core.scheduler.eligibility",
        "    Filter.RESTS: _rests,\n",
        "",
        ("tests/sim/test_lease_reach.py",),
    ),
    _bug(
        "each absence of an owner's worker has a start-up time of its own",
        "zsched.core.values.absence",
        "self.since = now - self.held_s(limit_s)",
        "self.since = now",
        ("tests/unit/core/values/test_absence.py", "tests/unit/core/scheduler/test_judge.py"),
    ),
    _bug(
        "what has been away for long is never forgiven",
        "zsched.core.values.absence",
        "min(self.total_s + min(away_s, limit_s), 2.0 * limit_s)",
        "self.total_s + min(away_s, limit_s)",
        ("tests/unit/core/values/test_absence.py",),
    ),
    _bug(
        "an owner whose lease comes and goes never says that it rests",
        TENURE,
        "self._absences[value.task] = value.epoch, absences",
        "self._absences[value.task] = value.epoch, absences if self.leases.until(value.task) <= now else Absences()",
        ("tests/sim/test_lease_reach.py",),
    ),
    _bug(
        "a candidate whose token comes and goes gets the task between two absences",
        "zsched.core.scheduler.unseen",
        "found |= comes_and_goes",
        "pass",
        ("tests/unit/core/scheduler/test_unseen.py",),
    ),
    _bug(
        "candidates whose tokens come and go get nothing though nobody has the task",
        "zsched.core.scheduler.unseen",
        "if is_ours or (owner is not None and is_seen.get(owner) and owner not in comes_and_goes):",
        "if comes_and_goes:",
        ("tests/unit/core/scheduler/test_unseen.py",),
    ),
    _bug(
        "an owner whose token comes and goes is left when it comes back",
        "zsched.core.scheduler.unseen",
        " and owner not in comes_and_goes):",
        "):",
        ("tests/unit/core/scheduler/test_unseen.py",),
    ),
    _bug(
        "a drain waits for a candidate whose token comes and goes",
        "zsched.core.node.stages",
        "stays = None if owner in left or (told is not None and told.draining) else owner",
        "stays = owner",
        ("tests/sim/test_unseen_streams.py",),
    ),
    _bug(
        "the only robot gives its task to an edge that no stream of it reaches",
        "zsched.core.scheduler.unseen",
        "if is_enough or any(is_seen.values())",
        "if any(is_seen.values())",
        ("tests/unit/core/scheduler/test_unseen.py",),
    ),
    _bug(
        "each robot that can do the task itself must see the others' workers",
        "zsched.core.node.stages",
        " and self.in_force.voters == (self.me,)",
        "",
        ("tests/sim/test_unseen_streams.py",),
    ),
    _bug(
        "a margin keeps the task on a machine far beyond its limit",
        SCORING,
        "self._is_kept = is_kept and is_within",
        "self._is_kept = is_kept",
        ("tests/unit/core/scheduler/test_scoring.py",),
    ),
    _bug(
        "absences of a longer start-up time count by a shorter one",
        "zsched.core.scheduler.judge",
        "None if since is None else since + self.held_s)",
        "since, self.absences.total_s, self.absences.back_at)",
        ("tests/unit/core/scheduler/test_judge.py",),
    ),
    _bug(
        "threads that came with a worker nobody measures are others'",
        "zsched.core.gateway.sharing",
        "own = max(need_cores, 0.0 if known is None or known.own is None else known.own)",
        "own = need_cores",
        ("tests/unit/core/gateway/test_sharing.py",),
    ),
    _bug(
        "a task that no other machine has room for has a spare",
        "zsched.core.node.status",
        "if is_ready and (lack is None or lack.filter not in OF_MACHINE):",
        "if is_ready:",
        ("tests/unit/core/node/test_status.py",),
    ),
    _bug(
        "a profile that comes late gives an owner's worker its start-up time again",
        "zsched.core.scheduler.judge",
        "self.absences.skip(now)",
        "self.absences = _of_worker()",
        ("tests/unit/core/scheduler/test_judge.py",),
    ),
    _bug(
        "an owner that is reached for a moment is not lost for its whole time",
        "zsched.core.scheduler.judge",
        "return self.lost.look(not is_reached, now, LOST_S)",
        "self.lost = Absences() if is_reached else self.lost\n"
        "        return self.lost.look(not is_reached, now, LOST_S)",
        ("tests/unit/core/scheduler/test_judge.py",),
    ),
    _bug(
        "an owner that cannot have its task loses nothing",
        "zsched.core.scheduler.judge",
        "{name: 1.0 - worth.get(name, least) for name in sorted(names)}",
        "{name: 1.0 - worth.get(name, 1.0) for name in sorted(names)}",
        ("tests/unit/core/scheduler/test_judge.py",),
    ),
    _bug(
        "a task goes back over a margin to an owner that can hold no lease",
        SCORING,
        "may_keep = owner in spec.candidates and owner not in doubts.unfit",
        "may_keep = owner in spec.candidates",
        ("tests/sim/test_clock_doubt.py", "tests/unit/core/scheduler/test_scoring.py"),
    ),
    _bug(
        "where nobody measures what is weighed nobody gets the task",
        SCORING,
        "value = 1.0 if are_alike else total",
        "value = total",
        ("tests/unit/core/scheduler/test_scoring.py",),
    ),
    _bug(
        "a drained owner keeps a task that would come back over a weak link",
        SCORING,
        "is_kept = has_owner and owner not in doubts.left and may_return(spec, told)",
        "is_kept = has_owner",
        ("tests/unit/core/scheduler/test_scoring.py",),
    ),
    _bug(
        "a robot's own weak signal keeps a task on a full edge",
        SCORING,
        "own_margin_db = margin_db if of_owner is None or of_owner.is_direct else 0.0",
        "own_margin_db = margin_db",
        ("tests/unit/core/scheduler/test_scoring.py",),
    ),
    _bug(
        "memory that no process shows counts twice for a task without a place",
        "zsched.core.scheduler.usage",
        "max(hidden_mb - _unseen_mb(spec, profile, own), 0.0)",
        "hidden_mb",
        ("tests/unit/core/scheduler/test_turns.py",),
    ),
    _bug(
        "a quick machine that is gone sets the need",
        "zsched.core.gateway.gateway",
        "heard_now = (self.fresh(name, now) for name in candidates)",
        "heard_now = (self._profiles[name][0] for name in candidates if name in self._profiles)",
        ("tests/unit/core/gateway/test_gateway.py",),
    ),
    _bug(
        "a profile waits for its hearer's next deadline",
        "zsched.core.node.choice",
        "is_news=node.profiler.has_news or has_deadlines",
        "is_news=node.profiler.has_news",
        ("tests/unit/core/node/test_node.py",),
    ),
    _bug(
        "what a slow core leaves undone is no need",
        "zsched.core.gateway.demand",
        "        return replace(known, work=told, is_sure=False)\n    return",
        "        return replace(known, work=use, is_sure=False)\n    return",
        ("tests/unit/core/gateway/test_demand.py",),
    ),
)

HANDOVER_BUGS = (
    _bug(
        "epoch compared with >=",
        EXECUTOR,
        "        if allocation.epoch == self.epoch:\n            if",
        "        if self.epoch < 0:\n            if",
        _EXECUTOR,
    ),
    _bug(
        "drain ends the gate too early",
        EXECUTOR,
        "        if not self._old:\n            self._go(Phase.SETTLED, RoutePhase.CLOSE, done, todo, took_s)",
        "        if True:\n            self._go(Phase.SETTLED, RoutePhase.CLOSE, done, todo, took_s)",
        _EXECUTOR,
    ),
    _bug(
        "closes a slot that drains when the task moves again",
        EXECUTOR,
        "            self._old = (*self._old, _Old(self._current))[-MAX_OLD:]",
        "            self._old = (_Old(self._current),)",
        _EXECUTOR,
    ),
    _bug(
        "flips for another epoch's readiness",
        EXECUTOR,
        "if epoch == self.epoch and self.phase is Phase.PREPARING:",
        "if self.phase is Phase.PREPARING:",
        _EXECUTOR,
    ),
)

ORDER_BUGS = (
    _bug(
        "a paused task escapes",
        SCHEDULER,
        "        if allocation.paused:\n            return Outcome.STAY",
        "        if allocation.paused and escape is None:\n            return Outcome.STAY",
        _SCHEDULER,
        seed=1,
    ),
    _bug(
        "a hard pin gives way",
        SCHEDULER,
        "(not allocation.is_bound or name in (home, owner))",
        "(not allocation.is_bound or owner is not None or name in (home, owner))",
        _SCHEDULER,
        seed=7,
    ),
    _bug(
        "a pin keeps an owner that is gone",
        SCHEDULER,
        "        if leaving is not None:\n            return Outcome.PROPOSE, leaving",
        "        if leaving is not None and allocation.home is None:\n            return Outcome.PROPOSE, leaving",
        _SCHEDULER,
    ),
    _bug(
        "a pinned task goes home at once",
        SCHEDULER,
        "if fit_s >= FIT_S else Outcome.WAIT",
        "if fit_s >= 0.0 else Outcome.WAIT",
        _SCHEDULER,
    ),
    _bug(
        "an order moves a pinned task elsewhere",
        ORDERS,
        "if value.home is not None and target != value.home:",
        "if value.home is not None and target == value.home:",
        _ORDERS,
    ),
    _bug(
        "an order for an older revision is taken",
        ORDERS,
        "if base_revision not in (None, revision):",
        "if base_revision is not None and base_revision > revision:",
        _ORDERS,
    ),
    _bug(
        "an ordered move counts in the fuse",
        "zsched.core.scheduler.rounds",
        "if left is None or is_ordered:",
        "if left is None:",
        _ORDERS,
    ),
    _bug(
        "an order never ends by itself",
        EXPIRY,
        "return for_s is not None and since is not None and now >= since + for_s",
        "return for_s is not None and since is None",
        _EXPIRY,
    ),
    _bug(
        "a newer revision makes an order young again",
        EXPIRY,
        "{key: before.get(key, now) for key in held}",
        "dict.fromkeys(held, now)",
        _EXPIRY,
    ),
    _bug(
        "a change of orders raises the epoch",
        CHANGE,
        "            revision=read.revision + 1,\n            pin=self.pin,",
        "            revision=read.revision + 1,\n            epoch=read.epoch + 1,\n            pin=self.pin,",
        _ORDERS,
        seed=1,
    ),
)

CORE_BUGS: tuple[Bug, ...] = (
    *REGISTER_BUGS,
    *LEASE_BUGS,
    *MEMBERSHIP_BUGS,
    *VOTE_BUGS,
    *HANDOVER_BUGS,
    *ORDER_BUGS,
)
