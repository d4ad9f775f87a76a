"""Who dials with a certificate of this fleet and is not let in, as the status tells it."""

from __future__ import annotations

from zsched.config.load import check_bytes
from zsched.core.membership.refused import REFUSED_KEPT, RefusedKeys
from zsched.core.values.fleet import Fleet

TEXT = """\
fleet: yard
nodes:
  robot1: {kind: robot, host: 192.0.2.1, listen: {control: tls/0.0.0.0:7457, data: tls/0.0.0.0:7458}}
  robot2: {kind: robot}
security: {operators: [ana], revoked: [robot2, ana.operator]}
"""


def fleet_of(text: str = TEXT) -> Fleet:
    fleet = check_bytes(text.encode()).fleet
    assert fleet is not None
    return fleet


def told(*labels: str, fleet: Fleet | None = None, later_s: float = 0.0) -> tuple[str, ...]:
    keys = RefusedKeys()
    for label in labels:
        keys.on_refused(label, 100.0)
    return keys.told(fleet or fleet_of(), 100.0 + later_s)


def test_a_revoked_key_is_named_with_the_way_to_another_one() -> None:
    (line,) = told("robot2")
    assert line.startswith("robot2 dials with a key that is revoked, and is not let in. ")
    assert "`zsched invite robot2` here and `zsched join` there" in line
    (line,) = told("ana.operator")
    assert "`zsched pki issue ana --role operator`" in line


def test_a_key_that_was_never_issued_is_not_called_revoked() -> None:
    (line,) = told("robot1.k3")
    assert line.startswith(
        "robot1.k3 dials with a key that nobody has issued for this fleet as it is: it lets in robot1. "
    )
    assert "revoked, and" not in line


def test_who_is_not_in_the_document_is_named_with_both_ways() -> None:
    (line,) = told("robot3.k2")
    assert "which has no node robot3, and is not let in: `zsched leave` on that machine" in line
    assert "`zsched invite robot3` here" in line
    (line,) = told("bob.guest")
    assert line.endswith("`zsched edit`: `security: {guests: [bob]}`")


def test_who_is_let_in_by_now_and_who_has_stopped_is_not_told_of() -> None:
    """A machine that joins dials until the others have begun anew: it is no stranger."""
    assert told("robot2.k2", "robot1", "ana.operator.k2") == ()
    assert told("robot2", later_s=61.0) == ()
    assert told("robot2", fleet=fleet_of(TEXT.replace("robot2, ", ""))) == ()


def test_a_label_that_is_none_and_a_fleet_without_security_are_not_told_of() -> None:
    assert told("robot2.king") == ()
    plain = TEXT.partition("security:")[0].replace("tls/", "tcp/")
    assert told("robot2", fleet=fleet_of(plain)) == ()


def test_a_few_keys_are_kept_and_the_newest_ones_come_once_others_are_over() -> None:
    keys = RefusedKeys()
    for number in range(REFUSED_KEPT + 5):
        keys.on_refused(f"robot{number + 3}", 100.0)
    assert len(keys.told(fleet_of(), 100.0)) == REFUSED_KEPT
    keys.on_refused("robot2", 161.0)
    assert len(keys.told(fleet_of(), 161.0)) == 1


def test_who_dials_on_stays_on_a_list_that_is_full() -> None:
    keys = RefusedKeys()
    for number in range(REFUSED_KEPT):
        keys.on_refused(f"robot{number + 3}", 100.0)
    keys.on_refused("robot3", 150.0)
    (line,) = keys.told(fleet_of(), 161.0)
    assert line.startswith("robot3 dials")
