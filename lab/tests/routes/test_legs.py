"""Legs of synthetic tracks: stop to stop, laps, and none."""

import numpy as np
import pytest

from lab.routes.legs import Leg, _laps, _spans, drives_of
from protocol.queries.routing import RouteMachine
from sitegrid.proof.tracks import LoadTrack

HZ = 10


def track(speed, heading):
    """Track at 10 Hz."""
    step = np.asarray(speed) / HZ
    place = np.cumsum(step[:, None] * np.stack([np.cos(heading), np.sin(heading)], axis=1), axis=0)
    stamps = np.arange(len(step)) * 10**8
    table = np.zeros(len(step), [("speed", "f8")])
    table["speed"] = speed
    return table, LoadTrack(stamps, place, np.unwrap(heading), np.zeros((len(step), 2)), np.cumsum(np.abs(step)))


def test_a_leg_is_from_stop_to_stop_ahead_and_long():
    drives = [(5.0, 300), (0.0, 50), (5.0, 400), (0.0, 50), (-5.0, 400), (0.0, 20), (5.0, 100), (0.0, 20), (5.0, 300)]
    speed = np.concatenate([np.full(n, v) for v, n in drives])
    table, course = track(speed, np.zeros(len(speed)))
    ((begin, end, stops),) = _spans(table, course)
    assert stops == (True, True)
    assert course.driven_m[end] - course.driven_m[begin] == pytest.approx(200)
    assert table["speed"][begin] == table["speed"][end] == 0.0


def test_a_tour_without_stops_is_cut_into_whole_turns():
    around = 2 * np.pi * 50
    speed = np.full(round(3.5 * around / 5 * HZ), 5.0)
    table, course = track(speed, np.arange(len(speed)) * 5 / HZ / 50)
    laps = list(_spans(table, course))
    assert len(laps) == 3
    for (begin, end, stops), (following, _, _) in zip(laps, [*laps[1:], (laps[-1][1], 0, 0)], strict=True):
        assert stops == (False, False)
        assert course.driven_m[end] - course.driven_m[begin] == pytest.approx(around, abs=1.0)
        assert end == following
    straight = track(speed, np.zeros(len(speed)))[1]
    assert list(_laps(straight, 0, len(speed))) == []


def test_legs_over_one_line_with_one_load_are_one_drive():
    x = np.arange(400.0)
    there = np.stack([x, 0 * x], axis=1)
    truck, empty_truck = RouteMachine(mass_kg=44_000.0), RouteMachine(mass_kg=22_000.0)

    def leg(line, machine=truck):
        return Leg(line, machine, (True, True), 1.0, 1.0)

    legs = [leg(there), leg(there + 2.0), leg(there[::-1]), leg(there, empty_truck), leg(there[:200]), leg(there - 1.0)]
    assert drives_of(legs) == [0, 0, 1, 2, 3, 0]
