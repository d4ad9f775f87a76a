"""The operator's zenoh file is judged before anything opens a session with it."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from support.fleets import fleet_of, node_of
from zsched.cli import app
from zsched.commands.act.apply import make_plan
from zsched.commands.base.ask import Door
from zsched.commands.base.change import InForce
from zsched.config.load import check_file
from zsched.core.values.errors import ConfigError
from zsched.core.values.exits import EXIT_CONFIG
from zsched.core.values.fleet import Fleet, Security
from zsched.link.sessions.access_rules import ALL
from zsched.link.sessions.zenoh_file import denied_by, faults_of, judged

FILE = "/etc/zsched/zenoh.json5"
FLEET = """
fleet: hall
nodes: {robot1: {kind: robot, host: 192.0.2.21, listen: {control: "tcp/0.0.0.0:7457", data: "tcp/0.0.0.0:7458"}}}
zenoh: {config: zenoh.json5}
tasks:
  merge:
    candidates: [robot1]
    weights: {cpu: 1, memory: 0, network: 0}
    inputs: [{from: "{robot}/scan", to: "{target}/merge/{robot}/scan"}]
"""


def fleet() -> Fleet:
    return fleet_of(name="hall", of=(node_of("robot1"),), tasks=(), zenoh_config=FILE)


def rules(*keys: str, permission: str = "allow", default: str = "deny", **subject: Any) -> str:
    """Access control with one rule for everything under these keys."""
    rule = {"id": "r", "permission": permission, "messages": list(ALL), "key_exprs": list(keys)}
    subjects, policies = [{"id": "s", **subject}], [{"rules": ["r"], "subjects": ["s"]}]
    found = {"default_permission": default, "rules": [rule], "subjects": subjects, "policies": policies}
    return json.dumps({"access_control": {"enabled": True, **found}})


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('{mode: "peer" transport: {}}', "1:8: error: zenoh cannot read this"),
        ('{mod: "peer"}', "unknown field `mod`"),
        ('{id: "aabb"}', "`id`"),
        ('{namespace: "robot3"}', "`namespace`"),
        ("{transport: {unicast: {lowlatency: true}}}", "lowlatency"),
    ],
)
def test_a_file_that_no_fleet_could_work_with_is_a_fault(text: str, words: str) -> None:
    (fault,) = faults_of(fleet(), text)
    assert words in fault.render(FILE)


NARROW = rules(*(f"@zsched/hall/{kind}/**" for kind in ("beat", "profile", "alive", "status")), "*/scan", "*/merge/**")
"""What an operator writes who allows each kind by itself."""


@pytest.mark.parametrize(
    ("text", "is_sure"),
    [
        ('{access_control: {enabled: true, default_permission: "deny"}}', True),
        (rules("**"), True),
        (rules("@zsched/other/**"), True),
        (rules("@zsched/*/*/robot1/**", permission="deny", default="allow"), True),
        (rules("@zsched/*/beat/robot1", permission="deny", default="allow"), None),
        (NARROW, False),
    ],
)
def test_the_first_key_that_is_denied_is_named_and_whether_that_is_sure(text: str, *, is_sure: bool | None) -> None:
    assert faults_of(fleet(), text) == ()
    found, faults = denied_by(fleet(), text)
    key = "put (ingress) of '@zsched/hall/*/robot1/**'"
    assert (found, [key in one.message for one in faults]) == (bool(is_sure), [] if is_sure is None else [True])


def test_tls_or_rules_do_not_go_with_a_security_section() -> None:
    secured = replace(fleet(), security=Security(folder="/etc/zsched/pki"))
    for text in ('{transport: {link: {tls: {root_ca_certificate: "a"}}}}', rules("@zsched/**")):
        (fault,) = faults_of(secured, text)
        assert (fault.hint, fault.file) == ("keep one of them", FILE)


def report(folder: Path, text: str) -> str:
    """What `check` and `apply` say of a fleet file beside this zenoh file."""
    (folder / "fleet.yaml").write_text(FLEET)
    (folder / "zenoh.json5").write_text(text)
    return judged(check_file(folder / "fleet.yaml")).report()


def test_the_rules_are_tried_against_this_fleet_s_own_streams(tmp_path: Path) -> None:
    said = report(tmp_path, rules("@zsched/**"))
    assert "denies put (ingress) of 'robot1/scan', which this fleet needs" in said
    assert "error" not in report(tmp_path, rules("@zsched/**", "*/scan", "*/merge/**"))


def test_rules_that_may_allow_it_together_are_a_warning(tmp_path: Path) -> None:
    said = report(tmp_path, NARROW)
    assert "error" not in said
    assert "warning: `access_control` may deny put (ingress) of '@zsched/hall/*/robot1/**'" in said
    assert CliRunner().invoke(app, ["check", str(tmp_path / "fleet.yaml")]).exit_code == 0
    report(tmp_path, rules("**"))
    assert CliRunner().invoke(app, ["check", str(tmp_path / "fleet.yaml")]).exit_code == EXIT_CONFIG


def started(tmp_path: Path, text: str) -> subprocess.CompletedProcess[str]:
    """A daemon that does not start with this zenoh file, and ends by itself."""
    (tmp_path / "fleet.yaml").write_text(FLEET)
    (tmp_path / "zenoh.json5").write_text(text)
    folders = ["--config", tmp_path / "fleet.yaml", "--state-dir", tmp_path / "state", "--runtime-dir", tmp_path]
    command = [sys.executable, "-m", "zsched.daemon", "--node", "robot1", *map(str, folders)]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)


def test_a_start_with_such_a_file_ends_with_its_code(tmp_path: Path) -> None:
    """With `lowlatency` zenoh panicked, and every daemon but the first lived on without its socket."""
    ended = started(tmp_path, "{transport: {unicast: {lowlatency: true, qos: {enabled: false}}}}")
    assert (ended.returncode, "lowlatency" in ended.stderr) == (EXIT_CONFIG, True)


@pytest.mark.parametrize("text", [NARROW, rules("**")])
def test_a_start_with_rules_that_deny_something_warns_and_goes_on(tmp_path: Path, text: str) -> None:
    """It goes on to the TLS of the same file, with which it cannot listen: so it ends before it opens a session."""
    tls = {"transport": {"link": {"tls": {"root_ca_certificate": "/none.pem"}}}}
    ended = started(tmp_path, json.dumps(json.loads(text) | tls))
    assert (ended.returncode, "TLS without listen_certificate" in ended.stderr) == (EXIT_CONFIG, True), ended.stderr
    assert "of '@zsched/hall/*/robot1/**', which this fleet needs" in ended.stderr


def test_check_and_apply_refuse_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    report(tmp_path, '{id: "aabb"}')
    file = tmp_path / "fleet.yaml"
    found = CliRunner().invoke(app, ["check", str(file)])
    assert (found.exit_code, "`id`" in found.stderr) == (EXIT_CONFIG, True)
    monkeypatch.setenv("ZSCHED_CONFIG", str(file))
    held = InForce(
        node="robot1", fleet="hall", revision=1, number=1, is_settled=True, electors=(), document="", text=""
    )
    with pytest.raises(ConfigError, match="`id`"):
        make_plan(Door(socket=tmp_path / "no.sock"), held, file.read_text(), str(file))
