"""Differential and relative sensors (Moore & Stouch 2014, robot_localization: `differential`, `relative`).

Differential: two successive values make a rate of change. Relative: the first value stands for what the filter
believes at that moment, its anchor; later values count from there. In robot_localization the anchor is exact, as the
start is zero by definition. Here the filter may be unsure of it and learn better later, so where the state has room an
anchor gets states of its own: how far off the filter was at that moment.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from agents.localisation.filters.belief import Belief, Conditioned, Measurement
from protocol.arrays import Floats
from protocol.machine.machine_config import RELATIVE, SensorConfig
from protocol.rotations import wrap_angle

PAIR_S = 1.1  # a mean over more is far from the rate at its middle; a receiver of 1 Hz still makes pairs


@dataclass(frozen=True)
class StampedValue:
    """Values (k,) of a sensor and their variances (k,) at a stamp."""

    stamp_ns: int
    values: Floats
    variances: Floats


def rate_between(before: StampedValue, now: StampedValue, *, angles: bool = False) -> StampedValue | None:
    """Mean rate of change between two values, at the middle of their time, where it is right to second order.

    None where they are more than PAIR_S apart, or not in order. angles: the values are angles [rad].
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
    """A value of a sensor at a stamp."""

    @property
    def stamp_ns(self) -> int:
        """When it was measured."""

    @property
    def sensor(self) -> SensorConfig:
        """What measured it."""


Value = TypeVar("Value", bound=Measured)


class ModalSensors(ABC, Generic[Value]):
    """Sensors whose values become measurements of their own stamps, each in its mode."""

    def __init__(self) -> None:
        self._confirmed: set[str] = set()
        self._last: dict[str, StampedValue] = {}  # of differential ones

    def needs_anchor(self, value: Value) -> bool:
        """Whether it is a first value of a relative sensor; one that was refused as too late does not count."""
        return value.sensor.mode == RELATIVE and value.sensor.name not in self._confirmed

    @abstractmethod
    def anchor(self, value: Value, belief: Belief) -> None:
        """Let a relative sensor count from this value, and from the belief at its stamp."""

    @abstractmethod
    def measurement(self, value: Value) -> Measurement | None:
        """What the filter gets of this value; None where a differential sensor has no pair."""

    def confirm(self, value: Value, _: Conditioned) -> None:
        """Keep the anchor: the filter had room for a measurement that counts from it."""
        self._confirmed.add(value.sensor.name)

    def _rate(self, name: str, now: StampedValue, *, angles: bool = False) -> StampedValue | None:
        """Rate since the last value of a sensor, which this one becomes; values out of order are dropped."""
        before = self._last.get(name, now)
        if now.stamp_ns < before.stamp_ns:
            return None
        self._last[name] = now
        return rate_between(before, now, angles=angles)
