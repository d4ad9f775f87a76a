"""`--connect`: asking where no daemon is."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from zsched.cli import app
from zsched.commands.ask import endpoint_of


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("robot1", "tcp/robot1:7457"),
        ("tcp/robot1", "tcp/robot1:7457"),
        ("192.0.2.11:7500", "tcp/192.0.2.11:7500"),
        ("tls/robot1:7500", "tls/robot1:7500"),
        ("[2001:db8::1]", "tcp/[2001:db8::1]:7457"),
        ("tcp/[2001:db8::1]:7500", "tcp/[2001:db8::1]:7500"),
    ],
)
def test_an_endpoint_may_be_given_without_its_protocol_and_port(text: str, expected: str) -> None:
    assert endpoint_of(text) == expected


@pytest.mark.parametrize("text", ["", "tcp/", "/robot1", "robot1:port", "tcp/:7457"])
def test_what_is_no_endpoint_is_a_usage_error(folder: Path, text: str) -> None:
    result = run("status", "--connect", text, "--runtime-dir", folder)
    assert (result.exit_code, result.stdout) == (2, "")
    assert "is no endpoint; write tcp/robot1:7457" in result.stderr


@pytest.mark.usefixtures("folder")
def test_connect_takes_the_name_of_a_node() -> None:
    assert run("status", "--connect", "robot1", "--node", "*").exit_code == 2
