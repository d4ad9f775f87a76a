"""The bugs of electors by themselves: one for each rule without which healthy electors go, or a fleet stands still.

Knows: which text of which module each bug replaces, and which tests may find it. Does not know: how it is planted.
"""

from __future__ import annotations

from typing import Final

from zsched_lab.bugs.core_bugs import AGREEMENT, Bug

PILOT: Final = "zsched.core.electorate.pilot"
HELM: Final = "zsched.core.electorate.helm"
_TESTS: Final = ("tests/unit/core/electorate/test_pilot.py", "tests/sim/test_pilot.py")


def _node_bug(name: str, module: str, *changes: tuple[str, str]) -> Bug:
    return Bug(name=name, module=module, changes=changes, tests=("tests/sim/test_pilot_nodes.py",), has_schedules=False)


def _bug(name: str, *changes: tuple[str, str]) -> Bug:
    return Bug(name=name, module=PILOT, changes=changes, tests=_TESTS, has_schedules=False)


PILOT_BUGS: tuple[Bug, ...] = (
    _bug(
        "another disk of an elector's name is the elector's end",
        (
            "        if seat is not None and _answers(seat, word):\n            self._seats[seat] = now\n",
            (
                "        if seat is not None:\n"
                "            self._seats[seat] = now if _answers(seat, word) else -math.inf\n"
            ),
        ),
    ),
    _bug(
        "an elector is known by its name alone",
        (
            'return word.disk != "" and seat.is_held_by(word.node, word.disk)',
            'return word.disk != "" and seat.name == word.node',
        ),
    ),
    _bug(
        "one elector's view removes another", ("if len(opinions[name]) >= needed), None)", "if opinions[name]), None)")
    ),
    _bug(
        "an elector that has slept believes its clock",
        ("            self._listens_since = now\n", "            pass\n"),
    ),
    _bug("an opinion of long ago counts", ("now - peer.at < silence_s and _answers", "_answers")),
    _bug(
        "an opinion under another number counts",
        (" for name, word in words if word.is_current]", " for name, word in words]"),
    ),
    _bug("an elector is added without room", ("if count > 1 and len(alive) < majority(count + 1):", "if not alive:")),
    _bug(
        "a single elector stays alone",
        ("if count > 1 and len(alive) < majority(count + 1):", "if len(alive) < majority(count + 1):"),
    ),
    _bug(
        "electors are added before the dead are removed",
        (
            "        if lost is not None and lost.change is not None:\n            return lost\n",
            (
                "        added = self._addable(value, course, now)\n"
                "        if added.change is not None:\n"
                "            return added\n"
                "        if lost is not None and lost.change is not None:\n"
                "            return lost\n"
            ),
        ),
    ),
    _bug("a candidate is added that comes and goes", ("now - peer.since >= STEADY * course.silence_s", "True")),
    _bug("a candidate is added that is behind", ("if is_steady and peer.word.is_current:", "if is_steady:")),
    _bug(
        "a candidate is steady over two disks",
        ("if peer is None or peer.word.disk != word.disk or now", "if peer is None or now"),
    ),
    _bug("three become two without a spare", ("if count == 3 and not self._fit", "if count == 0 and not self._fit")),
    _bug(
        "a leaver goes before the others are settled",
        ("return value.settled and value.electorate", "return value.electorate"),
    ),
    _bug(
        "a leaver goes though too few of the electors that stay are alive",
        ("            if len(staying) >= majority(count - 1):\n", "            if staying:\n"),
    ),
    _bug(
        "a single elector that leaves finds nobody to follow it",
        ("if not fit or (count >= aim and not is_handed_on):", "if not fit or count >= aim:"),
    ),
    _bug(
        "who leaves becomes an elector",
        ("if peer is None or name in kept or name in course.leaving:", "if peer is None or name in kept:"),
    ),
    _node_bug(
        "the pilot is not told who leaves",
        HELM,
        (
            "        leaving=tuple(flag.subject for flag in flags if flag.kind is FlagKind.LEAVE),\n",
            "        leaving=(),\n",
        ),
    ),
    _bug(
        "who has lost its disk is no spare for its own seat",
        (" and not (name == instead and peer.word.may_return)", ""),
    ),
    _node_bug(
        "nobody says that it lost its disk and may return",
        AGREEMENT,
        (
            "return bool(self._durable is not None and self._lost and",
            "return bool(self._durable is None and self._lost and",
        ),
    ),
    _bug(
        "who was never heard is counted on",
        (
            "if peer is not None and now - peer.at < silence_s and _answers(seat, peer.word):",
            "if peer is None or now - peer.at < silence_s:",
        ),
    ),
    _bug("electors that the operator has named are replaced", ("if not course.is_auto:", "if not course.members:")),
    _bug("the electors become an even number", ("return count - 1 + count % 2", "return count")),
    _bug("one elector's view sends a robot away", ("if count >= needed or (name", "if count or (name")),
    _bug(
        "one elector's view calls a robot back",
        ("is_back = len(lists) - count >= needed", "is_back = len(lists) > count"),
    ),
    _bug(
        "an elector that has just started calls back whoever is away",
        ("        if name in value.away:\n", "        if name in value.away and peer is not None:\n"),
    ),
    _node_bug(
        "an elector that lost its disk is never one again",
        AGREEMENT,
        ("if self._lost and self._numbers.roll is not None and", "if False and self._numbers.roll is not None and"),
    ),
    _node_bug(
        "votes of an old seat are held against the new one",
        AGREEMENT,
        ("                self.witness.seen.pop(name, None)\n", ""),
    ),
    _node_bug(
        "robots that are away count in votes",
        HELM,
        ("tuple(name for name in fleet.voters if name not in away) or fleet.voters", "fleet.voters or away"),
    ),
    _node_bug(
        "a node that starts counts the robots of its document",
        "zsched.core.node.node",
        ("        documents.count_voters(self, todo)\n", ""),
    ),
    Bug(
        name="rounds go by the electors of the file",
        module="zsched.core.node.documents",
        changes=(
            (
                "node.in_force.count(node.agreement.voters, node.agreement.electors)",
                "node.in_force.count(node.agreement.voters, node.in_force.electors)",
            ),
        ),
        tests=("tests/unit/core/electorate/test_strangers.py",),
        has_schedules=False,
    ),
)
