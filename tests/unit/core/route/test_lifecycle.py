"""The bytes of a managed node's services are those of an independent encoder; which step leads to which state."""

from __future__ import annotations

from typing import Any

import pytest
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from zsched.core.route.lifecycle import State, Transition, change_state_request, is_changed, state_of, step


@pytest.fixture(scope="module")
def store() -> Any:
    made = get_typestore(Stores.ROS2_HUMBLE)
    made.register(get_types_from_msg("lifecycle_msgs/Transition transition\n", "test_msgs/msg/Request"))
    made.register(get_types_from_msg("bool success\n", "test_msgs/msg/Response"))
    made.register(get_types_from_msg("lifecycle_msgs/State current_state\n", "test_msgs/msg/Told"))
    return made


@pytest.mark.parametrize("transition", list(Transition))
def test_a_request_is_read_as_its_id_without_a_label(store: Any, transition: Transition) -> None:
    read = store.deserialize_cdr(change_state_request(transition), "test_msgs/msg/Request").transition
    assert (read.id, read.label) == (int(transition), "")
    constants = store.types["lifecycle_msgs/msg/Transition"]
    assert getattr(constants, f"TRANSITION_{transition.name}") == transition


@pytest.mark.parametrize("state", list(State))
def test_answers_of_an_independent_encoder_are_read(store: Any, state: State) -> None:
    types = store.types
    told = types["test_msgs/msg/Told"](current_state=types["lifecycle_msgs/msg/State"](id=int(state), label="x"))
    assert state_of(bytes(store.serialize_cdr(told, "test_msgs/msg/Told"))) == state
    assert getattr(types["lifecycle_msgs/msg/State"], f"PRIMARY_STATE_{state.name}") == state
    for success in (True, False):
        answer = bytes(store.serialize_cdr(types["test_msgs/msg/Response"](success=success), "test_msgs/msg/Response"))
        assert is_changed(answer) is success


@pytest.mark.parametrize("garbage", [b"", b"\x00\x01\x00\x00", b"\x01\x01\x00\x00\x01", b"error"])
def test_what_is_no_answer_says_nothing(garbage: bytes) -> None:
    assert state_of(garbage) is None
    assert is_changed(garbage) is None


def test_the_steps_lead_to_the_state_of_the_role_and_stop_there() -> None:
    ways = {
        Transition.CONFIGURE: State.INACTIVE,
        Transition.ACTIVATE: State.ACTIVE,
        Transition.DEACTIVATE: State.INACTIVE,
    }
    for is_owner, end in ((True, State.ACTIVE), (False, State.INACTIVE)):
        for start in (State.UNCONFIGURED, State.INACTIVE, State.ACTIVE):
            state = start
            while (transition := step(state, is_owner=is_owner)) is not None:
                state = ways[transition]
            assert state == end
    for passing in (State.FINALIZED, 10, 13, 15):
        assert step(passing, is_owner=True) is None
