"""Why a session could not be opened: zenoh's real errors, in the words of who has to mend it."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import pytest
import zenoh

from zsched.link.sessions.config import client_config, data_config
from zsched.link.sessions.problems import why_not_open


@pytest.fixture
def taken() -> Iterator[int]:
    """A port that another program listens on."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        yield listener.getsockname()[1]


def refusal(config: str) -> str:
    with pytest.raises(zenoh.ZError) as caught:
        zenoh.open(zenoh.Config.from_json5(config)).close()
    return why_not_open(config, caught.value)


def listening(*endpoints: str) -> str:
    return data_config(listen=endpoints, connect=(), shared_memory=False)


def test_a_taken_port_is_named_with_the_command_that_finds_who_has_it(taken: int) -> None:
    said = refusal(listening(f"tcp/127.0.0.1:{taken}"))
    assert said.startswith(f"cannot listen on tcp/127.0.0.1:{taken}: another program has that port; ")
    assert f"`ss -ltnp 'sport = :{taken}'`" in said


def test_of_several_endpoints_the_one_that_failed_is_named(taken: int) -> None:
    said = refusal(listening("tcp/127.0.0.1:0", f"tcp/127.0.0.1:{taken}"))
    assert said.startswith(f"cannot listen on tcp/127.0.0.1:{taken}: ")


def test_an_address_of_another_machine_is_said_to_be_that() -> None:
    said = refusal(listening("tcp/192.0.2.7:7458"))
    assert said.startswith("cannot listen on tcp/192.0.2.7:7458: this machine does not have that address; ")


def test_what_has_no_words_of_ours_keeps_zenohs_without_its_source_lines() -> None:
    """The name cannot be looked up; zenoh does not even say which."""
    said = refusal(listening("tcp/127.0.0.9999:7458"))
    assert said.startswith("cannot listen on tcp/127.0.0.9999:7458: ")
    assert ".rs:" not in said
    assert "fleet file" in said


def test_a_client_that_nobody_answers_is_asked_for_its_router() -> None:
    said = refusal(client_config(connect=("tcp/127.0.0.1:1",)))
    assert said == "cannot be joined: nobody answers at tcp/127.0.0.1:1 in time; is its router up?"


@pytest.mark.parametrize("config", ["{mode: 'peer'}", "[]", '{"listen": 7}', '{"listen": {"endpoints": {}}}'])
def test_an_operators_own_configuration_does_not_hide_the_error(config: str) -> None:
    assert "boom" in why_not_open(config, ValueError("boom"))
