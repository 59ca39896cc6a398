"""The paper's table: rows, figures, conversion to machine and options."""

from lab.campaign.recordings import PlannedDrive
from lab.positions import configurations as table
from lab.positions import published
from lab.positions.configurations import Configuration
from sitegrid.logs.sensors import select


def used(machine):
    return [s.name for s in machine.sensors if s.use]


def test_the_table_has_every_configuration_of_the_paper_in_both_profiles_and_one_more():
    rows = table.configurations()
    assert len(rows) == len(set(rows)) == len(table.SENSORS) * len(table.FILTERS) * len(table.PROFILES) == 36
    assert {(r.filter, r.gps, r.imu) for r in rows} == set(published.POSITIONS) | {("ekf", 3, 1), ("ukf", 3, 1)}
    assert len(published.POSITIONS) == 16
    assert {(r.gps, r.imu) for r in table.configurations(table.HEADLINE)} == {(1, 1), (2, 1), (3, 1)}
    assert Configuration("ukf", 3, 1, "paper").published_net_m is None


def test_sensors_of_a_row_are_in_use_and_no_others():
    machine = PlannedDrive(0, 1.0).machine
    rest = {"torque", "wheels", "articulation"}
    assert set(used(select(machine, 2, 1))) == rest | {"imu-3", "attitude-3", "gps-1", "gps-2"}
    assert set(used(select(machine, 0, 3))) == rest | {f"{k}-{i}" for k in ("imu", "attitude") for i in (1, 3, 4)}
    assert used(select(machine)) == used(machine)
