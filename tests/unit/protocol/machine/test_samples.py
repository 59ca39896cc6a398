import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from protocol.errors import MessageError
from protocol.machine.samples import COLUMNS, LIMITS, check_samples, content_hash, empty


def good(n: int) -> np.ndarray:
    rows = empty(n)
    rows["stamp_ns"] = 1
    return rows


@pytest.mark.parametrize("name", LIMITS)
def test_limits_are_inclusive(name):
    for value in LIMITS[name]:
        rows = good(1)
        rows[name] = value
        if name == "cov_xy_m2":
            rows["cov_xx_m2"] = rows["cov_yy_m2"] = 1e6
        check_samples(rows, 100.0)


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


def test_hash_tells_samples_apart():
    rows = good(2)
    assert content_hash(rows[0]) == content_hash(rows[1])
    for name in COLUMNS:
        changed = good(1)
        changed[name] = 2
        assert content_hash(changed[0]) != content_hash(rows[0])
