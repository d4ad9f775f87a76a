"""Secrets go, everything else stays."""

from __future__ import annotations

import json

import pytest

from support.clinic import FLEET
from zsched.config.load import check_bytes
from zsched.tools.redaction import clean, clean_json, clean_yaml, secrets_of

SECRETS = ("hunter22", "tok,en#1", "abcd1234", "pw4url", "line one", "line two", "swordfish", "pg4pass", "camel4case")
WITH_SECRETS = FLEET.replace(
    "    worker: {command: [python, -m, zsched.tasks.echo]}",
    """    worker:
      command: [python, -m, zsched.tasks.echo, --api-key, abcd1234, --mode=fast, --auth-token=abcd1234]
      env:
        DB_PASSWORD: hunter22   # the one of the hall
        API_TOKEN: tok,en#1
        LONG_SECRET: |
          line one
          line two
        BROKER: mqtt://user:pw4url@192.0.2.7:1883/x
        PIN: "12"
        PGPASSWORD: pg4pass
        apiToken: camel4case
        MODE: fast
        MONKEY: "7"
""",
)


def leaks(text: str) -> list[str]:
    return [secret for secret in SECRETS if secret in text]


def test_a_fleet_file_loses_its_secrets_and_nothing_else() -> None:
    fleet = check_bytes(WITH_SECRETS.encode()).fleet
    assert fleet is not None
    text = clean_yaml(WITH_SECRETS, secrets_of(fleet))
    assert leaks(text) == []
    assert '"12"' not in text
    for kept in ("MODE: fast", 'MONKEY: "7"', "--mode=fast", "192.0.2.7:1883/x", "ready", "robot2", "mqtt://"):
        assert (kept in text) == (kept in WITH_SECRETS), kept
    assert check_bytes(text.encode()).fleet is not None  # what is left is still a fleet file
    assert clean_yaml(FLEET) == FLEET


def test_words_of_a_driver_s_program_are_looked_at_like_any_other_command_s() -> None:
    driven = "{driver: ros2_lifecycle, node: '/{target}/slam', command: [slam, --api-key, abcd1234], ready: matching}"
    text = FLEET.replace("worker: {command: [python, -m, zsched.tasks.echo]}", f"worker: {driven}")
    assert driven in text
    fleet = check_bytes(text.encode()).fleet
    assert fleet is not None
    assert leaks(clean_yaml(text, secrets_of(fleet))) == []


@pytest.mark.parametrize("option", ["--api-key abcd1234", "--api-key=abcd1234"])
def test_words_of_a_line_for_a_shell_are_looked_at_too(option: str) -> None:
    command = f'[bash, -c, "source /opt/ros/setup.bash && exec slam {option} --mode fast"]'
    text = FLEET.replace("[python, -m, zsched.tasks.echo]", command)
    fleet = check_bytes(text.encode()).fleet
    assert fleet is not None
    cleaned = clean_yaml(text, secrets_of(fleet))
    assert leaks(cleaned) == []
    assert "setup.bash && exec slam" in cleaned


@pytest.mark.parametrize(
    "words",
    [
        "command: [slam, --api-key, abcd1234, --mode, fast]",
        "command: [slam, '--api-key', 'abcd''1234', --mode, fast]",
        'command: ["slam", "--api-key", "abcd\\"1234", "--mode", "fast"]',
        'command:\n        - slam\n        - --api-key\n        - "abcd1234"\n        - --mode\n        - fast',
        "command: [slam]\n      env: {DB_PASSWORD: 'abcd''1234'}\n      args: [--mode, fast]",
        'command: [bash, -c, "exec slam --api-key abcd1234 --mode fast"]',
        "command: [bash, -c, \"exec slam --api-key 'abcd1234' --mode fast\"]",
        'command: [bash, -c, "exec slam --api-key \\"abcd1234\\" --mode fast"]',
    ],
)
def test_a_fleet_file_with_faults_loses_what_stands_behind_an_option_too(words: str) -> None:
    """Nobody can read it to the end, so nothing but its own text tells which words are secrets."""
    text = clean_yaml(f"fleet: lab\nnodes: {{}}\ntasks:\n  merge:\n    worker:\n      {words}\n")
    assert ("abcd" in text, "1234" in text, "REMOVED" in text) == (False, False, True), text
    assert "fast" in text


@pytest.mark.parametrize("secret", ["p\u00e4ss-word", 'with"quote', "back\\slash", "o'hara-99"])
def test_a_secret_goes_however_a_fleet_file_or_the_log_writes_it(secret: str) -> None:
    for form in (json.dumps(secret), json.dumps(secret, ensure_ascii=False), "'" + secret.replace("'", "''") + "'"):
        worker = f"worker: {{command: [slam, --token, {form}], env: {{TOKEN: {form}}}}}"
        text = FLEET.replace("worker: {command: [python, -m, zsched.tasks.echo]}", worker)
        fleet = check_bytes(text.encode()).fleet
        assert fleet is not None, form
        secrets = secrets_of(fleet)
        for is_ascii in (False, True):
            line = json.dumps({"text": f"a {secret} b"}, ensure_ascii=is_ascii)
            assert clean(line, secrets) == line.replace(json.dumps(secret, ensure_ascii=is_ascii)[1:-1], "REMOVED")
        assert form[1:-1] not in clean_yaml(text, secrets)


def test_what_stands_behind_an_option_with_its_value_is_no_secret() -> None:
    text = FLEET.replace("zsched.tasks.echo]", "zsched.tasks.echo, --auth-token=abcd1234, --mode=fast]")
    assert secrets_of(check_bytes(text.encode()).fleet) == ("abcd1234",)


def test_a_zenoh_key_in_a_log_line_stays() -> None:
    line = "stream task=echo key=robot1/in epoch=3 API_KEY=swordfish"
    assert clean(line) == "stream task=echo key=robot1/in epoch=3 API_KEY=REMOVED"


def test_private_keys_go_and_known_values_go_everywhere() -> None:
    pem = "a\n-----BEGIN EC PRIVATE KEY-----\nMHcCAQEE\n-----END EC PRIVATE KEY-----\nb"
    assert clean(pem) == "a\nREMOVED\nb"
    body = {"problems": ["worker said swordfish", "task=echo epoch=2"], "up_s": 3.5, "counters": {"tokens_seen": 5}}
    assert clean_json(body, ("swordfish",)) == {**body, "problems": ["worker said REMOVED", "task=echo epoch=2"]}
