"""Planted faults: written in `faults.toml`, and drawn from functions' syntax trees.

A fault is located in any checkout by content, a text snippet or a function's syntax without docstring, never by file.
So the suites of two checkouts get the same faults.
"""

from __future__ import annotations

import ast
import hashlib
import random
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

PACKAGES = ("protocol", "agents", "mapserver", "sim", "sitegrid")
FILE = Path(__file__).parent / "faults.toml"
Function = ast.FunctionDef | ast.AsyncFunctionDef
OTHER = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.And: ast.Or,
    ast.Or: ast.And,
}


@dataclass(frozen=True)
class Place:
    """Place of a fault in a checkout: file, bytes to replace, lines."""

    path: Path
    start: int
    end: int
    lines: tuple[int, int]
    text: bytes


@dataclass(frozen=True)
class WrittenFault:
    """A written fault: the unique `old` becomes `new`. what: its kind."""

    name: str
    what: str
    old: str
    new: str

    def place(self, root: Path) -> Place | None:
        """Its place; None unless `old` is unique."""
        places = [
            Place(path, at, at + len(old), (_line(text, at), _line(text, at + len(old))), self.new.encode())
            for path in sources(root)
            for text, old in [(path.read_bytes(), self.old.encode())]
            for at in [text.find(old)]
            if at >= 0
        ]
        return places[0] if len(places) == 1 and places[0].path.read_bytes().count(self.old.encode()) == 1 else None


@dataclass(frozen=True)
class DrawnFault:
    """A drawn fault. function: name and digest of its syntax; node: index of the change."""

    name: str
    what: str
    function: str
    node: int

    def place(self, root: Path) -> Place | None:
        """Its place; None unless the function is unchanged and unique."""
        if len(those := _functions(root).get(self.function, [])) != 1:
            return None
        path, function = those[0]
        text = path.read_bytes()
        node, changed = list(changes(function))[self.node]
        starts = [0, *(i + 1 for i, byte in enumerate(text) if byte == ord("\n"))]
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        start, end = starts[node.lineno - 1] + node.col_offset, starts[node.end_lineno - 1] + node.end_col_offset
        return Place(path, start, end, (node.lineno, node.end_lineno), f"({changed})".encode())


Fault = WrittenFault | DrawnFault


def written() -> list[Fault]:
    """Faults from the file."""
    table = tomllib.loads(FILE.read_text(encoding="utf-8"))
    return [WrittenFault(name, **entry) for name, entry in table.items()]


def drawn(root: Path, other: Path, count: int, seed: int) -> list[Fault]:
    """Faults of functions unique in both checkouts, equally many per package."""
    draw, faults = random.Random(seed), list[Fault]()
    ours = {name: those[0] for name, those in _functions(root).items() if len(those) == 1}
    theirs = _functions(other)
    for number, package in enumerate(PACKAGES):
        both = {
            name: function
            for name, (path, function) in ours.items()
            if path.relative_to(root).parts[0] == package and len(theirs.get(name, [])) == 1
        }
        places = [(name, i) for name, function in sorted(both.items()) for i, _ in enumerate(changes(function))]
        share = count // len(PACKAGES) + (number < count % len(PACKAGES))
        for name, i in draw.sample(places, min(share, len(places))):
            node, changed = list(changes(both[name]))[i]
            what = f"{package}: {name.partition(' ')[0]}: {ast.unparse(node)[:60]} -> {changed[:60]}"
            faults.append(
                DrawnFault(
                    f"{name.partition(' ')[0]}-{hashlib.sha256(f'{name} {i}'.encode()).hexdigest()[:6]}", what, name, i
                )
            )
    return faults


def sources(root: Path) -> Iterator[Path]:
    """The product's modules."""
    for package in PACKAGES:
        yield from sorted((root / package).rglob("*.py"))


def functions(path: Path) -> Iterator[Function]:
    """All functions and methods of a module, without nested ones."""
    for node in ast.parse(path.read_bytes()).body:
        inner = node.body if isinstance(node, ast.ClassDef) else [node]
        yield from (each for each in inner if isinstance(each, ast.FunctionDef | ast.AsyncFunctionDef))


def key(function: Function) -> str:
    """Name and digest of a function's syntax, without docstring."""
    body = function.body[1:] if ast.get_docstring(function, clean=False) is not None else function.body
    syntax = ast.dump(function.args) + "".join(map(ast.dump, body))
    return f"{function.name} {hashlib.sha256(syntax.encode()).hexdigest()[:16]}"


def changes(function: Function) -> Iterator[tuple[ast.expr, str]]:
    """Expressions of a function and their replacements: operator, number, check, swap."""
    for statement in function.body:
        for node in _walk(statement):
            if isinstance(node, ast.If | ast.While) and not _is_changed(node.test):
                yield node.test, f"not ({ast.unparse(node.test)})"
            elif isinstance(node, ast.Call) and len(node.args) == 2 and not node.keywords:
                first, second = map(ast.unparse, node.args)
                if first != second:
                    yield node, f"{ast.unparse(node.func)}({second}, {first})"
            elif isinstance(node, ast.expr) and (changed := _changed(node)):
                yield node, changed


def _changed(node: ast.expr) -> str:
    """Replacement of an expression, or empty."""
    if isinstance(node, ast.Compare) and len(node.ops) == 1:
        operator = OTHER[type(node.ops[0])]()
        return ast.unparse(ast.Compare(node.left, [operator], node.comparators))
    if isinstance(node, ast.BinOp) and type(node.op) in OTHER:
        return ast.unparse(ast.BinOp(node.left, OTHER[type(node.op)](), node.right))
    if isinstance(node, ast.BoolOp):
        return ast.unparse(ast.BoolOp(OTHER[type(node.op)](), node.values))
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not | ast.USub):
        return ast.unparse(node.operand)
    if isinstance(node, ast.Constant) and type(node.value) in (int, float, bool):
        return repr(not node.value if isinstance(node.value, bool) else 2 * node.value or 1)
    return ""


def _walk(node: ast.AST) -> Iterator[ast.AST]:
    """Nodes below, except formatted text, which has no positions in Python 3.11."""
    yield node
    for child in ast.iter_child_nodes(node):
        if not isinstance(child, ast.JoinedStr):
            yield from _walk(child)


def _is_changed(test: ast.expr) -> bool:
    """Whether an `if` test is already changed as an expression."""
    return bool(_changed(test))


@cache
def _functions(root: Path) -> dict[str, list[tuple[Path, Function]]]:
    """Functions with their places, by key."""
    named: dict[str, list[tuple[Path, Function]]] = {}
    for path in sources(root):
        for function in functions(path):
            named.setdefault(key(function), []).append((path, function))
    return named


def _line(text: bytes, at: int) -> int:
    return text.count(b"\n", 0, at) + 1
