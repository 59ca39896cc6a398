import math
from dataclasses import replace

import numpy as np
import pytest

from agents.estimation.ground import GroundEstimate
from agents.localisation.belief import PoseBelief
from agents.sampling import PoseHistory, Sampler, SamplingConfig
from protocol.arrays import Table
from protocol.samples import check_samples

S = 10**9
ESTIMATE = GroundEstimate(0.05, 1e-4, 0.2, 0.1, 1e-3, 0.0)


def pose(seconds: float, x_m: float = 0.0, heading_rad: float = 0.0, variance_m2: float = 1.0) -> PoseBelief:
    return PoseBelief(round((100 + seconds) * S), x_m, 5.0, heading_rad, 2.0, np.diag([variance_m2, 2 * variance_m2]))


def drive(sampler: Sampler, estimate: GroundEstimate = ESTIMATE, metres: float = 10.0, speed: float = 2.0) -> Table:
    """Drive east at constant speed from x = 0, with a pose and a look at the wheels every 50 ms."""
    rows = []
    for i in range(round(metres / speed / 0.05) + 1):
        t = i * 0.05
        sampler.poses.append(pose(t, speed * t))
        if sampler.is_due(speed * t):
            sampler.mark(round((100 + t) * S), speed * t, estimate)
        rows.append(sampler.take())
    return np.concatenate(rows)


@pytest.mark.parametrize("every_m", [0.5, 2.0])
def test_one_sample_per_stretch_that_says_how_long_it_is(every_m: float) -> None:
    rows = drive(Sampler(1.5, SamplingConfig(every_m=every_m, lag_s=0.0)))
    assert len(rows) == 10 / every_m
    assert rows["distance_m"] == pytest.approx(every_m)
    check_samples(rows, 1e4)


def test_distance_of_a_stretch_is_at_most_twice_every_m() -> None:
    sampler = Sampler(0.0, SamplingConfig(every_m=0.5, lag_s=0.0))
    sampler.poses.append(pose(0))
    sampler.mark(100 * S, 30.0, ESTIMATE)
    assert sampler.take()["distance_m"].tolist() == [1.0]


def test_lag_places_the_sample_where_the_machine_was() -> None:
    now, lagged = (drive(Sampler(0.0, SamplingConfig(lag_s=lag_s))) for lag_s in (0.0, 1.0))
    assert now["x_m"] == pytest.approx(np.arange(1, 21) * 0.5)
    assert lagged["x_m"] == pytest.approx(np.arange(17) * 0.5)  # marks at 2.0, 2.5 ... 10.0 m, 1 s is 2 m
    assert lagged["stamp_ns"][0] == 100 * S


def test_marks_before_the_first_pose_are_counted() -> None:
    sampler = Sampler(0.0, SamplingConfig(lag_s=1.0))
    rows = drive(sampler)
    assert sampler.withheld == {"no_pose": 3}
    assert len(rows) == 20 - 3


def test_load_centre_lies_ahead() -> None:
    for heading, place in ((0.0, (1.5, 5.0)), (math.pi / 2, (0.0, 6.5)), (math.pi, (-1.5, 5.0))):
        sampler = Sampler(1.5, SamplingConfig(lag_s=0.0))
        sampler.poses.append(pose(0, heading_rad=heading))
        sampler.mark(100 * S, 0.5, ESTIMATE)
        (row,) = sampler.take()
        assert (row["x_m"], row["y_m"]) == pytest.approx(place)


@pytest.mark.parametrize("heading", [0.0, 0.7, -2.0])
def test_gradient_is_turned_into_the_map(heading: float) -> None:
    sampler = Sampler(1.5, SamplingConfig(lag_s=0.0))
    sampler.poses.append(pose(0, heading_rad=heading))
    sampler.mark(100 * S, 0.5, ESTIMATE)
    (row,) = sampler.take()
    ahead, left = complex(math.cos(heading), math.sin(heading)), complex(-math.sin(heading), math.cos(heading))
    expected = 0.2 * ahead + 0.1 * left
    assert complex(row["grade_e"], row["grade_n"]) == pytest.approx(expected, abs=1e-6)
    assert (row["c_rr"], row["c_rr_var"], row["grade_var"]) == pytest.approx((0.05, 1e-4, 1e-3))
    assert (row["cov_xx_m2"], row["cov_xy_m2"], row["cov_yy_m2"]) == (1.0, 0.0, 2.0)


@pytest.mark.parametrize("rate", [0.03, -0.03])
def test_samples_on_a_change_of_slope_are_withheld_and_counted(rate: float) -> None:
    sampler = Sampler(0.0, SamplingConfig(lag_s=0.0, max_pitch_rate_radps=0.026))
    assert not len(drive(sampler, replace(ESTIMATE, pitch_rate_radps=rate)))
    assert sampler.withheld == {"pitch_transient": 20}


def test_samples_of_an_unsure_place_are_withheld_and_counted() -> None:
    sampler = Sampler(0.0, SamplingConfig(lag_s=0.0, max_std_m=1.2))
    assert not len(drive(sampler))  # the variance north is 2 m2
    assert sampler.withheld == {"unsure_position": 20}


def test_nothing_is_lost_while_no_pose_is_known() -> None:
    """The heading is found late: the poses then come all at once, from the beginning of the drive on."""
    sampler = Sampler(0.0, SamplingConfig(lag_s=0.0))
    for i in range(1, 21):
        sampler.mark(round((100 + i * 0.25) * S), i * 0.5, ESTIMATE)
        assert not len(sampler.take())
    for i in range(201):
        sampler.poses.append(pose(i * 0.05, i * 0.1))
    rows = sampler.take()
    assert rows["x_m"] == pytest.approx(np.arange(1, 21) * 0.5)
    assert not sampler.withheld


def test_interpolation_takes_the_short_way_across_the_back_heading() -> None:
    history = PoseHistory(30)
    history.append(pose(0, 0.0, math.pi - 0.1))
    history.append(pose(1, 4.0, -math.pi + 0.3, variance_m2=3.0))
    middle = history.at(100 * S + S // 2)
    assert middle
    assert math.remainder(middle.heading_rad - (math.pi + 0.1), math.tau) == pytest.approx(0, abs=1e-12)
    assert -math.pi <= middle.heading_rad <= math.pi
    assert (middle.x_m, middle.speed_mps, middle.covariance_m2[0, 0]) == pytest.approx((2.0, 2.0, 2.0))


def test_history_knows_its_ends_and_nothing_beyond() -> None:
    history = PoseHistory(30)
    assert history.newest is None
    assert history.at(100 * S) is None
    history.append(pose(0, 1.0))
    history.append(pose(1, 2.0))
    for seconds, x in ((0, 1.0), (1, 2.0)):
        at = history.at((100 + seconds) * S)
        assert at
        assert at.x_m == x
    assert history.at(100 * S - 1) is None
    assert history.at(101 * S + 1) is None


def test_pose_of_the_same_stamp_replaces_the_last() -> None:
    history = PoseHistory(30)
    history.append(pose(0, 1.0))
    history.append(pose(0, 2.0))
    assert history.newest
    assert history.newest.x_m == 2.0


def test_history_forgets_but_never_what_history_s_asks_for() -> None:
    history = PoseHistory(2.0)
    for i in range(1000):
        history.append(pose(i * 0.1, float(i)))
        if i >= 20:
            assert history.at(round((100 + i * 0.1 - 2.0) * S) + 1)
    assert len(history._poses) <= 42


@pytest.mark.parametrize("name", list(SamplingConfig.__dataclass_fields__))
def test_bad_sampling_option_is_refused_by_name(name: str) -> None:
    with pytest.raises(ValueError, match=name):
        SamplingConfig(**{name: -1.0})


def test_lag_must_lie_within_the_history() -> None:
    with pytest.raises(ValueError, match="lag_s"):
        SamplingConfig(lag_s=30.0, history_s=30.0)
