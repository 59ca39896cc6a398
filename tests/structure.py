"""Figures of the house: `python -m tests.structure [FOLDER] [--json]` prints those of any checkout.

From files tracked by git, without importing them: older checkouts can be measured.
"""

from __future__ import annotations

import argparse
import ast
import json
import re
import statistics
import subprocess
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from tests.import_levels import layering
from tests.paths import ROOT

CONFIGS = ("agent", "server", "sim")
AREAS = PRODUCT, LABORATORY, LABORATORY_TESTS, TESTS = ("product", "laboratory", "laboratory's tests", "tests")
# Present and former folders of the laboratory.
OF_LABORATORY = {"lab", "evaluation", "benchmarks", "benchmark", "results"}
ADDS_FLAG = {"add_argument", "add"}
COMMENT = re.compile(r"^(?: *|.* {2})# (.*)$", re.MULTILINE)  # as left by the formatter


@dataclass(frozen=True)
class Module:
    """A code file: path in the checkout, lines, and lines per function.

    words: in docstrings and comments. constants: numeric module constants and field defaults. flags: declared command
    line options. imports: the checkout's modules, from the top level.
    """

    path: Path
    lines: int
    functions: tuple[int, ...]
    docstring: str
    words: int
    constants: int
    flags: frozenset[str]
    imports: frozenset[str]

    @property
    def name(self) -> str:
        """As in Python."""
        return ".".join(self.path.with_suffix("").parts).removesuffix(".__init__")

    @property
    def area(self) -> str:
        """Part of the house."""
        is_laboratory, is_test = is_of_laboratory(self.path), "tests" in self.path.parts
        return AREAS[2 * is_test + (is_laboratory != is_test)]


def is_of_laboratory(path: Path) -> bool:
    """Whether a module or page is the laboratory's."""
    return bool(OF_LABORATORY & set(path.with_suffix("").parts))


def packages(root: Path) -> tuple[str, ...]:
    """A checkout's packages except `tests`, in layer order if known."""
    there = {path.parts[0] for path in _listed(root, "*/__init__.py") if len(path.parts) == 2} - {"tests"}
    linted = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]
    return tuple(name for name in linted["root_packages"] if name in there)


@cache
def modules(root: Path, *folders: str) -> list[Module]:
    """All modules of folders, with `__init__`."""
    return [_module(root, path) for path in _listed(root, *folders) if path.suffix == ".py"]


def crowds(everything: list[Module]) -> Counter[Path]:
    """Modules per folder, without `__init__`."""
    return Counter(module.path.parent for module in everything if module.path.name != "__init__.py")


def options(root: Path, name: str) -> set[str]:
    """Options in an example configuration file, commented-out ones too."""
    text = (root / "config" / f"{name}.toml").read_text(encoding="utf-8")
    commented = re.findall(r"^# (\w+) = ", text, re.MULTILINE) if name == "sim" else []  # defaults from the scenario
    return {*commented, *_names(tomllib.loads(text), "")}


def is_description(option: str) -> bool:
    """Whether an agent's option describes machine or sensor rather than behaviour."""
    return option.startswith(("machine.", "sensor."))


def figures(root: Path) -> dict[str, Any]:
    """All figures: by area, by package, in total."""
    everything = modules(root, *packages(root), "tests")
    by_area = {area: [module for module in everything if module.area == area] for area in AREAS}
    code = by_area[PRODUCT] + by_area[LABORATORY]
    names = {name: options(root, name) for name in CONFIGS}
    described = {option for option in names["agent"] if is_description(option)}
    contracts = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"]
    folder, crowd = crowds(by_area[PRODUCT]).most_common(1)[0]
    return {
        "areas": {area: _of_area(of_area) for area, of_area in by_area.items() if of_area},
        "packages": {name: _sizes([m for m in code if m.path.parts[0] == name]) for name in packages(root)},
        "document_words": _document_words(root),
        "options": {name: len(options - described) for name, options in names.items()} | {"described": len(described)},
        "import_contracts": len(contracts["contracts"]),
        "fullest_folder": {"folder": str(folder), "modules": crowd},
    }


def table(measured: Mapping[str, Any]) -> str:
    """Figures for people: a column per area, a line per package."""
    areas = measured["areas"]
    shown = {area: {name: _shown(value) for name, value in values.items()} for area, values in areas.items()}
    for area, words in measured["document_words"].items():
        shown[area]["words in documents"] = str(words)
    rows = [["", *shown], *([name, *(column.get(name, "-") for column in shown.values())] for name in shown[PRODUCT])]
    sizes = [[name, *map(_shown, values.values())] for name, values in measured["packages"].items()]
    head = ["package", *next(iter(measured["packages"].values()))]
    counts = dict(measured["options"])
    described = counts.pop("described")
    by_file = ", ".join(f"{name} {n}" for name, n in counts.items())
    full = measured["fullest_folder"]
    return "\n".join(
        [
            *_columns(rows),
            "",
            *_columns([head, *sizes]),
            "",
            f"options: {sum(counts.values())} ({by_file}), and {described} that describe a machine and its sensors",
            f"import contracts: {measured['import_contracts']}",
            f"fullest folder: {full['folder']} with {full['modules']} modules",
        ]
    )


# --- the figures of modules ------------------------------------------------------------------------------------------


def _of_area(of_area: Sequence[Module]) -> dict[str, Any]:
    imports = {module.name: module.imports for module in of_area}
    levels, circles = layering(imports)
    flags = {flag for module in of_area for flag in module.flags}
    return {
        **_sizes(of_area),
        "numeric constants": sum(module.constants for module in of_area),
        "flags": len(flags),
        "words in docstrings and comments": sum(module.words for module in of_area),
        "import levels": levels,
        "import circles": circles,
    }


def _sizes(of_package: Sequence[Module]) -> dict[str, Any]:
    lines = [module.lines for module in of_package]
    functions = [size for module in of_package for size in module.functions]
    return {
        "modules": len(lines),
        "lines": sum(lines),
        "lines of a module": _spread(lines),
        "functions": len(functions),
        "lines of a function": _spread(functions),
    }


def _module(root: Path, path: Path) -> Module:
    text = (root / path).read_text(encoding="utf-8")
    tree = ast.parse(text)
    nodes = list(ast.walk(tree))
    functions = [node for node in nodes if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    sizes = tuple((f.end_lineno or f.lineno) - f.lineno + 1 for f in functions)
    return Module(
        path,
        text.count("\n"),
        sizes,
        ast.get_docstring(tree) or "",
        words=sum(len(prose.split()) for prose in _prose(nodes, text)),
        constants=sum(map(_constants, tree.body))
        + sum(_defaults(node) for node in nodes if isinstance(node, ast.ClassDef)),
        flags=frozenset(_flags(nodes)),
        imports=frozenset(_imports(root, tree)),
    )


def _prose(nodes: Sequence[ast.AST], text: str) -> Iterator[str]:
    """Docstrings and comments."""
    documented = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
    yield from (ast.get_docstring(node, clean=False) or "" for node in nodes if isinstance(node, documented))
    yield from COMMENT.findall(text)


def _constants(statement: ast.stmt) -> int:
    """Number of capitalised names that it binds to numbers or sums of numbers."""
    if isinstance(statement, ast.AnnAssign):
        targets: list[ast.expr] = [statement.target]
    elif isinstance(statement, ast.Assign):
        targets = statement.targets
    else:
        return 0
    named = [node.id for target in targets for node in ast.walk(target) if isinstance(node, ast.Name)]
    return sum(name.upper() == name for name in named) if _is_numeric(statement.value) else 0


def _defaults(kind: ast.ClassDef) -> int:
    """Numeric field defaults except 0 and 1, neutral elements."""
    values = [each.value for each in kind.body if isinstance(each, ast.AnnAssign) and _is_numeric(each.value)]
    return sum(not (isinstance(value, ast.Constant) and value.value in (0, 1)) for value in values)


def _is_numeric(value: ast.expr | None) -> bool:
    """Whether it contains a number, and neither text nor call."""
    nodes = list(ast.walk(value)) if value else []
    constants = [node.value for node in nodes if isinstance(node, ast.Constant)]
    numbers = [constant for constant in constants if type(constant) in (int, float, complex)]
    return bool(numbers) and len(numbers) == len(constants) and not any(isinstance(n, ast.Call) for n in nodes)


def _flags(nodes: Sequence[ast.AST]) -> Iterator[str]:
    """Declared command line options."""
    for call in (node for node in nodes if isinstance(node, ast.Call)):
        function = call.func
        name = function.attr if isinstance(function, ast.Attribute) else getattr(function, "id", "")
        texts = [arg.value for arg in call.args if isinstance(arg, ast.Constant)] if name in ADDS_FLAG else []
        yield from (text for text in texts if isinstance(text, str) and text.startswith("--"))


def _imports(root: Path, tree: ast.Module) -> Iterator[str]:
    """Modules of the checkout imported outside functions, for types too."""
    blocks = [tree.body, *(node.body for node in tree.body if isinstance(node, ast.If))]
    for node in (statement for block in blocks for statement in block):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                inner = root / node.module.replace(".", "/") / alias.name
                is_module = inner.is_dir() or inner.with_suffix(".py").is_file()
                yield f"{node.module}.{alias.name}" if is_module else node.module


# --- documents, files, layout ----------------------------------------------------------------------------------------


def _document_words(root: Path) -> dict[str, int]:
    words = {PRODUCT: 0, LABORATORY: 0}
    for path in _listed(root, "*.md"):
        words[LABORATORY if is_of_laboratory(path) else PRODUCT] += len((root / path).read_text().split())
    return words


def _listed(root: Path, *patterns: str) -> list[Path]:
    """Existing files tracked by git."""
    listed = subprocess.run(["git", "ls-files", *patterns], cwd=root, capture_output=True, check=True, text=True)
    return [Path(name) for name in listed.stdout.splitlines() if (root / name).exists()]


def _spread(values: Sequence[int]) -> dict[str, int]:
    p90 = statistics.quantiles(values, n=10, method="inclusive")[-1] if len(values) > 1 else sum(values)
    return {"median": round(statistics.median(values or [0])), "p90": round(p90), "max": max(values, default=0)}


def _shown(value: Any) -> str:
    return " / ".join(map(str, value.values())) if isinstance(value, dict) else str(value)


def _columns(rows: Sequence[Sequence[str]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join([row[0].ljust(widths[0]), *map(str.rjust, row[1:], widths[1:])]) for row in rows]


def _names(values: object, prefix: str) -> Iterator[str]:
    if isinstance(values, list) and any(isinstance(value, dict) for value in values):
        for value in values:
            yield from _names(value, prefix)
    elif isinstance(values, dict):
        for name, value in values.items():
            yield from _names(value, f"{prefix}.{name}")
    else:
        yield prefix.removeprefix(".")


PACKAGES = packages(ROOT)

if __name__ == "__main__":
    parser = argparse.ArgumentParser(prog="python -m tests.structure", description="The house in figures.")
    parser.add_argument("folder", nargs="?", type=Path, default=ROOT, help="a checkout (default: this one)")
    parser.add_argument("--json", action="store_true", help="print JSON for machines")
    arguments = parser.parse_args()
    measured = figures(arguments.folder)
    print(json.dumps(measured) if arguments.json else table(measured))
