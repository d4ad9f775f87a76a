"""Bugs of operators' flags: which nodes they keep out, which hand over, how long they last.

Knows: as `zsched_lab.bugs.core_bugs`. Does not know: the same.
"""

from __future__ import annotations

from zsched_lab.bugs.core_bugs import Bug

FLAGS, DECISION = "zsched.core.scheduler.flags", "zsched.core.scheduler.decision"
JUDGE, NODE = "zsched.core.scheduler.judge", "zsched.core.node.node"
ORDERS, DOCUMENTS = "zsched.core.electorate.orders", "zsched.core.electorate.documents"
HANDLER, APPLY = "zsched.core.node.orders", "zsched.commands.act.apply"

_FLAGS = ("tests/unit/core/scheduler/test_flags.py",)
_JUDGE = ("tests/unit/core/scheduler/test_judge.py",)
_ORDERS = ("tests/unit/core/electorate/test_orders.py",)
_DOOR = ("tests/unit/core/node/test_orders.py",)


def _bug(name: str, module: str, old: str, new: str, tests: tuple[str, ...], *, has_schedules: bool = False) -> Bug:
    return Bug(
        name=name,
        module=module,
        changes=((old, new),),
        tests=tests,
        has_schedules=has_schedules,
        has_changing_fleets=True,
    )


FLAG_BUGS: tuple[Bug, ...] = (
    _bug(
        "a drained node gets tasks",
        DECISION,
        "for name, why in figures.closed if name in candidates}",
        "for name, why in figures.closed if name not in candidates}",
        _FLAGS,
        has_schedules=True,
    ),
    _bug(
        "a drained owner that leads stays",
        JUDGE,
        "if (leaving is None or name != owner)",
        "if (escape is None or name != owner)",
        _JUDGE,
        has_schedules=True,
    ),
    _bug(
        "an ineligible owner hands over",
        FLAGS,
        "drained = {flag.subject: told_flag(flag) for flag in flags if flag.kind in HANDS_OVER}",
        "drained = {flag.subject: told_flag(flag) for flag in flags}",
        _FLAGS,
        has_schedules=True,
    ),
    _bug(
        "a document that is still known here leaves the disk",
        "zsched.core.electorate.documents",
        "        known = tuple(sorted({*self._fleets, *self._kept}))\n",
        "        known = tuple(sorted(self._kept))\n",
        _ORDERS,
    ),
    _bug(
        "a flag counts anew with every document",
        FLAGS,
        "known.get(_key(flag), now) for flag in flags}",
        "now for flag in flags}",
        _FLAGS,
    ),
    _bug(
        "a flag whose time is over stays",
        ORDERS,
        "            todo.add(do.AmendDocument(document=value.document, flags=flags))\n",
        "",
        _ORDERS,
        has_schedules=True,
    ),
    _bug(
        "flags are forgotten over a restart",
        DOCUMENTS,
        "dict(flags)",
        "{flags: () for flags in ()}",
        _ORDERS,
        has_schedules=True,
    ),
    _bug(
        "a document of a peer brings no flags",
        DOCUMENTS,
        "self._fleets[document], self._flags[document] = fleet, flags",
        "self._fleets[document], self._flags[document] = fleet, ()",
        _ORDERS,
        has_schedules=True,
    ),
    _bug(
        "a vote for a node that is flagged since is committed",
        NODE,
        "if change.owner in self.flags.closed:",
        "if change.owner in ():",
        _DOOR,
    ),
    _bug("a drain waits for the cap", JUDGE, "owner is not None and not is_drain\n", "owner is not None\n", _JUDGE),
    _bug(
        "a drain is stronger than a hard pin",
        JUDGE,
        "(not allocation.is_bound or name in (home, owner))",
        "(not allocation.is_bound or is_drain or name in (home, owner))",
        _JUDGE,
    ),
    _bug(
        "a drain is stronger than a pause",
        JUDGE,
        "        if allocation.paused:\n",
        "        if allocation.paused and leaving is None:\n",
        _JUDGE,
    ),
    _bug(
        "a flagged node is a place for an ordered move",
        HANDLER,
        "    if target in node.flags.closed:\n",
        "    if target in ():\n",
        _DOOR,
    ),
    _bug(
        "another document forgets the flags",
        APPLY,
        'flags = [flag for flag in plan.held.flags if flag["subject"] in nodes]',
        "flags = []",
        ("tests/unit/commands/test_apply.py",),
    ),
)
