"""What a secured node opens its sessions with, and what is refused before it opens any."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import zenoh

from support.authorities import install, make_authority
from support.fleets import fleet_of
from zsched.core.values.certificates import Holder, Role
from zsched.core.values.errors import ConfigError
from zsched.core.values.fleet import Fleet, Security
from zsched.link.sessions.access_rules import Side
from zsched.link.sessions.secured import digest_of, files_of, identity_of, require_own, secured_text
from zsched.link.sessions.tls import asker_in, protocol_of, session_text


@pytest.fixture
def pki(tmp_path: Path) -> Path:
    install(make_authority(tmp_path / "authority", "yard"), tmp_path / "pki", "robot1")
    return tmp_path / "pki"


def fleet(folder: Path, *revoked: str) -> tuple[Fleet, Security]:
    security = Security(folder=str(folder), revoked=revoked)
    return fleet_of(name="yard", of=("robot1", "robot2"), tasks=(), security=security), security


def test_the_text_has_tls_both_ways_and_denies_what_no_rule_allows(pki: Path) -> None:
    yard, security = fleet(pki)
    config = zenoh.Config.from_json5(secured_text(yard, security, Side.CONTROL, "{mode: 'peer'}"))
    tls = json.loads(config.get_json("transport/link/tls"))
    assert tls["enable_mtls"]
    assert tls["close_link_on_expiration"]
    assert (tls["listen_private_key"], tls["root_ca_certificate"]) == (str(pki / "key.pem"), str(pki / "ca.pem"))
    assert json.loads(config.get_json("access_control"))["default_permission"] == "deny"
    assert json.loads(config.get_json("transport/link/protocols")) == ["tls"]
    assert protocol_of(yard, "") == "tls"
    assert session_text(replace(yard, security=None), Side.CONTROL) == ""


@pytest.mark.parametrize("name", ["certificate.pem", "key.pem", "ca.pem"])
def test_a_missing_file_is_named_and_never_means_plain_text(pki: Path, name: str) -> None:
    (pki / name).unlink()
    yard, security = fleet(pki)
    with pytest.raises(ConfigError, match=rf"{name}: cannot be read: No such file.*`zsched pki issue`"):
        secured_text(yard, security, Side.CONTROL, "")


def test_what_systemd_hands_over_counts_first(pki: Path, tmp_path: Path) -> None:
    _, security = fleet(pki)
    handed = tmp_path / "credentials"
    handed.mkdir()
    (handed / "key.pem").write_text("none")
    found = files_of(security, {"CREDENTIALS_DIRECTORY": str(handed)})
    assert found.key == pki / "key.pem", "the unit says so where it found no key"
    (handed / "key.pem").write_bytes((pki / "key.pem").read_bytes())
    found = files_of(security, {"CREDENTIALS_DIRECTORY": str(handed)})
    assert (found.key, found.certificate) == (handed / "key.pem", pki / "certificate.pem")


def test_a_node_runs_with_its_own_certificate_only(pki: Path) -> None:
    yard, security = fleet(pki)
    require_own(yard, security, "robot1")
    with pytest.raises(ConfigError, match="is robot1's, and this node is robot2"):
        require_own(yard, security, "robot2")
    yard, security = fleet(pki, "robot1")
    with pytest.raises(ConfigError, match="`security: revoked` does not let in"):
        require_own(yard, security, "robot1")


def test_tools_ask_in_the_name_of_the_certificate(pki: Path, tmp_path: Path) -> None:
    yard, security = fleet(pki)
    assert identity_of(yard, security).holder == Holder(name="robot1")
    assert asker_in(yard, "laptop") == "robot1"
    assert asker_in(replace(yard, security=None), "laptop") == "laptop"
    install(make_authority(tmp_path / "other", "field"), tmp_path / "visit", "ana", Role.OPERATOR)
    with pytest.raises(ConfigError, match=r"names 'ana.operator.field.zsched.internal', which is no name in"):
        asker_in(fleet(tmp_path / "visit")[0], "laptop")
    (pki / "certificate.pem").write_text("nothing")
    with pytest.raises(ConfigError, match="there is no certificate in it"):
        asker_in(yard, "laptop")


def test_another_certificate_has_another_digest(pki: Path, tmp_path: Path) -> None:
    _, security = fleet(pki)
    before = digest_of(security)
    install(make_authority(tmp_path / "second", "yard"), pki, "robot1")
    assert digest_of(security) != before
