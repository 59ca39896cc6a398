"""Corrected samples: errors undone, nothing else changed."""

from dataclasses import replace

import numpy as np
import pytest

from mapserver.calibration.correction import (
    ANY_SHARE,
    HEADINGS,
    LEVEL_SHARE,
    NO_SHARE,
    Correction,
    SampleCorrections,
    corrected,
    measured,
)
from protocol.arrays import Floats, Table
from protocol.machine.samples import APPLIED, LIMITS
from tests.reference.correction import in_numpy
from tests.unit.mapserver.calibration.drives import RAMP, START_NS, Errors, drive
from tests.unit.mapserver.data import random_samples

EVER = (0, 2**62)


def correction(
    zero: float, k: float = 0.0, across: float = 0.0, *, span: tuple[int, int] = EVER, most: float = ANY_SHARE
) -> Correction:
    return Correction("a", *span, zero, k / (1 + k), across, (), most)


def wild(seed: int) -> Table:
    draw = np.random.default_rng(seed)
    rows = random_samples(5000, seed)
    rows["heading_rad"] = draw.uniform(-7, 7, len(rows))
    rows["speed_mps"] = draw.normal(0, 3, len(rows))
    for name in ("c_rr", "grade_e", "grade_n", *APPLIED):
        rows[name] = draw.uniform(*LIMITS[name], len(rows))
    rows["c_rr"][:100] = np.nan
    for name in ("c_rr", "grade_e", "grade_n"):
        rows[name][100:200] = np.nan
    return rows


@pytest.mark.parametrize("off", [(0.01234, 0.6, -0.00321), (1.0, -0.5, 1.0), (-1.0, 0.0, -1.0)])  # some to the limits
@pytest.mark.parametrize("most", [ANY_SHARE, LEVEL_SHARE, NO_SHARE])
def test_the_kernel_equals_numpy_bit_for_bit(off: tuple[float, float, float], most: float) -> None:
    rows, c = wild(5), correction(*off, most=most)
    assert corrected(rows, [c]).tobytes() == in_numpy(rows, c).tobytes()


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_errors_are_undone_ahead_and_in_reverse_on_level_ground_and_on_slopes(direction: float) -> None:
    errors = Errors(zero=0.006, scale=0.6, across=-0.004)
    true, wrong = (drive(RAMP, e, direction=direction, seed=3, late=False) for e in (Errors(), errors))
    right = corrected(wrong, [correction(errors.zero, errors.scale, errors.across)])
    for name in ("grade_e", "grade_n"):
        assert np.abs(right[name] - true[name]).max() < 1e-5, name
    # noise in the balance counts as drive force too, so the scale is undone in it
    off = right["c_rr"].astype(np.float64) - true["c_rr"]
    assert abs(off.mean()) < 3e-4
    assert np.abs(off).max() < 0.01
    assert np.abs(wrong["c_rr"] - true["c_rr"]).max() > 0.1


def test_each_span_has_its_own_correction_and_rows_of_none_stay_bytes_as_they_were() -> None:
    rows = random_samples(400, 2)
    rows["stamp_ns"] = START_NS + np.arange(400) * 10**9
    first, middle, end = (START_NS + second * 10**9 for second in (100, 200, 300))
    both = [correction(-0.004, span=(middle, end)), correction(0.003, 0.1, span=(first, middle))]
    parts = [rows[:100], in_numpy(rows[100:200], both[1]), in_numpy(rows[200:300], both[0]), rows[300:]]
    for some in (both, both[::-1]):
        assert corrected(rows, some).tobytes() == np.concatenate(parts).tobytes()
    assert corrected(rows, []) is rows


def calibrated_by_itself(rows: Table, zero: Floats, scale: Floats) -> Table:
    """As sent by a machine with these zeros and scales (n,) applied: agents/estimation/ground.py."""
    out = rows.copy()
    d, heading = np.where(rows["speed_mps"] >= 0, 1.0, -1.0), rows["heading_rad"].astype(np.float64)
    c, s = np.cos(heading), np.sin(heading)
    share = d * rows["c_rr"] + c * rows["grade_e"] + s * rows["grade_n"]
    out["c_rr"] -= d * (zero + scale * share)
    out["grade_e"], out["grade_n"] = rows["grade_e"] + zero * c, rows["grade_n"] + zero * s
    out["applied_zero"], out["applied_scale"] = zero, scale
    return out


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_what_a_machine_applied_is_undone_sample_by_sample(direction: float) -> None:
    raw = drive(RAMP, Errors(0.006, 0.08, -0.004), direction=direction, seed=4)
    draw, standstill = np.random.default_rng(1), np.arange(len(raw)) * 12 // len(raw)
    sent = calibrated_by_itself(raw, draw.normal(0, 0.006, 12)[standstill], draw.normal(0, 0.1, 12)[standstill])
    assert np.abs(sent["c_rr"] - raw["c_rr"]).max() > 0.01
    back = measured(sent)
    for name in ("c_rr", "grade_e", "grade_n"):
        assert np.abs(back[name] - raw[name]).max() < 1e-5 + 0.02 * np.pi / HEADINGS, name
    assert not back["applied_zero"].any()
    assert not back["applied_scale"].any()
    assert measured(back) is back


MANY = [
    Correction("a", 0, START_NS + 600 * 10**9, 0.01, 0.03, 0.002, ()),
    Correction("a", START_NS + 600 * 10**9, 2**62, -0.01, 0.0, 0.0, (), LEVEL_SHARE),
    Correction("b", START_NS + 300 * 10**9, START_NS + 900 * 10**9, 0.002, -0.1, 0.0, ()),
]


def test_samples_of_all_machines_are_corrected_as_those_of_each():
    rows, draw = wild(7), np.random.default_rng(7)
    rows["stamp_ns"] = START_NS + draw.integers(0, 1800, len(rows)) * 10**9
    machine = draw.integers(0, 3, len(rows))
    out = SampleCorrections(MANY).applied(rows, ["c", "b", "a"], machine)
    for index, name in enumerate("cba"):
        own = [each for each in MANY if each.machine == name]
        assert out[machine == index].tobytes() == corrected(rows[machine == index], own).tobytes()
    assert out[machine == 0].tobytes() == rows[machine == 0].tobytes()
    assert (out[machine == 2] != rows[machine == 2]).any()
    assert SampleCorrections(MANY).applied(rows, ["c"], np.zeros(len(rows), np.int64)) is rows


def test_equal_corrections_are_those_that_do_the_same():
    assert SampleCorrections(MANY) == SampleCorrections(MANY[::-1])
    less_sure = [replace(each, covariance=((1.0,),)) for each in MANY]
    assert SampleCorrections(less_sure) == SampleCorrections(MANY)
    for changed in ({"machine": "d"}, {"zero": 0.02}, {"most_share": 0.2}, {"to_ns": 9}):
        assert SampleCorrections([replace(MANY[0], **changed), *MANY[1:]]) != SampleCorrections(MANY)


def test_a_digest_before_a_time_is_of_what_is_done_until_then():
    some, later = SampleCorrections(MANY), Correction("b", START_NS + 900 * 10**9, 2**62, 0.5, 0.0, 0.0, ())
    more = SampleCorrections([*MANY, later])
    assert more.digest() != some.digest()
    assert more.digest(START_NS + 900 * 10**9) == some.digest(START_NS + 900 * 10**9)
    assert more.digest(START_NS + 900 * 10**9 + 1) != some.digest(START_NS + 900 * 10**9 + 1)
    cut = [replace(MANY[0], to_ns=START_NS + 200 * 10**9), *MANY[1:]]
    assert SampleCorrections(cut).digest(START_NS + 200 * 10**9) == some.digest(START_NS + 200 * 10**9)
    assert SampleCorrections(MANY[1:]).digest(START_NS) == SampleCorrections().digest() == ""
