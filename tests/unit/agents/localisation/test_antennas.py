"""Antennas away from their mounts are named, others never."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from agents.localisation.antennas import Trial
from agents.positioning import PipelineConfig, Positioning
from protocol.machine.machine_config import MachineConfig, Mount, SensorConfig
from protocol.machine.readings import Gps, Reading
from tests.unit.agents.drives import S_BEND, SITE, Leg, changed_sensor, drive, with_ahrs

RTK, ALONE = 0.02, 1.5  # std of fixes [m]
FRONT, REAR = Mount((1.2, 0.0, 3.0)), Mount((-0.8, 0.0, 3.0))
TRUE = MachineConfig(
    "truck-1",
    sensors=(
        SensorConfig("gps-1", "gps", FRONT),
        SensorConfig("gps-2", "gps", REAR),
        SensorConfig("imu", "imu"),
        SensorConfig("wheels", "encoder"),
    ),
)
BACK_AND_FORTH = (Leg(4, 1.0), Leg(4), Leg(4, -1.0), Leg(4, -1.0), Leg(6), Leg(4, 1.0))


def problems(machine: MachineConfig, readings: Sequence[Reading]) -> dict[str, str]:
    positioning = Positioning(SITE, machine, PipelineConfig())
    positioning.step(readings)
    return positioning.faults


def noisy_fixes(readings: Sequence[Reading], std_m: float, off_m: float = 0.0, seed: int = 5) -> list[Reading]:
    """Fixes of this std; gps-2 has a slow error to the north."""
    rng = np.random.default_rng(seed)

    def noised(r: Gps) -> Gps:
        north_m = 0.5 * std_m * rng.standard_normal() + (off_m if r.sensor == "gps-2" else 0.0)
        return replace(r, lat_deg=r.lat_deg + north_m / 111_200, var_e_m2=std_m**2, var_n_m2=std_m**2)

    return [noised(r) if isinstance(r, Gps) else r for r in readings]


def mounted(first: Mount, second: Mount) -> MachineConfig:
    return changed_sensor(changed_sensor(TRUE, "gps-1", mount=first), "gps-2", mount=second)


@pytest.mark.parametrize(
    "legs", [pytest.param(S_BEND, marks=pytest.mark.nightly), BACK_AND_FORTH], ids=["ahead", "in reverse too"]
)
@pytest.mark.parametrize(
    ("believed", "sentence"),
    [
        (TRUE, ""),
        (mounted(REAR, FRONT), "and gps-1 sit the other way round than their mounts say: exchange their addresses"),
        (
            mounted(FRONT, Mount((1.2, 2.0, 3.0))),
            "lies -2.0 m ahead and 0.0 m left of gps-1, by the mounts 0.0 and 2.0: measure both",
        ),
    ],
    ids=["right", "exchanged", "across"],
)
def test_two_antennas_that_sit_otherwise_than_stated_are_named(
    legs: tuple[Leg, ...], believed: MachineConfig, sentence: str
) -> None:
    shown = problems(believed, noisy_fixes(drive((*legs, *legs), TRUE).readings, RTK))
    assert sentence.replace("-0.0", "0.0") in shown.get("gps-2", "").replace("-0.0", "0.0")
    assert bool(sentence) == bool(shown)


def test_fixes_of_metres_name_nothing_before_their_error_has_faded() -> None:
    readings = noisy_fixes(drive(S_BEND * 2, TRUE).readings, ALONE, off_m=2.5)
    assert not problems(mounted(REAR, FRONT), readings)
    assert [minutes_until_named(apart_m) for apart_m in (2.0, 3.0)] == [7, 3], "as docs/receivers.md says"


def minutes_until_named(apart_m: float) -> int:
    """Two swapped antennas, a stretch per 3 s; variances of both, both axes."""
    variance = 2 * 2 * ALONE**2
    trial = Trial(apart_m, white=0.25 * variance, slow=0.75 * variance, slow_s=45.0)
    while trial.wrong is None:
        trial.shown, trial.n = -15 * apart_m + 0j, 15
        trial.finish(1 + 0j, 3.0)
    return int(trial.driven_s / 60)


@pytest.mark.parametrize(("off_deg", "sentence"), [(0, ""), (30, ""), (180, "exchange its two antennas"), (90, "left")])
def test_a_heading_that_points_elsewhere_than_the_machine_drives_is_named(off_deg: float, sentence: str) -> None:
    machine = replace(TRUE, sensors=(*TRUE.sensors[:1], *TRUE.sensors[2:], SensorConfig("ahrs", "attitude")))
    readings = with_ahrs(drive(S_BEND, machine), off_rad=np.radians(off_deg))
    shown = problems(machine, noisy_fixes(readings, RTK))
    assert sentence in shown.get("ahrs", "")
    assert bool(sentence) == bool(shown)


def test_without_wheels_and_accelerometer_nobody_knows_what_is_ahead() -> None:
    believed = mounted(REAR, FRONT)
    blind = replace(believed, sensors=believed.sensors[:2])
    readings = [r for r in drive(S_BEND, TRUE).readings if isinstance(r, Gps)]
    assert not problems(blind, noisy_fixes(readings, RTK))
