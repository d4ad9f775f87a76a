"""Bugs of a running node that takes another fleet file over, and of workers that start again one after another.

Knows: as `zsched_lab.bugs.core_bugs`. Does not know: the same.
"""

from __future__ import annotations

from zsched_lab.bugs.core_bugs import Bug

IN_FORCE = "zsched.core.values.in_force"
AGREEMENT, LEASE = "zsched.core.vote.agreement", "zsched.core.vote.lease"
RENEWING, RETUNING = "zsched.core.executor.renewing", "zsched.core.vote.retuning"
ADOPTION, HANDOVER = "zsched.core.values.adoption", "zsched.core.executor.handover"

_FLEET = ("tests/unit/core/node/test_fleet.py",)
_CHANGES = ("tests/sim/test_fleet_changes.py",)
_RENEWING = ("tests/unit/core/executor/test_renewing.py",)


def _bug(name: str, module: str, old: str, new: str, tests: tuple[str, ...]) -> Bug:
    return Bug(name=name, module=module, changes=((old, new),), tests=tests)


ADOPTION_BUGS: tuple[Bug, ...] = (
    _bug(
        "a file's electors count as soon as it is read",
        ADOPTION,
        "counted = old.electors if electors is None else electors",
        "counted = new.electors",
        _FLEET,
    ),
    _bug(
        "a register that goes forgets its promises",
        AGREEMENT,
        "                away[register.state.task] = register.state\n",
        "                pass\n",
        _FLEET,
    ),
    _bug(
        "membership keeps the nodes of the file before",
        IN_FORCE,
        "            _fit(nodes, make, [name for name in self.nodes if name != but])\n",
        "            pass\n",
        _FLEET,
    ),
    _bug(
        "robots vote as by the file before",
        IN_FORCE,
        "        self.voters = self.robots = fleet.voters\n",
        "        self.voters = self.robots = getattr(self, 'voters', fleet.voters)\n",
        _FLEET,
    ),
    _bug(
        "a task that becomes exclusive is granted at once",
        LEASE,
        "until = math.inf if self.is_in_doubt else now + hold_s(max(self.lease_s, self.granted_s, self.guard_lease_s))",
        "until = math.inf if self.is_in_doubt else now",
        _FLEET,
    ),
    _bug(
        "a task that leaves the file keeps its streams",
        HANDOVER,
        "        todo.add(EndTask(task=self.spec.name))\n",
        "",
        _FLEET,
    ),
    _bug(
        "a changed tuning is never proposed",
        RETUNING,
        "            if changed and value.revision > 0 and not self._ahead:\n",
        "            if changed and value.revision < 0 and not self._ahead:\n",
        _FLEET,
    ),
    _bug(
        "who was away undoes what was tuned since",
        RETUNING,
        " and not self._ahead:",
        ":",
        _CHANGES,
    ),
    _bug(
        "a second change loses the first one",
        RETUNING,
        "seen = (*before.seen, before.wanted)",
        "pass",
        ("tests/unit/core/vote/test_retuning.py",),
    ),
    _bug(
        "the register of the fleet keeps the clocks of before",
        IN_FORCE,
        "        return self.timing\n",
        "        return self.__dict__.setdefault('_first', self.timing)\n",
        _CHANGES,
    ),
    _bug(
        "an owner that had to stop forgets its predecessor",
        HANDOVER,
        "            lease_until_s=until_s,\n            predecessor=self._predecessor,",
        "            lease_until_s=until_s,\n            predecessor=self.role.predecessor,",
        ("tests/unit/core/executor/test_predecessor.py",),
    ),
    _bug(
        "the owner starts its worker first",
        RENEWING,
        "    if behind or starting:\n        return Step.WAIT\n",
        "",
        _RENEWING,
    ),
    _bug(
        "two candidates start their workers at the same time",
        RENEWING,
        "return Step.RENEW if is_my_turn and is_quiet and not is_at_work else Step.WAIT",
        "return Step.RENEW if not is_at_work else Step.WAIT",
        _RENEWING,
    ),
    _bug(
        "an owner restarts its worker under its streams",
        RENEWING,
        "    return Step.GIVE_AWAY\n",
        "    return Step.RENEW_IN_PLACE\n",
        _RENEWING,
    ),
    _bug(
        "a profile of before the change is believed",
        RENEWING,
        "file == fleet_file and now >= since + SAME_FILE_S",
        "file == fleet_file",
        _RENEWING,
    ),
    _bug(
        "a node without the file holds up all others",
        RENEWING,
        "        if now >= self._behind_since.setdefault(task, now) + OTHER_FILE_S:\n            return True\n",
        "",
        _RENEWING,
    ),
)
