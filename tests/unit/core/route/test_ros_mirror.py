"""Each side of a stream is shown the other's endpoints, under its own names."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from zsched.core.route.ros2 import Endpoint, EndpointKind
from zsched.core.route.ros_mirror import MAX_ENDPOINTS, Sides, mirrored
from zsched.core.values.plan import Direction, RosGraph, Route, StreamClass, StreamSettings

TYPE, HASH, QOS = "std_msgs::msg::dds_::String_", "RIHS01_ab", ":1:,1:,:,:,,"
MP, MS, SS, SC = EndpointKind.PUBLISHER, EndpointKind.SUBSCRIPTION, EndpointKind.SERVICE, EndpointKind.CLIENT
NOBODY = Sides(local=frozenset(), fleet=frozenset())


def one(kind: EndpointKind, topic: str, qos: str = QOS) -> Endpoint:
    return Endpoint(kind=kind, key=f"0/{topic}/{TYPE}/{HASH}", qos=qos)


def route(
    direction: Direction, from_expr: str, to_expr: str, graph: RosGraph = RosGraph.RMW_ZENOH, name: str = "t/in/0"
) -> Route:
    settings = StreamSettings(stream_class=StreamClass.LATEST, graph=graph)
    return Route(stream=name, direction=direction, from_expr=from_expr, to_expr=to_expr, settings=settings)


INPUT = route(Direction.INPUT, "0/robot1/map/*/*", "0/edge1/m/robot1/map/*/*")
OUTPUT = route(Direction.OUTPUT, "0/edge1/m/map/*/*", "0/robot1/merged/*/*")
SERVICE = route(Direction.SERVICE, "0/robot1/now/*/*", "0/edge1/now/*/*")


def test_a_publisher_is_shown_forwards_and_a_subscription_backwards() -> None:
    seen = Sides(
        local=frozenset({one(MP, "robot1/map")}), fleet=frozenset({one(MS, "edge1/m/robot1/map", "::,5:,:,:,,")})
    )
    assert mirrored([INPUT], seen) == Sides(
        local=frozenset({one(MS, "robot1/map", "::,5:,:,:,,")}), fleet=frozenset({one(MP, "edge1/m/robot1/map")})
    )


def test_a_lazy_camera_sees_one_subscription_that_takes_what_crosses_machines() -> None:
    by_cpu = "2::,5:,:,:,,/backends:cpu:"
    camera, detector = one(MP, "robot1/map", by_cpu), one(MS, "edge1/m/robot1/map", by_cpu)
    seen = Sides(local=frozenset({camera}), fleet=frozenset({detector}))
    assert mirrored([INPUT], seen).local == {one(MS, "robot1/map", by_cpu)}
    plain = route(Direction.INPUT, "0/robot1/map/*/*", "edge1/m/robot1/map")
    assert mirrored([plain], seen).local == {one(MS, "robot1/map", by_cpu)}, "the relay stands in for a plain worker"


def test_an_output_goes_the_other_way() -> None:
    seen = Sides(local=frozenset({one(MS, "robot1/merged")}), fleet=frozenset({one(MP, "edge1/m/map")}))
    assert mirrored([OUTPUT], seen) == Sides(
        local=frozenset({one(MP, "robot1/merged")}), fleet=frozenset({one(MS, "edge1/m/map")})
    )


def test_a_service_is_shown_to_the_robot_and_its_clients_to_the_worker() -> None:
    seen = Sides(local=frozenset({one(SC, "robot1/now")}), fleet=frozenset({one(SS, "edge1/now")}))
    assert mirrored([SERVICE], seen) == Sides(
        local=frozenset({one(SS, "robot1/now")}), fleet=frozenset({one(SC, "edge1/now")})
    )


def test_a_worker_with_plain_keys_is_stood_in_for() -> None:
    plain = route(Direction.INPUT, f"0/robot1/map/{TYPE}/*", "edge1/m/robot1/map")
    seen = Sides(local=frozenset({one(MP, "robot1/map")}), fleet=frozenset())
    assert mirrored([plain], seen) == Sides(local=frozenset({one(MS, "robot1/map")}), fleet=frozenset())
    back = route(Direction.OUTPUT, "edge1/m/7/map", f"0/robot1/merged/{TYPE}/{HASH}")
    assert mirrored([back], NOBODY) == Sides(local=frozenset({one(MP, "robot1/merged")}), fleet=frozenset())
    served = route(Direction.SERVICE, f"0/robot1/now/{TYPE}/{HASH}", "edge1/m/now")
    assert mirrored([served], NOBODY).local == frozenset({one(SS, "robot1/now", "::,10:,:,:,,")})


def test_keys_that_are_none_of_ros_or_that_nobody_can_name_are_not_announced() -> None:
    plain = route(Direction.OUTPUT, "edge1/m/7/map", "robot1/merged")
    wild = route(Direction.OUTPUT, "edge1/m/7/map", f"0/robot1/merged/{TYPE}/*")
    for silent in (plain, wild):
        assert mirrored([silent], NOBODY) == NOBODY


def test_a_plain_service_is_stood_in_for_where_its_clients_ask() -> None:
    """Its name is open: only who asks says for what."""
    wild = route(Direction.SERVICE, "0/robot1/now/*/*", "edge1/m/now")
    others = {one(SC, "robot2/now"), one(SS, "robot1/now"), one(MS, "robot1/now")}
    seen = Sides(local=frozenset({one(SC, "robot1/now")} | others), fleet=frozenset())
    assert mirrored([wild], seen) == Sides(local=frozenset({one(SS, "robot1/now")}), fleet=frozenset())


def test_a_plain_worker_is_stood_in_for_only_where_it_is_meant() -> None:
    plain = route(Direction.INPUT, f"0/robot1/map/{TYPE}/*", "edge1/m/robot1/map")
    seen = Sides(local=frozenset({one(MP, "robot1/map"), one(MP, "robot1/scan")}), fleet=frozenset())
    assert mirrored([plain], seen).local == frozenset({one(MS, "robot1/map")})


def test_a_subscription_is_not_shown_where_its_key_cannot_be_told() -> None:
    """The type is open on one side only: which one it is there, nobody knows."""
    dropped = route(Direction.INPUT, "0/robot1/*/*/*", f"0/edge1/m/{TYPE}/*")
    seen = Sides(local=frozenset(), fleet=frozenset({one(MS, "edge1/m")}))
    assert mirrored([dropped], seen) == NOBODY


def test_one_session_for_both_sides_shows_both_there() -> None:
    everything = frozenset({one(MP, "robot1/map"), one(MS, "edge1/m/robot1/map")})
    shown = mirrored([INPUT], Sides(local=everything, fleet=everything))
    assert shown.local | shown.fleet == {one(MS, "robot1/map"), one(MP, "edge1/m/robot1/map")}


def test_the_bridge_has_types_in_its_tokens() -> None:
    grid = {"type_name": "nav_msgs/msg/OccupancyGrid", "qos": ":1:1:0,1"}
    dds = route(Direction.INPUT, "map", "edge1/m/robot1/map", RosGraph.ROS2DDS)
    seen = Sides(local=frozenset({Endpoint(kind=MP, key="map", **grid)}), fleet=frozenset())
    assert mirrored([dds], seen).fleet == {Endpoint(kind=MP, key="edge1/m/robot1/map", **grid)}


@given(
    st.lists(st.sampled_from([one(kind, topic) for kind in EndpointKind for topic in ("robot1/map", "edge1/m/map")]))
)
def test_what_is_shown_of_a_stream_leads_back_to_what_was_seen(endpoints: list[Endpoint]) -> None:
    seen = Sides(local=frozenset(endpoints), fleet=frozenset(endpoints))
    shown = mirrored([INPUT, OUTPUT], seen)
    assert {one.kind for one in shown.local | shown.fleet} <= {MP, MS}
    assert mirrored([INPUT, OUTPUT], seen) == shown


def test_a_huge_graph_is_shown_in_part() -> None:
    crowd = frozenset(one(MP, "robot1/map", str(number)) for number in range(MAX_ENDPOINTS + 10))
    assert len(mirrored([INPUT], Sides(local=crowd, fleet=frozenset())).fleet) == MAX_ENDPOINTS
