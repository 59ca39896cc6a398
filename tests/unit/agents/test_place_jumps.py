"""Position jumps with wheels still counting: no sample is wrong and certain, whichever place was right."""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from agents.localisation.localiser import LocalisationConfig
from agents.localisation.place_watch import CLEAR_S, MARGIN_NS, MOST_CLEAR_S, PlaceWatch
from agents.pipeline import Pipeline
from agents.positioning import PipelineConfig
from agents.sampling import joined
from protocol.arrays import Bools, Floats
from protocol.machine.machine_config import MachineConfig
from protocol.machine.readings import Gps, Reading
from tests.tiers import by_night
from tests.unit.agents.drives import SITE, START_NS, Leg, drive, machine, noisy, seconds, thinned
from tests.unit.agents.test_receiver_faults import SLOW_S, SLOW_SHARE, STD_M, shifted

LEGS = (Leg(3), Leg(4, 1.0), Leg(6), *[Leg(5, 0.0, 0.25), Leg(7), Leg(4, 0.0, -0.3), Leg(6)] * 5)  # 123 s
SEED, AT_S = 1, 60.0
Off = Callable[[float], float]  # fix error by time


@cache
def measured(receivers: int) -> tuple[MachineConfig, list[Reading]]:
    """The drive by receivers with slow and white errors."""
    own = machine(receivers=receivers)
    slow = {"drift_share": SLOW_SHARE, "drift_time_s": SLOW_S}
    own = replace(own, sensors=tuple(replace(s, **slow) if s.kind == "gps" else s for s in own.sensors))
    rng, slow_m, kept = np.random.default_rng(SEED), math.sqrt(SLOW_SHARE) * STD_M, math.exp(-0.2 / SLOW_S)
    errors = {f"gps-{i + 1}": slow_m * rng.standard_normal(2) for i in range(receivers)}
    readings: list[Reading] = []
    for r in noisy(thinned(drive(LEGS, own).readings, 40), SEED):
        if isinstance(r, Gps):
            errors[r.sensor] = kept * errors[r.sensor] + slow_m * math.sqrt(1 - kept**2) * rng.standard_normal(2)
            white_m = math.sqrt(1 - SLOW_SHARE) * STD_M * rng.standard_normal(2)
            r = shifted(r, *(errors[r.sensor] + white_m).tolist())
        readings.append(r)
    return own, readings


def replayed(off: Off, receivers: int = 1, hit: tuple[str, ...] = ("gps-1", "gps-2")) -> tuple[Floats, Bools, Any, str]:
    """Times of final samples, those over 5 m off with a stated error below 3 m, health and its sentence."""
    own, readings = measured(receivers)
    pipeline = Pipeline(SITE, own, PipelineConfig(LocalisationConfig("ekf", slip=0.0, slip_soft=0.0)))
    made, said = [], ""
    for r in readings:
        if isinstance(r, Gps) and r.sensor in hit and (off_m := off(seconds(r))):
            r = shifted(r, 0.6 * off_m, 0.8 * off_m)
        made.append(pipeline.step([r]))
        said = said or " ".join(pipeline.faults.values())
    final, made_up = joined([*made, pipeline.finish()]).final, drive(LEGS, own)
    true = np.array([made_up.at(stamp_ns) for stamp_ns in final["stamp_ns"].tolist()])
    east_m = final["x_m"] - true[:, 0] - own.load_centre_m * np.cos(true[:, 2])
    north_m = final["y_m"] - true[:, 1] - own.load_centre_m * np.sin(true[:, 2])
    sure = np.sqrt(np.maximum(final["cov_xx_m2"], final["cov_yy_m2"])) < 3.0
    return (final["stamp_ns"] - START_NS) * 1e-9, (np.hypot(east_m, north_m) > 5.0) & sure, pipeline.health(), said


def false(metres: float, lasts_s: float, creeps_s: float = 1e-9) -> Off:
    return lambda s: metres * min(max(s - AT_S, 0.0) / creeps_s, 1.0) * (s < AT_S + lasts_s)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("metres", "lasts_s", "creeps_s", "receivers"),
    by_night([(30, 5, 0, 1), (100, 30, 2, 1), (500, 30, 0, 2)], day=[(30, 5, 0, 1)]),
)
def test_of_a_jump_that_comes_back_only_what_lies_between_is_withheld(
    metres: float, lasts_s: float, creeps_s: float, receivers: int
) -> None:
    at_s, lies, health, said = replayed(false(metres, lasts_s, creeps_s or 1e-9), receivers)
    assert lies.sum() <= 1
    assert health["counters"]["place_jumps_back"] == 1
    assert health["withheld"]["place_unclear"] < 8 * (lasts_s + 12.0)  # at 4 m/s
    assert (at_s > AT_S + lasts_s + 10.0).sum() > 100
    assert "jumped" in said
    assert "samples are withheld until it is clear which place is right" in said


@pytest.mark.slow
@pytest.mark.parametrize(
    "off",
    [
        pytest.param(false(30.0, math.inf, 2.0), id="false"),
        pytest.param(lambda s: 500.0 * (s < AT_S), id="true", marks=pytest.mark.nightly),
    ],
)
def test_of_a_jump_that_lasts_nothing_is_sure_before_it_has_stood_for_longer(off: Off) -> None:
    _, lies, health, _ = replayed(off)
    assert lies.sum() <= 1
    assert health["counters"]["place_jumps"] == 1
    assert health["withheld"]["place_unclear"] > 300


@pytest.mark.slow
@pytest.mark.nightly
def test_a_receiver_that_jumps_beside_one_that_does_not_withholds_nothing() -> None:
    _, lies, health, _ = replayed(false(30.0, math.inf), 2, ("gps-1",))
    assert lies.sum() <= 1
    assert "place_jumps" not in health["counters"]


def stood(watch: PlaceWatch, from_s: float, to_s: float) -> None:
    for at_s in np.arange(from_s, to_s, 0.2).tolist():
        watch.look(round(at_s * 1e9))


@pytest.mark.parametrize(("before_s", "needed_s"), [(15.0, CLEAR_S), (60.0, 180.0), (4000.0, MOST_CLEAR_S)])
def test_a_new_place_has_to_last_longer_than_the_one_before(before_s: float, needed_s: float) -> None:
    watch, jump_ns = PlaceWatch(), round((1000 + before_s) * 1e9)
    stood(watch, 1000.0, 1000.0 + before_s)
    watch.jumped("gps-1", jump_ns, jump_ns + MARGIN_NS, np.array([30.0, 0.0]))
    begin_s = 1003.0 + before_s
    stood(watch, begin_s, begin_s + needed_s - 4.0)
    assert not watch.is_clear
    assert watch.off_m(0) == 30.0
    stood(watch, begin_s + needed_s - 4.0, begin_s + needed_s + 2.0)
    assert watch.is_clear
    assert watch.off_m(jump_ns - 10**9) == 30.0, "nobody knows how long it was wrong before"
    assert watch.off_m(jump_ns + 3 * MARGIN_NS) == 0.0


def test_jumps_on_the_way_count_from_the_first_place_and_a_short_one_is_none() -> None:
    watch = PlaceWatch()
    watch.jumped("gps-1", 10**10, 10**10, np.array([5.0, 5.0]))
    assert watch.is_clear
    for off_m in ([20.0, 0.0], [0.0, 30.0], [-21.0, -28.0]):
        watch.jumped("gps-1", 2 * 10**10, 2 * 10**10, np.array(off_m))
    assert watch.is_clear
    assert watch.counters == {"place_jumps": 3, "place_jumps_back": 1}
    assert watch.off_m(2 * 10**10) > 30.0
    assert watch.off_m(10**10) == 0.0
