"""Small changes of a module's code, one at a time, that its unit tests should notice."""

import ast
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import CodeType
from typing import Any

COMPARISONS = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
OPERATORS = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.LShift: ast.RShift,
    ast.RShift: ast.LShift,
    ast.BitAnd: ast.BitOr,
    ast.Pow: ast.Mult,
    ast.BitOr: ast.BitAnd,
    ast.BitXor: ast.BitAnd,
}
TWINS = {"min": "max", "max": "min", "any": "all", "all": "any"}
"""Functions and methods that are taken for each other."""


@dataclass(frozen=True, slots=True)
class Mutant:
    """One change of a syntax tree."""

    name: str  # "function or constant: code before -> code after", the same wherever that stands in its file
    line: int
    holder: Any  # node or list that is changed
    place: str | int  # attribute or index in it
    changed: Any  # what comes there

    @contextmanager
    def applied(self) -> Iterator[None]:
        """Change the tree for as long as the context lasts."""
        before = _get(self.holder, self.place)
        _set(self.holder, self.place, self.changed)
        yield
        _set(self.holder, self.place, before)


def compiled(tree: ast.Module, mutant: Mutant, path: str) -> CodeType:
    """Return the code of the tree with one change."""
    with mutant.applied():
        return compile(ast.fix_missing_locations(tree), path, "exec")


def mutants(tree: ast.Module) -> list[Mutant]:
    """Return all changes of a module, in the order of its lines.

    Texts are left as they are, and so are annotations, decorators and what an error is raised with: unit tests rightly
    do not hold every word.
    """
    return sorted(_below(tree, "module"), key=lambda mutant: mutant.line)


def _below(node: ast.AST, function: str) -> Iterator[Mutant]:
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        function = node.name
    elif function == "module" and isinstance(node, ast.Assign | ast.AnnAssign):
        function = ast.unparse(node.target if isinstance(node, ast.AnnAssign) else node.targets[0])
    for field, value in ast.iter_fields(node):
        if field in {"annotation", "returns", "decorator_list"} or isinstance(node, ast.Raise | ast.JoinedStr):
            continue
        for holder, place, child in _children(node, field, value):
            if isinstance(child, ast.expr | ast.stmt):
                for before, changed in _changes(child):
                    yield Mutant(_named(function, before, changed), child.lineno, holder, place, changed)
                yield from _inside(child, function)
            yield from _below(child, function)


def _children(node: ast.AST, field: str, value: Any) -> list[tuple[Any, str | int, ast.AST]]:
    """Each node directly below another, with its place."""
    if isinstance(value, list):
        return [(value, index, child) for index, child in enumerate(value) if isinstance(child, ast.AST)]
    return [(node, field, value)] if isinstance(value, ast.AST) else []


def _changes(node: ast.expr | ast.stmt) -> Iterator[tuple[ast.AST, ast.AST]]:
    """Replacements of a node as a whole."""
    match node:
        case ast.Constant(value=bool(value)):
            yield node, ast.Constant(not value)
        case ast.Constant(value=int(value)) | ast.Constant(value=float(value)):
            yield node, ast.Constant(value + 1)
        case ast.Constant(value=bytes(value)) if value:
            yield node, ast.Constant(b"?" + value[1:])
        case ast.UnaryOp(op=ast.Not() | ast.USub() | ast.Invert(), operand=operand):
            yield node, operand
        case ast.Return(value=ast.expr() as value) if not (isinstance(value, ast.Constant) and value.value is None):
            yield node, ast.Return(ast.Constant(None))
        case ast.Expr(value=ast.Call()):
            yield node, ast.Pass()
        case ast.Assign(targets=[ast.Attribute() | ast.Subscript()]):
            yield node, ast.Pass()
        case ast.AugAssign() | ast.Raise() | ast.Continue() | ast.Break():
            yield node, ast.Pass()


def _inside(node: ast.expr | ast.stmt, function: str) -> Iterator[Mutant]:
    """Changes of a node's operator, condition or function."""

    def change(holder: Any, place: str | int, changed: Any) -> Mutant:
        before = ast.unparse(node).splitlines()[0]
        mutant = Mutant("", node.lineno, holder, place, changed)
        with mutant.applied():
            after = ast.unparse(node).splitlines()[0]
        return Mutant(f"{function}: {before} -> {after}", node.lineno, holder, place, changed)

    match node:
        case ast.Compare(ops=ops):
            for index, operator in enumerate(ops):
                yield change(ops, index, COMPARISONS[type(operator)]())
        case ast.BinOp(op=operator) | ast.AugAssign(op=operator) if type(operator) in OPERATORS:
            yield change(node, "op", OPERATORS[type(operator)]())
        case ast.BoolOp(op=operator):
            yield change(node, "op", ast.Or() if isinstance(operator, ast.And) else ast.And())
        case ast.If(test=test) | ast.While(test=test) | ast.IfExp(test=test):
            yield change(node, "test", ast.UnaryOp(ast.Not(), test))
        case ast.Call(func=ast.Name(id=name) as called) if name in TWINS:
            yield change(called, "id", TWINS[name])
        case ast.Call(func=ast.Attribute(attr=name) as called) if name in TWINS:
            yield change(called, "attr", TWINS[name])


def _named(function: str, before: ast.AST, changed: ast.AST) -> str:
    first, then = (ast.unparse(ast.fix_missing_locations(node)).splitlines()[0] for node in (before, changed))
    return f"{function}: {first} -> {then}"


def _get(holder: Any, place: str | int) -> Any:
    return getattr(holder, place) if isinstance(place, str) else holder[place]


def _set(holder: Any, place: str | int, value: Any) -> None:
    if isinstance(place, str):
        setattr(holder, place, value)
    else:
        holder[place] = value
