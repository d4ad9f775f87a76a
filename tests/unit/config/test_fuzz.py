"""Whatever the bytes are: a fleet or faults, never an exception, and every fault renders."""

import random
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from zsched.config.load import CheckResult, check_bytes
from zsched.config.schema import endpoint_fault, host_fault

CONFIGS = sorted((Path(__file__).parents[3] / "configs").rglob("*.yaml"))
SNIPPETS = (
    "[", "]", "{", "}", ":", ",", "\n", "  ", "- ", "&a ", "*a", "!!int ", "!x ", "? ", "| ", "> ", "'", '"', "#", "%",
    "@", "`", "\t", "\r", "\0", "\x85", "\u2028", "\ufeff", "~", "null", "true", "1e999", "-1", ".nan", "0x", "<<: *a",
    "--- ", "...", "{robot}", "{target}", "{epoch}", "**", "$*", "kind: edge", "é", "\U0001f916", "9" * 400, "[" * 60,
    "a: " * 40,
)  # fmt: skip


def is_sound(result: CheckResult) -> None:
    assert (result.fleet is None) == bool(result.faults), result.report()
    report = result.report()
    for fault in (*result.faults, *result.warnings):
        assert fault.message
        assert fault.line >= 0
        fault.render("f.yaml").encode()
        assert "\x1b" not in fault.render("f.yaml")
        assert fault.message in report or len(result.faults) > 200


@settings(max_examples=150, deadline=None)
@given(st.binary(max_size=200))
def test_arbitrary_bytes(data: bytes) -> None:
    is_sound(check_bytes(data))


@settings(max_examples=150, deadline=None)
@given(st.lists(st.sampled_from(SNIPPETS), max_size=25).map("".join))
def test_arbitrary_yaml_snippets(text: str) -> None:
    is_sound(check_bytes(text.encode("utf-8", "surrogatepass")))


@pytest.mark.parametrize("seed", range(4))
def test_mutated_shipped_files(seed: int) -> None:
    source = random.Random(seed)
    for _ in range(25):
        text = source.choice(CONFIGS).read_text()
        for _ in range(source.randint(1, 4)):
            at, length = source.randrange(len(text)), source.choice((0, 0, 1, 1, 5, 30))
            text = text[:at] + source.choice((*SNIPPETS, "")) + text[at + length :]
        is_sound(check_bytes(text.encode()))


@pytest.mark.parametrize("seed", range(4))
def test_shipped_files_with_words_exchanged(seed: int) -> None:
    """Stays valid YAML far more often than single characters do, so the schema and the cross checks get their share."""
    source = random.Random(100 + seed)
    words = sorted(
        {
            word
            for path in CONFIGS
            for word in path.read_text().replace(",", " ").replace("}", " ").split()
            if "#" not in word
        }
    )
    for _ in range(25):
        lines = source.choice(CONFIGS).read_text().split("\n")
        for _ in range(source.randint(1, 3)):
            number = source.randrange(len(lines))
            parts = lines[number].split(" ")
            at = source.randrange(len(parts))
            parts[at] = source.choice(
                (source.choice(words), "", "[]", "{}", "-1", "x", '"{robot}/{target}"', "1e9", "{a: b}")
            )
            lines[number] = " ".join(parts)
        is_sound(check_bytes("\n".join(lines).encode()))


def test_known_hostile_files() -> None:
    bomb = "a0: &a0 [x,x]\n" + "".join(f"a{n}: &a{n} [{','.join([f'*a{n - 1}'] * 9)}]\n" for n in range(1, 12))
    for data in (
        b"",
        b"\xff\xfe",
        b"a\x00b",
        b"&a [*a]",
        b"fleet: &a {b: *a}",
        b"nodes: &n {r1: {kind: robot, links: *n}}",
        b"[" * 800,
        b'fleet: "\\UFFFFFFFF"',
        b'fleet: "\\uD800"',
        b"fleet: \x1b[31m",
        b"{a: " * 800,
        b"- " * 800,
        b"x" * (256 << 10) + b"y",
        b"? [a]\n: b",
        b"%YAML 1.1\n---\nfleet: yes",
        b"--- a\n--- b",
        b"!!python/object/apply:os.system [ls]",
        b"fleet: !!binary x",
        b"just text",
        b"[a, list]",
        b"fleet: a\r\nnodes:\r\n  R: {}\r\n",
        bomb.encode(),
        f"nodes: {{{', '.join(f'n{n}: {{kind: edge}}' for n in range(200))}}}".encode(),
    ):
        result = check_bytes(data)
        is_sound(result)
        assert result.faults


def test_many_faults_are_cut_with_a_count() -> None:
    result = check_bytes(("fleet: f\n" + "".join(f"x{n}: 1\n" for n in range(500))).encode())
    assert len(result.faults) > 500
    assert f"and {len(result.faults) - 200} more" in result.report()


def test_syntax_fault_has_its_place_and_a_hint() -> None:
    result = check_bytes(b"fleet: f\ntasks:\n  t:\n    inputs: [{from: {robot}/map, to: x}]\n", "f.yaml")
    assert "f.yaml:4:28: error: not valid YAML" in result.report()
    assert "must be quoted" in result.report()
    tab = check_bytes(b"fleet: f\nnodes:\n\tr1: {kind: robot}\n", "f.yaml")
    assert "f.yaml:3:1: error" in tab.report()
    assert "no tabs" in tab.report()


@settings(max_examples=300, deadline=None)
@given(st.one_of(st.text(max_size=40), st.text(alphabet="tcpuds/:.[]0179af#?-", max_size=30)))
def test_hosts_and_endpoints_are_judged_never_an_exception(text: str) -> None:
    host_fault(text)
    endpoint_fault(text)
    endpoint_fault(f"tcp/{text}")
