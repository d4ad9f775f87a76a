"""The bugs of electors that change: one for each rule of the fleet register without which something is lost or stuck.

Knows: which text of which module each bug replaces, and which tests may find it. Does not know: how it is planted.
"""

from __future__ import annotations

from typing import Final

from zsched_lab.bugs.core_bugs import ACCEPTOR, AGREEMENT, LEASE, REGISTER, Bug

ROLL, CHANGES = "zsched.core.electorate.roll", "zsched.core.electorate.changes"
FOUNDING, SETTLING = "zsched.core.electorate.founding", "zsched.core.electorate.settling"
VALUES: Final = "zsched.core.values.electorate"
_TESTS: Final = ("tests/unit/core/electorate/test_rules.py",)


def _bug(name: str, module: str, *changes: tuple[str, str], also: Bug | None = None, has_schedules: bool = True) -> Bug:
    return Bug(
        name=name,
        module=module,
        changes=changes,
        tests=_TESTS,
        has_schedules=has_schedules,
        has_changing_electors=True,
        also=also,
    )


def _numbers_bug(name: str, module: str, *changes: tuple[str, str], also: Bug | None = None) -> Bug:
    tests = ("tests/unit/core/vote/test_numbers.py",)
    return Bug(name=name, module=module, changes=changes, tests=tests, has_schedules=False, also=also)


def _fleet_bug(name: str, module: str, *changes: tuple[str, str], has_schedules: bool = True) -> Bug:
    tests = ("tests/unit/core/electorate/test_orders.py", "tests/sim/test_fleet_changes.py")
    return Bug(
        name=name, module=module, changes=changes, tests=tests, has_schedules=has_schedules, has_changing_fleets=True
    )


NUMBERS, DOCUMENTS = "zsched.core.electorate.numbers", "zsched.core.electorate.documents"

ELECTOR_BUGS: tuple[Bug, ...] = (
    _fleet_bug(
        "documents of changes that are under way go",
        NUMBERS,
        ("named = (*state, *roll.proposed)", "named = state"),
        has_schedules=False,
    ),
    _bug(
        "two electors change at once",
        CHANGES,
        ("tuple(sorted((*read.electors, added)", "tuple(sorted((*read.electors[1:], added)"),
    ),
    _bug(
        "electors change on an unsettled value",
        CHANGES,
        ('return "" if read.settled else', 'return "" if read else'),
    ),
    _bug(
        "the last elector is removed",
        CHANGES,
        ('"" if len(read.electors) > 1 else', '"" if read.electors else'),
        has_schedules=False,
    ),
    _bug(
        "a length of leases keeps the number",
        CHANGES,
        (
            "return replace(changed, number=read.number + 1, settled=False, lease_s=lease_s, guard_lease_s=longest)",
            "return replace(changed, lease_s=lease_s, guard_lease_s=longest)",
        ),
        has_schedules=False,
    ),
    Bug(
        name="who settles without waiting forgets the longer lease",
        module=CHANGES,
        changes=(("longest = read.lease_s if self.has_waited else read.guard_lease_s", "longest = read.lease_s"),),
        tests=("tests/unit/core/electorate/test_rules.py",),
        has_schedules=False,
    ),
    Bug(
        name="settled while a task is leased that is not exclusive any more",
        module=SETTLING,
        changes=(("(hold_s(value.guard_lease_s) if is_leased else _guard_s(value))", "_guard_s(value)"),),
        tests=("tests/unit/core/electorate/test_rules.py",),
        has_schedules=False,
    ),
    Bug(
        name="a task that comes back waits for today's lease alone",
        module=LEASE,
        changes=(("max(self.lease_s, self.granted_s, self.guard_lease_s))", "max(self.lease_s, self.granted_s))"),),
        tests=("tests/unit/core/vote/test_lease.py",),
        has_schedules=False,
    ),
    Bug(
        name="a document that is gone at a start is not asked for",
        module="zsched.core.electorate.numbers",
        changes=(
            (
                "        if not self.documents.holds(self.roll.value):\n            self._want(",
                "        if not self.roll.value.document:\n            self._want(",
            ),
        ),
        tests=("tests/unit/core/electorate/test_orders.py",),
        has_changing_fleets=True,
    ),
    _bug(
        "a task that comes back has its old register",
        CHANGES,
        ("number = creations if known is None else known.number", "number = int(task[1:])"),
        ("                creations += 1\n", "                creations = max(creations, int(task[1:]))\n"),
    ),
    _bug(
        "electors answer for registers that the document does not list",
        ROLL,
        (
            "                self._registers.pop(task).close(todo)\n",
            (
                "                old = Creation(task=task, number=self._registers.pop(task).state.creation)\n"
                "                self._registers[task] = self._begin(old)\n"
                "                self._registers[task].count_with(\n"
                "                    self.value.electorate, is_elector=self.is_elector, is_blank=False, now=now\n"
                "                )\n"
            ),
        ),
        ("return creation is not None and creation.number == question.creation", "return True"),
    ),
    _bug(
        "a seat is held by its name alone",
        VALUES,
        ('return self.name == name and self.disk in ("", disk)', "return self.name == name"),
    ),
    _bug(
        "ballots do not carry the disk",
        REGISTER,
        ("incarnation=self._incarnation, disk=self._id", "incarnation=self._incarnation"),
    ),
    _bug(
        "electors answer under a number that they have left",
        ROLL,
        ("        if question.number != value.number:\n", "        if question.number > value.number:\n"),
        also=_bug(
            "",
            REGISTER,
            ("if not is_same and not (is_by_file and self._count.is_founding):", "if False:"),
        ),
    ),
    _bug(
        "another generation's question is answered",
        ROLL,
        ("        if question.generation_id != value.generation_id:\n", "        if not question.generation_id:\n"),
        also=_bug(
            "",
            REGISTER,
            ("if not is_same and not (is_by_file and self._count.is_founding):", "if False:"),
        ),
    ),
    _bug(
        "a learnt fleet value is not on disk before the first answer",
        ROLL,
        ("        self._register.learn(value, todo, now)\n", "        self._register.learn(value, ToDo(), now)\n"),
        ("todo.must_persist = todo.must_beat = True", "todo.must_beat = True"),
    ),
    _bug(
        "an accepted fleet value is handed on",
        ROLL,
        (
            "fleet=self.value if is_behind else None",
            "fleet=None if not is_behind else self.value if self.state.accepted is None else self.state.accepted.value",
        ),
        ("        is_behind = question.number < self.value.number\n", "        is_behind = True\n"),
    ),
    _bug(
        "a lower number learns nothing",
        ROLL,
        ("fleet=self.value if is_behind else None", "fleet=None"),
        ("            todo.fleet.append(AskFleet(peer=asker))\n", "            pass\n"),
        ("            todo.fleet.append(TellFleet(to=(answer.elector,), value=self.value))\n", "            pass\n"),
        has_schedules=False,
    ),
    _bug(
        "settled without identity rounds",
        SETTLING,
        ("registers if register.written_under != value.electorate]", "registers if False]"),
    ),
    _bug(
        "identity rounds of another number count",
        SETTLING,
        ("registers if register.written_under != value.electorate]", "registers if register.written_under is None]"),
    ),
    _bug(
        "identity rounds write nothing",
        REGISTER,
        ("        if is_identity and newest is None:\n", "        if is_identity:\n"),
    ),
    Bug(
        name="all electors settle at once",
        module=ROLL,
        changes=(("self._jitter(), 1 + self._rank())", "self._jitter(), 0)"),),
        tests=("tests/sim/test_members.py",),
        has_schedules=False,
    ),
    Bug(
        name="a fleet value is learnt by anybody's word",
        module=ROLL,
        changes=(("is not None and accepted.value == value\n", "is not None\n"),),
        tests=("tests/unit/core/vote/test_joining.py",),
        has_schedules=False,
    ),
    Bug(
        name="promises of a number serve the next one",
        module=REGISTER,
        changes=(
            (
                "        if running is not None and running.is_ahead:\n            self._round = None",
                "        if running is not None and running.is_ahead:\n            pass",
            ),
        ),
        tests=("tests/unit/core/register/test_register_proposer.py",),
        has_schedules=False,
    ),
    Bug(
        name="a change asks again for what was promised ahead",
        module=REGISTER,
        changes=(
            (
                "            self._read(running, todo, now)\n\n    def prepare_ahead",
                "            self._prepare(todo, now)\n\n    def prepare_ahead",
            ),
        ),
        tests=("tests/unit/core/register/test_register_proposer.py",),
        has_schedules=False,
    ),
    _bug(
        "no guard before settled",
        SETTLING,
        ("return hold_s(value.guard_lease_s) if value.is_exclusive else 0.0", "return 0.0"),
        has_schedules=False,
    ),
    _bug(
        "the guard goes by the new lease alone",
        CHANGES,
        ("longest = max(lease_s, read.guard_lease_s)", "longest = lease_s"),
        has_schedules=False,
    ),
    _bug(
        "settled is said of any number",
        CHANGES,
        ("if read.number == self.number and not read.settled else", "if not read.settled else"),
        has_schedules=False,
    ),
    _bug(
        "what was accepted for an old seat counts for a new one",
        ROLL,
        ("is_blank=seat != self.seat, is_new=True", "is_blank=False, is_new=True"),
    ),
    _bug(
        "a round goes on under a number before",
        REGISTER,
        (
            "            running.phase, running.deadline, running.ballot = _Phase.WAIT, now, None\n\n    def close",
            "            pass\n\n    def close",
        ),
        also=_bug("", ROLL, ("        if question.number != value.number:\n", "        if False:\n")),
    ),
    _bug(
        "another joining's answer counts",
        REGISTER,
        (" and seat.joining == answer.joining", ""),
        has_schedules=False,
    ),
    _bug(
        "the halves of a fleet are recovered as one generation",
        FOUNDING,
        (
            "generation_id=generation_id,\n        parent_id",
            'generation_id=f"{int(before.generation_id, 16) + 1:x}",\n        parent_id',
        ),
    ),
    _bug(
        "recovered tasks keep their registers",
        FOUNDING,
        ("number=before.creations + index", "number=_creation_of(before, task) or index"),
    ),
    _numbers_bug(
        "an elector grants to a beat of another number",
        LEASE,
        ("if self._grants and self._counts_like_us(beat) else None", "if self._grants else None"),
    ),
    _numbers_bug(
        "an elector by the agreed value alone grants at its start",
        LEASE,
        ("math.inf if self.is_in_doubt else self.over_at", "math.inf if self.is_in_doubt else -math.inf"),
    ),
    _numbers_bug(
        "a task that comes with a missing document begins blank",
        NUMBERS,
        ("state=self._recall(creation) or RegisterState(", "state=RegisterState("),
    ),
    _numbers_bug(
        "a node without its document writes only the tasks of its file",
        AGREEMENT,
        ("return self.document is not None", "return bool(self.fleet_value and self.fleet_value.document)"),
    ),
    _numbers_bug(
        "an echo of another number counts",
        LEASE,
        ("beat.lease_terms == self.terms and self._counts_like_us(beat)", "beat.lease_terms == self.terms"),
    ),
    _numbers_bug(
        "an elector with a shorter lease forgets its longer grants when it starts again",
        LEASE,
        (
            "own_s = max((self.lease_s, *(granter.longer_s(now) for granter in self._granters.values())))",
            "own_s = self.lease_s",
        ),
    ),
    _numbers_bug(
        "a clock in doubt ends the guard of a longer grant",
        LEASE,
        ("now + max(least_s, self._hold_s)", "now + least_s"),
    ),
    _numbers_bug(
        "a longer lease counts from a beat of the number before",
        LEASE,
        ("self.first_number = max(self.first_number, self._sent[-1][0] + 1)", "self.first_number += 0"),
    ),
    _numbers_bug(
        "a change of the electors ends the owner's lease",
        LEASE,
        ("        self._kept_until = self.lease_until()\n", ""),
    ),
    _numbers_bug(
        "a grant is guarded with the lease of a later number",
        LEASE,
        (
            "            granter.lease_s = lease_s  # a grant of before is remembered with its own length\n",
            "            granter.lease_s, granter._hold_s = lease_s, hold_s(lease_s)\n",
        ),
    ),
    _numbers_bug(
        "grants are forgotten when their task is removed",
        LEASE,
        (
            "        self._others.clear()\n        for granter",
            (
                "        self._others.clear()\n"
                "        self._granters = {task: one for task, one in self._granters.items() if task in standing}\n"
                "        for granter"
            ),
        ),
    ),
    _numbers_bug(
        "electors change before a document is agreed",
        CHANGES,
        ('    if not read.document:\n        return "no document is agreed yet"\n', ""),
    ),
    _numbers_bug(
        "the first document keeps the number",
        CHANGES,
        (
            "            _renumbered(read, read.electors),\n            document",
            "            replace(read, revision=read.revision + 1),\n            document",
        ),
    ),
    _numbers_bug(
        "a question without a number is answered for ever",
        REGISTER,
        ("not (is_by_file and self._count.is_founding)", "not is_by_file"),
        also=_bug(
            "",
            ROLL,
            (
                "        if value.electorate.is_founding and not question.generation_id:\n",
                "        if not question.generation_id:\n",
            ),
        ),
    ),
    _numbers_bug(
        "the fleet value is not in the state file",
        AGREEMENT,
        ("            fleet_register=self._numbers.state,\n", ""),
    ),
    _numbers_bug(
        "an unasked fleet value is believed",
        AGREEMENT,
        (
            "        if not event.is_answer:\n",
            (
                "        if learnt.fleet is not None and self._numbers.learn(learnt.fleet, todo, now):\n"
                "            self._count_anew()\n"
                "        if not event.is_answer:\n"
            ),
        ),
    ),
    _fleet_bug(
        "an elector accepts a fleet value without its document",
        ROLL,
        ("if not self._holds(question.acceptance.value) and", "if False and"),
    ),
    _fleet_bug(
        "a fleet value is learnt without its document",
        ROLL,
        (
            "        if self._holds(value):\n            self._register.learn",
            "        if True:\n            self._register.learn",
        ),
    ),
    _fleet_bug(
        "a document that nobody has sent is not asked for again",
        DOCUMENTS,
        ("            if now >= self._ask_at[document]:\n", "            if False:\n"),
        ("return min((self._ask_at[document] for document in self._wanted), default=math.inf)", "return math.inf"),
    ),
    _fleet_bug(
        "a promise of the first change is not on disk",
        NUMBERS,
        (
            "return state if self.changed is not None or has_voted else None",
            "return state if self.changed is not None else None",
        ),
    ),
    _fleet_bug(
        "the document of an acceptance is not kept",
        NUMBERS,
        ('"" if accepted is None else accepted.value.document)', '"")'),
        has_schedules=False,
    ),
    _fleet_bug(
        "an elector answers a fleet ballot that is not its asker's",
        ACCEPTOR,
        ("if not self._is_its_own(event.question.ballot, event.asker):", "if False:"),
        has_schedules=False,
    ),
    _fleet_bug(
        "a document leaves an elector out",
        NUMBERS,
        ("gone = [name for name in self.electors if name not in names]", "gone: list[NodeId] = []"),
        has_schedules=False,
    ),
    _fleet_bug(
        "the node keeps its file's electors though others are agreed",
        NUMBERS,
        ("return replace(fleet, electors=value.electorate.names,", "return replace(fleet,"),
        has_schedules=False,
    ),
)
