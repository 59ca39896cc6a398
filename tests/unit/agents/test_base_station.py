"""A base station: what its fixes are off, with the variances that the model promises, and which fixes it leaves out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from agents.base_station import PINNED, BaseStation, LastingError
from protocol.machine.machine_config import Mount, SensorConfig
from protocol.machine.readings import Gps, Odometry
from protocol.site.site_config import Projection, SiteConfig

T0 = 1_750_000_000_000_000_000
SITE = SiteConfig("pit", 49.0, 8.0)
PROJECTION = Projection(SITE)
PLACE = (100.0, 50.0)
STD_M, SHARE, TAU_S = 1.5, 0.8, 45.0
STEP_S = 0.2


def sensor(name: str = "gps-1", xyz_m: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> SensorConfig:
    return SensorConfig(name, "gps", Mount(xyz_m), drift_share=SHARE, drift_time_s=TAU_S)


def station(*sensors: SensorConfig, place: tuple[float, float] = PLACE) -> BaseStation:
    return BaseStation("base-1", sensors or (sensor(),), place, PROJECTION)


def fix(off: Sequence[float], i: int, name: str = "gps-1", at: Sequence[float] = PLACE, dt_s: float = STEP_S) -> Gps:
    lat, lon, height = PROJECTION.to_geodetic(at[0] + off[0], at[1] + off[1])
    return Gps(name, T0 + round(i * dt_s * 1e9), lat, lon, height, STD_M**2, STD_M**2, 9.0)


def drifting(n: int, seed: int) -> np.ndarray:
    """Errors (n, 2) as the model has them."""
    rng = np.random.default_rng(seed)
    keep = np.exp(-STEP_S / TAU_S)
    slow, errors = rng.standard_normal(2) * STD_M * np.sqrt(SHARE), np.empty((n, 2))
    for row in errors:
        row[:] = slow + rng.standard_normal(2) * STD_M * np.sqrt(1 - SHARE)
        slow = keep * slow + np.sqrt(1 - keep**2) * STD_M * np.sqrt(SHARE) * rng.standard_normal(2)
    return errors


def test_correction_is_fix_less_antenna_with_the_variances_of_the_receiver() -> None:
    (made,) = station(sensor(xyz_m=(2.0, -1.0, 3.0))).step([fix((1.25, -0.5), 1, at=(102.0, 49.0))])
    assert (made.east_m, made.north_m) == pytest.approx((1.25, -0.5), abs=1e-6)
    assert (made.white_m2, made.slow_m2) == pytest.approx(((1 - SHARE) * STD_M**2, SHARE * STD_M**2))
    assert (made.sensor, made.time_s, made.stamp_ns) == ("base-1", TAU_S, T0 + 200_000_000)


def test_two_receivers_make_one_correction_with_less_white_noise() -> None:
    base = station(sensor("gps-1"), sensor("gps-2"))
    first = base.step([fix((1.0, 0.0), 1), fix((3.0, 2.0), 1, "gps-2")])
    made = base.step([fix((1.0, 0.0), 2), fix((3.0, 2.0), 2, "gps-2")])
    assert (len(first), len(made)) == (1, 1)
    assert (made[-1].east_m, made[-1].north_m) == pytest.approx((2.0, 1.0), abs=1e-6)
    assert made[-1].white_m2 == pytest.approx((1 - SHARE) * STD_M**2 / 2)
    assert made[-1].slow_m2 == pytest.approx(SHARE * STD_M**2)  # antennas close to each other err alike


def test_receiver_that_is_away_for_a_moment_stops_the_others_and_later_not() -> None:
    base = station(sensor("gps-1"), sensor("gps-2"))
    base.step([fix((1.0, 0.0), 1), fix((3.0, 2.0), 1, "gps-2"), fix((1.0, 0.0), 2), fix((3.0, 2.0), 2, "gps-2")])
    alone = [c for i in range(3, 60) for c in base.step([fix((1.0, 0.01 * (i % 2)), i)])]
    assert alone
    assert min(c.stamp_ns for c in alone) - T0 > 5.0 * 1e9  # no jump to the error of one of the two


@pytest.mark.slow
@pytest.mark.parametrize("wrong_m", [0.0, 5.0])
def test_lasting_error_of_a_wrong_survey_is_found_within_what_it_states(wrong_m: float) -> None:
    base = station(place=(PLACE[0] - wrong_m, PLACE[1]))
    last = base.step([fix(error, i) for i, error in enumerate(drifting(5 * 1800, 0), 1)])[-1]
    std_m = last.offset_m2**0.5
    assert std_m < 0.4
    assert np.abs([last.offset_e_m - wrong_m, last.offset_n_m]).max() < 2.5 * std_m
    assert ("check `place`" in base.problem) is bool(wrong_m)


def test_lasting_error_follows_a_base_that_was_moved_after_a_while() -> None:
    lasting, rng = LastingError(), np.random.default_rng(0)
    for i in range(1, 300):
        lasting.update(T0 + i * 10**9, rng.standard_normal(2) * 0.1, 0.01, 0.01, TAU_S)
    sure_m2 = lasting.variance_m2
    for i in range(300, 310):
        lasting.update(T0 + i * 10**9, np.array([8.0, 0.0]), 0.01, 0.01, TAU_S)
    assert np.hypot(*lasting.offset_m) < 0.5  # outliers teach nothing
    for i in range(310, 400):
        lasting.update(T0 + i * 10**9, np.array([8.0, 0.0]) + rng.standard_normal(2) * 0.1, 0.01, 0.01, TAU_S)
    assert lasting.offset_m == pytest.approx([8.0, 0.0], abs=0.3)
    assert lasting.variance_m2 < 10 * sure_m2


def test_receiver_that_holds_its_place_is_left_out_and_reported() -> None:
    base = station()
    made = base.step([fix((1.0, 1.0), i) for i in range(1, 2 * PINNED)])
    assert len(made) == PINNED
    assert base.counters["fix_pinned"] == PINNED - 1
    assert "static hold" in base.problem
    assert base.step([fix((1.1, 1.0), 2 * PINNED)])
    assert not base.problem


def test_what_is_no_fix_of_this_place_is_counted_and_nothing_else() -> None:
    base = station()
    readings = [
        fix((5000.0, 0.0), 1),
        fix((0.0, 0.0), 2, name="gps-9"),
        Odometry("gps-1", T0 + 3, 0.0, 0.0, 0.0),
    ]
    assert base.step(readings) == []
    assert base.counters == {"fix_far_off": 1, "reading_unknown_sensor": 2}
    made = base.step([fix((1.0, 0.0), 5), fix((1.1, 0.0), 5), fix((1.2, 0.0), 4), fix((1.3, 0.0), 6)])
    assert [round((c.stamp_ns - T0) * 1e-9, 3) for c in made] == [1.0, 1.2]


@pytest.mark.parametrize("at", [10_000_000, -10_000_000])
def test_pause_or_a_clock_that_jumps_keeps_what_the_base_has_learnt(at: int) -> None:
    base = station()
    before = base.step([fix(e, i) for i, e in enumerate(drifting(2000, 0), 1)])[-1]
    after = [c for i in range(300) for c in base.step([fix((1.0 + 0.01 * i, 0.0), at + i)])]
    assert after
    assert after[0].offset_m2 < 2 * before.offset_m2 + 1e-3 * abs(at)
    assert all(np.isfinite([c.offset_e_m, c.offset_n_m, c.offset_m2]).all() for c in after)
