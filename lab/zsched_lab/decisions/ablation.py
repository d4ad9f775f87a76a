"""``python -m zsched_lab.decisions.ablation OFF service ...``: the study with mechanisms of forecasting switched off.

``OFF`` is one name of `SWITCHES` or of a filter that one robot looks at by itself (`zsched.core.values.veto.Filter`),
or several with commas between; what follows is as for `zsched_lab.decisions`.

Knows: which function or figure each mechanism hangs on. Does not know: what it earns.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from typing import Any, Final

from zsched.core.gateway import demand
from zsched.core.gateway.sharing import Shares
from zsched.core.scheduler import utility
from zsched.core.scheduler.eligibility import CHAIN
from zsched.core.scheduler.kept import Kept
from zsched.core.values.veto import Filter
from zsched_lab.decisions.__main__ import main

Switch = tuple[Any, str, Any]
"""What is set, under which name, to what."""


def _always(value: object) -> Callable[..., object]:
    return lambda *_given, **_more: value


def _at_without_experience(shares: Shares, *given: Any) -> float:
    """A fair share that is believed wherever the task has been."""
    getattr(shares, "_kept").clear()  # noqa: B009 - the study reaches into the product here, and nowhere else
    cores: float = _AT(shares, *given)
    return cores


_AT: Final = Shares.at
SWITCHES: Final[Mapping[str, tuple[Switch, ...]]] = {
    "kept": ((Kept, "corrected", lambda _kept, worth, *_more: dict(worth)),),
    "seen-lack": ((demand.Demands, "given_ratio", _always(1.0)),),
    "seen-age": ((demand.Demands, "seen_s", _always(0.0)),),
    "fair-share": ((Shares, "at", _always(0.0)),),
    "kept-share": ((Shares, "at", _at_without_experience),),
    "guess": ((demand, "UNSURE", 1.0),),
    "told-lack": ((demand, "_told", _always(None)),),
    "least-need": ((utility, "LEAST_NEED_RATIO", 0.0),),
    "free-room": ((utility, "SPARE", 0.005),),
}
"""{mechanism: what switches it off}."""


if __name__ == "__main__":
    for name in filter(None, sys.argv.pop(1).split(",")):
        for place, attribute, value in SWITCHES.get(name, ()):
            setattr(place, attribute, value)
        if name not in SWITCHES:
            del CHAIN[Filter(name)]
    main()
