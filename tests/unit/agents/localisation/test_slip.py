import numpy as np
import pytest

from agents.localisation.slip import ROLLING_S, machine_speed, rolling_resistance
from protocol.units import GRAVITY_MPS2


@pytest.mark.parametrize(
    ("wheel_mps", "traction", "speed_mps"), [(2.0, 0.1, 1.96), (-2.0, -0.1, -1.96), (2.0, -0.1, 2.04)]
)
def test_driven_wheels_turn_further_than_the_machine_moves_and_braked_ones_less(
    wheel_mps: float, traction: float, speed_mps: float
) -> None:
    assert machine_speed(wheel_mps, traction, 0.2) == pytest.approx(speed_mps)


@pytest.mark.parametrize("dt_s", [0.01, 0.05, 5.0])
def test_rolling_resistance_is_what_neither_climbs_nor_accelerates(dt_s: float) -> None:
    rolling = 0.0
    for _ in range(round(10 * ROLLING_S / dt_s) + 1):
        rolling = rolling_resistance(rolling, 0.15, 0.12 * GRAVITY_MPS2, dt_s)
    assert rolling == pytest.approx(0.03, rel=1e-3)


def test_rolling_resistance_follows_in_half_a_second() -> None:
    rolling = np.float64(0.0)
    for _ in range(round(ROLLING_S / 0.01)):
        rolling = rolling_resistance(rolling, 0.1, 0.0, 0.01)
    assert rolling == pytest.approx(0.1 * (1 - np.exp(-1)), rel=0.02)
