"""When two answers of one robot say the same."""

from __future__ import annotations

from dataclasses import replace

import pytest

from support.proposals import vector_of
from zsched.core.scheduler.rest import SAME_UTILITY, is_like
from zsched.core.values.model import UtilityVector

OLD = vector_of("robot1", {"edge1": 0.7, "edge2": 0.5}, 5)


def test_an_answer_is_like_one_with_figures_that_differ_by_less_than_a_news() -> None:
    near = vector_of("robot1", {"edge1": 0.7 + 0.9 * SAME_UTILITY, "edge2": 0.5 - 0.9 * SAME_UTILITY}, 5)
    assert is_like((OLD,), (OLD,))
    assert is_like((near,), (OLD,))


@pytest.mark.parametrize(
    "new",
    [
        vector_of("robot1", {"edge1": 0.7, "edge2": 0.5 + 1.1 * SAME_UTILITY}, 5),
        vector_of("robot1", {"edge1": 0.7 - 1.1 * SAME_UTILITY, "edge2": 0.5}, 5),
        vector_of("robot1", {"edge1": 0.7}, 5),
        vector_of("robot1", {"edge1": 0.7, "edge2": 0.5}, 6),
        replace(OLD, refused=(("edge3", "no fresh profile"),)),
        replace(OLD, utilities=(OLD.utilities[0], replace(OLD.utilities[1], reachable=False))),
        replace(OLD, utilities=(OLD.utilities[0], replace(OLD.utilities[1], at_limit=True))),
    ],
)
def test_an_answer_that_could_lead_to_another_decision_is_not_like_it(new: UtilityVector) -> None:
    assert not is_like((new,), (OLD,))
    assert not is_like((OLD, new), (OLD,))
