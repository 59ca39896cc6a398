"""The notebooks of examples/ run on a site from their first cell to their last."""

from __future__ import annotations

import pytest

from tests.integration.web_site import NAME, WebSite
from tests.paths import ROOT

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")


@pytest.mark.processes
@pytest.mark.filterwarnings("ignore")  # of the kernel's own libraries
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
