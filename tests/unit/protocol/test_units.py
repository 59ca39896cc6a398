import math

import pytest

from protocol.units import factor, stamp_ns, stamp_scale


@pytest.mark.parametrize(
    ("unit", "field", "expected"),
    [
        ("deg", "angle_rad", math.pi / 180),
        ("deg", "lat_deg", 1.0),
        ("deg/s", "gyro_x_radps", math.pi / 180),
        ("deg2", "var_yaw_rad2", (math.pi / 180) ** 2),
        ("km/h", "speed_x_mps", 1 / 3.6),
        ("g", "force_z_mps2", 9.80665),
        ("kNm", "torque_nm", 1000.0),
        ("t", "payload_kg", 1000.0),
    ],
)
def test_factor(unit, field, expected):
    assert factor(unit, field) == pytest.approx(expected, rel=1e-15)


@pytest.mark.parametrize(("unit", "field"), [("m", "angle_rad"), ("deg", "var_e_m2"), ("g", "torque_nm")])
def test_unit_of_another_quantity_is_refused(unit, field):
    with pytest.raises(ValueError, match=f"`{unit}` does not fit `{field}`"):
        factor(unit, field)


def test_whole_stamps_are_exact_and_others_rounded():
    assert stamp_ns("1750000000000000001", 1) == 1_750_000_000_000_000_001
    assert stamp_ns("3", stamp_scale("s")) == 3_000_000_000
    assert stamp_ns("0.0000000006", stamp_scale("s")) == 1
    with pytest.raises(ValueError, match="no unit of time"):
        stamp_scale("deg")
