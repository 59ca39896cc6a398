import math

import numpy as np
import pytest

from sim.machines.chassis import chassis_of, drive_force_n, steering_radps, weigh
from sim.machines.model import MachineModel
from sim.state import STEP_S
from tests.unit.sim.planes import BOTH, LOADER, nominal


@BOTH
def test_weight_follows_the_model_at_any_load(model: MachineModel) -> None:
    for payload in (0.0, 1234.0, model.payload_kg):
        weight = weigh(chassis_of([model]), nominal(model), np.array([payload]))
        assert weight.mass_kg[0] == pytest.approx(model.mass_kg + payload)
        assert weight.front_share[0] == pytest.approx(model.front_share(payload))
        assert weight.centre_height_m[0] == pytest.approx(model.centre_height_m(payload))


def test_hydraulics_and_engine_follow_with_their_lags_and_limits() -> None:
    chassis, zero = chassis_of([LOADER]), np.zeros(1)
    rate, angle, drive = zero, zero, zero
    for _ in range(8):  # one lag of the steering
        rate = steering_radps(chassis, np.array([9.0]), zero, rate)
    assert rate[0] / LOADER.steer_radps == pytest.approx(1 - math.exp(-1), abs=0.03)
    for _ in range(1000):
        rate = steering_radps(chassis, np.array([9.0]), angle, rate)
        angle = angle + STEP_S * rate
        assert angle[0] <= LOADER.max_articulation_rad + 1e-9
    assert angle[0] == pytest.approx(LOADER.max_articulation_rad)
    for _ in range(15):  # one lag of the engine
        drive = drive_force_n(chassis, np.array([-9e3]), drive, np.array([8e3]))
    assert drive[0] / -9e3 == pytest.approx(1 - math.exp(-1), abs=0.03)
    for _ in range(60):
        drive = drive_force_n(chassis, np.array([-9e3]), drive, np.array([8e3]))
    assert drive[0] == -8e3
