"""Corrected samples: the errors of a sample undone, and nothing else changed."""

from dataclasses import replace

import numpy as np
import pytest

from mapserver.fleet.correction import (
    ANY_SHARE,
    HEADINGS,
    LEVEL_SHARE,
    Correction,
    Corrections,
    corrected,
)
from protocol.arrays import Floats, Table
from protocol.machine.samples import LIMITS, SAMPLE_DTYPE
from tests.reference.correction import in_numpy
from tests.unit.mapserver.data import random_samples
from tests.unit.mapserver.fleet.drives import LOW, RAMP, START_NS, Errors, drive

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
    for name in ("c_rr", "grade_e", "grade_n"):
        rows[name] = draw.uniform(*LIMITS[name], len(rows))
    rows["c_rr"][:100] = np.nan
    for name in ("c_rr", "grade_e", "grade_n"):
        rows[name][100:200] = np.nan
    return rows


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("most", [ANY_SHARE, LEVEL_SHARE])
def test_the_kernel_equals_numpy_bit_for_bit(seed: int, most: float) -> None:
    rows = wild(seed)
    c = correction(0.01234, 0.6, -0.00321, most=most)
    assert corrected(rows, [c]).tobytes() == in_numpy(rows, c).tobytes()


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_errors_are_undone_ahead_and_in_reverse_on_level_ground_and_on_slopes(direction: float) -> None:
    errors = Errors(zero=0.006, scale=0.6, across=-0.004)
    true, wrong = (drive(RAMP, e, direction=direction, seed=3, late=False) for e in (Errors(), errors))
    right = corrected(wrong, [correction(errors.zero, errors.scale, errors.across)])
    for name in ("grade_e", "grade_n"):
        assert np.abs(right[name] - true[name]).max() < 1e-5, name
    # what noise is in the balance counts as drive force too, so that the scale is undone in it
    off = right["c_rr"].astype(np.float64) - true["c_rr"]
    assert abs(off.mean()) < 3e-4
    assert np.abs(off).max() < 0.01
    assert np.abs(wrong["c_rr"] - true["c_rr"]).max() > 0.1


def test_rows_that_no_correction_covers_stay_bytes_as_they_were() -> None:
    rows = drive(LOW, seconds=200.0)[:1000]
    rows["stamp_ns"] = START_NS + np.arange(1000) * 10**9
    span = START_NS + 200 * 10**9, START_NS + 300 * 10**9
    out = corrected(rows, [correction(0.01, span=span)])
    changed = np.array([a.tobytes() != b.tobytes() for a, b in zip(out, rows, strict=True)])
    assert changed[200:300].all()
    assert not changed[:200].any()
    assert not changed[300:].any()
    assert corrected(rows, []) is rows


def test_each_span_has_its_own_correction_in_any_order() -> None:
    rows = random_samples(400, 2)
    rows["stamp_ns"] = START_NS + np.arange(400) * 10**9
    middle = START_NS + 200 * 10**9
    both = [correction(-0.004, span=(middle, EVER[1])), correction(0.003, 0.1, span=(0, middle))]
    out = corrected(rows, both)
    assert out.tobytes() == corrected(rows, both[::-1]).tobytes()
    apart = np.concatenate([corrected(rows[:200], both[1:]), corrected(rows[200:], both[:1])])
    assert out.tobytes() == apart.tobytes()


def test_values_end_at_the_limits_of_a_sample() -> None:
    rows = wild(5)
    out = corrected(rows, [correction(1.0, -0.5, 1.0)])
    for name in ("c_rr", "grade_e", "grade_n"):
        low, high = LIMITS[name]
        assert np.nanmin(out[name]) >= low
        assert np.nanmax(out[name]) <= high


def test_a_correction_touches_nothing_else() -> None:
    rows = wild(6)
    out = corrected(rows, [correction(0.01, 0.1, 0.01)])
    for name in SAMPLE_DTYPE.names or ():
        if name not in ("c_rr", "grade_e", "grade_n"):
            assert out[name].tobytes() == rows[name].tobytes(), name


def test_where_the_scale_is_not_known_samples_on_slopes_keep_their_resistance() -> None:
    rows = drive(RAMP, Errors(zero=0.004, scale=0.05), seed=1)
    out = corrected(rows, [correction(0.004, most=LEVEL_SHARE)])
    steep = np.abs(rows["grade_e"]) > 0.2
    assert steep.sum() > 100
    assert out["c_rr"][steep].tobytes() == rows["c_rr"][steep].tobytes()
    assert (out["c_rr"][np.abs(rows["grade_e"]) < 0.02] != rows["c_rr"][np.abs(rows["grade_e"]) < 0.02]).mean() > 0.7


def test_headings_are_those_of_the_table() -> None:
    angles: Floats = np.linspace(-7, 7, 20_001)
    rows = np.zeros(len(angles), SAMPLE_DTYPE)
    rows["heading_rad"], rows["speed_mps"] = angles, 1.0
    out = corrected(rows, [correction(1.0)])
    assert np.abs(out["grade_e"] - np.cos(angles)).max() < np.pi / HEADINGS + 1e-5
    assert np.abs(out["grade_n"] - np.sin(angles)).max() < np.pi / HEADINGS + 1e-5


# --- all machines ----------------------------------------------------------------------------------------------------

MANY = [
    Correction("a", 0, START_NS + 600 * 10**9, 0.01, 0.03, 0.002, ()),
    Correction("a", START_NS + 600 * 10**9, 2**62, -0.01, 0.0, 0.0, (), LEVEL_SHARE),
    Correction("b", START_NS + 300 * 10**9, START_NS + 900 * 10**9, 0.002, -0.1, 0.0, ()),
]


def test_samples_of_all_machines_are_corrected_as_those_of_each():
    rows, draw = wild(7), np.random.default_rng(7)
    rows["stamp_ns"] = START_NS + draw.integers(0, 1800, len(rows)) * 10**9
    machine = draw.integers(0, 3, len(rows))
    out = Corrections(MANY).applied(rows, ["c", "b", "a"], machine)
    for index, name in enumerate("cba"):
        own = [each for each in MANY if each.machine == name]
        assert out[machine == index].tobytes() == corrected(rows[machine == index], own).tobytes()
    assert out[machine == 0].tobytes() == rows[machine == 0].tobytes()
    assert (out[machine == 2] != rows[machine == 2]).any()
    halves = [Corrections(MANY[::-1]).applied(rows[i::2], ["c", "b", "a"], machine[i::2]) for i in (0, 1)]
    assert [half.tobytes() for half in halves] == [out[i::2].tobytes() for i in (0, 1)]


def test_corrections_of_others_leave_the_samples_alone():
    rows = wild(1)
    assert Corrections(MANY).applied(rows, ["c"], np.zeros(len(rows), np.int64)) is rows
    assert Corrections().applied(rows, ["a"], np.zeros(len(rows), np.int64)) is rows


def test_equal_corrections_are_those_that_do_the_same():
    assert Corrections(MANY) == Corrections(MANY[::-1])
    assert len({Corrections(MANY), Corrections(MANY[::-1]), Corrections()}) == 2
    less_sure = [replace(each, covariance=((1.0,),)) for each in MANY]
    assert Corrections(less_sure) == Corrections(MANY)
    for changed in (
        {"machine": "d"},
        {"zero": 0.02},
        {"scale": 0.02},
        {"across": 0.02},
        {"most_share": 0.2},
        {"to_ns": 9},
    ):
        assert Corrections([replace(MANY[0], **changed), *MANY[1:]]) != Corrections(MANY)
    assert Corrections() != MANY


def test_a_digest_before_a_time_is_of_what_is_done_until_then():
    some, later = Corrections(MANY), Correction("b", START_NS + 900 * 10**9, 2**62, 0.5, 0.0, 0.0, ())
    more = Corrections([*MANY, later])
    assert more.digest() != some.digest()
    assert more.digest(START_NS + 900 * 10**9) == some.digest(START_NS + 900 * 10**9)
    assert more.digest(START_NS + 900 * 10**9 + 1) != some.digest(START_NS + 900 * 10**9 + 1)
    cut = [replace(MANY[0], to_ns=START_NS + 200 * 10**9), *MANY[1:]]
    assert Corrections(cut).digest(START_NS + 200 * 10**9) == some.digest(START_NS + 200 * 10**9)
    assert Corrections(MANY[1:]).digest(START_NS) == Corrections().digest() == ""
