"""A running daemon's adapters follow another fleet file as far as they can at once."""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import Mock

import pytest

from support.fleets import fleet_of
from zsched.core.values.certificates import Holder
from zsched.core.values.fleet import Fleet, Security
from zsched.runtime.adoption import Adoption
from zsched.runtime.endpoints import endpoints_for

SECURITY = Security(folder="pki")
FLEET = fleet_of(of=("robot1", "robot2"), tasks=(), security=SECURITY)


@pytest.mark.parametrize(
    ("new", "then"),
    [
        (replace(FLEET, security=replace(SECURITY, revoked=("robot2",))), ["robot1", "robot2.k2"]),
        (fleet_of(of=("robot1",), tasks=(), security=SECURITY), ["robot1"]),
    ],
    ids=["a revoked key", "a node that is gone"],
)
def test_orders_count_by_the_fleet_in_force_before_sessions_are_opened_anew(new: Fleet, then: list[str]) -> None:
    bus, compared = Mock(), Mock()
    adoption = Adoption(
        me="robot1",
        started_with=FLEET,
        points=endpoints_for(FLEET, FLEET.node("robot1"), lambda: 7458, protocol="tls"),
        protocol="tls",
        recipes=Mock(),
        crew=Mock(),
        supervisor=Mock(),
        relay=Mock(),
        bus=bus,
        access=Mock(),
        desk=Mock(),
        post=Mock(),
        sampler=Mock(),
        compare_sessions=compared,
    )
    adoption.adopt(new)
    (holders,) = bus.take_orders_of.call_args.args
    assert sorted(one.label for one in holders) == then
    assert Holder(name="robot1") in holders
    compared.assert_called_once_with(True, ())  # it begins anew in its turn
