"""The bugs of machines that come and go: one for each rule without which fleets mix, or a machine cannot join.

Knows: which text of which module each bug replaces, and which tests may find it. Does not know: how it is planted.
"""

from __future__ import annotations

from typing import Final

from zsched_lab.bugs.core_bugs import Bug

MEMBERSHIP: Final = "zsched.commands.members.belongings"
FOUNDING: Final = "zsched.core.electorate.founding"
INVITATION: Final = "zsched.link.invitation"


def _bug(name: str, module: str, *changes: tuple[str, str], test: str = "commands/members/test_membership.py") -> Bug:
    return Bug(name=name, module=module, changes=changes, tests=(f"tests/unit/{test}",), has_schedules=False)


MEMBER_BUGS: tuple[Bug, ...] = (
    _bug(
        "a new fleet has the generation of its name",
        MEMBERSHIP,
        ("generation_id=secrets.token_hex(16)", 'generation_id=f"{len(fleet.name):032x}"'),
    ),
    _bug(
        "a machine that joins is not told the generation",
        MEMBERSHIP,
        (
            "state = replace(plain, registers=(), fleet_register=RegisterState(task=fleet.name, learnt=value))",
            "state = plain",
        ),
    ),
    _bug(
        "a machine joins in generation 0 whatever operators have counted",
        MEMBERSHIP,
        ("generation, disk = invitation.value, invitation.generation, ", "generation, disk = invitation.value, 0, "),
    ),
    _bug(
        "a machine of another generation takes itself for joined",
        MEMBERSHIP,
        ("value.generation_id == invitation.value.generation_id", "value.fleet == invitation.value.fleet"),
    ),
    Bug(
        name="a copied disk is this machine's own",
        module="zsched.host.state_file",
        changes=(
            ("        if not is_same_hardware(state.hardware, self._hardware):\n", "        if not state.node:\n"),
        ),
        tests=("tests/unit/host/test_state_file.py",),
        has_schedules=False,
    ),
    _bug(
        "an invitation replaces another fleet's file",
        MEMBERSHIP,
        ("    if found_.name != fleet:\n", "    if found_.name != found_.name:\n"),
    ),
    _bug(
        "the seat of a new fleet names no disk",
        FOUNDING,
        ("Elector(name=me, disk=disk, joining=1),)", "Elector(name=me),)"),
    ),
    _bug(
        "a changed invitation is taken",
        INVITATION,
        ('if body.pop("digest", None) != _digest(body):', 'if body.pop("digest", None) is None:'),
        test="link/test_invitation.py",
    ),
    _bug(
        "an invitation's document is not compared with its value",
        INVITATION,
        ("if document_hash(document) != value.document:", "if not value.document:"),
        test="link/test_invitation.py",
    ),
)
