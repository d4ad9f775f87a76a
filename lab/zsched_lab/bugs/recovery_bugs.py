"""The bugs of recovery: one for each rule without which halves of a fleet mix, or an owner of before works beside one.

Knows: which text of which module each bug replaces, and which tests may find it. Does not know: how it is planted.
"""

from __future__ import annotations

from typing import Final

from zsched_lab.bugs.core_bugs import AGREEMENT, LEASE, Bug

RECOVERY: Final = "zsched.core.electorate.recovery"
STRANGERS: Final = "zsched.core.electorate.strangers"
ON_DISK: Final = "zsched.commands.members.recovery"
NUMBERS: Final = "zsched.core.electorate.numbers"
BEATS: Final = "zsched.core.node.beats"
_UNIT: Final = "tests/unit/core/electorate/"


def _bug(name: str, module: str, *changes: tuple[str, str], test: str = f"{_UNIT}test_strangers.py") -> Bug:
    return Bug(name=name, module=module, changes=changes, tests=(test,), has_schedules=False)


RECOVERY_BUGS: tuple[Bug, ...] = (
    _bug(
        "a recovered elector does not wait for leases of before",
        RECOVERY,
        ("            granted_s=granted_s,\n", "            granted_s=0.0,\n"),
    ),
    _bug(
        "a recovered generation takes its id from its parent",
        ON_DISK,
        (
            "generation_id=secrets.token_hex(16)",
            'generation_id=f"{(int(recovery.before.generation_id, 16) + 1) % 2**128:032x}"',
        ),
        test="tests/unit/commands/members/test_recovery.py",
    ),
    _bug(
        "states of two halves are recovered together",
        RECOVERY,
        ("        if generation_of(state) != named:\n", "        if not named:\n"),
        test="tests/unit/commands/members/test_recovery.py",
    ),
    _bug(
        "a majority that can agree is recovered",
        RECOVERY,
        ("    if any(len(names) < majority(count) for names, count in able):\n", "    if able:\n"),
        test=f"{_UNIT}test_recovery.py",
    ),
    _bug(
        "electors that were only accepted are a majority that can agree",
        RECOVERY,
        ("for value in (learnt, before)]", "for value in (before,)]"),
        test=f"{_UNIT}test_recovery.py",
    ),
    _bug(
        "a beat of another generation counts",
        BEATS,
        (
            "    if node.agreement.is_stranger(beat, todo, now):\n",
            "    if node.agreement.is_stranger(beat, todo, 0.0) < 0:\n",
        ),
    ),
    _bug(
        "a grant of another generation's number counts",
        LEASE,
        (
            'return not self.number or beat.lease_terms.partition(",")[0] == self.terms',
            "return bool(beat.lease_terms) or not self.number",
        ),
    ),
    _bug(
        "what another generation has learnt is learnt",
        AGREEMENT,
        (
            "if self.strangers.on_learnt(learnt, self._numbers.value, is_named=self._numbers.is_named):",
            "if self.strangers.on_learnt(learnt, self._numbers.value, is_named=self._numbers.is_named) < 0:",
        ),
    ),
    _bug(
        "a stranger's proposal counts",
        STRANGERS,
        ("        return node in self._heard and now -", "        return node in () and now -"),
    ),
    _bug(
        "a question of another generation is answered",
        NUMBERS,
        ("        return self.is_named or question.number > 1\n", "        return False\n"),
    ),
    _bug(
        "a node that changes sides is an elector at once",
        RECOVERY,
        ('        lost=why if has_name else "",\n', '        lost="",\n'),
        test=f"{_UNIT}test_recovery.py",
    ),
    _bug(
        "a blank disk comes back into one of two halves by itself",
        RECOVERY,
        ("    if not agreed or len(sides) != 1 or generation not in", "    if not agreed or generation not in"),
        test=f"{_UNIT}test_recovery.py",
    ),
    _bug(
        "a blank disk answers for the seat of its name",
        "zsched.commands.members.blank",
        ("        why=NEW_DISK,\n", '        why="",\n'),
        test="tests/unit/commands/members/test_init.py",
    ),
    _bug(
        "a node that is to join follows any generation",
        NUMBERS,
        ("            first = replace(first, generation_id=self._joins)\n", "            pass\n"),
    ),
)
