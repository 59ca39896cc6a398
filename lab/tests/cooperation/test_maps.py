"""Maps of an arm over time: by stamp, by arrival, with the decisions made so far."""

import numpy as np
import pytest

from lab.cooperation.live import LiveRun, arrivals
from lab.cooperation.maps import Timeline
from lab.tests.cooperation.samples import SECOND_NS, driving
from mapserver.calibration.correction import LAST_NS, Correction
from mapserver.calibration.decision import SOLVER, CalibrationDecision
from mapserver.ingest.decisions import plain
from mapserver.journal.rows import JournalRow
from mapserver.trust.decisions import AUDIT, TrustDecision
from protocol.site.geometry import CellWindow
from sim.simulator import START_NS

WINDOW = CellWindow(0, 0, 60, 40)
LATE_NS = 30 * SECOND_NS


def event(number: int, decision) -> dict:
    kind, stamp_ns, body = plain(decision)
    return {"id": number, "kind": kind, "stamp_ns": stamp_ns, "body": body}


def excludes(machine: str, second: float) -> TrustDecision:
    return TrustDecision(machine, False, AUDIT, "it contradicts all others", START_NS + round(second * 1e9))


def corrects(machine: str, zero: float, second: float) -> CalibrationDecision:
    span = Correction(machine, 0, LAST_NS, zero, 0.0, 0.0, ((1e-8, 0.0, 0.0), (0.0, 1e-8, 0.0), (0.0, 0.0, 1e-8)))
    return CalibrationDecision(machine, SOLVER, "by the ground", START_NS + round(second * 1e9), (span,))


@pytest.fixture
def run() -> LiveRun:
    """Two machines on separate lanes for 20 s, arriving 30 s late."""
    samples = np.concatenate([driving(0, 20, 10.5), driving(0, 20, 30.5, c_rr=0.06)])
    return LiveRun(
        samples=samples,
        machine=np.repeat([0, 1], 20),
        arrived_ns=samples["stamp_ns"] + LATE_NS,
        machines=["a", "b"],
        events=[],
        sent_bytes=[0, 0],
        received_bytes=[0, 0],
        delivered=True,
        late_s=0.0,
        pids={},
    )


def with_events(run: LiveRun, *events: dict) -> LiveRun:
    return LiveRun(**{**vars(run), "events": list(events)})


def known(layers, row: int) -> int:
    return int(np.isfinite(layers["resistance"][row, 20:40]).sum())


def at(*seconds: float) -> list[int]:
    return [START_NS + round(second * 1e9) for second in seconds]


def test_a_map_has_what_was_stamped_by_then(run: LiveRun):
    maps = list(Timeline.of_run(run).maps(at(4.5, 9.5, 100), WINDOW))
    assert [known(layers, 10) for layers in maps] == [5, 10, 20]
    assert maps[-1]["resistance"][10, 25] == pytest.approx(0.02, abs=0.002)
    assert maps[-1]["resistance"][30, 25] == pytest.approx(0.06, abs=0.006)


def test_maps_step_by_step_are_those_made_at_once(run: LiveRun):
    line = Timeline.of_run(with_events(run, event(1, corrects("a", 0.004, 7.0))))
    stepped = list(line.maps(at(*range(2, 22, 3)), WINDOW))[-1]
    (whole,) = line.maps(at(20), WINDOW)
    for name in stepped:
        assert np.array_equal(stepped[name], whole[name], equal_nan=True)


def test_a_decision_counts_from_when_it_was_made(run: LiveRun):
    judged = with_events(run, event(1, excludes("b", 12.0)))
    before, after = Timeline.of_run(judged).maps(at(11, 13), WINDOW)
    assert (known(before, 30), known(after, 30)) == (12, 0)
    assert known(after, 10) == 14
    (known_now,) = Timeline.of_run(judged, decided=True).maps(at(11), WINDOW)
    assert known(known_now, 30) == 0


def test_by_arrival_a_decision_counts_once_the_sites_now_has_arrived(run: LiveRun):
    line = Timeline.of_run(with_events(run, event(1, excludes("b", 12.0))), arrived=True)
    assert [(when - START_NS) / 1e9 for when, _ in line.facts[1:]] == [42.0]


def test_arrivals_are_in_the_time_of_each_machines_log():
    rows = [
        JournalRow(1, "a", 1, 1, driving(0, 2), received_ns=1_002 * SECOND_NS),
        JournalRow(2, "b", 1, 1, driving(0, 1), received_ns=1_005 * SECOND_NS),
    ]
    got = arrivals(rows, {"a": 1_000.0, "b": 1_004.0}, speed=8.0)
    assert ((got - START_NS) / 1e9).tolist() == [16.0, 16.0, 8.0]
