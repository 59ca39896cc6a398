"""One word per thing: replaced private words do not return (docs/glossary.md).

Single words are looked for in identifiers, options, keys of configuration files and headings; phrases in all sentences.
"""

from __future__ import annotations

import ast
import re
import subprocess
import tomllib
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from tests.paths import ROOT

# Word, and replacement.
REPLACED = {
    "ladder": "timeline",
    "rung": "tier",
    "hot": "open",
    "keeper": "upkeep",
    "sheet": "frame",
    "bank": "sensor group",
    "told": "stated, stamped",
    "felt": "mean of an IMU",
    "push": "balance step",
    "hire": "crew",
    "board": "at_start",
    "aside": "quarantine, lateral",
    "renewed": "reset",
    "referred": "anchored",
    "dead": "dead_reckoning",
}
WHOLE = dict.fromkeys(("found", "of"), "a noun that says what it is") | dict.fromkeys(("gives", "says"), "measures")
PAIRS = {("left", "out"): "excluded", ("put", "aside"): "quarantine", ("way", "m"): "distance_m"}
# Phrases, and what says it: for documents, docstrings, comments and messages.
PHRASES = {
    "zero error": "bias",
    "closed tour": "closed loop",
    "another course": "diverged",
    "nobody else's business": "private",
    "too unsure": "too uncertain",
    "good as silent": "counts as silent",
    "as dear as": "costs as much as",
    "dearer ": "more expensive",
    "work pays": "worth grading",
    "is let in": "may join",
    "let it in": "trust it",
    "fade what": "fade uncertain, fade old",
    "good ground rolls": "target rolling resistance",
    "risen by nothing": "climbed nothing",
}
# Of the field or the language.
COMPOUNDS = {
    tuple(compound.split()) for compound in (*("dead reckoning", "dead reckoned", "data sheet", "data sheets"),)
}


def tracked(*patterns: str) -> list[Path]:
    listed = subprocess.run(["git", "ls-files", *patterns], cwd=ROOT, capture_output=True, check=True, text=True)
    return [path for name in listed.stdout.split() if (path := ROOT / name).exists() and path != Path(__file__)]


def replaced(name: str) -> str:
    """The better word for a name, or empty."""
    if name in WHOLE:
        return WHOLE[name]
    words = [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)]
    pairs = list(pairwise([*words, ""]))
    for pair in pairs:
        if pair in PAIRS:
            return PAIRS[pair]
    in_compounds = {word for pair in pairs if pair in COMPOUNDS for word in pair}
    for word in words:
        singular = word.removesuffix("s") if word.removesuffix("s") in REPLACED else word
        if singular in REPLACED and word not in in_compounds:
            return REPLACED[singular]
    return ""


def identifiers(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Names defined by a module, with lines; not those of libraries."""
    for node in ast.walk(tree):
        match node:
            case ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()):
                yield node.lineno, name
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                yield node.lineno, "" if name.startswith("test_") else name  # a sentence
            case ast.arg(arg=name):
                yield node.lineno, name
            case ast.alias(asname=str(name)):
                yield node.lineno, name
            case ast.Call(func=ast.Attribute(attr="add_argument")):
                options = [word.value for word in node.args if isinstance(word, ast.Constant)]
                yield from ((node.lineno, str(option).replace("-", "_")) for option in options)


def keys(table: Mapping[str, Any]) -> Iterator[str]:
    for name, value in table.items():
        yield name
        for inner in value if isinstance(value, list) else [value]:
            if isinstance(inner, Mapping):
                yield from keys(inner)


@pytest.mark.slow
def test_no_identifier_is_a_private_word() -> None:
    wrong = []
    for path in tracked("*.py"):
        names = [(0, path.stem), *identifiers(ast.parse(path.read_text(encoding="utf-8")))]
        wrong += [
            f"{path.relative_to(ROOT)}:{line} {name}: {better}" for line, name in names if (better := replaced(name))
        ]
    assert not wrong, "\n".join(sorted(set(wrong)))


def test_no_key_of_a_configuration_file_is_a_private_word() -> None:
    files = {path: tomllib.loads(path.read_text(encoding="utf-8")) for path in tracked("*.toml")}
    wrong = [f"{path.relative_to(ROOT)} {key}" for path, table in files.items() for key in keys(table) if replaced(key)]
    assert not wrong, "\n".join(wrong)


def test_no_heading_is_made_of_private_words() -> None:
    wrong = []
    for path in tracked("*.md"):
        headings = re.findall(r"^#+ (.*)$", path.read_text(encoding="utf-8"), re.MULTILINE)
        words = [word for heading in headings for word in re.findall(r"[\w-]+", heading.replace("dead reckoning", ""))]
        wrong += [f"{path.relative_to(ROOT)} {w}" for w in words if w not in WHOLE and replaced(w.replace("-", "_"))]
    assert not wrong, "\n".join(wrong)


def test_no_sentence_has_a_phrase_that_a_plainer_one_replaced() -> None:
    files = [path for path in tracked("*.py", "*.md", "*.toml", "*.js", "*.ipynb") if "results" not in path.parts]
    wrong = [
        f"{path.relative_to(ROOT)}:{number} {phrase}: {better}"
        for path in files
        for number, line in enumerate(path.read_text(encoding="utf-8").lower().splitlines(), 1)
        for phrase, better in PHRASES.items()
        if phrase in line
    ]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("name", ["Ladder", "hot_blocks", "way_m", "left_out", "imu_bank", "found", "DeadEnd", "gives"])
def test_a_private_word_is_seen(name: str) -> None:
    assert replaced(name)


@pytest.mark.parametrize("name", ["dead_reckoning", "DeadReckonedPose", "data_sheet", "heappush", "founded", "always"])
def test_a_standard_word_stays(name: str) -> None:
    assert not replaced(name)
