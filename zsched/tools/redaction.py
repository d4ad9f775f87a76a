"""Takes secrets out of what an operator hands to others (pure).

Knows: names that stand for secrets, passwords in URLs and options, PEM keys. Does not know: where a text came from.

What no name gives away stays: a text with secrets in a comment keeps them.
"""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Iterable, Iterator
from typing import Any, Final

from zsched.core.values.fleet import Fleet

GONE: Final = "REMOVED"
LEAST: Final = 4
"""A shorter value is taken out where it stands, and not wherever the same letters are."""
_WORDS: Final = "pass|pwd|key|apikey|auth|pin"
_PLAIN: Final = "passwd|password|passphrase|secret|token|credential"
"""Words that stand for nothing else, wherever they are in a name (``PGPASSWORD``, ``apiToken``)."""
NAME: Final = re.compile(rf"(?:^|[_-])(?:{_WORDS})(?:[_-]|\d|$)|{_PLAIN}", re.IGNORECASE)
_PAIR: Final = re.compile(
    r"""(?P<name>["']?[A-Za-z_][\w-]*["']?)(?P<sep>\s*:\s+)"""
    r"""(?P<value>"(?:[^"\\]|\\.)*"|'(?:[^']|'')*'|[^\s,{}\[\]#][^,}\n#]*)"""
)
_WORD_AFTER: Final = re.compile(
    r"""(?P<name>["']?--[A-Za-z_][\w-]*["']?)(?P<sep>[ \t]*,\s*|[ \t]*\n[ \t]*-[ \t]+)"""
    r"""(?P<value>"(?:[^"\\]|\\.)*"|'(?:[^']|'')*'|[^\s,{}\[\]#"'][^,\]\n#]*)"""
)
"""An option in a list of words, and the word behind it."""
_SHELL_WORD: Final = re.compile(
    r"""(?P<name>--[A-Za-z_][\w-]*)(?P<sep>[ \t]+)"""
    r"""(?P<value>'[^']*'|\\?"[^"\\]*\\?"|[^\s"',;&|\]}\\-][^\s"',;&|\]}\\]*)"""
)
"""An option in a line for a shell, and the word behind it."""
_OPTION: Final = re.compile(r"(?P<name>(?:--)?[A-Za-z_][\w-]*)(?P<sep>=)(?P<value>\"[^\"]*\"|'[^']*'|[^\s,;&\]\"']+)")
_URL: Final = re.compile(r"(?P<head>\b[a-z][a-z0-9+.-]*://)[^/\s@\"']+@")
_PEM: Final = re.compile(r"-----BEGIN ([A-Z ]*PRIVATE KEY)-----.*?-----END \1-----", re.DOTALL)
_LINE: Final = re.compile(r"^(?P<indent>\s*)(?P<name>[\"']?[A-Za-z_][\w-]*[\"']?)\s*:\s+(?![{\[#\s])")
"""A line of a block mapping, whose value is the rest of it, and may go on in deeper lines."""


def secrets_of(fleet: Fleet | None) -> tuple[str, ...]:
    """Values of the workers' environments and options whose names say that they are secrets, the longest first."""
    found: set[str] = set()
    for task in fleet.tasks if fleet is not None else ():
        found.update(value for name, value in task.worker.env if NAME.search(name))
        words = [word.removeprefix("--arg=").removeprefix("--option=") for word in task.worker.command]  # of drivers
        for line in (words, *(word.split() for word in words)):  # a word may be a line for a shell
            found.update(after for word, after in itertools.pairwise(line) if _is_option(word) and "=" not in word)
            found.update(word.partition("=")[2] for word in line if _is_option(word.partition("=")[0]))
    plain = {line.strip() for value in found for line in value.splitlines()}
    lines = {form for line in plain for form in _forms(line)}
    return tuple(sorted((line for line in lines if len(line) >= LEAST), key=lambda line: (-len(line), line)))


def _forms(secret: str) -> tuple[str, ...]:
    """As it is, and as JSON and both kinds of YAML's quotes write it: the log is JSON, a fleet file may have any."""
    quoted = (json.dumps(secret, ensure_ascii=is_ascii)[1:-1] for is_ascii in (False, True))
    return (secret, *quoted, secret.replace("'", "''"))


def _is_option(word: str) -> bool:
    return word.startswith("--") and NAME.search(word) is not None


def clean(text: str, secrets: Iterable[str] = ()) -> str:
    """The text without ``secrets``, values of options and variables with such names, URLs' passwords, private keys.

    ``key=`` in a log line is a zenoh key, and stays.
    """
    for secret in secrets:
        text = text.replace(secret, GONE)
    text = _PEM.sub(GONE, text)
    text = _URL.sub(rf"\g<head>{GONE}@", text)
    return _OPTION.sub(lambda found: found[0] if found["name"] == "key" else _without_value(found), text)


def clean_yaml(text: str, secrets: Iterable[str] = ()) -> str:
    """The same of a fleet file, whose values also follow ``name: `` or stand in a block below it, or behind an option.

    One with a fault tells no ``secrets`` of its own.
    """
    cleaned = _SHELL_WORD.sub(_without_value, _WORD_AFTER.sub(_without_value, clean(text, secrets)))
    lines = _lines(cleaned.split("\n"))
    return "\n".join(_PAIR.sub(_without_value, line) for line in lines)


def clean_json(value: Any, secrets: tuple[str, ...] = ()) -> Any:
    """The same of every text in JSON values."""
    if isinstance(value, str):
        return clean(value, secrets)
    if isinstance(value, list):
        return [clean_json(one, secrets) for one in value]
    if isinstance(value, dict):
        return {name: clean_json(one, secrets) for name, one in value.items()}
    return value


def _without_value(found: re.Match[str]) -> str:
    name = found["name"].strip("\"'")
    return f"{found['name']}{found['sep']}{GONE}" if NAME.search(name) and GONE not in found["value"] else found[0]


def _lines(lines: Iterable[str]) -> Iterator[str]:
    inside: int | None = None
    for line in lines:
        depth = len(line) - len(line.lstrip())
        if inside is not None and (not line.strip() or depth > inside):
            continue
        inside = None
        found = _LINE.match(line)
        if found is not None and NAME.search(found["name"].strip("\"'")):
            inside = len(found["indent"])
            yield f"{found['indent']}{found['name']}: {GONE}"
        else:
            yield line
