"""Ten machines that drive all day cost no more than they may."""

import time
import tracemalloc

import pytest

from mapserver.fleet.calibration import MOST_EPOCHS, MOST_MACHINES, calibrate, epochs_of_each, groups, joined
from mapserver.fleet.ledger import EPOCHS, Ledger, newest
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


@pytest.mark.slow
def test_a_hundred_machines_take_a_minute_and_a_gigabyte_at_most() -> None:
    """What they know of four hours each is bounded: of all together a solve takes so many epochs."""
    routes = (LOW, RAMP, RAMP_AGAIN)
    tables = [Ledger() for _ in routes]
    for i, (route, ledger) in enumerate(zip(routes, tables, strict=True)):
        ledger.add(drive(route, Errors(0.002 * i, 0.02 * i), seconds=4 * 3600.0, seed=i, late=False))
    stays = {f"m{i:03d}": tables[i % 3].stays() for i in range(MOST_MACHINES)}
    tracemalloc.start()
    began_s = time.process_time()
    result = calibrate(stays)
    took_s, most_bytes = time.process_time() - began_s, tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert took_s < 60.0
    assert most_bytes < 0.7e9  # beside what the program itself takes
    assert len(result.corrections) == MOST_EPOCHS
    assert result.common.observed
    one = calibrate({name: newest(stays[name], epochs_of_each(3)) for name in ("m000", "m001", "m002")})
    assert result.machines["m001"].zero == pytest.approx(one.machines["m001"].zero, abs=0.002)


def test_more_machines_are_solved_in_groups() -> None:
    names = [f"m{i:03d}" for i in range(2 * MOST_MACHINES + 1)]
    assert groups([]) == [()]
    assert groups(names[:MOST_MACHINES]) == [tuple(names[:MOST_MACHINES])]
    some = groups(reversed(names))
    assert (len(some), sorted(name for group in some for name in group)) == (3, names)
    assert [epochs_of_each(n) for n in (0, 1, 20, 21, 100, 5000)] == [EPOCHS, EPOCHS, EPOCHS, 47, 10, 10]


def test_what_groups_say_is_joined_and_the_common_scale_is_the_least_known() -> None:
    stays = {}
    for name, route in (("a", LOW), ("b", RAMP)):
        ledger = Ledger()
        ledger.add(drive(route, Errors(0.004, 0.03)))
        stays[name] = ledger.stays()
    parts = [calibrate({name: table}) for name, table in stays.items()]
    whole = joined(parts)
    assert {*whole.machines} == {*whole.stated} == {one.machine for one in whole.corrections} == {"a", "b"}
    assert whole.machines["b"] == parts[1].machines["b"]
    assert parts[1].common.observed
    assert whole.common == parts[0].common
