"""What the driver `systemd` makes of names, variables and a unit's properties."""

from __future__ import annotations

import doctest

import pytest

from zsched.drivers import systemd
from zsched.drivers.systemd import judged

UNIT = "shout.service"


def test_examples_in_the_module_hold() -> None:
    assert doctest.testmod(systemd).failed == 0


FILE = "edge1-shout.env"
READS = f"/run/zsched/{FILE} (ignore_errors=no)"
READS_ALL = "/run/zsched/*-shout.env (ignore_errors=no)"


@pytest.mark.parametrize(
    ("properties_", "told", "fix", "is_fatal"),
    [
        ({"LoadState": "not-found"}, "is not-found", "systemctl status", True),
        ({"LoadState": "masked"}, "is masked", "systemctl status", True),
        ({"LoadState": "loaded"}, "does not read the worker's variables", f"EnvironmentFile=/run/zsched/{FILE}", False),
        (
            {"LoadState": "loaded", "EnvironmentFiles": READS, "UnitFileState": "enabled"},
            "also starts at boot",
            "systemctl disable",
            False,
        ),
        (
            {"LoadState": "loaded", "EnvironmentFiles": READS, "UnitFileState": "static", "Restart": "on-failure"},
            "has Restart=on-failure",
            "Restart=no",
            False,
        ),
        ({"LoadState": "loaded", "EnvironmentFiles": READS, "UnitFileState": "static"}, "is there", "", True),
        (
            {"LoadState": "loaded", "EnvironmentFiles": READS_ALL},
            "is there",
            "",
            True,
        ),
    ],
)
def test_the_doctor_is_told_what_a_unit_lacks(
    properties_: dict[str, str], told: str, fix: str, *, is_fatal: bool
) -> None:
    look = judged(UNIT, properties_, FILE)
    assert told in look.told
    assert look.fix.startswith(fix)
    assert bool(fix) is bool(look.fix)
    assert look.is_fatal is is_fatal
