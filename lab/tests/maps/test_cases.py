"""Cases for map merging are as described."""

from dataclasses import replace

import numpy as np
import pytest

from lab.maps.cases import CaseMachine, MapCase, parking_place, select
from lab.maps.samples import BUCKET_NS, cell_of, gauss_markov, simulate, sweep_lanes


def case(name: str, columns: int = 60, rows: int = 40, index: int = 0) -> MapCase:
    return replace(select([name])[index], columns=columns, rows=rows)


def rows_of(scene, machine: str):
    return np.concatenate([delivery.rows for delivery in scene.deliveries if delivery.machine == machine])


def test_position_errors_last_and_have_the_deviation_that_is_stated():
    """From the first sample on; 150 samples are 30 s."""
    draw = np.random.default_rng(2)
    errors, first = gauss_markov(200_000, 1.3, draw), [gauss_markov(2, 1.3, draw)[0] for _ in range(4000)]
    assert np.std(errors) == pytest.approx(1.3, rel=0.05)
    assert np.std(first) == pytest.approx(1.3, rel=0.05)
    assert np.corrcoef(errors[:-150], errors[150:])[0, 1] == pytest.approx(np.exp(-1), abs=0.06)


@pytest.mark.parametrize(("columns", "rows"), [(9, 40), (60, 1)])
def test_one_pass_drives_every_cell_and_cells_between_samples_count(columns: int, rows: int):
    assert simulate(case("1x1", columns, rows), 0).driven.all()


def test_the_bad_machine_measures_too_much_and_is_off_to_the_east_and_knows_neither():
    plan = case("bad_machine")
    scene = simulate(plan, 2)
    good, bad = rows_of(scene, "machine2"), rows_of(scene, "machine4")
    assert bad["c_rr"].mean() == pytest.approx(1.6 * good["c_rr"].mean(), rel=0.02)
    assert [bad[axis].mean() - good[axis].mean() for axis in ("x_m", "y_m")] == pytest.approx([3.0, 0.0], abs=0.8)
    assert (bad["cov_xx_m2"] == good["cov_xx_m2"][0]).all()
    assert [machine.gain for machine in plan.machines] == [1, 1, 1, 1.6]


def test_the_parked_machine_stands_sends_all_the_time_and_drives_nothing():
    parked_case = case("parked_bad_machine")
    scene = simulate(parked_case, 4)
    parked, busy = rows_of(scene, "machine5"), rows_of(scene, "machine1")
    assert parked["distance_m"].max() == parked["speed_mps"].max() == 0.0
    assert len(parked) >= len(busy)
    x_m, y_m = parking_place(parked_case)
    assert (parked["x_m"].mean(), parked["y_m"].mean()) == pytest.approx((x_m + 3, y_m), abs=1.5)
    assert parked["c_rr"].mean() == pytest.approx(1.6 * 0.04, abs=0.001)
    alone = replace(parked_case, machines=(CaseMachine(passes=1), CaseMachine(parked=True)))
    assert simulate(alone, 4).driven.sum() == simulate(case("1x1"), 4).driven.sum()


@pytest.mark.parametrize("seed", range(2))
def test_the_zone_is_repaved_inside_a_bucket_while_the_fourth_pass_is_in_it(seed: int):
    scene = simulate(case("repaved", columns=150, rows=100), seed)
    assert scene.repaved_ns is not None
    assert 0.15 * BUCKET_NS < scene.repaved_ns % BUCKET_NS < 0.85 * BUCKET_NS
    rows = rows_of(scene, "machine1")
    sweep = sweep_lanes(case("repaved", columns=150, rows=100), CaseMachine(passes=5), np.random.default_rng(0))
    assert sweep.number[np.searchsorted(rows["stamp_ns"], scene.repaved_ns)] == 3
    there = scene.site.repaved[cell_of(sweep.x_m, sweep.y_m, scene.site)]
    late = rows["stamp_ns"] >= scene.repaved_ns
    for when, c_rr in ((~late, 0.06), (late, 0.02)):
        assert np.median(rows["c_rr"][there & when]) == pytest.approx(c_rr, abs=0.001)
        assert (when & there & (sweep.number == 3)).any()
