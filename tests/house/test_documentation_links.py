"""Targets of documents exist: relative links with anchors, paths and modules in backticks."""

import re
from collections.abc import Iterator
from pathlib import Path

from tests.paths import DOCS, ROOT
from tests.structure import PACKAGES

LAB = [page for page in (ROOT / "lab").rglob("*.md") if page.name != "house.md"]  # it names former files
PAGES = [*(ROOT / f"{name}.md" for name in ("README", "CONTRIBUTING", "CHANGELOG")), *DOCS.rglob("*.md"), *LAB]
TOP = "|".join((*PACKAGES, "tests", "docs", "config", r"\.ci"))
PATH = re.compile(rf"`((?:{TOP})/(?:[\w.*-]+/)*(?:[\w*-]+\.(?:py|md|toml|urdf|c|bin|png|jpg))?)`")
MODULE = re.compile(rf"`((?:{'|'.join(PACKAGES)})(?:\.[A-Za-z_]\w*)+)`")
FILE = re.compile(r"`(\w+\.py)`")  # a module by its file name
FILES = {path.name: path for top in ("tests", *PACKAGES) for path in (ROOT / top).rglob("*.py")}
FUNCTION = re.compile(r"`([A-Za-z_]+)\.(?!toml|md|py)([a-z_]+)`")  # Class.method or module.function
LINK = re.compile(r"\]\((?!https?:)([^)#]*)(?:#([^)]+))?\)")


def test_links_paths_and_modules_of_the_documents_exist():
    assert [f"{page.relative_to(ROOT)}: {name}" for page in PAGES for name in _missing(page)] == []


def test_functions_that_the_design_names_exist():
    product = "\n".join(path.read_text() for top in PACKAGES for path in (ROOT / top).rglob("*.py"))
    named = FUNCTION.findall((DOCS / "design.md").read_text())
    bodies = re.findall(r"^class (\w+)(.*?)(?=^\S)", product, re.MULTILINE | re.DOTALL)
    bodies += [(path.stem, path.read_text()) for path in FILES.values()]
    there = {
        (owner, name) for owner, name in named for place, body in bodies if place == owner and f"def {name}(" in body
    }
    assert [pair for pair in named if pair not in there] == []


def _missing(page: Path) -> Iterator[str]:
    text = page.read_text()
    yield from (path for path in PATH.findall(text) if not any(ROOT.glob(path)))
    yield from (name for name in FILE.findall(text) if name not in FILES)
    yield from (name for name in MODULE.findall(text) if not _is_defined(name))
    for target, anchor in LINK.findall(text):
        file = page.parent / target if target else page
        if not file.exists() or (anchor and anchor not in _anchors(file)):
            yield f"{target}#{anchor}"


def _is_defined(name: str) -> bool:
    """Whether a dotted name leads to a module or a word in one."""
    *parents, last = name.split(".")
    if last in ("py", "toml") or (ROOT / name.replace(".", "/")).is_dir():
        return True
    module = ROOT.joinpath(*parents)
    files = [module / f"{last}.py", module.with_suffix(".py"), module / "__init__.py"]
    return files[0].exists() or any(f.exists() and re.search(rf"\b{last}\b", f.read_text()) for f in files[1:])


def _anchors(file: Path) -> set[str]:
    """Anchors of a page's headings, as on code hosts."""
    headings = re.findall(r"^#+ (.*)$", file.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}
