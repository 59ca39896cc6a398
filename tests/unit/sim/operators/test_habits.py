from contextlib import closing
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from protocol.arrays import Floats
from protocol.errors import ConfigError
from sim.config import SimConfig
from sim.operators.habits import RUN_UP_M, STOPS, WANDER_STEP_M, WANDER_STEPS, DrivingConfig, Habits, draw_habits
from sim.scenario.file import load_scenario
from sim.sensors.noise import generator
from sim.simulator import Simulator
from tests.unit.sim.drives import Driven, drive

SEED = 5


def habits(config: DrivingConfig, machines: int = 1, seed: int = SEED) -> Habits:
    return draw_habits(config, [generator(seed, i, "driver") for i in range(machines)])


def lateral_m(drawn: Habits, driven_m: Floats) -> Floats:
    """Lateral offsets (k, n) after distances driven (k,)."""
    n = len(drawn.left_m)
    return np.array([drawn.lateral_m(np.full(n, at)) for at in driven_m])


@pytest.mark.parametrize(("wander_m", "length_m"), [(0.3, 20.0), (1.0, 60.0)])
def test_wander_has_its_deviation_and_its_correlation_along_the_distance(wander_m: float, length_m: float) -> None:
    left_m = habits(DrivingConfig(wander_m, length_m), machines=200).left_m
    assert left_m.shape == (200, WANDER_STEPS)
    assert left_m.std() == pytest.approx(wander_m, rel=0.03)  # clipped at the widest percent
    assert abs(left_m).max() <= DrivingConfig(wander_m, length_m).widest_m
    assert abs(left_m.mean()) < 0.02 * wander_m
    for lengths in (0.2, 0.5, 1.0, 2.0):
        apart = round(lengths * length_m / WANDER_STEP_M)
        share = 2 * apart * WANDER_STEP_M / length_m
        correlation = (left_m * np.roll(left_m, apart, axis=1)).mean() / (left_m**2).mean()
        assert correlation == pytest.approx((1 + share) * np.exp(-share), abs=0.03)


def test_wander_is_smooth_begins_on_the_line_and_after_eight_kilometres_again() -> None:
    drawn = habits(DrivingConfig(0.5, 40.0), machines=3)
    track = lateral_m(drawn, np.arange(0.0, 600.0, 0.1))
    assert (track[0] == 0).all()
    assert abs(np.diff(track, axis=0)).max() < 0.02  # never steeper than 0.2
    lap_m = WANDER_STEP_M * WANDER_STEPS
    np.testing.assert_allclose(drawn.lateral_m(np.full(3, lap_m + 77.7)), drawn.lateral_m(np.full(3, 77.7)), atol=1e-12)
    assert (drawn.lateral_m(np.full(3, RUN_UP_M / 2)) == 0.5 * drawn.left_m[:, int(RUN_UP_M / 2 / WANDER_STEP_M)]).all()


def test_stops_come_at_the_distances_and_last_the_times_that_are_given() -> None:
    drawn = habits(DrivingConfig(stop_every_m=100.0, stop_s=(3.0, 9.0)), machines=20)
    gap_m, stop_s = zip(*(drawn.stop(np.full(20, number)) for number in range(STOPS)), strict=True)
    assert 50 <= np.min(gap_m) < 55 < 145 < np.max(gap_m) <= 150
    assert np.mean(gap_m) == pytest.approx(100.0, rel=0.02)
    assert 3 <= np.min(stop_s) < 3.1 < 8.9 < np.max(stop_s) <= 9
    np.testing.assert_array_equal(drawn.stop(np.full(20, STOPS + 4)), drawn.stop(np.full(20, 4)))


def test_habits_depend_on_the_seed_and_the_machine_alone() -> None:
    config = DrivingConfig(0.5, 40.0, stop_every_m=100.0)
    one, more, other = habits(config, 1), habits(config, 3), habits(config, 1, SEED + 1)
    for name in ("left_m", "gap_m", "stop_s"):
        first = getattr(one, name)[0]
        np.testing.assert_array_equal(getattr(more, name)[0], first)
        assert (getattr(more, name)[1] == first).mean() < 0.01  # clipped values are equal
        assert (getattr(other, name)[0] == first).mean() < 0.01


@pytest.mark.parametrize(
    ("keys", "problem"),
    [
        ("wander_m = 1.1", "wander_m: 1.1 is not between 0 and 1"),
        ("wander_length_m = 5", "wander_length_m: 5.0 is not between 10 and 1000"),
        ("wander_m = 1\nwander_length_m = 12", "at most 0.6 m"),
        ("stop_every_m = 5", "stop_every_m: 5.0 is not between 20 and 100000"),
        ("stop_s = [9, 3]", r"stop_s: \[9.0, 3.0\] are not a shortest and a longest time from 1 to 3600 s"),
    ],
)
def test_unusable_habits_are_refused(tmp_path: Path, keys: str, problem: str) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(f'base = "paper_site"\n[driving]\n{keys}\n')
    with pytest.raises(ConfigError, match=problem) as error:
        load_scenario(str(path))
    assert "driving" in str(error.value)


def test_a_route_must_leave_room_for_drivers_who_wander(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    route = '[[route]]\nname = "{}"\ncorners = [[30, 4.5], [90, 4.5], [90, 90], [30, 90]]\n'
    text = 'base = "paper_site"\n' + "".join(map(route.format, ("west", "east", "middle")))
    path.write_text(text)
    load_scenario(str(path))
    path.write_text(text + "[driving]\nwander_m = 0.8\n")
    with pytest.raises(ConfigError, match="keep 5 m inside"):
        load_scenario(str(path))


# --- on the road -----------------------------------------------------------------------------------------------------


def stops(driven: Driven, machine: int) -> list[tuple[float, float]]:
    """Distance driven [m] and duration [s] of each stop of at least a second."""
    still = abs(driven.states.speed_mps[:, machine]) < 0.02
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still, [0]]).astype(int)))
    spans = [(first, last) for first, last in edges.reshape(-1, 2).tolist() if first and last < len(still)]
    return [(float(driven.driven_m[a, machine]), 0.1 * (b - a)) for a, b in spans if b - a >= 10]


@cache
def site() -> Driven:
    return drive(SimConfig(scenario="paper_site_driven", world="fast", seed=3), 400.0)


@pytest.mark.nightly
@pytest.mark.slow
def test_machines_stand_where_and_as_long_as_their_drivers_stop() -> None:
    driven = site()
    with closing(Simulator(SimConfig(scenario="paper_site_driven", world="fast", seed=3))) as simulator:
        drawn = simulator._habits
    for machine in range(3):
        stood = stops(driven, machine)
        gaps_m, times_s = drawn.gap_m[machine], drawn.stop_s[machine]
        at_m = np.cumsum(gaps_m)
        assert len(stood) >= 4
        planned = [(at, time) for at, time in zip(at_m, times_s, strict=True) if at < driven.driven_m[-1, machine] - 1]
        for at, time in planned:  # besides stops behind other machines
            assert any(abs(m - at) < 2.0 and time - 0.5 < s < time + 1.0 for m, s in stood), (at, time, stood)
    still = abs(driven.states.speed_mps) < 0.02
    assert 0.1 < still.mean() < 0.4


@pytest.mark.slow
def test_a_stop_on_a_slope_ends_without_rolling_back(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text('base = "paper_site"\n[driving]\nstop_every_m = 20.0\nstop_s = [1.0, 2.0]\n')
    driven = drive(SimConfig(scenario=str(path), world="fast", seed=1), 150.0)
    steep = np.hypot(driven.states.grade_e, driven.states.grade_n) > 0.2
    assert (steep & (abs(driven.states.speed_mps) < 0.02)).sum() > 20
    assert driven.states.speed_mps.min() > -0.3
