"""Notebooks of examples/, and the documents' Python and commands, on a site; the documents build."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path
from textwrap import dedent

import pytest

from tests.integration.web_site import NAME, WebSite
from tests.paths import ROOT

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")
ENDPOINT = "tcp/127.0.0.1:7447"


@pytest.mark.nightly
@pytest.mark.processes
@pytest.mark.filterwarnings("ignore")  # of the kernel's libraries
@pytest.mark.parametrize("name", [path.name for path in sorted((ROOT / "examples").glob("*.ipynb"))])
def test_a_notebook_runs_and_was_saved_with_its_answers(hauling: WebSite, name: str, monkeypatch):
    monkeypatch.setenv("SITEGRID_ENDPOINT", hauling.endpoint)
    monkeypatch.setenv("SITEGRID_SITE", NAME)
    monkeypatch.setenv("MPLBACKEND", "module://matplotlib_inline.backend_inline")
    notebook = nbformat.read(ROOT / "examples" / name, 4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(cell.outputs for cell in code)
    nbclient.NotebookClient(notebook, timeout=300).execute()
    said = [output for cell in code for output in cell.outputs]
    assert not [output for output in said if output.output_type == "error"]
    assert any("image/png" in output.get("data", {}) for output in said)


@pytest.mark.processes
@pytest.mark.parametrize("page", ["README.md", "docs/tutorials/ask-from-python.md"])
def test_the_python_of_a_page_runs_and_prints_what_stands_below_it(hauling: WebSite, page: str):
    ((code, below),) = re.findall(
        r"```python\n(.*?)```\n((?: {4}[^\n]*\n)*)", (ROOT / page).read_text("utf-8"), re.DOTALL
    )
    assert code.count(ENDPOINT) == 1
    here = code.replace(ENDPOINT, hauling.endpoint).replace('"paper"', repr(NAME))
    ended = subprocess.run([sys.executable, "-c", here], capture_output=True, text=True, timeout=120, check=False)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert outline(ended.stdout) == outline(dedent(below)) or not below


def outline(printed: str) -> list[str]:
    """Lines without numbers, road names and column widths."""
    lines = [" ".join(re.sub(r"[-\d._]+[ens]?\b|nan", "#", line).split()) for line in printed.splitlines()]
    return [line.removesuffix(" ...") for line in lines if line]


@pytest.mark.nightly
@pytest.mark.processes
def test_a_recording_is_made_checked_and_run_as_the_tutorial_says(tmp_path: Path):
    page = (ROOT / "docs/tutorials/recording-to-map.md").read_text("utf-8")
    steps = re.findall(r"```sh\n(sitegrid .*)\n```\n((?: {4}.*\n|\n)*)", page)
    assert len(steps) == 3
    for line, shown in steps:
        command = [sys.executable, "-m", *shlex.split(line)]
        ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=900, check=False)
        assert ended.returncode == 0, ended.stderr
        printed = outline(ended.stdout)
        assert [said for said in outline(shown) if not any(one.startswith(said) for one in printed)] == []


@pytest.mark.processes
def test_what_the_readme_asks_of_a_running_site_is_answered(hauling: WebSite, tmp_path: Path):
    """Each command in a process, except those that start or simulate something."""
    blocks = re.findall(r"```sh\n(.*?)```", (ROOT / "README.md").read_text("utf-8"), re.DOTALL)
    lines = [shlex.split(line, comments=True) for line in "".join(blocks).splitlines()]
    asked = [
        words for words in lines if words[:2] in (["sitegrid", "query"], ["sitegrid", "plot"], ["sitegrid", "export"])
    ]
    assert len(asked) == 7
    for _, *words in asked:
        command = [sys.executable, "-m", "sitegrid", *words, "--endpoint", hauling.endpoint, "--site", NAME]
        ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False)
        assert ended.returncode == 0, ended.stderr
    assert {path.name for path in tmp_path.iterdir()} == {"map.png", "map.tif"}


@pytest.mark.nightly
def test_the_documents_build_without_a_warning(tmp_path: Path):
    pytest.importorskip("myst_parser")
    command = [sys.executable, "-m", "sphinx", "--quiet", "--fail-on-warning", "-c", "docs", ".", tmp_path]
    built = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600, check=False)
    assert (built.returncode, built.stderr) == (0, "")
    assert "sitegrid.Client.point" in (tmp_path / "docs" / "api.html").read_text("utf-8")
