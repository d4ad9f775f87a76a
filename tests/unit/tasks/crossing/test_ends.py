"""The giver and the taker beside a worker that is played: what counts as given, as put, as dropped."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import zenoh

from zsched.core.values.plan import Role, WorkerRole
from zsched.errors import AdapterError
from zsched.tasks.crossing.give import Giver
from zsched.tasks.crossing.parcels import NOT_OWNER, TAKEN, Parcel, given_key, is_lasting
from zsched.tasks.crossing.take import MAX_KEYS, Taker
from zsched.tasks.crossing.ways import Ways
from zsched.worker import Received, Request
from zsched.worker.keys import output_key


class Played:
    """A worker's role, and what its outputs have put."""

    prefix = "edge1/cross"

    def __init__(self) -> None:
        self.is_owner = True
        self.is_draining = False
        self.lease_until_s: float | None = 1e9
        self.puts: list[tuple[str, bytes, Any, Any]] = []
        self.ended = 0

    @property
    def role(self) -> Role:
        if not self.is_owner:
            return Role(task="cross", role=WorkerRole.IDLE)
        role = WorkerRole.DRAINING if self.is_draining else WorkerRole.ACTIVE
        return Role(task="cross", role=role, epoch=1, lease_until_s=self.lease_until_s)

    def publisher(self, template: str, **_options: bool) -> Any:
        played = self
        output_key(template, self.prefix)

        class _Output:
            def put(self, payload: Any, *, attachment: Any = None, encoding: Any = None) -> bool:
                if played.is_owner:
                    played.puts.append((template, bytes(payload), attachment, encoding))
                return played.is_owner

        return _Output()


class Gate:
    """Another cell's gateway: the parcels that it took, or why it took none."""

    endpoint = "tcp/192.0.2.31:7458"

    def __init__(self, then: Callable[[], None] = lambda: None) -> None:
        self.took: list[Parcel] = []
        self.why = ""
        self._then = then

    def give(self, parcel: Parcel) -> str:
        if not self.why:
            self.took.append(parcel)
        self._then()
        return self.why

    def reach(self) -> str:
        return self.why


def giver(worker: Played, gate: Gate) -> Giver:
    return Giver(worker, "hall-b", Ways([gate]), 0.0)  # type: ignore[arg-type] # played


def sample(name: str = "robot1/map", **more: Any) -> Received:
    return Received(key=f"edge1/cross/{name}", payload=zenoh.ZBytes(b"x"), encoding="text/plain", **more)


def test_each_sample_is_given_under_its_own_key_with_the_next_number() -> None:
    worker, gate = Played(), Gate()
    end = giver(worker, gate)
    end.on_sample(sample())
    end.on_sample(sample("robot2/map", attachment=zenoh.ZBytes(b"a")))
    assert [(one.name, one.number, one.encoding) for one in gate.took] == [
        ("robot1/map", 1, "text/plain"),
        ("robot2/map", 2, "text/plain"),
    ]
    assert len({one.life for one in gate.took}) == 1
    assert gate.took[1].attachment is not None


def test_a_standby_gives_nothing_and_raises_nothing() -> None:
    worker, gate = Played(), Gate()
    worker.is_owner = False
    giver(worker, gate).on_sample(sample())
    assert gate.took == []


def test_what_nobody_takes_is_dropped_by_name_with_the_cell_and_the_address() -> None:
    gate = Gate()
    gate.why = "is shut"
    told = "robot1/map was dropped: hall-b did not take it: at tcp/192.0.2.31:7458 is shut"
    with pytest.raises(AdapterError, match=told):
        giver(Played(), gate).on_sample(sample())


def test_what_nobody_took_while_the_task_moved_is_the_next_owner_s() -> None:
    worker = Played()
    gate = Gate(then=lambda: setattr(worker, "is_owner", False))
    gate.why = "is shut"
    giver(worker, gate).on_sample(sample())


@pytest.mark.parametrize(
    ("one", "told"),
    [
        (
            sample("robot1/hall-b/robot7/map"),
            "robot1/hall-b/robot7/map does not cross to hall-b: it has come from there",
        ),
        (sample(deleted=True), "robot1/map was deleted: that does not cross to hall-b"),
    ],
)
def test_what_cannot_cross_is_said(one: Received, told: str) -> None:
    gate = Gate()
    with pytest.raises(AdapterError, match=told):
        giver(Played(), gate).on_sample(one)
    assert gate.took == []


def request(name: str = "robot1/map", number: int = 1) -> Request:
    parameters = Parcel(name=name, life="a1", number=number).selector("edge1/cross", "hall-a").partition("?")[2]
    key = given_key("edge1/cross", "hall-a", name)
    return Request(key=key, parameters=parameters, payload=zenoh.ZBytes(b"x"), encoding="text/plain")


def test_a_taker_puts_each_parcel_once_under_the_cell_s_name() -> None:
    worker = Played()
    taker = Taker(worker, is_latest=False)  # type: ignore[arg-type] # played
    assert [taker.on_request(request(number=number)) for number in (1, 1, 2)] == [TAKEN.encode()] * 3
    assert worker.puts == [("{prefix}/{epoch}/hall-a/robot1/map", b"x", None, "text/plain")] * 2


def test_a_taker_that_is_no_owner_says_so_and_puts_it_once_it_is() -> None:
    worker = Played()
    taker = Taker(worker, is_latest=False)  # type: ignore[arg-type] # played
    worker.is_owner = False
    assert taker.on_request(request()) == NOT_OWNER.encode()
    worker.is_owner = True
    assert taker.on_request(request()) == TAKEN.encode()
    assert len(worker.puts) == 1


def test_a_taker_that_drains_leaves_what_comes_to_the_next_owner() -> None:
    worker = Played()
    worker.is_draining = True
    assert Taker(worker, is_latest=False).on_request(request()) == NOT_OWNER.encode()  # type: ignore[arg-type] # played
    assert worker.puts == []


def test_without_a_lease_nothing_is_taken_for_a_former_owner_might_take_it() -> None:
    worker = Played()
    worker.lease_until_s = None
    with pytest.raises(AdapterError, match="must say `exclusive: true`"):
        Taker(worker, is_latest=False).on_request(request())  # type: ignore[arg-type] # played
    assert worker.puts == []


def test_a_question_for_any_key_puts_nothing() -> None:
    worker = Played()
    assert Taker(worker, is_latest=False).on_request(request("**")) == TAKEN.encode()  # type: ignore[arg-type] # played
    assert worker.puts == []


def test_keys_are_bounded() -> None:
    taker = Taker(Played(), is_latest=False)  # type: ignore[arg-type] # played
    for number in range(MAX_KEYS):
        taker.on_request(request(f"robot1/{number}", number + 1))
    with pytest.raises(AdapterError, match="4096 keys have come already"):
        taker.on_request(request("robot1/more", MAX_KEYS + 1))


def test_a_key_with_a_brace_is_refused_for_good() -> None:
    """Each of its samples held up all others for 10 s."""
    with pytest.raises(AdapterError, match=r"^never taken: hall-a/robot1/\{x\}: .*no placeholder \{x\}") as refused:
        Taker(Played(), is_latest=False).on_request(request("robot1/{x}"))  # type: ignore[arg-type] # played
    assert is_lasting(str(refused.value))


def test_one_key_too_many_is_refused_for_good() -> None:
    taker = Taker(Played(), is_latest=False)  # type: ignore[arg-type] # played
    for number in range(MAX_KEYS):
        taker.on_request(request(f"robot1/{number}", number + 1))
    with pytest.raises(AdapterError, match=r"^never taken: "):
        taker.on_request(request("robot1/more", MAX_KEYS + 1))
    assert taker.on_request(request("robot1/0", MAX_KEYS + 2)) == TAKEN.encode()
