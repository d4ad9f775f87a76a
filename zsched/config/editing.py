"""Decides where an entry stands in a fleet file's text, and adds it or takes it out; every other character stays.

Knows: block and flow style, which lines belong to an entry. Does not know: whether the result is a good fleet file
(`zsched.config.load` tells), who wants it.

The text is spliced, not written again, so comments, quotes and the order of keys are the operator's. What comes of it
is read again: unless it says exactly what was wanted, it is refused.

A comment belongs to an entry if it stands on a line of the entry, or below it and further in than its key. The comment
lines above an entry stay when the entry goes: they may be about more than this one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Final

from zsched.config.reader import Mapping, Node, Scalar, read_yaml
from zsched.config.reader import Sequence as Listing
from zsched.config.rows import flow
from zsched.core.values.errors import ConfigError
from zsched.core.values.struct import Struct, replace

_STEP: Final = 2
"""Indentation of entries where the file shows none."""
_ADVICE: Final = "change the file by hand: zsched edit"


class _Entry(Struct, frozen=True, kw_only=True):
    """One entry of a section in the text: offsets of its key's first character and behind its value's last one."""

    name: str
    start: int
    end: int
    col: int


class _Section(Struct, frozen=True, kw_only=True):
    """The value of a key at the top of the file, or of a key below."""

    key_end: int
    """Behind the key itself, before its colon."""
    start: int
    end: int
    is_flow: bool
    is_null: bool
    entries: tuple[_Entry, ...]


def names_of(text: str, section: str, file: str) -> tuple[str, ...]:
    """The names of the entries below ``section`` in a text that holds this section and nothing else.

    Raises:
        ConfigError: it is no YAML, or it holds something else.
    """
    root, out = read_yaml(text.encode())
    if root is None:
        fault = out.faults[0]
        raise ConfigError(fault.render(file))
    held = dict(_pairs(root)).get(section)
    if not isinstance(held, Mapping) or not held.pairs or len(_pairs(root)) != 1:
        message = f"{file}: expected the one key {section!r} with entries below, as in a fleet file"
        raise ConfigError(f"{message}; for example {section}: {{NAME: {{...}}}}")
    return tuple(key.text for key, _ in held.pairs)


def add_entries(text: str, section: str, fragment: str, file: str = "the file") -> str:
    """The fleet file ``text`` with the entries of ``fragment`` at the end of ``section``.

    Args:
        text: a fleet file without a fault.
        section: ``tasks`` or ``nodes``.
        fragment: a text with this section and nothing else; its comments come along where both are in block style.
        file: the fragment's name, for errors.

    Raises:
        ConfigError: the fragment holds something else, or an entry is there already.
    """
    names = names_of(fragment, section, file)
    root = _tree(text)
    there = dict(_pairs(dict(_pairs(root)).get(section)))
    double = [name for name in names if name in there]
    if double:
        raise ConfigError(f"{file}: {section} has {', '.join(double)} already; change it with zsched edit")
    added = dict(_pairs(_tree(fragment)))[section]
    wanted = _with(root, section, added)
    return _checked(_added(text, section, fragment, added), wanted, f"{', '.join(names)} cannot be added")


def remove_task(text: str, name: str) -> str:
    """The fleet file ``text`` without the task ``name``.

    Raises:
        ConfigError: there is none, or the text cannot be spliced.
    """
    return _without(text, ("tasks", name))


def remove_node(text: str, name: str) -> str:
    """The fleet file ``text`` without the node ``name``, in its section and in every list of names and links.

    Raises:
        ConfigError: there is none, or the text cannot be spliced.
    """
    text = _without(text, ("nodes", name))
    for path in _links_to(text, name):
        text = _without(text, path)
    while (place := _list_with(text, name)) is not None:
        text = _unlisted(text, place, name)
    return text


def is_list(text: str, path: tuple[str, ...]) -> bool:
    """Whether a list stands at ``path`` in a fleet file's text."""
    return isinstance(_at(_tree(text), path), Listing)


def add_names(text: str, path: tuple[str, ...], names: Sequence[str]) -> str:
    """The fleet file ``text`` with ``names`` at the end of the list at ``path``.

    A list at the top of the file, such as ``("seeds",)``, is begun where there is none.

    Raises:
        ConfigError: there is something else than a list, or the text cannot be spliced.
    """
    root = _tree(text)
    what = f"{', '.join(names)} cannot be added to {'.'.join(path)}"
    held = _at(root, path)
    if held is None and len(path) == 1:
        return _checked(f"{_ended(text)}{path[0]}: [{', '.join(names)}]\n", _listing(root, path, names), what)
    if not isinstance(held, Listing):
        raise ConfigError(f"{what}: it is no list of names; {_ADVICE}")
    found = _find(text, path)
    assert found is not None
    if found.is_flow and found.entries:
        at = found.entries[-1].end
        spliced = f"{text[:at]}, {', '.join(names)}{text[at:]}"
    elif found.is_flow:
        spliced = f"{text[: found.start]}[{', '.join(names)}]{text[found.end :]}"
    else:
        last = found.entries[-1]
        dash, at = text[_line_start(text, last.start) : last.start], _last_line_end(text, last)
        spliced = _ended(text[:at]) + "".join(f"{dash}{name}\n" for name in names) + text[at:]
    return _checked(spliced, _listing(root, path, names), what)


# --- trees -----------------------------------------------------------------------------------------------------------


def _tree(text: str) -> Node:
    root, out = read_yaml(text.encode())
    if root is None:
        raise ConfigError(out.faults[0].render("the fleet's file"))
    return root


def _pairs(node: Node | None) -> tuple[tuple[str, Node], ...]:
    return tuple((key.text, held) for key, held in node.pairs) if isinstance(node, Mapping) else ()


def _with(root: Node, section: str, added: Node) -> str:
    """What the tree says once ``added`` is part of its section."""
    assert isinstance(root, Mapping)
    assert isinstance(added, Mapping)
    pairs = []
    is_there = False
    for key, held in root.pairs:
        is_it = key.text == section
        is_there |= is_it
        before = held.pairs if isinstance(held, Mapping) else ()
        pairs.append((key, replace(added, pairs=(*before, *added.pairs)) if is_it else held))
    if not is_there:
        pairs.append((Scalar(text=section, is_plain=True, place=root.place), added))
    return flow(replace(root, pairs=tuple(pairs)))


def _at(node: Node | None, path: Sequence[str]) -> Node | None:
    for word in path:
        node = dict(_pairs(node)).get(word)
    return node


def _listing(root: Node, path: Sequence[str], names: Sequence[str]) -> str:
    """What the tree says once the names are at the end of the list at ``path``."""

    def more(node: Node | None, left: Sequence[str]) -> Node:
        if not left:
            items = node.items if isinstance(node, Listing) else ()
            added = tuple(Scalar(text=name, is_plain=True, place=root.place) for name in names)
            return Listing(items=(*items, *added), place=root.place)
        assert isinstance(node, Mapping)
        pairs = [(key, more(held, left[1:]) if key.text == left[0] else held) for key, held in node.pairs]
        if all(key.text != left[0] for key, _ in node.pairs):
            pairs.append((Scalar(text=left[0], is_plain=True, place=root.place), more(None, left[1:])))
        return replace(node, pairs=tuple(pairs))

    return flow(more(root, path))


def _pruned(node: Node, path: Sequence[str]) -> Node:
    """The tree without the entry at ``path``."""
    assert isinstance(node, Mapping)
    if len(path) == 1:
        return replace(node, pairs=tuple(pair for pair in node.pairs if pair[0].text != path[0]))
    pairs = tuple((key, _pruned(held, path[1:]) if key.text == path[0] else held) for key, held in node.pairs)
    return replace(node, pairs=pairs)


def _links_to(text: str, name: str) -> list[tuple[str, ...]]:
    nodes = _pairs(dict(_pairs(_tree(text))).get("nodes"))
    linked = [node for node, held in nodes if name in dict(_pairs(dict(_pairs(held)).get("links")))]
    return [("nodes", node, "links", name) for node in linked]


def _lists(root: Node) -> Iterator[tuple[tuple[str, ...], Node]]:
    """Every place that may be a list of nodes."""
    top = dict(_pairs(root))
    yield from (((key,), top[key]) for key in ("seeds", "electorate") if key in top)
    for task, held in _pairs(top.get("tasks")):
        inside = dict(_pairs(held))
        if "candidates" in inside:
            yield ("tasks", task, "candidates"), inside["candidates"]


def _list_with(text: str, name: str) -> tuple[str, ...] | None:
    for path, held in _lists(_tree(text)):
        if isinstance(held, Listing) and any(isinstance(item, Scalar) and item.text == name for item in held.items):
            return path
    return None


def _checked(text: str, wanted: str, what: str) -> str:
    """The text, if it says what is wanted."""
    root, _ = read_yaml(text.encode())
    if root is None or flow(root) != wanted:
        raise ConfigError(f"{what} without writing the file anew (an anchor, or an unusual style); {_ADVICE}")
    return text


# --- splices ---------------------------------------------------------------------------------------------------------


def _compose(text: str) -> Any:
    from ruamel.yaml import YAML  # noqa: PLC0415 - only who edits pays for it

    yaml = YAML(typ="safe", pure=True)
    yaml.composer.warn_double_anchors = False
    return yaml.compose(text)


def _find(text: str, path: Sequence[str]) -> _Section | None:
    """The value at ``path``; ``None``: there is none."""
    held, key_end = _compose(text), 0
    for word in path:
        pair = next((pair for pair in held.value if pair[0].value == word), None) if held.id == "mapping" else None
        if pair is None:
            return None
        key, held = pair
        key_end = key.end_mark.index
    entries: list[_Entry] = []
    for item in held.value if held.id in ("mapping", "sequence") else ():
        key, value = item if held.id == "mapping" else (item, item)
        mark = key.start_mark
        entries.append(
            _Entry(name=str(key.value), start=mark.index, end=max(key.end_mark.index, _end(value)), col=mark.column)
        )
    return _Section(
        key_end=key_end,
        start=held.start_mark.index,
        end=held.end_mark.index,
        is_flow=bool(getattr(held, "flow_style", False)),
        is_null=held.id == "scalar",
        entries=tuple(entries),
    )


def _end(node: Any) -> int:
    """Behind the last character of a value: a block's own mark stands at whatever comes next."""
    if node.id == "scalar" or node.flow_style or not node.value:
        return int(node.end_mark.index)
    last = node.value[-1]
    return max(_end(one) for one in last) if node.id == "mapping" else _end(last)


def _line_start(text: str, at: int) -> int:
    return text.rfind("\n", 0, at) + 1


def _line_end(text: str, at: int) -> int:
    """Behind the line end of the line that holds the character before ``at``."""
    found = text.find("\n", max(at - 1, 0))
    return len(text) if found < 0 else found + 1


def _last_line_end(text: str, entry: _Entry) -> int:
    """Behind the entry's last line, with the comments below it that are further in than its key."""
    end = _line_end(text, entry.end)
    at = end
    while at < len(text):
        line = text[at : _line_end(text, at + 1)]
        bare = line.strip()
        at += len(line)
        if bare.startswith("#") and len(line) - len(line.lstrip(" ")) > entry.col:
            end = at
        elif bare:
            break
    return end


def _added(text: str, section: str, fragment: str, added: Node) -> str:
    found = _find(text, (section,))
    if found is None:
        return f"{_ended(text)}\n{section}:\n{_block(fragment, section, added, _STEP)}"
    if found.is_flow and found.entries:
        at = found.entries[-1].end
        more = ", ".join(f"{name}: {flow(held)}" for name, held in _pairs(added))
        return f"{text[:at]}, {more}{text[at:]}"
    if not found.entries:
        root = _find(text, ())
        if found.is_flow and root is not None and root.is_flow:  # as of JSON: no block may stand in it
            more = ", ".join(f"{name}: {flow(held)}" for name, held in _pairs(added))
            return f"{text[: found.start]}{{{more}}}{text[found.end :]}"
        if found.is_flow:
            text = text[: found.start].rstrip(" ") + text[found.end :]
        at = _line_end(text, found.key_end + 1)
        return _ended(text[:at]) + _block(fragment, section, added, _STEP) + text[at:]
    last = found.entries[-1]
    at = _last_line_end(text, last)
    return _ended(text[:at]) + _block(fragment, section, added, last.col) + text[at:]


def _ended(text: str) -> str:
    return text if not text or text.endswith("\n") else f"{text}\n"


def _block(fragment: str, section: str, added: Node, col: int) -> str:
    """The entries in block style, ``col`` columns in; their lines are the fragment's where it is in block style."""
    found = _find(fragment, (section,))
    assert found is not None
    if found.is_flow:
        return "".join(f"{' ' * col}{name}: {flow(held)}\n" for name, held in _pairs(added))
    first = found.entries[0]
    start = _line_end(fragment, found.key_end + 1)  # comments above the first entry come along
    lines = fragment[start : _last_line_end(fragment, found.entries[-1])].splitlines()
    return "".join(f"{_shifted(line, first.col, col)}\n" for line in lines)


def _shifted(line: str, was: int, col: int) -> str:
    if not line.strip():
        return ""
    inner = line[was:] if line[:was].strip() == "" else line.lstrip()
    return " " * col + inner


def _without(text: str, path: tuple[str, ...]) -> str:
    """The text without the entry at ``path``."""
    *above, name = path
    found = _find(text, above)
    at = next((at for at, one in enumerate(found.entries) if one.name == name), None) if found is not None else None
    what = ".".join(path)
    if found is None or at is None:
        there = ", ".join(one.name for one in found.entries) if found is not None else "none"
        raise ConfigError(f"the fleet's file has no {what}; there are {there}")
    wanted = flow(_pruned(_tree(text), path))
    return _checked(_cut(text, found, at, "{}"), wanted, f"{what} cannot be removed")


def _unlisted(text: str, path: tuple[str, ...], name: str) -> str:
    """The text without ``name`` in the list at ``path``."""
    found = _find(text, path)
    assert found is not None
    at = next(at for at, one in enumerate(found.entries) if one.name == name)
    spliced = _cut(text, found, at, "[]")
    if name in [one.name for one in getattr(_find(spliced, path), "entries", ())]:
        raise ConfigError(f"{name} cannot be taken out of {'.'.join(path)}; {_ADVICE}")
    return spliced


def _cut(text: str, found: _Section, at: int, empty: str) -> str:
    """The text without the entry number ``at``; ``empty`` stands for the section when that was the only one."""
    entry = found.entries[at]
    if found.is_flow:
        if at + 1 < len(found.entries):
            return text[: entry.start] + text[found.entries[at + 1].start :]
        start = found.entries[at - 1].end if at else entry.start
        return text[:start] + text[entry.end :]
    start, end = _line_start(text, entry.start), _last_line_end(text, entry)
    if len(found.entries) > 1:
        return text[:start] + text[end:]
    colon = text.index(":", found.key_end) + 1
    return f"{text[:colon]} {empty}{text[colon:start]}{text[end:]}"
