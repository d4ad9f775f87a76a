"""Who is answered by `zsched web`, and who is refused before anything is looked up: each promise of its own."""

from __future__ import annotations

import hmac
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from zsched.cli import app
from zsched.commands.base.common import CliError
from zsched.tools.watch import gate as rules
from zsched.tools.watch.gate import FILES, HEADERS, Asked, Gate, Refusal, Route
from zsched.tools.watch.web import endpoint_of, token_of

PAGE = Path(rules.__file__).parent / "page"
TOKEN = "a-token-of-some-length"
OPEN = Gate(names=frozenset({"localhost", "robot1"}))
CLOSED = Gate(names=frozenset({"localhost"}), token=TOKEN)


def judge(gate: Gate, target: str = "/", method: str = "GET", **headers: str | list[str]) -> Route | Refusal:
    """The gate's word; a header is written with ``_`` for ``-``, and may come more than once."""
    found = {"host": ["127.0.0.1:7459"]}
    for name, value in headers.items():
        found[name.lower().replace("_", "-")] = [value] if isinstance(value, str) else value
    return gate.judge(Asked(method=method, target=target, headers=lambda name: found.get(name.lower(), [])))


def status(answer: Route | Refusal) -> int:
    return answer.status if isinstance(answer, Refusal) else 200


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS", "TRACE", "CONNECT", "get", "X"])
def test_every_method_but_get_and_head_is_refused(method: str) -> None:
    answer = judge(OPEN, method=method)
    assert isinstance(answer, Refusal)
    assert (answer.status, answer.headers) == (405, (("Allow", "GET, HEAD"),))
    assert status(judge(OPEN, method="HEAD")) == 200


@pytest.mark.parametrize(
    "host", ["127.0.0.1", "127.0.0.1:7459", "192.0.2.7:80", "[::1]:7459", "[2001:db8::1]", "localhost:1", "Robot1"]
)
def test_addresses_and_own_names_are_hosts(host: str) -> None:
    assert status(judge(OPEN, host=host)) == 200


@pytest.mark.parametrize(
    "host",
    [
        *("evil.example", "evil.example:7459", "127.0.0.1.evil.example", "localhost.evil.example", "", ":7459", "[::1"),
        *("::1", "[127.0.0.1]", "127.0.0.1:x", "127.0.0.1:123456", "2130706433", "0x7f.1", "robot1@evil", "[::1]x"),
    ],
)
def test_a_name_that_another_pointed_here_is_refused(host: str) -> None:
    assert status(judge(OPEN, host=host)) == 421


def test_a_request_without_a_host_or_with_two_is_refused() -> None:
    assert status(judge(OPEN, host=[])) == 421
    assert status(judge(OPEN, host=["127.0.0.1", "evil.example"])) == 421


@pytest.mark.parametrize(
    "path",
    [
        *("/index.html", "/../pyproject.toml", "/page.js/", "//page.js", "/%2e%2e/x", "/api", "/api/", "/api/explain/"),
        *(
            "/api/explain/../status",
            "/api/explain/a/b",
            "/api/explain/A%20b",
            "/metrics/",
            "http://x/",
            "*",
            "",
            "/web.py",
        ),
    ],
)
def test_only_known_paths_are_answered(path: str) -> None:
    assert status(judge(OPEN, path)) == 404


def test_known_paths_are_routed() -> None:
    for path in (*FILES, "/api/live", "/api/status", "/metrics"):
        assert judge(OPEN, path) == Route(path=path)
    assert judge(OPEN, "/api/explain/map_merge") == Route(path="/api/explain/", task="map_merge")


def test_a_query_is_refused_so_that_no_token_gets_into_an_address() -> None:
    for path in ("/", "/metrics", "/api/live"):
        assert status(judge(CLOSED, f"{path}?token={TOKEN}")) == 400


@pytest.mark.parametrize("path", ["/api/live", "/api/status", "/metrics", "/api/explain/echo"])
def test_what_tells_of_the_fleet_needs_the_token_and_takes_no_other(path: str) -> None:
    good = f"Bearer {TOKEN}"
    assert status(judge(CLOSED, path, authorization=good)) == 200
    assert status(judge(CLOSED, path, authorization=f"bearer  {TOKEN}")) == 200
    wrong = [
        "",
        TOKEN,
        "Bearer",
        "Bearer ",
        f"Basic {TOKEN}",
        f"Bearer {TOKEN}x",
        f"Bearer {TOKEN[:-1]}",
        "Bearer \udcff",
    ]
    for word in wrong:
        answer = judge(CLOSED, path, authorization=word)
        assert isinstance(answer, Refusal), word
        assert (answer.status, dict(answer.headers)) == (401, {"WWW-Authenticate": 'Bearer realm="zsched"'})
    assert status(judge(CLOSED, path)) == 401
    assert status(judge(CLOSED, path, authorization=[good, good])) == 401


def test_the_token_is_compared_in_a_time_that_tells_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """By `hmac.compare_digest`, and of digests: neither how much of it is right nor its length shows."""
    lengths: list[tuple[int, int]] = []
    compare = hmac.compare_digest

    def noted(one: bytes, other: bytes) -> bool:
        lengths.append((len(one), len(other)))
        return compare(one, other)

    monkeypatch.setattr("hmac.compare_digest", noted)
    for word in ("", "x", TOKEN, TOKEN * 9):
        judge(CLOSED, "/metrics", authorization=f"Bearer {word}")
    judge(CLOSED, "/metrics", authorization=f"Basic {TOKEN}")
    assert lengths == [(32, 32)] * 5


def test_the_page_itself_holds_no_data_and_needs_no_token() -> None:
    assert [status(judge(CLOSED, path)) for path in FILES] == [200] * len(FILES)


@pytest.mark.parametrize("site", ["cross-site", "same-site"])
def test_pages_of_other_sites_may_not_ask_for_data(site: str) -> None:
    assert status(judge(OPEN, "/api/live", sec_fetch_site=site)) == 403
    assert status(judge(OPEN, "/", sec_fetch_site=site)) == 200, "a link from elsewhere may lead here"
    assert status(judge(OPEN, "/api/live", sec_fetch_site="same-origin")) == 200
    assert status(judge(OPEN, "/metrics", sec_fetch_site="none")) == 200


# --- the page --------------------------------------------------------------------------------------------------------


def test_the_policy_lets_nothing_in_but_the_page_s_own_files() -> None:
    policy = dict(part.strip().split(" ", 1) for part in HEADERS["Content-Security-Policy"].split(";"))
    assert policy.pop("default-src") == "'none'"
    assert {policy.pop(name) for name in ("base-uri", "form-action", "frame-ancestors")} == {"'none'"}
    assert set(policy.values()) == {"'self'"}


def test_the_page_is_made_of_its_own_files_and_of_text_only() -> None:
    texts = {path.name: path.read_text(encoding="utf-8") for path in PAGE.iterdir()}
    assert set(texts) == {name for name, _ in FILES.values()}
    for name, text in texts.items():
        outside = re.findall(r"(?:https?:)?//[a-z][\w.]+", re.sub(r"http://www.w3.org/2000/svg", "", text))
        assert outside == [], name
        assert re.findall(r"innerHTML|outerHTML|insertAdjacent|document\.write|eval\(|new Function", text) == [], name
    html = texts["index.html"]
    assert re.findall(r"<script(?![^>]* src=)|<style|\son\w+=|\sstyle=|javascript:", html) == []
    used = set(re.findall(r'byId\("(\w+)"\)|fill\("(\w+)"', texts["page.js"]))
    assert {name for pair in used for name in pair if name} <= set(re.findall(r'id="([\w-]+)"', html))


# --- where, and the token --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", ["", "7459", "robot1:7459", "127.0.0.1", "127.0.0.1:x", "127.0.0.1:70000", "::1:7459"])
def test_a_place_that_is_no_address_with_a_port_is_refused(text: str) -> None:
    with pytest.raises(CliError, match="is no address with a port") as caught:
        endpoint_of(text)
    assert caught.value.code == 2


def test_a_token_is_a_long_word(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "token"
    monkeypatch.delenv("ZSCHED_WEB_TOKEN", raising=False)
    assert token_of(None) == ""
    file.write_text(f"{TOKEN}\n")
    assert token_of(file) == TOKEN
    for text in ("", "short", "two words of enough length", "ä" * 20):
        file.write_text(text)
        with pytest.raises(CliError, match="one word of at least 16"):
            token_of(file)
    monkeypatch.setenv("ZSCHED_WEB_TOKEN", "short")
    with pytest.raises(CliError, match="ZSCHED_WEB_TOKEN: a token is one word"):
        token_of(None)
    with pytest.raises(CliError, match="cannot be read"):
        token_of(tmp_path / "none")


@pytest.mark.parametrize("place", ["0.0.0.0:0", "[::]:0", "192.0.2.1:7459"])
def test_beyond_this_machine_it_listens_only_with_a_token(place: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ZSCHED_WEB_TOKEN", raising=False)
    refused = CliRunner().invoke(app, ["web", "--listen", place])
    assert refused.exit_code == 2
    assert "give a token with --token-file" in refused.stderr
