"""Differential and relative sensors (Moore & Stouch 2014, robot_localization: `differential`, `relative`).

Differential: two values give a rate. Relative: the first value stands for the belief then, its anchor; later ones count
from it. In robot_localization the start is zero by definition, so the anchor is exact. Here the belief may improve, so
an anchor's error has states where there is room.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from agents.localisation.filters.belief import Belief, Conditioned, Measurement
from protocol.arrays import Floats
from protocol.machine.machine_config import RELATIVE, SensorConfig
from protocol.rotations import wrap_angle

PAIR_S = 1.1  # longest pair; 1 Hz receivers still pair


@dataclass(frozen=True)
class StampedValue:
    """Sensor values (k,) with variances (k,) at a stamp."""

    stamp_ns: int
    values: Floats
    variances: Floats


def rate_between(before: StampedValue, now: StampedValue, *, angles: bool = False) -> StampedValue | None:
    """Mean rate between two values, at their middle, where it is right to second order.

    None if more than PAIR_S apart or out of order. angles: values in rad.
    """
    dt_s = (now.stamp_ns - before.stamp_ns) * 1e-9
    if not 0 < dt_s <= PAIR_S:
        return None
    change = now.values - before.values
    if angles:
        change = wrap_angle(change)
    middle_ns = (before.stamp_ns + now.stamp_ns) // 2
    return StampedValue(middle_ns, change / dt_s, (before.variances + now.variances) / dt_s**2)


class Measured(Protocol):
    """A stamped sensor value."""

    @property
    def stamp_ns(self) -> int:
        """Stamp of the measurement."""

    @property
    def sensor(self) -> SensorConfig:
        """The sensor."""


Value = TypeVar("Value", bound=Measured)


class ModalSensors(ABC, Generic[Value]):
    """Sensors whose values become measurements at their own stamps, by mode."""

    def __init__(self) -> None:
        self._confirmed: set[str] = set()
        self._last: dict[str, StampedValue] = {}  # of differential ones

    def needs_anchor(self, value: Value) -> bool:
        """Whether it is a relative sensor's first accepted value."""
        return value.sensor.mode == RELATIVE and value.sensor.name not in self._confirmed

    @abstractmethod
    def anchor(self, value: Value, belief: Belief) -> None:
        """Anchor a relative sensor at this value and belief."""

    @abstractmethod
    def measurement(self, value: Value) -> Measurement | None:
        """The measurement of this value; None for a differential sensor without a pair."""

    def confirm(self, value: Value, _: Conditioned) -> None:
        """Keep the anchor: the filter had room for its measurement."""
        self._confirmed.add(value.sensor.name)

    def _rate(self, name: str, now: StampedValue, *, angles: bool = False) -> StampedValue | None:
        """Rate since the sensor's last value; out-of-order values are dropped."""
        before = self._last.get(name, now)
        if now.stamp_ns < before.stamp_ns:
            return None
        self._last[name] = now
        return rate_between(before, now, angles=angles)
