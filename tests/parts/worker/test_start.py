"""A worker's session where its relay is late, or its file is none."""

from __future__ import annotations

import logging
import threading

import pytest
import zenoh

from support.sessions import opened
from support.waiting import free_endpoint, until
from zsched.core.values.errors import ConfigError
from zsched.core.values.fleet import WorkerLink
from zsched.link.sessions.config import client_config, data_config, worker_config
from zsched.worker.start import open_session


def test_a_client_waits_for_a_relay_that_listens_late_and_says_so_once(caplog: pytest.LogCaptureFixture) -> None:
    """The relay's port is taken: that mends itself, so the worker must not end as one that cannot run here."""
    endpoint = free_endpoint()
    text = client_config(connect=(endpoint,), connect_s=0.2)
    sessions: list[zenoh.Session] = []
    opening = threading.Thread(target=lambda: sessions.append(open_session(text)))
    with caplog.at_level(logging.WARNING, "zsched.worker"):
        opening.start()
        until(lambda: bool(caplog.records), "the word that the relay cannot be reached")
        assert not sessions
        with opened(data_config(listen=(endpoint,), connect=(), shared_memory=False)):
            opening.join(20.0)
            assert len(sessions) == 1
            assert list(sessions[0].info.peers_zid())
            sessions[0].close()
    assert len(caplog.records) == 1


@pytest.mark.parametrize("link", list(WorkerLink))
def test_a_file_that_is_no_configuration_is_told_at_once(link: WorkerLink) -> None:
    text = worker_config(connect=("tcp/127.0.0.1:1",), link=link)
    with pytest.raises(ConfigError, match="cannot be opened"):
        open_session(text[:-1])
