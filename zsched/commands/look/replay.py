"""`zsched explain --replay FILE`: makes every judgement of a decision log again, and compares it with what was decided.

It also reckons with a written judgement for `zsched explain`: its sums, what a robot sees, without a node.

Knows: lines of a log, the written form, exit codes. Does not know: how a judgement is made
(`zsched.core.scheduler.decision`). It loads the scheduler, so `explain` imports it only when it reckons.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from zsched.commands.base.common import CliError, Json, counted, nearest, print_json, say
from zsched.core.scheduler.decision import decide_again, verdict_of
from zsched.core.scheduler.explain import explained, judged_again, seen_by, without
from zsched.core.values.codec import as_plain, from_plain
from zsched.core.values.decision import Decision
from zsched.core.values.errors import WireError
from zsched.core.values.exits import EXIT_FAILED, EXIT_OK, EXIT_USAGE
from zsched.core.values.report import plain
from zsched.host.decision_log import is_torn
from zsched.host.files import read_packed
from zsched.host.screen import harmless

SCHEMA = "zsched.replay/1"
MOST_BYTES = 64 * 1024 * 1024


def replay(file: Path, *, is_json: bool) -> int:
    """Judge again what the log tells; returns 1 at the first judgement that comes out differently.

    A line that a power cut has torn is left out, and told.

    Raises:
        CliError: the file cannot be read, or a line is none of a decision log.
    """
    try:
        lines = read_packed(file, MOST_BYTES).splitlines()
    except OSError as error:
        raise CliError(EXIT_USAGE, f"{file}: cannot be read: {error.strerror}") from error
    if not lines:
        raise CliError(EXIT_USAGE, f"{file}: it is empty, and no decision log")
    done = 0
    torn: list[int] = []
    for number, line in enumerate(lines, 1):
        try:
            decision, written = _decision(line)
        except (ValueError, AttributeError, TypeError, KeyError, WireError) as error:
            if not is_torn(line):
                raise CliError(EXIT_USAGE, f"{file}:{number}: no line of a decision log ({error})") from error
            torn.append(number)
            continue
        if decision is None:
            continue
        again = json.loads(json.dumps(as_plain(verdict_of(decide_again(decision.figures).judgement))))
        if again != written:
            where = f"{file}:{number}"
            if is_json:
                found = {"judged": done, "equal": False, "line": number, "was": written, "is": again, "torn": torn}
                print_json({"schema": SCHEMA, **found})
            else:
                sys.stdout.write(f"{where}: decided {_told(written)}\n{where}: and again {_told(again)}\n")
            return EXIT_FAILED
        done += 1
    if is_json:
        print_json(
            {"schema": SCHEMA, "judged": done, "equal": True, "line": None, "was": None, "is": None, "torn": torn}
        )
    else:
        say(f"{counted(done, 'judgements')} made again, all equal")
        if torn:
            where = ", ".join(map(str, torn))
            say(f"left out, for a power cut or a full disk has torn it: line {where}")
    return EXIT_OK


def _decision(line: bytes) -> tuple[Decision | None, object]:
    """(a line's judgement, its verdict as it is written); ``None`` for a line without one."""
    body = json.loads(line).get("decision")
    return (None, None) if body is None else (from_plain(body, Decision), body["verdict"])


def _told(verdict: object) -> str:
    return harmless(json.dumps(verdict, ensure_ascii=False))


def read(written: Json) -> Decision:
    """The judgement.

    Raises:
        CliError: another version has written it, or it is damaged.
    """
    try:
        return from_plain(written, Decision)
    except WireError as error:
        text = f"the judgement cannot be read ({error}); update the older of the two, zsched here or the daemon"
        raise CliError(EXIT_FAILED, text) from error


def sums(written: Json) -> Json:
    """Its sums, as ``zsched.explain/1`` has them."""
    told: Json = plain(explained(read(written)))
    return told


def sight(written: Json, robot: str, judge: str) -> Json:
    """What the robot sees, as ``zsched.explain/1`` has it.

    Raises:
        CliError: it is no robot of the fleet.
    """
    decision = read(written)
    robots = decision.figures.voters
    if robot not in robots:
        raise CliError(EXIT_USAGE, f"--robot: the fleet has no robot {robot!r}{nearest(robot, robots)}")
    told: Json = plain(seen_by(decision, robot, judge))
    return told


def planned(written: Json, gone: str) -> Json:
    """The judgement without a node, and whether the task would move.

    Raises:
        CliError: the node is no candidate, robot or elector.
    """
    decision = read(written)
    figures = decision.figures
    known = sorted({*figures.rules.candidates, *figures.voters, *figures.electors})
    if gone not in known:
        raise CliError(EXIT_USAGE, f"--plan: {gone!r} is no candidate, robot or elector{nearest(gone, known)}")
    again = judged_again(decision, without(figures, gone))
    told: Json = plain(explained(again))
    moves = again.verdict.outcome == "propose" and again.verdict.candidate != figures.allocation.owner
    return {"without": gone, "would_move": moves, **told}
