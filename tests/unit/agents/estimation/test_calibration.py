"""Zero and scale of the balance: calibration there and back, and on known ground."""

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from agents.dead_reckoning import DeadReckonedPose, DeadReckoning
from agents.estimation.balance import Balance
from agents.estimation.calibration import Calibration, Calibrator
from agents.estimation.calibration_file import _checksum, load, save
from agents.estimation.closed_tours import Tour
from agents.estimation.ground import EstimationConfig
from agents.estimation.offers import AHEAD_NS, TOO_OLD_NS, Offers, intersected
from agents.estimation.tuning import TUNING, EstimationTuning
from protocol.errors import StoreError
from protocol.machine.samples import LIMITS, SCALE_STD, ZERO_STD, ZERO_WALK
from protocol.wire.codec import encode_offer
from protocol.wire.messages import CalibrationOffer
from tests.unit.agents.drives import START_NS, VEHICLE, Leg, drive
from tests.unit.agents.ground import STEADY, STEP_S, EstimatorRun

FLAT: Callable[[float], float] = lambda _: 0.0  # noqa: E731
NOISE = 0.008 * math.sqrt(5)  # per step: a stretch of 0.5 m has 5 steps


@dataclass
class Place:
    """Stands in for dead reckoning."""

    x_m: float = 0.0
    y_m: float = 0.0
    angle_rad: float = 0.0

    @property
    def pose(self) -> DeadReckonedPose:
        return DeadReckonedPose(0, 0.0, self.angle_rad, self.x_m, self.y_m)


class Course:
    """A calibrator driven to and fro on a line, with ground and slope by place and sensor errors."""

    def __init__(
        self,
        calibrator: Calibrator,
        *,
        zero: float = 0.0,
        scale: float = 0.0,
        c_rr: Callable[[float], float] = lambda _: 0.04,
        slope: Callable[[float], float] = FLAT,
        noise: float = 0.0,
        seed: int = 0,
    ) -> None:
        self.calibrator = calibrator
        self.place = Place()
        self._zero, self._scale, self._c_rr, self._slope = zero, scale, c_rr, slope
        self._noise, self._rng = noise, np.random.default_rng(seed)
        self._steps = 0
        self._distance_m = 0.0

    def drive(
        self, metres: float, direction: float = 1.0, *, known_c_rr: float | None = None, speed_mps: float = 2.0
    ) -> None:
        """Straight ahead or back, in steps of 0.05 s."""
        for _ in range(round(metres / (speed_mps * STEP_S))):
            self._steps += 1
            self._distance_m += speed_mps * STEP_S
            self.place.x_m += direction * speed_mps * STEP_S * math.cos(self.place.angle_rad)
            self.place.y_m += direction * speed_mps * STEP_S * math.sin(self.place.angle_rad)
            balance = self._balance(direction, speed_mps)
            self.calibrator.update(balance, cast(DeadReckoning, self.place), known_c_rr)

    def there_and_back(self, metres: float, times: int = 1) -> None:
        for _ in range(times):
            self.drive(metres)
            self.wait(2.0)
            self.drive(metres, -1.0)
            self.wait(2.0)

    def wait(self, seconds: float) -> None:
        self._steps += round(seconds / STEP_S)
        self.calibrator.interrupt()

    def _balance(self, direction: float, speed_mps: float) -> Balance:
        slope, c_rr = self._slope(self.place.x_m), self._c_rr(self.place.x_m)
        true = direction * c_rr * math.cos(slope)
        share = (true + math.sin(slope)) / (1 - self._scale)  # so that share (1 - scale) balances
        noise = self._noise * self._rng.standard_normal()
        return replace(
            STEADY,
            stamp_ns=START_NS + self._steps * round(STEP_S * 1e9),
            speed_mps=direction * speed_mps,
            distance_m=self._distance_m,
            slope_x=slope,
            share=share,
            unbalanced=true + self._scale * share + self._zero + noise,
        )


def course(calibration: Calibration | None = None, tuning: EstimationTuning = TUNING, **options: object) -> Course:
    return Course(Calibrator(calibration, tuning), **options)  # type: ignore[arg-type]


# --- there and back --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("zero", "c_rr"), [(0.004, 0.25), (-0.008, 0.01)])
def test_flat_ground_there_and_back_shows_the_zero(zero: float, c_rr: float) -> None:
    on = course(zero=zero, c_rr=lambda _: c_rr, noise=NOISE, seed=1)
    on.there_and_back(40, 6)
    calibration = on.calibrator.calibration
    assert calibration.zero == pytest.approx(zero, abs=0.0012)
    assert calibration.scale == pytest.approx(0.0, abs=0.045)
    assert math.sqrt(calibration.covariance[0][0]) < 0.0012
    assert math.sqrt(calibration.covariance[1][1]) > 0.02  # not observable on flat ground
    assert on.calibrator.counters["pairs"] > 6 * 70
    assert calibration.passages > 6 * 70


def test_a_slope_shows_the_scale_too() -> None:
    """40 m flat, then a 12 degree ramp."""
    scale = -0.05
    on = course(zero=0.004, scale=scale, slope=lambda x: math.radians(12) if x > 20 else 0.0, noise=NOISE, seed=2)
    on.there_and_back(40, 8)
    calibration = on.calibrator.calibration
    assert calibration.zero == pytest.approx(0.004, abs=0.0015)
    assert calibration.scale == pytest.approx(scale, abs=0.012)
    corrected = [calibration.corrected(on._balance(d, 2.0)) * d for d in (1.0, -1.0)]
    assert np.mean(corrected) == pytest.approx(0.04, abs=0.02)


def test_a_passage_counts_once() -> None:
    """There, back and there on the same 20 m: each passage has one partner."""
    on = course(zero=0.004)
    on.drive(20)
    on.wait(1)
    on.drive(20, -1.0)
    pairs = on.calibrator.counters["pairs"]
    assert 35 <= pairs <= 40
    on.wait(1)
    on.drive(20)
    assert on.calibrator.counters["pairs"] <= pairs + 6  # all but the ends are used up
    on.wait(1)
    on.drive(20, -1.0)
    assert 2 * pairs - 6 <= on.calibrator.counters["pairs"] <= 2 * pairs + 6


@pytest.mark.parametrize(
    ("change", "pairs"),
    [
        ({}, True),
        ({"y_m": 0.5}, True),
        ({"y_m": 0.9}, False),
        ({"angle_rad": 0.1 + 4 * math.pi}, True),  # full turns do not count
        ({"angle_rad": 0.3}, False),
        ({"wait_s": 90.0}, True),
        ({"wait_s": 150.0}, False),
    ],
    ids=str,
)
def test_what_is_the_same_ground(change: dict[str, float], pairs: bool) -> None:
    on = course(zero=0.004)
    on.drive(6)
    on.wait(change.pop("wait_s", 1.0))
    for name, value in change.items():
        setattr(on.place, name, value)
    on.drive(3, -1.0)
    assert bool(on.calibrator.counters["pairs"]) is pairs


def test_pairs_beyond_three_standard_deviations_are_excluded() -> None:
    """Std of the zero 0.0045, of two stretches' mean 0.008 / sqrt(2)."""
    for sigmas, excluded in ((3.3, True), (2.7, False)):
        on = course(zero=sigmas * math.hypot(ZERO_STD, TUNING.stretch_std / math.sqrt(2)))
        on.there_and_back(1)
        assert bool(on.calibrator.counters["off"]) is excluded


def test_a_zero_far_beyond_its_class_is_found_in_the_end() -> None:
    """0.3 m/s2, ten times the class: so many pairs in a row are no border."""
    on = course(zero=0.03, noise=NOISE, seed=5)
    on.there_and_back(40, 6)
    assert on.calibrator.counters["relocked"] >= 1
    assert on.calibrator.counters["off"] >= TUNING.relock
    assert on.calibrator.calibration.zero == pytest.approx(0.03, abs=0.003)


def test_known_ground_on_a_slope_counts_with_its_cosine_in_both_directions() -> None:
    on = course(zero=0.006, c_rr=lambda _: 0.2, slope=lambda _: 0.3)
    for direction in (1.0, -1.0):
        on.drive(60, direction, known_c_rr=0.2)
    assert on.calibrator.calibration.zero == pytest.approx(0.006, abs=3e-4)
    assert (on.calibrator.counters["known_ground"] > 200, on.calibrator.counters["pairs"]) == (True, 0)


# --- uncertainty -----------------------------------------------------------------------------------------------------


NO_FLOOR = replace(TUNING, floor=1e-12)


def test_covariance_is_honest() -> None:
    """Rms of normalised errors, zero and scale drawn from the assumed distribution."""
    errors = []
    for seed in range(25):
        rng = np.random.default_rng(1000 + seed)
        zero, scale = ZERO_STD * rng.standard_normal(), SCALE_STD * rng.standard_normal()
        on = course(
            tuning=NO_FLOOR, zero=zero, scale=scale, slope=lambda x: 0.2 if x > 10 else 0.0, noise=NOISE, seed=seed
        )
        on.there_and_back(20, 2)
        c = on.calibrator.calibration
        off_zero, off_scale = c.zero - zero, c.scale - scale
        (zz, _), (_, ss) = c.covariance
        balance = (off_zero + 0.25 * off_scale) / math.sqrt(c.variance(0.25))
        errors.append((off_zero / math.sqrt(zz), off_scale / math.sqrt(ss), balance))
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    assert ((rms > 0.6) & (rms < 1.5)).all(), f"{rms=}"


def test_no_number_of_pairs_gets_below_the_floor() -> None:
    on = course(slope=lambda x: 0.2 if x > 10 else 0.0)
    on.there_and_back(20, 40)
    (zz, _), (_, ss) = on.calibrator.calibration.covariance
    assert math.sqrt(zz) == pytest.approx(TUNING.floor)
    assert math.sqrt(ss) == pytest.approx(10 * TUNING.floor)


def given(age_s: float = 0.0) -> Calibration:
    return Calibration(0.005, 0.01, ((1e-6, 0.0), (0.0, 1e-4)), START_NS - round(age_s * 1e9), 50)


@pytest.mark.parametrize(("age_s", "std"), [(0.0, 1e-3), (400.0, math.hypot(1e-3, 1.6e-3)), (1e7, 4.5e-3)])
def test_zero_grows_unsure_as_time_passes_but_never_more_than_at_first(age_s: float, std: float) -> None:
    """Random walk 8e-5 per root second; the scale stays."""
    calibrator = Calibrator(given(age_s), NO_FLOOR)
    calibrator.age(START_NS)
    (zz, _), (_, ss) = calibrator.calibration.covariance
    assert math.sqrt(zz) == pytest.approx(std, rel=1e-3)
    assert math.sqrt(ss) == pytest.approx(1e-2)


# --- closed loops ----------------------------------------------------------------------------------------------------


def tour(zero: float, seconds: float = 0.0, std: float = 1e-3) -> Tour:
    return Tour(START_NS + round(seconds * 1e9), zero, std, 300.0)


def test_a_tour_is_one_measurement_of_the_zero() -> None:
    calibrator = Calibrator()
    calibrator.add_tour(tour(0.006))
    gain = ZERO_STD**2 / (ZERO_STD**2 + 1e-6)
    calibration = calibrator.calibration
    assert calibration.zero == pytest.approx(gain * 0.006)
    assert calibration.covariance[0][0] == pytest.approx((1 - gain) * ZERO_STD**2)
    assert (calibration.scale, calibration.covariance[1][1]) == (0.0, pytest.approx(SCALE_STD**2))
    assert (calibration.passages, calibrator.counters["tours"]) == (1, 1)


def test_one_tour_that_is_far_off_is_excluded_and_three_that_agree_are_right() -> None:
    calibrator = Calibrator()
    for i in range(TUNING.relock_tours):
        assert abs(calibrator.calibration.zero) < 1e-12
        calibrator.add_tour(tour(0.03, 90.0 * i))
    calibrator.add_tour(tour(0.03, 300.0))
    assert calibrator.calibration.zero == pytest.approx(0.03, abs=1e-3)
    assert (calibrator.counters["off"], calibrator.counters["relocked"]) == (TUNING.relock_tours, 1)


def test_what_is_applied_can_be_stated_in_a_sample() -> None:
    """An absurd sensor: its samples would be refused."""
    for sign in (1.0, -1.0):
        beyond = Calibration(sign * 0.3, sign * 0.7, ((1e-6, 0.0), (0.0, 1e-4)))
        calibration = Calibrator(beyond).calibration
        assert (calibration.zero, calibration.scale) == (sign * LIMITS["applied_zero"][1], sign * 0.5)


# --- the map server's offers -----------------------------------------------------------------------------------------

NAME, S = VEHICLE.name, 10**9
OFFER = CalibrationOffer(NAME, START_NS, 0.004, 0.05, 4e-7, 2e-5, 1e-6)
STANDS, DRIVES = [Leg(2)], [Leg(2), Leg(4, 0.5), Leg(6)]


def table(**changes: Any) -> dict[str, Any]:
    return {**encode_offer(OFFER), **changes}


def test_a_good_offer_waits_and_is_taken_once() -> None:
    offers = Offers(NAME, 0)
    for _ in range(3):
        offers.consider(table(), START_NS + S)
    assert offers.take() == OFFER
    assert offers.take() is None
    offers.consider(table(), START_NS + 2 * S)
    assert offers.take() is None
    assert not offers.counters


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"zero": math.nan}, "not_finite"),
        ({"zero": 0.3}, "out_of_range"),
        ({"scale_var": None}, "missing_field"),
        ({"machine": "loader-9"}, "wrong_machine"),
        ({"stamp_ns": START_NS - S}, "not_newer"),
        ({"stamp_ns": START_NS + TOO_OLD_NS - S}, "too_old"),
        ({"stamp_ns": START_NS + 2 * TOO_OLD_NS + AHEAD_NS + S}, "in_future"),
    ],
)
def test_a_bad_offer_is_refused_and_counted(changes: Any, reason: str) -> None:
    offers = Offers(NAME, START_NS)
    offers.consider(table(**changes), START_NS + 2 * TOO_OLD_NS)
    assert offers.counters == {f"refused_offer_{reason}": 1}
    assert offers.take() is None


def own(zero: float = 0.0, scale: float = 0.0, stds: tuple[float, float] = (ZERO_STD, SCALE_STD)) -> Calibrator:
    return Calibrator(Calibration(zero, scale, ((stds[0] ** 2, 0.0), (0.0, stds[1] ** 2)), START_NS, 7))


def test_who_knows_nothing_has_what_is_offered() -> None:
    calibrator = own()
    calibrator.take(OFFER, START_NS)
    taken = calibrator.calibration
    assert (taken.zero, taken.scale) == pytest.approx((OFFER.zero, OFFER.scale), rel=1e-6)
    assert (taken.offer_ns, calibrator.counters["offers"]) == (START_NS, 1)


def test_an_offer_is_no_surer_than_the_floor_and_grows_unsure_with_its_age() -> None:
    for age_s in (0.0, 900.0):
        calibrator = own()
        calibrator.take(replace(OFFER, zero_var=1e-9, scale_var=1e-7, covariance=0.0), START_NS + round(age_s * 1e9))
        (zz, _), (_, ss) = calibrator.calibration.covariance
        assert zz == pytest.approx(TUNING.floor**2 + ZERO_WALK**2 * age_s, rel=1e-6)
        assert ss == pytest.approx((10 * TUNING.floor) ** 2, rel=1e-6)


def test_what_is_offered_again_and_again_shows_nothing_new() -> None:
    """Offers share their samples: as independent measurements they would be overconfident."""
    once, often = own(), own()
    once.take(OFFER, START_NS)
    for i in range(50):
        often.take(replace(OFFER, stamp_ns=START_NS + i), START_NS + i)
    one, other = once.calibration, often.calibration
    assert np.array(other.covariance) == pytest.approx(np.array(one.covariance), rel=1e-3)
    assert (other.zero, other.scale) == pytest.approx((one.zero, one.scale), rel=1e-3)


def test_an_offer_that_contradicts_what_is_measured_is_refused_and_counted() -> None:
    calibrator = own(0.0, 0.0, (7e-4, 7e-3))
    before = calibrator.calibration
    calibrator.take(replace(OFFER, zero=0.006), START_NS)
    assert calibrator.calibration == before
    assert calibrator.counters == {"refused_offer_off": 1}


@pytest.mark.parametrize("seed", range(2))
def test_an_intersection_is_consistent_whatever_the_correlation(seed: int) -> None:
    """Its covariance is at least the true one, from independent to fully dependent estimates."""
    draw = np.random.default_rng(seed)
    A, B = (m @ m.T + 0.1 * np.eye(2) for m in draw.normal(size=(2, 2, 2)))
    of_a, of_b = np.linalg.inv(A), np.linalg.inv(B)
    x, P = intersected(np.array([1.0, 2.0]), A, np.array([1.0, 2.0]), B)
    assert x == pytest.approx([1.0, 2.0])
    assert np.linalg.det(P) <= min(np.linalg.det(A), np.linalg.det(B)) * (1 + 1e-9)
    assert (np.linalg.eigvalsh(of_a + of_b - np.linalg.inv(P)) > -1e-9).all()
    root_a, root_b = np.linalg.cholesky(A), np.linalg.cholesky(B)
    for correlation in (-0.99, 0.0, 0.99):
        AB = correlation * root_a @ root_b.T
        ws = np.linspace(0, 1, 101)
        w = min(ws, key=lambda w: np.abs(np.linalg.inv(w * of_a + (1 - w) * of_b) - P).max())
        gain_a, gain_b = w * P @ of_a, (1 - w) * P @ of_b
        cross = gain_a @ AB @ gain_b.T
        true = gain_a @ A @ gain_a.T + gain_b @ B @ gain_b.T + cross + cross.T
        assert (np.linalg.eigvalsh(P - true) > -1e-9).all()


def test_an_offer_counts_from_the_next_standstill_on_and_health_says_so() -> None:
    run = EstimatorRun(VEHICLE, EstimationConfig(accept_calibration=True))
    readings = drive([*DRIVES, Leg(4, -0.5), Leg(3)], VEHICLE).readings
    at = {s: next(i for i, r in enumerate(readings) if r.stamp_ns > START_NS + s * S) for s in (8, 11)}
    run.feed(readings[: at[8]])
    run.estimator.consider(table(stamp_ns=START_NS + 5 * S))
    run.feed(readings[at[8] : at[11]])
    assert run.estimator.health()["calibration"]["zero"] == 0.0
    run.feed(readings[at[11] :])
    health = run.estimator.health()["calibration"]
    assert health["zero"] == pytest.approx(OFFER.zero, rel=1e-3)
    assert (health["offers"], health["offer_ns"], health["accepts_offers"]) == (1, START_NS + 5 * S, True)
    assert run.estimator.at(readings[-1].stamp_ns - S).zero == health["zero"]


def test_who_does_not_accept_offers_ignores_them() -> None:
    run = EstimatorRun(VEHICLE)
    readings = drive(STANDS, VEHICLE).readings
    run.feed(readings[: len(readings) // 2])
    run.estimator.consider(table())
    run.feed(readings[len(readings) // 2 :])
    health = run.estimator.health()["calibration"]
    assert (health["zero"], health["offer_ns"], health["accepts_offers"]) == (0.0, 0, False)
    assert not [name for name in health if name.startswith(("offers", "refused"))]


def test_offers_need_a_calibration_of_ones_own() -> None:
    with pytest.raises(ValueError, match="set `calibrate` too"):
        EstimationConfig(calibrate=False, accept_calibration=True)


# --- on disk ---------------------------------------------------------------------------------------------------------

KNOWN = Calibration(0.0031, -0.02, ((1e-6, -2e-7), (-2e-7, 1e-4)), 1_767_225_600_000_000_000, 41)


def test_what_was_saved_is_loaded_exactly_and_only_its_owner_reads_it(tmp_path: Path) -> None:
    assert load(tmp_path / "c.json", "loader-1") is None
    save(tmp_path / "c.json", "loader-1", KNOWN)
    assert load(tmp_path / "c.json", "loader-1") == KNOWN
    assert [path.name for path in tmp_path.iterdir()] == ["c.json"]
    assert (tmp_path / "c.json").stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize("text", ["", "[]", "{", '{"version": 2}', "\x00\xff", "[" * 100_000])
def test_anything_else_is_refused_with_its_path(tmp_path: Path, text: str) -> None:
    (tmp_path / "c.json").write_text(text, encoding="latin-1")
    with pytest.raises(StoreError, match=r"c\.json"):
        load(tmp_path / "c.json", "loader-1")


@pytest.mark.parametrize(
    "wrong",
    [
        {"machine": "loader-2"},
        {"zero": float("nan")},
        {"zero": 0.3},
        {"scale": -0.6},
        {"covariance": [[1e-6, 1.0], [1.0, 1e-4]]},
        {"covariance": [[1e-6, 0.0]]},
        {"passages": None},
    ],
)
def test_senseless_numbers_are_refused(tmp_path: Path, wrong: dict[str, Any]) -> None:
    path = tmp_path / "c.json"
    save(path, "loader-1", KNOWN)
    table = {**json.loads(path.read_text()), **wrong}
    del table["crc32"]
    path.write_text(json.dumps({**table, "crc32": _checksum(table)}))
    with pytest.raises(StoreError, match=r"c\.json: is (no|the) calibration"):
        load(path, "loader-1")


@pytest.mark.slow
def test_no_flipped_bit_is_used(tmp_path: Path) -> None:
    """Any flipped bit: the saved calibration or an error naming the file."""
    path = tmp_path / "c.json"
    save(path, "loader-1", KNOWN)
    whole, refused = path.read_bytes(), 0
    bits = range(0, 8 * len(whole), 5)
    for at in bits:
        damaged = bytearray(whole)
        damaged[at // 8] ^= 1 << at % 8
        path.write_bytes(damaged)
        try:
            assert load(path, "loader-1") == KNOWN
        except StoreError as error:
            assert "c.json" in str(error)  # noqa: PT017 # blanks between values may be anything that is blank
            refused += 1
    assert refused > 0.9 * len(bits)


def test_a_folder_that_is_not_there_is_an_error_of_ours(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="cannot be written"):
        save(tmp_path / "none" / "c.json", "loader-1", KNOWN)
