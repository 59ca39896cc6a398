"""What the map server offers: judged, taken once, and never surer than it is."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from agents.estimation.calibration import FLOOR, SCALE_STD, ZERO_STD, ZERO_WALK, Calibration, Calibrator
from agents.estimation.ground import EstimationConfig
from agents.estimation.offers import AHEAD_NS, TOO_OLD_NS, Offers, intersected
from protocol.wire.messages import CalibrationOffer
from protocol.wire.offer_codec import encode_offer
from tests.unit.agents.drives import START_NS, VEHICLE, Leg, drive
from tests.unit.agents.ground import EstimatorRun

NAME, S = VEHICLE.name, 10**9
OFFER = CalibrationOffer(NAME, START_NS, 0.004, 0.05, 4e-7, 2e-5, 1e-6)
STANDS, DRIVES = [Leg(2)], [Leg(2), Leg(4, 0.5), Leg(6)]


def table(**changes: Any) -> dict[str, Any]:
    return {**encode_offer(OFFER), **changes}


# --- which are taken -------------------------------------------------------------------------------------------------


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
        ({"stamp_ns": START_NS}, "not_newer"),
        ({"stamp_ns": START_NS + TOO_OLD_NS - S}, "too_old"),
        ({"stamp_ns": START_NS + 2 * TOO_OLD_NS + AHEAD_NS + S}, "in_future"),
    ],
)
def test_a_bad_offer_is_refused_and_counted(changes: Any, reason: str) -> None:
    offers = Offers(NAME, START_NS)
    offers.consider(table(**changes), START_NS + 2 * TOO_OLD_NS)
    assert offers.counters == {f"refused_offer_{reason}": 1}
    assert offers.take() is None


# --- what it is worth ------------------------------------------------------------------------------------------------


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
        assert zz == pytest.approx(FLOOR**2 + ZERO_WALK**2 * age_s, rel=1e-6)
        assert ss == pytest.approx((10 * FLOOR) ** 2, rel=1e-6)


def test_what_is_offered_again_and_again_shows_nothing_new() -> None:
    """Each offer is of the same samples, or nearly; as measurements of their own they would be believed too much."""
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
    """Its covariance is never less than the true one, for independent estimates and for fully dependent ones."""
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


# --- when it counts --------------------------------------------------------------------------------------------------


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
