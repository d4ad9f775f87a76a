"""What of others is believed by its seal: every forgery and every replay is refused with its word."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from support.authorities import install, make_authority
from support.fleets import fleet_of
from zsched.core.values.certificates import Role
from zsched.core.values.errors import ConfigError, WireError
from zsched.core.values.fleet import Fleet, Security, Signatures
from zsched.link.bus import seals as module
from zsched.link.bus.sealing import seals_of
from zsched.link.bus.seals import Seals, nonce
from zsched.link.keyspace import Keyspace
from zsched.link.seal import Act, pack, unpack

KEYS = Keyspace("yard")
PUT = KEYS.proposal("robot1")
ASKED = KEYS.register("*", "robot1")
TOLD = KEYS.register("robot2", "robot1")
COMMAND = KEYS.command("robot2", "ana")
FRAME = b"frame"
LIFE = 5
Make = Callable[..., Seals]


def fleet(folder: Path, signatures: Signatures = Signatures.REQUIRED, revoked: tuple[str, ...] = ()) -> Fleet:
    security = Security(
        folder=str(folder), operators=("ana",), guests=("screen",), signatures=signatures, revoked=revoked
    )
    return fleet_of(name="yard", of=("robot1", "robot2"), tasks=(), security=security)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("seals")
    authority = make_authority(place / "authority", "yard")
    for name, role in (("robot1", Role.NODE), ("robot2", Role.NODE), ("mallory", Role.NODE), ("ana", Role.OPERATOR)):
        install(authority, place / name, name, role)
    install(authority, place / "screen", "screen", Role.GUEST)
    install(make_authority(place / "other", "yard"), place / "other robot1", "robot1")
    install(authority, place / "late", "late")
    expired = authority.renew("robot1", None, b"", b"", datetime.now(UTC) - timedelta(days=31))
    (place / "late" / "certificate.pem").write_bytes(expired.certificate)
    (place / "late" / "key.pem").write_bytes((place / "robot1" / "key.pem").read_bytes())
    return place


@pytest.fixture
def of(folder: Path) -> Make:
    def make(
        name: str,
        signatures: Signatures = Signatures.REQUIRED,
        life: int = LIFE,
        revoked: tuple[str, ...] = (),
    ) -> Seals:
        found = seals_of(fleet(folder / name, signatures, revoked), life)
        assert found is not None
        return found

    return make


def refused(judge: Callable[..., object], *arguments: object) -> str:
    with pytest.raises(WireError) as caught:
        judge(*arguments)
    return caught.value.reason


def test_what_a_member_seals_in_its_own_name_is_believed(of: Make) -> None:
    one, other = of("robot1"), of("robot2")
    other.put("proposal", PUT, FRAME, one.seal(Act.PUT, PUT, FRAME), "robot1")
    question = one.seal(Act.QUESTION, ASKED, FRAME, life=0)
    holder = other.question("register", ASKED, FRAME, question, "robot1")
    assert holder is not None
    assert holder.label == "robot1"
    answer = other.seal(Act.ANSWER, TOLD, FRAME, question=question)
    one.answer("register", TOLD, FRAME, answer, "robot2", question)


@pytest.mark.parametrize(
    ("signer", "word"),
    [
        ("mallory", "signer"),  # certified, and no node of the file
        ("robot2", "signer"),
        ("ana", "signer"),
        ("screen", "signer"),
        ("other robot1", "certificate"),
        ("late", "certificate"),
    ],
)
def test_a_put_by_anybody_but_its_owner_is_refused(of: Make, signer: str, word: str) -> None:
    seal = of(signer).seal(Act.PUT, PUT, FRAME)
    assert refused(of("robot2").put, "proposal", PUT, FRAME, seal, "robot1") == word


def test_a_revoked_key_s_seal_is_refused(of: Make) -> None:
    seal = of("robot1").seal(Act.PUT, PUT, FRAME)
    judge = of("robot2", revoked=("robot1",))
    assert refused(judge.put, "proposal", PUT, FRAME, seal, "robot1") == "signer"


def test_a_frame_without_a_seal_is_refused_where_signatures_are_required(of: Make) -> None:
    assert refused(of("robot2").put, "proposal", PUT, FRAME, b"", "robot1") == "unsigned"
    assert refused(of("robot2").question, "register", ASKED, FRAME, b"", "robot1") == "unsigned"


def test_offered_takes_what_is_unsigned_and_no_wrong_seal(of: Make) -> None:
    judge = of("robot2", Signatures.OFFERED)
    judge.put("proposal", PUT, FRAME, b"", "robot1")
    assert judge.question("command", COMMAND, FRAME, b"", "ana") is None
    seal = of("robot1").seal(Act.PUT, PUT, FRAME)
    assert refused(judge.put, "proposal", PUT, b"other", seal, "robot1") == "signature"


def test_nothing_is_signed_without_the_section_or_with_off(folder: Path) -> None:
    assert seals_of(fleet(folder / "robot1", Signatures.OFF)) is None
    assert seals_of(replace(fleet(folder / "robot1"), security=None)) is None


def test_a_key_that_does_not_fit_is_refused_at_the_start(folder: Path, tmp_path: Path) -> None:
    for name in ("certificate.pem", "ca.pem"):
        (tmp_path / name).write_bytes((folder / "robot1" / name).read_bytes())
    (tmp_path / "key.pem").write_bytes(b"no key")
    with pytest.raises(ConfigError, match="private key"):
        seals_of(fleet(tmp_path))


def test_a_seal_is_for_one_key_frame_and_kind_of_message_only(of: Make) -> None:
    one, judge = of("robot1"), of("robot2")
    seal = one.seal(Act.PUT, PUT, FRAME)
    assert refused(judge.put, "proposal", PUT, FRAME + b"2", seal, "robot1") == "signature"
    assert refused(judge.put, "allocation", KEYS.allocation("robot1"), FRAME, seal, "robot1") == "signature"
    elsewhere = Keyspace("other").proposal("robot1")
    assert refused(judge.put, "proposal", elsewhere, FRAME, seal, "robot1") == "signature"
    assert refused(judge.answer, "register", PUT, FRAME, seal, "robot1", b"") == "signature"
    moved = pack(replace(unpack(seal), sequence=unpack(seal).sequence + 1))
    assert refused(judge.put, "proposal", PUT, FRAME, moved, "robot1") == "signature"


def test_a_put_is_taken_once_and_an_older_one_never(of: Make) -> None:
    one, judge = of("robot1"), of("robot2")
    first, second = (one.seal(Act.PUT, PUT, FRAME) for _ in range(2))
    judge.put("proposal", PUT, FRAME, second, "robot1")
    for old in (first, second):
        assert refused(judge.put, "proposal", PUT, FRAME, old, "robot1") == "replay"
    next_life = of("robot1", life=LIFE + 1)
    judge.put("proposal", PUT, FRAME, next_life.seal(Act.PUT, PUT, FRAME), "robot1")
    later = one.seal(Act.PUT, PUT, FRAME)
    assert refused(judge.put, "proposal", PUT, FRAME, later, "robot1") == "replay", "of the life before"


def test_a_clock_that_is_set_back_stops_nobody(of: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    one, judge = of("robot1"), of("robot2")
    judge.put("proposal", PUT, FRAME, one.seal(Act.PUT, PUT, FRAME), "robot1")
    monkeypatch.setattr(module, "wall_ns", lambda: 1)
    judge.put("proposal", PUT, FRAME, one.seal(Act.PUT, PUT, FRAME), "robot1")
    reborn = of("robot1", life=LIFE + 1)
    judge.put("proposal", PUT, FRAME, reborn.seal(Act.PUT, PUT, FRAME), "robot1")


def test_an_answer_is_for_its_question_only(of: Make) -> None:
    """The same question asked again: yesterday's promise is none for today's round."""
    one, other = of("robot1"), of("robot2")
    before, now = (one.seal(Act.QUESTION, ASKED, FRAME, life=0) for _ in range(2))
    old = other.seal(Act.ANSWER, TOLD, FRAME, question=before)
    one.answer("register", TOLD, FRAME, old, "robot2", before)
    assert refused(one.answer, "register", TOLD, FRAME, old, "robot2", now) == "signature"
    learnt, asked, again = KEYS.learnt("robot2", "robot1"), nonce(), nonce()
    told = other.seal(Act.ANSWER, learnt, FRAME, question=asked)
    one.answer("allocation", learnt, FRAME, told, "robot2", asked)
    assert refused(one.answer, "allocation", learnt, FRAME, told, "robot2", again) == "signature"


def test_a_command_is_for_one_life_and_taken_once(of: Make) -> None:
    ana, judge = of("ana", life=0), of("robot2")
    first, second = (ana.seal(Act.QUESTION, COMMAND, FRAME, life=LIFE) for _ in range(2))
    for seal in (second, first):  # two tools at once: their order does not count
        holder = judge.question("command", COMMAND, FRAME, seal, "ana")
        assert holder is not None
        assert holder.label == "ana.operator"
        assert refused(judge.question, "command", COMMAND, FRAME, seal, "ana") == "replay"
    after = of("robot2", life=LIFE + 1)
    assert refused(after.question, "command", COMMAND, FRAME, first, "ana") == "stale"


def test_commands_are_remembered_up_to_a_bound_and_older_ones_are_refused(
    of: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "KEPT_COMMANDS", 3)
    ana, judge = of("ana", life=0), of("robot2")
    seals = [ana.seal(Act.QUESTION, COMMAND, FRAME, life=LIFE) for _ in range(6)]
    for seal in seals[1:]:
        judge.question("command", COMMAND, FRAME, seal, "ana")
    for seal in seals:
        assert refused(judge.question, "command", COMMAND, FRAME, seal, "ana") == "replay"


@pytest.mark.parametrize(("name", "word"), [("screen", "signer"), ("robot1", "signer")])
def test_a_command_in_ana_s_name_by_anybody_else_is_refused(of: Make, name: str, word: str) -> None:
    seal = of(name, life=0).seal(Act.QUESTION, COMMAND, FRAME, life=LIFE)
    assert refused(of("robot2").question, "command", COMMAND, FRAME, seal, "ana") == word


def test_a_guest_s_own_command_is_refused(of: Make) -> None:
    key = KEYS.command("robot2", "screen")
    seal = of("screen", life=0).seal(Act.QUESTION, key, FRAME, life=LIFE)
    assert refused(of("robot2").question, "command", key, FRAME, seal, "screen") == "signer"


def test_an_operator_votes_nowhere(of: Make) -> None:
    key = KEYS.register("*", "ana")
    seal = of("ana", life=0).seal(Act.QUESTION, key, FRAME, life=0)
    assert refused(of("robot2").question, "register", key, FRAME, seal, "ana") == "signer"


def test_a_certificate_that_was_right_counts_no_longer_than_it_is_valid(
    of: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, judge = of("robot1"), of("robot2")
    judge.put("proposal", PUT, FRAME, one.seal(Act.PUT, PUT, FRAME), "robot1")
    wall_s = time.time()
    monkeypatch.setattr(module, "wall_s", lambda: wall_s + 31 * 86400)
    later = one.seal(Act.PUT, PUT, FRAME)
    assert refused(judge.put, "proposal", PUT, FRAME, later, "robot1") == "certificate"


def test_certificates_do_not_fill_the_memory(of: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    """One in other bytes would be another one each time."""
    judge = of("robot2")
    own = unpack(of("robot1").seal(Act.PUT, PUT, FRAME)).certificate
    for number in range(10):
        assert judge._certified(own + b"%d" % number) is None
    assert not judge._known
    monkeypatch.setattr(module, "KEPT_CERTIFICATES", 2)
    for name in ("robot1", "robot2", "ana"):
        assert judge._certified(unpack(of(name).seal(Act.PUT, PUT, FRAME)).certificate) is not None
    assert len(judge._known) == 2


def test_refusals_are_one_line_a_minute_and_say_how_many_there_were(
    of: Make, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 1000.0
    monkeypatch.setattr(module, "monotonic_s", lambda: now)
    judge = of("robot2")
    with caplog.at_level(logging.WARNING):
        for _ in range(100):
            assert refused(judge.put, "proposal", PUT, FRAME, b"", "robot1") == "unsigned"
        assert len(caplog.records) == 1
        now += 60
        assert refused(judge.put, "proposal", PUT, FRAME, b"", "robot1") == "unsigned"
    assert len(caplog.records) == 2
    assert "as=robot1 why=unsigned; 99 more" in caplog.text
