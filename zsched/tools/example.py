"""`zsched new`: writes a small complete example, a fleet file, a worker and an application, into a folder.

Knows: the examples that the package holds, and that nothing is overwritten. Does not know: what is in them.
"""

from __future__ import annotations

import shlex
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Final

import typer

from zsched.commands.base.common import CliError, say, warn
from zsched.core.values.exits import EXIT_FAILED
from zsched.host.files import write_regular

EXAMPLES: Final = Path(__file__).parent / "examples"


APPLICATION: Final = "ask.py"
"""The file of each example that runs on the robot and knows nothing of zsched."""


class Example(StrEnum):
    """Which way the example's worker goes."""

    PYTHON = "python"
    ROS2 = "ros2"
    ZENOH = "zenoh"


def files_of(example: Example) -> dict[str, bytes]:
    """{name: content} of an example, by name."""
    return {path.name: path.read_bytes() for path in sorted((EXAMPLES / example.value).iterdir()) if path.is_file()}


def new(
    kind: Annotated[Example, typer.Argument(metavar="KIND", help="python, ros2 or zenoh: which way its worker goes.")],
    folder: Annotated[Path, typer.Argument(metavar="[DIR]", help="Where. [the current folder]")] = Path(),
) -> None:
    """Write a small task to begin with: a fleet file, a worker, an application (see `zsched dev`).

    Example: zsched new python my-task

    Nothing is overwritten.
    """
    for path in write_example(kind, folder):
        say(str(path))
    words = shlex.join(("zsched", "dev", *(() if folder == Path() else (str(folder),))))
    warn(f"next: `{words}`; it prints the line that starts the application in another terminal")


def write_example(example: Example, folder: Path) -> tuple[Path, ...]:
    """Write the example's files into ``folder``, which is made if it is not there; their paths.

    Raises:
        CliError: a file of that name is there (nothing is written then), or the folder cannot be written.
    """
    files = files_of(example)
    there = [name for name in files if (folder / name).exists() or (folder / name).is_symlink()]
    if there:
        raise CliError(
            EXIT_FAILED, f"{folder} has {', '.join(there)} already, and nothing was written; name another folder"
        )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, content in files.items():
            write_regular(folder / name, content)
    except OSError as error:
        raise CliError(EXIT_FAILED, f"cannot write {error.filename or folder}: {error.strerror}") from error
    return tuple(folder / name for name in files)
