"""Drive trains with a diesel, a converter and gears: from wheels that turn and are driven back to the engine.

The worlds know forces at the wheels alone. What engine, gearbox and brakes do for them is worked out here, as their
controllers would state it. With gear and final drive i, efficiency eta, the converter's torque ratio k, and losses,

    engine torque = wheel torque / (i eta k) + losses        ahead
    wheel torque = -losses i / eta                           at most, of an engine that brakes; retarder, then brakes
"""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import numpy as np

from protocol.arrays import Bools, Floats, Ints
from protocol.config import require_between
from protocol.machine.powertrain_config import PowertrainConfig
from protocol.units import DIESEL_J_PER_L
from sim.state import STEP_S

INDICATED_EFFICIENCY = 0.46  # of the burning in a diesel, before its friction; the best ones brake at 0.42
SHIFT_STEPS = round(0.6 / STEP_S)  # a change of gears under load
HELD_STEPS = round(2.0 / STEP_S)  # from one change to the next
STANDS_RADPS = 0.03  # wheels that turn slower show no direction
LOCKS = 1.25  # times the idle speed: the converter is locked from there on
BRAKES_FROM = 0.02  # of the engine's full torque at the wheels: less is not felt at the pedal; assumed


@dataclass(frozen=True)
class DriveTrain:
    """Drive train of a kind of machine; `sim/machines/*.toml` explain the values.

    data_sheet: what an agent may know; its `losses` are those at shift_up_rpm. stall_rpm, stall_ratio: of the
    converter, engine speed and torque ratio against wheels that stand.
    hydraulics: the most that pumps beside the wheels take, as a share of the reference torque.
    """

    data_sheet: PowertrainConfig
    idle_rpm: float
    shift_down_rpm: float
    shift_up_rpm: float
    stall_rpm: float
    stall_ratio: float
    hydraulics: float

    def __post_init__(self) -> None:
        require_between(self, 1, 4, "stall_ratio")
        require_between(self, 0, 1, "hydraulics")
        if not 0 < self.idle_rpm < self.shift_down_rpm < self.shift_up_rpm:
            raise ValueError("idle_rpm, shift_down_rpm, shift_up_rpm: they do not rise")


@dataclass(frozen=True)
class Shafts:
    """What a drive train does at k instants, arrays (k,).

    torque, losses: of the engine, as shares of its reference torque, losses included. gear: from 1, -1 in reverse.
    retarder: share of its most. braked: whether service brakes help. hydraulics: see `DriveTrain`.
    """

    engine_radps: Floats
    torque: Floats
    losses: Floats
    gear: Ints
    ratio: Floats
    locked: Bools
    shifting: Bools
    retarder: Floats
    braked: Bools
    litres_ph: Floats
    hydraulics: Floats


class Gearbox:
    """An automatic one: gears by the engine's speed, the converter open where the engine would stall."""

    def __init__(self, train: DriveTrain) -> None:
        data = train.data_sheet
        self._ratios = np.array([*data.gears, *data.reverse_gears]) * data.final_drive
        self._gears, self._train = len(data.gears), train
        self._gear, self._since = 0, HELD_STEPS

    def run(self, wheel_radps: Floats) -> tuple[Ints, Floats, Bools]:
        """Gear (k,), its ratio with the final drive, and whether it is being changed."""
        gears = np.empty(len(wheel_radps), np.int64)
        since = np.empty(len(wheel_radps), np.int64)
        for i, radps in enumerate(wheel_radps.tolist()):
            wanted = self._wanted(radps)
            self._gear, self._since = wanted, (self._since + 1 if wanted == self._gear else 0)
            gears[i], since[i] = self._gear, self._since
        named = np.where(gears < self._gears, gears + 1, self._gears - 1 - gears)
        return named, self._ratios[gears], since < SHIFT_STEPS

    def _wanted(self, radps: float) -> int:
        if abs(radps) < STANDS_RADPS:
            return self._gear
        if radps < 0:
            return self._gears
        if self._gear >= self._gears:
            return 0
        rpm = radps * self._ratios[self._gear] * 30 / pi
        if self._since < HELD_STEPS:
            return self._gear
        up = rpm > self._train.shift_up_rpm and self._gear < self._gears - 1
        return self._gear + up - (rpm < self._train.shift_down_rpm and self._gear > 0)


def shafts(
    train: DriveTrain, geared: tuple[Ints, Floats, Bools], wheel_radps: Floats, torque_nm: Floats, pumps: Floats
) -> Shafts:
    """What engine and brakes do for wheels that turn so fast and have this torque together, pumps taking a share."""
    gear, ratio, shifting = geared
    data, idle, stall = train.data_sheet, train.idle_rpm * pi / 30, train.stall_rpm * pi / 30
    full_nm, handed_on = data.reference_torque_nm, ratio * data.efficiency
    drives = torque_nm * np.where(gear < 0, -1.0, 1.0) >= 0
    wheels_nm, turning = np.abs(torque_nm), np.abs(wheel_radps) * ratio
    locked = turning > LOCKS * idle
    load = np.where(drives, wheels_nm, 0.0) / (handed_on * full_nm * train.stall_ratio)
    engine = np.where(locked, turning, np.maximum(turning, idle + (stall - idle) * np.sqrt(np.minimum(load, 1.0))))
    converter = np.where(locked, 1.0, 1.0 + (train.stall_ratio - 1.0) * (1.0 - turning / engine))
    losses = data.losses * (0.5 + 0.5 * engine / (train.shift_up_rpm * pi / 30))
    # Braking: the engine first, as much as its losses take, then the retarder, then the brakes.
    dragged_nm = np.minimum(wheels_nm, losses * full_nm * ratio / data.efficiency)
    net = np.where(drives, wheels_nm / (handed_on * converter), -dragged_nm * data.efficiency / ratio) / full_nm
    rest_nm = np.where(drives, 0.0, wheels_nm - dragged_nm)
    most_nm = data.retarder_torque_nm * data.final_drive
    torque = np.maximum(net + losses + pumps, 0.0)
    return Shafts(
        engine_radps=engine,
        torque=torque,
        losses=losses,
        gear=gear,
        ratio=ratio,
        locked=locked,
        shifting=shifting,
        retarder=np.minimum(rest_nm / most_nm, 1.0) if most_nm else np.zeros_like(rest_nm),
        braked=rest_nm > most_nm + BRAKES_FROM * full_nm * ratio,
        litres_ph=torque * full_nm * engine * 3600.0 / (INDICATED_EFFICIENCY * DIESEL_J_PER_L),
        hydraulics=pumps,
    )
