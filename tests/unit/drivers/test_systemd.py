"""What the driver `systemd` makes of names, variables and a unit's properties."""

from __future__ import annotations

import doctest

import pytest

from zsched.drivers import systemd
from zsched.drivers.engine import Ended
from zsched.drivers.systemd import judged, properties, quoted, unit_name, why_it_ended

UNIT = "shout.service"


def test_examples_in_the_module_hold() -> None:
    assert doctest.testmod(systemd).failed == 0


def test_only_a_template_gets_an_instance() -> None:
    assert unit_name("a@.service", "edge1", "shout") == "a@edge1-shout.service"
    assert unit_name("a@x.service", "edge1", "shout") == "a@x.service"


@pytest.mark.parametrize(
    ("value", "line"),
    [("plain", 'A="plain"'), ('a "b"', 'A="a \\"b\\""'), ("$HOME `x` \\", 'A="\\$HOME \\`x\\` \\\\"'), ("", 'A=""')],
)
def test_a_variable_is_quoted_as_systemd_reads_it(value: str, line: str) -> None:
    assert quoted("A", value) == line


def shown(result: str, status: int, code: int = 1) -> dict[str, str]:
    return properties(f"Result={result}\nExecMainStatus={status}\nExecMainCode={code}\nMainPID=0\n")


@pytest.mark.parametrize(
    ("properties_", "reason", "is_final"),
    [
        (shown("success", 0), f"{UNIT} has ended or was stopped by somebody else: bye", False),
        (shown("exit-code", 3), f"{UNIT} failed with status 3 (exit-code): bye", False),
        (shown("exit-code", 78), f"{UNIT} failed with status 78 (exit-code): bye", True),
        (shown("oom-kill", 9, 2), f"{UNIT} was killed by signal 9 (oom-kill): bye", False),
        (shown("core-dump", 11, 3), f"{UNIT} was killed by signal 11 (core-dump): bye", False),
        (shown("signal", 78, 2), f"{UNIT} was killed by signal 78 (signal): bye", False),
    ],
)
def test_the_reason_names_result_status_and_last_words(
    properties_: dict[str, str], reason: str, *, is_final: bool
) -> None:
    assert why_it_ended(UNIT, properties_, "bye") == Ended(reason=reason, is_final=is_final)


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
