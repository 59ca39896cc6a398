import json
from pathlib import Path

import pytest

from lab.tests.stored import FILE, RUNS, figures


@pytest.mark.slow
@pytest.mark.parametrize("name", RUNS)
def test_a_small_run_has_the_figures_that_are_stored(name: str, tmp_path: Path):
    assert figures(name, tmp_path) == json.loads(FILE.read_text())[name]
