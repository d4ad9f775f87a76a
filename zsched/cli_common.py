"""What every verb of the command line shares: exit codes, errors as text, output as JSON, when to use colour.

Knows: the contract (stdout is data, stderr everything else). Does not know: any verb.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Mapping
from typing import Any

import typer
from typer.core import TyperGroup

from zsched.errors import AdapterError, ConfigError, ZschedError

EXIT_OK, EXIT_FAILED, EXIT_USAGE, EXIT_UNREACHABLE, EXIT_DEGRADED, EXIT_TIMED_OUT, EXIT_CONFIG = 0, 1, 2, 3, 4, 5, 78

Json = dict[str, Any]


class CliError(ZschedError):
    """A verb cannot do what was asked: what failed, where, why, one thing to do; ends the command with ``code``."""

    def __init__(self, code: int, text: str) -> None:
        super().__init__(text)
        self.code = code


class Verbs(TyperGroup):
    """Turns the errors we raise on purpose into one message on stderr and an exit code; bugs keep their traceback."""

    def invoke(self, ctx: Any) -> Any:
        """Run the verb."""
        try:
            return super().invoke(ctx)
        except CliError as error:
            code, text = error.code, str(error)
        except ConfigError as error:
            code, text = EXIT_CONFIG, str(error)
        except AdapterError as error:
            code, text = EXIT_FAILED, str(error)
        # a fleet file's faults start with its name, like a compiler's: nothing goes in front of them
        prefix = "" if code == EXIT_CONFIG else f"zsched {ctx.invoked_subcommand}: "
        typer.echo(f"{prefix}{text}", err=True)
        raise typer.Exit(code)


def print_json(body: Mapping[str, Any], *, is_line: bool = False) -> None:
    """One JSON object on stdout: indented for people, or on one line (a stream of them is NDJSON)."""
    text = json.dumps(body, ensure_ascii=False, indent=None if is_line else 2)
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def wants_color(is_refused: bool, env: Mapping[str, str] = os.environ) -> bool:
    """Colour only on a terminal, and not when ``--no-color``, ``NO_COLOR`` (no-color.org) or a dumb one says no."""
    return not is_refused and not env.get("NO_COLOR") and env.get("TERM") != "dumb" and sys.stdout.isatty()
