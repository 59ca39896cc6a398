"""The paper's table: its rows, its figures, and how a row becomes a machine and options."""

import pytest

from agents.pipeline import PipelineConfig
from evaluation.campaign.recordings import PlannedDrive
from evaluation.positions.configurations import (
    FILTERS,
    HEADLINE,
    PAPER_NET_M,
    PROFILES,
    SENSORS,
    Configuration,
    UnsupportedError,
    configurations,
    configure,
    pipeline_options,
    select,
    started_at,
)

ROW = Configuration("ukf", 2, 1, "default")


def used(machine):
    return [s.name for s in machine.sensors if s.use]


def test_the_table_has_every_configuration_of_the_paper_in_both_profiles_and_one_more():
    rows = configurations()
    assert len(rows) == len(set(rows)) == len(SENSORS) * len(FILTERS) * len(PROFILES) == 36
    assert {(r.filter, r.gps, r.imu) for r in rows} == set(PAPER_NET_M) | {("ekf", 3, 1), ("ukf", 3, 1)}
    assert len(PAPER_NET_M) == 16
    assert {(r.gps, r.imu) for r in configurations(HEADLINE)} == {(1, 1), (2, 1), (3, 1)}
    assert Configuration("ukf", 3, 1, "paper").published_net_m is None


def test_sensors_of_a_row_are_in_use_and_no_others():
    machine = PlannedDrive(0, 1.0).machine
    rest = {"torque", "wheels", "articulation"}
    assert set(used(select(machine, 2, 1))) == rest | {"imu-3", "attitude-3", "gps-1", "gps-2"}
    assert set(used(select(machine, 0, 3))) == rest | {f"{k}-{i}" for k in ("imu", "attitude") for i in (1, 3, 4)}
    assert used(select(machine)) == used(machine)


def test_more_receivers_than_there_are_is_refused():
    with pytest.raises(UnsupportedError, match="3 GPS receivers, not 4"):
        select(PlannedDrive(0, 1.0).machine, gps=4)


def test_without_gps_the_start_is_given():
    options = started_at(pipeline_options(Configuration("ukf", 0, 1, "default")), (1.0, 2.0, 0.5))
    assert options.localisation.start == (1.0, 2.0, 0.5)
    assert options.localisation.filter == "ukf"


@pytest.mark.parametrize("filter_", FILTERS)
@pytest.mark.parametrize("profile", PROFILES)
def test_filter_and_profile_reach_the_pipeline(filter_: str, profile: str):
    options = pipeline_options(Configuration(filter_, 1, 1, profile))
    assert (options.localisation.filter, options.localisation.profile) == (filter_, profile)


def test_a_row_becomes_a_machine_and_options():
    machine, options = configure(PlannedDrive(0, 1.0).machine, ROW)
    assert isinstance(options, PipelineConfig)
    assert {s.name for s in machine.sensors if s.kind == "gps" and s.use} == {"gps-1", "gps-2"}
