"""The codec: what goes in comes out, what is no frame is a `WireError`, and what was once sent is read for ever."""

from __future__ import annotations

import importlib.util
import math
import types
from dataclasses import MISSING, fields, make_dataclass, replace
from enum import Enum
from pathlib import Path
from random import Random
from typing import Any, Union, get_args, get_origin

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from zsched.core.electorate.founding import founded
from zsched.core.values import codec as wire
from zsched.core.values import document, messages, model
from zsched.core.values.beat import MAX_BEAT_BYTES, Beat
from zsched.core.values.electorate import FleetValue
from zsched.core.values.errors import WireError
from zsched.core.values.profile import Profile, WorkerLoad, WorkerState
from zsched.core.values.rehearsal import FAULTS, Strike
from zsched.core.values.struct import Struct
from zsched.core.values.words import Trouble
from zsched.link.pipe import frames as relay_pipe

GOLDEN = Path(__file__).parent / "golden"
REASONS = {"size", "garbage", "frame", "version", "kind", "type", "missing", "range"}
assert relay_pipe.REPORTS  # imported for the kinds that it registers


def load_samples() -> dict[str, Any]:
    spec = importlib.util.spec_from_file_location("golden_make", GOLDEN / "make.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    samples: dict[str, Any] = module.SAMPLES
    return samples


SAMPLES = load_samples()
CLASSES: tuple[type[Any], ...] = tuple(cls for cls, _ in wire.KINDS.values())
BEAT = Beat(node="r1", incarnation=1, sequence=1, loop_lag_s=0.0)


def frame_of(body: object, kind: object = "beat", version: object = wire.VERSION, *more: object) -> bytes:
    frame: bytes = msgpack.packb([version, kind, body, *more])
    return frame


def reason_of(frame: bytes, *classes: type[Any]) -> str:
    with pytest.raises(WireError) as caught:
        wire.decode(frame, *(classes or CLASSES))
    return caught.value.reason


# --- golden frames ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", sorted(wire.KINDS))
def test_golden_frame_of_this_version_is_read_and_is_what_we_send(kind: str) -> None:
    assert kind in SAMPLES, f"add a sample of {kind!r} to tests/unit/core/values/golden/make.py and run it"
    frame = (GOLDEN / f"{kind}.v{wire.VERSION}.bin").read_bytes()
    assert wire.decode(frame, *CLASSES) == SAMPLES[kind]
    assert wire.decode(wire.encode(SAMPLES[kind]), *CLASSES) == SAMPLES[kind]


def test_golden_frames_of_kinds_that_are_gone_are_not_deleted() -> None:
    names = {path.name for path in GOLDEN.glob("*.bin")}
    assert {f"{kind}.v1.bin" for kind in SAMPLES} <= names


# --- round trips -----------------------------------------------------------------------------------------------------

FOUNDED = founded("lab", 1, ("r1", "r2"))
BALLOT = model.Ballot(counter=3, node="r1", incarnation=7)
NAMES = st.from_regex(r"[a-z0-9][a-z0-9_-]{0,20}", fullmatch=True)
TEXTS = st.text(st.characters(codec="utf-8"), max_size=60)
ONE_OF: dict[type, tuple[str, ...]] = {
    messages.FleetQuestion: ("prepare", "accept"),
    messages.FleetAnswer: ("promise", "accepted", "refused"),
    messages.ChangeFleet: ("document", "add_elector", "remove_elector"),
}
BATCHES: dict[type, tuple[type, ...]] = {
    messages.Ballots: (messages.Prepare, messages.Accept),
    messages.Votes: (messages.Promise, messages.Accepted, messages.Refused),
}
IDS = {"disk", "document", "joins"}
FREE_TEXT = {"reason", "detail", "electorate", "hardware", "problem", "source", "zid", "incarnation", "from_expr"}
RANGES: dict[str, tuple[float, float]] = {
    "rssi_dbm": (-120.0, 0.0),
    "cpu_cores": (0.01, 64.0),
    "memory_mb": (1.0, 1e6),
    "keep_last": (0, 1000),
    "depth": (1, 100_000),
    "max_hz": (0.01, 10_000),
    "timeout_s": (0.05, 3600),
    "hold_s": (0, 3600),
    "max_pending": (1, 256),
    "speed": (0.001, 1000.0),
    "deadline_ms": (1.0, 3.6e6),
    "for_s": (1.0, model.MAX_FOR_S),
    "price_s": (0.0, model.MAX_PRICE_S),
    "nu_dbm": (-120.0, 0.0),
    "rho_dbm": (-120.0, 0.0),
}


def strategy(hint: Any, name: str = "") -> st.SearchStrategy[Any]:
    """Values of a type hint that the field ``name`` may hold."""
    low, high = RANGES.get(name, (0, 1))
    if hint is bool:
        return st.booleans()
    if hint is int:
        return st.integers(int(low), int(high) if name in RANGES else model.MAX_COUNTER)
    if hint is float:
        return st.floats(low, high)
    if hint is document.Text:
        return TEXTS
    if hint is str and name in IDS:
        return st.text("0123456789abcdef", min_size=1, max_size=32)
    if hint is str:
        return TEXTS if name in FREE_TEXT else NAMES
    if get_origin(hint) is tuple:
        return tuple_strategy(get_args(hint), name)
    if get_origin(hint) in (Union, types.UnionType):
        (inner,) = [arg for arg in get_args(hint) if arg is not type(None)]
        return st.none() | strategy(inner, name)
    if isinstance(hint, type) and issubclass(hint, Enum):
        return st.sampled_from(hint)
    return dataclass_strategy(hint)


def batch_of(cls: type[Any], elector: str, parts: tuple[list[Any], ...]) -> Any:
    """Some questions of one proposer, or the answers of one elector."""
    if cls is messages.Votes:
        parts = tuple([replace(one, elector=elector) for one in part] for part in parts)
    batch = cls(**{field.name: tuple(part) for field, part in zip(fields(cls), parts, strict=False)})
    if cls is messages.Votes:
        no = messages.Refused(
            elector=elector, task="lab", ballot=BALLOT, refusal=messages.Refusal.NUMBER, promised=BALLOT, fleet=FOUNDED
        )
        return replace(batch, ahead=messages.fleet_answer(no))
    first = messages.Prepare(task="lab", ballot=BALLOT, electorate="e", generation_id="ab", number=2)
    return replace(batch, ahead=first, fleet=FOUNDED)


def tuple_strategy(args: tuple[Any, ...], name: str) -> st.SearchStrategy[Any]:
    if len(args) == 2 and args[1] is Ellipsis:
        return st.lists(strategy(args[0], name), max_size=2).map(tuple)
    return st.tuples(*(strategy(arg, name) for arg in args))


def dataclass_strategy(cls: type[Any]) -> st.SearchStrategy[Any]:
    if cls is model.Weights:
        return st.sampled_from([(1.0, 0.0, 0.0), (0.5, 0.25, 0.25), (0.1, 0.2, 0.7)]).map(
            lambda w: model.Weights(cpu=w[0], memory=w[1], network=w[2])
        )
    if cls is FleetValue:
        return st.sampled_from((FOUNDED, replace(FOUNDED, document="0a", revision=2)))
    if (get_origin(cls) or cls) is messages.Accept:
        return st.builds(
            lambda acceptance, electorate: messages.Accept(
                task=acceptance.value.task, acceptance=acceptance, electorate=electorate
            ),
            strategy(wire.hints_of(cls)["acceptance"]),
            TEXTS,
        )
    if cls in BATCHES:
        some = st.tuples(*(st.lists(strategy(kind), max_size=2) for kind in BATCHES[cls])).filter(any)
        return st.builds(batch_of, st.just(cls), NAMES, some)
    hints = wire.hints_of(cls)
    made = get_origin(cls) or cls
    parts = {field.name: strategy(hints[field.name], field.name) for field in fields(made)}
    if made is Strike:
        parts["step"] = st.sampled_from(FAULTS)
    if made is messages.ReadHistory:
        parts["cursor"] = st.sampled_from(("", "4711:65536"))
    if made not in ONE_OF:
        return st.builds(made, **parts)
    whole = [
        {other: parts[other] for other in parts if other not in ONE_OF[made] or other == one} for one in ONE_OF[made]
    ]
    for one, kept in zip(ONE_OF[made], whole, strict=True):
        kept[one] = kept[one].filter(bool)
    return st.one_of(*(st.builds(made, **kept) for kept in whole))


@pytest.mark.parametrize("kind", sorted(wire.KINDS))
def test_round_trip_of_any_value(kind: str) -> None:
    cls, bound = wire.KINDS[kind]

    @settings(max_examples=20, deadline=None, derandomize=True, database=None)
    @given(strategy(cls))
    def check(value: Any) -> None:
        frame = wire.encode(value)
        assert len(frame) <= bound
        decoded = wire.decode(frame, *CLASSES)
        assert decoded == value
        assert type(decoded) is type(value)

    check()


def test_defaults_do_not_travel() -> None:
    body = msgpack.unpackb(wire.encode(BEAT))[2]
    assert body == {"node": "r1", "incarnation": 1, "sequence": 1, "loop_lag_s": 0.0}


def test_whole_number_is_read_as_float_where_a_float_stands() -> None:
    body = {"node": "r1", "incarnation": 1, "sequence": 1, "loop_lag_s": 2}
    assert type(wire.decode(frame_of(body), Beat).loop_lag_s) is float


# --- newer and older peers -------------------------------------------------------------------------------------------


def test_fields_may_have_the_names_that_the_written_out_codec_uses_itself() -> None:
    names = ("value", "get", "cls", "f", "fail", "item0", "default1", "_3", "inf", "len", "type", "x", "body")
    odd = make_dataclass("Odd", [(name, int | None, None) for name in names], frozen=True, kw_only=True)
    read, write = wire._codec(odd)
    value = odd(**{name: index for index, name in enumerate(names)})
    assert write(value) == {name: index for index, name in enumerate(names)}
    assert read(write(value)) == value
    assert read({}) == odd()
    with pytest.raises(WireError):
        read({"len": "no number"})


def test_unknown_fields_of_a_newer_peer_are_ignored_at_every_depth() -> None:
    body = msgpack.unpackb(wire.encode(SAMPLES["accept"]))[2]
    body["new"] = {"a": [1, 2]}
    body["acceptance"]["value"]["tuning"]["new"] = 1
    assert wire.decode(frame_of(body, "accept"), messages.Accept) == SAMPLES["accept"]


@pytest.mark.parametrize("version", [0, 2, -1, "1", None, 1.0, True, [1]])
def test_other_version_is_refused(version: object) -> None:
    assert reason_of(frame_of({}, "beat", version)) == "version"


@pytest.mark.parametrize("kind", ["nonsense", None, 7, ["beat"], {}])
def test_unknown_kind_is_refused(kind: object) -> None:
    assert reason_of(frame_of({}, kind)) == "kind"


def test_kind_that_this_key_does_not_carry_is_refused() -> None:
    assert reason_of(wire.encode(BEAT), Profile, model.Proposal) == "kind"


def test_kind_or_class_is_registered_once() -> None:
    with pytest.raises(ValueError, match="twice"):
        wire.register("beat", dict, 1)
    with pytest.raises(ValueError, match="twice"):
        wire.register("beat2", Beat, 1)


# --- what is no frame ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("frame", "reason"),
    [
        (b"", "garbage"),
        (b"\xc1", "garbage"),
        (wire.encode(BEAT)[:-1], "garbage"),
        (wire.encode(BEAT) + b"\x00", "garbage"),
        (msgpack.packb({}), "frame"),
        (msgpack.packb([1, "beat"]), "frame"),
        (msgpack.packb(None), "frame"),
        (frame_of([]), "type"),
        (frame_of({1: 2}), "garbage"),
        (frame_of({b"node": "r1"}), "missing"),
        (frame_of({}), "missing"),
        (frame_of({"node": "r1", "incarnation": 1, "sequence": 1}), "missing"),
    ],
)
def test_bytes_that_are_no_frame(frame: bytes, reason: str) -> None:
    assert reason_of(frame) == reason


@pytest.mark.parametrize(
    ("field", "value", "reason"),
    [
        ("node", "Robot 1", "range"),
        ("node", "x" * 513, "type"),
        ("node", b"r1", "type"),
        ("node", None, "type"),
        ("incarnation", -1, "range"),
        ("incarnation", 2**53 + 1, "range"),
        ("incarnation", 1.0, "type"),
        ("incarnation", True, "type"),
        ("loop_lag_s", math.nan, "type"),
        ("loop_lag_s", math.inf, "type"),
        ("loop_lag_s", -0.1, "range"),
        ("disk", "no hex", "range"),
        ("disk", "0" * 33, "range"),
        ("loop_lag_s", "0", "type"),
        ("learnt", [["merge", 1]], "type"),
        ("learnt", [["merge", 1, 2, 3]], "type"),
        ("learnt", {"merge": 1}, "type"),
        ("suspects", "r1", "type"),
        ("suspects", [["r1"]], "type"),
        ("node", msgpack.ExtType(5, b"x"), "type"),
        ("node", msgpack.Timestamp(1), "type"),
    ],
)
def test_field_of_a_wrong_type_or_out_of_range(field: str, value: object, reason: str) -> None:
    body = {"node": "r1", "incarnation": 1, "sequence": 1, "loop_lag_s": 0.0, field: value}
    assert reason_of(frame_of(body)) == reason


@pytest.mark.parametrize("place", ["frame", "version", "kind", "body", "field", "unknown field"])
@pytest.mark.parametrize("depth", [10, 500, 1020, 5000])
def test_deeply_nested_bytes_are_refused_or_ignored(place: str, depth: int) -> None:
    """Deeper than Python's own recursion limit: even quoting it in a message may fail."""
    deep = b"\x91" * depth + b"\xc0"
    good = msgpack.packb({"node": "r1", "incarnation": 1, "sequence": 1, "loop_lag_s": 0.0})
    frames = {
        "frame": deep,
        "version": b"\x93" + deep + b"\xa4beat" + good,
        "kind": b"\x93\x01" + deep + good,
        "body": b"\x93\x01\xa4beat" + deep,
        "field": b"\x93\x01\xa4beat\x81\xa4node" + deep,
        "unknown field": b"\x93\x01\xa4beat\x85\xa3new" + deep + good[1:],
    }
    if place == "unknown field" and depth < 1024:
        assert wire.decode(frames[place], Beat) == BEAT
        return
    assert reason_of(frames[place]) in REASONS


def test_announced_sizes_reserve_no_memory() -> None:
    """Four bytes may claim an array, map or string of four billion items."""
    for marker in (b"\xdd", b"\xdf", b"\xdb", b"\xc6", b"\xc9"):
        assert reason_of(b"\x93\x01\xa4beat" + marker + b"\xff\xff\xff\xff") == "garbage"


# --- size bounds -----------------------------------------------------------------------------------------------------


def test_frame_larger_than_its_kind_allows_is_neither_sent_nor_read() -> None:
    big = replace(BEAT, suspects=tuple(f"robot-{i:04}" for i in range(2000)))
    with pytest.raises(WireError) as caught:
        wire.encode(big)
    assert caught.value.reason == "size"
    body = {"node": "r1", "incarnation": 1, "sequence": 1, "loop_lag_s": 0.0, "new": "x" * MAX_BEAT_BYTES}
    assert reason_of(frame_of(body), Beat) == "size"
    assert reason_of(frame_of(body), Beat, messages.Learnt) == "size"  # a large kind beside it does not help


def test_frame_of_the_largest_allowed_size_is_read() -> None:
    body = {"node": "r1", "incarnation": 1, "sequence": 1, "loop_lag_s": 0.0, "new": ""}
    body["new"] = "x" * (MAX_BEAT_BYTES - len(frame_of(body)) - 2)
    frame = frame_of(body)
    assert len(frame) == MAX_BEAT_BYTES
    assert wire.decode(frame, Beat) == BEAT


# --- fuzz ------------------------------------------------------------------------------------------------------------


def mutated(frame: bytes, other: bytes, rng: Random) -> bytes:
    """One random change: bits, bytes, a cut, a splice, a repetition."""
    data = bytearray(frame)
    at = rng.randrange(len(data))
    action = rng.randrange(6)
    if action == 0:
        data[at] ^= 1 << rng.randrange(8)
    elif action == 1:
        data[at] = rng.randrange(256)
    elif action == 2:
        del data[at:]
    elif action == 3:
        data[at:at] = rng.randbytes(rng.randrange(1, 6))
    elif action == 4:
        data[at : at + rng.randrange(1, 20)] = other[rng.randrange(len(other)) :][:20]
    else:
        data[at:at] = data[at : at + rng.randrange(1, 30)]
    return bytes(data)


def check_hostile(frame: bytes) -> bool:
    """Decode; only a `WireError` with a known word may come out. True when it is a frame after all."""
    reason, value = "", None
    try:
        value = wire.decode(frame, *CLASSES)
    except WireError as error:
        reason = error.reason
    assert reason in REASONS or type(value) in CLASSES
    return not reason


@pytest.mark.parametrize("seed", range(2))
def test_fuzz_mutated_bytes_raise_wire_errors_only(seed: int) -> None:
    rng = Random(seed)
    frames = [wire.encode(sample) for sample in SAMPLES.values()]
    read = 0
    for number in range(30_000):
        frame = mutated(frames[number % len(frames)], rng.choice(frames), rng)
        while rng.random() < 0.3 and frame:
            frame = mutated(frame, rng.choice(frames), rng)
        read += check_hostile(frame)
    assert 0 < read < 20_000  # some mutations are harmless, most are not


HOSTILE: tuple[Any, ...] = (
    None, True, -1, 0, 2**63, 2**64 - 1, -(2**63), 1e308, -1e308, math.nan, math.inf, "", "a", "A b", "x" * 600,
    "\u0000", b"\xff", [], [[]], {}, {"a": 1}, [1, 2, 3], msgpack.ExtType(1, b""), msgpack.Timestamp(0),
)  # fmt: skip


def replanted(value: Any, rng: Random) -> Any:
    """``value`` with one of its parts, at any depth, replaced by something hostile, or left out."""
    if not value or not isinstance(value, list | dict) or rng.random() < 0.1:
        return rng.choice(HOSTILE)
    if isinstance(value, list):
        at = rng.randrange(len(value))
        return [*value[:at], replanted(value[at], rng), *value[at + 1 :]]
    key = rng.choice(sorted(value))
    if rng.random() < 0.1:
        return {name: part for name, part in value.items() if name != key}
    return {**value, key: replanted(value[key], rng)}


@pytest.mark.parametrize("seed", range(2))
def test_fuzz_well_formed_frames_with_hostile_parts_raise_wire_errors_only(seed: int) -> None:
    rng = Random(seed)
    trees = [msgpack.unpackb(wire.encode(sample)) for sample in SAMPLES.values()]
    for number in range(20_000):
        check_hostile(msgpack.packb(replanted(trees[number % len(trees)], rng)))


# --- the state file --------------------------------------------------------------------------------------------------


def test_state_file_round_trip() -> None:
    assert wire.decode_state(wire.encode_state(SAMPLES["state"])) == SAMPLES["state"]


def test_state_file_cut_or_changed_anywhere_is_refused() -> None:
    content = wire.encode_state(SAMPLES["state"])
    for at in range(len(content)):
        for damaged in (content[:at], content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :]):
            with pytest.raises(WireError) as caught:
                wire.decode_state(damaged)
            assert caught.value.reason in REASONS | {"checksum"}


@pytest.mark.parametrize("content", [b"", b"\n", b"zsched-state/2 00\n", b"zsched-state/1\n", b"\x00" * 4096])
def test_foreign_file_is_no_state(content: bytes) -> None:
    with pytest.raises(WireError) as caught:
        wire.decode_state(content)
    assert caught.value.reason == "frame"


def test_every_kind_is_a_frozen_value_with_bounded_size() -> None:
    for cls, bound in wire.KINDS.values():
        assert issubclass(cls, Struct)
        assert cls.__struct_config__.frozen
        assert bound <= wire.LARGE
        made: Any = cls  # typeshed does not know it as a dataclass
        assert all(field.default_factory is MISSING for field in fields(made))  # encode compares with `default` only


def test_a_later_program_s_word_where_nothing_may_be_said_is_read_as_nothing() -> None:
    told = wire.as_plain(WorkerLoad(task="merge", state=WorkerState.READY, trouble=Trouble.RESTS))
    assert wire.from_plain({**told, "trouble": "sulks", "renewal": "some day"}, WorkerLoad) == WorkerLoad(
        task="merge", state=WorkerState.READY
    )
    for word in (3, None, ["rests"]):
        with pytest.raises(WireError, match="expected one of"):
            wire.from_plain({**told, "trouble": word}, WorkerLoad)
    with pytest.raises(WireError, match="expected one of"):
        wire.from_plain({**told, "state": "sulking"}, WorkerLoad)
