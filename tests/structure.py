"""The house in figures: `python -m tests.structure [FOLDER]` prints a table of any checkout (lab/results/house.md)."""

from __future__ import annotations

import ast
import re
import statistics
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.paths import ROOT

PACKAGES = ("protocol", "agents", "mapserver", "sim", "sitegrid", "lab")
CONFIGS = ("agent", "server", "sim")


@dataclass(frozen=True)
class Module:
    """A file of code: its path in the checkout, its lines, and the lines of each of its functions."""

    path: Path
    lines: int
    functions: tuple[int, ...]
    docstring: str


def modules(root: Path, *packages: str) -> list[Module]:
    """All modules of packages, `__init__` too."""
    listed = subprocess.run(["git", "ls-files", *packages], cwd=root, capture_output=True, check=True, text=True)
    paths = [Path(name) for name in listed.stdout.split() if name.endswith(".py") and (root / name).exists()]
    return [_module(root, path) for path in paths]


def crowds(everything: list[Module]) -> Counter[Path]:
    """How many modules beside `__init__` each folder has."""
    return Counter(module.path.parent for module in everything if module.path.name != "__init__.py")


def options(root: Path, name: str) -> set[str]:
    """Names of the options in an example of a configuration file, also of those that are commented out."""
    text = (root / "config" / f"{name}.toml").read_text(encoding="utf-8")
    commented = re.findall(r"^# (\w+) = ", text, re.MULTILINE) if name == "sim" else []  # as the scenario says
    return {*commented, *_names(tomllib.loads(text), "")}


def is_description(option: str) -> bool:
    """Whether an option of the agent describes its machine or a sensor, rather than what the agent does."""
    return option.startswith(("machine.", "sensor."))


def table(root: Path) -> str:
    """What stands in lab/results/house.md."""
    rows = ["package     modules  lines  module: median / p90 / max  functions  function: median / p90 / max"]
    every = []
    for package in (*PACKAGES, "tests"):
        of_package = modules(root, package)
        every += of_package if package != "tests" else []
        rows.append(_row(package, of_package))
    rows.insert(-1, _row("product", every))
    counts = {name: len(options(root, name)) for name in CONFIGS}
    described = len([option for option in options(root, "agent") if is_description(option)])
    counts["agent"] -= described
    shown = ", ".join(f"{name} {n}" for name, n in counts.items())
    rows.append(f"options: {sum(counts.values())} ({shown}), and {described} that describe a machine and its sensors")
    contracts = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["importlinter"][
        "contracts"
    ]
    rows.append(f"import contracts: {len(contracts)}")
    folder, crowd = crowds(every).most_common(1)[0]
    rows.append(f"fullest folder: {folder} with {crowd} modules")
    return "\n".join(rows)


def _module(root: Path, path: Path) -> Module:
    text = (root / path).read_text(encoding="utf-8")
    tree = ast.parse(text)
    functions = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)]
    sizes = tuple((f.end_lineno or f.lineno) - f.lineno + 1 for f in functions)
    return Module(path, text.count("\n"), sizes, ast.get_docstring(tree) or "")


def _row(name: str, of_package: list[Module]) -> str:
    lines = [module.lines for module in of_package]
    functions = [size for module in of_package for size in module.functions]
    return f"{name:<11} {len(lines):>7} {sum(lines):>6}  {_spread(lines):<26} {len(functions):>9}  {_spread(functions)}"


def _spread(values: list[int]) -> str:
    p90 = statistics.quantiles(values, n=10, method="inclusive")[-1]
    return f"{statistics.median(values):.0f} / {p90:.0f} / {max(values)}"


def _names(values: object, prefix: str) -> Iterator[str]:
    if isinstance(values, list) and any(isinstance(value, dict) for value in values):
        for value in values:
            yield from _names(value, prefix)
    elif isinstance(values, dict):
        for name, value in values.items():
            yield from _names(value, f"{prefix}.{name}")
    else:
        yield prefix.removeprefix(".")


if __name__ == "__main__":
    print(table(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT))
