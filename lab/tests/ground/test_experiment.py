"""The ground's table where there is little or nothing to judge."""

import math
from pathlib import Path

import pytest

from lab.campaign.recordings import PlannedDrive, make
from lab.ground import experiment
from lab.ground.experiment import GroundConfiguration, PipelineOutput
from lab.tests.stored import LOADERS
from protocol.machine.samples import empty


@pytest.mark.parametrize(("seconds", "settled"), [(600.0, 240.0), (1200.0, 240.0), (100.0, 40.0)])
def test_a_machine_has_time_to_settle(seconds, settled):
    assert experiment.settle_s(seconds) == settled


@pytest.mark.slow
def test_a_tour_without_samples_still_has_rows(tmp_path: Path):
    drive, row = PlannedDrive(4, 5.0, "dgps", LOADERS), GroundConfiguration("kalman", "calibrated")
    make(drive, tmp_path)
    silent = experiment.judged(drive, row, PipelineOutput(empty(0), {}, 1.0), tmp_path)
    summary = experiment.summarise(row, [silent, silent])
    assert summary["cells"] == 0
    assert math.isnan(summary["right_class_pct"])
