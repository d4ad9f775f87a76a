"""The `security:` section: what it says, and every fault with its place."""

from __future__ import annotations

from zsched.config.load import CheckResult, check_bytes
from zsched.core.values.fleet import Security, fleet_hash

TEXT = """\
fleet: yard
nodes:
  robot1: {kind: robot, host: 192.0.2.1, listen: {control: tls/0.0.0.0:7457, data: tls/0.0.0.0:7458}}
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


def test_a_revoked_key_of_a_node_that_has_left_is_no_fault_and_a_misspelt_one_is() -> None:
    """`invite` and `pki revoke` write these lines, and the name may come back: nobody is to take them out."""
    for left in ("robot3", "robot3.k2", "gone", "ana.operator"):
        assert check(f"{{revoked: [{left}]}}").report() == check("{}").report(), left
    for wrong in ("robto1", "rbot1.k2", "robot-1"):
        report = check(f"{{revoked: [{wrong}]}}").report()
        assert f"{wrong!r} is a key of nobody in this file" in report
        assert "the line keeps nobody out; did you mean 'robot1'?" in report


def test_a_revoked_name_in_another_role_is_told_with_the_label_that_keeps_its_key_out() -> None:
    """Who writes the name alone means a node: an operator's key would go on being let in, without a word."""
    result = check("{operators: [ana], guests: [screen], revoked: [ana.k2, screen.operator, robot1]}")
    assert result.fleet is not None
    told = {one.message: one.hint.rpartition(" ")[2] for one in result.warnings if " is a key of " in one.message}
    assert told == {
        "'ana.k2' is a key of nobody: ana is no node here, but an operator": "ana.operator.k2",
        "'screen.operator' is a key of nobody: screen is no operator here, but a guest": "screen.guest",
    }


def test_a_local_side_that_other_machines_reach_is_told() -> None:
    def told(endpoint: str, section: str = "{}") -> list[str]:
        local = f"kind: robot, local: {{mode: peer, listen: ['{endpoint}']}}"
        text = TEXT.replace("robot2: {kind: robot}", f"robot2: {{{local}}}")
        result = check(section, text) if section else check_bytes(text.replace("security:", "").encode())
        assert result.fleet is not None, result.report()
        return [one.message for one in result.warnings if "local side" in one.message]

    for endpoint in ("tcp/0.0.0.0:7460", "tcp/[::]:7460", "udp/192.0.2.7:7460", "tcp/robot2:7460", "ws/10.0.0.1:1"):
        assert told(endpoint) == [f"{endpoint}: other machines reach this local side, and it has no certificates"]
        assert told(endpoint, "") == [], "without certificates everything is plain text"
    for endpoint in ("tcp/127.0.0.1:7460", "tcp/[::1]:7460", "tcp/localhost:7460", "unixsock-stream//run/robot"):
        assert told(endpoint) == []


def test_plain_text_beside_the_section_is_a_fault_with_the_line_to_write() -> None:
    result = check("{}", TEXT.replace("tls/0.0.0.0:7457", "tcp/0.0.0.0:7457"))
    (fault,) = result.faults
    assert fault.message == "tcp/ is plain text, and the fleet is secured (line 5)"
    assert fault.hint == "tls/0.0.0.0:7457"


def test_quic_is_refused_for_its_links_do_not_end_when_they_are_refused() -> None:
    text = TEXT.replace("data: tls/", "data: quic/")
    (fault,) = check("{}", text).faults
    assert fault.message == "zenoh cannot end a refused link of quic/, and the fleet is secured (line 5)"
    assert fault.hint == "tls/0.0.0.0:7458"
    assert check_bytes(text.replace("security:", "").encode()).fleet is not None


def test_only_the_nodes_that_are_named_give_orders_and_somebody_must() -> None:
    found, every, people = (security(one) for one in ("{orders: [robot2]}", "{}", "{orders: [], operators: [ana]}"))
    assert found is not None
    assert every is not None
    assert people is not None
    assert (found.orders, every.orders, people.orders) == (("robot2",), None, ())
    assert [one.message for one in check("{orders: [ana], operators: [ana]}").faults] == ["'ana' is no node"]
    assert [one.message for one in check("{orders: []}").faults] == ["nobody could give an order"]
