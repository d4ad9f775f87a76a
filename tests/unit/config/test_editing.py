"""Entries are added and taken out; every other character of the fleet file stays."""

from __future__ import annotations

import difflib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zsched.config.editing import add_entries, add_names, is_list, remove_node, remove_task
from zsched.config.load import check_bytes
from zsched.core.values.errors import ConfigError
from zsched.core.values.fleet import Fleet

ANNOTATED = (Path(__file__).parents[3] / "configs" / "fleet.yaml").read_text()
FRAGMENT = """\
# what the shop floor wants
tasks:
    # counts pallets
    count:
        candidates: [edge1, edge2]   # both have a camera
        weights: {cpu: 1}
        worker:
            command: [python, count.py]

        # nothing leaves it
    sweep: {candidates: {kind: edge}, weights: {cpu: 0.5, memory: 0.5}}
"""
FLOW = "fleet: hall\nnodes: {r1: {kind: robot, links: {e1: {wired: true}}}, e1: {kind: edge}, e2: {kind: edge}}\n"


def fleet_of(text: str) -> Fleet:
    result = check_bytes(text.encode())
    assert result.fleet is not None, result.report()
    return result.fleet


def lines_of(old: str, new: str) -> tuple[list[str], list[str]]:
    """(lines that came, lines that went)."""
    told = list(difflib.ndiff(old.splitlines(), new.splitlines()))
    return [line[2:] for line in told if line[0] == "+"], [line[2:] for line in told if line[0] == "-"]


def test_tasks_are_added_with_their_comments_and_nothing_else_changes() -> None:
    text = add_entries(ANNOTATED, "tasks", FRAGMENT)
    come, gone = lines_of(ANNOTATED, text)
    assert gone == []
    assert come == [
        "  # counts pallets",
        "  count:",
        "      candidates: [edge1, edge2]   # both have a camera",
        "      weights: {cpu: 1}",
        "      worker:",
        "          command: [python, count.py]",
        "",
        "      # nothing leaves it",
        "  sweep: {candidates: {kind: edge}, weights: {cpu: 0.5, memory: 0.5}}",
    ]
    assert [task.name for task in fleet_of(text).tasks] == ["count", "map_merge", "sweep"]


@pytest.mark.parametrize("name", ["count", "sweep"])
def test_a_task_that_was_added_is_removed_without_a_trace_of_its_lines(name: str) -> None:
    text = remove_task(add_entries(ANNOTATED, "tasks", FRAGMENT), name)
    come, gone = lines_of(ANNOTATED, text)
    assert gone == []
    assert f"  {name}:" not in come
    assert [task.name for task in fleet_of(text).tasks] == sorted({"count", "sweep", "map_merge"} - {name})


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("tasks: {}  # none yet\nseeds: [e1]\n", "tasks:  # none yet\n  t: {a: 1}\nseeds: [e1]\n"),
        ("tasks:\nseeds: [e1]\n", "tasks:\n  t: {a: 1}\nseeds: [e1]\n"),
        ("seeds: [e1]", "seeds: [e1]\n\ntasks:\n  t: {a: 1}\n"),
        ("tasks: {u: {b: 2}}\n", "tasks: {u: {b: 2}, t: {a: 1}}\n"),
        ("tasks: {\n  u: {b: 2},\n}\n", "tasks: {\n  u: {b: 2}, t: {a: 1},\n}\n"),
        ("tasks:\n   u: {b: 2}\n   # of u?\n# end\n", "tasks:\n   u: {b: 2}\n   t: {a: 1}\n   # of u?\n# end\n"),
        (
            "tasks:\n  u:\n    text: |\n      one\n\nz: 1\n",
            "tasks:\n  u:\n    text: |\n      one\n\n  t: {a: 1}\nz: 1\n",
        ),
    ],
)
def test_an_entry_goes_into_every_style_of_section(before: str, after: str) -> None:
    assert add_entries(before, "tasks", "tasks: {t: {a: 1}}") == after


@pytest.mark.parametrize(
    "text",
    ["tasks: {u: 2}\n", "tasks: {\n u: 2,  # c\n}\n", "tasks:\n  # c\n  u: 2  # d\n\n# e\n", '{"tasks": {"u": 2\n}}'],
)
def test_what_comes_and_goes_leaves_no_trace(text: str) -> None:
    assert remove_task(add_entries(text, "tasks", "tasks: {t: {a: [1]}}"), "t") == text


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("tasks:\n  t: {a: 1}\nz: 1\n", "tasks: {}\nz: 1\n"),
        ("tasks: {t: {a: 1}}\n", "tasks: {}\n"),
        ("tasks: {t: {a: 1}, u: 2}\n", "tasks: {u: 2}\n"),
        ("tasks: {u: 2, t: {a: 1}}\n", "tasks: {u: 2}\n"),
        (
            "tasks:\n  # of t or more\n  t:\n    a: 1  # c\n    # its own\n\n  # of u\n  u: 2\n",
            "tasks:\n  # of t or more\n\n  # of u\n  u: 2\n",
        ),
        ("tasks:\r\n  t: 1\r\n  u: 2\r\n", "tasks:\r\n  u: 2\r\n"),
        ("tasks:\n  u: 2\n  t: >\n    one\n    two", "tasks:\n  u: 2\n"),
    ],
)
def test_a_task_leaves_every_style_of_section(before: str, after: str) -> None:
    assert remove_task(before, "t") == after


def test_a_node_leaves_its_section_the_lists_and_the_links() -> None:
    text = (
        FLOW + "electorate: [r1, e1, e2]\nseeds:\n  - e2\n  - e1  # the old one\ntasks:\n  t: {candidates: [e1, e2]}\n"
    )
    assert remove_node(text, "e1") == (
        "fleet: hall\nnodes: {r1: {kind: robot, links: {}}, e2: {kind: edge}}\n"
        "electorate: [r1, e2]\nseeds:\n  - e2\ntasks:\n  t: {candidates: [e2]}\n"
    )


def test_what_cannot_be_spliced_is_refused_with_what_to_do() -> None:
    text = "tasks:\n  t: &one {a: 1}\n  u: *one\n"
    with pytest.raises(ConfigError, match=r"tasks\.t cannot be removed .* zsched edit"):
        remove_task(text, "t")
    with pytest.raises(ConfigError, match=r"no tasks\.v; there are t, u"):
        remove_task(text, "v")
    with pytest.raises(ConfigError, match=r"no nodes\.v"):
        remove_node(text, "v")


ENTRY = st.sampled_from(
    ["{a: 1}", "\n    a: 1  # c", "\n    a: |\n      x: 1\n      # y\n", "[1,\n    2]", "'{x}'", "2 # c"]
)


@given(held=st.lists(ENTRY, min_size=2, max_size=5), gone=st.integers(0, 4), gap=st.sampled_from(["", "\n", "  # c\n"]))
def test_every_entry_can_be_removed_and_the_others_keep_their_bytes(held: list[str], gone: int, gap: str) -> None:
    parts = [f"{gap}  t{number}: {text}\n" for number, text in enumerate(held)]
    gone %= len(parts)
    text = remove_task("fleet: f\ntasks:\n" + "".join(parts) + "# end\n", f"t{gone}")
    kept = [part.rstrip("\n") for number, part in enumerate(parts) if number != gone]
    assert all(part.strip() in text for part in kept)
    assert f"t{gone}:" not in text


# --- lists of names --------------------------------------------------------------------------------------------------


def test_names_are_added_to_the_candidates_of_a_task_only_where_they_are_a_list() -> None:
    text = "tasks:\n  merge: {candidates: [a], weights: {cpu: 1}}\n  count:\n    candidates: {kind: edge}\n"
    path = ("tasks", "merge", "candidates")
    assert add_names(text, path, ["x"]) == text.replace("[a]", "[a, x]")
    assert not is_list(text, ("tasks", "count", "candidates"))
    with pytest.raises(ConfigError, match=r"x cannot be added to tasks\.count\.candidates: it is no list of names"):
        add_names(text, ("tasks", "count", "candidates"), ["x"])
    with pytest.raises(ConfigError, match="cannot be added"):
        add_names("{fleet: f}", ("seeds",), ["x"])
