"""A document says in a comment that a task is on its way to another cell, and keeps its entry there."""

from __future__ import annotations

from pathlib import Path

import pytest

from zsched.config.editing import add_entries, remove_task, task_entry
from zsched.config.handing import Mark, mark_of, marked, names_in, unmarked
from zsched.config.load import check_bytes

ANNOTATED = (Path(__file__).parents[3] / "configs" / "fleet.yaml").read_text()
BLOCK = (
    """\
fleet: hall
nodes: {r1: {kind: robot}, e1: {kind: edge, host: h, listen: {control: tcp/0.0.0.0:7457, data: tcp/0.0.0.0:7458}}}
tasks:
    count:   # pallets
        candidates: [e1]

        # two lines
        weights: {cpu: 1}
        worker:
            command: [python, "-c", "print('#  zsched: end of task count')"]
            env:
                SAID: |
                    one

                      # no comment
                    three   """
    """
    sweep: {candidates: {kind: edge}, weights: {cpu: 1}}
"""
)  # with blanks at a line's end
ANCHORED = """\
fleet: hall
nodes: {r1: {kind: robot}, e1: {kind: edge, host: h, listen: {control: tcp/0.0.0.0:7457, data: tcp/0.0.0.0:7458}}}
tasks:
  sweep: {candidates: &all {kind: edge}, weights: {cpu: 1}}
  count:
    candidates: *all
    weights: {cpu: 1}
"""
FLOW = (
    ANCHORED.partition("tasks:")[0]
    + "tasks: {count: {candidates: [e1], weights: {cpu: 1}}, b: {candidates: [e1], weights: {cpu: 1}}}"
)


BREAKS = FLOW.replace("candidates: [e1]", 'worker: {command: [say, "a\\u2028b\\x85c\\u2029: d"]}, candidates: [e1]', 1)


@pytest.mark.parametrize(
    ("text", "task"), [(BREAKS, "count"), (ANNOTATED, "map_merge"), (BLOCK, "count"), (FLOW, "count"), (BLOCK, "sweep")]
)
def test_an_entry_that_is_kept_and_brought_back_says_the_same(text: str, task: str) -> None:
    entry = task_entry(text, task)
    assert entry.startswith(f"tasks:\n  {task}:")
    kept = marked(remove_task(text, task), Mark(task=task, cell="hall-b", entry=entry))
    assert mark_of(kept, task) == Mark(task=task, cell="hall-b", entry=entry)
    assert mark_of(kept, "other") is None
    assert check_bytes(kept.encode()).fleet == check_bytes(remove_task(text, task).encode()).fleet, "a comment"
    bare = unmarked(kept, task)
    assert bare.removesuffix("\n") == remove_task(text, task).removesuffix("\n")
    back, before = (check_bytes(one.encode()).fleet for one in (add_entries(bare, "tasks", entry), text))
    assert back is not None
    assert before is not None
    assert {one.name: one for one in back.tasks} == {one.name: one for one in before.tasks}


def test_an_entry_keeps_its_lines_and_comments() -> None:
    lines = task_entry(BLOCK, "count").splitlines()
    assert lines[1:6] == [
        "  count:   # pallets",
        "      candidates: [e1]",
        "",
        "      # two lines",
        "      weights: {cpu: 1}",
    ]


def test_an_entry_that_says_less_alone_is_written_anew() -> None:
    assert task_entry(ANCHORED, "count") == "tasks:\n  count: {candidates: {kind: edge}, weights: {cpu: 1}}\n"


def test_a_second_mark_takes_the_place_of_the_first_and_leaves_others() -> None:
    one = marked(BLOCK, Mark(task="count", cell="hall-b", entry=task_entry(BLOCK, "count")))
    two = marked(one, Mark(task="sweep", cell="hall-c", entry=task_entry(BLOCK, "sweep")))
    again = marked(two, Mark(task="count", cell="hall-d", entry=task_entry(BLOCK, "count")))
    found = [mark_of(again, name) for name in ("count", "sweep")]
    assert [mark.cell for mark in found if mark is not None] == ["hall-d", "hall-c"]
    assert unmarked(unmarked(again, "count"), "sweep") == BLOCK


def test_a_mark_that_stands_there_twice_goes_as_a_whole() -> None:
    """Two documents were put together by hand."""
    once = marked(BLOCK, Mark(task="count", cell="hall-b", entry=task_entry(BLOCK, "count")))
    assert unmarked(once + once.removeprefix(BLOCK), "count") == BLOCK


def test_a_mark_tells_which_run_of_the_command_it_is_of() -> None:
    mark = Mark(task="count", cell="hall-b", entry=task_entry(BLOCK, "count"), by="0123abcd")
    assert mark_of(marked(BLOCK, mark), "count") == mark
    assert mark_of(marked(BLOCK, mark).replace(" by 0123abcd", ""), "count") == Mark(
        task="count", cell="hall-b", entry=mark.entry
    )


def test_a_mark_that_somebody_has_cut_is_none() -> None:
    text = marked(BLOCK, Mark(task="count", cell="hall-b", entry=task_entry(BLOCK, "count")))
    cut = text.replace("# zsched: end of task count\n", "seeds: [e1]\n")
    assert mark_of(cut, "count") is None
    assert unmarked(cut, "count") == cut


def test_names_are_found_as_words_in_values_only() -> None:
    entry = """\
tasks:
  robot9:
    candidates: [edge1, edge12]
    worker: {command: [python, "--peer=robot1", robot3x]}
    inputs: [{from: "robot2/in", to: "{target}/x/robot2"}]
"""
    known = ["robot1", "robot2", "robot3", "edge1", "edge2", "robot9", "inputs"]
    assert names_in(entry, known) == ("edge1", "robot1", "robot2")
