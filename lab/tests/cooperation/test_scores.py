"""Figures of arms with known answers: times, rounds, false alarms."""

import numpy as np
import pytest

from lab.calibration.drives import Scene
from lab.cooperation.drives import FOUR, REPAVED, TOURS, length_m, planned
from lab.cooperation.live import LiveRun
from lab.cooperation.scores import false_alarms, minutes_until, rounds_ns
from lab.ground.truth import true_ground
from lab.tests.cooperation.samples import driving, track
from sim.simulator import START_NS

DRIVE = planned(3, 400.0, FOUR, "fast", repaves=True)


def run_of(samples=None, events=()) -> LiveRun:
    samples = driving(0, 10) if samples is None else samples
    machine = np.zeros(len(samples), np.int64)
    return LiveRun(samples, machine, samples["stamp_ns"], ["loader-1"], list(events), [0], [0], True, 0.0, {})


def test_minutes_until_a_share_are_taken_between_two_maps():
    minutes = np.array([1.0, 2.0, 3.0])
    assert minutes_until(minutes, np.array([40.0, 80.0, 100.0]), 90.0) == pytest.approx(2.5)
    assert minutes_until(minutes, np.array([100.0, 100.0, 100.0]), 90.0) == pytest.approx(0.9)
    assert minutes_until(minutes, np.array([95.0, 80.0, 99.0]), 90.0) == pytest.approx(90 / 95)  # the first time counts
    assert np.isnan(minutes_until(minutes, np.array([0.0, 50.0, 89.9]), 90.0))


def test_a_round_is_over_once_the_last_machine_has_driven_it():
    names = DRIVE.machines[:2]
    far_m = 2.1 * max(length_m((name,)) for name in TOURS)
    line = np.stack([np.arange(0.0, far_m), np.zeros(int(np.ceil(far_m)))], axis=1)
    tracks = {names[0]: track(line), names[1]: track(line, step_s=1.0)}
    true = Scene(true_ground(DRIVE.ground, 3).truth, tracks)
    slow_s = length_m(DRIVE.tours[names[1]])
    assert (rounds_ns(true, DRIVE, names, 1) - START_NS) / 1e9 == pytest.approx(slow_s, abs=1.1)
    assert rounds_ns(true, DRIVE, names, 3) is None


def test_changes_that_are_listed_elsewhere_are_false_alarms():
    def change(number: int, x_m: float, y_m: float) -> dict:
        bounds = (x_m - 1, y_m - 1, x_m + 1, y_m + 1)
        return {"id": number, "kind": "change", "stamp_ns": 0, "body": {"id": number, "bounds": bounds}}

    (x_m, y_m), *_ = REPAVED["west"]
    events = [change(1, x_m + 5, y_m + 5), change(2, 150.0, 120.0), change(2, 150.0, 121.0)]
    layers = {"resistance": np.where(np.arange(30_000).reshape(150, 200) < 5000, 0.02, np.nan)}
    assert false_alarms(run_of(events=events), DRIVE, layers, 864.0) == (1, pytest.approx(5000e-6 * 0.01))
    still = planned(3, 400.0, FOUR, "fast")
    assert false_alarms(run_of(events=events), still, layers, 864.0)[0] == 2
