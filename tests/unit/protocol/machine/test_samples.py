import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.errors import MessageError, Refusal
from protocol.machine.samples import COLUMNS, LIMITS, check_samples, content_hash, empty


def good(n: int) -> np.ndarray:
    rows = empty(n)
    rows["stamp_ns"] = 1
    return rows


def test_no_samples_and_zeros_are_good():
    check_samples(empty(), 100.0)
    check_samples(good(3), 100.0)


@pytest.mark.parametrize("name", LIMITS)
def test_limits_are_inclusive(name):
    for value in LIMITS[name]:
        rows = good(1)
        rows[name] = value
        if name == "cov_xy_m2":
            rows["cov_xx_m2"] = rows["cov_yy_m2"] = 1e6
        check_samples(rows, 100.0)


def test_first_bad_row_is_named():
    rows = good(5)
    rows["c_rr"][[2, 4]] = 9.0
    with pytest.raises(MessageError) as caught:
        check_samples(rows, 100.0)
    assert (caught.value.field, caught.value.row, caught.value.reason) == ("c_rr", 2, Refusal.OUT_OF_RANGE)


@given(st.floats(0.0, 1e5, width=32), st.floats(0.0, 1e5, width=32), st.floats(-1, 1))
def test_covariance_of_any_correlation_is_good_in_single_precision(xx, yy, correlation):
    rows = good(1)
    rows["cov_xx_m2"], rows["cov_yy_m2"] = xx, yy
    rows["cov_xy_m2"] = correlation * np.sqrt(float(np.float32(xx)) * float(np.float32(yy)))
    check_samples(rows, 100.0)


@given(
    st.floats(2.0**-20, 2.0**10, width=32), st.floats(2.0**-20, 2.0**10, width=32), st.sampled_from([-1.01, 1.01, 5])
)
def test_covariance_beyond_full_correlation_is_refused(xx, yy, correlation):
    rows = good(1)
    rows["cov_xx_m2"], rows["cov_yy_m2"] = xx, yy
    rows["cov_xy_m2"] = correlation * np.sqrt(xx * yy)
    with pytest.raises(MessageError, match="semidefinite"):
        check_samples(rows, 100.0)


@pytest.mark.parametrize("group", [("c_rr", "c_rr_var"), ("grade_e", "grade_n", "grade_var")])
def test_unknown_means_all_of_a_group(group):
    for name in group:
        rows = good(2)
        rows[name][1] = np.nan
        with pytest.raises(MessageError, match="must be NaN together") as caught:
            check_samples(rows, 100.0)
        assert (caught.value.reason, caught.value.row) == (Refusal.NOT_FINITE, 1)
    rows = good(2)
    for name in group:
        rows[name][1] = np.nan
    check_samples(rows, 100.0)


def test_hash_tells_samples_apart():
    rows = good(2)
    assert content_hash(rows[0]) == content_hash(rows[1])
    for name in COLUMNS:
        changed = good(1)
        changed[name] = 2
        assert content_hash(changed[0]) != content_hash(rows[0])
