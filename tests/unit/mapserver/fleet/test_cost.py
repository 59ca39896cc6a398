"""Ten machines that drive all day cost no more than they may."""

import time

import pytest

from mapserver.fleet.calibration import calibrate
from mapserver.fleet.ledger import EPOCHS, Ledger
from tests.unit.mapserver.fleet.drives import LOW, RAMP, RAMP_AGAIN, Errors, drive

MACHINES, HOURS = 10, 8
MOST_BYTES = 50e6
MOST_S = 10.0  # twice the goal: processor time itself doubles on a loaded machine


@pytest.mark.slow
def test_ten_machines_for_a_day_take_little_memory_and_time() -> None:
    ledgers = {f"m{i}": Ledger() for i in range(MACHINES)}
    for i, ledger in enumerate(ledgers.values()):
        route = (LOW, RAMP, RAMP_AGAIN)[i % 3]
        for hour in range(HOURS):
            errors = Errors(0.001 * i, 0.01 * i)
            ledger.add(drive(route, errors, seconds=3600.0, seed=100 * i + hour, start_s=3600.0 * hour, late=False))
    stays = {name: ledger.stays() for name, ledger in ledgers.items()}
    assert sum(ledger.nbytes for ledger in ledgers.values()) < MOST_BYTES
    began_s = time.process_time()
    result = calibrate(stays)
    assert time.process_time() - began_s < MOST_S
    assert len(result.corrections) == MACHINES * EPOCHS
