"""Decides which publishers are asked next for what they hold, until each has answered.

Knows: the tokens of publishers, how much each has answered, when a question is repeated. Does not know: zenoh, threads,
clocks, samples.

A question can go unanswered although its publisher is well: it stood still for a moment, or zenoh dropped the question
("Received Query for unknown key_expr"). An answer can be empty although a value is there: the question overtook the
declaration of the cache. So an answer that failed to come is asked for again while the token lives, and an empty one is
believed at the third time. A publisher that has answered is not asked again.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable
from typing import Final

from zsched.core.values.struct import Struct, field

ADVANCED: Final = "@adv"
MAX_PENDING: Final = 64
"""Publishers of one expression that wait to be asked; behind that one question for all is less work."""
MAX_PUBLISHERS: Final = 4096
SETTLE_S: Final = 0.05
"""A publisher that comes while everything is being asked is given this time to answer that question."""
PAUSE_S: Final = 0.5
MAX_PAUSE_S: Final = 8.0
EMPTY_TRIES: Final = 3
BLIND_TRIES: Final = 5
"""Questions for everything when one fails and no known publisher explains it."""

Publisher = tuple[str, str, str]
"""Its key, its session, its number there (or ``uhlc``)."""


class Question(Struct, frozen=True, kw_only=True):
    """One query, and what comes of it."""

    selector: str
    tokens: tuple[str, ...]
    """Whose publishers it asks, as far as they are known."""
    is_for_all: bool
    answers: Counter[Publisher] = field(default_factory=Counter)


class _Unanswered(Struct):
    due_s: float
    tries: int = 0


class Questions:
    """Those of one key expression. Callers that share them between threads hold a lock."""

    def __init__(self, expr: str, depth: int) -> None:
        """``depth`` is how many samples of each publisher are wanted."""
        self._all = f"{expr}/{ADVANCED}/**"
        self._depth = depth
        self._unanswered: dict[str, _Unanswered] = {}  # by token, in order
        self._all_due_s: float | None = None
        self._all_tries = 0
        self._all_open: list[Question] = []

    def ask_all(self, now: float) -> None:
        """Everything is to be asked, also of publishers without a token."""
        self._all_due_s = now

    def appeared(self, token: str, now: float) -> None:
        """A publisher with a cache came."""
        if len(self._unanswered) >= MAX_PUBLISHERS:
            self.ask_all(now)
            return
        self._unanswered[token] = _Unanswered(now + SETTLE_S if self._all_open else now)

    def disappeared(self, token: str) -> None:
        """A publisher went: nobody is left to answer."""
        self._unanswered.pop(token, None)

    def next(self, now: float) -> Question | None:
        """What to ask now; `ended` is owed for it."""
        self._take_early_answers()
        due = [token for token, one in self._unanswered.items() if one.due_s <= now]
        if len(due) > MAX_PENDING or (self._all_due_s is not None and self._all_due_s <= now):
            self._all_due_s = None
            question = Question(selector=self._all, tokens=tuple(due), is_for_all=True)
            self._all_open.append(question)
        elif due:
            question = Question(selector=due[0], tokens=(due[0],), is_for_all=False)
        else:
            return None
        for token in question.tokens:
            self._unanswered[token].due_s = math.inf
        return question

    def next_due_s(self) -> float | None:
        """When there is something to ask again; ``None`` when nothing is owed or all of it is under way."""
        times = [one.due_s for one in self._unanswered.values()]
        earliest = min([*times, math.inf if self._all_due_s is None else self._all_due_s])
        return None if earliest == math.inf else earliest

    def ended(self, question: Question, now: float, *, is_whole: bool) -> None:
        """Nothing more comes of a question; ``is_whole``: every publisher that was asked has answered."""
        if question.is_for_all:
            self._all_open.remove(question)
        self._forget(self._unanswered, question, at_least=1 if is_whole else self._depth)
        owing = [one for token in question.tokens if (one := self._unanswered.get(token)) is not None]
        for one in owing:
            one.tries += 1
            one.due_s = now + _pause_s(one.tries)
        if is_whole:
            for token in question.tokens:
                one_left = self._unanswered.get(token)
                if one_left is not None and one_left.tries >= EMPTY_TRIES:
                    del self._unanswered[token]
        elif question.is_for_all and not self._unanswered and self._all_tries < BLIND_TRIES:
            self._all_tries += 1
            self._all_due_s = now + _pause_s(self._all_tries)

    def _take_early_answers(self) -> None:
        """Who appeared during a question for everything may have answered it."""
        for question in self._all_open:
            waiting = [token for token, one in self._unanswered.items() if one.due_s < math.inf]
            self._forget(waiting, question, at_least=self._depth)

    def _forget(self, tokens: Iterable[str], question: Question, at_least: int) -> None:
        for token in list(tokens):
            if question.answers[publisher_of(token)] >= at_least:
                self._unanswered.pop(token, None)


def publisher_of(token: str) -> Publisher:
    """Whose token it is: ``<key>/@adv/pub/<session>/<number>/<anything>``."""
    key, _, rest = token.partition(f"/{ADVANCED}/")
    _, session, number = [*rest.split("/"), "", "", ""][:3]
    return key, session, number


def _pause_s(tries: int) -> float:
    return min(PAUSE_S * 2.0 ** min(tries - 1, 10), MAX_PAUSE_S)
