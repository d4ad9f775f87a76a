"""The house's budget: no room grows unseen (`benchmarks/budget.toml`)."""

from __future__ import annotations

import pytest

from benchmarks.house import HERE, budget, code_lines, spent


def test_no_figure_is_above_its_budget() -> None:
    now, most = spent(HERE), budget()
    above = {name: (figure, most.get(name)) for name, figure in now.items() if figure > most.get(name, 0)}
    assert not above, "now and at most: take something away, or say in the commit why this room must grow"


def test_each_budget_is_of_a_figure_that_there_is() -> None:
    assert set(budget()) <= set(spent(HERE)), "run: python -m benchmarks.house --lower"


@pytest.mark.parametrize(
    ("text", "lines"),
    [
        ("", 0),
        ("# a comment\n\n", 0),
        ('"""A docstring\n\nof three lines."""\nx = 1  # with a comment\n', 1),
        ('def f() -> str:\n    """Told."""\n    return """two\nlines"""\n', 3),
        ('X = 1\n"""What it is."""\n', 1),
        ("y = f(\n    1,\n\n    2,\n)\n", 4),
    ],
)
def test_a_line_counts_where_it_has_code(text: str, lines: int) -> None:
    assert code_lines(text) == lines
