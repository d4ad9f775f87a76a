"""The decision log: bounded, whole lines, told when the disk refuses, read page by page over a rotation."""

from __future__ import annotations

import json
import os
import queue
import resource
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from support.decisions import figures_of
from support.fleets import task_of
from support.waiting import until
from zsched.core.values.codec import LARGE, decode, encode
from zsched.core.values.decision import Decision, HistoryLine, Move, Verdict
from zsched.core.values.instructions import RecordStory
from zsched.core.values.messages import HistoryTold
from zsched.host import decision_log
from zsched.host.decision_log import NAME, OLD_NAME, QUEUE_LIMIT, SCHEMA, DecisionLog, read_page

MOVE = Move(epoch=2, revision=2, left="edge1", owner="edge2", reason="edge1 is gone", votes=(("robot1", "edge2"),))
DECISION = Decision(
    figures=figures_of(task_of(), "robot1"),
    verdict=Verdict(outcome="none", candidate=None, aggregate=0.0, reason="utilities of 0 robots, 1 needed"),
)


def story(text: str, **more: object) -> RecordStory:
    return RecordStory(stage="vote", text=text, task="merge", epoch=2, **more)  # type: ignore[arg-type]


class Kept:
    """A log with what it has told of itself."""

    def __init__(self, folder: Path, file_bytes: int = 4096) -> None:
        self.told: list[str | None] = []
        self.log = DecisionLog(folder, "robot1", 7, self.told.append, file_bytes)

    def write(self, *stories: RecordStory) -> None:
        """Put them and have the thread write them to the end."""
        for one in stories:
            self.log.put(one)
        self.log.put(story("end"))
        self.log._queue.put(None)
        self.log._run()


def lines(folder: Path) -> list[dict[str, object]]:
    """All entries that are left, oldest first."""
    found: list[dict[str, object]] = []
    cursor, has_more = "", True
    while has_more:
        page, cursor, has_more = read_page(folder, cursor, most_bytes=700)
        found += [json.loads(line) for line in page]
    return found


def test_a_story_becomes_one_line_and_the_thread_writes_all_before_it_ends(tmp_path: Path) -> None:
    log = DecisionLog(tmp_path, "robot1", 7, lambda _problem: None)
    log.start()
    log.put(story("learnt", move=MOVE))
    log.put(story("stay edge1: nobody better", decision=DECISION))
    log.close()
    first, second = lines(tmp_path)
    assert {name: first[name] for name in ("schema", "node", "life", "stage", "text", "task", "epoch")} == {
        "schema": SCHEMA,
        "node": "robot1",
        "life": 7,
        "stage": "vote",
        "text": "learnt",
        "task": "merge",
        "epoch": 2,
    }
    assert first["move"]["votes"] == [["robot1", "edge2"]]  # type: ignore[index]
    assert list(second)[-1] == "decision"
    assert second["decision"]["verdict"]["outcome"] == "none"  # type: ignore[index]


def test_the_two_files_stay_within_their_bound_and_keep_the_newest(tmp_path: Path) -> None:
    kept = Kept(tmp_path)
    for number in range(20):
        kept.write(*(story(f"{number}.{index} " + "x" * 100) for index in range(10)))
        sizes = [(tmp_path / name).stat().st_size for name in (NAME, OLD_NAME) if (tmp_path / name).exists()]
        assert all(size <= 4096 for size in sizes)
    texts = [str(entry["text"]) for entry in lines(tmp_path)]
    assert texts[-1] == "end"
    assert 20 < len(texts) < 50
    assert kept.told == []


def test_what_a_restart_finds_is_gone_on_with(tmp_path: Path) -> None:
    Kept(tmp_path).write(story("before"))
    Kept(tmp_path).write(story("after"))
    assert [entry["text"] for entry in lines(tmp_path)] == ["before", "end", "after", "end"]


@contextmanager
def full_disk(most_bytes: int) -> Iterator[None]:
    """No file may grow over ``most_bytes``: a write is cut there, the next one fails."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_costs_lines_which_are_counted_and_told_and_never_half_a_line(tmp_path: Path) -> None:
    kept = Kept(tmp_path)
    kept.write(story("first"))
    size = (tmp_path / NAME).stat().st_size
    with full_disk(size + 40):
        kept.write(story("lost"), story("lost"))
    assert (tmp_path / NAME).stat().st_size == size, "a line that was cut is taken back"
    assert len(kept.told) == 1
    assert "is not written: File too large" in str(kept.told[0])
    kept.write(story("again"))
    assert [entry["text"] for entry in lines(tmp_path)][2:] == [
        "3 lines of this log are lost: the disk refused them, or they came too fast",
        "again",
        "end",
    ]
    assert kept.told[1:] == [None]


def test_the_last_bytes_of_a_disk_are_the_state_s(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = Kept(tmp_path)
    kept.write(story("first"))
    free = os.statvfs(tmp_path)
    monkeypatch.setattr(decision_log, "RESERVE_BYTES", 2 * free.f_blocks * free.f_frsize)
    kept.write(story("lost"))
    assert [str(told).partition("; ")[0].partition("written: ")[2] for told in kept.told] == [
        "the disk is full, and its last bytes are the state's"
    ]
    monkeypatch.undo()
    kept.write(story("again"))
    assert "lost" not in [entry["text"] for entry in lines(tmp_path)]


def test_a_disk_that_has_room_again_is_seen_without_a_new_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A fleet at rest writes none for hours, and its status had the problem for as long."""
    kept = Kept(tmp_path)
    kept.write(story("first"))
    with full_disk((tmp_path / NAME).stat().st_size + 40):
        kept.write(story("lost"))
    monkeypatch.setattr(decision_log, "RETRY_S", 0.01)
    kept.log.start()
    until(lambda: kept.told[1:] == [None], "the end of the problem")
    kept.log.close()
    assert str(lines(tmp_path)[-1]["text"]).startswith("2 lines of this log are lost")


def test_a_queue_without_room_counts_what_it_refuses_and_keeps_nobody_waiting(tmp_path: Path) -> None:
    kept = Kept(tmp_path, file_bytes=1 << 20)
    kept.write(*(story(str(number)) for number in range(QUEUE_LIMIT + 4)))
    texts = [entry["text"] for entry in lines(tmp_path)]
    assert texts[0] == "5 lines of this log are lost: the disk refused them, or they came too fast"
    assert texts[1] == "0"
    assert len(texts) == QUEUE_LIMIT + 1


def test_a_reader_goes_on_where_it_was_over_a_rotation(tmp_path: Path) -> None:
    kept = Kept(tmp_path)
    kept.write(story("one"))
    page, cursor, has_more = read_page(tmp_path, "")
    assert (len(page), has_more) == (2, False)
    assert read_page(tmp_path, cursor) == ([], cursor, False)
    kept.write(*(story(f"{number} " + "x" * 100) for number in range(20)))
    assert (tmp_path / OLD_NAME).exists()
    seen, has_more = [], True
    while has_more:
        page, cursor, has_more = read_page(tmp_path, cursor)
        seen += [json.loads(line)["text"].split()[0] for line in page]
    assert seen == [*map(str, range(20)), "end"]


def test_a_reader_whose_file_is_shorter_by_now_begins_with_what_is_left(tmp_path: Path) -> None:
    """Somebody has emptied it, or a new file has the number of the one that is gone: `events --follow` went silent."""
    kept = Kept(tmp_path)
    kept.write(*(story(f"old {number}") for number in range(5)))
    _, cursor, _ = read_page(tmp_path, "")
    os.truncate(tmp_path / NAME, 0)
    assert read_page(tmp_path, cursor)[0] == []
    kept.write(story("new"))
    page, cursor, _ = read_page(tmp_path, cursor)
    assert [json.loads(line)["text"].split()[0] for line in page] == ["new", "end"]
    assert read_page(tmp_path, cursor) == ([], cursor, False)


def test_a_page_read_while_the_newer_file_is_set_aside_leaves_nothing_out_and_tells_nothing_twice(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = Kept(tmp_path)
    kept.write(*(story(f"{number} " + "x" * 100) for number in range(20)))
    old = len((tmp_path / OLD_NAME).read_bytes().splitlines())
    texts = [entry["text"] for entry in lines(tmp_path)]
    opened, real = list[str](), Path.open

    def open_and_set_aside(path: Path, *arguments: Any, **named: Any) -> Any:
        file = real(path, *arguments, **named)
        opened.append(path.name)
        if len(opened) == 1:
            (tmp_path / NAME).replace(tmp_path / OLD_NAME)
            (tmp_path / NAME).touch()
        return file

    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", open_and_set_aside)
        page, cursor, _ = read_page(tmp_path, "")
    assert [json.loads(line)["text"] for line in page] == texts[old:], "what was the older file is gone"
    assert read_page(tmp_path, cursor)[0] == []


def test_operators_get_no_figures_and_moves_alone_where_they_ask_for_them(tmp_path: Path) -> None:
    kept = Kept(tmp_path, file_bytes=1 << 20)
    kept.write(
        story("judged", decision=DECISION),
        story('text with ,"move": in it'),
        story("moved", move=MOVE),
        story("x", took_s=0.25),
        story("paused", by="ana.operator"),
    )
    with (tmp_path / NAME).open("ab") as file:
        file.write(b'{"torn":\n')
    everything = kept.log.answer({"verb": "log"})
    assert [entry["text"] for entry in everything["entries"]] == [
        "judged",
        'text with ,"move": in it',
        "moved",
        "x",
        "paused",
        "end",
    ]
    assert not any("decision" in entry for entry in everything["entries"])
    moves = kept.log.answer({"verb": "log", "moves": True, "cursor": 5})
    assert [entry["text"] for entry in moves["entries"]] == ["moved", "x", "paused"]
    assert [line.by for line in kept.log.history("").lines] == ["", "", "ana.operator"]
    assert kept.log.answer({"cursor": everything["cursor"]})["entries"] == []
    assert kept.log.answer({"cursor": "1:nonsense"})["entries"] == everything["entries"]


@pytest.mark.parametrize("size", [1, 50, 300])
def test_a_line_longer_than_a_page_is_read_whole(tmp_path: Path, size: int) -> None:
    Kept(tmp_path).write(story("x" * 400))
    page, _, _ = read_page(tmp_path, "", most_bytes=size)
    assert json.loads(page[0])["text"] == "x" * 400


def test_another_machine_is_told_the_moves_by_the_log_s_thread_page_by_page(tmp_path: Path) -> None:
    log = DecisionLog(tmp_path, "robot1", 7, lambda _problem: None)
    log.start()
    for number in range(1200):
        log.put(story("stay edge1: nobody better", decision=DECISION))
        log.put(story(f"learnt {number} " + "x" * 200, move=MOVE))
        while log._queue.qsize() > 500:
            time.sleep(0.001)
    told: queue.SimpleQueue[HistoryTold | None] = queue.SimpleQueue()
    found: list[HistoryLine] = []
    cursor, pages = "", 0
    while True:
        assert log.ask(cursor, told.put)
        page = told.get(timeout=10.0)
        assert page is not None
        assert len(encode(page)) < LARGE
        assert decode(encode(page), HistoryTold) == page
        found += page.lines
        cursor, pages = page.cursor, pages + 1
        if not page.has_more:
            break
    log.close()
    assert [line.text.split()[1] for line in found] == [str(number) for number in range(1200)]
    assert found[0].move == MOVE
    assert pages > 3


def test_only_some_questions_wait_at_a_time_and_a_log_that_cannot_be_read_is_no_history(tmp_path: Path) -> None:
    log = DecisionLog(tmp_path, "robot1", 7, lambda _problem: None)
    told: list[HistoryTold | None] = []
    assert [log.ask("", told.append) for _ in range(6)] == [True, True, True, True, False, False]
    (tmp_path / NAME).mkdir()
    log.start()
    log.close()
    assert told == [None] * 4
    assert log.ask("", told.append), "who was answered waits no more"
