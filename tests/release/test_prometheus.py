"""Prometheus's own tool takes the alarms."""

import shutil
import subprocess

import pytest

from tests.paths import ROOT


@pytest.mark.nightly
@pytest.mark.skipif(not shutil.which("promtool"), reason="no promtool")
def test_promtool_takes_the_rules() -> None:
    rules = ROOT / "config" / "prometheus" / "rules.yml"
    done = subprocess.run(["promtool", "check", "rules", str(rules)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert f"{rules.read_text().count('alert:')} rules found" in done.stdout
