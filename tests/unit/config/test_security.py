"""The `security:` section: what it says, and every fault with its place."""

from __future__ import annotations

from zsched.config.load import CheckResult, check_bytes
from zsched.core.values.fleet import Security, fleet_hash

TEXT = """\
fleet: yard
nodes:
  robot1: {kind: robot, host: 192.0.2.1, listen: {control: tls/0.0.0.0:7457, data: quic/0.0.0.0:7458}}
  robot2: {kind: robot}
security:
"""


def check(section: str, text: str = TEXT) -> CheckResult:
    return check_bytes((text.rstrip() + " " + section).encode(), "/etc/zsched/fleet.yaml")


def security(section: str) -> Security | None:
    result = check(section)
    assert result.fleet is not None, result.report()
    return result.fleet.security


def test_an_empty_section_secures_with_the_folder_beside_the_file() -> None:
    assert security("{}") == Security(folder="/etc/zsched/pki")
    assert security("{folder: /run/keys}") == Security(folder="/run/keys")


def test_names_are_sorted_and_without_a_section_nothing_is_secured() -> None:
    found = security("{operators: [bob, ana], guests: [screen], revoked: [robot1, ana.operator]}")
    assert found == Security(
        folder="/etc/zsched/pki", operators=("ana", "bob"), guests=("screen",), revoked=("ana.operator", "robot1")
    )
    plain = check_bytes(TEXT.replace("security:", "").encode())
    assert plain.fleet is not None
    assert plain.fleet.security is None


def test_all_nodes_must_agree_on_the_names_not_on_the_folder() -> None:
    def digest(section: str) -> str:
        fleet = check(section).fleet
        assert fleet is not None
        return fleet_hash(fleet)

    assert digest("{folder: /a/pki}") == digest("{folder: /b/pki}")
    assert len({digest(text) for text in ("{}", "{operators: [ana]}", "{guests: [ana]}", "{revoked: [robot1]}")}) == 4


def test_each_fault_is_said_with_what_to_do() -> None:
    for section, said in (
        ("{operators: [robot1]}", "'robot1' is a node"),
        ("{operators: [ana, ana]}", "'ana' is there twice"),
        ("{operators: [ana], guests: [ana]}", "'ana' is an operator, too"),
        ("{revoked: [robot1.k1]}", "not a certificate's name: for example robot1"),
        (f"{{guests: [{'g' * 60}]}}", "characters, at most 64 are possible"),
        ("{key: /etc/key}", "has no key 'key'"),
    ):
        result = check(section)
        assert result.fleet is None
        assert said in result.report(), result.report()
    assert "'gone' is a key of nobody" in check("{revoked: [gone]}").report()


def test_plain_text_beside_the_section_is_a_fault_with_the_line_to_write() -> None:
    result = check("{}", TEXT.replace("tls/0.0.0.0:7457", "tcp/0.0.0.0:7457"))
    (fault,) = result.faults
    assert fault.message == "tcp/ is plain text, and the fleet is secured (line 5)"
    assert fault.hint == "tls/0.0.0.0:7457"
