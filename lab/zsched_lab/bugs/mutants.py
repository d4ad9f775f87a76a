"""Small faults that can be made in a module's source, one at a time (mutation testing, DeMillo et al., 1978).

Knows: the operators, and which places cannot matter (words, types, asserts). Does not know: what is tested, or how a
mutant is planted (`zsched_lab.bugs.mutant_tests`).

An operator changes one node of the syntax tree; the mutated module is compiled from that tree, so lines stay where they
are. A mutant that compiles to the same code as the original is none. What only people read is left alone: docstrings,
f-strings, the arguments of stories, errors and asserts; so are annotations, imports and the decorators' arguments.
"""

from __future__ import annotations

import ast
import copy
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import CodeType

WORDS_FOR_PEOPLE = frozenset({"RecordStory", "TypeVar", "NewType", "cast"})
"""Calls whose arguments decide nothing."""

_COMPARED: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
_COMPUTED: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.Pow: ast.Mult,
    ast.BitOr: ast.BitAnd,
    ast.BitAnd: ast.BitOr,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
}
_SWAPPED = {"min": "max", "max": "min", "any": "all", "all": "any"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Mutant:
    """One small fault: the ``index``-th change that can be made in ``module``."""

    module: str
    index: int
    number: int
    """Which one of the same changes in the same function."""
    operator: str
    line: int
    function: str
    """Where it runs: ``=`` and the qualified name of the outermost function, or else when the module is imported."""
    before: str
    after: str

    @property
    def key(self) -> str:
        """What tells it apart from all others, also after lines have moved or another function has changed."""
        return f"{self.module}:{self.function}:{self.operator}:{self.number}:{self.before} -> {self.after}"

    @property
    def path(self) -> str:
        """Its file, without the package: core/vote/voting.py."""
        return self.module.removeprefix("zsched.").replace(".", "/") + ".py"

    def file(self, package: Path) -> Path:
        """Its file below the package's folder."""
        return package / self.path

    def __str__(self) -> str:
        return f"{self.path}:{self.line}: {self.before} -> {self.after}"


def files_of(core: Path) -> list[Path]:
    """The core's files that hold code."""
    return sorted(path for path in core.rglob("*.py") if path.name != "__init__.py")


def module_of(path: Path, core: Path) -> str:
    """The full name of one of the core's modules: ``zsched.core.vote.voting``."""
    return ".".join(("zsched", *path.relative_to(core.parent).with_suffix("").parts))


@dataclass(slots=True)
class _Place:
    """One change that can be made: ``make`` returns what takes the node's place."""

    path: tuple[tuple[str, int | None], ...]
    node: ast.AST
    operator: str
    make: Callable[[ast.AST], ast.AST]
    function: str


def mutants_of(module: str, source: str) -> list[Mutant]:
    """All mutants of a module's source, in its order."""
    found: list[Mutant] = []
    same: Counter[tuple[str, ...]] = Counter()
    for index, place in enumerate(_places(ast.parse(source))):
        before, after = _told(place.node), _told(place.make(copy.deepcopy(place.node)))
        line = getattr(place.node, "lineno", 0) or min(
            (one.lineno for one in ast.walk(place.node) if isinstance(one, ast.expr)), default=1
        )
        if before != after:
            what = (place.function, place.operator, before, after)
            same[what] += 1
            found.append(
                Mutant(
                    module=module,
                    index=index,
                    number=same[what],
                    operator=place.operator,
                    line=line,
                    function=place.function,
                    before=before,
                    after=after,
                )
            )
    return found


def mutated(mutant: Mutant, source: str, path: str) -> CodeType | None:
    """The module's code with the fault in it; ``None`` when that is the same code.

    Raises:
        ValueError: the source is another one than the mutant was made of.
    """
    tree = ast.parse(source)
    place = next((place for index, place in enumerate(_places(tree)) if index == mutant.index), None)
    if place is None or _told(place.node) != mutant.before:
        raise ValueError(f"{mutant} is not in the source any more")
    code = compile(_with(tree, place), path, "exec")
    return None if _shape(code) == _shape(compile(source, path, "exec")) else code


# --- places ----------------------------------------------------------------------------------------------------------


def _places(tree: ast.Module) -> Iterator[_Place]:
    yield from _under(tree, (), "")


def _under(node: ast.AST, path: tuple[tuple[str, int | None], ...], function: str) -> Iterator[_Place]:
    for operator, make in _changes(node):
        yield _Place(path, node, operator, make, function)
    for name, value in ast.iter_fields(node):
        if _is_silent(node, name):
            continue
        inner = function
        if isinstance(node, ast.ClassDef | ast.FunctionDef) and not function.startswith("="):
            inner = _named(function, node, name)
        for at, child in enumerate(value) if isinstance(value, list) else ((None, value),):
            if isinstance(child, ast.AST):
                yield from _under(child, (*path, (name, at)), inner)


def _named(function: str, node: ast.ClassDef | ast.FunctionDef, name: str) -> str:
    """Where a child of a definition runs: a function's body when it is called, all else at the import.

    Names of functions begin with ``=``: what is in an inner one belongs to the outermost.
    """
    if isinstance(node, ast.ClassDef):
        return f"{function}{node.name}."
    return f"={function}{node.name}" if name == "body" else function


def _is_silent(node: ast.AST, name: str) -> bool:
    """Whether nothing of a field decides anything."""
    match node:
        case ast.JoinedStr() | ast.Raise() | ast.Assert() | ast.Import() | ast.ImportFrom():
            return True
        case ast.Call(func=ast.Name(id=called)):
            return called in WORDS_FOR_PEOPLE
        case ast.AnnAssign():
            return name in {"annotation", "target"}
        case ast.FunctionDef():
            return name in {"decorator_list", "returns"}
        case ast.ClassDef():
            return name in {"decorator_list", "bases", "keywords"}
        case ast.arg():
            return name == "annotation"
        case ast.If(test=ast.Name(id="TYPE_CHECKING")):
            return True
        case ast.Subscript(slice=ast.Name() | ast.Tuple(), value=ast.Name(id=called)):
            return called[:1].isupper() or called in {"tuple", "list", "dict", "frozenset", "set", "type"}
        case _:
            return False


def _changes(node: ast.AST) -> Iterator[tuple[str, Callable[[ast.AST], ast.AST]]]:
    match node:
        case ast.Compare(ops=[op]):
            yield from (("comparison", _compare(kind)) for kind in _COMPARED.get(type(op), ()))
        case ast.BoolOp(op=op, values=values):
            yield "and/or", _boolean(ast.Or() if isinstance(op, ast.And) else ast.And())
            yield from (("left out", _without(at)) for at in range(len(values)))
        case ast.UnaryOp(op=ast.Not()):
            yield "negation", lambda one: one.operand  # type: ignore[attr-defined]
        case ast.UnaryOp(op=ast.USub()):
            yield "sign", lambda one: one.operand  # type: ignore[attr-defined]
        case ast.BinOp(op=op) | ast.AugAssign(op=op) if type(op) in _COMPUTED and not _is_type(node):
            yield "arithmetic", _operate(_COMPUTED[type(op)])
        case ast.Constant(value=value) if isinstance(value, bool | int | float):
            yield from (("constant", _constant(other)) for other in _others(value))
        case ast.Call(func=ast.Name(id=called)) if called in _SWAPPED:
            yield "function", _call(_SWAPPED[called])
        case _:
            pass
    yield from _changes_of_statements(node)


def _changes_of_statements(node: ast.AST) -> Iterator[tuple[str, Callable[[ast.AST], ast.AST]]]:
    match node:
        case ast.If() | ast.While() | ast.IfExp():
            yield "condition", _negated
        case ast.comprehension(ifs=[_, *_]):
            yield "filter", _unfiltered
        case ast.Return(value=ast.expr() as value) if not isinstance(value, ast.Constant):
            yield "returned", lambda _one: ast.Return(value=ast.Constant(value=None))
        case ast.Expr(value=ast.Call(func=called)) if getattr(called, "id", "") not in WORDS_FOR_PEOPLE:
            yield "deleted", lambda _one: ast.Pass()
        case ast.AugAssign() | ast.Assign(targets=[ast.Attribute() | ast.Subscript() | ast.Tuple()]):
            if not _is_local_tuple(node):
                yield "deleted", lambda _one: ast.Pass()
        case ast.Delete() | ast.Return(value=None):
            yield "deleted", lambda _one: ast.Pass()
        case ast.Continue():
            yield "loop", lambda _one: ast.Break()
        case ast.Break():
            yield "loop", lambda _one: ast.Continue()
        case _:
            pass


def _is_local_tuple(node: ast.AST) -> bool:
    """Whether an assignment makes plain names: without it nothing would run at all."""
    if not isinstance(node, ast.Assign) or not isinstance(node.targets[0], ast.Tuple):
        return False
    return any(isinstance(part, ast.Name) for part in node.targets[0].elts)


def _is_type(node: ast.AST) -> bool:
    """Whether ``|`` joins types: all that it joins are names in capitals or None."""
    if not isinstance(node, ast.BinOp) or not isinstance(node.op, ast.BitOr):
        return False
    sides = (node.left, node.right)
    return any(
        (isinstance(side, ast.Name) and side.id[:1].isupper())
        or (isinstance(side, ast.Constant) and side.value is None)
        or (isinstance(side, ast.Subscript) and isinstance(side.value, ast.Name))
        for side in sides
    )


# --- changes ---------------------------------------------------------------------------------------------------------


def _compare(kind: type[ast.cmpop]) -> Callable[[ast.AST], ast.AST]:
    def make(node: ast.AST) -> ast.AST:
        assert isinstance(node, ast.Compare)
        return ast.Compare(left=node.left, ops=[kind()], comparators=node.comparators)

    return make


def _boolean(op: ast.boolop) -> Callable[[ast.AST], ast.AST]:
    def make(node: ast.AST) -> ast.AST:
        assert isinstance(node, ast.BoolOp)
        return ast.BoolOp(op=op, values=node.values)

    return make


def _without(at: int) -> Callable[[ast.AST], ast.AST]:
    def make(node: ast.AST) -> ast.AST:
        assert isinstance(node, ast.BoolOp)
        left = [value for index, value in enumerate(node.values) if index != at]
        return left[0] if len(left) == 1 else ast.BoolOp(op=node.op, values=left)

    return make


def _operate(kind: type[ast.operator]) -> Callable[[ast.AST], ast.AST]:
    def make(node: ast.AST) -> ast.AST:
        assert isinstance(node, ast.BinOp | ast.AugAssign)
        node.op = kind()
        return node

    return make


def _others(value: float) -> tuple[float | bool, ...]:
    if isinstance(value, bool):
        return (not value,)
    if isinstance(value, int):
        return (value + 1, value - 1) if value > 1 else (value + 1,)
    return (value * 2 if value else 1.0, value / 2) if value else (1.0,)


def _constant(value: float) -> Callable[[ast.AST], ast.AST]:
    return lambda _node: ast.Constant(value=value)


def _call(name: str) -> Callable[[ast.AST], ast.AST]:
    def make(node: ast.AST) -> ast.AST:
        assert isinstance(node, ast.Call)
        node.func = ast.copy_location(ast.Name(id=name, ctx=ast.Load()), node.func)
        return node

    return make


def _negated(node: ast.AST) -> ast.AST:
    assert isinstance(node, ast.If | ast.While | ast.IfExp)
    node.test = ast.copy_location(ast.UnaryOp(op=ast.Not(), operand=node.test), node.test)
    return node


def _unfiltered(node: ast.AST) -> ast.AST:
    assert isinstance(node, ast.comprehension)
    node.ifs = []
    return node


# --- trees -----------------------------------------------------------------------------------------------------------


def _with(tree: ast.Module, place: _Place) -> ast.Module:
    """The tree with one node changed."""
    changed = copy.deepcopy(tree)
    old = _at(changed, place.path)
    new = place.make(old)
    if new is not old:
        if hasattr(old, "lineno"):
            new = ast.copy_location(new, old)
        *above, (name, at) = place.path
        parent = _at(changed, tuple(above))
        if at is None:
            setattr(parent, name, new)
        else:
            getattr(parent, name)[at] = new
    return ast.fix_missing_locations(changed)


def _at(tree: ast.AST, path: tuple[tuple[str, int | None], ...]) -> ast.AST:
    for name, at in path:
        value = getattr(tree, name)
        tree = value if at is None else value[at]
    return tree


def _told(node: ast.AST) -> str:
    """A node's source in one short line: of a statement with a body only its head."""
    head = node
    if isinstance(node, ast.If | ast.While):
        head = node.test
    text = " ".join(ast.unparse(head).split()) if not isinstance(head, ast.comprehension) else _filter(head)
    return text if len(text) <= 100 else f"{text[:97]}..."


def _filter(node: ast.comprehension) -> str:
    """A comprehension's part."""
    return " ".join([f"for {ast.unparse(node.target)}", *(f"if {ast.unparse(test)}" for test in node.ifs)])


def _shape(code: CodeType) -> tuple[object, ...]:
    """What a code does, without where it stands."""
    constants = tuple(_shape(one) if isinstance(one, CodeType) else (type(one), repr(one)) for one in code.co_consts)
    return code.co_name, code.co_code, constants, code.co_names, code.co_varnames, code.co_exceptiontable
