"""A stream that crosses between two cells of real daemons: every sample, and what deaths, freezes and silences cost."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import psutil
import pytest
import zenoh

from support.authorities import install, secured
from support.waiting import TooSlowError
from zsched.core.values.certificates import Role
from zsched.core.values.struct import replace
from zsched.pki.authority import opened
from zsched.runtime.access_rules import Side
from zsched.runtime.tls import session_text
from zsched.sessions.config import client_config
from zsched.tasks.crossing.gateway import NOBODY, Gateway
from zsched.tasks.crossing.parcels import Parcel
from zsched_lab.fleet.crossing import CAME, GIVING, TAKING, Ends, cell, let_cross, relays
from zsched_lab.fleet.loopback import free_endpoint
from zsched_lab.fleet.testbed import Json, Testbed

pytestmark = pytest.mark.timeout(240)
WAIT_S = 60.0


def beds_of(stack: ExitStack, folder: Path, here: Json, there: Json) -> tuple[Testbed, Testbed]:
    """(hall-a's, hall-b's) daemons, which are not started."""
    beds = []
    for tree in (here, there):
        (folder / tree["fleet"]).mkdir(exist_ok=True)
        beds.append(stack.enter_context(Testbed(folder / tree["fleet"], tree)))
        beds[-1].init()
    return beds[0], beds[1]


@pytest.fixture
def on_crash() -> str:
    return "replay"


@pytest.fixture
def ends(tmp_path: Path, on_crash: str) -> Iterator[Ends]:
    here, there = cell(GIVING), cell(TAKING)
    let_cross(here, there, on_crash=on_crash)
    with ExitStack() as stack:
        beds = beds_of(stack, tmp_path, here, there)
        for bed in beds:
            bed.start()
        for bed in beds:
            bed.wait_whole()
        yield Ends(*beds)


def moved(bed: Testbed, former: str) -> None:
    """Wait until another node is the owner, by the word of all others."""
    others = tuple(name for name in bed.running() if name != former)
    bed.wait(lambda: bed.owner(*others) not in (former, None), WAIT_S, f"an owner after {former}")


def owner_of(bed: Testbed) -> str:
    owner = bed.owner()
    assert owner is not None
    return owner


def once_each(got: list[int]) -> list[int]:
    """Each number where it came first."""
    return list(dict.fromkeys(got))


def counted(ends: Ends, word: str) -> int:
    """What hall-a's relay has counted of the stream, once a second."""
    return sum(getattr(one, word) for one in ends.here.counts("robot1"))


def test_every_sample_crosses_once_and_in_order_also_while_both_ends_move(ends: Ends) -> None:
    with ends.sending():
        ends.flows()
        for bed in (ends.here, ends.there):
            owner = owner_of(bed)
            bed.stop(owner)
            moved(bed, owner)
            ends.flows()
    ends.settle()
    assert sorted(once_each(ends.got)) == list(range(ends.sent))
    ends.here.wait(lambda: counted(ends, "messages") >= ends.sent, WAIT_S, "samples in the books")
    if counted(ends, "replayed"):
        raise TooSlowError("a giver did not keep up with its move: what it had left went by on_crash")
    assert ends.got == list(range(ends.sent))
    first = ends.samples[0]
    assert {str(sample.key_expr) for sample in ends.samples} == {CAME}
    assert str(first.encoding) == "text/plain"
    assert first.attachment is not None
    assert first.attachment.to_bytes() == b"kept"


@pytest.mark.long
@pytest.mark.parametrize("on_crash", ["replay", "report"])
def test_a_giver_that_is_killed_has_a_successor_and_the_books_tell_what_was_lost(ends: Ends, on_crash: str) -> None:
    with ends.sending():
        ends.flows()
        owner = owner_of(ends.here)
        ends.here.kill(owner)
        moved(ends.here, owner)
        ends.flows()
    ends.settle()
    came = once_each(ends.got)
    assert came == sorted(came)
    lost = ends.sent - len(came)
    if on_crash == "replay":
        assert lost == 0

    def is_told() -> bool:  # the relay counts once a second
        counts = ends.here.counts("robot1")
        dropped = sum(number for one in counts for _, number in one.drops)
        told = dropped + sum(one.at_most_lost + one.lost for one in counts)
        return lost <= told and dropped + sum(one.messages for one in counts) >= ends.sent

    ends.here.wait(is_told, WAIT_S, f"{lost} of {ends.sent} samples in the books")


@pytest.mark.long
@pytest.mark.parametrize("how", ["killed", "frozen"])
def test_the_next_gateway_is_used_when_the_first_is_gone_with_its_taker(ends: Ends, how: str) -> None:
    there, frozen = ends.there, list[psutil.Process]()
    with ends.sending():
        ends.flows()
        owner = owner_of(there)
        if how == "killed":
            there.kill(owner)
        else:
            daemon = psutil.Process(there.pid(owner))
            frozen = [daemon, psutil.Process(there.relay_pid(owner)), *daemon.children(recursive=True)]
            for process in frozen:
                process.suspend()
        moved(there, owner)
        ends.flows()
    for process in frozen:
        process.resume()
    ends.settle()
    assert set(ends.got) == set(range(ends.sent))


@pytest.mark.long
def test_a_giver_that_reaches_nobody_says_so_and_what_it_drops_is_counted(tmp_path: Path) -> None:
    here, there = cell(GIVING), cell(TAKING)
    let_cross(here, there, "--patience", "0.5")
    gateways = relays(there)
    with ExitStack() as stack:
        giving, taking = beds_of(stack, tmp_path, here, there)
        giving.start()

        def told(*words: str) -> str:
            texts: list[str] = giving.task("robot1")["problems"]
            return next((text for text in texts if all(word in text for word in words)), "")

        giving.wait(lambda: told("hall-b cannot be reached", gateways[0]), WAIT_S, "why no giver is ready")
        taking.start()
        taking.wait_whole()
        giving.wait_whole()
        ends = Ends(giving, taking)
        ends.flows()
        taking.kill("edge1")
        taking.kill("edge2")
        with ends.sending():
            giving.wait(lambda: told("callback raised", "hall-b did not take it", gateways[1]), WAIT_S, "the trouble")
            taking.start()
            taking.wait_whole()
            ends.flows()
        ends.settle()
        lost = ends.sent - len(set(ends.got))
        words = "callback raised once" if lost == 1 else f"callback raised {lost} times"
        giving.wait(lambda: told(words), WAIT_S, f"the word that {lost} were dropped")


def at_home(bed: Testbed, stack: ExitStack) -> zenoh.Session:
    """An application of robot1's host, by its local side."""
    side = bed.fleet.node("robot1").local
    assert side is not None
    session = zenoh.open(zenoh.Config.from_json5(client_config(connect=side.listen)))
    stack.callback(session.close)
    return session


def test_secured_cells_whose_applications_know_nothing_of_each_other(tmp_path: Path) -> None:
    here, there = cell(GIVING), cell(TAKING)
    for tree, security in ((here, {}), (there, {"guests": [GIVING, "screen"]})):
        (tmp_path / tree["fleet"]).mkdir()
        secured(tree, tmp_path / tree["fleet"], security=security)
        tree["nodes"]["robot1"]["local"] = {"mode": "peer", "listen": [free_endpoint()]}
    desk = tmp_path / "of-hall-b"  # as on each machine of hall-a that may run the giver
    with opened(tmp_path / TAKING / "authority", TAKING) as authority:
        for guest in (GIVING, "screen"):
            install(authority, desk / guest, guest, Role.GUEST)
    file = desk / "hall-b.yaml"
    let_cross(here, there, "--file", str(file))
    file.write_text(json.dumps({**there, "security": {**there["security"], "folder": GIVING}}))
    with ExitStack() as stack:
        giving, taking = beds_of(stack, tmp_path, here, there)
        for bed in (giving, taking):
            bed.start()
        for bed in (giving, taking):
            bed.wait_whole(90)
        ends = Ends(giving, taking, at_home(giving, stack), at_home(taking, stack))
        with ends.sending():
            ends.flows()
        ends.settle()
        assert ends.got == list(range(ends.sent))

        assert taking.fleet.security is not None
        screen = replace(taking.fleet, security=replace(taking.fleet.security, folder=str(desk / "screen")))
        text = session_text(screen, Side.VISIT, {})
        forged = Parcel(name="robot1/pose", life="x", number=1, payload=b"-1")
        for end in relays(there):  # another guest may not give in hall-a's name
            gateway = Gateway(end, GIVING, client_config(connect=(end,), operator_json5=text))
            stack.callback(gateway.end)
            assert gateway.give(forged) == NOBODY
        ends.flows()
        assert -1 not in ends.got
