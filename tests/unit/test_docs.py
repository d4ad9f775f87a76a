"""The documentation says what the code says: links, key and wire tables, commands, decisions, no foreign paths.

Run as a program, this file writes the tables of docs/design/wire.md anew.
"""

from __future__ import annotations

import csv
import inspect
import re
import types
from collections.abc import Iterator, Sequence
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from pathlib import Path
from typing import Any, Final, NewType, Union, get_args, get_origin

import pytest
import typer.main

from zsched.cli import app
from zsched.commands.program import LAB_VERBS
from zsched.config.timing import PROFILES
from zsched.core.values import (
    codec as wire,  # the pipe's kinds are registered with the codec when its module is imported
)
from zsched.link.keyspace import Keyspace
from zsched.link.pipe import frames as relay_pipe
from zsched_lab.bugs.core_bugs import Bug
from zsched_lab.bugs.planted import BUGS, places

ROOT: Final = Path(__file__).parents[2]
DOCS: Final = sorted(
    path
    for path in (*ROOT.glob("*.md"), *ROOT.glob("docs/**/*.md"))
    if ".venv" not in path.parts  # a virtual environment below docs/ is nobody's document
)
NAMES: Final = [str(path.relative_to(ROOT)) for path in DOCS]
LINK: Final = re.compile(r"!?\[[^\]]*\]\(([^()\s]+)\)")
FENCE: Final = re.compile(r"^```[^\n]*\n(.*?)^```", re.MULTILINE | re.DOTALL)
COMMAND: Final = re.compile(r"(?:^|[\s`(/])zsched ([a-z]+)((?: [^\s`#;|&)]+)*)", re.MULTILINE)


def text_of(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


# --- links -----------------------------------------------------------------------------------------------------------


def anchor(heading: str) -> str:
    """A heading's anchor, as GitHub makes it."""
    words = re.sub(r"[^\w\- ]", "", heading.replace("`", "").strip().lower())
    return words.replace(" ", "-")


def broken_links(path: Path, text: str) -> Iterator[str]:
    for target in LINK.findall(FENCE.sub("", text)):
        if re.match(r"[a-z]+:", target):
            continue
        place, _, fragment = target.partition("#")
        file = (path.parent / place).resolve() if place else path
        if not file.is_relative_to(ROOT):
            yield f"{target}: outside the repository"
        elif not file.exists():
            yield f"{target}: not there"
        elif fragment and fragment not in {anchor(h) for h in re.findall(r"^#+ (.*)$", file.read_text(), re.MULTILINE)}:
            yield f"{target}: no such heading"


@pytest.mark.parametrize("name", NAMES)
def test_links_resolve(name: str) -> None:
    assert list(broken_links(ROOT / name, text_of(name))) == []


def test_planted_broken_links_are_found() -> None:
    text = "[a](nowhere.md) [b](README.md#no-such-heading) [c](../secret) [d](https://example.org) [e](LICENSE)"
    found = list(broken_links(ROOT / "x.md", text))
    assert [line.split(":")[0] for line in found] == ["nowhere.md", "README.md#no-such-heading", "../secret"]


def test_every_document_is_in_the_index() -> None:
    index = ROOT / "docs" / "README.md"
    linked = {(index.parent / target.partition("#")[0]).resolve() for target in LINK.findall(index.read_text())}
    assert [
        name for path, name in zip(DOCS, NAMES, strict=True) if path != index and path.resolve() not in linked
    ] == []


# --- what is named must exist ----------------------------------------------------------------------------------------


FOLDERS: Final = "|".join(
    sorted(
        {path.name for base in (ROOT, ROOT / "zsched") for path in base.iterdir() if path.is_dir()} - {"build", "dist"}
    )
).replace(".", r"\.")
"""The first word of a path that the documents give."""


def missing_files(text: str) -> list[str]:
    """Files of the repository named in backticks that are not there (``{a,b}`` and ``*`` are expanded)."""
    missing = []
    for name in re.findall(rf"`((?:{FOLDERS})/[^\s`]+)`", text):
        alternatives = re.search(r"\{([^}]*)\}", name)
        parts = alternatives.group(1).split(",") if alternatives else [""]
        for part in parts:
            one = name.replace(alternatives.group(0), part) if alternatives else name
            one = one.partition("::")[0].rstrip("/")
            if not any(any(base.glob(one)) for base in (ROOT, ROOT / "zsched")):
                missing.append(one)
    return missing


@pytest.mark.parametrize("name", NAMES)
def test_named_files_exist(name: str) -> None:
    assert missing_files(text_of(name)) == []


def test_planted_missing_file_is_found() -> None:
    assert missing_files("`core/node/node.py` `tests/unit/core/node/test_{node,nothing}.py` `core/absent.py`") == [
        "tests/unit/core/node/test_nothing.py",
        "core/absent.py",
    ]


def test_named_tests_exist() -> None:
    """Every ``test_...`` function that a document names is in the suite."""
    code = "\n".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py"))
    defined = set(re.findall(r"def (test_\w+)", code))
    modules = {path.stem for path in (ROOT / "tests").rglob("test_*.py")}
    named = {word for name in NAMES for word in re.findall(r"`(test_\w+)`", text_of(name))}
    named |= set(re.findall(r",(test_\w+),", text_of(BUG_LIST)))
    assert sorted(named - defined - modules) == []


def test_glossary_s_python_names_are_the_code_s() -> None:
    """The last part of every name behind a word is a word of the sources."""
    sources = [*(ROOT / "zsched").rglob("*.py"), *(ROOT / "lab").rglob("*.py")]
    words = {word for path in sources for word in re.findall(r"\w+", path.read_text())}
    words |= {path.stem for base in ("zsched", "lab") for path in (ROOT / base).rglob("*")} | {"FLOORS", "py"}
    names = set(re.findall(r"^\* \*\*[^*]+\*\* \(`([^`]+)`\): ", text_of("docs/design/glossary.md"), re.MULTILINE))
    assert len(names) > 50
    assert sorted(name for name in names if re.findall(r"\w+", name)[-1] not in words) == []


@pytest.mark.parametrize("name", NAMES)
def test_python_examples_compile(name: str) -> None:
    for number, code in enumerate(re.findall(r"^```python\n(.*?)^```", text_of(name), re.MULTILINE | re.DOTALL)):
        compile(code, f"{name}, example {number}", "exec")


ABSOLUTE: Final = re.compile(r"(?<![\w.}*<>:/@-])/([A-Za-z][\w.-]*)/[\w.*<-]")
PLACES: Final = frozenset({"opt", "etc", "usr", "var", "run", "proc", "sys", "dev", "path"})
"""Folders that every Linux machine has (and ``/path/to``)."""


def foreign_paths(text: str) -> list[str]:
    return [match.group(0) for match in ABSOLUTE.finditer(text) if match.group(1) not in PLACES]


@pytest.mark.parametrize("name", NAMES)
def test_no_document_names_a_path_of_somebody_s_machine(name: str) -> None:
    assert foreign_paths(text_of(name)) == []


def test_planted_foreign_path_is_found() -> None:
    assert foreign_paths("see /home/me/notes and `/etc/zsched/fleet.yaml`, not robot1/map or {robot}/map") == [
        "/home/m"
    ]


# --- keyspace.md -----------------------------------------------------------------------------------------------------


def rendered_keys() -> dict[str, str]:
    """{method of `Keyspace`: its key, every argument as ``<name>``}."""
    keys = Keyspace("<fleet>")
    found = {}
    for name, method in inspect.getmembers(keys, inspect.ismethod):
        if not name.startswith("_"):
            found[name] = method(*(f"<{argument}>" for argument in inspect.signature(method).parameters))
    return found


def between(text: str, mark: str) -> str:
    return text.partition(f"<!-- {mark}: begin -->\n")[2].partition(f"<!-- {mark}: end -->")[0].strip("\n")


def test_key_table_is_the_code_s() -> None:
    rows = re.findall(r"^\| `(\w+)` \| `([^`]+)` \|", between(text_of("docs/design/keyspace.md"), "keys"), re.MULTILINE)
    assert len(rows) == len(dict(rows))
    assert dict(rows) == rendered_keys()


# --- wire.md ---------------------------------------------------------------------------------------------------------


def parts_of(hint: Any) -> Iterator[type]:
    """The frozen values inside a type hint, at every depth."""
    if get_origin(hint) in (tuple, Union, types.UnionType):
        for inner in get_args(hint):
            yield from parts_of(inner)
    elif is_dataclass(get_origin(hint) or hint):
        yield get_origin(hint) or hint
        for inner in wire.hints_of(hint).values():
            yield from parts_of(inner)


def shown(hint: Any) -> str:
    """A type hint in a reader's words."""
    if get_origin(hint) is tuple:
        arguments = get_args(hint)
        if arguments[-1] is Ellipsis:
            return f"list of {shown(arguments[0])}"
        return f"({', '.join(shown(argument) for argument in arguments)})"
    if get_origin(hint) in (Union, types.UnionType):
        return " or ".join("nil" if part is type(None) else shown(part) for part in get_args(hint))
    if isinstance(hint, type) and issubclass(hint, Enum):
        return "one of " + " ".join(str(member.value) for member in hint)
    has_name = isinstance(hint, type | NewType) or is_dataclass(get_origin(hint))
    return str(hint.__name__) if has_name else str(hint)


def fields_of(cls: type) -> str:
    """A value's fields behind their types; what may be left out ends with a question mark."""
    hints = wire.hints_of(cls)
    by_type: dict[str, list[str]] = {}
    for f in fields(cls):
        by_type.setdefault(shown(hints[f.name]), []).append(f"{f.name}{'' if f.default is MISSING else '?'}")
    return "; ".join(f"{kind}: `{' '.join(names)}`" for kind, names in by_type.items()) or "none"


def title(kind: str, cls: type) -> str:
    """A kind, and its class where that is not the kind's name in capitals."""
    usual = cls.__name__ == "".join(word.title() for word in kind.split("_"))
    return f"`{kind}`" if usual else f"`{kind}` (`{cls.__name__}`)"


def kinds_table() -> str:
    assert relay_pipe.REPORTS  # imported for its registrations
    lines = ["| kind | at most, bytes | fields |", "| --- | --- | --- |"]
    for kind, (cls, bound) in wire.KINDS.items():
        if cls.__module__.startswith("zsched."):
            lines.append(f"| {title(kind, cls)} | {bound} | {fields_of(cls)} |")
    return "\n".join(lines)


def parts_table() -> str:
    kinds = {cls for cls, _ in wire.KINDS.values()}
    inner = {part for cls in kinds for hint in wire.hints_of(cls).values() for part in parts_of(hint)} - kinds
    lines = ["| value | fields |", "| --- | --- |"]
    lines += [f"| `{cls.__name__}` | {fields_of(cls)} |" for cls in sorted(inner, key=lambda cls: cls.__name__)]
    return "\n".join(lines)


TABLES: Final = {"kinds": kinds_table, "parts": parts_table}


def write_tables() -> None:
    text = text_of("docs/design/wire.md")
    for mark, table in TABLES.items():
        text = text.replace(between(text, mark), table())
    (ROOT / "docs" / "design" / "wire.md").write_text(text, encoding="utf-8")


@pytest.mark.parametrize(("mark", "table"), TABLES.items())
def test_wire_tables_are_the_codec_s(mark: str, table: Any) -> None:
    assert between(text_of("docs/design/wire.md"), mark) == table(), (
        "write them anew: .venv/bin/python tests/unit/test_docs.py"
    )


def test_wire_version_told_is_the_codec_s() -> None:
    assert f"This is version {wire.VERSION}." in text_of("docs/design/wire.md")


# --- timing.md -------------------------------------------------------------------------------------------------------


def test_profiles_are_told_as_the_code_s_differences() -> None:
    rows = {}
    for line in between(text_of("docs/design/timing.md"), "profiles").splitlines()[2:]:
        name, *cells = [cell.strip(" `") for cell in line.strip("|").split("|")]
        rows[name] = cells[:3]
    base, expected = PROFILES["wifi"], {}
    for field in fields(base):
        if field.name != "name":
            usual = getattr(base, field.name)
            others = [getattr(PROFILES[name], field.name) for name in ("wired", "wan")]
            expected[field.name] = [f"{usual:g}", *("" if value == usual else f"{value:g}" for value in others)]
    assert rows == expected


# --- commands --------------------------------------------------------------------------------------------------------

PROGRAM: Final[Any] = typer.main.get_command(app)
VERBS: Final[dict[str, Any]] = {name: PROGRAM.get_command(None, name) for name in PROGRAM.list_commands(None)}


def wrong_commands(text: str) -> list[str]:
    """Commands of the command line in ``text`` whose verb, or an option of it, does not exist."""
    wrong = []
    for verb, rest in COMMAND.findall(text):
        below = next(iter(rest.split()), "")
        command = getattr(VERBS.get(verb), "commands", {}).get(below) or VERBS.get(verb)
        if command is None:
            wrong.append(f"zsched {verb}")
            continue
        known = {"--help", "-h"} | {name for param in command.params for name in (*param.opts, *param.secondary_opts)}
        given = [word.partition("=")[0] for word in rest.split() if word.startswith("-")]
        wrong += [f"zsched {verb} {name}" for name in given if name not in known]
    return wrong


def code_of(text: str) -> str:
    return "\n".join((*FENCE.findall(text), *re.findall(r"`(zsched [^`\n]+)`", FENCE.sub("", text))))


@pytest.mark.parametrize("name", NAMES)
def test_commands_are_the_command_line_s(name: str) -> None:
    if name == "CHANGELOG.md":
        return  # tells of commands as they were
    text = text_of(name)
    announced = set(re.findall(r"no `(zsched [a-z]+)`", text))  # what does not exist may be named as such
    assert [command for command in wrong_commands(code_of(text)) if command not in announced] == []


def test_planted_wrong_commands_are_found() -> None:
    text = "sudo bin/zsched ini --node x\nzsched status --jsno | less\nzsched check fleet.yaml   # fine"
    assert wrong_commands(text) == ["zsched ini", "zsched status --jsno"]


def examples(group: Any, before: str = "zsched") -> Iterator[tuple[str, str]]:
    """(each verb below it, the example that its help shows; empty: none)."""
    for name in group.list_commands(None):
        command = group.get_command(None, name)
        words = f"{before} {name}"
        if name in LAB_VERBS:
            continue
        if hasattr(command, "commands"):
            yield from examples(command, words)
        else:
            yield words, (re.findall(r"^Example: (.*)$", inspect.cleandoc(command.help), re.MULTILINE) or [""])[0]


def test_the_help_of_every_verb_has_an_example_that_can_be_typed() -> None:
    found = dict(examples(PROGRAM))
    assert len(found) > 50
    assert [words for words, example in found.items() if f"{words} " not in f"{example} "] == []
    assert wrong_commands("\n".join(found.values())) == []
    assert max(map(len, found.values())) < 80 - len("  Example: ")


# --- decisions -------------------------------------------------------------------------------------------------------

DECISIONS: Final = [name for name in NAMES if name.startswith("docs/decisions/")]


def test_decisions_have_a_number_each() -> None:
    """Records that are written at the same time get their numbers before, and may come in any order."""
    numbers = [int(Path(name).name[:4]) for name in DECISIONS]
    assert numbers == sorted(set(numbers))


PARTS: Final = ["Context", "Decision", "Consequences", "Alternatives refused"]


def has_its_parts(record: str) -> bool:
    """Whether a record has a status and its four parts; one that is replaced names its successor in their place."""
    headings = re.findall(r"^## (.*)$", record, re.MULTILINE)
    if re.search(r"^Status: replaced[^\n]*\]\(\d{4}-", record, re.MULTILINE):
        return headings == []
    return "\nStatus: " in record and headings == PARTS


@pytest.mark.parametrize("name", DECISIONS)
def test_decision_has_its_four_parts_or_a_successor(name: str) -> None:
    assert has_its_parts(text_of(name))


def test_planted_faults_of_a_record_are_found() -> None:
    status, parts = "# 0001: x\n\nStatus: accepted.\n", "".join(f"\n## {part}\n" for part in PARTS)
    replaced = status.replace("accepted", "replaced by [0002](0002-y.md)")
    assert has_its_parts(status + parts)
    assert has_its_parts(replaced)
    for broken in (status, parts, replaced + parts, status + parts.replace("\n## Decision\n", "")):
        assert not has_its_parts(broken)


def test_decisions_that_the_code_cites_exist() -> None:
    cited = {
        number
        for folder in ("zsched", "lab")
        for path in (ROOT / folder).rglob("*.py")
        for number in re.findall(r"decisions/(\d{4})", path.read_text(encoding="utf-8"))
    }
    assert cited <= {Path(name).name[:4] for name in DECISIONS}


# --- planted bugs ----------------------------------------------------------------------------------------------------


BUG_LIST: Final = "docs/develop/planted-bugs.csv"


def faults_of_bug_list(text: str, bugs: Sequence[Bug]) -> list[str]:
    """Differences of docs/develop/planted-bugs.csv from the code: which bugs, where, in which order."""
    rows = [(row["bug"], row["in"]) for row in csv.DictReader(text.splitlines())]
    expected = [(bug.name, places(bug)) for bug in bugs]
    found = [f"no row of {name}" for name, _ in expected if name not in dict(rows)]
    found += [f"no such bug: {name}" for name, _ in rows if name not in dict(expected)]
    return found if found or rows == expected else ["rows in another order, of other modules, or twice"]


def test_every_planted_bug_has_a_row() -> None:
    assert faults_of_bug_list(text_of(BUG_LIST), BUGS) == []


def test_the_page_of_planted_bugs_counts_them() -> None:
    found_by = [row["found by"] for row in csv.DictReader(text_of(BUG_LIST).splitlines())]
    by_seed = sum(how.startswith("seed ") for how in found_by)
    page = text_of("docs/develop/planted-bugs.md")
    assert f"by {len(found_by)} deliberate bugs" in page
    assert f"find {by_seed} of them, directed tests {len(found_by) - by_seed}." in page


def test_planted_faults_of_the_bug_list_are_found() -> None:
    text = text_of(BUG_LIST)
    row = next(line for line in text.splitlines() if line.startswith(f"{BUGS[0].name},"))
    assert faults_of_bug_list(text.replace(row + "\n", ""), BUGS) == [f"no row of {BUGS[0].name}"]
    assert faults_of_bug_list(text, BUGS[1:]) == [f"no such bug: {BUGS[0].name}"]
    assert faults_of_bug_list(text.replace(row, f"{row}\n{row}"), BUGS) != []
    assert faults_of_bug_list(text.replace(row, row.replace(".py", ".pyc", 1)), BUGS) != []


if __name__ == "__main__":
    write_tables()
