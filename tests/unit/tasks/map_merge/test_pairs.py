"""The acceptance rule and the graph of accepted alignments."""

from __future__ import annotations

import math

import pytest

from zsched.tasks.map_merge.align import Fit
from zsched.tasks.map_merge.geometry import Pose2, difference
from zsched.tasks.map_merge.pairs import Alignment, Rule, broken_cycle, spanning_transforms

_RULE = Rule()


def _fit(*, score: float = 0.9, agreeing: int = 1000, pose: Pose2 | None = None) -> Fit:
    return Fit(a_t_b=pose or Pose2(), score=score, agreeing=agreeing, overlap=0.4)


def _edge(a: str, b: str, pose: Pose2, agreeing: int = 1000) -> Alignment:
    return Alignment(pair=(a, b), fit=_fit(pose=pose, agreeing=agreeing), margin=2.0, is_accepted=True)


def _centre(_robot: str) -> tuple[float, float]:
    return 0.0, 0.0


@pytest.mark.parametrize(
    ("found", "margin", "word"),
    [
        (_fit(), 1.3, ""),
        (_fit(), None, ""),
        (_fit(score=0.75, agreeing=600), 1.3, ""),
        (_fit(score=0.749), 2.0, "score"),
        (_fit(agreeing=599), 2.0, "wall cells"),
        (_fit(), 1.29, "margin"),
    ],
)
def test_rule_needs_score_agreement_and_margin(found: Fit, margin: float | None, word: str) -> None:
    refusal = _RULE.refusal(found, 0.05, margin)
    assert (refusal == "") == (word == "")
    assert word in refusal


def _triangle(closing_error: Pose2) -> list[Alignment]:
    a_t_b, b_t_c = Pose2(x=3.0, yaw=0.5), Pose2(y=2.0, yaw=-0.2)
    return [
        _edge("a", "b", a_t_b),
        _edge("b", "c", b_t_c),
        _edge("a", "c", a_t_b.compose(b_t_c).compose(closing_error), agreeing=700),
    ]


@pytest.mark.parametrize("error", [Pose2(x=0.51), Pose2(yaw=math.radians(3.1))])
def test_circle_that_does_not_close_names_the_weakest(error: Pose2) -> None:
    broken = broken_cycle(_triangle(error), _centre)
    assert broken is not None
    assert broken[0] == ("a", "c")
    assert "a - b - c" in broken[1]


def test_spanning_follows_the_strongest_edges_in_both_directions() -> None:
    edges = _triangle(Pose2(x=0.3))
    poses, tree = spanning_transforms("c", edges, frozenset())
    assert tree == {("b", "c"), ("a", "b")}
    metres, radians = difference(poses["a"], Pose2(x=3.0, yaw=0.5).compose(Pose2(y=2.0, yaw=-0.2)).inverse())
    assert metres < 1e-9
    assert radians < 1e-9


def test_spanning_keeps_its_tree_against_a_slightly_stronger_edge() -> None:
    edges = [_edge("a", "b", Pose2()), _edge("a", "c", Pose2(), 1000), _edge("b", "c", Pose2(), 1200)]
    _, fresh = spanning_transforms("a", edges, frozenset())
    _, kept = spanning_transforms("a", edges, frozenset({("a", "b"), ("a", "c")}))
    assert ("b", "c") in fresh
    assert kept == {("a", "b"), ("a", "c")}


def test_spanning_leaves_out_who_is_not_connected() -> None:
    poses, _ = spanning_transforms("a", [_edge("b", "c", Pose2())], frozenset())
    assert poses == {"a": Pose2()}
