"""Corrections of a base: what they bring, which are refused and why, and that they never do what nobody asked for."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from agents.localisation.consistency import VarianceFactor
from agents.localisation.corrections import MAX_AGE_S, MAX_AHEAD_S, REFUSALS, REPEATS, Corrections
from agents.localisation.filters.belief import Belief
from agents.localisation.filters.motion import GpsError
from agents.localisation.filters.state import Layout
from agents.localisation.localiser import LocalisationConfig
from agents.localisation.site_share import WAIT_S, SiteShareEstimator
from agents.pipeline import Pipeline
from agents.positioning import PipelineConfig, Positioning
from protocol.machine.machine_config import MachineConfig, SensorConfig
from protocol.machine.readings import Correction, Gps, Reading
from tests.unit.agents.drives import PROJECTION, SITE, START_NS, Drive, Leg, drive, machine, thinned

BASE = SensorConfig("base-1", "correction")
TOUR = (Leg(4, 0.5), Leg(6), *[Leg(6, 0, 0.3), Leg(10)] * 3)  # 58 s
SLOW_M2, TIME_S = 2.25, 45.0
Off = Callable[[float], tuple[float, float]]


def ramp(t_s: float) -> tuple[float, float]:
    """A slow error (2,) [m] that grows to some metres."""
    return 2.5 * math.sin(t_s / 12), 2.0 * math.sin(t_s / 17 + 0.4)


def with_base(vehicle: MachineConfig) -> MachineConfig:
    return replace(vehicle, sensors=(*vehicle.sensors, BASE))


def off(reading: Reading, error: Off) -> Reading:
    """A fix that is off by an error."""
    if not isinstance(reading, Gps):
        return reading
    x, y, z = PROJECTION.to_map(reading.lat_deg, reading.lon_deg, reading.height_m)
    east, north = error((reading.stamp_ns - START_NS) * 1e-9)
    lat, lon, height = PROJECTION.to_geodetic(x + east, y + north, z)
    return replace(reading, lat_deg=lat, lon_deg=lon, height_m=height)


def correction(t_s: float, east: float, north: float, **options: Any) -> Correction:
    values = (east, north, 0.01, SLOW_M2, TIME_S, 0.0, 0.0, 0.01)
    return replace(Correction("base-1", START_NS + round(t_s * 1e9), *values), **options)


def corrections(error: Off, seconds: float, from_s: float = 0.2) -> list[Correction]:
    return [correction(t, *error(t)) for t in np.arange(from_s, seconds, 0.2)]


def mixed(readings: Sequence[Reading], made: Sequence[Correction], link_s: float = 0.1) -> list[Reading]:
    arrivals = [(r.stamp_ns, r) for r in readings] + [(c.stamp_ns + round(link_s * 1e9), c) for c in made]
    return [reading for _, reading in sorted(arrivals, key=lambda a: a[0])]


def locate(vehicle: MachineConfig, readings: Sequence[Reading], engine: str = "ekf", **options: Any) -> Positioning:
    config = LocalisationConfig(filter=engine, slip=0.0, slip_soft=0.0, lag_s=0.0, **options)
    positioning = Positioning(SITE, vehicle, PipelineConfig(localisation=config))
    positioning.step(readings)
    return positioning


@cache
def usual(what: str) -> Positioning:
    """The drive of most of these tests: alone, or beside a base that errs as the machine does, and is believed to."""
    readings = [off(reading, ramp) for reading in thinned(drive(TOUR, machine()).readings)]
    if what == "alone":
        return locate(machine(), readings)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(SiteShareEstimator, "share", 0.95)
        return locate(with_base(machine()), mixed(readings, corrections(ramp, 60)))


def error_m(located: Positioning, made: Drive, from_s: float = 30.0) -> float:
    """Root mean square error of the poses."""
    stamps = [int(ns) for ns in made.stamps_ns[::20] if START_NS + from_s * 1e9 < ns]
    poses = [(pose, made.at(ns)) for ns in stamps if (pose := located.pose_at(ns))]
    assert poses
    return float(np.sqrt(np.mean([(p.x_m - x) ** 2 + (p.y_m - y) ** 2 for p, (x, y, *_) in poses])))


@pytest.fixture(scope="module")
def made() -> Drive:
    return drive(TOUR, machine())


@pytest.fixture(scope="module")
def readings(made: Drive) -> list[Reading]:
    return [off(reading, ramp) for reading in thinned(made.readings)]


@pytest.fixture
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    """The share is known to be large from the start on."""
    monkeypatch.setattr(SiteShareEstimator, "share", 0.95)


@pytest.fixture
def stated(monkeypatch: pytest.MonkeyPatch) -> None:
    """What receivers state of their errors holds, as it does beside a base."""
    monkeypatch.setattr(VarianceFactor, "note", lambda *_: None)


@pytest.mark.slow
def test_base_that_is_not_heard_changes_nothing(readings: list[Reading], stated: None) -> None:
    alone, beside = locate(machine(), readings), locate(with_base(machine()), readings)
    assert beside.pose.x_m == pytest.approx(alone.pose.x_m, abs=1e-6)
    assert np.allclose(beside.pose.covariance_m2, alone.pose.covariance_m2, rtol=1e-6)
    assert beside.localiser.base_report() == {
        "name": "base-1",
        "used": False,
        "why_not": "no correction has come in",
        "age_s": None,
        "share": pytest.approx(0.32, abs=0.05),
    }


@pytest.mark.slow
@pytest.mark.parametrize(("receivers", "engine"), [(1, "ukf"), (2, "ekf")])
def test_base_that_errs_as_the_machine_does_takes_most_of_the_error(
    made: Drive, known: None, receivers: int, engine: str
) -> None:
    vehicle = machine(receivers=receivers)
    driven = drive(TOUR, vehicle)
    readings = [off(reading, ramp) for reading in thinned(driven.readings)]
    without = locate(vehicle, readings, engine)
    located = locate(with_base(vehicle), mixed(readings, corrections(ramp, 60)), engine)
    assert error_m(located, driven) < 0.65 * error_m(without, driven)
    state = located.localiser.base_report()
    assert state["used"]
    assert state["age_s"] < 0.5
    assert located.counters["base-1_used"] > 40


@pytest.mark.slow
def test_base_with_another_error_does_no_harm_where_nothing_is_shared(
    made: Drive, readings: list[Reading], monkeypatch: pytest.MonkeyPatch, stated: None
) -> None:
    monkeypatch.setattr(SiteShareEstimator, "share", 0.0)
    wild = corrections(lambda t: (5 * math.cos(t / 5), -4.0), 60)
    located = locate(with_base(machine()), mixed(readings, wild))
    assert error_m(located, made) == pytest.approx(error_m(locate(machine(), readings), made), rel=1e-6)
    assert located.localiser.base_report()["why_not"].startswith("its errors are not those of this machine")


@pytest.mark.slow
def test_survey_that_is_wrong_is_no_error_of_the_machine(made: Drive, readings: list[Reading], known: None) -> None:
    def surveyed(t_s: float) -> tuple[float, float]:
        east, north = ramp(t_s)
        return east + 5.0, north

    right = error_m(usual("beside"), made)
    known_off = [replace(c, offset_e_m=5.0) for c in corrections(surveyed, 60)]
    assert error_m(locate(with_base(machine()), mixed(readings, known_off)), made) == pytest.approx(right, rel=1e-3)
    unsure = [replace(c, offset_m2=9.0) for c in corrections(surveyed, 60)]
    assert error_m(locate(with_base(machine()), mixed(readings, unsure)), made) < error_m(usual("alone"), made)


@pytest.mark.slow
def test_jump_of_the_base_moves_the_machine_little(made: Drive, readings: list[Reading], known: None) -> None:
    rng, jump_m, white_m = np.random.default_rng(3), 5.0, 0.55

    def jumping(t_s: float) -> tuple[float, float]:
        (east, north), white = ramp(t_s), rng.standard_normal(2) * white_m
        return east + jump_m * (t_s > 40) + white[0], north + white[1]

    said = [replace(c, white_m2=max(white_m**2, 0.01)) for c in corrections(jumping, 60)]
    located = locate(with_base(machine()), mixed(readings, said))
    assert located.counters["base-1_gated"] == REFUSALS
    assert located.counters["correction_base_jumped"] == 1
    assert error_m(located, made, 40.0) < error_m(usual("alone"), made, 40.0)


@pytest.mark.slow
def test_what_does_not_count_is_refused_counted_and_named(readings: list[Reading], made: Drive) -> None:
    half = [r for r in readings if r.stamp_ns < START_NS + 30e9]
    located = locate(with_base(machine()), mixed(half, corrections(ramp, 29)))
    used, pose = located.counters["base-1_used"], located.pose
    assert used > 20
    for t_s, reason in ((29.7, ""), (29.7, "not_newer"), (20.0, "not_newer"), (30 + MAX_AHEAD_S + 1, "in_future")):
        located.step([correction(t_s, t_s, 0.0)])
        assert sum(
            located.counters[f"correction_{r}"] for r in ("not_newer", "too_old", "in_future")
        ) == located.counters["correction_not_newer"] + (reason == "in_future")
        if reason:
            assert located.counters[f"correction_{reason}"] >= 1
            assert located.localiser.base_report()["why_not"] == f"the last one was {reason.replace('_', ' ')}"
    assert located.pose is pose  # a correction alone moves nothing, and its stamp is nobody's clock
    located.step([r for r in readings if r.stamp_ns >= START_NS + 30e9])
    assert located.pose.stamp_ns > START_NS + 50e9
    assert "gap_restarts" not in located.counters


@pytest.mark.slow
def test_old_and_repeated_ones_are_not_used(readings: list[Reading]) -> None:
    old = mixed(readings, corrections(ramp, 60), link_s=MAX_AGE_S + 1)
    located = locate(with_base(machine()), old)
    assert located.counters["correction_too_old"] > 50
    assert "base-1_used" not in located.counters
    stuck = locate(
        with_base(machine()),
        mixed(readings, [correction(c.stamp_ns * 1e-9 - START_NS * 1e-9, 1.0, 1.0) for c in corrections(ramp, 60)]),
    )
    assert stuck.counters["base-1_used"] <= REPEATS
    assert stuck.counters["correction_repeated"] > 200
    state = stuck.localiser.base_report()
    assert (state["used"], state["why_not"]) == (False, "the last one was repeated")


@pytest.mark.slow
def test_base_that_falls_silent_is_reported_and_fades(made: Drive, readings: list[Reading], known: None) -> None:
    located = locate(with_base(machine()), mixed(readings, corrections(ramp, 20)))
    state = located.localiser.base_report()
    assert not state["used"]
    assert "s old" in state["why_not"]
    sure = usual("beside")
    assert located.pose.covariance_m2[0, 0] > 1.2 * sure.pose.covariance_m2[0, 0]


# --- how they come in ------------------------------------------------------------------------------------------------

LAYOUT = Layout(1, True, 2, 0, True)


def believed(t_s: float) -> Belief:
    return Belief(START_NS + round(t_s * 1e9), np.zeros(LAYOUT.n), np.eye(LAYOUT.n))


@pytest.fixture
def judged(monkeypatch: pytest.MonkeyPatch) -> list[Correction]:
    """Corrections of which the share is estimated."""
    taken: list[Correction] = []
    monkeypatch.setattr(SiteShareEstimator, "add_correction", lambda _, correction: taken.append(correction))
    return taken


def test_all_that_a_link_held_up_count_when_they_come_at_once(judged: list[Correction]) -> None:
    """25 of them, of 5 s; and none waits for ever where nothing of the machine's own comes in."""
    taking = Corrections(BASE, LAYOUT)
    made = [correction(5 + 0.2 * i, 0.1 * i, 0.0) for i in range(25)]
    for one in made:
        taking.take(one, believed(10.0).stamp_ns)
    measurement = taking.measurement(believed(10.0))
    assert judged == made
    assert measurement
    assert measurement.z[0] == pytest.approx(0.1 * 22)  # the mean of the last second
    assert taking.measurement(believed(10.05)) is None
    for i in range(500):
        taking.take(correction(11 + 0.2 * i, 0.1 * i, 0.0), believed(11 + 0.2 * i).stamp_ns)
    taking.measurement(believed(111.0))
    assert len(judged) < 25 + 5 * MAX_AGE_S + 2


def test_profile_paper_says_that_it_uses_none() -> None:
    options = PipelineConfig(localisation=LocalisationConfig(profile="paper"))
    pipeline = Pipeline(SITE, with_base(machine()), options)
    pipeline.step([correction(1.0, 0.0, 0.0)])
    assert pipeline.health()["base"]["why_not"] == "the profile `paper` uses none"
    assert Pipeline(SITE, machine(), PipelineConfig()).health()["base"] is None


def test_machine_uses_one_base() -> None:
    with pytest.raises(ValueError, match="one base station, not base-1 and base-2"):
        replace(machine(), sensors=(BASE, replace(BASE, name="base-2")))
    replace(machine(), sensors=(BASE, replace(BASE, name="base-2", use=False)))


# --- the share that machine and base have in common -------------------------------------------------------------------

T0 = 1_750_000_000_000_000_000
ERROR = GpsError(2.7, 45.0)
WHITE_M2 = 0.06  # mean of a second


def slow(rng: np.random.Generator, seconds: int, time_s: float = ERROR.time_s) -> np.ndarray:
    """A Gauss-Markov error (n, 2) of variance 1, once a second."""
    keep = np.exp(-1 / time_s)
    white = rng.standard_normal((seconds, 2))
    out = np.empty_like(white)
    out[0] = white[0]
    for i in range(1, seconds):
        out[i] = keep * out[i - 1] + np.sqrt(1 - keep**2) * white[i]
    return out


def errors(share: float, seconds: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Slow errors of machine and base (n, 2) [m]."""
    rng = np.random.default_rng(seed)
    site, machine, base = (slow(rng, seconds) for _ in range(3))
    common, std = np.sqrt(share) * site, np.sqrt(ERROR.variance_m2)
    return std * (common + np.sqrt(1 - share) * machine), std * (common + np.sqrt(1 - share) * base)


def follow(
    estimator: SiteShareEstimator, machine: np.ndarray, base: np.ndarray, seed: int, start: int = 0, late_s: int = 0
) -> None:
    """Let a machine drive round at 4 m/s beside a base; once a second. late_s: how long corrections are held up.

    Its dead reckoning walks by 0.03 m per sqrt(m), and has scale and heading wrong by 0.015, which changes in a minute.
    """
    rng = np.random.default_rng([seed, start, 1])
    late: list[Correction] = []
    heading = np.cumsum(rng.uniform(-0.1, 0.15, len(machine)))
    shifts = 4.0 * np.exp(1j * heading)
    wrong = 0.015 * slow(rng, len(machine), 60.0).view(complex)[:, 0] * shifts
    lost = np.cumsum(wrong + rng.standard_normal((len(machine), 2)).view(complex)[:, 0] * 0.06).view(float)
    for i, (e, b) in enumerate(zip(machine + lost.reshape(-1, 2), base, strict=True)):
        white = rng.standard_normal((2, 2)) * np.sqrt(WHITE_M2)
        stamp_ns = T0 + (start + i) * 10**9
        estimator.drive(stamp_ns, np.array([shifts[i].real, shifts[i].imag]))
        estimator.add_fix("gps-1", stamp_ns, e + white[0], WHITE_M2, ERROR)
        east_m, north_m = (b + white[1]).tolist()
        slow_m2, time_s = ERROR.variance_m2, ERROR.time_s
        late.append(Correction("base-1", stamp_ns, east_m, north_m, WHITE_M2, slow_m2, time_s, 0.0, 0.0, 1.0))
        if i >= late_s:
            estimator.add_correction(late.pop(0))


@pytest.mark.parametrize(
    ("share", "off"),
    [(0.0, 0.1), (0.8, 0.1), pytest.param(0.95, 0.05, marks=pytest.mark.nightly)],
)
@pytest.mark.slow
def test_share_is_found_in_ten_minutes_and_not_overstated(share: float, off: float) -> None:
    shares = []
    for seed in range(3):
        estimator = SiteShareEstimator()
        follow(estimator, *errors(share, 600, seed), seed)
        shares.append(estimator.share)
    assert np.mean(shares) == pytest.approx(share, abs=off), shares


@pytest.mark.slow
def test_link_that_holds_corrections_up_costs_nothing_of_the_share() -> None:
    machine, base = errors(0.9, 200, 4)
    late, at_once = SiteShareEstimator(), SiteShareEstimator()
    follow(at_once, machine, base, 4)
    follow(late, machine, base, 4, late_s=WAIT_S - 1)
    assert late.share == pytest.approx(at_once.share, abs=1e-9)


@pytest.mark.slow
def test_base_that_repeats_what_is_long_past_loses_its_share_within_a_minute() -> None:
    machine, base = errors(0.95, 1000, 5)
    estimator = SiteShareEstimator()
    follow(estimator, machine[:900], base[:900], 5)
    before = estimator.share
    follow(estimator, machine[900:960], base[:60], 5, start=900)
    assert before > 0.9
    assert estimator.share < 0.3


@pytest.mark.slow
def test_outliers_of_fixes_and_a_machine_that_was_carried_say_nothing_of_the_share() -> None:
    machine, base = errors(0.95, 420, 5)
    true, seconds = SiteShareEstimator(), np.arange(420)
    follow(true, machine, base, 5)
    once, often, carried = seconds == 400, seconds % 60 == 40, seconds >= 400
    for wrong, off_m in ((once, 80.0), (often, 5.0), (carried, 10.0)):
        estimator = SiteShareEstimator()
        follow(estimator, machine + [off_m, 0.0] * wrong[:, None], base, 5)
        assert estimator.share == pytest.approx(true.share, abs=0.05)
