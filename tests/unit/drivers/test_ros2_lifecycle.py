"""What the driver of managed nodes refuses before it starts one, and how it says why one has ended."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import zenoh

from support.clocks import Clocks
from zsched.core.route.lifecycle import State, Transition
from zsched.core.values.errors import ConfigError
from zsched.drivers.place import Place
from zsched.drivers.ros2_lifecycle import LifecycleNode, as_client, fault_of, look
from zsched.link.sessions.config import worker_config


def node(tmp_path: Path, domain: str = "0") -> LifecycleNode:
    place = Place(fleet="f", node="edge1", task="t", session=tmp_path / "none", variables=())
    return LifecycleNode(argparse.Namespace(node="/{target}/slam", arg=["sh"]), place, domain)


@pytest.mark.parametrize(
    ("name", "machine", "domain", "said"),
    [
        ("/edge-1/slam", "edge-1", "0", "'edge-1' cannot stand in the ROS name /edge-1/slam"),
        ("/edge1/7", "edge1", "0", "/edge1/7 is no ROS name"),
        ("/edge1/slam", "edge1", "233", "ROS_DOMAIN_ID is '233', not a number up to 232"),
        ("/edge1/slam", "edge1", "x", "ROS_DOMAIN_ID is 'x'"),
    ],
)
def test_a_name_or_domain_that_ros_has_not_is_refused(name: str, machine: str, domain: str, said: str) -> None:
    assert said in (fault_of(name, machine, domain) or "")


def test_a_wrong_domain_is_final_and_a_missing_session_file_is_not(tmp_path: Path) -> None:
    wrong = node(tmp_path, "x").begin(lambda _: None)
    assert wrong is not None
    assert wrong.is_final
    missing = node(tmp_path).begin(lambda _: None)
    assert missing is not None
    assert "the services of /edge1/slam cannot be asked" in missing.reason
    assert not missing.is_final


def test_the_end_of_the_process_is_told_by_status_or_signal(tmp_path: Path) -> None:
    engine = node(tmp_path)
    assert engine.why(-9).reason == "/edge1/slam was killed by signal 9"
    assert engine.why(0).reason == "/edge1/slam has ended by itself"
    assert engine.why(78).is_final
    assert not engine.why(1).is_final


class Led(LifecycleNode):
    """A node that answers by the script: seconds that pass before, and the state that it tells."""

    def __init__(self, clocks: Clocks, *script: tuple[float, State | None]) -> None:
        place = Place(fleet="f", node="edge1", task="t", session=Path("none"), variables=())
        super().__init__(argparse.Namespace(node="/{target}/slam", arg=["sh"]), place, "0")
        self._clocks, self._script = clocks, iter(script)
        self.change_s, self.reasons = 0.0, list[str]()
        self._tell_end = lambda ended: self.reasons.append(ended.reason)

    def lead(self, relays: Sequence[object] = ("a relay",)) -> Led:
        info = SimpleNamespace(routers_zid=list, peers_zid=lambda: list(relays))
        self._lead(cast("Any", SimpleNamespace(info=info)))  # nothing else of it is used
        return self

    def _state(self, session: zenoh.Session) -> int | None:
        del session
        passed, state = next(self._script, (0.0, None))
        self._clocks.awake += passed
        if state is State.FINALIZED:  # the script is over
            self._stop.set()
        self._news.set()
        return None if state is State.FINALIZED else state

    def _changes(self, session: zenoh.Session, transition: Transition) -> bool:
        del session, transition
        self._clocks.awake += self.change_s
        return True


def test_a_node_is_heard_by_the_answer_to_a_long_transition(monkeypatch: pytest.MonkeyPatch) -> None:
    """It loads a map for 25 s; one question that is lost then is no silence of 27 s."""
    led = Led(
        Clocks(monkeypatch), (0.0, State.UNCONFIGURED), (2.0, None), (0.0, State.INACTIVE), (0.0, State.FINALIZED)
    )
    led.change_s = 25.0
    assert led.lead().reasons == []
    still = Led(Clocks(monkeypatch), (0.0, State.UNCONFIGURED), *(((2.0, None),) * 6))
    assert still.lead().reasons == ["/edge1/slam has not told its state for 10 s"]


def test_a_node_is_not_silent_while_its_relay_is_away(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is asked through the relay: a port that is taken for a minute is no fault of the node's."""
    script = ((0.0, State.INACTIVE), *(((2.0, None),) * 30), (0.0, State.INACTIVE), (0.0, State.FINALIZED))
    assert Led(Clocks(monkeypatch), *script).lead(relays=()).reasons == []
    assert len(Led(Clocks(monkeypatch), *script).lead().reasons) == 1


def test_a_machine_that_sleeps_is_no_silence_of_a_node(monkeypatch: pytest.MonkeyPatch) -> None:
    clocks = Clocks(monkeypatch)
    led = Led(clocks, (0.0, State.INACTIVE), (2.0, None), (0.0, State.INACTIVE), (0.0, State.FINALIZED))
    waited = led._news.wait

    def wait(timeout: float | None = None) -> bool:
        clocks.slept += 3600.0
        return waited(timeout)

    monkeypatch.setattr(led._news, "wait", wait)
    assert led.lead().reasons == []


def test_the_driver_is_a_client_of_the_nodes_relay_only() -> None:
    config = zenoh.Config.from_json5(as_client(worker_config(connect=("tcp/127.0.0.1:1", "tcp/127.0.0.1:2"))))
    assert config.get_json("mode") == '"client"'
    assert "127.0.0.1:1" in config.get_json("connect/endpoints")
    assert "127.0.0.1:2" not in config.get_json("connect/endpoints")
    for text in ("{}", "{no"):
        with pytest.raises(ConfigError):
            as_client(text)


def test_the_doctor_looks_for_the_program_and_the_name() -> None:
    assert look(["--node=/{target}/slam", "--arg=sh"], "edge1", "t").fix == ""
    assert "no program nobody-has-this" in look(["--node=/{target}/slam", "--arg=nobody-has-this"], "edge1", "t").told
    assert "cannot stand" in look(["--node=/{target}/slam", "--arg=sh"], "edge-1", "t").told
