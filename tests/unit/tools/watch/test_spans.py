"""Which lines of a decision log make the span of a move: as robots and edges write them, in all orders that happen."""

from __future__ import annotations

from typing import Any

from zsched.tools.watch.trace import OVERDUE_S, Moves, Span, trace_id


def line(at: float, stage: str, epoch: int, text: str, **more: Any) -> dict[str, Any]:
    return {"at": at, "node": "robot1", "life": 7, "stage": stage, "text": text, "task": "echo", "epoch": epoch} | more


def learnt(at: float, epoch: int, left: str | None, owner: str, reason: str = "edge1 is draining") -> dict[str, Any]:
    told: dict[str, Any] = {
        "epoch": epoch,
        "revision": epoch,
        "left": left,
        "owner": owner,
        "reason": reason,
        "votes": [],
    }
    return line(at, "vote", epoch, f"learnt revision {epoch}: owner {owner}", move=told)


PLANNED = [
    line(10.0, "scheduler", 3, "stay edge1: nobody better [edge1=0.5]"),
    line(30.926, "scheduler", 3, "propose edge2: edge1 is draining [edge2=0.466]"),
    line(30.943, "vote", 3, "won: 2 of 2 for edge2"),
    line(31.067, "vote", 4, "move to edge2 on revision 3: committed"),
    learnt(31.067, 4, "edge1", "edge2"),
    line(31.067, "executor", 4, "prepares edge2"),
    line(31.076, "executor", 4, "flips to edge2"),
    line(31.143, "executor", 4, "flipped to edge2 in 99 ms, 0 kept values replayed; edge1 drains", took_s=0.099),
    line(31.151, "executor", 4, "settled on edge2: edge1 drained"),
    line(31.383, "scheduler", 4, "stay edge2: nobody better [edge2=0.5]"),
]
FAILOVER = [
    line(50.10, "scheduler", 4, "propose edge1: edge2 is gone [edge1=0.5]"),
    learnt(50.15, 5, "edge2", "edge1", "edge2 is gone"),
    line(50.15, "executor", 5, "drops the slot of epoch 4: edge2 is gone"),
    line(50.22, "executor", 5, "flipped to edge1 in 81 ms, 0 kept values replayed", took_s=0.081),
]


def stages(span: Span) -> list[str]:
    return [f"{stage}: {text.split()[0]}" for _, stage, text in span.lines]


def test_a_move_goes_from_the_judgement_that_called_it_to_the_end_of_the_drain() -> None:
    (span,) = Moves().take(PLANNED)
    assert (span.task, span.epoch, span.left, span.owner, span.reason) == (
        "echo",
        4,
        "edge1",
        "edge2",
        "edge1 is draining",
    )
    assert (span.begin, span.end, span.switched_s) == (30.926, 31.151, 0.099)
    assert stages(span) == [
        *("scheduler: propose", "vote: won:", "vote: move", "vote: learnt"),
        *("executor: prepares", "executor: flips", "executor: flipped", "executor: settled"),
    ]


def test_a_dead_owner_s_move_ends_with_the_switch() -> None:
    moves = Moves()
    assert [span.epoch for span in moves.take(PLANNED)] == [4]
    (span,) = moves.take(FAILOVER)
    assert (span.begin, span.end, span.switched_s) == (50.10, 50.22, 0.081)
    assert not list(moves.rest())


def test_lines_one_at_a_time_make_the_same_spans() -> None:
    moves = Moves()
    found = [span for entry in (*PLANNED, *FAILOVER) for span in moves.take([entry])]
    assert found == list(Moves().take([*PLANNED, *FAILOVER]))
    assert len(found) == 2


def test_a_move_without_an_end_is_told_when_the_next_comes_or_its_time_is_over() -> None:
    moves = Moves()
    assert not list(moves.take(PLANNED[:6]))
    assert not list(moves.overdue(31.0 + OVERDUE_S))
    (late,) = moves.overdue(31.1 + OVERDUE_S)
    assert (late.epoch, late.switched_s, late.end) == (4, None, 31.067)
    assert [span.epoch for span in moves.take([*PLANNED[4:7], FAILOVER[1]])] == [4]
    assert [span.epoch for span in moves.rest()] == [5]


def test_an_owner_that_was_there_before_the_start_is_no_move() -> None:
    moves = Moves()
    known = learnt(40.0, 4, None, "edge2", "known from before the restart")
    known["move"]["is_known"] = True
    assert [span.epoch for span in moves.take([*PLANNED[:6], known, *PLANNED[7:]])] == [4]
    assert not list(moves.rest())


def test_an_edge_only_learns() -> None:
    moves = Moves()
    assert not list(moves.take([learnt(5.0, 1, None, "edge1", "learnt from a peer")]))
    (span,) = moves.rest()
    assert (span.begin, span.end, span.left) == (5.0, 5.0, None)


def test_tasks_do_not_mix_and_lines_without_one_are_left_out() -> None:
    other = [{**entry, "task": "detect"} for entry in PLANNED]
    mixed = [one for pair in zip(PLANNED, other, strict=True) for one in pair]
    mixed.insert(5, {"at": 31.0, "node": "robot1", "stage": "membership", "text": "edge1 gone"})
    found = list(Moves().take(mixed))
    assert sorted(span.task for span in found) == ["detect", "echo"]
    assert {len(span.lines) for span in found} == {8}


def test_what_waits_for_a_move_is_bounded() -> None:
    moves = Moves()
    lines = [line(float(number), "vote", 3, "lost") for number in range(5000)]
    assert not list(moves.take(lines))
    (span,) = (*moves.take([learnt(6000.0, 4, "edge1", "edge2")]), *moves.rest())
    assert len(span.lines) <= 101


def test_every_node_names_a_move_s_trace_alike_and_no_two_moves_share_one() -> None:
    assert trace_id("hall", "echo", 4) == trace_id("hall", "echo", 4)
    assert len({trace_id(fleet, task, epoch) for fleet in "ab" for task in "cd" for epoch in range(50)}) == 200
    assert 0 < trace_id("hall", "echo", 4) < 1 << 128
