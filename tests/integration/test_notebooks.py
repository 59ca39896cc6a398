"""The notebooks of examples/ and README's Python run on a site."""

from __future__ import annotations

import re
import subprocess
import sys

import pytest

from tests.integration.web_site import NAME, WebSite
from tests.paths import ROOT

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")


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
def test_the_python_of_the_readme_runs(hauling: WebSite):
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text("utf-8"), re.DOTALL)
    assert code.count('connect("tcp/127.0.0.1:7447", "paper")') == 1
    here = code.replace("tcp/127.0.0.1:7447", hauling.endpoint).replace('"paper"', repr(NAME))
    ended = subprocess.run([sys.executable, "-c", here], capture_output=True, text=True, timeout=120, check=False)
    assert (ended.returncode, ended.stderr) == (0, "")
    float(ended.stdout)  # a value, or NaN where nobody was
