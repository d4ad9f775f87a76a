"""The newest lines of a worker: bounded, numbered, page after page."""

from __future__ import annotations

from zsched.core.values import codec as wire
from zsched.core.values.messages import WorkerLines
from zsched.host.workers.kept_lines import MOST_CHARS, MOST_LINES, PER_ANSWER, KeptLines


def test_the_newest_lines_stay_with_their_numbers() -> None:
    kept = KeptLines()
    for number in range(1, MOST_LINES + 11):
        kept.add(f"line {number}")
    lines, newest = kept.behind(0)
    assert (lines[0].number, lines[0].text, newest) == (11, "line 11", MOST_LINES + 10)


def test_an_answer_holds_a_page_and_the_next_one_goes_on_behind_it() -> None:
    kept = KeptLines()
    for number in range(1, PER_ANSWER + 4):
        kept.add(f"line {number}")
    first, newest = kept.behind(0)
    rest, _ = kept.behind(first[-1].number)
    assert (len(first), newest) == (PER_ANSWER, PER_ANSWER + 3)
    assert [line.number for line in rest] == [PER_ANSWER + 1, PER_ANSWER + 2, PER_ANSWER + 3]
    assert kept.behind(newest) == ((), newest)
    assert kept.behind(newest + 5) == ((), newest), "of another daemon, whose numbers were higher"


def test_a_page_of_the_longest_lines_in_any_script_fits_into_a_frame() -> None:
    kept = KeptLines()
    for _ in range(PER_ANSWER):
        kept.add("\N{CJK UNIFIED IDEOGRAPH-20000}" * 3000)
    lines, newest = kept.behind(0)
    assert {len(line.text) for line in lines} == {MOST_CHARS}
    assert lines[0].text.endswith(" ...")
    answer = WorkerLines(node="edge1", task="merge", lines=lines, newest=newest)
    assert wire.decode(wire.encode(answer), WorkerLines) == answer
