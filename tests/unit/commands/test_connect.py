"""`--connect`: asking where no daemon is."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from zsched.cli import app
from zsched.commands.base import ask
from zsched.commands.base.ask import Door, ask_door
from zsched.commands.base.common import CliError
from zsched.core.values.errors import AdapterError


def run(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.mark.parametrize(
    ("group", "advice"),
    [
        (0, "run this as root: root started this daemon"),
        (os.getgid() or 1, "$USER, then log in again)"),
        (4_000_000_001, "run this as root or as a member of the socket's group"),
    ],
)
def test_who_may_not_open_the_socket_is_never_told_to_join_root_s_group(
    monkeypatch: pytest.MonkeyPatch, group: int, advice: str
) -> None:
    """A daemon that root started in the foreground has a socket of root's group: its members may do much else."""

    def refuse(*_: Any, **__: Any) -> None:
        raise AdapterError("no") from PermissionError(13, "Permission denied")

    monkeypatch.setattr(ask, "_asked", refuse)
    monkeypatch.setattr(Path, "stat", lambda _path: SimpleNamespace(st_gid=group))
    with pytest.raises(CliError) as told:
        ask_door(Door(socket=Path("/run/zsched/robot1.sock")), {"verb": "status"})
    assert str(told.value).endswith(advice)
    assert "-aG root" not in str(told.value)
