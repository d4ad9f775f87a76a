"""Keys, graph tokens and attachments of ROS 2 over zenoh, held to recorded ones."""

from __future__ import annotations

import doctest
import json
from pathlib import Path
from typing import Any

import pytest
import zenoh
import zenoh.ext
from hypothesis import given
from hypothesis import strategies as st

from zsched.core.route import keyexpr, ros2
from zsched.core.route.keyexpr import fault, includes
from zsched.core.route.ros2 import (
    Attachment,
    Endpoint,
    EndpointKind,
    decode_attachment,
    default_qos,
    encode_attachment,
    endpoint_token,
    hash_fault,
    is_rmw_key,
    name_fault,
    node_token,
    parse_token,
    ros_key,
    token_selector,
    type_fault,
)
from zsched.core.values.plan import RosGraph

STRING_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
CHATTER = f"0/chatter/std_msgs::msg::dds_::String_/{STRING_HASH}"
SERVICE_HASH = "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a"

# as rmw_zenoh's design document shows them (domain 2)
LISTENER = "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/listener"
SUBSCRIPTION = (
    "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/10/MS/%/%/listener/%chatter/std_msgs::msg::dds_::String_/"
    f"{STRING_HASH}/::,10:,:,:,,"
)
SERVER = (
    "@ros2_lv/2/f9980ee0495eaafb3e38f0d19e2eae12/0/10/SS/%/%/add_two_ints_server/%add_two_ints/"
    f"example_interfaces::srv::dds_::AddTwoInts_/{SERVICE_HASH}/::,10:,:,:,,"
)
# of a topic with buffer fields, as rmw_zenoh_cpp 0.10.5 (Lyrical) writes it; the list is that of a node with one GPU
CAMERA = "@ros2_lv/0/abc/0/1/MS/%/%/cam/%image/sensor_msgs::msg::dds_::Image_/RIHS01_x/2::,5:,:,:,,"
# the ros2dds bridge, 1.x
BRIDGED = "@/f9980ee0495eaafb3e38f0d19e2eae12/@ros2_lv/MP/robot1§map/nav_msgs§msg§OccupancyGrid/:1:1:0,1"


def test_keys_are_those_of_the_design_document() -> None:
    key = ros_key(RosGraph.RMW_ZENOH, "/chatter", domain=0, type_name="std_msgs/msg/String", type_hash=STRING_HASH)
    assert key == CHATTER
    namespaced = ros_key(RosGraph.RMW_ZENOH, "/robot1/chatter", domain=0, type_name="std_msgs/msg/String")
    assert namespaced == "0/robot1/chatter/std_msgs::msg::dds_::String_/*"
    service = ros_key(
        RosGraph.RMW_ZENOH,
        "/add_two_ints",
        domain=2,
        type_name="example_interfaces/srv/AddTwoInts",
        type_hash=SERVICE_HASH,
    )
    assert service == f"2/add_two_ints/example_interfaces::srv::dds_::AddTwoInts_/{SERVICE_HASH}"
    assert ros_key(RosGraph.ROS2DDS, "/robot1/map", domain=0) == "robot1/map"


def test_a_key_with_open_type_and_hash_includes_the_real_one() -> None:
    open_key = ros_key(RosGraph.RMW_ZENOH, "/chatter", domain=0)
    assert includes(open_key, CHATTER)
    assert is_rmw_key(open_key)
    assert is_rmw_key(CHATTER)
    assert is_rmw_key("0/chatter/std_msgs::msg::dds_::String_/TypeHashNotSupported")


def test_recorded_tokens_are_read() -> None:
    assert parse_token(SUBSCRIPTION) == (
        "aac3178e146ba6f1fc6e6a4085e77f21",
        Endpoint(kind=EndpointKind.SUBSCRIPTION, key=CHATTER.replace("0/", "2/", 1), qos="::,10:,:,:,,"),
    )
    parsed = parse_token(SERVER)
    assert parsed is not None
    assert parsed[1].kind is EndpointKind.SERVICE
    assert parsed[1].key == f"2/add_two_ints/example_interfaces::srv::dds_::AddTwoInts_/{SERVICE_HASH}"
    assert parse_token(BRIDGED) == (
        "f9980ee0495eaafb3e38f0d19e2eae12",
        Endpoint(kind=EndpointKind.PUBLISHER, key="robot1/map", type_name="nav_msgs/msg/OccupancyGrid", qos=":1:1:0,1"),
    )
    without_qos = parse_token(BRIDGED.rpartition("/")[0])
    assert without_qos is not None
    assert (without_qos[1].key, without_qos[1].qos) == ("robot1/map", "")
    assert parse_token(LISTENER) is None


@pytest.mark.parametrize("more", ["/backends:cpu:", "/backends:cuda:0;cpu:", "/later:1/backends:cpu:/later"])
def test_a_token_that_names_backends_is_announced_again_with_what_crosses_machines(more: str) -> None:
    parsed = parse_token(CAMERA + more)
    assert parsed is not None
    key = "0/image/sensor_msgs::msg::dds_::Image_/RIHS01_x"
    assert parsed[1] == Endpoint(kind=EndpointKind.SUBSCRIPTION, key=key, qos="2::,5:,:,:,,/backends:cpu:")
    ours = endpoint_token(RosGraph.RMW_ZENOH, parsed[1], zid="abc", node="cam", number=1)
    assert ours == f"{CAMERA}/backends:cpu:"
    assert zenoh.KeyExpr(token_selector(RosGraph.RMW_ZENOH)).includes(ours)


def test_what_follows_is_tolerated() -> None:
    assert parse_token(f"{CAMERA}/what/ever") == parse_token(CAMERA)
    assert parse_token(f"{BRIDGED}/what/ever") == parse_token(BRIDGED)
    value = Attachment(sequence=1, stamp_ns=2, gid=bytes(range(16)))
    assert decode_attachment(encode_attachment(value) + b"more") == value


WORDS = json.loads((Path(__file__).parent / "words" / "kilted-0.6.7.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("domain", ["0", "7"])
def test_what_live_nodes_say_is_read_and_said_again_to_the_letter(domain: str) -> None:
    """The words file names its source."""
    words = WORDS[f"domain_{domain}"]
    nodes = [token for token in words["tokens"] if "/NN/" in token]
    assert len(nodes) == 3
    for token in words["tokens"]:
        parsed, chunks = parse_token(token), token.split("/")
        assert (parsed is None) == (token in nodes)
        if parsed is None:
            continue
        zid, endpoint = parsed
        assert (zid, is_rmw_key(endpoint.key), endpoint.key.split("/")[0]) == (chunks[2], True, domain)
        ours = endpoint_token(RosGraph.RMW_ZENOH, endpoint, zid=zid, node=chunks[8], number=int(chunks[4])).split("/")
        assert (ours[:3], ours[4:6], ours[8:]) == (chunks[:3], chunks[4:6], chunks[8:])
    keys = {parsed[1].key for token in words["tokens"] if (parsed := parse_token(token)) is not None}
    assert keys >= {*words["attachments"], *words["asked"]}
    for raw in [*words["asked"].values(), *(one for those in words["attachments"].values() for one in those)]:
        value = decode_attachment(bytes.fromhex(raw))
        assert value is not None
        assert value.sequence >= 1
        assert encode_attachment(value).hex() == raw


RELEASES = json.loads((Path(__file__).parent / "words" / "releases.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("of", RELEASES, ids=[str(number) for number in range(len(RELEASES))])
def test_tokens_of_each_release_are_read_and_said_again(of: dict[str, Any]) -> None:
    """The words file names the source of each form."""
    for token, expected in of["tokens"].items():
        assert str(zenoh.KeyExpr(token)) == token
        parsed = parse_token(token)
        if expected is None:
            assert parsed is None, token
            continue
        kind, key, type_name, qos = expected
        endpoint = Endpoint(kind=EndpointKind(kind), key=key, type_name=type_name, qos=qos)
        assert parsed is not None, token
        assert parsed[1] == endpoint
        graph = RosGraph.ROS2DDS if token.startswith("@/") else RosGraph.RMW_ZENOH
        ours = endpoint_token(graph, endpoint, zid="5eed", node="zsched_robot1", number=7)
        assert parse_token(ours) == ("5eed", endpoint)
        assert not qos or parse_token(f"{token}/later") == parsed, "what follows is tolerated"


def test_keys_beside_a_topic_with_buffers_are_told_apart_from_topics() -> None:
    """buffer_endpoint_helpers.hpp of rmw_zenoh at b84b89eed63a91f6ec63ee34f173d2433ba3fcf4."""
    assert is_rmw_key(CHATTER)
    assert ros2.has_buffers_beside(RosGraph.RMW_ZENOH, CHATTER)
    for beside in (ros2.BUFFERS, f"/_buf/{'0f' * 16}"):
        assert not is_rmw_key(CHATTER + beside)
    assert not ros2.has_buffers_beside(RosGraph.ROS2DDS, "robot1/map")


def test_the_attachment_with_names_of_before_the_first_release_is_none() -> None:
    """attachment_helpers.cpp of rmw_zenoh at 038b5a4fbb337e8033a7474a4a788fa381204c3c."""
    named = ("sequence_number", zenoh.ext.Int64(1)), ("source_timestamp", zenoh.ext.Int64(2))
    raw = b"".join(zenoh.ext.z_serialize(one).to_bytes() for pair in named for one in pair)
    raw += zenoh.ext.z_serialize("source_gid").to_bytes() + zenoh.ext.z_serialize(bytes(16)).to_bytes()
    assert decode_attachment(raw) is None


@pytest.mark.parametrize(("graph", "token"), [(RosGraph.RMW_ZENOH, SUBSCRIPTION), (RosGraph.ROS2DDS, BRIDGED)])
def test_tokens_that_we_write_differ_from_recorded_ones_in_whose_they_are_only(graph: RosGraph, token: str) -> None:
    parsed = parse_token(token)
    assert parsed is not None
    ours = endpoint_token(graph, parsed[1], zid="5eed", node="zsched_robot1", number=7)
    assert parse_token(ours) == ("5eed", parsed[1])
    expected = token.replace(parsed[0], "5eed").replace("/0/10/", "/0/7/").replace("/listener/", "/zsched_robot1/")
    assert ours == expected
    assert zenoh.KeyExpr(token_selector(graph)).includes(ours)


def test_the_node_of_our_endpoints() -> None:
    assert node_token(RosGraph.RMW_ZENOH, domain="2", zid="5eed", node="zsched_robot1") == (
        "@ros2_lv/2/5eed/0/0/NN/%/%/zsched_robot1"
    )
    assert node_token(RosGraph.ROS2DDS, domain="2", zid="5eed", node="n") is None


@given(st.text(alphabet="@ros2_lv/%§:,MPSNC0a*", max_size=80))
def test_any_token_is_read_or_not_never_an_exception(token: str) -> None:
    parse_token(token)


@pytest.mark.parametrize(
    "name", ["/map", "/{robot}/map", "/{target}/merge/{robot}/map", "/_x/y_1", "/{robot}/s/*", "/a/**"]
)
def test_ros_names(name: str) -> None:
    assert name_fault(name) is None


@given(st.text(alphabet="/ab1_{}rot*", max_size=20))
def test_a_ros_name_makes_a_valid_key(name: str) -> None:
    if name_fault(name) is None and "**" not in name:
        assert fault(ros2.ros_key(RosGraph.RMW_ZENOH, name.replace("{", "").replace("}", ""), domain=0)) is None


@pytest.mark.parametrize(
    ("node", "may"), [("robot_1", True), ("r", True), ("a__b", False), ("7up", False), ("a-b", False)]
)
def test_a_node_s_name_may_stand_in_a_ros_name_or_not(node: str, *, may: bool) -> None:
    assert (ros2.node_name_fault(node) is None) is may
    assert (name_fault(f"/{node}/map") is None) is may


def test_types_and_hashes() -> None:
    for is_service in (False, True):
        assert type_fault("any", is_service=is_service) is None
        assert "under `actions:`" in (type_fault("a/action/B", is_service=is_service) or "")
        assert type_fault("a/msg/B_SendGoal", is_service=is_service)
        assert type_fault("std_msgs/String", is_service=is_service)


@pytest.mark.parametrize("name", ["std_msgs/msg/String", "nav2_msgs/action/Spin_FeedbackMessage"])
def test_the_type_of_a_topic_is_none_of_a_service(name: str) -> None:
    assert type_fault(name, is_service=False) is None
    assert type_fault(name, is_service=True) == "it is the type of a topic, this is a service"


@pytest.mark.parametrize("name", ["a/srv/B", "nav2_msgs/action/Spin_SendGoal", "nav2_msgs/action/Spin_GetResult"])
def test_the_type_of_a_service_is_none_of_a_topic(name: str) -> None:
    assert type_fault(name, is_service=True) is None
    assert type_fault(name, is_service=False) == "it is the type of a service, this is a topic"


def test_an_actions_services_have_keys_like_others() -> None:
    key = ros_key(RosGraph.RMW_ZENOH, "/spin/_action/send_goal", domain=3, type_name="nav2_msgs/action/Spin_SendGoal")
    assert key == "3/spin/_action/send_goal/nav2_msgs::action::dds_::Spin_SendGoal_/*"
    assert is_rmw_key(key)


@pytest.mark.parametrize(
    ("type_name", "type_hash", "key"),
    [
        ("any", "any", "0/sensors/*/*/**"),
        ("any", "TypeHashNotSupported", "0/sensors/*/**/TypeHashNotSupported"),
        ("std_msgs/msg/String", "any", "0/sensors/**/std_msgs::msg::dds_::String_/*"),
    ],
)
def test_a_name_that_ends_in_two_asterisks_makes_a_canonical_key(type_name: str, type_hash: str, key: str) -> None:
    made = ros_key(RosGraph.RMW_ZENOH, "/sensors/**", domain=0, type_name=type_name, type_hash=type_hash)
    assert made == key
    assert keyexpr.fault(made) is None
    assert is_rmw_key(made)
    assert hash_fault(STRING_HASH) is None
    assert hash_fault("TypeHashNotSupported") is None
    assert hash_fault("RIHS01_df")


# caught from a live rmw_zenoh_cpp 0.1.8 (Humble): `ros2 topic pub /chatter`
LIVE_TOKEN = (
    "@ros2_lv/0/9ca0f8facf84ffb1e6bfa4f2500889f0/0/3/MP/%/%/_ros2cli_712/%chatter/"
    "std_msgs::msg::dds_::String_/TypeHashNotSupported/"
)
LIVE_QOS = ":1:,1:,:,:,,"
LIVE_ATTACHMENT = bytes.fromhex("d800000000000000" + "34dae10162f8c418" + "10" + "f07168d3856ce9f689254cbed6252151")


@pytest.mark.parametrize("qos", [LIVE_QOS, "2::,1:,:,:,,", "2::,7:,:,:,,"])
def test_a_live_publishers_token_is_read_and_told_on_with_its_qos(qos: str) -> None:
    """In three forms of QoS: that of 0.1.8, and older ones."""
    parsed = parse_token(LIVE_TOKEN + qos)
    assert parsed is not None
    key = "0/chatter/std_msgs::msg::dds_::String_/TypeHashNotSupported"
    assert parsed == (
        "9ca0f8facf84ffb1e6bfa4f2500889f0",
        Endpoint(kind=EndpointKind.PUBLISHER, key=key, qos=qos),
    )
    ours = endpoint_token(RosGraph.RMW_ZENOH, parsed[1], zid="5eed", node="zsched_robot1", number=3)
    assert ours == (LIVE_TOKEN + qos).replace(parsed[0], "5eed").replace("_ros2cli_712", "zsched_robot1")
    assert includes(ros_key(RosGraph.RMW_ZENOH, "/chatter", domain=0), key)


def test_what_we_announce_of_a_latched_topic_is_what_a_live_node_announces() -> None:
    assert default_qos(is_latched=True, depth=1) == LIVE_QOS


def test_a_live_publishers_attachment_is_read_and_written() -> None:
    value = decode_attachment(LIVE_ATTACHMENT)
    assert value is not None
    assert value.sequence == 216
    assert value.stamp_ns == 0x18C4F86201E1DA34
    assert value.gid.hex() == "f07168d3856ce9f689254cbed6252151"
    assert encode_attachment(value) == LIVE_ATTACHMENT


# written out by hand from the design document: sequence 42, a stamp in ns, the length of the gid, the gid
RECORDED = bytes.fromhex("2a000000000000000033d8a53358c317" + "10" + "000102030405060708090a0b0c0d0e0f")


def test_the_attachment_is_33_bytes_in_the_right_order() -> None:
    value = Attachment(sequence=42, stamp_ns=0x17C35833A5D83300, gid=bytes(range(16)))
    assert encode_attachment(value) == RECORDED
    assert decode_attachment(RECORDED) == value
    odd = Attachment(sequence=-2, stamp_ns=0x17C35833A5D8337F, gid=bytes(range(16)))
    assert decode_attachment(encode_attachment(odd)) == odd, "no byte is another's"


@given(st.integers(-(2**63), 2**63 - 1), st.integers(0, 2**63 - 1), st.binary(min_size=16, max_size=16))
def test_the_attachment_is_what_zenohs_own_serializer_writes(sequence: int, stamp: int, gid: bytes) -> None:
    ours = encode_attachment(Attachment(sequence=sequence, stamp_ns=stamp, gid=gid))
    fields = (zenoh.ext.Int64(sequence), zenoh.ext.Int64(stamp), gid)
    assert ours == zenoh.ext.z_serialize(fields).to_bytes()
    assert decode_attachment(ours) == Attachment(sequence=sequence, stamp_ns=stamp, gid=gid)


@pytest.mark.parametrize("value", [(1, 1, b"short"), (2**63, 1, bytes(16))])
def test_what_does_not_fit_is_refused(value: tuple[int, int, bytes]) -> None:
    with pytest.raises(ValueError, match=r"gid|attachment"):
        encode_attachment(Attachment(sequence=value[0], stamp_ns=value[1], gid=value[2]))


@given(st.binary(max_size=40))
def test_any_bytes_are_an_attachment_or_not(raw: bytes) -> None:
    value = decode_attachment(raw)
    assert value is None or encode_attachment(value) == raw


def test_examples_in_the_module_hold() -> None:
    assert doctest.testmod(ros2).failed == 0
