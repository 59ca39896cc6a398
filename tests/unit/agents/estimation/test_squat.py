import math
from dataclasses import replace

import pytest

from agents.estimation.squat import front_share, squat_rad
from protocol.machine.machine_config import MachineConfig
from protocol.units import GRAVITY_MPS2

LOADER = MachineConfig(
    "loader-1",
    mass_kg=17_500,
    load_centre_m=1.5,
    wheelbase_m=3.0,
    axle_stiffness_npm=1.8e6,
    cog_height_m=1.0,
    payload_x_m=4.7,
    payload_z_m=0.85,
)


@pytest.mark.parametrize(
    ("payload_kg", "force_mps2", "share"),
    [
        (0.0, 0.0, 0.5),  # the load centre lies in the middle
        (4000.0, 0.0, (17_500 * 1.5 + 4000 * 4.7) / (21_500 * 3.0)),
        (
            0.0,
            2.0,
            0.5 - 2.0 / math.sqrt(GRAVITY_MPS2**2 - 4) / 3.0,
        ),  # uphill, or faster: to the rear
        (0.0, -2.0, 0.5 + 2.0 / math.sqrt(GRAVITY_MPS2**2 - 4) / 3.0),
    ],
)
def test_share_on_the_front_axle(payload_kg: float, force_mps2: float, share: float) -> None:
    assert front_share(LOADER, payload_kg, force_mps2) == pytest.approx(share)
    assert front_share(replace(LOADER, wheelbase_m=0.0), payload_kg, force_mps2) == 0.0


def test_empty_machine_at_rest_stands_level() -> None:
    assert squat_rad(LOADER, 0.0, 0.0) == 0.0


def test_payload_ahead_of_the_front_axle_lowers_the_nose() -> None:
    """By hand: 4000 kg at 4.7 m put 61.5 kN on the front axle and take 22.2 kN off the rear one."""
    front_n, rear_n = 4000 * GRAVITY_MPS2 * 4.7 / 3.0, 4000 * GRAVITY_MPS2 * (1 - 4.7 / 3.0)
    assert (front_n, rear_n) == pytest.approx((61_455, -22_228), abs=1)
    assert squat_rad(LOADER, 4000, 0.0) == pytest.approx((rear_n - front_n) / (1.8e6 * 3.0))
    assert squat_rad(LOADER, 4000, 0.0) == pytest.approx(-0.015497, abs=1e-6)


def test_acceleration_raises_the_nose() -> None:
    """By hand: 17.5 t at 2 m/s2, 1 m above the ground, shift 11.67 kN from the front axle to the rear one."""
    assert squat_rad(LOADER, 0.0, 2.0) == pytest.approx(2 * 17_500 * 2.0 * 1.0 / 3.0 / (1.8e6 * 3.0), abs=1e-9)
    assert squat_rad(LOADER, 0.0, -2.0) == -squat_rad(LOADER, 0.0, 2.0)


def test_payload_s_height_counts_with_acceleration() -> None:
    more = squat_rad(LOADER, 4000, 2.0) - squat_rad(LOADER, 4000, -2.0)
    assert more == pytest.approx(2 * 2 * 2.0 * (17_500 * 1.0 + 4000 * 0.85) / 3.0 / (1.8e6 * 3.0))


def test_on_a_slope_less_weight_presses_the_tyres() -> None:
    """A machine with its weight at the rear: its squat on level ground is subtracted, what it loses uphill is not."""
    rear_heavy = replace(LOADER, load_centre_m=1.0, cog_height_m=0.0)
    slope_rad = math.radians(20)
    squat = squat_rad(rear_heavy, 0.0, GRAVITY_MPS2 * math.sin(slope_rad))
    weight_n = 17_500 * GRAVITY_MPS2
    assert squat == pytest.approx(weight_n * (2 / 3 - 1 / 3) * (math.cos(slope_rad) - 1) / (1.8e6 * 3.0))


@pytest.mark.parametrize("unknown", ["wheelbase_m", "axle_stiffness_npm"])
def test_without_data_there_is_no_squat(unknown: str) -> None:
    assert squat_rad(replace(LOADER, **{unknown: 0.0}), 4000, 2.0) == 0.0  # type: ignore[arg-type]
    assert squat_rad(MachineConfig("loader-1"), 4000, 2.0) == 0.0


def test_force_beyond_gravity_is_survived() -> None:
    assert math.isfinite(squat_rad(LOADER, 4000, 30.0))
