"""Closed loops: the accelerometer's bias from returning to a place."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest

from agents.estimation import closed_tours
from agents.estimation.balance import Balance
from agents.estimation.closed_tours import ClosedTours, Tour
from agents.localisation.filters.belief import PoseBelief
from tests.unit.agents.drives import START_NS
from tests.unit.agents.ground import STEADY

STEP_NS, SPEED_MPS, ZERO = 50_000_000, 4.0, 0.006
Place = tuple[float, float]
Height = Callable[[float, float], float]
SQUARE = ((0.0, 0.0), (90.0, 0.0), (90.0, 90.0), (0.0, 90.0), (0.0, 0.0))
LAP_M = 360.0
RISE_STD_M = math.hypot(closed_tours.CLOSING_M, closed_tours.RISE_NOISE * math.sqrt(LAP_M))


def level(x_m: float, y_m: float) -> float:
    return 0.0


def ramp(x_m: float, y_m: float) -> float:
    """6 m up from x = 30 to 60."""
    return 6.0 * min(max((x_m - 30.0) / 30.0, 0.0), 1.0)


@dataclass
class Track:
    """A machine on a polyline: balances and poses at 20 Hz."""

    height: Height = level
    zero: float = ZERO
    direction: float = 1.0
    std_m: float = 0.7

    def __post_init__(self) -> None:
        self.tours = ClosedTours()
        self.shown: list[Tour] = []
        self.stamp_ns, self.distance_m = START_NS, 0.0
        self.shift_m = (0.9, 0.9)  # pose offset: no track runs between two cells
        self.slip: Callable[[float], float] = lambda slope: 1.0  # wheel distance per metre
        self.jolts: Callable[[Place], bool] = lambda place: False

    def drive(self, *corners: Place) -> Track:
        for place, ahead in points(corners):
            self.at(place, ahead, SPEED_MPS * STEP_NS * 1e-9)
        return self

    def at(self, place: Place, ahead: Place, metres: float) -> None:
        slope = self._slope(place, ahead)
        self.stamp_ns += STEP_NS
        self.distance_m += metres * math.hypot(1.0, slope) * self.slip(slope * self.direction)
        sine = math.sin(math.atan(slope * self.direction)) - self.zero
        balance = replace(
            STEADY,
            stamp_ns=self.stamp_ns,
            distance_m=self.distance_m,
            speed_mps=self.direction * SPEED_MPS,
            sine_x=sine,
            slope_x=math.asin(sine),
        )
        self.feed(balance, place)

    def feed(self, balance: Balance, place: Place) -> None:
        x, y = place[0] + self.shift_m[0], place[1] + self.shift_m[1]
        pose = PoseBelief(self.stamp_ns, x, y, 0.0, SPEED_MPS, self.std_m**2 * np.eye(2))
        is_jolted = self.jolts(place)
        if is_jolted:  # arbitrary accelerometer value
            balance = replace(balance, sine_x=0.5)
        if tour := self.tours.update(balance, pose, is_jolted=is_jolted):
            self.shown.append(tour)

    def _slope(self, place: Place, ahead: Place) -> float:
        """Along the track."""
        (x, y), (dx, dy) = place, ahead
        return (self.height(x + 0.05 * dx, y + 0.05 * dy) - self.height(x - 0.05 * dx, y - 0.05 * dy)) / 0.1


def points(corners: tuple[Place, ...]) -> Iterator[tuple[Place, Place]]:
    """Places and directions along a polyline."""
    step = SPEED_MPS * STEP_NS * 1e-9
    for (x0, y0), (x1, y1) in pairwise(corners):
        length = math.hypot(x1 - x0, y1 - y0)
        ahead = ((x1 - x0) / length, (y1 - y0) / length)
        for i in range(round(length / step)):
            yield (x0 + ahead[0] * i * step, y0 + ahead[1] * i * step), ahead


@pytest.mark.parametrize(
    ("height", "direction", "zero"), [(level, 1.0, -0.004), (ramp, 1.0, ZERO), (ramp, -1.0, -0.004)]
)
def test_a_closed_tour_shows_the_zero_absolutely_in_either_direction(
    height: Height, direction: float, zero: float
) -> None:
    track = Track(height, zero, direction).drive(*SQUARE, (30.0, 0.0))
    assert len(track.shown) == 1
    tour = track.shown[0]
    assert tour.zero == pytest.approx(zero, abs=2e-4)
    assert tour.distance_m == pytest.approx(direction * LAP_M, abs=5.0)
    assert tour.std == pytest.approx(RISE_STD_M / LAP_M, rel=0.1)


def test_back_and_forth_encloses_nothing() -> None:
    track = Track(ramp)
    for _ in range(10):
        for track.direction, start, end in ((1.0, 0.0, 100.0), (-1.0, 100.0, 0.0)):
            track.drive((start, 0.0), (end, 0.0))
    assert not track.shown


def test_a_metre_counts_once_however_often_the_loop_is_driven() -> None:
    track = Track(ramp)
    for _ in range(5):
        track.drive(*SQUARE)
    assert len(track.shown) in (4, 5)
    assert sum(tour.distance_m for tour in track.shown) <= 5 * LAP_M
    information = sum(tour.std**-2 for tour in track.shown)
    assert information == pytest.approx(len(track.shown) * (LAP_M / RISE_STD_M) ** 2, rel=0.2)


def test_an_inner_tour_is_taken_out_of_the_outer_one() -> None:
    inner = ((90.0, 40.0), (60.0, 40.0), (60.0, 60.0), (90.0, 60.0), (90.0, 40.0))
    track = Track(ramp).drive((0.0, 0.0), (90.0, 0.0), *inner, (90.0, 90.0), (0.0, 90.0), (0.0, 0.0), (20.0, 0.0))
    first, second = track.shown
    assert first.distance_m == pytest.approx(100.0, abs=5.0)
    assert second.distance_m == pytest.approx(LAP_M, abs=5.0)
    assert [first.zero, second.zero] == pytest.approx([ZERO, ZERO], abs=3e-4)


def test_a_position_that_jumps_tears_the_track() -> None:
    """A reset receiver or moved antenna: the apparently same place is another."""
    track = Track(ramp).drive((0.0, 0.0), (90.0, 0.0), (90.0, 90.0))
    track.shift_m = (0.9, 12.9)
    track.drive((90.0, 90.0), (0.0, 90.0), (0.0, -12.0), (20.0, -12.0))
    assert not track.shown
    assert track.tours.torn == 1
    track.drive((20.0, -12.0), (90.0, -12.0), (90.0, 90.0), (0.0, 90.0))
    assert [tour.zero for tour in track.shown] == pytest.approx([ZERO], abs=2e-4)


@pytest.mark.parametrize("seconds", [0.4, 60.0])
def test_a_gap_tears_the_track(seconds: float) -> None:
    track = Track(ramp).drive((0.0, 0.0), (90.0, 0.0), (90.0, 90.0))
    track.stamp_ns += round(seconds * 1e9)
    assert not track.drive((90.0, 90.0), (0.0, 90.0), (0.0, 0.0), (60.0, 0.0)).shown
    assert track.tours.torn == 1


def test_a_jolt_that_does_not_end_tears_the_track() -> None:
    track = Track(ramp)
    track.jolts = lambda place: 20.0 < place[0] < 20.0 + 1.5 * closed_tours.MAX_JOLT_S * SPEED_MPS
    assert not track.drive(*SQUARE, (18.0, 0.0)).shown
    assert track.tours.torn == 2  # there and back


def test_an_unsure_position_is_no_place_to_come_back_to() -> None:
    track = Track(std_m=closed_tours.MOST_STD_M + 0.1)
    for _ in range(3):
        track.drive(*SQUARE)
    assert not track.shown
    track.std_m = 1.0  # the track continues, but marks only later places
    track.drive(*SQUARE).drive(*SQUARE)
    assert len(track.shown) in (1, 2)
    assert track.shown[0].zero == pytest.approx(ZERO, abs=1e-4)


def test_a_parked_machine_whose_position_wanders_shows_nothing() -> None:
    track = Track()
    for i in range(5000):
        track.at((100.0 * math.sin(i / 300), 0.0), (1.0, 0.0), 0.0)
    assert not track.shown
    track.drive(*SQUARE, (60.0, 0.0))
    assert [tour.zero for tour in track.shown] == pytest.approx([ZERO], abs=2e-4)


def test_a_tour_closes_after_a_steep_slope_and_not_on_it() -> None:
    track = Track(lambda x, y: 2 * ramp(x, y)).drive((45.0, 0.0), *SQUARE[1:], (59.0, 0.0))
    assert not track.shown
    track.drive((59.0, 0.0), (75.0, 0.0))
    assert [tour.zero for tour in track.shown] == pytest.approx([ZERO], abs=3e-4)
    assert track.shown[0].std == pytest.approx(RISE_STD_M / LAP_M, rel=0.1)


def test_short_tours_do_not_count_and_long_ones_are_surer() -> None:
    def lap(side_m: float) -> list[Tour]:
        corners = ((0.0, 0.0), (side_m, 0.0), (side_m, side_m), (0.0, side_m), (0.0, 0.0), (side_m / 2, 0.0))
        return Track().drive(*corners).shown

    assert not lap(14.0)
    assert lap(20.0)[0].std > 2.5 * lap(90.0)[0].std > 4 * lap(400.0)[0].std


def test_marks_do_not_grow_without_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(closed_tours, "KEPT", 120)
    track = Track().drive((0.0, 0.0), (1000.0, 0.0))
    assert len(track.tours._marks) <= 120
    track.drive((1000.0, 0.0), (1000.0, 40.0), (950.0, 40.0), (950.0, 0.0), (980.0, 0.0))
    assert [tour.zero for tour in track.shown] == pytest.approx([ZERO], abs=2e-4)
