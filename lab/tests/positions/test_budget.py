"""The error budget: what the filter is informed, and rows on a short drive."""

from dataclasses import replace

import pytest

from agents.localisation import alignment, measurements
from agents.localisation.filters import motion
from agents.localisation.filters.state import Layout
from lab.campaign.experiment import Runner
from lab.campaign.recordings import PAPER, PlannedDrive
from lab.positions import budget
from lab.positions.budget import RECEIVERS, ROWS, TRUTHS, BudgetRow, configured, constants

FAST = replace(PAPER, world="fast")


def test_every_constant_that_is_set_is_one_of_the_filter_and_expects_less_error():
    for truth in TRUTHS.values():
        for module, name, value in truth.constants:
            assert module in (alignment, measurements, motion)
            assert 0 < value < getattr(module, name)


def test_constants_hold_for_the_time_of_a_replay_whatever_happens_in_it():
    layout, before = Layout(imus=1), motion.HEADING_WALK

    def walk() -> float:
        return float(motion._constants(layout, on_plane=False)[1][5, 5])

    def fail() -> None:
        with constants(((motion, "HEADING_WALK", 0.5 * before),)):
            assert walk() == pytest.approx(0.25 * usual)
            raise ZeroDivisionError

    usual = walk()
    with pytest.raises(ZeroDivisionError):
        fail()
    assert (motion.HEADING_WALK, walk()) == (before, usual)


def test_a_constant_that_the_filter_does_not_have_is_an_error_and_nothing_is_set():
    before = motion.HEADING_WALK
    with (
        pytest.raises(AttributeError, match="NO_SUCH"),
        constants(((motion, "HEADING_WALK", 1.0), (motion, "NO_SUCH", 1.0))),
    ):
        pytest.fail("went on")
    assert before == motion.HEADING_WALK


def test_sensors_are_worth_what_the_truth_makes_them():
    machine = PlannedDrive(0, 1.0).machine
    assert configured(machine, ()) == machine
    informed = configured(machine, ("wheels", "turn rate", "slow GPS error"))
    by_kind = {kind: [s for s in informed.sensors if s.kind == kind] for kind in ("torque", "encoder", "imu", "gps")}
    assert not any(s.use for s in by_kind["torque"])
    assert [dict(s.std) for s in by_kind["encoder"]] == [{"speed": 0.01}]
    assert {s.std["rate"] for s in by_kind["imu"]} == {0.001}
    assert {s.drift_share for s in by_kind["gps"]} == {0.0}


def test_rows_have_files_of_their_own():
    names = [BudgetRow(gps, truth).name for gps in RECEIVERS for truth in ROWS]
    assert len(set(names)) == len(names) == 14
    assert not any(set(name) & set(" /,") for name in names)


@pytest.mark.slow
def test_the_budget_says_what_slow_gps_errors_cost(tmp_path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(budget, "RECEIVERS", (1,))
    report, scores = budget.run(Runner(tmp_path), (2, 3), 40.0, FAST)
    rows = {row["truth"]: row for row in report["rows"]}
    assert list(rows) == ["none", *TRUTHS, "wheels, turn rate", "wheels, turn rate, side slip"]
    assert (rows["none"]["ratio"], rows["none"]["ratio_ci95"], rows["none"]["smoothed_ratio"]) == (1.0, 0.0, 1.0)
    assert rows["slow GPS error"]["ratio"] < 0.6
    for name, row in rows.items():
        assert row["net_m"] == pytest.approx(sum(row["net_by_seed_m"]) / 2, abs=1e-3)
        if name not in ("none", "slow GPS error"):
            assert row["ratio"] != 1.0  # the truth got through
    assert len(scores) == 7
