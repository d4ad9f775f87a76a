"""Manual pages (man) out of the same texts as `--help`: one for the program, one for each verb.

Knows: the tree of verbs as typer builds it, roff, files. Does not know: any verb.
"""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from zsched.commands.common import CliError, counted, say
from zsched.exits import EXIT_FAILED


def write_pages(program: Any, folder: Path) -> None:
    """Write the pages of ``program`` into a folder, which is made if it is not there.

    Raises:
        CliError: the folder cannot be written.
    """
    found = pages(program)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in found.items():
            (folder / name).write_text(text, encoding="utf-8")
    except OSError as error:
        raise CliError(
            EXIT_FAILED, f"{error.filename or folder}: {error.strerror}; give a folder to write to"
        ) from error
    say(f"{folder}: {counted(len(found), 'pages')}")


def pages(program: Any) -> dict[str, str]:
    """{file name: page} of ``program`` and all its own verbs but hidden ones."""
    return {f"{'-'.join(words)}.1": _page(words, one) for words, one in _commands(program, (program.name,))}


def _commands(command: Any, words: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    yield words, command
    for name, below in getattr(command, "commands", {}).items():
        if not below.hidden:
            yield from _commands(below, (*words, name))


def _page(words: tuple[str, ...], command: Any) -> str:
    title, spoken = "-".join(words), " ".join(words)
    text = inspect.cleandoc(command.help or "")
    first = text.partition("\n\n")[0]
    arguments = [param for param in command.params if param.param_type_name == "argument"]
    options = [param for param in command.params if param.param_type_name == "option"]
    lines = [
        f'.TH "{title.upper()}" "1" "" "zsched" "zsched"',
        ".SH NAME",
        f"{_roff(title)} \\- {_roff(_joined(first).rstrip('.'))}",
        ".SH SYNOPSIS",
        f".B {_roff(spoken)}",
        *(_roff(word) for word in ("[OPTIONS]", *(_metavar(param) for param in arguments))),
        *(["COMMAND [ARGS]..."] if hasattr(command, "commands") else []),
        ".SH DESCRIPTION",
        *_paragraphs(text),
    ]
    lines += [".SH ARGUMENTS", *_list(arguments)] if arguments else []
    lines += [".SH OPTIONS", *_list(options), *_item("-h, --help", "Show this message and exit.")]
    below = {name: one for name, one in getattr(command, "commands", {}).items() if not one.hidden}
    if below:
        lines += [".SH COMMANDS"]
        for name, one in below.items():
            lines += _item(name, _joined(inspect.cleandoc(one.help or "").partition("\n\n")[0]))
    if command.epilog:
        lines += [".SH EXIT STATUS", *_paragraphs(command.epilog.removeprefix("Exit codes: "))]
    others = ["-".join(words[:-1])] if len(words) > 1 else ["-".join((*words, name)) for name in below]
    lines += [".SH SEE ALSO", ", ".join(f"\\fB{_roff(other)}\\fR(1)" for other in others)]
    return "\n".join(lines) + "\n"


def _list(params: list[Any]) -> Iterator[str]:
    for param in params:
        names = ", ".join((*param.opts, *param.secondary_opts))
        takes = "" if getattr(param, "is_flag", True) else f" {param.metavar or param.name.strip('_').upper()}"
        yield from _item(f"{names}{takes}" if param.param_type_name == "option" else _metavar(param), param.help or "")


def _metavar(param: Any) -> str:
    return str(param.metavar or param.name.upper())


def _item(term: str, text: str) -> list[str]:
    return [".TP", f"\\fB{_roff(term)}\\fR", _roff(_joined(text))]


def _paragraphs(text: str) -> Iterator[str]:
    for number, paragraph in enumerate(text.split("\n\n")):
        yield from ([".PP"] if number else [])
        yield _roff(_joined(paragraph))


def _joined(text: str) -> str:
    return " ".join(text.split())


def _roff(text: str) -> str:
    """Plain text that roff takes for text."""
    escaped = text.replace("\\", "\\e").replace("-", "\\-").replace("`", "\\(ga")
    return f"\\&{escaped}" if escaped.startswith((".", "'")) else escaped
