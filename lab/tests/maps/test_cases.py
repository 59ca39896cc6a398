"""The cases on which merges are compared are what they say."""

from dataclasses import replace

import numpy as np
import pytest

from lab.maps import samples
from lab.maps.cases import CASES, CELL_M, CaseMachine, MapCase, build_site, parking_place, select
from lab.maps.samples import BUCKET_NS, PERIOD_NS, STEP_M, cell_of, gauss_markov, simulate, sweep_lanes
from protocol.machine.samples import SAMPLE_DTYPE, check_samples


def case(name: str, columns: int = 60, rows: int = 40, index: int = 0) -> MapCase:
    return replace(select([name])[index], columns=columns, rows=rows)


def rows_of(scene, machine: str):
    return np.concatenate([delivery.rows for delivery in scene.deliveries if delivery.machine == machine])


def test_cases_come_in_the_order_of_the_table_and_by_name():
    assert select([]) == CASES
    assert [c.title for c in select(["slope_15", "repaved"])] == ["repaved, 1 after", "repaved, 2 after", "slope_15"]
    assert len({c.name for c in CASES}) == len(CASES) == 12


def test_position_errors_last_and_have_the_deviation_that_is_stated():
    """From the first sample on; 150 samples are 30 s."""
    draw = np.random.default_rng(2)
    errors, first = gauss_markov(200_000, 1.3, draw), [gauss_markov(2, 1.3, draw)[0] for _ in range(4000)]
    assert np.std(errors) == pytest.approx(1.3, rel=0.05)
    assert np.std(first) == pytest.approx(1.3, rel=0.05)
    assert np.corrcoef(errors[:-150], errors[150:])[0, 1] == pytest.approx(np.exp(-1), abs=0.06)


def test_a_pass_goes_along_in_lanes_of_1_m_and_the_next_across():
    sweep = sweep_lanes(case("1x1"), CaseMachine(passes=2), np.random.default_rng(3))
    along, across = sweep.number == 0, sweep.number == 1
    assert along.sum() == 40 * 100
    assert across.sum() == 60 * 67
    assert np.unique(np.round(np.diff(np.unique(sweep.y_m[along])), 9)).tolist() == [1.0]
    assert np.unique(np.round(np.diff(np.unique(sweep.x_m[across])), 9)).tolist() == [1.0]
    np.testing.assert_allclose(np.diff(sweep.x_m[along][:100]), STEP_M)
    assert (np.diff(sweep.x_m[along][100:200]) < 0).all()  # and back
    first_across = sweep_lanes(case("1x1"), CaseMachine(first=1), np.random.default_rng(3))
    assert np.abs(np.sin(first_across.heading_rad)).min() == pytest.approx(1.0)


def test_headings_point_ahead():
    sweep = sweep_lanes(case("1x1"), CaseMachine(passes=2), np.random.default_rng(3))
    moved = np.stack([np.diff(sweep.x_m), np.diff(sweep.y_m)])
    on_a_lane = np.hypot(*moved) < STEP_M + 1e-6
    ahead = moved[0] * np.cos(sweep.heading_rad[1:]) + moved[1] * np.sin(sweep.heading_rad[1:])
    np.testing.assert_allclose(ahead[on_a_lane], STEP_M)
    assert on_a_lane.mean() > 0.95


@pytest.mark.parametrize(("columns", "rows"), [(9, 40), (60, 1)])
def test_one_pass_drives_every_cell_and_cells_between_samples_count(columns: int, rows: int):
    assert simulate(case("1x1", columns, rows), 0).driven.all()


def test_machines_send_valid_samples_of_one_work_day_at_5_hz():
    scene = simulate(case("4x4"), 1)
    starts = []
    for rows in [rows_of(scene, f"machine{i}") for i in (1, 2, 3, 4)]:
        assert rows.dtype == SAMPLE_DTYPE
        check_samples(rows, extent_m=1000.0)
        assert set(np.diff(rows["stamp_ns"])) == {PERIOD_NS}
        assert rows["distance_m"].min() == rows["distance_m"].max() == np.float32(STEP_M)
        assert rows["speed_mps"][0] == 3.0
        for column, value in (("cov_xx_m2", 1.69), ("cov_yy_m2", 1.69), ("c_rr_var", samples.C_RR_STD**2)):
            assert (rows[column] == np.float32(value)).all()
        starts.append(int(rows["stamp_ns"][0]))
    assert samples.START_NS <= min(starts) <= max(starts) < samples.START_NS + samples.START_WITHIN_NS + PERIOD_NS
    assert max(starts) - min(starts) < PERIOD_NS
    assert len(set(starts)) == 4
    assert scene.samples == sum(len(rows_of(scene, f"machine{i}")) for i in (1, 2, 3, 4))


def test_batches_of_100_arrive_machine_by_machine_in_turn():
    scene = simulate(case("4x4"), 1)
    received = [delivery.received_ns for delivery in scene.deliveries]
    assert received == sorted(received)
    assert {delivery.machine for delivery in scene.deliveries[:4]} == {"machine1", "machine2", "machine3", "machine4"}
    assert max(len(delivery.rows) for delivery in scene.deliveries) == samples.BATCH_ROWS
    for delivery in scene.deliveries:
        assert delivery.received_ns == delivery.rows["stamp_ns"][-1] + samples.LATENCY_NS


def test_the_same_seed_gives_the_same_bytes_and_another_other_ones():
    first, again, other = (rows_of(simulate(case("1x1"), seed), "machine1").tobytes() for seed in (5, 5, 6))
    assert first == again != other


def test_the_bad_machine_measures_too_much_and_is_off_to_the_east_and_knows_neither():
    plan = case("bad_machine")
    scene = simulate(plan, 2)
    good, bad = rows_of(scene, "machine2"), rows_of(scene, "machine4")
    assert bad["c_rr"].mean() == pytest.approx(1.6 * good["c_rr"].mean(), rel=0.02)
    assert [bad[axis].mean() - good[axis].mean() for axis in ("x_m", "y_m")] == pytest.approx([3.0, 0.0], abs=0.8)
    assert (bad["cov_xx_m2"] == good["cov_xx_m2"][0]).all()
    assert [machine.gain for machine in plan.machines] == [1, 1, 1, 1.6]


def test_receivers_state_what_they_are():
    scene = simulate(case("mixed_receivers"), 3)
    assert [rows_of(scene, f"machine{i}")["cov_xx_m2"][0] for i in (1, 2, 3, 4)] == pytest.approx([0.0025, *[6.25] * 3])
    sweep = sweep_lanes(case("mixed_receivers"), CaseMachine(), np.random.default_rng(0))
    rtk = rows_of(scene, "machine1")
    across = rtk["y_m"] - np.round(rtk["y_m"])  # a lane's offset, and the error
    assert len(rtk) == len(sweep.x_m)
    assert np.abs(across - np.median(across)).max() < 0.4


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


@pytest.mark.parametrize("seed", range(5))
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


def test_how_many_passes_follow_is_the_cases_own():
    one, two = (simulate(case("repaved", index=index), 0) for index in (0, 1))
    assert 0 < two.samples - one.samples < 60 * 40 / 0.6 + 60
    site = one.site
    assert (set(site.c_rr[site.repaved]), set(site.c_rr_later[site.repaved])) == ({0.06}, {0.02})
    assert (site.c_rr == site.c_rr_later)[~site.repaved].all()
    assert simulate(case("1x1"), 0).repaved_ns is None


@pytest.mark.parametrize(("index", "width"), [(0, 3), (1, 6)])
def test_a_narrow_road_lies_across_wet_dirt_and_alone_is_judged(index: int, width: int):
    site = build_site(case("narrow_road", index=index))
    assert site.judged.sum() * CELL_M**2 == width * 60
    assert (set(site.c_rr[site.judged]), set(site.c_rr[~site.judged])) == ({0.008}, {0.06})


def test_the_site_has_the_five_zones():
    site = build_site(CASES[0])
    assert site.c_rr.shape == (200, 300)
    places = [site.c_rr[row, column] for row, column in ((0, 149), (99, 150), (100, 99), (100, 100), (199, 200))]
    assert places == [0.008, 0.04, 0.02, 0.25, 0.06]
    assert not site.repaved.any()
    assert site.judged.all()
    assert not site.gradient.any()


def test_gradients_are_measured_along_and_across_with_a_bias_that_turns():
    slope = case("slope_15")
    assert np.hypot(*build_site(slope).gradient[39, 0]) == pytest.approx(np.tan(np.radians(15)))
    biases, deviations = [], []
    for seed in range(12):
        scene = simulate(slope, seed)
        sweep = sweep_lanes(slope, slope.machines[0], np.random.default_rng(0))
        rows = rows_of(scene, "machine1")
        true = scene.site.gradient[cell_of(sweep.x_m, sweep.y_m, scene.site)]
        error = np.stack([rows["grade_e"], rows["grade_n"]], axis=-1) - true
        inside = np.abs(error).max(axis=1) < 0.05  # its lanes are not quite this sweep's
        heading_rad = sweep.heading_rad[inside]
        along = error[inside, 0] * np.cos(heading_rad) + error[inside, 1] * np.sin(heading_rad)
        biases.append(along.mean())
        deviations.append(along.std())
        assert rows["grade_var"][0] == pytest.approx(samples.GRADE_STD**2 + samples.GRADE_BIAS_STD**2)
    assert np.median(deviations) == pytest.approx(samples.GRADE_STD, rel=0.1)
    assert 0.4 * samples.GRADE_BIAS_STD < np.std(biases) < 2 * samples.GRADE_BIAS_STD
