"""filterpy's filters behind our interface: steps equal to ours, and failures."""

import math
import subprocess
import sys
from collections.abc import Callable

import numpy as np
import pytest

from agents.localisation import localiser as localiser_module
from agents.localisation.filters.belief import Belief, Conditioned, DivergedError, Filter, Measurement, Motion
from agents.localisation.filters.ekf import Ekf
from agents.localisation.filters.textbook import TextbookEkf, TextbookUkf
from agents.localisation.filters.ukf import Ukf
from agents.localisation.localiser import LocalisationConfig
from agents.positioning import PipelineConfig, Positioning
from protocol.arrays import Floats
from protocol.machine.machine_config import SensorConfig
from tests.unit.agents.drives import (
    PROJECTION,
    S_BEND,
    SITE,
    START,
    START_NS,
    RunLocaliser,
    drive,
    machine,
    thinned,
    with_ahrs,
)

PAIRS = pytest.mark.parametrize(
    ("stock", "own", "name"), [(TextbookEkf(), Ekf(), "ekf"), (TextbookUkf(), Ukf(), "ukf")], ids=["ekf", "ukf"]
)
STOCK = pytest.mark.parametrize("stock", [TextbookEkf(), TextbookUkf()], ids=["ekf", "ukf"])
SECOND = 1_000_000_000
AHRS = SensorConfig("ahrs", "attitude")


class Compared:
    """A filter stepping from one's beliefs, noting the largest difference to the other's."""

    def __init__(self, stock: Filter, own: Filter) -> None:
        self.difference, self.steps, self.accepted = 0.0, 0, 0
        self._stock, self._own = stock, own

    def predict(self, belief: Belief, motion: Motion, stamp_ns: int) -> Belief:
        stock, own = (engine.predict(belief, motion, stamp_ns) for engine in (self._stock, self._own))
        self._compare(stock, own)
        return stock

    def condition(self, belief: Belief, measurement: Measurement) -> Conditioned:
        stock, own = (engine.condition(belief, measurement) for engine in (self._stock, self._own))
        assert stock.accepted == own.accepted
        assert stock.nis == pytest.approx(own.nis, rel=1e-9, nan_ok=True)
        np.testing.assert_allclose(stock.innovation, own.innovation, atol=1e-9)
        self.accepted += stock.accepted
        self._compare(stock.belief, own.belief)
        return stock

    def _compare(self, stock: Belief, own: Belief) -> None:
        self.steps += 1
        self.difference = max(self.difference, *(float(np.abs(d).max()) for d in (stock.x - own.x, stock.P - own.P)))


@PAIRS
@pytest.mark.slow
def test_each_step_of_a_drive_is_that_of_our_own_filter(
    stock: Filter, own: Filter, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Alignment, turns across +-180 degrees, an AHRS, fixes with a lever arm, an outlier."""
    vehicle = machine(receivers=2)
    vehicle = type(vehicle)(**{**vars(vehicle), "sensors": (*vehicle.sensors, AHRS)})
    made = drive(S_BEND[:3], vehicle, heading_rad=3.0)
    compared = Compared(stock, own)
    monkeypatch.setattr(localiser_module, "_engine", lambda _: compared)
    located = RunLocaliser(vehicle, PROJECTION, LocalisationConfig(profile="paper", filter=name))
    located.run(thinned(with_ahrs(made), 20))
    assert compared.steps > 500
    assert compared.accepted > 400
    assert compared.difference < 1e-9


@STOCK
def test_what_is_no_number_is_refused(stock: Filter) -> None:
    belief = Belief(0, np.zeros(2), np.eye(2))
    for bad in (seen([math.nan]), seen([math.inf]), seen([1.0], R=math.nan)):
        result = stock.condition(belief, bad)
        assert result.belief is belief
        assert math.isnan(result.nis)


NO_COVARIANCE = np.array([[1.0, 2.0], [2.0, 1.0]])  # eigenvalue -1


@pytest.mark.parametrize("P", [NO_COVARIANCE, np.eye(2) * np.nan, np.diag([-1.0, 1.0])])
def test_sums_that_fail_say_so(P: Floats) -> None:
    ukf, ekf = TextbookUkf(), TextbookEkf()
    with pytest.raises(DivergedError):
        ukf.predict(Belief(0, np.zeros(2), P), still(np.zeros((2, 2))), 1)
    if P is not NO_COVARIANCE:  # the EKF never factors its covariance
        with pytest.raises(DivergedError):
            ekf.predict(Belief(0, np.zeros(2), P), still(np.zeros((2, 2))), 1)
    with pytest.raises(DivergedError):
        ukf.condition(Belief(0, np.zeros(2), P), seen([1.0]))


def test_a_filter_that_failed_starts_again_and_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    vehicle = machine()
    made = drive([*S_BEND, *S_BEND[2:]], vehicle)
    failing = FailsOnce(Ekf(), START_NS + 20 * SECOND)
    monkeypatch.setattr(localiser_module, "_engine", lambda _: failing)
    config = PipelineConfig(localisation=LocalisationConfig(profile="paper", start=START))
    positioning = Positioning(SITE, vehicle, config)
    lost = False
    for reading in thinned(made.readings):
        positioning.step([reading])
        if positioning.counters["filter_restarts"] and not lost:
            lost = True
            assert positioning.pose is None  # the configured start is far behind
    assert positioning.counters["filter_restarts"] == 1
    assert made.off_m(positioning.pose) < 0.5
    assert made.turned_rad(positioning.pose) < 0.1


class FailsOnce:
    """A filter failing at one stamp."""

    def __init__(self, engine: Filter, at_ns: int) -> None:
        self._engine, self._at_ns, self._failed = engine, at_ns, False

    def predict(self, belief: Belief, motion: Motion, stamp_ns: int) -> Belief:
        if stamp_ns >= self._at_ns and not self._failed:
            self._failed = True
            raise DivergedError("as in this test")
        return self._engine.predict(belief, motion, stamp_ns)

    def condition(self, belief: Belief, measurement: Measurement) -> Conditioned:
        return self._engine.condition(belief, measurement)


@pytest.mark.slow
@pytest.mark.parametrize(("profile", "name", "loaded"), [("default", "ukf", False), ("paper", "ekf", True)])
def test_only_the_paper_s_profile_loads_the_library(profile: str, name: str, loaded: bool) -> None:
    code = (
        "import sys; from tests.unit.agents.drives import *; from agents.agent import Agent\n"
        f"run = localiser(VEHICLE, profile={profile!r}, filter={name!r}, start=START)\n"
        "run.run(drive((Leg(1),), VEHICLE).readings); assert run.belief\n"
        "print([n for n in ('filterpy', 'matplotlib') if n in sys.modules])"
    )
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert ("filterpy" in output) == loaded
    assert loaded or "matplotlib" not in output


def still(Q: Floats) -> Motion:
    identity: Callable[[Floats], Floats] = lambda states: states  # noqa: E731
    return Motion(identity, lambda x: np.eye(len(x)), Q, ())


def seen(z: list[float], R: float = 1.0, gate_sigma: float = 0.0) -> Measurement:
    """The first state."""
    H = np.array([[1.0, 0.0]])
    return Measurement("a", 0, np.array(z), np.array([[R]]), lambda s: s @ H.T, lambda _: H, gate_sigma=gate_sigma)
