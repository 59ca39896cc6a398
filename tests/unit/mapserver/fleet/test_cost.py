"""What machines that drive all day, and large fleets, take of memory; lab speed measures the time."""

import tracemalloc

import pytest

from mapserver.fleet.calibration import MOST_EPOCHS, MOST_MACHINES, calibrate, epochs_of_each, groups, joined
from mapserver.fleet.ledger import EPOCHS, Ledger, newest
from tests.unit.mapserver.fleet.drives import LOW, RAMP, RAMP_AGAIN, Errors, drive

ROUTES = (LOW, RAMP, RAMP_AGAIN)


@pytest.mark.slow
def test_a_machine_that_drives_all_day_takes_little_memory() -> None:
    ledger = Ledger()
    for hour in range(8):
        ledger.add(drive(RAMP, Errors(0.001, 0.01), seconds=3600.0, seed=hour, start_s=3600.0 * hour, late=False))
    stays = ledger.stays()
    assert ledger.nbytes < 5e6
    assert len(calibrate({"a": stays}).corrections) == EPOCHS


@pytest.mark.nightly
def test_a_hundred_machines_take_a_gigabyte_at_most() -> None:
    """What they know of four hours each is bounded: of all together a solve takes so many epochs."""
    tables = [Ledger() for _ in ROUTES]
    for i, (route, ledger) in enumerate(zip(ROUTES, tables, strict=True)):
        ledger.add(drive(route, Errors(0.002 * i, 0.02 * i), seconds=4 * 3600.0, seed=i, late=False))
    stays = {f"m{i:03d}": tables[i % 3].stays() for i in range(MOST_MACHINES)}
    tracemalloc.start()
    result = calibrate(stays)
    most_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
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
