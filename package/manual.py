"""Manual pages (man) out of the same texts as `--help`: one for the program, one for each verb.

`make man` writes them: ``python package/manual.py FOLDER``.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import typer.main

from zsched.cli import app


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


if __name__ == "__main__":
    for name, text in pages(typer.main.get_command(app)).items():
        (Path(sys.argv[1]) / name).write_text(text, encoding="utf-8")
