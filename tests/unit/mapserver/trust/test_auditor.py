"""Simulated fleets on five zones: bad machines are found with reason, no others."""

import tracemalloc
from typing import Any

import numpy as np
import pytest
from scipy.signal import lfilter

from mapserver.calibration.select import MachineErrors
from mapserver.journal.rows import JournalRows
from mapserver.trust import coarse_map
from mapserver.trust.auditor import Auditor, Verdict
from mapserver.trust.judgement import Reason
from protocol.arrays import Table
from protocol.machine.samples import SCALE_STD, ZERO_STD, empty
from protocol.site.ground_classes import ZONES
from tests.unit.mapserver.data import NOW_NS, samples

WIDTH_M, HEIGHT_M, STEP_M, STEP_S = 150, 100, 0.6, 0.2
C_RR = np.array([zone.c_rr for zone in ZONES])
SITE = np.zeros((HEIGHT_M, WIDTH_M), np.int64)
SITE[:50, 75:], SITE[50:, :50], SITE[50:, 50:100], SITE[50:, 100:] = 2, 1, 4, 3
WETTER = np.minimum(SITE + 1, 3)
DIRT = np.full_like(SITE, 2)


def gauss_markov(rng: np.random.Generator, n: int, std: float, tau_s: float) -> np.ndarray:
    decay = np.exp(-STEP_S / tau_s)
    noise = rng.normal(0, std * np.sqrt(1 - decay**2), n)
    noise[0] = rng.normal(0, std)
    return lfilter([1], [1, -decay], noise)


def drive(
    seed: int,
    km: float = 3.6,
    std_m: float = 1.3,
    gain: float = 1.0,
    zero: float = 0.0,
    off_m: tuple[float, float] = (0.0, 0.0),
    stuck: float | None = None,
    clock_s: float = 0.0,
    start_s: float = 0.0,
    site: np.ndarray = SITE,
    later: tuple[float, np.ndarray] | None = None,
) -> Table:
    """A machine driving from goal to goal; later: time of the site's change [s]."""
    rng = np.random.default_rng(seed)
    n = round(km * 1000 / STEP_M)
    goals = rng.uniform(0, (WIDTH_M, HEIGHT_M), (n // 20, 2))
    legs = np.maximum(1, np.hypot(*np.diff(goals, axis=0).T) / STEP_M)
    x, y = (np.interp(np.arange(n), np.r_[0, np.cumsum(legs)], goals[:, axis]) for axis in (0, 1))
    seconds = start_s + np.arange(n) * STEP_S
    place = y.astype(int).clip(0, HEIGHT_M - 1), x.astype(int).clip(0, WIDTH_M - 1)
    zone = site[place] if later is None else np.where(seconds >= later[0], later[1][place], site[place])
    rows = empty(n)
    rows["stamp_ns"] = NOW_NS + np.rint((seconds + clock_s) * 1e9).astype(np.int64)
    rows["x_m"] = x + gauss_markov(rng, n, std_m, 30) + off_m[0]
    rows["y_m"] = y + gauss_markov(rng, n, std_m, 30) + off_m[1]
    rows["cov_xx_m2"] = rows["cov_yy_m2"] = std_m**2
    rows["distance_m"] = STEP_M
    rows["c_rr"] = (gain * C_RR[zone] + zero if stuck is None else stuck) + rng.normal(
        0, 0.002 if stuck is None else 5e-4, n
    )
    return rows


def audit(fleet: list[Table], batch: int = 250) -> dict[str, Verdict]:
    auditor = Auditor(1.0)
    send(auditor, "abcdefgh", fleet, batch)
    return auditor.verdicts()


def send(auditor: Auditor, names: str, fleet: list[Table], batch: int = 250) -> None:
    for first in range(0, max(map(len, fleet)), batch):
        for name, rows in zip(names, fleet, strict=False):
            auditor.add(name, rows[first : first + batch])


def accused(verdicts: dict[str, Verdict]) -> dict[str, tuple[Reason, ...]]:
    return {name: verdict.reasons for name, verdict in verdicts.items() if verdict.contradicts}


def fleet(seed: int, *machines: dict[str, Any], **all_of_them: Any) -> list[Table]:
    return [drive(100 * seed + i, **(all_of_them | machine)) for i, machine in enumerate(machines)]


GOOD: dict[str, Any] = {}
BAD = {
    "gain": ([{"gain": 1.6}], [Reason.GAIN]),
    "weak": ([{"gain": 0.7}], [Reason.GAIN]),
    "stuck": ([{"stuck": 0.04}], [Reason.STUCK]),
    "fast clock": ([{"clock_s": 3600.0}], [Reason.CLOCK]),
    "displaced": ([{"off_m": (3.5, 0.0), "km": 10.8}], [Reason.OFFSET]),
    "two alike of five": ([{"gain": 1.6}, {"gain": 1.6}], [Reason.GAIN, Reason.GAIN]),
    "mirrored site": ([{"site": SITE[::-1, ::-1]}], [Reason.DISAGREES]),
}


@pytest.mark.parametrize("case", BAD)
def test_a_bad_machine_is_found_with_the_reason_and_no_other(case: str) -> None:
    faults, reasons = BAD[case]
    km = faults[0].get("km", 3.6)
    verdicts = audit(fleet(0, GOOD, GOOD, GOOD, *faults, km=km))
    assert accused(verdicts) == {name: (reason,) for name, reason in zip("de", reasons, strict=False)}
    for name, reason in zip("de", reasons, strict=False):
        assert verdicts[name].evidence["excess"][reason] > 1


def test_gain_and_displacement_together_are_both_found_and_measured() -> None:
    verdicts = audit(fleet(0, GOOD, GOOD, GOOD, {"gain": 1.6, "off_m": (0.0, 3.5)}, km=10.8))
    assert accused(verdicts) == {"d": (Reason.GAIN, Reason.OFFSET)}
    evidence = verdicts["d"].evidence
    assert evidence["gain"] == pytest.approx(1.6, abs=0.03)
    assert evidence["offset_north_m"] == pytest.approx(3.5, abs=1.0)
    assert abs(evidence["offset_east_m"]) < 1.0
    assert evidence["agreement"] > 0.8
    assert evidence["disagrees_with"] == ("a", "b", "c")


def state(zero: float, scale: float) -> MachineErrors:
    beyond = (abs(zero) / ZERO_STD, abs(scale) / SCALE_STD)
    return MachineErrors(zero, 0.001, scale, 0.01, 0.0, 0.001, ("heights",), ("edges",), beyond)


@pytest.mark.parametrize("off", [(0.0, 0.6), (0.0, -0.35), (0.03, 0.0)])
def test_a_machine_whose_corrected_samples_agree_is_accused_of_what_was_corrected(off: tuple[float, float]) -> None:
    auditor = Auditor(1.0)
    send(auditor, "abcd", fleet(0, GOOD, GOOD, GOOD, GOOD))
    known = {name: state(0.004, 0.05) for name in "abc"}
    verdicts = auditor.verdicts(known | {"d": state(*off)})
    assert accused(verdicts) == {"d": (Reason.BEYOND_DATA_SHEET,)}
    evidence = verdicts["d"].evidence
    assert (evidence["zero"], evidence["torque_gain"]) == (off[0], pytest.approx(1 + off[1]))
    assert (evidence["zero_std"], evidence["torque_gain_std"]) == (0.001, 0.01)
    assert (evidence["zero_by"], evidence["torque_gain_by"]) == (("heights",), ("edges",))
    assert evidence["excess"]["beyond_data_sheet"] > 1
    assert evidence["agrees_with"] == ("a", "b", "c")
    assert accused(auditor.verdicts(known | {"d": state(0.02, 0.29)})) == {}
    assert accused(auditor.verdicts(dict.fromkeys("abcd", state(*off)))) == {}


def test_a_machine_at_fault_is_no_measure_for_the_others() -> None:
    auditor = Auditor(1.0)
    send(auditor, "abc", fleet(0, GOOD, GOOD, {"gain": 1.1}))
    by_all = auditor.verdicts()["a"].evidence["gain"]
    by_right = auditor.verdicts({"c": state(0.0, 0.6)})["a"].evidence["gain"]
    assert by_all < 0.99
    assert by_right == pytest.approx(1.0, abs=0.01)


HONEST = {
    "alike": [GOOD] * 4,
    "one far better": [{"std_m": 0.05}] + [{"std_m": 2.5}] * 3,
    "scales of 5 %": [{"gain": 0.95}, GOOD, GOOD, {"gain": 1.05}],
    "biases on concrete": [{"zero": z, "site": 0 * SITE} for z in (0.0, 0.0, 0.003)],
    "stuck where nothing varies": [{"site": DIRT}] * 3 + [{"site": DIRT, "stuck": 0.04}],
    "repaved for all": [{"later": (600.0, WETTER)}] * 3,
    "two against two": [GOOD, GOOD, {"gain": 1.6}, {"gain": 1.6}],
    "most are wrong": [GOOD, GOOD, {"gain": 1.6}, {"gain": 0.6}, {"gain": 2.5}],
    "alone": [GOOD],
    "too little ground": [{"km": 0.12}] * 2 + [{"km": 0.12, "gain": 1.6}],
}


@pytest.mark.parametrize("case", HONEST)
def test_no_machine_is_accused_without_need(case: str) -> None:
    assert accused(audit(fleet(1, *HONEST[case]))) == {}


@pytest.mark.parametrize("after_s", [0.0, 3600.0])
def test_a_machine_that_left_before_the_rain_is_not_accused(after_s: float) -> None:
    """Unless it was there then."""
    auditor = Auditor(1.0)
    send(auditor, "d", [drive(1)])
    send(auditor, "abc", fleet(0, GOOD, GOOD, GOOD, site=WETTER, start_s=after_s))
    assert bool(accused(auditor.verdicts())) == (after_s == 0)


@pytest.mark.parametrize(("name", "value"), [("x_m", 5000.0), ("distance_m", 0.0), ("cov_xx_m2", 100.0)])
def test_samples_from_elsewhere_of_no_way_or_unsure_of_their_place_do_not_count(name: str, value: float) -> None:
    rows = drive(3, gain=1.6)
    rows[name] = value
    assert audit([*fleet(0, GOOD, GOOD, GOOD), rows])["d"].evidence["cells"] == 0


def test_a_repaired_machine_is_cleared_once_its_bad_periods_are_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(coarse_map, "PERIOD_S", 900.0)
    monkeypatch.setattr(coarse_map, "PERIODS", 2)
    others = fleet(0, GOOD, GOOD, GOOD, km=10.8)
    half = len(others[0]) // 2
    mended = np.concatenate([drive(3, km=5.4, gain=1.6), drive(4, km=5.4, start_s=half * STEP_S)])
    assert accused(audit([*others, mended])) == {}
    early = [rows[:half] for rows in (*others, mended)]
    assert accused(audit(early)) == {"d": (Reason.GAIN,)}


def test_many_rows_at_once_are_judged_as_one_by_one() -> None:
    sent = fleet(2, GOOD, GOOD, GOOD, {"gain": 1.4, "clock_s": 500.0})
    one_by_one = Auditor(1.0)
    send(one_by_one, "abcd", sent, 100)
    batches = [(i % 4, sent[i % 4][first : first + 100]) for first in range(0, len(sent[0]), 100) for i in range(4)]
    at_once = Auditor(1.0)
    for part in (batches[:70], batches[70:]):
        n, none = len(part), np.zeros(len(part), np.int64)
        lengths = np.array([len(rows) for _, rows in part])
        samples_of = np.concatenate([rows for _, rows in part])
        machine = np.array([i for i, _ in part])
        at_once.add_all(JournalRows(samples_of, lengths, tuple("abcd"), machine, np.arange(n), none, none, none))
    assert at_once.verdicts() == one_by_one.verdicts()


def test_ten_machines_on_a_large_site_take_little_memory() -> None:
    """1 km2, a tenth driven by each of ten machines: 25 000 cells of 2 m."""
    x_m, y_m = np.meshgrid(np.arange(0.5, 1000, 2), np.arange(0.5, 100, 2))
    rows = samples(x_m.size, x_m=x_m.ravel(), y_m=y_m.ravel(), stamp_ns=NOW_NS)
    tracemalloc.start()
    auditor = Auditor(1.0)
    for machine in "abcdefghij":
        auditor.add(machine, rows)
        auditor.add(machine, rows)
    used = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert used < 30e6
